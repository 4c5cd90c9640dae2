//! The scenario file: which machines do what, how good their sensors are, where GNSS lets go.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::motion::Motion;
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

/// How good the sensors are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Sensors {
    /// Cabin IMU; its rate is in the machine file.
    pub imu: Imu,
    /// Chassis IMU.
    pub base_imu: Imu,
    /// Both antennas.
    pub gnss: Gnss,
    /// Lidar odometry.
    pub lidar_odometry: LidarOdometry,
    /// Cabin-turn encoder.
    pub cabin_turn: CabinTurn,
}

/// When a sensor's readings are taken and when they arrive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Timing {
    pub rate_hz: f64,
    pub latency_s: f64,
    pub latency_jitter_s: f64,
    pub stamp_jitter_s: f64,
}

/// An IMU.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Imu {
    /// Hz; the cabin IMU's is `imu.update_rate` of its machine file.
    pub rate_hz: f64,
    /// White noise, rad/s/√Hz.
    pub gyroscope_noise_density: f64,
    /// White noise, m/s²/√Hz.
    pub accelerometer_noise_density: f64,
    /// Random walk of the bias, rad/s²/√Hz.
    pub gyroscope_random_walk: f64,
    /// Random walk of the bias, m/s³/√Hz.
    pub accelerometer_random_walk: f64,
    /// Bias at the start: half to all of it on each axis, either sign, rad/s.
    pub gyroscope_bias: f64,
    /// Bias at the start: half to all of it on each axis, either sign, m/s².
    pub accelerometer_bias: f64,
    /// The engine's vibration, least and greatest amplitude, m/s².
    pub vibration_mps2: [f64; 2],
    /// The engine's vibration, least and greatest frequency, Hz.
    pub vibration_hz: [f64; 2],
    /// The engine's vibration on the gyroscope, amplitude, rad/s.
    pub vibration_radps: f64,
    /// From stamp to arrival, s.
    pub latency_s: f64,
    /// One sigma, s.
    pub latency_jitter_s: f64,
    /// Stamps are off their even spacing by up to so much, s.
    pub stamp_jitter_s: f64,
}

/// The GNSS receiver while it is good.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Gnss {
    /// Hz.
    pub rate_hz: f64,
    /// One sigma of each fix east, north, up, m; also what the receiver reports.
    pub sigma_enu_m: [f64; 3],
    /// From stamp to arrival, s.
    pub latency_s: f64,
    /// One sigma, s.
    pub latency_jitter_s: f64,
    /// Stamps are off their even spacing by up to so much, s.
    pub stamp_jitter_s: f64,
}

/// The lidar odometry.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LidarOdometry {
    /// Hz.
    pub rate_hz: f64,
    /// One sigma of each increment, per axis, m.
    pub increment_sigma_m: f64,
    /// One sigma of each increment, per axis, degrees.
    pub increment_sigma_deg: f64,
    /// One sigma of each increment's scale.
    pub increment_sigma_scale: f64,
    /// From stamp to arrival, s.
    pub latency_s: f64,
    /// One sigma, s.
    pub latency_jitter_s: f64,
    /// Stamps are off their even spacing by up to so much, s.
    pub stamp_jitter_s: f64,
}

/// The encoder between chassis and cabin.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CabinTurn {
    /// Hz.
    pub rate_hz: f64,
    /// Steps of one turn; 0 is exact.
    pub steps: u32,
    /// From stamp to arrival, s.
    pub latency_s: f64,
    /// One sigma, s.
    pub latency_jitter_s: f64,
    /// Stamps are off their even spacing by up to so much, s.
    pub stamp_jitter_s: f64,
}

impl Default for Imu {
    fn default() -> Self {
        Self {
            rate_hz: 100.0,
            gyroscope_noise_density: 1.6e-4,
            accelerometer_noise_density: 1.1e-3,
            gyroscope_random_walk: 8.0e-6,
            accelerometer_random_walk: 6.0e-5,
            gyroscope_bias: 3.0e-3,
            accelerometer_bias: 0.05,
            vibration_mps2: [0.3, 0.5],
            vibration_hz: [21.0, 29.0],
            vibration_radps: 3.0e-4,
            latency_s: 0.002,
            latency_jitter_s: 0.0004,
            stamp_jitter_s: 2.0e-5,
        }
    }
}

