//! Rotations in three dimensions, stored as unit quaternions.

use std::ops::Mul;

use nalgebra::{Quaternion, UnitQuaternion};

use super::{Mat3, Vec3};

/// Below this angle (rad) series replace the closed forms; their first neglected term is under 1e-16.
const SMALL_ANGLE: f64 = 1e-4;

/// So far from 1 a quaternion's length may be by rounding alone.
const ROUNDED_LENGTH: f64 = 4.0 * f64::EPSILON;

/// A rotation: maps vectors written in the child frame into the parent frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct So3 {
    quaternion: UnitQuaternion<f64>,
}

/// The skew-symmetric matrix with `hat(a) * b = a × b` (\[S\] eq. 9).
pub fn hat(v: &Vec3) -> Mat3 {
    Mat3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

impl So3 {
    /// No rotation.
    pub fn identity() -> Self {
        Self { quaternion: UnitQuaternion::identity() }
    }

    /// From quaternion parts of any positive length, scalar last as in TUM files and ROS messages.
    /// Parts that are a rotation but for rounding are kept to the bit, so that what was written comes back.
    /// `None` if they are not finite or their length is under 1e-6.
    pub fn from_xyzw(x: f64, y: f64, z: f64, w: f64) -> Option<Self> {
        let quaternion = Quaternion::new(w, x, y, z);
        let length = quaternion.norm();
        let unit = if (length - 1.0).abs() < ROUNDED_LENGTH {
            UnitQuaternion::new_unchecked(quaternion)
        } else {
            UnitQuaternion::from_quaternion(quaternion)
        };
        (length.is_finite() && length > 1e-6).then_some(Self { quaternion: unit })
    }

    /// Quaternion parts, scalar last, with a scalar that is never negative.
    pub fn to_xyzw(&self) -> [f64; 4] {
        let q = self.quaternion.quaternion();
        let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
        [q.i * sign, q.j * sign, q.k * sign, q.w * sign]
    }

    /// Intrinsic Z-Y-X turns (rad): first yaw about z, then pitch about y, then roll about x.
    pub fn from_yaw_pitch_roll(yaw: f64, pitch: f64, roll: f64) -> Self {
        Self { quaternion: UnitQuaternion::from_euler_angles(roll, pitch, yaw) }
    }

    /// Intrinsic Z-Y-X angles (yaw, pitch, roll) in rad, yaw and roll in (-π, π], pitch in [-π/2, π/2].
    pub fn yaw_pitch_roll(&self) -> [f64; 3] {
        let (roll, pitch, yaw) = self.quaternion.euler_angles();
        [yaw, pitch, roll]
    }

    /// From a rotation matrix, which must be orthonormal.
    pub fn from_matrix(matrix: &Mat3) -> Self {
        let rotation = nalgebra::Rotation3::from_matrix_unchecked(*matrix);
        Self { quaternion: UnitQuaternion::from_rotation_matrix(&rotation) }
    }

    /// The rotation about `axis` (any positive length) by `angle` rad.
    pub fn about(axis: &Vec3, angle: f64) -> Self {
        Self::exp(&(axis.normalize() * angle))
    }

    /// The shortest rotation that turns the direction `from` into the direction `to`.
    pub fn between(from: &Vec3, to: &Vec3) -> Self {
        let quaternion = UnitQuaternion::rotation_between(from, to)
            .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vec3::x_axis(), std::f64::consts::PI));
        Self { quaternion }
    }

    /// Exponential map of a rotation vector (rad) (\[S\] eq. 132).
    pub fn exp(phi: &Vec3) -> Self {
        let angle_squared = phi.norm_squared();
        let (real, imaginary) = if angle_squared < SMALL_ANGLE * SMALL_ANGLE {
            (1.0 - angle_squared / 8.0, 0.5 - angle_squared / 48.0)
        } else {
            let angle = angle_squared.sqrt();
            let (sin, cos) = libm::sincos(0.5 * angle);
            (cos, sin / angle)
        };
        let q = Quaternion::new(real, imaginary * phi.x, imaginary * phi.y, imaginary * phi.z);
        Self { quaternion: UnitQuaternion::new_unchecked(q) }
    }

    /// Rotation vector (rad), at most π long (\[S\] eq. 133).
    pub fn log(&self) -> Vec3 {
        let q = self.quaternion.quaternion();
        let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
        let vector = q.imag() * sign;
        let real = q.w * sign;
        let sine = vector.norm();
        let factor = if sine < 0.5 * SMALL_ANGLE {
            2.0 / real * (1.0 - sine * sine / (3.0 * real * real))
        } else {
            2.0 * libm::atan2(sine, real) / sine
        };
        vector * factor
    }

    /// The inverse rotation.
    pub fn inverse(&self) -> Self {
        Self { quaternion: self.quaternion.inverse() }
    }

    /// `self * exp(phi)`.
    pub fn plus(&self, phi: &Vec3) -> Self {
        *self * Self::exp(phi)
    }

    /// The tangent `phi` with `origin.plus(phi) == self`.
    pub fn minus(&self, origin: &Self) -> Vec3 {
        (origin.inverse() * *self).log()
    }

    /// As a 3×3 matrix.
    pub fn matrix(&self) -> Mat3 {
        *self.quaternion.to_rotation_matrix().matrix()
    }

    /// Takes away the rounding error that long products collect in the quaternion's length.
    pub fn renormalized(&self) -> Self {
        Self { quaternion: UnitQuaternion::new_normalize(*self.quaternion.quaternion()) }
    }

    /// Right Jacobian: `exp(phi + d) ≈ exp(phi) * exp(Jr(phi) d)` (\[S\] eq. 143).
    pub fn right_jacobian(phi: &Vec3) -> Mat3 {
        let angle_squared = phi.norm_squared();
        let hat_phi = hat(phi);
        let (first, second) = if angle_squared < SMALL_ANGLE * SMALL_ANGLE {
            (0.5 - angle_squared / 24.0, 1.0 / 6.0 - angle_squared / 120.0)
        } else {
            let angle = angle_squared.sqrt();
            let (sin, cos) = libm::sincos(angle);
            ((1.0 - cos) / angle_squared, (angle - sin) / (angle_squared * angle))
        };
        Mat3::identity() - hat_phi * first + hat_phi * hat_phi * second
    }

    /// Inverse of [`So3::right_jacobian`] (\[S\] eq. 144).
    pub fn right_jacobian_inverse(phi: &Vec3) -> Mat3 {
        let angle_squared = phi.norm_squared();
        let hat_phi = hat(phi);
        let second = if angle_squared < SMALL_ANGLE * SMALL_ANGLE {
            1.0 / 12.0 + angle_squared / 720.0
        } else {
            let angle = angle_squared.sqrt();
            let half = 0.5 * angle;
            let (sin, cos) = libm::sincos(half);
            (1.0 - half * cos / sin) / angle_squared
        };
        Mat3::identity() + hat_phi * 0.5 + hat_phi * hat_phi * second
    }

    /// Left Jacobian: `exp(phi + d) ≈ exp(Jl(phi) d) * exp(phi)`; the transpose of the right one.
    pub fn left_jacobian(phi: &Vec3) -> Mat3 {
        Self::right_jacobian(phi).transpose()
    }
}

