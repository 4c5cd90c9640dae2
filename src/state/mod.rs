//! What the estimator knows and says: the navigation state, the estimate at IMU rate, health and events.

mod health;
mod live;

pub use health::{Event, EventKind, GnssState, Graph, Health, OutageReport, SensorHealth, Severity};
pub use live::{LiveRun, Takeover};

use std::fmt;

use nalgebra::{SMatrix, SVector};
use serde::{Deserialize, Serialize};

use crate::frames::{Base, Imu, Odom, Pose, World};
use crate::lie::{Se3, So3, Vec3};
use crate::time::Stamp;

/// Dimensions of [`NavState`]'s tangent.
pub const STATE_DIM: usize = 16;
/// Tangent of [`NavState`]: rotation (rad, right perturbation), position (m), velocity (m/s), gyro bias
/// (rad/s), accelerometer bias (m/s²), three each, and the chassis gyro's bias (rad/s); all but the rotation add
/// in the frame in which they are written.
pub type StateVector = SVector<f64, STATE_DIM>;
/// Matrix over tangents of [`NavState`].
pub type StateMatrix = SMatrix<f64, STATE_DIM, STATE_DIM>;

/// First row of each part in [`StateVector`].
pub mod row {
    /// Rotation.
    pub const ROTATION: usize = 0;
    /// Position.
    pub const POSITION: usize = 3;
    /// Velocity.
    pub const VELOCITY: usize = 6;
    /// Gyro bias.
    pub const GYRO_BIAS: usize = 9;
    /// Accelerometer bias.
    pub const ACCEL_BIAS: usize = 12;
    /// Bias of the chassis gyro about the turn axis; one row.
    pub const BASE_GYRO_BIAS: usize = 15;
}

/// State of the cabin IMU in the site frame: an element of SO(3) × R¹³.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NavState {
    /// `world_from_imu`, orientation.
    pub rotation: So3,
    /// Origin of the IMU in the world, m.
    pub position: Vec3,
    /// Of the IMU's origin, written in the world, m/s.
    pub velocity: Vec3,
    /// What the gyroscope reads at no rotation, rad/s, in the IMU frame.
    pub gyro_bias: Vec3,
    /// What the accelerometer reads too much, m/s², in the IMU frame.
    pub accel_bias: Vec3,
    /// What the chassis' gyroscope reads at no rotation about the chassis' z, rad/s.
    pub base_gyro_bias: f64,
}

impl NavState {
    /// At the origin, level, at rest, without bias.
    pub fn identity() -> Self {
        Self {
            rotation: So3::identity(),
            position: Vec3::zeros(),
            velocity: Vec3::zeros(),
            gyro_bias: Vec3::zeros(),
            accel_bias: Vec3::zeros(),
            base_gyro_bias: 0.0,
        }
    }

    /// The state moved by a tangent.
    pub fn plus(&self, tangent: &StateVector) -> Self {
        let part = |first: usize| tangent.fixed_rows::<3>(first).into_owned();
        Self {
            rotation: self.rotation.plus(&part(row::ROTATION)).renormalized(),
            position: self.position + part(row::POSITION),
            velocity: self.velocity + part(row::VELOCITY),
            gyro_bias: self.gyro_bias + part(row::GYRO_BIAS),
            accel_bias: self.accel_bias + part(row::ACCEL_BIAS),
            base_gyro_bias: self.base_gyro_bias + tangent[row::BASE_GYRO_BIAS],
        }
    }

    /// The tangent `d` with `origin.plus(d) == self`.
    pub fn minus(&self, origin: &Self) -> StateVector {
        let mut tangent = StateVector::zeros();
        tangent.fixed_rows_mut::<3>(row::ROTATION).copy_from(&self.rotation.minus(&origin.rotation));
        tangent.fixed_rows_mut::<3>(row::POSITION).copy_from(&(self.position - origin.position));
        tangent.fixed_rows_mut::<3>(row::VELOCITY).copy_from(&(self.velocity - origin.velocity));
        tangent.fixed_rows_mut::<3>(row::GYRO_BIAS).copy_from(&(self.gyro_bias - origin.gyro_bias));
        tangent.fixed_rows_mut::<3>(row::ACCEL_BIAS).copy_from(&(self.accel_bias - origin.accel_bias));
        tangent[row::BASE_GYRO_BIAS] = self.base_gyro_bias - origin.base_gyro_bias;
        tangent
    }

