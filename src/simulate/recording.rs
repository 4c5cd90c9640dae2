//! A whole scenario as one recording: the readings of all machines, as a site would have recorded them.

use std::collections::BTreeMap;
use std::path::Path;

use super::{Progress, Scenario, Simulation};
use crate::record::{RecordError, RecordWriter, Recorded, Summary};
use crate::sensors::{Arrival, Sensor};
use crate::time::Stamp;
use crate::wire::{Topic, encode_reading};

/// Writes an MCAP recording with the readings of all machines of the scenario, each when it arrived; stamps
/// count from 1970. They are those of the log folders of [`super::write`], bit for bit. `progress` is called
/// about once for each second of data.
///
/// # Errors
/// [`RecordError`] if the file cannot be written.
pub fn write_recording(
    scenario: &Scenario,
    path: &Path,
    mut progress: impl FnMut(Progress<'_>),
) -> Result<Summary, RecordError> {
    let duration_s = scenario.file.duration_s;
    let end = Stamp::from_seconds(duration_s);
    let mut writer = RecordWriter::create(path)?;
    let about = [("seed", scenario.file.seed.to_string()), ("duration_s", duration_s.to_string())];
    let about: BTreeMap<_, _> = about.map(|(key, value)| (key.to_owned(), value)).into();
    writer.write_metadata("holdfast.simulation", about)?;
    let mut machines: Vec<Simulated> =
        (0..scenario.machines.len()).map(|index| Simulated::new(scenario, index, end)).collect();
    let mut reported_s = 0.0;
    // The first machine first among equals.
    while let Some(machine) =
        machines.iter_mut().filter(|machine| machine.next.is_some()).min_by_key(|machine| machine.next_at())
    {
        let Some(Arrival { arrival, reading }) = machine.next.take() else { break };
        machine.next = machine.simulation.next();
        let sensor = reading.sensor();
        let sequence = &mut machine.sequences[sensor as usize];
        writer.write(&Recorded {
            machine: machine.id.clone(),
            topic: Topic::Sensor(sensor),
            boot: None,
            sequence: *sequence,
            received: arrival,
            sent: arrival,
            payload: encode_reading(&reading),
        })?;
        *sequence += 1;
        if arrival.as_seconds() >= reported_s + 1.0 {
            reported_s = arrival.as_seconds();
            progress(Progress { machine: &machine.id, fraction: reported_s / duration_s });
        }
    }
    writer.finish()
}

/// One machine and its next reading.
struct Simulated {
    id: String,
    simulation: Simulation,
    next: Option<Arrival>,
    sequences: [u64; Sensor::ALL.len()],
}

impl Simulated {
    fn new(scenario: &Scenario, index: usize, end: Stamp) -> Self {
        let mut simulation = Simulation::new(scenario, index).ending_at(end);
        let next = simulation.next();
        Self { id: scenario.machines[index].id.clone(), simulation, next, sequences: Default::default() }
    }

    fn next_at(&self) -> Option<Stamp> {
        self.next.map(|arrival| arrival.arrival)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::read_log_folder;
    use crate::record::read_arrivals;
    use crate::simulate::write;

    #[test]
    fn recording_holds_the_readings_of_the_log_folders_bit_for_bit() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let mut scenario = Scenario::load(&root.join("config/scenarios/construction.toml")).expect("valid");
        scenario.file.duration_s = 12.0;
        let folder = std::env::temp_dir().join(format!("holdfast-simulated-{}", std::process::id()));
        write(&scenario, &folder, |_| ()).expect("log folders");
        let path = folder.join("both.mcap");
        let summary = write_recording(&scenario, &path, |_| ()).expect("recording");
        let mut readings = 0;
        for id in scenario.machine_ids() {
            let logged = read_log_folder(&folder.join(id)).expect("log folder").arrivals;
            let recorded: Vec<Arrival> = read_arrivals([path.as_path()], id, |_| ())
                .expect("recording")
                .collect::<Result<_, _>>()
                .expect("readings");
            assert_eq!(recorded, logged, "{id}");
            readings += logged.len() as u64;
        }
        assert!(readings > 2_000, "{readings}");
        assert_eq!(summary.messages, readings);
        std::fs::remove_dir_all(&folder).expect("removed");
    }
}
