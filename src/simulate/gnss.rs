//! The GNSS receiver: RTK fixes while the sky is open, and what happens when it is not.

use super::dice::Dice;
use super::motion::Bodies;
use super::scenario::{Gnss, GnssConditionKind};
use super::sensor::Source;
use crate::frames::geodesy::SiteFrame;
use crate::lie::{Se3, Vec3};
use crate::sensors::{GnssFix, Reading};
use crate::time::{Span, Stamp};

/// Sigma up against sigma east and north while not fixed.
const VERTICAL_FACTOR: f64 = 1.6;
/// How long the error of a wandering fix lasts, s.
const WANDER_TIME_S: f64 = 5.0;
/// Part of an unreliable interval in which fixes are confident and wrong.
const CONFIDENT_PART: [f64; 2] = [0.55, 0.70];
/// What a confident and wrong fix reports, m.
const CONFIDENT_SIGMA_M: f64 = 0.02;
/// How far it is off, m.
const CONFIDENT_OFFSET_M: [f64; 2] = [0.3, 2.0];

/// A time in which GNSS is not good.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Interval {
    pub start: Stamp,
    pub end: Stamp,
    pub kind: GnssConditionKind,
}

/// The times in which GNSS is not good; they may come again.
#[derive(Clone, Debug, Default)]
pub(super) struct Sky {
    pub intervals: Vec<Interval>,
    pub period: Option<Span>,
}

impl Sky {
    /// The interval that `stamp` is in, which one it is, and how far in it, 0 to 1.
    fn at(&self, stamp: Stamp) -> Option<(usize, Interval, f64)> {
        let nanos = stamp.as_nanos();
        let now = Stamp::from_nanos(self.period.map_or(nanos, |period| nanos.rem_euclid(period.as_nanos())));
        let index = self.intervals.iter().position(|interval| interval.start <= now && now < interval.end)?;
        let interval = self.intervals[index];
        let part = now.seconds_since(interval.start) / interval.end.seconds_since(interval.start);
        Some((index, interval, part))
    }

    /// Consecutive intervals from 0 to `duration_s`: start, end, `good` or what is wrong.
    pub(super) fn conditions(&self, duration_s: f64) -> Vec<(f64, f64, &'static str)> {
        let mut edges = vec![0.0];
        let period_s = self.period.map_or(f64::INFINITY, Span::as_seconds);
        let mut round_s = 0.0;
        while round_s < duration_s {
            edges.push(round_s);
            for interval in &self.intervals {
                let inside = |stamp: Stamp| round_s + stamp.as_seconds().min(period_s);
                edges.extend([inside(interval.start), inside(interval.end)]);
            }
            round_s += period_s;
        }
        edges.retain(|edge_s| *edge_s < duration_s);
        edges.push(duration_s);
        edges.sort_by(f64::total_cmp);
        edges.dedup();
        let mut conditions: Vec<(f64, f64, &'static str)> = Vec::new();
        for pair in edges.windows(2) {
            let middle = Stamp::from_seconds(0.5 * (pair[0] + pair[1]));
            let name = self.at(middle).map_or("good", |(_, interval, _)| interval.kind.name());
            match conditions.last_mut() {
                Some(last) if last.2 == name => last.1 = pair[1],
                _ => conditions.push((pair[0], pair[1], name)),
            }
        }
        conditions
    }
}

/// What the receiver makes of an epoch; the same for both of its antennas.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Solution {
    /// White noise of `1 + extra` times the usual.
    Fixed { extra: f64 },
    /// A wandering error of this sigma, east and north, m.
    Float { sigma_m: f64 },
    /// Off, and does not know; the number of the interval.
    Confident { interval: usize },
    /// Nothing.
    Missing,
}

/// The part of the receiver that both antennas share. Each antenna holds one of its own, with the same
/// generator, and so sees the same.
#[derive(Clone, Debug)]
pub(super) struct Receiver {
    sky: Sky,
    /// Whether it has dropped out, under trees or when unreliable.
    dropped: bool,
    /// Whether the ambiguities are lost, under trees.
    floating: bool,
    last_stamp: Option<Stamp>,
    dice: Dice,
}

impl Receiver {
    pub(super) fn new(sky: Sky, dice: Dice) -> Self {
        Self { sky, dropped: false, floating: true, last_stamp: None, dice }
    }

