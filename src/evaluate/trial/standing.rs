//! Drift of a standing chassis, and the yardstick of an outage.

use crate::lie::{Se3, So3, Vec3};
use crate::sensors::LidarPose;
use crate::simulate::Truth;
use crate::time::Stamp;

/// A stop is recognised and what it says taken in after so long, s.
const SETTLES_S: f64 = 2.0;

/// Error when the chassis came to rest, when that had settled, and now.
#[derive(Default)]
pub(super) struct Standing {
    since: Option<(Stamp, Vec3)>,
    settled: Option<Vec3>,
    newest: Vec3,
}

impl Standing {
    /// How far the error has moved since the chassis stands, and since it has settled, m.
    pub fn drift_m(&mut self, stamp: Stamp, error: &Vec3) -> [f64; 2] {
        let (since, reference) = *self.since.get_or_insert((stamp, *error));
        self.newest = *error;
        if stamp.seconds_since(since) < SETTLES_S {
            return [(error - reference).norm(), 0.0];
        }
        let settled = *self.settled.get_or_insert(*error);
        [(error - reference).norm(), (error - settled).norm()]
    }

    /// Distance from the truth at the beginning and at the end of a rest that settled, m.
    pub fn distances_m(&self) -> Option<[f64; 2]> {
        self.settled?;
        Some([self.since?.1.norm(), self.newest.norm()])
    }
}

/// The lidar's increments in the outage, summed up, and left out while the chassis stands: with the true heading, and
/// with the estimate's.
pub(super) struct Yardstick {
    outage: Option<[Stamp; 2]>,
    before: Option<(Se3, Truth)>,
    sums: [Vec3; 2],
    squared: [f64; 2],
    count: f64,
}

impl Yardstick {
    pub fn new(outage: Option<[Stamp; 2]>) -> Self {
        Self { outage, before: None, sums: [Vec3::zeros(); 2], squared: [0.0; 2], count: 0.0 }
    }

    /// A pose of the lidar, and what the estimate's heading is off, rad.
    pub fn note(
        &mut self,
        pose: &LidarPose,
        imu_from_lidar: &Se3,
        heading_error: f64,
        truth: impl Fn(Stamp) -> Truth,
    ) {
        if self.outage.is_none_or(|[begin, end]| pose.stamp <= begin || pose.stamp >= end) {
            return;
        }
        let truth = truth(pose.stamp);
        let map_from_lidar = *pose.lidarmap_from_lidar.motion();
        if let Some((before, truth_before)) = &self.before {
            if (truth.base.pose.translation - truth_before.base.pose.translation).norm() > 1e-6 {
                let [from, to] = [truth_before, &truth].map(|truth| truth.imu.pose * *imu_from_lidar);
                let seen = from.rotation * (before.inverse() * map_from_lidar).translation;
                let real = to.translation - from.translation;
                let turned = So3::exp(&Vec3::new(0.0, 0.0, heading_error)) * seen;
                self.sums[0] += seen - real;
                self.sums[1] += turned - real;
            }
            for (squared, sum) in self.squared.iter_mut().zip(&self.sums) {
                *squared += sum.norm_squared();
            }
            self.count += 1.0;
        }
        self.before = Some((map_from_lidar, truth));
    }

    /// With the true heading, and with the estimate's.
    pub fn rmse_m(&self) -> [f64; 2] {
        self.squared.map(|squared| (squared / self.count.max(1.0)).sqrt())
    }
}
