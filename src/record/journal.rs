//! What the estimator of a machine did, boot by boot and as a whole: for replay to the bit of runs that fit into memory.

use std::path::Path;

use super::{Places, RecordError, Step};
use crate::state::{LiveRun, Takeover};
use crate::wire::{BootId, JournalHead};

/// One boot of a machine, as far as the recording holds it without a gap.
#[derive(Clone, Debug, PartialEq)]
pub struct BootRun {
    /// Which boot.
    pub boot: BootId,
    /// Who took the readings, if the recording tells.
    pub head: Option<JournalHead>,
    /// From the boot on; what came after a gap is not in it.
    pub run: LiveRun,
    /// What is missing, if something is: the run ends before it.
    pub gap: Option<String>,
}

/// The boots of `machine` in a recording of one or more files of which there is a journal, oldest first.
///
/// The order of the readings is that of the journal. What the journal does not tell of, such as the last readings
/// before a power cut, is left out.
///
/// # Errors
/// [`RecordError`] if a file cannot be read or is no MCAP file.
pub fn read_live_runs<'a>(
    paths: impl IntoIterator<Item = &'a Path>,
    machine: &str,
) -> Result<Vec<BootRun>, RecordError> {
    let places = Places::of(paths, |_| ())?;
    let mut runs = Vec::new();
    for mut recorded in places.boots(machine)? {
        let mut run = LiveRun::default();
        while let Some(step) = recorded.next_step()? {
            let number = run.arrivals.len() as u64;
            match step {
                Step::Reading { arrival, seen } => {
                    if !seen {
                        run.unseen.insert(number);
                    }
                    run.arrivals.push(arrival);
                }
                Step::TookOver(solution_of) => run.takeovers.push(Takeover { before: number, solution_of }),
            }
        }
        if let (Some(boot), true) = (recorded.boot(), recorded.has_journal()) {
            let (head, gap) = (recorded.head().cloned(), recorded.gap().map(str::to_owned));
            runs.push(BootRun { boot, head, run, gap });
        }
    }
    Ok(runs)
}
