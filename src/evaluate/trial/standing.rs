//! Drift of a standing chassis, and the yardstick of an outage.

use crate::lie::{Se3, Vec3};
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

/// The lidar's increments in the outage, summed up with the true heading, and left out while the chassis stands.
pub(super) struct Yardstick {
    outage: Option<[Stamp; 2]>,
    before: Option<(Se3, Truth)>,
    sum: Vec3,
    squared: f64,
    count: f64,
}

impl Yardstick {
    pub fn new(outage: Option<[Stamp; 2]>) -> Self {
        Self { outage, before: None, sum: Vec3::zeros(), squared: 0.0, count: 0.0 }
    }

    pub fn note(&mut self, pose: &LidarPose, imu_from_lidar: &Se3, truth: impl Fn(Stamp) -> Truth) {
        if self.outage.is_none_or(|[begin, end]| pose.stamp <= begin || pose.stamp >= end) {
            return;
        }
        let truth = truth(pose.stamp);
        let map_from_lidar = *pose.lidarmap_from_lidar.motion();
        if let Some((before, truth_before)) = &self.before {
            let [from, to] = [truth_before, &truth].map(|truth| truth.imu.pose * *imu_from_lidar);
            let error = (before.inverse() * map_from_lidar).translation - (from.inverse() * to).translation;
            if (truth.base.pose.translation - truth_before.base.pose.translation).norm() > 1e-6 {
                self.sum += from.rotation * error;
            }
            self.squared += self.sum.norm_squared();
            self.count += 1.0;
        }
        self.before = Some((map_from_lidar, truth));
    }

    pub fn rmse_m(&self) -> f64 {
        (self.squared / self.count.max(1.0)).sqrt()
    }
}
