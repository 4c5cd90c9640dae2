//! Which fixes the filters believe.
//!
//! A fix is left out if its reported sigmas are over the machine's `gnss.sigma_max_m`. Where innovations are judged, it is
//! also left out if its innovation is beyond the 99.9 % bound of the chi-square distribution; fixes that are left out for
//! that for longer than [`CONTRADICTION_MAX`] are right, and are believed until one agrees again: a filter that has
//! gone astray would else never come back.

use crate::estimator::GateOptions;
use crate::frames::geodesy::SiteFrame;
use crate::lie::{Mat3, Vec3};
use crate::sensors::GnssFix;
use crate::time::{Span, Stamp};

/// 99.9 % of the squares of three normal numbers' sums are smaller.
const LIMIT: f64 = 16.27;
/// As long as our own estimator takes multipath to last at most.
const CONTRADICTION_MAX: Span = Span::from_millis(8_000);
/// Without a fix for so long, the estimate rests on something else.
const TRUST_LASTS: Span = Span::from_millis(1_000);

/// A fix as a filter uses it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Fix {
    pub stamp: Stamp,
    /// The antenna in the world, m.
    pub measured: Vec3,
    /// The antenna in the IMU frame, m.
    pub lever_arm: Vec3,
    /// m, not below the machine's floor.
    pub sigma: Vec3,
}

#[derive(Clone, Debug, Default)]
pub(super) struct FixGate {
    contradicted_since: Option<Stamp>,
    last_used: Option<Stamp>,
}

impl FixGate {
    /// What a fix amounts to, unless the receiver itself says that it is bad.
    pub fn read(
        options: &GateOptions,
        site: &SiteFrame,
        fix: &GnssFix,
        lever_arm: Vec3,
    ) -> Result<Fix, String> {
        let reported = fix.sigma_enu_m;
        let worst = reported.x.max(reported.y).max(0.5 * reported.z);
        if worst > options.sigma_max_m {
            return Err(format!("reported sigma {worst:.3} m is over {} m", options.sigma_max_m));
        }
        Ok(Fix {
            stamp: fix.stamp,
            measured: site.to_enu(fix.position),
            lever_arm,
            sigma: reported.map(|sigma| sigma.max(options.sigma_floor_m)),
        })
    }

    /// Whether a fix may be used, given its innovation (m) and the innovation's covariance (m²).
    pub fn judge(&mut self, stamp: Stamp, innovation: &Vec3, covariance: &Mat3) -> Result<(), String> {
        let solved = covariance.cholesky().map(|factor| factor.solve(innovation));
        let squared = solved.map_or(f64::INFINITY, |solved| innovation.dot(&solved));
        if squared <= LIMIT {
            self.contradicted_since = None;
        } else {
            let since = *self.contradicted_since.get_or_insert(stamp);
            if stamp - since < CONTRADICTION_MAX {
                return Err(format!("squared innovation {squared:.1} is over {LIMIT}"));
            }
        }
        self.note_used(stamp);
        Ok(())
    }

    /// A fix is used.
    pub fn note_used(&mut self, stamp: Stamp) {
        self.last_used = Some(self.last_used.map_or(stamp, |last| last.max(stamp)));
    }

    /// Whether fixes are in use.
    pub fn trusts(&self, now: Stamp) -> bool {
        self.last_used.is_some_and(|last| now - last <= TRUST_LASTS)
    }
}
