//! The machine file: who the machine is, where its sensors sit, how good they are.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::endpoint::{endpoints, listening, secret};
use super::tls::Tls;
use super::{Checked, Topics, Violation, identifier, positive, violation, within};
use crate::estimator::{self, GateOptions, InOutage};
use crate::frames::geodesy::{Geodetic, SiteFrame};
use crate::frames::{self, Cabin, Pose};
use crate::lie::{Se3, So3, Vec3};
use crate::preintegration::ImuNoise;
use crate::smoother;
use crate::time::Span;

/// IMU samples further apart than so many periods are a gap.
const GAP_PERIODS: f64 = 2.5;

/// One excavator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Machine {
    /// Letters, digits and '-'; unique on the site.
    pub id: String,
    /// For people; the id if it is empty.
    #[serde(default)]
    pub name: String,
    /// Origin of the site frame.
    pub world: World,
    /// Where the sensors sit.
    pub frames: Frames,
    /// Cabin IMU.
    #[serde(default)]
    pub imu: Imu,
    /// Chassis IMU.
    #[serde(default)]
    pub base_imu: BaseImu,
    /// Lidar odometry.
    #[serde(default)]
    pub lidar_odometry: LidarOdometry,
    /// GNSS receiver.
    #[serde(default)]
    pub gnss: Gnss,
    /// What is believed.
    #[serde(default)]
    pub gate: Gate,
    /// Fixed-lag smoother.
    #[serde(default)]
    pub smoother: Smoother,
    /// How the estimate starts.
    #[serde(default)]
    pub initialization: Initialization,
    /// What goes out.
    #[serde(default)]
    pub publish: Publish,
    /// How the machine reaches the site.
    #[serde(default)]
    pub link: Link,
    /// What the machine keeps itself.
    #[serde(default)]
    pub record: OnBoard,
    /// Where its readings are in a ROS 2 bag.
    #[serde(default)]
    pub topics: Topics,
}

/// Origin of the site frame, WGS84; the same for all machines of a site.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// Degrees, north positive.
    pub latitude_deg: f64,
    /// Degrees, east positive.
    pub longitude_deg: f64,
    /// Above the ellipsoid, m.
    pub altitude_m: f64,
}

/// A rigid motion, `parent_from_child`; what is not said is zero.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Transform {
    /// Origin of the child in the parent, m.
    pub translation_m: [f64; 3],
    /// Intrinsic Z-Y-X angles, degrees: yaw, pitch, roll.
    pub yaw_pitch_roll_deg: [f64; 3],
}

/// Where the sensors sit, each as `parent_from_child`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Frames {
    /// At cabin-turn angle zero.
    #[serde(default)]
    pub base_from_cabin: Transform,
    /// Cabin IMU on the cabin.
    pub cabin_from_imu: Transform,
    /// Lidar on the cabin.
    #[serde(default)]
    pub cabin_from_lidar: Transform,
    /// Phase centre of the left antenna; only the translation matters.
    #[serde(default)]
    pub cabin_from_gnss_left: Transform,
    /// Phase centre of the right antenna; without it there is no heading from antennas.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cabin_from_gnss_right: Option<Transform>,
    /// Chassis IMU on the chassis.
    #[serde(default)]
    pub base_from_base_imu: Transform,
}

/// Noise of the cabin IMU, by Kalibr's names: continuous-time densities of white noise and random walk.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Imu {
    /// Hz.
    pub update_rate: f64,
    /// m/s²/√Hz.
    pub accelerometer_noise_density: f64,
    /// m/s³/√Hz.
    pub accelerometer_random_walk: f64,
    /// rad/s/√Hz.
    pub gyroscope_noise_density: f64,
    /// rad/s²/√Hz.
    pub gyroscope_random_walk: f64,
    /// Where vibration is faster than the samples: how far the mean over a sampling period may be off, as a part of how
    /// much the reading changes from one sample to the next.
    pub gyroscope_missed_part: f64,
    /// The same for the accelerometer.
    pub accelerometer_missed_part: f64,
}

/// Noise of the chassis IMU.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BaseImu {
    /// rad/s/√Hz.
    pub gyroscope_noise_density: f64,
    /// rad/s²/√Hz.
    pub gyroscope_random_walk: f64,
}

/// Noise of one increment between consecutive lidar poses.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LidarOdometry {
    /// Per axis, m.
    pub increment_sigma_m: f64,
    /// Per axis, degrees.
    pub increment_sigma_deg: f64,
    /// What poses are to the graph that holds through an outage.
    pub in_outage: LidarInOutage,
}