impl Default for Gnss {
    fn default() -> Self {
        Self {
            rate_hz: 20.0,
            sigma_enu_m: [0.008, 0.008, 0.014],
            latency_s: 0.06,
            latency_jitter_s: 0.008,
            stamp_jitter_s: 2.0e-6,
        }
    }
}

impl Default for LidarOdometry {
    fn default() -> Self {
        Self {
            rate_hz: 5.0,
            increment_sigma_m: 0.006,
            increment_sigma_deg: 0.05,
            increment_sigma_scale: 0.0015,
            latency_s: 0.11,
            latency_jitter_s: 0.015,
            stamp_jitter_s: 2.0e-4,
        }
    }
}

impl Default for CabinTurn {
    fn default() -> Self {
        Self {
            rate_hz: 100.0,
            steps: 8192,
            latency_s: 0.004,
            latency_jitter_s: 0.0008,
            stamp_jitter_s: 2.0e-5,
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
        }
        Ok(())
    }
}

impl Machine {
    fn check(&self, repeat: bool) -> Result<(), Violation> {
        let close = |pair: &[[f64; 2]]| (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1]) < 0.1;
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

impl Sensors {
    fn check(&self) -> Result<(), Violation> {
        for (table, timing) in [
            ("sensors.imu", self.imu.timing()),
            ("sensors.base_imu", self.base_imu.timing()),
            ("sensors.gnss", self.gnss.timing()),
            ("sensors.lidar_odometry", self.lidar_odometry.timing()),
            ("sensors.cabin_turn", self.cabin_turn.timing()),
        ] {
            let key = |name: &str| format!("{table}.{name}");
            config::within(&key("rate_hz"), timing.rate_hz, 0.1, 2000.0)?;
            config::within(&key("latency_s"), timing.latency_s, 0.0, 60.0)?;
            config::within(&key("latency_jitter_s"), timing.latency_jitter_s, 0.0, 60.0)?;
            config::within(&key("stamp_jitter_s"), timing.stamp_jitter_s, 0.0, 0.4 / timing.rate_hz)?;
        }
        for (table, imu) in [("sensors.imu", &self.imu), ("sensors.base_imu", &self.base_imu)] {
            for (name, value) in [
                ("gyroscope_noise_density", imu.gyroscope_noise_density),
                ("accelerometer_noise_density", imu.accelerometer_noise_density),
                ("gyroscope_random_walk", imu.gyroscope_random_walk),
                ("accelerometer_random_walk", imu.accelerometer_random_walk),
                ("gyroscope_bias", imu.gyroscope_bias),
                ("accelerometer_bias", imu.accelerometer_bias),
                ("vibration_mps2", imu.vibration_mps2[0].min(imu.vibration_mps2[1])),
                ("vibration_hz", imu.vibration_hz[0].min(imu.vibration_hz[1])),
                ("vibration_radps", imu.vibration_radps),
            ] {
                config::within(&format!("{table}.{name}"), value, 0.0, 1.0e3)?;
            }
        }
        for sigma in self.gnss.sigma_enu_m {
            config::within("sensors.gnss.sigma_enu_m", sigma, 0.0, 100.0)?;
        }
        let lidar = &self.lidar_odometry;
        config::within("sensors.lidar_odometry.increment_sigma_m", lidar.increment_sigma_m, 0.0, 10.0)?;
        config::within("sensors.lidar_odometry.increment_sigma_deg", lidar.increment_sigma_deg, 0.0, 90.0)?;
        config::within("sensors.lidar_odometry.increment_sigma_scale", lidar.increment_sigma_scale, 0.0, 1.0)
    }
}

macro_rules! timed {
    ($($sensor:ty),*) => {
        $(impl $sensor {
            pub(super) fn timing(&self) -> Timing {
                Timing {
                    rate_hz: self.rate_hz,
                    latency_s: self.latency_s,
                    latency_jitter_s: self.latency_jitter_s,
                    stamp_jitter_s: self.stamp_jitter_s,
                }
            }
        })*
    };
}

timed!(Imu, Gnss, LidarOdometry, CabinTurn);
