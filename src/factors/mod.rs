//! What a measurement says about the states: whitened residuals and their Jacobians.
//!
//! Each factor file has its equation, source and frames. A residual is divided by its sigma, so that the
//! cost is half its squared norm; Jacobians are over the tangent of `state::NavState` (rotation, position,
//! velocity, gyro bias, accelerometer bias, chassis gyro bias). No graph in here: the room `smoother` knows who is tied to whom.

mod between;
mod imu;
mod pose;
mod position;
mod robust;
mod turn;

#[cfg(test)]
mod differences;

pub use between::{BetweenFactor, LinearBetween};
pub use imu::{ImuFactor, LinearImu};
pub use pose::{LinearPose, PoseFactor};
pub use position::{LinearPosition, PositionFactor};
pub use robust::huber_weight;
pub use turn::{LinearTurn, TurnFactor};
