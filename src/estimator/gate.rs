//! The gate: which fixes are believed.
//!
//! ```text
//!              bad fixes in a row, or silence
//!   trusted ───────────────────────────────────▶ lost (degraded, jumping, frozen, silent)
//!      ▲                                            │ good fix
//!      │ `fixes_to_return` good fixes in a row      ▼
//!      └────────────────────────────────────── recovering ──▶ lost on a bad fix
//! ```
//! A single bad fix is left out without loss of trust. While trust is lost no fix is used; fixes that agree
//! with each other, report small sigmas and imply a possible speed bring it back, also if they contradict the
//! estimate: then the estimate was wrong.

use crate::lie::{Mat3, Vec3};
use crate::state::GnssState;
use crate::time::{Span, Stamp};

/// Chi-square with 3 degrees of freedom, passed by 1 in 10 000 good fixes.
const INNOVATION_LIMIT: f64 = 21.1;
/// So many bad fixes in a row are a loss.
const BAD_IN_A_ROW: u32 = 3;
/// Without fixes for so long, GNSS is silent.
const SILENCE: Span = Span::from_millis(1_000);
/// A position that stays the same to the bit while the machine moves so far is frozen, m.
const FROZEN_TRAVEL_M: f64 = 0.3;

/// Settings of the gate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Reported sigmas below it are raised to it, m.
    pub sigma_floor_m: f64,
    /// Reported sigmas above it are refused, m.
    pub sigma_max_m: f64,
    /// m/s.
    pub speed_max: f64,
    /// Good fixes in a row that end an outage.
    pub fixes_to_return: u32,
}

/// A fix as the gate sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    pub stamp: Stamp,
    /// Antenna in the world, m.
    pub position: Vec3,
    /// As reported, m.
    pub sigma: Vec3,
    /// Where the estimate expects the antenna, and the covariance of that, m and m².
    pub expected: Vec3,
    pub expected_covariance: Mat3,
}

/// What the gate says of a fix.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Judgement {
    /// Whether it goes into the graph.
    pub used: bool,
    /// Why it was found bad.
    pub refusal: Option<String>,
    /// Squared innovation over its limit; over 1 is a contradiction.
    pub test_ratio: f64,
    /// Trust was lost or came back with this fix.
    pub turn: Option<Turn>,
}

/// The two ways through the diagram that others act on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Turn {
    /// Since the stamp of the last fix used.
    Lost { since: Stamp },
    /// With this fix.
    Recovered,
}

#[derive(Clone, Debug)]
pub(super) struct Gate {
    options: Options,
    state: GnssState,
    trusted: bool,
    good_in_row: u32,
    bad_in_row: u32,
    last_used: Option<Stamp>,
    last_heard: Option<Stamp>,
    previous: Option<Candidate>,
    /// Where the estimate was when the position began to be the same to the bit.
    same_since: Option<(Vec3, Vec3)>,
}

impl Gate {
    pub fn new(options: Options) -> Self {
        Self {
            options,
            state: GnssState::Silent,
            trusted: false,
            good_in_row: 0,
            bad_in_row: 0,
            last_used: None,
            last_heard: None,
            previous: None,
            same_since: None,
        }
    }

    /// The estimate has just started from fixes up to `stamp`, which are thereby believed.
    pub fn begin_trusted(&mut self, stamp: Stamp) {
        self.trusted = true;
        self.state = GnssState::Fixed;
        self.last_used = Some(stamp);
        self.last_heard = Some(stamp);
    }

    pub fn state(&self) -> GnssState {
        self.state
    }

    pub fn trusted(&self) -> bool {
        self.trusted
    }

    /// Sigma to use for a fix: the reported one, not under the floor.
    pub fn usable_sigma(&self, reported: &Vec3) -> Vec3 {
        reported.map(|sigma| sigma.max(self.options.sigma_floor_m))
    }

    /// Why the reported sigmas are too large, if they are.
    pub fn sigma_refusal(&self, reported: &Vec3) -> Option<String> {
        let worst = reported.x.max(reported.y).max(0.5 * reported.z);
        let limit = self.options.sigma_max_m;
        (worst > limit).then(|| format!("reported sigma {worst:.3} m is over {limit} m"))
    }

