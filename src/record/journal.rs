//! Reads from a recording what the estimator of a machine did, boot by boot: for replay to the bit.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;

use super::{RecordError, Recorded, read_in_order};
use crate::sensors::{Arrival, Sensor};
use crate::state::{LiveRun, Takeover};
use crate::wire::{BootId, JournalHead, JournalPage, Topic, WireError, decode_journal_page, decode_reading};

/// One boot of a machine, as far as the recording holds it without a gap.
#[derive(Clone, Debug, PartialEq)]
pub struct BootRun {
    /// Which boot.
    pub boot: BootId,
    /// Who took the readings, if the journal tells.
    pub head: Option<JournalHead>,
    /// From the boot on; what came after a gap is not in it.
    pub run: LiveRun,
    /// What is missing, if something is: the run ends before it.
    pub gap: Option<String>,
}

/// The boots of `machine` in a recording, oldest first.
///
/// The order of the readings is that of the journal, and does not rest on times, nor on the order of the file, in
/// which messages that were fetched later come late. What the journal does not tell of, such as the last readings
/// before a power cut, is left out.
///
/// # Errors
/// [`RecordError`] if the file cannot be read or is no MCAP file.
pub fn read_live_runs(path: &Path, machine: &str) -> Result<Vec<BootRun>, RecordError> {
    read_live_runs_of([path], machine)
}

/// The same for a recording in several files.
///
/// # Errors
/// [`RecordError`] if a file cannot be read or is no MCAP file.
pub fn read_live_runs_of<'a>(
    paths: impl IntoIterator<Item = &'a Path>,
    machine: &str,
) -> Result<Vec<BootRun>, RecordError> {
    Ok(runs_of(read_in_order(paths, machine)?))
}

/// The boots in the messages of one machine, which are in the order in which it sent them.
pub(super) fn runs_of(messages: impl IntoIterator<Item = Recorded<Vec<u8>>>) -> Vec<BootRun> {
    let mut shelf = Shelf::default();
    let mut pages = Vec::new();
    for message in messages {
        match message.topic {
            Topic::Sensor(sensor) => shelf.put(sensor, message),
            Topic::Journal => pages.push(decode_journal_page(&message.payload)),
            Topic::Pose | Topic::Odom | Topic::Health | Topic::Event => {}
        }
    }
    let mut runs: Vec<BootRun> = Vec::new();
    let mut unreadable = None;
    for page in pages {
        let page = match page {
            Ok(page) => page,
            Err(error) => {
                unreadable = Some(error.to_string());
                continue;
            }
        };
        if runs.last().is_none_or(|last| last.boot != page.boot) {
            shelf.next_boot(page.boot);
            runs.push(BootRun { boot: page.boot, head: None, run: LiveRun::default(), gap: None });
        }
        let Some(last) = runs.last_mut() else { continue };
        if let Some(head) = &page.head {
            last.head = Some((**head).clone());
        }
        if last.gap.is_none()
            && let Err(gap) = append(&mut last.run, &page, &mut shelf)
        {
            last.gap = Some(match unreadable.take() {
                Some(reason) => format!("{gap} ({reason})"),
                None => gap,
            });
        }
    }
    runs
}

/// Adds a page to a run.
fn append(run: &mut LiveRun, page: &JournalPage, shelf: &mut Shelf) -> Result<(), String> {
    let end = run.arrivals.len() as u64;
    if page.first != end {
        let begun = if end == 0 { ": the beginning of the boot is not recorded" } else { "" };
        return Err(format!("the journal goes on at reading {}, not at {end}{begun}", page.first));
    }
    let takeovers = run.takeovers.len() as u64;
    if page.takeovers != takeovers {
        return Err(format!("the journal goes on at takeover {}, not at {takeovers}", page.takeovers));
    }
    for sensor in page.sensors().map_err(|error| error.to_string())? {
        run.arrivals.push(shelf.take(sensor)?);
    }
    run.unseen.extend(&page.unseen);
    let before = page.end();
    run.takeovers.extend(page.taken_over.map(|solution_of| Takeover { before, solution_of }));
    Ok(())
}

/// A reading with the number of its message.
type Numbered = (u32, Result<Arrival, WireError>);

/// The readings of each boot and sensor in their order, and which is the next one of the boot.
#[derive(Default)]
struct Shelf {
    readings: BTreeMap<(Option<BootId>, Sensor), VecDeque<Numbered>>,
    boot: Option<BootId>,
    next: BTreeMap<Sensor, u32>,
}

impl Shelf {
    fn put(&mut self, sensor: Sensor, message: Recorded<Vec<u8>>) {
        let arrival = decode_reading(sensor, &message.payload)
            .map(|reading| Arrival { arrival: message.sent, reading });
        // The lower half, as the file has it.
        let numbered = (message.sequence as u32, arrival);
        self.readings.entry((message.boot, sensor)).or_default().push_back(numbered);
    }

    /// A boot counts its messages from 0.
    fn next_boot(&mut self, boot: BootId) {
        self.next.clear();
        self.boot = Some(boot);
    }

    /// The next reading of the boot. In recordings that do not tell boots, what is left of the boot before is passed
    /// over.
    fn take(&mut self, sensor: Sensor) -> Result<Arrival, String> {
        let wanted = self.next.entry(sensor).or_default();
        let missing = || format!("message {wanted} of {sensor} is missing");
        let of_boot = (self.boot, sensor);
        let row = if self.readings.contains_key(&of_boot) { of_boot } else { (None, sensor) };
        let row = self.readings.get_mut(&row).ok_or_else(missing)?;
        while *wanted == 0 && row.front().is_some_and(|(sequence, _)| *sequence != 0) {
            row.pop_front();
        }
        let found = row.front().is_some_and(|(sequence, _)| *sequence == *wanted);
        let (sequence, arrival) = row.pop_front().filter(|_| found).ok_or_else(missing)?;
        *wanted = sequence.wrapping_add(1);
        arrival.map_err(|error| format!("message {sequence} of {sensor}: {error}"))
    }
}
