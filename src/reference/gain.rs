//! What the future adds: the live estimate against the smoothed one.

use serde::Serialize;

use super::{LiveSample, Smoothed};
use crate::batch::SmoothedNode;
use crate::evaluate::Statistics;
use crate::lie::{So3, Vec3};
use crate::state::{Mode, NavState};
use crate::time::Stamp;

/// Points of the differences over time that are kept, at most.
const POINTS_MAX: usize = 2_000;

/// Of a whole session.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Gain {
    /// IMU samples that have both a live and a smoothed pose.
    pub compared: u64,
    /// IMU samples with a live pose only.
    pub without_smoothed: u64,
    /// All of them, and by what the live estimate rested on.
    pub parts: Vec<Part>,
    /// Over time, thinned: the largest of each stretch.
    pub points: Vec<Point>,
    /// Of every compared sample, its horizontal difference, m.
    #[serde(skip)]
    pub horizontal_m: Vec<(Stamp, f64)>,
}

impl Gain {
    /// The largest horizontal difference of the samples between two stamps, both included, m; nothing of none.
    pub fn largest_between(&self, from: Stamp, to: Stamp) -> Option<f64> {
        let inside = self.horizontal_m.iter().filter(|(stamp, _)| (from..=to).contains(stamp));
        inside.map(|(_, off_m)| *off_m).max_by(f64::total_cmp)
    }
}

/// The samples of one kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Part {
    /// `all`, or the mode.
    pub name: &'static str,
    /// IMU samples.
    pub samples: u64,
    /// Live less smoothed, horizontally, m.
    pub horizontal_m: Statistics,
    /// The same vertically, m.
    pub vertical_m: Statistics,
    /// The same about the vertical, degrees.
    pub heading_deg: Statistics,
    /// What the live estimate said of itself: root of its mean horizontal variance, m.
    pub live_sigma_m: f64,
    /// The same of the smoothed.
    pub smoothed_sigma_m: f64,
    /// The same of the heading, degrees: live, smoothed.
    pub heading_sigma_deg: [f64; 2],
}

/// The differences of one stretch of time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Point {
    /// Of the largest horizontal difference, s.
    pub t_s: f64,
    /// m.
    pub horizontal_m: f64,
    /// m, with its sign.
    pub vertical_m: f64,
    /// With its sign.
    pub heading_deg: f64,
    /// Of the live estimate, horizontally, m.
    pub live_sigma_m: f64,
    /// Of the smoothed.
    pub smoothed_sigma_m: f64,
}

#[derive(Default)]
struct Sums {
    horizontal: Vec<f64>,
    vertical: Vec<f64>,
    heading: Vec<f64>,
    /// Of variances: horizontal live and smoothed, m²; heading live and smoothed, rad².
    variances: [f64; 4],
}

impl Sums {
    fn note(&mut self, point: &Point, heading_variances: [f64; 2]) {
        self.horizontal.push(point.horizontal_m);
        self.vertical.push(point.vertical_m.abs());
        self.heading.push(point.heading_deg.abs());
        self.variances[0] += point.live_sigma_m.powi(2);
        self.variances[1] += point.smoothed_sigma_m.powi(2);
        self.variances[2] += heading_variances[0];
        self.variances[3] += heading_variances[1];
    }

    fn part(self, name: &'static str) -> Option<Part> {
        let samples = self.horizontal.len() as u64;
        let sigma = self.variances.map(|sum| (sum / samples as f64).sqrt());
        Some(Part {
            name,
            samples,
            horizontal_m: Statistics::of(self.horizontal)?,
            vertical_m: Statistics::of(self.vertical)?,
            heading_deg: Statistics::of(self.heading)?,
            live_sigma_m: sigma[0],
            smoothed_sigma_m: sigma[1],
            heading_sigma_deg: [sigma[2].to_degrees(), sigma[3].to_degrees()],
        })
    }
}

pub(super) fn of(smoothed: &Smoothed, live: &[LiveSample]) -> Gain {
    let mut by_stamp: Vec<&LiveSample> = live.iter().collect();
    by_stamp.sort_by_key(|sample| sample.stamp);
    let modes = [Mode::Main, Mode::Fallback, Mode::ImuOnly];
    let (mut all, mut parts) = (Sums::default(), modes.map(|_| Sums::default()));
    let (mut points, mut horizontal_m) = (Vec::new(), Vec::new());
    let stretch = live.len().div_ceil(POINTS_MAX).max(1);
    let mut compared = 0;
    smoothed.at_samples(|stamp, state, node| {
        let Ok(found) = by_stamp.binary_search_by_key(&stamp, |sample| sample.stamp) else { return };
        let live = by_stamp[found];
        let (point, heading_variances) = difference(live, stamp, state, node);
        all.note(&point, heading_variances);
        horizontal_m.push((stamp, point.horizontal_m));
        if let Some(place) = modes.iter().position(|mode| *mode == live.mode) {
            parts[place].note(&point, heading_variances);
        }
        if compared % stretch == 0 {
            points.push(point);
        } else if let Some(last) = points.last_mut().filter(|last| point.horizontal_m > last.horizontal_m) {
            *last = point;
        }
        compared += 1;
    });
    let parts = modes.into_iter().zip(parts).filter_map(|(mode, sums)| sums.part(mode.name()));
    Gain {
        compared: compared as u64,
        without_smoothed: (live.len() - compared.min(live.len())) as u64,
        parts: all.part("all").into_iter().chain(parts).collect(),
        points,
        horizontal_m,
    }
}

fn difference(live: &LiveSample, stamp: Stamp, state: &NavState, node: &SmoothedNode) -> (Point, [f64; 2]) {
    let apart = live.state.translation - state.position;
    let turned: So3 = live.state.rotation * state.rotation.inverse();
    let up: Vec3 = node.state.rotation.inverse() * Vec3::z();
    let heading_variance = up.dot(&(node.covariance.fixed_view::<3, 3>(0, 0) * up)).max(0.0);
    let horizontal = |x: f64, y: f64| libm::hypot(x, y);
    let point = Point {
        t_s: stamp.as_seconds(),
        horizontal_m: horizontal(apart.x, apart.y),
        vertical_m: apart.z,
        heading_deg: turned.log().z.to_degrees(),
        live_sigma_m: horizontal(live.position_sigma_m[0], live.position_sigma_m[1]),
        smoothed_sigma_m: (node.covariance[(3, 3)] + node.covariance[(4, 4)]).max(0.0).sqrt(),
    };
    (point, [live.heading_sigma.powi(2), heading_variance])
}
