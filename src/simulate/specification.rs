//! How good the simulated sensors are: part of the scenario file.

use serde::{Deserialize, Serialize};

use crate::config::{self, Violation};

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
    /// One sigma of what is new in each fix east, north, up, m.
    pub sigma_enu_m: [f64; 3],
    /// One sigma of an error that changes slowly (a first-order Gauss-Markov process), each antenna by itself, m.
    pub slow_sigma_enu_m: [f64; 3],
    /// For so long it remembers, s.
    pub slow_time_s: f64,
    /// What the receiver reports, as a part of both together; below one it is surer than it should be.
    pub reported_sigma_scale: f64,
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
            slow_sigma_enu_m: [0.0; 3],
            slow_time_s: 30.0,
            reported_sigma_scale: 1.0,
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

/// When a sensor's readings are taken and when they arrive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Timing {
    pub rate_hz: f64,
    pub latency_s: f64,
    pub latency_jitter_s: f64,
    pub stamp_jitter_s: f64,
}

impl Sensors {
    /// Values in range.
    pub(super) fn check(&self) -> Result<(), Violation> {
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
        for sigma in self.gnss.slow_sigma_enu_m {
            config::within("sensors.gnss.slow_sigma_enu_m", sigma, 0.0, 100.0)?;
        }
        config::within("sensors.gnss.slow_time_s", self.gnss.slow_time_s, 0.01, 1.0e6)?;
        let scale = self.gnss.reported_sigma_scale;
        config::within("sensors.gnss.reported_sigma_scale", scale, 0.01, 100.0)?;
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
