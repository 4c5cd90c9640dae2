//! The gate: which fixes are believed.
//!
//! ```text
//!              bad fixes in a row, or silence
//!   trusted ───────────────────────────────────▶ lost (degraded, jumping, frozen, silent)
//!      ▲                                            │ good fix
//!      │ `fixes_to_return` good fixes in a row      ▼
//!      └────────────────────────────────────── recovering ──▶ lost on a bad fix
//! ```
//! A single bad fix is left out without loss of trust. While trust is lost no fix is used. Fixes that report
//! small sigmas, imply a possible speed and agree with the estimate, whose covariance has grown meanwhile, bring
//! it back. Fixes that agree with each other but not with the estimate are multipath, which lasts seconds; if
//! they go on for longer than that, the estimate was wrong, and they are believed.

use super::inflation::Inflation;
use crate::lie::{Mat3, Vec3};
use crate::state::GnssState;
use crate::time::{Span, Stamp};

/// Squared innovation (3 degrees of freedom) that is refused: about 7 sigmas along one axis. What is less far
/// off is left to the robust loss, since vibration and stamps have heavier tails than their sigmas say.
const INNOVATION_LIMIT: f64 = 50.0;
/// Squared innovation up to which a fix agrees with the estimate while trust is lost: 1 in 100 good fixes is
/// further off, and its return only takes longer.
const RETURN_LIMIT: f64 = 11.3;
/// Multipath that lasts is further off than this, m. A fix that is nearer agrees up to a larger squared innovation:
/// all fixes share the estimate's error, and one outage in a hundred ends more than three sigmas off.
const NEAR_M: f64 = 0.15;
const NEAR_LIMIT: f64 = 30.0;
/// Multipath is over after so long; fixes that contradict the estimate for longer are right.
const CONTRADICTION_MAX: Span = Span::from_millis(8_000);
/// Error of a fix with fixed ambiguities that is new in each fix, at most, m.
const WHITE_SIGMA_M: f64 = 0.02;
/// A sigma up to so many times the receiver's usual one is usual too.
const USUAL_SIGMA: f64 = 1.3;
/// The usual sigma rises to a larger one in about so long, s; it falls at once.
const USUAL_RISES_S: f64 = 60.0;
/// Slow errors of fixes stay alike for about so long, s.
const CORRELATION_S: f64 = 3.0;
/// So many good fixes in a row are worth telling.
const GOOD_TO_TELL: u32 = 3;
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
    /// Part of every fix's error that changes slowly and that no fix reports, one sigma, m; and how slowly, s.
    pub slow_sigma_m: f64,
    /// Time over which the slow part stays alike, s.
    pub slow_time_s: f64,
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
    /// It is where the estimate expects it.
    pub agrees: bool,
    /// While trust is lost: it is one of several good fixes in a row that agree with the estimate.
    pub on_trial: bool,
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
    /// While lost: since when fixes agree with each other against the estimate.
    contradicting_since: Option<Stamp>,
    last_used: Option<Stamp>,
    last_heard: Option<Stamp>,
    period_s: f64,
    inflation: Inflation,
    /// What the receiver reports of its good fixes, m.
    usual_sigma: Option<Vec3>,
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
            contradicting_since: None,
            last_used: None,
            last_heard: None,
            period_s: 0.05,
            inflation: Inflation::default(),
            usual_sigma: None,
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

    /// The reported sigma, not under the floor.
    fn floored(&self, reported: &Vec3) -> Vec3 {
        reported.map(|sigma| sigma.max(self.options.sigma_floor_m))
    }

    /// Sigma of one fix by itself: as much larger than reported as innovations have shown.
    fn single_sigma(&self, reported: &Vec3) -> Vec3 {
        self.floored(reported).component_mul(&self.inflation.factors())
    }

    /// What reported sigmas are multiplied by now: east, north, up.
    pub fn inflation(&self) -> Vec3 {
        self.inflation.factors()
    }

    /// Sigma to use for a fix among its neighbours. With fixed ambiguities the error is close to white, and as large
    /// as usual. What the receiver reports beyond that comes from multipath and float ambiguities, which change
    /// slowly: n fixes in one correlation time say no more than one, so that part of the variance is n times as large.
    pub fn usable_sigma(&self, reported: &Vec3) -> Vec3 {
        let alike = 1.0 + 2.0 * CORRELATION_S / self.period_s.max(1.0e-3);
        let reported = self.floored(reported);
        let usual = self.usual_sigma.unwrap_or(reported);
        let usable = reported.zip_map(&usual, |sigma, usual| {
            let white = sigma.min(WHITE_SIGMA_M.min(USUAL_SIGMA * usual));
            (white * white + (sigma * sigma - white * white) * alike).sqrt()
        });
        // A slow part that the configuration knows of (a first-order Gauss-Markov process of time constant τ): seen
        // n = 1 + 2 τ / T times in its own time, it must weigh as one.
        let slow_alike = 1.0 + 2.0 * self.options.slow_time_s / self.period_s.max(1.0e-3);
        let slow = self.options.slow_sigma_m * slow_alike.sqrt();
        usable.component_mul(&self.inflation.factors()).map(|sigma| libm::hypot(sigma, slow))
    }

    /// Why the reported sigmas are too large, if they are.
    pub fn sigma_refusal(&self, reported: &Vec3) -> Option<String> {
        let worst = reported.x.max(reported.y).max(0.5 * reported.z);
        let limit = self.options.sigma_max_m;
        (worst > limit).then(|| format!("reported sigma {worst:.3} m is over {limit} m"))
    }

    /// Squared, normalized innovation over its limit.
    pub fn test_ratio(&self, candidate: &Candidate) -> f64 {
        let sigma = self.single_sigma(&candidate.sigma);
        let covariance = candidate.expected_covariance + Mat3::from_diagonal(&sigma.component_mul(&sigma));
        let innovation = candidate.position - candidate.expected;
        let solved = covariance.cholesky().map(|factor| factor.solve(&innovation));
        solved.map_or(f64::INFINITY, |solved| innovation.dot(&solved) / INNOVATION_LIMIT)
    }

    /// Test ratio up to which a fix agrees with the estimate.
    fn ratio_limit(&self, candidate: &Candidate) -> f64 {
        if self.trusted {
            1.0
        } else if (candidate.position - candidate.expected).norm() < NEAR_M {
            NEAR_LIMIT / INNOVATION_LIMIT
        } else {
            RETURN_LIMIT / INNOVATION_LIMIT
        }
    }

    /// Judges the fix of the left antenna.
    pub fn judge(&mut self, candidate: Candidate) -> Judgement {
        if let Some(heard) = self.last_heard {
            // Bounded: a fix after a silence is not a change of the receiver's rate.
            self.period_s += 0.1 * (candidate.stamp.seconds_since(heard).clamp(0.01, 1.0) - self.period_s);
        }
        self.last_heard = Some(candidate.stamp);
        let test_ratio = self.test_ratio(&candidate);
        let agrees = test_ratio <= self.ratio_limit(&candidate);
        let (cause, refusal) = self.find_fault(&candidate, test_ratio).unzip();
        let turn = match cause {
            Some(cause) => self.note_bad(cause, candidate.stamp),
            None => self.note_good(),
        };
        self.previous = Some(candidate);
        let used = cause.is_none() && self.trusted;
        if used {
            self.last_used = Some(candidate.stamp);
            let innovation = candidate.position - candidate.expected;
            let expected_variance = candidate.expected_covariance.diagonal();
            let sigma = self.floored(&candidate.sigma);
            let rise = self.period_s / USUAL_RISES_S;
            let follow = |usual: f64, sigma: f64| sigma.min(usual + (sigma - usual) * rise);
            self.usual_sigma = Some(self.usual_sigma.map_or(sigma, |usual| usual.zip_map(&sigma, follow)));
            self.inflation.note(candidate.stamp, &innovation, &expected_variance, &sigma);
        }
        let on_trial = cause.is_none() && !self.trusted && agrees && self.good_in_row >= GOOD_TO_TELL;
        Judgement { used, refusal, test_ratio, agrees, on_trial, turn }
    }

    fn find_fault(&mut self, candidate: &Candidate, test_ratio: f64) -> Option<(GnssState, String)> {
        let contradicting_since = self.contradicting_since.take();
        if let Some(reason) = self.sigma_refusal(&candidate.sigma) {
            return Some((GnssState::Degraded, reason));
        }
        if let Some(travelled) = self.frozen_for(candidate) {
            let reason = format!("position has not changed while the machine moved {travelled:.2} m");
            return Some((GnssState::Frozen, reason));
        }
        if let Some(reason) = self.too_fast(candidate) {
            return Some((GnssState::Jumping, reason));
        }
        let limit = self.ratio_limit(candidate);
        if test_ratio <= limit {
            // Some that agree by chance do not end a contradiction; the return of trust does.
            self.contradicting_since = contradicting_since;
            return None;
        }
        if !self.trusted {
            let since = contradicting_since.unwrap_or(candidate.stamp);
            self.contradicting_since = Some(since);
            if candidate.stamp - since > CONTRADICTION_MAX {
                return None;
            }
        }
        let off = (candidate.position - candidate.expected).norm();
        let reason =
            format!("is {off:.2} m from where it is expected, {:.1} times the limit", test_ratio / limit);
        Some((GnssState::Jumping, reason))
    }

    fn too_fast(&self, candidate: &Candidate) -> Option<String> {
        let previous = self.previous.as_ref()?;
        let elapsed = candidate.stamp.seconds_since(previous.stamp);
        let moved = (candidate.position - previous.position).norm();
        let noise = 5.0 * (candidate.sigma.norm() + previous.sigma.norm()).max(0.01);
        (moved > self.options.speed_max * elapsed + noise)
            .then(|| format!("moved {moved:.2} m in {elapsed:.2} s"))
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
        if self.good_in_row >= GOOD_TO_TELL.min(self.options.fixes_to_return) {
            self.state = GnssState::Recovering;
        }
        if self.good_in_row < self.options.fixes_to_return {
            return None;
        }
        self.trusted = true;
        self.contradicting_since = None;
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

    const OPTIONS: Options = Options {
        sigma_floor_m: 0.005,
        sigma_max_m: 0.2,
        slow_sigma_m: 0.0,
        slow_time_s: 10.0,
        speed_max: 5.0,
        fixes_to_return: 10,
    };

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
        let turns: Vec<_> = (1..=5).map(|k| gate.judge(candidate(k, near(k, 0.04), 0.5)).turn).collect();
        assert_eq!(turns[2], Some(Turn::Lost { since: Stamp::from_nanos(0) }));
        assert_eq!(turns.iter().flatten().count(), 1);
        assert_eq!(gate.state(), GnssState::Degraded);
        let used: Vec<_> = (6..=16).map(|k| gate.judge(candidate(k, near(k, 0.04), 0.01)).used).collect();
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
    fn fixes_that_contradict_the_estimate_are_multipath_for_seconds_and_right_after_that() {
        let mut gate = trusted();
        (0..10).for_each(|k| assert!(gate.judge(candidate(k, near(k, 0.0), 0.01)).used));
        // 0.8 m off for two seconds, with small sigmas: never used, and the good ones after it are.
        (10..50).for_each(|k| assert!(!gate.judge(candidate(k, near(k, 0.8), 0.01)).used));
        let back: Vec<_> = (50..70).map(|k| gate.judge(candidate(k, near(k, 0.0), 0.01)).used).collect();
        assert_eq!(back.iter().position(|used| *used), Some(10), "the first one has jumped back");
        // The same offset for good: the estimate is wrong.
        let offset: Vec<_> = (70..300).map(|k| gate.judge(candidate(k, near(k, 0.8), 0.01)).used).collect();
        let accepted = offset.iter().position(|used| *used).expect("believed in the end");
        assert!((160..190).contains(&accepted), "{accepted}");
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