    fn solution(&mut self, stamp: Stamp) -> Solution {
        let step_s = self.last_stamp.map_or(0.0, |last| stamp.seconds_since(last));
        self.last_stamp = Some(stamp);
        // Always as many draws, so that conditions do not change what comes after them.
        let [drop, float, miss] = [(); 3].map(|()| self.dice.uniform(0.0, 1.0));
        self.dropped = if self.dropped { drop > step_s / 1.2 } else { drop < step_s / 7.0 };
        self.floating = if self.floating { float > step_s / 4.0 } else { float < step_s / 3.0 };
        let Some((index, interval, part)) = self.sky.at(stamp) else {
            return Solution::Fixed { extra: 0.0 };
        };
        let wave = |period_s: f64| {
            0.5 - 0.5 * (std::f64::consts::TAU * stamp.seconds_since(interval.start) / period_s).cos()
        };
        match interval.kind {
            GnssConditionKind::Blocked => Solution::Missing,
            GnssConditionKind::Multipath => Solution::Confident { interval: index },
            GnssConditionKind::Unreliable => {
                if (CONFIDENT_PART[0]..CONFIDENT_PART[1]).contains(&part) {
                    Solution::Confident { interval: index }
                } else if self.dropped || miss < 0.05 {
                    Solution::Missing
                } else {
                    Solution::Float { sigma_m: 0.3 + 0.7 * wave(17.0) }
                }
            }
            GnssConditionKind::Trees => {
                if self.dropped || miss < 0.1 {
                    Solution::Missing
                } else if self.floating {
                    Solution::Float { sigma_m: 0.1 + 0.5 * wave(13.0) }
                } else {
                    Solution::Fixed { extra: 0.8 }
                }
            }
        }
    }
}

/// Which antenna.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Side {
    Left,
    Right,
}

/// One antenna.
pub(super) struct AntennaSource {
    side: Side,
    cabin_from_antenna: Se3,
    site: SiteFrame,
    specification: Gnss,
    receiver: Receiver,
    /// Of unit variance, remembers for [`WANDER_TIME_S`].
    wander: Vec3,
    last_stamp: Option<Stamp>,
    /// Error of confident fixes in each interval, m.
    offsets: Vec<Vec3>,
    dice: Dice,
}

impl AntennaSource {
    /// `offsets` gives the direction of confident errors, `dice` the noise.
    pub(super) fn new(
        side: Side,
        cabin_from_antenna: Se3,
        site: SiteFrame,
        specification: Gnss,
        receiver: Receiver,
        mut offsets: Dice,
        mut dice: Dice,
    ) -> Self {
        let mut offset = || {
            let heading = offsets.uniform(0.0, std::f64::consts::TAU);
            let size_m = offsets.uniform(CONFIDENT_OFFSET_M[0], CONFIDENT_OFFSET_M[1]);
            let up = offsets.uniform(-0.5, 0.5);
            Vec3::new(heading.cos(), heading.sin(), up).normalize() * size_m
        };
        let offsets = receiver.sky.intervals.iter().map(|_| offset()).collect();
        let wander = dice.normals();
        let last_stamp = None;
        Self { side, cabin_from_antenna, site, specification, receiver, wander, last_stamp, offsets, dice }
    }
}

impl Source for AntennaSource {
    fn read(&mut self, stamp: Stamp, bodies: &Bodies) -> Option<Reading> {
        let white = self.dice.normals();
        let drive = self.dice.normals();
        let memory = self.last_stamp.map_or(1.0, |last| (-stamp.seconds_since(last) / WANDER_TIME_S).exp());
        self.wander = self.wander * memory + drive * (1.0 - memory * memory).sqrt();
        self.last_stamp = Some(stamp);
        let usual = Vec3::from_row_slice(&self.specification.sigma_enu_m);
        let (error, sigma_enu_m) = match self.receiver.solution(stamp) {
            Solution::Missing => return None,
            Solution::Fixed { extra } => {
                let sigma = usual * (1.0 + extra);
                (white.component_mul(&sigma), sigma)
            }
            Solution::Float { sigma_m } => {
                let sigma = Vec3::new(sigma_m, sigma_m, VERTICAL_FACTOR * sigma_m);
                (self.wander.component_mul(&sigma) + white.component_mul(&usual), sigma)
            }
            Solution::Confident { interval } => {
                let error = self.offsets[interval] * (1.0 + 0.1 * self.wander.x);
                (error + white.component_mul(&usual), Vec3::repeat(CONFIDENT_SIGMA_M))
            }
        };
        let antenna = bodies.cabin.pose * self.cabin_from_antenna.translation;
        let position = self.site.to_geodetic(&(antenna + error));
        let fix = GnssFix { stamp, position, sigma_enu_m };
        Some(match self.side {
            Side::Left => Reading::GnssLeft(fix),
            Side::Right => Reading::GnssRight(fix),
        })
    }
}