/// What lidar poses are to the graph that holds through an outage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LidarInOutage {
    /// Each relative to the one before: right for odometry whose error walks.
    #[default]
    Relative,
    /// Global, in a map that was fixed to the world at the loss (Nubert et al. 2022).
    PseudoGlobal,
}

/// What is known of the GNSS receiver.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Gnss {
    /// Reported sigmas below it are raised to it, m.
    pub sigma_floor_m: f64,
    /// Reported sigmas above it are refused, m.
    pub sigma_max_m: f64,
    /// What every fix of this receiver is off by for a while without reporting it, one sigma, m: orbit and troposphere
    /// over a long baseline, multipath at a place. Innovations cannot show it.
    pub slow_sigma_m: f64,
    /// How long it stays alike, s.
    pub slow_time_s: f64,
}

/// What is believed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Gate {
    /// Fixes that imply a higher speed are refused, m/s.
    pub speed_max_mps: f64,
    /// So many good fixes in a row end an outage.
    pub fixes_to_return: u32,
}

/// Fixed-lag smoother.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Smoother {
    /// Length of the window, s; later readings are refused.
    pub lag_s: f64,
}

/// How the estimate starts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Initialization {
    /// So long a standstill gives attitude and gyro bias, s.
    pub static_window_s: f64,
    /// The estimate starts once the heading is known to this, degrees (one sigma).
    pub heading_sigma_deg: f64,
    /// Prior of the accelerometer bias, one sigma, m/s².
    pub accel_bias_sigma: f64,
    /// Prior of the gyro bias, one sigma, rad/s; used if the machine never stands still.
    pub gyro_bias_sigma: f64,
}

/// What the machine publishes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Publish {
    /// `pose` and `odom`, Hz; the IMU's rate at most.
    pub pose_rate_hz: f64,
    /// Also publish the readings under `sensor/`, so that the site records them.
    pub sensors: bool,
}

/// How the machine reaches the site.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Link {
    /// The site's id: first part of every key after `holdfast/`.
    pub site: String,
    /// Zenoh endpoints to dial, such as `tcp/127.0.0.1:7447`.
    pub connect: Vec<String>,
    /// Zenoh endpoints on which drivers may publish readings, such as `tcp/127.0.0.1:7448`.
    pub listen: Vec<String>,
    /// `listen` may be reached from other computers, and whoever does is believed.
    pub unauthenticated: bool,
    /// A link with no byte for so long is dead, ms.
    pub lease_ms: u64,
    /// Certificates: all of `connect` is TLS, and both ends know each other.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls: Option<Tls>,
}

/// The machine's own record, from which the site fetches what it missed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OnBoard {
    /// The record is in a folder in it that has the machine's id for its name.
    pub directory: PathBuf,
    /// Of all files together, MB (10⁶ bytes); the oldest are deleted.
    pub size_max_mb: u64,
    /// Without it what does not reach the site is lost.
    pub enabled: bool,
}

impl Default for Imu {
    fn default() -> Self {
        Self {
            update_rate: 100.0,
            accelerometer_noise_density: 1.1e-3,
            accelerometer_random_walk: 6.0e-5,
            gyroscope_noise_density: 1.6e-4,
            gyroscope_random_walk: 8.0e-6,
            gyroscope_missed_part: 0.0,
            accelerometer_missed_part: 0.0,
        }
    }
}

impl Default for BaseImu {
    fn default() -> Self {
        Self { gyroscope_noise_density: 1.6e-4, gyroscope_random_walk: 8.0e-6 }
    }
}

impl Default for LidarOdometry {
    fn default() -> Self {
        Self { increment_sigma_m: 0.006, increment_sigma_deg: 0.05, in_outage: LidarInOutage::Relative }
    }
}

impl Default for Gnss {
    fn default() -> Self {
        Self { sigma_floor_m: 0.005, sigma_max_m: 0.2, slow_sigma_m: 0.0, slow_time_s: 10.0 }
    }
}

impl Default for Gate {
    fn default() -> Self {
        Self { speed_max_mps: 5.0, fixes_to_return: 10 }
    }
}

impl Default for Smoother {
    fn default() -> Self {
        Self { lag_s: 3.0 }
    }
}

impl Default for Initialization {
    fn default() -> Self {
        Self { static_window_s: 2.0, heading_sigma_deg: 1.5, accel_bias_sigma: 0.1, gyro_bias_sigma: 5.0e-3 }
    }
}

impl Default for Publish {
    fn default() -> Self {
        Self { pose_rate_hz: 100.0, sensors: true }
    }
}

