//! Lie groups of rigid motion: [`So3`] and [`Se3`].
//!
//! One convention for the whole house: perturbations act on the right, `x.plus(d) = x * exp(d)`, and
//! tangent vectors are ordered rotation first, then translation. Formulas follow Solà, Deray and
//! Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), cited as \[S\] with its
//! equation numbers. No frames in here: those are types of the room `frames`.
//!
//! Sines and their kin come from the crate `libm`, not from the system: the same inputs give the same bits on
//! every processor.

mod se3;
mod so3;

pub use se3::Se3;
pub use so3::{So3, hat};

/// Column of three, SI units of its context.
pub type Vec3 = nalgebra::Vector3<f64>;
/// 3×3 matrix.
pub type Mat3 = nalgebra::Matrix3<f64>;
/// Tangent of [`Se3`]: rotation (rad), then translation (m).
pub type Vec6 = nalgebra::Vector6<f64>;
/// 6×6 matrix over tangents of [`Se3`].
pub type Mat6 = nalgebra::Matrix6<f64>;
