//! The GNSS receiver: RTK fixes while the sky is open, and what happens when it is not.

use super::dice::Dice;
use super::motion::Bodies;
use super::scenario::GnssConditionKind;
use super::sensor::Source;
use super::specification::Gnss;
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
    /// How far off confident and wrong fixes are, least and most, m.
    pub offset_m: Option<[f64; 2]>,
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

    /// Consecutive intervals from 0 to `end`: `good` or what is wrong.
    pub(super) fn conditions(&self, end: Stamp) -> Vec<(Stamp, Stamp, &'static str)> {
        let mut edges = vec![Stamp::default(), end];
        let mut round = Span::default();
        loop {
            for edge in self.intervals.iter().flat_map(|interval| [interval.start, interval.end]) {
                // What lies after the end of a round is never reached.
                let edge = self.period.map_or(edge, |period| edge.min(Stamp::default() + period));
                edges.push((edge + round).min(end));
            }
            let Some(period) = self.period else { break };
            round = Span::from_nanos(round.as_nanos() + period.as_nanos());
            if Stamp::default() + round >= end {
                break;
            }
            edges.push(Stamp::default() + round);
        }
        edges.sort();
        edges.dedup();
        let mut conditions: Vec<(Stamp, Stamp, &'static str)> = Vec::new();
        for pair in edges.windows(2) {
            let name = self.at(pair[0]).map_or("good", |(_, interval, _)| interval.kind.name());
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
            0.5 - 0.5 * libm::cos(std::f64::consts::TAU * stamp.seconds_since(interval.start) / period_s)
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
    /// Of unit variance, remembers for the specification's time.
    slow: Vec3,
    slow_dice: Dice,
    last_stamp: Option<Stamp>,
    /// Error of confident fixes in each interval, m.
    offsets: Vec<Vec3>,
    dice: Dice,
}

impl AntennaSource {
    /// `offsets` gives the direction of confident errors, `noise` what is new in each fix, and what is slow.
    pub(super) fn new(
        side: Side,
        cabin_from_antenna: Se3,
        site: SiteFrame,
        specification: Gnss,
        receiver: Receiver,
        mut offsets: Dice,
        [mut dice, mut slow_dice]: [Dice; 2],
    ) -> Self {
        let mut offset = |interval: &Interval| {
            let [least_m, most_m] = interval.offset_m.unwrap_or(CONFIDENT_OFFSET_M);
            let heading = offsets.uniform(0.0, std::f64::consts::TAU);
            let size_m = offsets.uniform(least_m, most_m);
            let up = offsets.uniform(-0.5, 0.5);
            Vec3::new(libm::cos(heading), libm::sin(heading), up).normalize() * size_m
        };
        let offsets = receiver.sky.intervals.iter().map(&mut offset).collect();
        let wander = dice.normals();
        Self {
            side,
            cabin_from_antenna,
            site,
            specification,
            receiver,
            wander,
            slow: slow_dice.normals(),
            slow_dice,
            last_stamp: None,
            offsets,
            dice,
        }
    }
}

impl Source for AntennaSource {
    fn read(&mut self, stamp: Stamp, bodies: &Bodies) -> Option<Reading> {
        let white = self.dice.normals();
        let drive = self.dice.normals();
        let step_s = self.last_stamp.map_or(0.0, |last| stamp.seconds_since(last));
        self.last_stamp = Some(stamp);
        let remember = |process: &Vec3, drive: &Vec3, time_s: f64| {
            let memory = libm::exp(-step_s / time_s);
            process * memory + drive * (1.0 - memory * memory).sqrt()
        };
        self.wander = remember(&self.wander, &drive, WANDER_TIME_S);
        self.slow = remember(&self.slow, &self.slow_dice.normals(), self.specification.slow_time_s);
        let usual = Vec3::from_row_slice(&self.specification.sigma_enu_m);
        let slow = Vec3::from_row_slice(&self.specification.slow_sigma_enu_m);
        let whole = usual.zip_map(&slow, libm::hypot) * self.specification.reported_sigma_scale;
        let (error, sigma_enu_m) = match self.receiver.solution(stamp) {
            Solution::Missing => return None,
            Solution::Fixed { extra } => {
                let error = white.component_mul(&usual) + self.slow.component_mul(&slow);
                (error * (1.0 + extra), whole * (1.0 + extra))
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
