//! The left antenna by the estimate, in truth, and by its fixes.

use std::collections::VecDeque;

use crate::lie::{Mat3, Vec3};
use crate::sensors::GnssFix;
use crate::simulate::Truth;
use crate::smoother::predicted_position_covariance;
use crate::state::{Estimate, NavState};
use crate::time::{Span, Stamp};

/// Estimates are kept for fixes on their way, so long.
const KEPT: Span = Span::from_millis(2_000);
/// Estimates further apart are not interpolated, s.
const GAP_MAX_S: f64 = 0.3;
/// Fixes further apart are not one after the other, s.
const FIX_GAP_MAX_S: f64 = 0.2;

/// At one estimate: the antenna by it and in truth, and the covariance of the former.
type Place = (Stamp, [Vec3; 2], Mat3);

#[derive(Default)]
pub(super) struct Antenna {
    recent: VecDeque<Place>,
    /// Fixes that no estimate has come past yet: stamp, place (m), sigma (m).
    waiting: VecDeque<(Stamp, Vec3, Vec3)>,
    /// At the stamp of the newest fix, and the fix.
    at_fix: Option<(Stamp, [Vec3; 2], Vec3)>,
}

/// A fix with the estimate at its stamp, as it was published, that is without that fix.
pub(super) struct Passed {
    pub stamp: Stamp,
    /// (z − p)ᵀ (C + R)⁻¹ (z − p), three degrees of freedom.
    pub squared_innovation: f64,
    /// The motion since the fix before, by the estimate, in truth, and by the fixes.
    pub moved: Option<[Vec3; 3]>,
}

impl Antenna {
    pub fn note(&mut self, estimate: &Estimate, truth: &Truth, lever_arm: &Vec3) {
        let at = |state: &NavState| state.position + state.rotation * *lever_arm;
        let of_pose = estimate.covariance.fixed_view::<6, 6>(0, 0).into_owned();
        let covariance = predicted_position_covariance(&estimate.state, &of_pose, lever_arm);
        self.recent.push_back((estimate.stamp, [at(&estimate.state), at(&truth.state)], covariance));
        while self.recent.front().is_some_and(|(stamp, ..)| estimate.stamp - *stamp > KEPT) {
            self.recent.pop_front();
        }
    }

    pub fn note_fix(&mut self, fix: &GnssFix, place: Vec3) {
        self.waiting.push_back((fix.stamp, place, fix.sigma_enu_m));
    }

    /// The next fix that the estimates have come past.
    pub fn next(&mut self) -> Option<Passed> {
        loop {
            let newest = self.recent.back()?.0;
            let (stamp, fix, sigma) = self.waiting.pop_front_if(|(stamp, ..)| *stamp <= newest)?;
            let Some((at, covariance)) = self.at(stamp) else { continue };
            let innovation = fix - at[0];
            let whole = covariance + Mat3::from_diagonal(&sigma.component_mul(&sigma));
            let solved = whole.cholesky().map(|factor| factor.solve(&innovation));
            let squared_innovation = solved.map_or(f64::NAN, |solved| innovation.dot(&solved));
            let before = self.at_fix.replace((stamp, at, fix));
            let moved = before
                .filter(|(last, ..)| stamp.seconds_since(*last) < FIX_GAP_MAX_S)
                .map(|(_, from, last_fix)| [at[0] - from[0], at[1] - from[1], fix - last_fix]);
            return Some(Passed { stamp, squared_innovation, moved });
        }
    }

    fn at(&self, stamp: Stamp) -> Option<([Vec3; 2], Mat3)> {
        let after = self.recent.partition_point(|(recent, ..)| *recent < stamp);
        let (before, after) = (self.recent.get(after.checked_sub(1)?)?, self.recent.get(after)?);
        let gap_s = after.0.seconds_since(before.0);
        if gap_s > GAP_MAX_S {
            return None;
        }
        let part = stamp.seconds_since(before.0) / gap_s;
        Some((std::array::from_fn(|which| before.1[which].lerp(&after.1[which], part)), after.2))
    }
}
