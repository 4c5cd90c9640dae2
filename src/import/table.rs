//! Lines of separated fields that know where in which file they stand.

use std::path::{Path, PathBuf};

use super::ImportError;
use crate::time::Stamp;

/// The text of a file with its name.
pub(super) struct Text {
    path: PathBuf,
    text: String,
}

/// One line, cut into fields.
pub(super) struct Row<'a> {
    path: &'a Path,
    line: usize,
    text: &'a str,
    fields: Vec<&'a str>,
}

impl Text {
    pub(super) fn read(path: &Path) -> Result<Self, ImportError> {
        let unreadable = |source| ImportError::Unreadable { path: path.to_owned(), source };
        let text = std::fs::read_to_string(path).map_err(unreadable)?;
        Ok(Self { path: path.to_owned(), text })
    }

    /// The lines that are not empty.
    pub(super) fn rows(&self, separator: Separator) -> impl Iterator<Item = Row<'_>> {
        let text = self.text.strip_prefix('\u{feff}').unwrap_or(&self.text);
        let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
        lines.map(move |(index, line)| Row::cut(&self.path, index + 1, line, separator))
    }

    /// Its length.
    pub(super) fn bytes(&self) -> u64 {
        self.text.len() as u64
    }

    /// How many bytes are before a row.
    pub(super) fn offset(&self, row: &Row<'_>) -> u64 {
        (row.text.as_ptr() as usize - self.text.as_ptr() as usize) as u64
    }

    pub(super) fn error(&self, line: usize, message: String) -> ImportError {
        ImportError::Invalid { path: self.path.clone(), line, column: 1, message }
    }
}

/// What stands between fields.
#[derive(Clone, Copy)]
pub(super) enum Separator {
    Comma,
    Space,
}

impl<'a> Row<'a> {
    /// Line `line`, counted from 1, of the file `path`.
    pub(super) fn cut(path: &'a Path, line: usize, text: &'a str, separator: Separator) -> Self {
        let fields = match separator {
            Separator::Comma => text.split(',').map(str::trim).collect(),
            Separator::Space => text.split_ascii_whitespace().collect(),
        };
        Self { path, line, text, fields }
    }

    pub(super) fn fields(&self) -> &[&'a str] {
        &self.fields
    }

    pub(super) fn is_comment(&self) -> bool {
        self.text.trim_start().starts_with('#')
    }

    /// `Err` unless the line has so many fields.
    pub(super) fn expect_fields(&self, count: usize) -> Result<(), ImportError> {
        if self.fields.len() == count {
            return Ok(());
        }
        let column = if self.fields.len() > count { count } else { self.fields.len() };
        Err(self.error(column, format!("{} fields, expected {count}", self.fields.len())))
    }

    /// A number; NaN and infinities are numbers.
    pub(super) fn number(&self, field: usize) -> Result<f64, ImportError> {
        self.fields[field]
            .parse()
            .map_err(|_| self.error(field, format!("\"{}\" is not a number", self.fields[field])))
    }

    pub(super) fn stamp(&self, field: usize) -> Result<Stamp, ImportError> {
        Stamp::parse_seconds(self.fields[field])
            .ok_or_else(|| self.error(field, format!("\"{}\" is not a time in seconds", self.fields[field])))
    }

    /// An error at a field; past the last field, at the end of the line.
    pub(super) fn error(&self, field: usize, message: String) -> ImportError {
        // Fields are slices of the line, so their addresses tell where they stand.
        let column = match self.fields.get(field) {
            Some(part) => {
                let offset = part.as_ptr() as usize - self.text.as_ptr() as usize;
                self.text[..offset].chars().count() + 1
            }
            None => self.text.chars().count() + 1,
        };
        ImportError::Invalid { path: self.path.to_owned(), line: self.line, column, message }
    }
}