impl Mul for So3 {
    type Output = So3;
    fn mul(self, other: So3) -> So3 {
        So3 { quaternion: self.quaternion * other.quaternion }
    }
}

impl Mul<Vec3> for So3 {
    type Output = Vec3;
    fn mul(self, vector: Vec3) -> Vec3 {
        self.quaternion * vector
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples() -> Vec<Vec3> {
        let mut samples = vec![Vec3::zeros()];
        for scale in [1e-9, 1e-5, 0.99e-4, 1.01e-4, 1e-2, 0.7, 2.0, 3.1] {
            for direction in [Vec3::new(1.0, 0.0, 0.0), Vec3::new(-0.4, 0.6, 0.7), Vec3::new(0.2, -0.9, 0.1)]
            {
                samples.push(direction.normalize() * scale);
            }
        }
        samples
    }

    #[test]
    fn log_undoes_exp() {
        for phi in samples() {
            assert!((So3::exp(&phi).log() - phi).norm() < 1e-14 * (1.0 + 1e2 * phi.norm()), "{phi}");
        }
    }

    #[test]
    fn exp_agrees_with_the_series_of_the_matrix_exponential() {
        for phi in samples() {
            let mut term = Mat3::identity();
            let mut sum = Mat3::identity();
            for order in 1..40 {
                term = term * hat(&phi) / f64::from(order);
                sum += term;
            }
            assert!((So3::exp(&phi).matrix() - sum).norm() < 1e-13, "{phi}");
        }
    }

    #[test]
    fn right_jacobian_agrees_with_differences_and_with_its_inverse() {
        let step = 1e-6;
        for phi in samples() {
            let analytic = So3::right_jacobian(&phi);
            for axis in 0..3 {
                let mut forward = phi;
                let mut backward = phi;
                forward[axis] += step;
                backward[axis] -= step;
                let origin = So3::exp(&phi);
                let difference =
                    (So3::exp(&forward).minus(&origin) - So3::exp(&backward).minus(&origin)) / (2.0 * step);
                assert!((difference - analytic.column(axis)).norm() < 1e-8, "{phi} {axis}");
            }
            let product = analytic * So3::right_jacobian_inverse(&phi);
            assert!((product - Mat3::identity()).norm() < 1e-12, "{phi}");
        }
    }

    #[test]
    fn euler_angles_and_quaternions_come_back() {
        let rotation = So3::from_yaw_pitch_roll(2.0, -0.3, 0.1);
        let [yaw, pitch, roll] = rotation.yaw_pitch_roll();
        assert!((yaw - 2.0).abs() + (pitch + 0.3).abs() + (roll - 0.1).abs() < 1e-14);
        let [x, y, z, w] = rotation.to_xyzw();
        let back = So3::from_xyzw(3.0 * x, 3.0 * y, 3.0 * z, 3.0 * w).expect("finite");
        assert!(back.minus(&rotation).norm() < 1e-15);
        assert!(So3::from_xyzw(0.0, 0.0, 0.0, 0.0).is_none());
        assert!(So3::from_xyzw(f64::NAN, 0.0, 0.0, 1.0).is_none());
    }

    #[test]
    fn shortest_rotation_handles_opposite_directions() {
        let turned = So3::between(&Vec3::z(), &-Vec3::z()) * Vec3::z();
        assert!((turned + Vec3::z()).norm() < 1e-12);
    }
}