    /// Squared, normalized innovation over its limit.
    pub fn test_ratio(&self, candidate: &Candidate) -> f64 {
        let sigma = self.usable_sigma(&candidate.sigma);
        let covariance = candidate.expected_covariance + Mat3::from_diagonal(&sigma.component_mul(&sigma));
        let innovation = candidate.position - candidate.expected;
        let solved = covariance.cholesky().map(|factor| factor.solve(&innovation));
        solved.map_or(f64::INFINITY, |solved| innovation.dot(&solved) / INNOVATION_LIMIT)
    }

    /// Judges the fix of the left antenna.
    pub fn judge(&mut self, candidate: Candidate) -> Judgement {
        self.last_heard = Some(candidate.stamp);
        let test_ratio = self.test_ratio(&candidate);
        let (cause, refusal) = match self.find_fault(&candidate, test_ratio) {
            Some((cause, reason)) => (Some(cause), Some(reason)),
            None => (None, None),
        };
        let turn = match cause {
            Some(cause) => self.note_bad(cause, candidate.stamp),
            None => self.note_good(),
        };
        self.previous = Some(candidate);
        let used = cause.is_none() && self.trusted;
        if used {
            self.last_used = Some(candidate.stamp);
        }
        Judgement { used, refusal, test_ratio, turn }
    }

    fn find_fault(&mut self, candidate: &Candidate, test_ratio: f64) -> Option<(GnssState, String)> {
        if let Some(reason) = self.sigma_refusal(&candidate.sigma) {
            return Some((GnssState::Degraded, reason));
        }
        if let Some(travelled) = self.frozen_for(candidate) {
            let reason = format!("position has not changed while the machine moved {travelled:.2} m");
            return Some((GnssState::Frozen, reason));
        }
        if let Some(previous) = &self.previous {
            let elapsed = candidate.stamp.seconds_since(previous.stamp);
            let moved = (candidate.position - previous.position).norm();
            let noise = 5.0 * (candidate.sigma.norm() + previous.sigma.norm()).max(0.01);
            if moved > self.options.speed_max * elapsed + noise {
                let reason = format!("moved {moved:.2} m in {elapsed:.2} s");
                return Some((GnssState::Jumping, reason));
            }
        }
        // While trust is lost, fixes have to agree with each other, not with an estimate that may have drifted.
        if self.trusted && test_ratio > 1.0 {
            let off = (candidate.position - candidate.expected).norm();
            let reason = format!("is {off:.2} m from where it is expected, {test_ratio:.1} times the limit");
            return Some((GnssState::Jumping, reason));
        }
        None
    }

    /// How far the machine went while the position stayed the same to the bit, if that is too far.
    fn frozen_for(&mut self, candidate: &Candidate) -> Option<f64> {
        let (position, expected) = *self.same_since.get_or_insert((candidate.position, candidate.expected));
        if position != candidate.position {
            self.same_since = Some((candidate.position, candidate.expected));
            return None;
        }
        let travelled = (candidate.expected - expected).norm();
        (travelled > FROZEN_TRAVEL_M).then_some(travelled)
    }

    fn note_bad(&mut self, cause: GnssState, stamp: Stamp) -> Option<Turn> {
        self.good_in_row = 0;
        self.bad_in_row += 1;
        if self.trusted {
            return (self.bad_in_row >= BAD_IN_A_ROW).then(|| self.lose(cause, stamp));
        }
        self.state = cause;
        None
    }

    fn note_good(&mut self) -> Option<Turn> {
        self.bad_in_row = 0;
        if self.trusted {
            self.state = GnssState::Fixed;
            return None;
        }
        self.good_in_row += 1;
        self.state = GnssState::Recovering;
        if self.good_in_row < self.options.fixes_to_return {
            return None;
        }
        self.trusted = true;
        self.state = GnssState::Fixed;
        Some(Turn::Recovered)
    }

    fn lose(&mut self, cause: GnssState, stamp: Stamp) -> Turn {
        self.trusted = false;
        self.good_in_row = 0;
        self.state = cause;
        Turn::Lost { since: self.last_used.unwrap_or(stamp) }
    }

