//! Rigid motions in three dimensions: a rotation and a translation.

use std::ops::Mul;

use super::{Mat3, Mat6, So3, Vec3, Vec6, hat};

/// A rigid motion: maps points written in the child frame into the parent frame, `R p + t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Se3 {
    /// Parent from child.
    pub rotation: So3,
    /// Origin of the child in the parent, m.
    pub translation: Vec3,
}

impl Se3 {
    /// A motion with these parts.
    pub fn new(rotation: So3, translation: Vec3) -> Self {
        Self { rotation, translation }
    }

    /// No motion.
    pub fn identity() -> Self {
        Self::new(So3::identity(), Vec3::zeros())
    }

    /// Exponential map of (rotation, translation) (\[S\] eq. 172).
    pub fn exp(tangent: &Vec6) -> Self {
        let (phi, rho) = split(tangent);
        Self::new(So3::exp(&phi), So3::left_jacobian(&phi) * rho)
    }

    /// Tangent (rotation, translation) with `exp(log(x)) == x` (\[S\] eq. 173).
    pub fn log(&self) -> Vec6 {
        let phi = self.rotation.log();
        let rho = So3::right_jacobian_inverse(&phi).transpose() * self.translation;
        join(&phi, &rho)
    }

    /// The inverse motion.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self::new(rotation, -(rotation * self.translation))
    }

    /// `self * exp(tangent)`.
    pub fn plus(&self, tangent: &Vec6) -> Self {
        *self * Self::exp(tangent)
    }

    /// The tangent `d` with `origin.plus(d) == self`.
    pub fn minus(&self, origin: &Self) -> Vec6 {
        (origin.inverse() * *self).log()
    }

    /// Adjoint: `x * exp(d) == exp(Ad(x) d) * x` (\[S\] eq. 175, rotation first).
    pub fn adjoint(&self) -> Mat6 {
        let rotation = self.rotation.matrix();
        let mut adjoint = Mat6::zeros();
        adjoint.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
        adjoint.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
        adjoint.fixed_view_mut::<3, 3>(3, 0).copy_from(&(hat(&self.translation) * rotation));
        adjoint
    }

    /// Inverse of the right Jacobian: `log(x * exp(d)) ≈ log(x) + Jr⁻¹(log x) d` (\[S\] eqs. 179 to 181).
    pub fn right_jacobian_inverse(tangent: &Vec6) -> Mat6 {
        let (phi, rho) = split(tangent);
        let inverse = So3::right_jacobian_inverse(&phi);
        let coupling = coupling_block(&-phi, &-rho);
        let mut jacobian = Mat6::zeros();
        jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&inverse);
        jacobian.fixed_view_mut::<3, 3>(3, 3).copy_from(&inverse);
        jacobian.fixed_view_mut::<3, 3>(3, 0).copy_from(&(-inverse * coupling * inverse));
        jacobian
    }
}

fn split(tangent: &Vec6) -> (Vec3, Vec3) {
    (tangent.fixed_rows::<3>(0).into_owned(), tangent.fixed_rows::<3>(3).into_owned())
}

fn join(phi: &Vec3, rho: &Vec3) -> Vec6 {
    Vec6::new(phi.x, phi.y, phi.z, rho.x, rho.y, rho.z)
}

/// The block Q of the left Jacobian of SE(3) (\[S\] eq. 180; Barfoot, State Estimation for Robotics, eq. 7.86b).
fn coupling_block(phi: &Vec3, rho: &Vec3) -> Mat3 {
    let angle_squared = phi.norm_squared();
    let (p, r) = (hat(phi), hat(rho));
    let (second, third, fourth) = if angle_squared < 1e-4 {
        (
            1.0 / 6.0 - angle_squared / 120.0 + angle_squared * angle_squared / 5040.0,
            1.0 / 24.0 - angle_squared / 720.0 + angle_squared * angle_squared / 40320.0,
            1.0 / 120.0 - angle_squared / 2520.0 + angle_squared * angle_squared / 120_960.0,
        )
    } else {
        let angle = angle_squared.sqrt();
        let (sin, cos) = libm::sincos(angle);
        (
            (angle - sin) / (angle_squared * angle),
            (angle_squared + 2.0 * cos - 2.0) / (2.0 * angle_squared * angle_squared),
            (2.0 * angle - 3.0 * sin + angle * cos) / (2.0 * angle_squared * angle_squared * angle),
        )
    };
    r * 0.5
        + (p * r + r * p + p * r * p) * second
        + (p * p * r + r * p * p - p * r * p * 3.0) * third
        + (p * r * p * p + p * p * r * p) * fourth
}

impl Mul for Se3 {
    type Output = Se3;
    fn mul(self, other: Se3) -> Se3 {
        Se3::new(self.rotation * other.rotation, self.rotation * other.translation + self.translation)
    }
}

impl Mul<Vec3> for Se3 {
    type Output = Vec3;
    fn mul(self, point: Vec3) -> Vec3 {
        self.rotation * point + self.translation
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples() -> Vec<Vec6> {
        let direction = Vec6::new(0.3, -0.5, 0.8, 1.5, -2.0, 0.7);
        [0.0, 1e-8, 1e-4, 0.9e-2, 1.1e-2, 0.3, 1.0, 3.0].iter().map(|scale| direction * *scale).collect()
    }

    #[test]
    fn log_undoes_exp() {
        for tangent in samples() {
            assert!((Se3::exp(&tangent).log() - tangent).norm() < 1e-12, "{tangent}");
        }
    }

    #[test]
    fn inverse_and_adjoint_hold_their_identities() {
        for tangent in samples() {
            let motion = Se3::exp(&tangent);
            assert!((motion * motion.inverse()).log().norm() < 1e-14);
            let small = Vec6::new(0.1, 0.2, -0.1, 0.4, -0.3, 0.2);
            let right = motion * Se3::exp(&small);
            let left = Se3::exp(&(motion.adjoint() * small)) * motion;
            assert!(right.minus(&left).norm() < 1e-13, "{tangent}");
        }
    }

    #[test]
    fn right_jacobian_inverse_agrees_with_differences() {
        let step = 1e-6;
        for tangent in samples() {
            let motion = Se3::exp(&tangent);
            let analytic = Se3::right_jacobian_inverse(&tangent);
            for axis in 0..6 {
                let mut nudge = Vec6::zeros();
                nudge[axis] = step;
                let difference = (motion.plus(&nudge).log() - motion.plus(&-nudge).log()) / (2.0 * step);
                assert!((difference - analytic.column(axis)).norm() < 1e-8, "{tangent} {axis}");
            }
        }
    }
}