impl Default for Link {
    fn default() -> Self {
        Self {
            site: "site".to_owned(),
            connect: vec!["tcp/127.0.0.1:7447".to_owned()],
            listen: Vec::new(),
            unauthenticated: false,
            lease_ms: 2_000,
            tls: None,
        }
    }
}

impl Default for OnBoard {
    fn default() -> Self {
        Self { directory: PathBuf::from("holdfast-data/on-board"), size_max_mb: 4_000, enabled: true }
    }
}

impl Transform {
    /// The motion, with the frames that the caller promises.
    pub fn pose<A, B>(&self) -> Pose<A, B> {
        let [yaw, pitch, roll] = self.yaw_pitch_roll_deg.map(f64::to_radians);
        let translation = Vec3::from_row_slice(&self.translation_m);
        Pose::assume(Se3::new(So3::from_yaw_pitch_roll(yaw, pitch, roll), translation))
    }

    fn check(&self, key: &str) -> Result<(), Violation> {
        for value in self.translation_m {
            within(key, value, -100.0, 100.0)?;
        }
        for value in self.yaw_pitch_roll_deg {
            within(key, value, -360.0, 360.0)?;
        }
        Ok(())
    }
}

impl World {
    /// The site frame at this origin.
    pub fn site_frame(&self) -> SiteFrame {
        SiteFrame::new(Geodetic {
            latitude_deg: self.latitude_deg,
            longitude_deg: self.longitude_deg,
            altitude_m: self.altitude_m,
        })
    }

    /// The origin in range; `key` is the table's name.
    ///
    /// # Errors
    /// The first value out of range.
    pub fn check(&self, key: &str) -> Result<(), Violation> {
        within(&format!("{key}.latitude_deg"), self.latitude_deg, -90.0, 90.0)?;
        within(&format!("{key}.longitude_deg"), self.longitude_deg, -180.0, 180.0)?;
        within(&format!("{key}.altitude_m"), self.altitude_m, -1000.0, 10_000.0)
    }
}

impl Machine {
    /// What people call it.
    pub fn display_name(&self) -> &str {
        if self.name.is_empty() { &self.id } else { &self.name }
    }

    /// The machine file that says all this, defaults too.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).unwrap_or_else(|error| format!("# has no TOML form: {error}"))
    }
}

impl Machine {
    /// What the estimator must know of this machine.
    pub fn estimator_options(&self) -> estimator::Options {
        let mounted = &self.frames;
        let cabin_from_imu: Pose<Cabin, frames::Imu> = mounted.cabin_from_imu.pose();
        let imu_from_cabin = cabin_from_imu.inverse();
        let in_imu = |transform: &Transform| imu_from_cabin * Vec3::from_row_slice(&transform.translation_m);
        let site = self.world.site_frame();
        let noise = ImuNoise {
            gyroscope_noise_density: self.imu.gyroscope_noise_density,
            accelerometer_noise_density: self.imu.accelerometer_noise_density,
            gyroscope_random_walk: self.imu.gyroscope_random_walk,
            accelerometer_random_walk: self.imu.accelerometer_random_walk,
            base_gyroscope_random_walk: self.base_imu.gyroscope_random_walk,
            missed_part: [self.imu.gyroscope_missed_part, self.imu.accelerometer_missed_part],
            gap_s: GAP_PERIODS / self.imu.update_rate,
        };
        let lag = Span::from_seconds(self.smoother.lag_s);
        estimator::Options {
            smoother: smoother::Options::new(lag, site.gravity(), noise),
            site,
            imu_from_lidar: imu_from_cabin * mounted.cabin_from_lidar.pose(),
            imu_from_cabin,
            base_from_cabin: mounted.base_from_cabin.pose(),
            base_from_base_imu: mounted.base_from_base_imu.pose(),
            base_gyroscope_noise_density: self.base_imu.gyroscope_noise_density,
            antenna_left: in_imu(&mounted.cabin_from_gnss_left),
            antenna_right: mounted.cabin_from_gnss_right.as_ref().map(in_imu),
            lidar_sigma: [
                self.lidar_odometry.increment_sigma_deg.to_radians(),
                self.lidar_odometry.increment_sigma_m,
            ],
            lidar_in_outage: match self.lidar_odometry.in_outage {
                LidarInOutage::Relative => InOutage::Relative,
                LidarInOutage::PseudoGlobal => InOutage::PseudoGlobal,
            },
            gate: GateOptions {
                sigma_floor_m: self.gnss.sigma_floor_m,
                sigma_max_m: self.gnss.sigma_max_m,
                slow_sigma_m: self.gnss.slow_sigma_m,
                slow_time_s: self.gnss.slow_time_s,
                speed_max: self.gate.speed_max_mps,
                fixes_to_return: self.gate.fixes_to_return,
            },
            initialization: estimator::Initialization {
                static_window: Span::from_seconds(self.initialization.static_window_s),
                heading_sigma: self.initialization.heading_sigma_deg.to_radians(),
                accel_bias_sigma: self.initialization.accel_bias_sigma,
                gyro_bias_sigma: self.initialization.gyro_bias_sigma,
            },
        }
    }
}

