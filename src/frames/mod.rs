//! Frames as types, and the one door by which a motion gets them.
//!
//! `Pose<World, Imu>` maps what is written in `Imu` into `World`; `Pose<World, Cabin> * Pose<Cabin, Imu>`
//! compiles and gives `Pose<World, Imu>`, the wrong chain does not compile. Geodetic coordinates and local
//! gravity are in [`geodesy`]. The lengths of the machine itself (extrinsics) are configuration, not here.

pub mod geodesy;

use std::fmt;
use std::marker::PhantomData;
use std::ops::Mul;

use crate::lie::{Se3, So3, Vec3};

macro_rules! frames {
    ($($(#[$doc:meta])* $name:ident = $text:literal;)*) => {
        $($(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $name {}
        impl Frame for $name {
            const NAME: &'static str = $text;
        })*
    };
}

/// A frame of reference; its name is used in messages and recordings.
pub trait Frame {
    /// The `frame_id` on the wire.
    const NAME: &'static str;
}

frames! {
    /// Site frame, ENU (x east, y north, z up) at the configured WGS84 origin, shared by the site's machines.
    World = "world";
    /// Local frame of one machine: continuous for ever, gravity-aligned, drifts slowly against [`World`].
    Odom = "odom";
    /// Chassis: x forward, y left, z up along the cabin-turn axis.
    Base = "base";
    /// Cabin: turns about +z of [`Base`] by the measured cabin-turn angle.
    Cabin = "cabin";
    /// Cabin IMU: the body whose state is estimated.
    Imu = "imu";
    /// Chassis IMU.
    BaseImu = "base_imu";
    /// Lidar on the cabin.
    Lidar = "lidar";
    /// Start frame of the lidar odometry.
    LidarMap = "lidar_map";
}

/// A rigid motion that maps points written in `Child` into `Parent`: `parent_from_child`.
pub struct Pose<Parent, Child> {
    motion: Se3,
    frames: PhantomData<fn() -> (Parent, Child)>,
}

impl<A, B> Pose<A, B> {
    /// Promises that `motion` maps `B` into `A`. The only way in: grep for it to see who promises.
    pub fn assume(motion: Se3) -> Self {
        Self { motion, frames: PhantomData }
    }

    /// Both frames coincide.
    pub fn identity() -> Self {
        Self::assume(Se3::identity())
    }

    /// The motion without its frames.
    pub fn motion(&self) -> &Se3 {
        &self.motion
    }

    /// Orientation of `B` in `A`.
    pub fn rotation(&self) -> So3 {
        self.motion.rotation
    }

    /// Origin of `B` in `A`, m.
    pub fn translation(&self) -> Vec3 {
        self.motion.translation
    }

    /// Maps the other way.
    pub fn inverse(&self) -> Pose<B, A> {
        Pose::assume(self.motion.inverse())
    }
}

impl<A, B, C> Mul<Pose<B, C>> for Pose<A, B> {
    type Output = Pose<A, C>;
    fn mul(self, other: Pose<B, C>) -> Pose<A, C> {
        Pose::assume(self.motion * other.motion)
    }
}

/// Maps a point.
impl<A, B> Mul<Vec3> for Pose<A, B> {
    type Output = Vec3;
    fn mul(self, point: Vec3) -> Vec3 {
        self.motion * point
    }
}

impl<A, B> Clone for Pose<A, B> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<A, B> Copy for Pose<A, B> {}

impl<A, B> PartialEq for Pose<A, B> {
    fn eq(&self, other: &Self) -> bool {
        self.motion == other.motion
    }
}

impl<A: Frame, B: Frame> fmt::Debug for Pose<A, B> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x, y, z, w] = self.motion.rotation.to_xyzw();
        let t = self.motion.translation;
        write!(formatter, "{}_from_{} [{} {} {} | {x} {y} {z} {w}]", A::NAME, B::NAME, t.x, t.y, t.z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_chain_and_invert() {
        let world_from_cabin: Pose<World, Cabin> =
            Pose::assume(Se3::new(So3::from_yaw_pitch_roll(1.0, 0.2, 0.1), Vec3::new(3.0, 2.0, 1.0)));
        let cabin_from_imu: Pose<Cabin, Imu> =
            Pose::assume(Se3::new(So3::from_yaw_pitch_roll(-0.4, 0.0, 3.0), Vec3::new(0.3, -0.2, 0.2)));
        let world_from_imu: Pose<World, Imu> = world_from_cabin * cabin_from_imu;
        let back = world_from_cabin.inverse() * world_from_imu;
        assert!(back.motion().minus(cabin_from_imu.motion()).norm() < 1e-14);
    }
}
