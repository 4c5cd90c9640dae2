//! What the estimator must know of its machine.

use super::gate;
use crate::frames::geodesy::SiteFrame;
use crate::frames::{Base, BaseImu, Cabin, Imu, Lidar, Pose};
use crate::lie::Vec3;
use crate::smoother;
use crate::time::Span;

/// Settings of one machine's estimator.
#[derive(Clone, Debug)]
pub struct Options {
    /// Window, gravity and IMU noise.
    pub smoother: smoother::Options,
    /// The site frame fixes are brought into.
    pub site: SiteFrame,
    /// Where the lidar sits.
    pub imu_from_lidar: Pose<Imu, Lidar>,
    /// Where the IMU sits on the cabin.
    pub imu_from_cabin: Pose<Imu, Cabin>,
    /// At cabin-turn angle zero.
    pub base_from_cabin: Pose<Base, Cabin>,
    /// Where the chassis IMU sits.
    pub base_from_base_imu: Pose<Base, BaseImu>,
    /// White noise of the chassis' gyroscope, rad/s/√Hz.
    pub base_gyroscope_noise_density: f64,
    /// Phase centre of the left antenna in the IMU frame, m.
    pub antenna_left: Vec3,
    /// Phase centre of the right antenna in the IMU frame, m.
    pub antenna_right: Option<Vec3>,
    /// One sigma of a lidar increment: rad, m.
    pub lidar_sigma: [f64; 2],
    /// What lidar poses are to the fallback graph.
    pub lidar_in_outage: InOutage,
    /// What is believed.
    pub gate: gate::Options,
    /// How the estimate starts.
    pub initialization: Initialization,
}

/// What lidar poses are to the fallback graph.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum InOutage {
    /// Relative to the pose before, or after a gap to the newest that was used.
    #[default]
    Relative,
    /// Global, in a map that was fixed to the world at the loss: the paper's form.
    PseudoGlobal,
}

/// How the estimate starts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Initialization {
    /// So long a standstill gives attitude and gyro bias.
    pub static_window: Span,
    /// Heading known to this, rad (one sigma), is enough.
    pub heading_sigma: f64,
    /// Prior of the accelerometer bias, m/s².
    pub accel_bias_sigma: f64,
    /// Prior of the gyro bias of a machine that never stood still, rad/s.
    pub gyro_bias_sigma: f64,
}
