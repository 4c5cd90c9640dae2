//! The scenario file: which machines do what, how good their sensors are, where GNSS lets go.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::motion::Motion;
use super::specification::Sensors;
use crate::config::{self, Checked, ConfigError, Violation};

/// A scenario and the machine files that it names.
#[derive(Clone, Debug)]
pub struct Scenario {
    /// The scenario file.
    pub file: ScenarioFile,
    /// One for each `[[machine]]`, in that order.
    pub machines: Vec<config::Machine>,
}

/// What a scenario file says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScenarioFile {
    /// All randomness comes from it.
    pub seed: u64,
    /// Length of the log, s.
    pub duration_s: f64,
    /// Whether actions and GNSS conditions begin again when they are over, each machine by itself. The
    /// actions must then end where they began.
    #[serde(default)]
    pub repeat: bool,
    /// How good the sensors are.
    #[serde(default)]
    pub sensors: Sensors,
    /// The machines.
    pub machine: Vec<Machine>,
    /// When GNSS is not good.
    #[serde(default)]
    pub gnss_condition: Vec<GnssCondition>,
}

/// One machine of a scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Machine {
    /// Machine file, relative to the scenario file.
    pub file: PathBuf,
    /// East and north (m) of points that the chassis' way is drawn towards; it starts at the first.
    pub path_m: Vec<[f64; 2]>,
    /// About the steepest slope of the ground along and across the way, degrees.
    #[serde(default = "default_ground_slope_deg")]
    pub ground_slope_deg: f64,
    /// One after the other.
    pub action: Vec<Action>,
    /// Instead of the scenario's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensors: Option<Sensors>,
}

/// What a machine does.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Action {
    /// Nothing.
    Stand {
        /// s.
        duration_s: f64,
    },
    /// Turns the cabin.
    Turn {
        /// Counter-clockwise.
        by_deg: f64,
        /// s.
        duration_s: f64,
    },
    /// Digs: the chassis stands, the cabin swings out and back once a cycle.
    Dig {
        /// How often.
        cycles: u32,
        /// Length of one, s.
        cycle_s: f64,
        /// Angle of the swing; each cycle's is off by up to 15 %.
        swing_deg: f64,
    },
    /// Drives along the way.
    Drive {
        /// Negative goes back.
        distance_m: f64,
        /// About the speed between the ramps.
        speed_mps: f64,
        /// Turns the cabin by so much while driving.
        #[serde(default)]
        turn_deg: f64,
    },
    /// Moves the legs: tilts and lifts the chassis.
    Level {
        /// Left side up.
        #[serde(default)]
        roll_deg: f64,
        /// Nose down.
        #[serde(default)]
        pitch_deg: f64,
        /// Up.
        #[serde(default)]
        height_m: f64,
        /// s.
        duration_s: f64,
    },
}

/// A time in which GNSS is not good.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GnssCondition {
    /// From the start of the log, or of each repetition.
    pub start_s: f64,
    /// The first time that is good again.
    pub end_s: f64,
    /// What is wrong.
    pub kind: GnssConditionKind,
    /// Ids of the machines that it befalls; all if it is empty.
    #[serde(default)]
    pub machines: Vec<String>,
    /// How far off confident and wrong fixes are, least and most, m; 0.3 to 2 m if it is missing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub offset_m: Option<[f64; 2]>,
}

/// What can be wrong with GNSS.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GnssConditionKind {
    /// The fix wanders by 0.3 to 1 m and says so; epochs are missing; for 15 % of the time it is
    /// confident and wrong.
    Unreliable,
    /// No fixes.
    Blocked,
    /// Now fixed, now float with 0.1 to 0.6 m; epochs are missing.
    Trees,
    /// Confident and wrong: reports 2 cm, is 0.3 to 2 m off.
    Multipath,
}

impl GnssConditionKind {
    /// The name in files.
    pub const fn name(self) -> &'static str {
        match self {
            GnssConditionKind::Unreliable => "unreliable",
            GnssConditionKind::Blocked => "blocked",
            GnssConditionKind::Trees => "trees",
            GnssConditionKind::Multipath => "multipath",
        }
    }
}

const fn default_ground_slope_deg() -> f64 {
    2.5
}

