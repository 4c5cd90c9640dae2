//! What was wrong with data on its way through: counted by kind, each with its first case.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

/// Kinds of faults, how many there were of each, and the first of them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    kinds: BTreeMap<String, (u64, String)>,
}

impl Faults {
    /// Counts one more of a kind, such as `/a/pose: messages that cannot be read`; `first` says which it is and
    /// why, and is asked for the first of the kind only.
    pub fn note(&mut self, kind: &str, first: impl FnOnce() -> String) {
        self.note_many(kind, 1, first);
    }

    /// Counts `count` more of a kind.
    pub fn note_many(&mut self, kind: &str, count: u64, first: impl FnOnce() -> String) {
        if count == 0 {
            return;
        }
        match self.kinds.get_mut(kind) {
            Some((sum, _)) => *sum += count,
            None => {
                self.kinds.insert(kind.to_owned(), (count, first()));
            }
        }
    }

    /// Counts bytes of a file that could not be read.
    pub fn note_lost(&mut self, path: &Path, bytes: u64) {
        let kind = format!("{}: bytes that are torn off or damaged", path.display());
        self.note_many(&kind, bytes, || "it was not closed, or a chunk fails its check".to_owned());
    }

    /// Nothing was wrong.
    pub fn is_empty(&self) -> bool {
        self.kinds.is_empty()
    }

    /// How many faults of a kind there were.
    pub fn count(&self, kind: &str) -> u64 {
        self.kinds.get(kind).map_or(0, |(count, _)| *count)
    }
}

/// One line a kind.
impl fmt::Display for Faults {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (kind, (count, first)) in &self.kinds {
            writeln!(formatter, "{kind}: {count}, first: {first}")?;
        }
        Ok(())
    }
}