impl Checked for Machine {
    fn check(&self) -> Result<(), Violation> {
        identifier("id", &self.id)?;
        self.world.check("world")?;
        let frames = &self.frames;
        frames.base_from_cabin.check("frames.base_from_cabin")?;
        frames.cabin_from_imu.check("frames.cabin_from_imu")?;
        frames.cabin_from_lidar.check("frames.cabin_from_lidar")?;
        frames.cabin_from_gnss_left.check("frames.cabin_from_gnss_left")?;
        frames.base_from_base_imu.check("frames.base_from_base_imu")?;
        if let Some(right) = &frames.cabin_from_gnss_right {
            right.check("frames.cabin_from_gnss_right")?;
            let left = Vec3::from_row_slice(&frames.cabin_from_gnss_left.translation_m);
            let baseline_m = (Vec3::from_row_slice(&right.translation_m) - left).norm();
            if baseline_m < 0.1 {
                return violation(
                    "frames.cabin_from_gnss_right",
                    format!("is {baseline_m} m from the left antenna, must be at least 0.1 m"),
                );
            }
        }
        within("imu.update_rate", self.imu.update_rate, 10.0, 2000.0)?;
        positive("imu.accelerometer_noise_density", self.imu.accelerometer_noise_density)?;
        positive("imu.accelerometer_random_walk", self.imu.accelerometer_random_walk)?;
        positive("imu.gyroscope_noise_density", self.imu.gyroscope_noise_density)?;
        positive("imu.gyroscope_random_walk", self.imu.gyroscope_random_walk)?;
        within("imu.gyroscope_missed_part", self.imu.gyroscope_missed_part, 0.0, 1.0)?;
        within("imu.accelerometer_missed_part", self.imu.accelerometer_missed_part, 0.0, 1.0)?;
        positive("base_imu.gyroscope_noise_density", self.base_imu.gyroscope_noise_density)?;
        positive("base_imu.gyroscope_random_walk", self.base_imu.gyroscope_random_walk)?;
        positive("lidar_odometry.increment_sigma_m", self.lidar_odometry.increment_sigma_m)?;
        positive("lidar_odometry.increment_sigma_deg", self.lidar_odometry.increment_sigma_deg)?;
        within("gnss.slow_sigma_m", self.gnss.slow_sigma_m, 0.0, 10.0)?;
        positive("gnss.slow_time_s", self.gnss.slow_time_s)?;
        positive("gnss.sigma_floor_m", self.gnss.sigma_floor_m)?;
        positive("gnss.sigma_max_m", self.gnss.sigma_max_m)?;
        positive("gate.speed_max_mps", self.gate.speed_max_mps)?;
        within("gate.fixes_to_return", f64::from(self.gate.fixes_to_return), 1.0, 1000.0)?;
        within("smoother.lag_s", self.smoother.lag_s, 0.2, 60.0)?;
        within("initialization.static_window_s", self.initialization.static_window_s, 0.5, 60.0)?;
        within("initialization.heading_sigma_deg", self.initialization.heading_sigma_deg, 0.1, 30.0)?;
        positive("initialization.accel_bias_sigma", self.initialization.accel_bias_sigma)?;
        positive("initialization.gyro_bias_sigma", self.initialization.gyro_bias_sigma)?;
        within("publish.pose_rate_hz", self.publish.pose_rate_hz, 0.1, 2000.0)?;
        identifier("link.site", &self.link.site)?;
        endpoints("link.connect", &self.link.connect)?;
        listening("link", &self.link.listen, self.link.unauthenticated, "")?;
        if self.link.tls.is_some() {
            secret("link.connect", &self.link.connect)?;
        }
        within("link.lease_ms", self.link.lease_ms as f64, 100.0, 600_000.0)?;
        within("record.size_max_mb", self.record.size_max_mb as f64, 1.0, 1e9)?;
        self.topics.check()
    }
}