impl Scenario {
    /// Reads a scenario file and the machine files that it names.
    ///
    /// # Errors
    /// [`ConfigError`] with file, line and column.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let file: ScenarioFile = config::load(path)?;
        let directory = path.parent().unwrap_or(Path::new(""));
        let mut machines: Vec<config::Machine> = Vec::new();
        for machine in &file.machine {
            machines.push(config::load(&directory.join(&machine.file))?);
        }
        let scenario = Self { file, machines };
        // What only shows with all files read: told with the scenario file's name, at its start.
        scenario.check_machines().map_err(|violation| ConfigError::Invalid {
            path: path.to_owned(),
            line: 1,
            column: 1,
            message: violation.to_string(),
        })?;
        Ok(scenario)
    }

    /// Ids of the machines, in the order of the file.
    pub fn machine_ids(&self) -> Vec<&str> {
        self.machines.iter().map(|machine| machine.id.as_str()).collect()
    }

    fn check_machines(&self) -> Result<(), Violation> {
        for (index, machine) in self.machines.iter().enumerate() {
            if self.machines[..index].iter().any(|other| other.id == machine.id) {
                return config::violation("machine.file", format!("gives \"{}\" twice", machine.id));
            }
            if machine.world != self.machines[0].world {
                let message =
                    format!("gives \"{}\" another [world] than \"{}\"", machine.id, self.machines[0].id);
                return config::violation("machine.file", message);
            }
        }
        for condition in &self.file.gnss_condition {
            if let Some(id) = condition.machines.iter().find(|id| !self.machine_ids().contains(&id.as_str()))
            {
                return config::violation(
                    "gnss_condition.machines",
                    format!("names \"{id}\", no machine here"),
                );
            }
        }
        Ok(())
    }
}

impl Checked for ScenarioFile {
    fn check(&self) -> Result<(), Violation> {
        config::within("duration_s", self.duration_s, 1.0, 1.0e6)?;
        if self.machine.is_empty() {
            return config::violation("machine", "is missing, must be one at least".to_owned());
        }
        self.sensors.check()?;
        for machine in &self.machine {
            machine.check(self.repeat)?;
        }
        for condition in &self.gnss_condition {
            config::within("gnss_condition.start_s", condition.start_s, 0.0, 1.0e6)?;
            config::within("gnss_condition.end_s", condition.end_s, condition.start_s, 1.0e6)?;
            if let Some([least, most]) = condition.offset_m {
                config::within("gnss_condition.offset_m", least, 0.0, 1.0e3)?;
                config::within("gnss_condition.offset_m", most, least, 1.0e3)?;
            }
        }
        Ok(())
    }
}

impl Machine {
    fn check(&self, repeat: bool) -> Result<(), Violation> {
        let close = |pair: &[[f64; 2]]| libm::hypot(pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]) < 0.1;
        if self.path_m.len() < 2 || self.path_m.windows(2).any(close) {
            return config::violation(
                "machine.path_m",
                "must have two points at least, and neighbours at least 0.1 m apart".to_owned(),
            );
        }
        for value in self.path_m.iter().flatten() {
            config::within("machine.path_m", *value, -1.0e5, 1.0e5)?;
        }
        config::within("machine.ground_slope_deg", self.ground_slope_deg, 0.0, 20.0)?;
        for action in &self.action {
            action.check()?;
        }
        if let Some(sensors) = &self.sensors {
            sensors.check()?;
        }
        let (low, high, whole) = Motion::reach_m(self);
        if low < -1e-9 || high > whole {
            return config::violation(
                "machine.action",
                format!("drives from {low} m to {high} m on a way of {whole:.1} m"),
            );
        }
        if !repeat {
            return Ok(());
        }
        let motion = Motion::new(self, crate::lie::Se3::identity(), true, 0, "");
        if motion.period_s() < 1.0 {
            return config::violation("machine.action", "must last 1 s at least to repeat".to_owned());
        }
        for (what, left) in motion.left_over() {
            if left.abs() > 1e-9 {
                return config::violation(
                    "machine.action",
                    format!("must end where it began to repeat, but {what} add up to {left}"),
                );
            }
        }
        Ok(())
    }
}

impl Action {
    fn check(&self) -> Result<(), Violation> {
        let key = "machine.action";
        let duration = |duration_s: f64| config::within(key, duration_s, 0.1, 1.0e6);
        match *self {
            Action::Stand { duration_s } => duration(duration_s),
            Action::Turn { by_deg, duration_s } => {
                config::within(key, by_deg, -7200.0, 7200.0)?;
                duration(duration_s)
            }
            Action::Dig { cycles, cycle_s, swing_deg } => {
                config::within(key, f64::from(cycles), 1.0, 1.0e4)?;
                config::within(key, swing_deg, -360.0, 360.0)?;
                duration(cycle_s)
            }
            Action::Drive { distance_m, speed_mps, turn_deg } => {
                config::within(key, distance_m.abs(), 0.01, 1.0e5)?;
                config::within(key, speed_mps, 0.01, 20.0)?;
                config::within(key, turn_deg, -7200.0, 7200.0)
            }
            Action::Level { roll_deg, pitch_deg, height_m, duration_s } => {
                config::within(key, roll_deg, -30.0, 30.0)?;
                config::within(key, pitch_deg, -30.0, 30.0)?;
                config::within(key, height_m, -5.0, 5.0)?;
                duration(duration_s)
            }
        }
    }
}
