//! Motion of a rigid body and of what is mounted on it.

use super::jet::Jet;
use crate::lie::{Se3, So3, Vec3};

/// A body's pose in the world and its first two derivatives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigidMotion {
    /// World from body.
    pub pose: Se3,
    /// Of the body's origin, written in the world, m/s.
    pub velocity: Vec3,
    /// Of the body's origin, written in the world, m/s².
    pub acceleration: Vec3,
    /// Of the body, written in the body, rad/s.
    pub angular_rate: Vec3,
    /// Time derivative of `angular_rate`, rad/s².
    pub angular_acceleration: Vec3,
}

impl RigidMotion {
    /// From position (m) and intrinsic Z-Y-X angles (rad) with their derivatives.
    pub(super) fn new(position: [Jet; 3], [yaw, pitch, roll]: [Jet; 3]) -> Self {
        let take = |part: fn(&Jet) -> f64| Vec3::from_iterator(position.iter().map(part));
        // Rates of the angles as quantities of their own; their second derivatives are not needed.
        let rate = |angle: Jet| Jet::new(angle.rate, angle.acceleration, 0.0);
        let (sin_pitch, cos_pitch) = pitch.sin_cos();
        let (sin_roll, cos_roll) = roll.sin_cos();
        let body = [
            rate(roll) - rate(yaw) * sin_pitch,
            rate(pitch) * cos_roll + rate(yaw) * cos_pitch * sin_roll,
            rate(yaw) * cos_pitch * cos_roll - rate(pitch) * sin_roll,
        ];
        Self {
            pose: Se3::new(
                So3::from_yaw_pitch_roll(yaw.value, pitch.value, roll.value),
                take(|jet| jet.value),
            ),
            velocity: take(|jet| jet.rate),
            acceleration: take(|jet| jet.acceleration),
            angular_rate: Vec3::from_iterator(body.iter().map(|jet| jet.value)),
            angular_acceleration: Vec3::from_iterator(body.iter().map(|jet| jet.rate)),
        }
    }

    /// Motion of a frame mounted at `body_from_mounted`.
    pub fn mounted(&self, body_from_mounted: &Se3) -> Self {
        let arm = body_from_mounted.translation;
        let swing = self.angular_rate.cross(&arm);
        let pull = self.angular_acceleration.cross(&arm) + self.angular_rate.cross(&swing);
        let mounted_from_body = body_from_mounted.rotation.inverse();
        Self {
            pose: self.pose * *body_from_mounted,
            velocity: self.velocity + self.pose.rotation * swing,
            acceleration: self.acceleration + self.pose.rotation * pull,
            angular_rate: mounted_from_body * self.angular_rate,
            angular_acceleration: mounted_from_body * self.angular_acceleration,
        }
    }

    /// Motion of a frame that turns about this body's z axis by `angle` (rad).
    pub(super) fn turning(&self, angle: Jet) -> Self {
        let body_from_turned = So3::exp(&(Vec3::z() * angle.value));
        let carried = self.mounted(&Se3::new(body_from_turned, Vec3::zeros()));
        let own_rate = Vec3::z() * angle.rate;
        Self {
            angular_rate: carried.angular_rate + own_rate,
            angular_acceleration: carried.angular_acceleration - own_rate.cross(&carried.angular_rate)
                + Vec3::z() * angle.acceleration,
            ..carried
        }
    }

    /// Acceleration less gravity (m/s², world), written in the body: what its accelerometer feels.
    pub fn specific_force(&self, gravity: &Vec3) -> Vec3 {
        self.pose.rotation.inverse() * (self.acceleration - gravity)
    }
}