    /// Looks at the clock of the readings: nothing heard for long is a loss too.
    pub fn notice_silence(&mut self, now: Stamp) -> Option<Turn> {
        let heard = self.last_heard?;
        if now - heard <= SILENCE || self.state == GnssState::Silent {
            return None;
        }
        self.previous = None;
        let was_trusted = self.trusted;
        let turn = self.lose(GnssState::Silent, now);
        was_trusted.then_some(turn)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OPTIONS: Options =
        Options { sigma_floor_m: 0.005, sigma_max_m: 0.2, speed_max: 5.0, fixes_to_return: 10 };

    fn candidate(index: i64, position: Vec3, sigma_m: f64) -> Candidate {
        Candidate {
            stamp: Stamp::from_nanos(index * 50_000_000),
            position,
            sigma: Vec3::repeat(sigma_m),
            expected: Vec3::zeros(),
            expected_covariance: Mat3::identity() * 1e-4,
        }
    }

    /// A position that is never the same to the bit.
    fn near(index: i64, offset: f64) -> Vec3 {
        Vec3::new(offset, 1e-4 * index as f64, 0.0)
    }

    fn trusted() -> Gate {
        let mut gate = Gate::new(OPTIONS);
        gate.begin_trusted(Stamp::from_nanos(-1));
        gate
    }

    #[test]
    fn good_fixes_pass_and_one_outlier_costs_no_trust() {
        let mut gate = trusted();
        assert!(gate.judge(candidate(0, near(0, 0.0), 0.01)).used);
        let judgement = gate.judge(candidate(1, near(1, 0.2), 0.01));
        assert!(!judgement.used && judgement.refusal.is_some() && judgement.test_ratio > 1.0);
        assert!(gate.judge(candidate(2, near(2, 0.0), 0.01)).used);
        assert_eq!(gate.state(), GnssState::Fixed);
    }

    #[test]
    fn reported_sigma_over_the_limit_loses_trust_and_ten_good_fixes_bring_it_back() {
        let mut gate = trusted();
        gate.judge(candidate(0, near(0, 0.0), 0.01));
        let turns: Vec<_> = (1..=5).map(|k| gate.judge(candidate(k, near(k, 0.1), 0.5)).turn).collect();
        assert_eq!(turns[2], Some(Turn::Lost { since: Stamp::from_nanos(0) }));
        assert_eq!(turns.iter().flatten().count(), 1);
        assert_eq!(gate.state(), GnssState::Degraded);
        let used: Vec<_> = (6..=16).map(|k| gate.judge(candidate(k, near(k, 0.1), 0.01)).used).collect();
        assert_eq!(used.iter().position(|used| *used), Some(9));
    }

    #[test]
    fn bad_fix_in_between_starts_the_count_anew() {
        let mut gate = trusted();
        gate.notice_silence(Stamp::from_nanos(5_000_000_000));
        (200..209).for_each(|k| assert!(!gate.judge(candidate(k, near(k, 0.0), 0.01)).used));
        gate.judge(candidate(209, near(209, 0.0), 0.5));
        assert_eq!(gate.state(), GnssState::Degraded);
        let used: Vec<_> = (210..220).map(|k| gate.judge(candidate(k, near(k, 0.0), 0.01)).used).collect();
        assert_eq!(used.iter().position(|used| *used), Some(9));
    }

    #[test]
    fn silence_and_frozen_positions_are_found() {
        let mut gate = trusted();
        gate.judge(candidate(0, near(0, 0.0), 0.01));
        assert_eq!(gate.notice_silence(Stamp::from_nanos(900_000_000)), None);
        let lost = gate.notice_silence(Stamp::from_nanos(1_100_000_000));
        assert_eq!(lost, Some(Turn::Lost { since: Stamp::from_nanos(0) }));
        assert_eq!(gate.notice_silence(Stamp::from_nanos(1_200_000_000)), None);

        let mut gate = trusted();
        for k in 0..100 {
            let moving =
                Candidate { expected: Vec3::x() * 0.01 * k as f64, ..candidate(k, Vec3::zeros(), 0.01) };
            gate.judge(Candidate { expected_covariance: Mat3::identity(), ..moving });
        }
        assert_eq!(gate.state(), GnssState::Frozen);
        assert!(!gate.trusted());
    }

    #[test]
    fn impossible_speed_is_refused() {
        let mut gate = trusted();
        let loose = |k: i64, offset: f64| Candidate {
            expected_covariance: Mat3::identity() * 100.0,
            ..candidate(k, near(k, offset), 0.01)
        };
        gate.judge(loose(0, 0.0));
        let judgement = gate.judge(loose(1, 2.0));
        assert!(judgement.refusal.expect("refused").contains("moved 2.00 m"));
    }
}
