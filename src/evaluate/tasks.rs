//! The tasks of the paper as the simulator does them: digging, and navigation.

use std::path::Path;

use crate::config::{self, ConfigError, Machine};
use crate::simulate::{Action, GnssCondition, GnssConditionKind, Scenario, ScenarioFile};

/// Scenario files are part of the program, so that the tasks are the same wherever it runs.
const CONSTRUCTION: (&str, &str) =
    ("config/scenarios/construction.toml", include_str!("../../config/scenarios/construction.toml"));
const NAVIGATION: (&str, &str) =
    ("config/scenarios/navigation.toml", include_str!("../../config/scenarios/navigation.toml"));
const MACHINES: [(&str, &str); 2] = [
    ("simulated-roof.toml", include_str!("../../config/machines/simulated-roof.toml")),
    ("simulated-floor.toml", include_str!("../../config/machines/simulated-floor.toml")),
];

/// A task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Task {
    /// Digs, and shifts its stand now and then; fixes are unreliable from 105 s to 150 s.
    Digging,
    /// Drives some 500 m; trees stand in the sky from 220 s to 380 s.
    Navigation,
}

impl Task {
    /// Both.
    pub const ALL: [Task; 2] = [Task::Digging, Task::Navigation];

    /// The name in files.
    pub const fn name(self) -> &'static str {
        match self {
            Task::Digging => "digging",
            Task::Navigation => "navigation",
        }
    }

    /// The scenario as shipped.
    ///
    /// # Errors
    /// [`ConfigError`], which a test excludes.
    pub fn scenario(self) -> Result<Scenario, ConfigError> {
        let (path, text) = match self {
            Task::Digging => CONSTRUCTION,
            Task::Navigation => NAVIGATION,
        };
        let file: ScenarioFile = config::parse(text, Path::new(path))?;
        let mut machines = Vec::new();
        for machine in &file.machine {
            let name = machine.file.file_name().unwrap_or_default();
            let (_, text) = MACHINES.iter().find(|(known, _)| name == *known).unwrap_or(&MACHINES[0]);
            machines.push(config::parse::<Machine>(text, &machine.file)?);
        }
        Ok(Scenario { file, machines })
    }
}

/// No fixes at all between two times.
pub fn block(scenario: &mut Scenario, start_s: f64, end_s: f64) {
    let kind = GnssConditionKind::Blocked;
    let blocked = GnssCondition { start_s, end_s, kind, machines: Vec::new(), offset_m: None };
    scenario.file.gnss_condition = vec![blocked];
}

/// Lidar increments so many times as far off, and the machine knows it.
pub fn scale_lidar(scenario: &mut Scenario, factor: f64) {
    let sensors = scenario.file.machine.iter_mut().filter_map(|machine| machine.sensors.as_mut());
    for lidar in sensors.chain([&mut scenario.file.sensors]).map(|sensors| &mut sensors.lidar_odometry) {
        lidar.increment_sigma_m *= factor;
        lidar.increment_sigma_deg *= factor;
        lidar.increment_sigma_scale *= factor;
    }
    for machine in &mut scenario.machines {
        machine.lidar_odometry.increment_sigma_m *= factor;
        machine.lidar_odometry.increment_sigma_deg *= factor;
    }
}

/// The machines do all they do, go back where they came from, and do it once more: twice as long and a half.
pub fn lengthen(scenario: &mut Scenario) {
    let reversed = |action: &Action| match *action {
        Action::Drive { distance_m, speed_mps, turn_deg } => {
            Action::Drive { distance_m: -distance_m, speed_mps, turn_deg: -turn_deg }
        }
        Action::Level { roll_deg, pitch_deg, height_m, duration_s } => {
            Action::Level { roll_deg: -roll_deg, pitch_deg: -pitch_deg, height_m: -height_m, duration_s }
        }
        other => other,
    };
    for machine in &mut scenario.file.machine {
        let there = machine.action.clone();
        // Backwards, so that the chassis stays on its way.
        machine.action.extend(there.iter().rev().map(reversed));
        machine.action.extend(there);
    }
    scenario.file.duration_s *= 2.5;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::Simulation;

    #[test]
    fn shipped_tasks_are_those_of_the_files() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        for (task, file) in Task::ALL.into_iter().zip([CONSTRUCTION.0, NAVIGATION.0]) {
            let shipped = task.scenario().expect("valid");
            let read = Scenario::load(&root.join(file)).expect("valid");
            assert_eq!(shipped.file, read.file);
            assert_eq!(shipped.machine_ids(), read.machine_ids());
        }
    }

    #[test]
    fn lengthened_task_moves_on_and_stays_on_its_way() {
        let mut scenario = Task::Digging.scenario().expect("valid");
        lengthen(&mut scenario);
        for index in 0..2 {
            let simulation = Simulation::new(&scenario, index);
            let at = |time_s: f64| {
                simulation.truth(crate::time::Stamp::from_seconds(time_s)).base.pose.translation
            };
            let far = |from: f64, to: f64| (at(from) - at(to)).norm();
            let farthest_m = (205..400).map(|second| far(205.0, f64::from(second))).fold(0.0, f64::max);
            assert!(farthest_m > 2.0, "it moves: {farthest_m} m");
            assert!((0..500).all(|second| far(0.0, f64::from(second)) < 15.0));
        }
    }
}