    /// Pose of the IMU in the world.
    pub fn world_from_imu(&self) -> Pose<World, Imu> {
        Pose::assume(Se3::new(self.rotation, self.position))
    }

    /// Variance (rad²) of a rotation about the world's vertical, of a covariance in the state's tangent.
    pub fn heading_variance(&self, covariance: &StateMatrix) -> f64 {
        let up_in_imu = self.rotation.inverse() * Vec3::z();
        let rotation = covariance.fixed_view::<3, 3>(row::ROTATION, row::ROTATION);
        up_in_imu.dot(&(rotation * up_in_imu)).max(0.0)
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        let parts = [self.position, self.velocity, self.gyro_bias, self.accel_bias];
        self.base_gyro_bias.is_finite()
            && self.rotation.to_xyzw().iter().all(|part| part.is_finite())
            && parts.iter().all(|part| part.iter().all(|value| value.is_finite()))
    }
}

/// What the estimate rests on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// Not started: waits for what [`Health::waits_for`] says.
    Initializing,
    /// Main graph: GNSS, with lidar and IMU.
    Main,
    /// No usable GNSS: lidar and IMU hold the position.
    Fallback,
    /// Neither GNSS nor lidar: the IMU alone, for seconds.
    ImuOnly,
}

impl Mode {
    /// The name in files and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Mode::Initializing => "initializing",
            Mode::Main => "main",
            Mode::Fallback => "fallback",
            Mode::ImuOnly => "imu_only",
        }
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// State of the chassis in the odom frame, by kinematics.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BaseState {
    /// Chassis in the odom frame.
    pub odom_from_base: Pose<Odom, Base>,
    /// Of the chassis' origin, written in the chassis frame, m/s (as `nav_msgs/Odometry` has it).
    pub velocity_in_base: Vec3,
    /// Of the chassis, written in the chassis frame, rad/s.
    pub angular_rate_in_base: Vec3,
}

/// The estimate at one IMU sample: what is published and written.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// Of the IMU sample.
    pub stamp: Stamp,
    /// Accurate; may be corrected from one sample to the next.
    pub state: NavState,
    /// Of the IMU, less bias, in the IMU frame, rad/s.
    pub angular_rate_in_imu: Vec3,
    /// Smooth: never steps.
    pub odom_from_imu: Pose<Odom, Imu>,
    /// Takes the steps that `odom_from_imu` does not.
    pub world_from_odom: Pose<World, Odom>,
    /// The chassis, where the cabin-turn angle is known.
    pub base: Option<BaseState>,
    /// Of `state`, in its tangent (see [`StateVector`]).
    pub covariance: StateMatrix,
    /// What the estimate rests on.
    pub mode: Mode,
}

impl Estimate {
    /// Accurate pose of the IMU.
    pub fn world_from_imu(&self) -> Pose<World, Imu> {
        self.state.world_from_imu()
    }

    /// Standard deviations of position in the world (m): x, y, z.
    pub fn position_sigma_m(&self) -> [f64; 3] {
        std::array::from_fn(|axis| {
            self.covariance[(row::POSITION + axis, row::POSITION + axis)].max(0.0).sqrt()
        })
    }

    /// Standard deviations (rad) of rotations about the world's x, y and z: roll, pitch, yaw of a level body.
    pub fn rotation_sigma(&self) -> [f64; 3] {
        let rotation = self.state.rotation.matrix();
        let covariance = rotation
            * self.covariance.fixed_view::<3, 3>(row::ROTATION, row::ROTATION)
            * rotation.transpose();
        std::array::from_fn(|axis| covariance[(axis, axis)].max(0.0).sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn minus_undoes_plus() {
        let state = NavState {
            rotation: So3::from_yaw_pitch_roll(2.0, 0.4, -0.2),
            position: Vec3::new(3.0, 4.0, 5.0),
            ..NavState::identity()
        };
        let tangent = StateVector::from_fn(|index, _| 0.1 * (index as f64 - 7.0));
        assert!((state.plus(&tangent).minus(&state) - tangent).norm() < 1e-14);
    }
}
