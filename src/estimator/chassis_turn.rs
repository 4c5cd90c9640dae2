//! The chassis' gyroscope, a second opinion on the heading.
//!
//! Its bias walks on its own. Seen through the encoder, the turns of both gyroscopes are the same, so an outage's
//! heading rests on the mean of two walks. With fixes, the antennas teach both biases.

use crate::lie::So3;
use crate::preintegration::SampleBuffer;
use crate::sensors::ImuSample;
use crate::time::{Span, Stamp};

/// Between samples further apart, nobody knows how the chassis turned.
const GAP_MAX: Span = Span::from_millis(100);
/// Samples are kept so long: the window, what is late, and a silence of the cabin's IMU.
pub(super) const KEPT: Span = Span::from_millis(15_000);
/// A cabin that turned less is held by its brake, rad: a step and a half of a usual encoder.
const HELD_MAX: f64 = 1.2e-3;
/// What the encoder adds to one link, one sigma, rad: with the cabin held, and with steps and play at both ends.
const ENCODER_SIGMA: [f64; 2] = [1.0e-4, 4.0e-4];

/// Follows the chassis IMU.
#[derive(Debug, Default)]
pub(super) struct ChassisTurn {
    /// In the chassis' frame.
    samples: SampleBuffer,
    /// The newer node of the newest link.
    pub tied: Option<Stamp>,
}

impl ChassisTurn {
    /// Takes a sample of the chassis IMU, its angular rate in the chassis' frame.
    pub fn push_sample(&mut self, sample: ImuSample) {
        let goes_on =
            |newest: &ImuSample| newest.stamp < sample.stamp && sample.stamp - newest.stamp <= GAP_MAX;
        if !self.samples.newest().is_none_or(goes_on) {
            self.samples.clear();
            self.tied = None;
        }
        self.samples.push(sample);
        self.samples.forget_before(sample.stamp - KEPT);
    }

    /// Since when and until when the turn is known without a gap.
    pub fn covered(&self) -> Option<(Stamp, Stamp)> {
        Some((self.samples.oldest()?.stamp, self.samples.newest()?.stamp))
    }

    /// `base_from_base` from one stamp to another by the gyroscope, less `bias` (rad/s) about the vertical.
    pub fn turned(&self, from: Stamp, to: Stamp, bias: f64) -> Option<So3> {
        let steps = self.samples.steps(from, to)?;
        Some(steps.fold(So3::identity(), |turn, step| {
            let mut rate = step.angular_rate;
            rate.z -= bias;
            turn.plus(&(rate * step.span_s)).renormalized()
        }))
    }
}

/// One sigma (rad) of a link of `span_s` over which the cabin turned by `turn` (rad): white noise of the gyroscope
/// (rad/s/√Hz) and the encoder at both ends.
pub(super) fn sigma(gyroscope_noise_density: f64, span_s: f64, turn: f64) -> f64 {
    let encoder = ENCODER_SIGMA[usize::from(turn.abs() > HELD_MAX)];
    libm::hypot(gyroscope_noise_density * span_s.sqrt(), encoder)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lie::Vec3;

    #[test]
    fn held_cabin_leaves_the_gyroscope_alone() {
        let held = sigma(1.6e-4, 1.0, 0.0);
        let turned = sigma(1.6e-4, 1.0, 0.5);
        assert!(held < 2.0e-4 && turned > 4.0e-4, "{held} {turned}");
    }

    #[test]
    fn turn_is_the_integral_of_the_rate_less_bias_and_a_gap_forgets() {
        let mut chassis = ChassisTurn::default();
        let at = |millis: i64| Stamp::from_nanos(millis * 1_000_000);
        let push = |chassis: &mut ChassisTurn, millis: i64| {
            let angular_rate = Vec3::new(0.0, 0.0, 0.2);
            chassis.push_sample(ImuSample { stamp: at(millis), angular_rate, specific_force: Vec3::zeros() });
        };
        (0..=100).for_each(|index| push(&mut chassis, 10 * index));
        let turn = chassis.turned(at(105), at(905), 0.05).expect("covered");
        assert!((turn.log() - Vec3::z() * 0.12).norm() < 1e-12);
        push(&mut chassis, 1_300);
        assert!(chassis.turned(at(905), at(1_300), 0.0).is_none());
    }
}
