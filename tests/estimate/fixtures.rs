//! Simulated logs, made once for all tests here, and how estimates of them are judged.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use holdfast::config::{self, Machine};
use holdfast::estimator::Options;
use holdfast::import::{Interval, StampedPose, read_intervals, read_log_folder, read_tum};
use holdfast::sensors::Arrival;
use holdfast::time::Stamp;

use crate::command::{empty_folder, holdfast, repository};

/// One machine of a scenario, simulated.
#[derive(Clone, Debug)]
pub struct Log {
    pub name: String,
    pub folder: PathBuf,
    pub machine: PathBuf,
}

/// Both machines of the scenario, by the shipped command.
pub fn simulated(scenario: &'static str) -> &'static [Log] {
    static CONSTRUCTION: OnceLock<Vec<Log>> = OnceLock::new();
    static NAVIGATION: OnceLock<Vec<Log>> = OnceLock::new();
    let logs = match scenario {
        "construction" => &CONSTRUCTION,
        "navigation" => &NAVIGATION,
        other => panic!("no scenario {other}"),
    };
    logs.get_or_init(|| {
        let out = empty_folder(&format!("simulated-{scenario}"));
        let file = repository(&format!("config/scenarios/{scenario}.toml"));
        let ended = holdfast(&[
            "simulate".as_ref(),
            "--scenario".as_ref(),
            file.as_os_str(),
            "--out".as_ref(),
            out.as_os_str(),
        ]);
        assert_eq!(ended.code, 0, "{ended:?}");
        let machines = [("walker-1", "simulated-roof"), ("walker-2", "simulated-floor")];
        assert_eq!(ended.stdout.lines().count(), machines.len(), "one line a machine: {}", ended.stdout);
        machines
            .map(|(id, file)| Log {
                name: format!("{scenario} {id}"),
                folder: out.join(id),
                machine: repository(&format!("config/machines/{file}.toml")),
            })
            .into()
    })
}

impl Log {
    pub fn arrivals(&self) -> Vec<Arrival> {
        read_log_folder(&self.folder).expect("log").arrivals
    }

    pub fn options(&self) -> Options {
        config::load::<Machine>(&self.machine).expect("machine file").estimator_options()
    }

    pub fn truth(&self) -> Vec<StampedPose> {
        read_tum(&self.folder.join("truth_imu.tum")).expect("truth")
    }

    pub fn intervals(&self) -> Vec<Interval> {
        read_intervals(&self.folder.join("gnss_truth.csv")).expect("intervals")
    }

    /// A copy with the rows of `from_s` to before `to_s` only (by stamp), without the truth.
    pub fn cut(&self, to: &Path, from_s: f64, to_s: f64) {
        for sensor in holdfast::sensors::Sensor::ALL {
            let name = format!("{}.csv", sensor.name());
            let text = fs::read_to_string(self.folder.join(&name)).expect("log file");
            let (header, rows) = text.split_once('\n').expect("header");
            let kept: Vec<&str> = rows
                .lines()
                .filter(|row| {
                    let stamp: f64 = row.split(',').nth(1).expect("stamp").parse().expect("number");
                    from_s <= stamp && stamp < to_s
                })
                .collect();
            fs::write(to.join(&name), format!("{header}\n{}\n", kept.join("\n"))).expect("write");
        }
    }
}

/// A machine file without the right antenna.
pub fn without_right_antenna(machine: &Path, to: &Path) {
    let text = fs::read_to_string(machine).expect("machine file");
    let kept: Vec<&str> = text.lines().filter(|line| !line.starts_with("cabin_from_gnss_right")).collect();
    assert!(kept.len() < text.lines().count(), "{} has a right antenna", machine.display());
    fs::write(to, kept.join("\n")).expect("write");
}

/// The true pose at exactly this stamp.
pub fn true_pose(truth: &[StampedPose], stamp: Stamp) -> Option<&StampedPose> {
    truth.binary_search_by_key(&stamp, |pose| pose.stamp).ok().map(|index| &truth[index])
}
