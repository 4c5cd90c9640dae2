//! The motion behind the newest node, brought forward with every sample: a measurement finds it made but for its
//! last step.

use crate::lie::Vec3;
use crate::preintegration::{ImuNoise, Preintegration, SampleBuffer};
use crate::state::NavState;
use crate::time::Stamp;

/// Samples behind the newest node whose motions are kept: a fifth of a second at 100 Hz. Later ones begin at the last.
const KEPT: usize = 20;

/// The motions from the newest node to each sample after it.
#[derive(Debug, Default)]
pub(super) struct Ahead {
    from: Stamp,
    /// Of the gyroscope and the accelerometer, for which the motions hold.
    biases: [Vec3; 2],
    motions: Vec<(Stamp, Preintegration)>,
}

impl Ahead {
    /// Integrates up to the newest sample from a node, anew if it is another one or its biases have changed.
    pub fn follow(&mut self, from: Stamp, start: &NavState, samples: &SampleBuffer, noise: &ImuNoise) {
        let biases = [start.gyro_bias, start.accel_bias];
        if (self.from, self.biases) != (from, biases) {
            (self.from, self.biases) = (from, biases);
            self.motions.clear();
        }
        self.motions.reserve(KEPT.saturating_sub(self.motions.len()));
        let reached = self.motions.last().map_or(from, |(reached, _)| *reached);
        let Some(newest) = samples.newest().map(|sample| sample.stamp).filter(|newest| *newest > reached)
        else {
            return;
        };
        let Some(steps) = samples.steps(reached, newest) else { return };
        for (step, sample) in steps.zip(samples.after(reached)).take(KEPT - self.motions.len()) {
            let before = self.motions.last().map(|(_, motion)| motion.clone());
            let mut motion = before.unwrap_or_else(|| Preintegration::new(start.gyro_bias, start.accel_bias));
            motion.add(&step, noise);
            self.motions.push((sample.stamp, motion));
        }
    }

    /// The longest motion that is known from a node with these biases and does not go beyond `to`, and how far it
    /// goes.
    pub fn known(&self, from: Stamp, to: Stamp, start: &NavState) -> Option<&(Stamp, Preintegration)> {
        if (self.from, self.biases) != (from, [start.gyro_bias, start.accel_bias]) {
            return None;
        }
        let beyond = self.motions.partition_point(|(stamp, _)| *stamp <= to);
        self.motions.get(beyond.checked_sub(1)?)
    }

    pub fn forget(&mut self) {
        self.motions.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensors::ImuSample;
    use crate::time::Span;

    const NOISE: ImuNoise = ImuNoise::OF_TESTS;

    fn sample(index: i64) -> ImuSample {
        let phase = index as f64;
        ImuSample {
            stamp: Stamp::from_nanos(index * 10_000_000),
            angular_rate: Vec3::new(0.3, -0.2, 0.1) * phase.sin(),
            specific_force: Vec3::new(0.1, 0.2, 9.8) * (1.0 + 0.1 * phase.cos()),
        }
    }

    #[test]
    fn what_was_integrated_ahead_is_what_would_be_integrated_later() {
        let (from, later) = (Stamp::from_nanos(3_000_000), Stamp::from_nanos(52_000_000));
        let start = NavState { gyro_bias: Vec3::new(1e-3, 2e-3, -1e-3), ..NavState::identity() };
        let other = NavState { gyro_bias: Vec3::zeros(), ..start };
        let (mut samples, mut ahead) = (SampleBuffer::default(), Ahead::default());
        for index in 0..40 {
            samples.push(sample(index));
            // At first the node has other biases, and in the end there is another node.
            let state = if index < 4 { &other } else { &start };
            ahead.follow(if index < 30 { from } else { later }, state, &samples, &NOISE);
            let node = if index < 30 { from } else { later };
            let newest = sample(index).stamp;
            if newest <= node {
                assert!(ahead.known(node, newest, state).is_none());
                continue;
            }
            for to in [newest, newest - Span::from_millis(4), newest - Span::from_millis(17)] {
                let Some((reached, known)) = ahead.known(node, to, state) else {
                    assert!(to - node < Span::from_millis(10), "{index}");
                    continue;
                };
                let mut motion = known.clone();
                samples.steps(*reached, to).expect("covered").for_each(|step| motion.add(&step, &NOISE));
                let steps = samples.steps(node, to).expect("covered");
                let whole = Preintegration::of_steps(steps, state.gyro_bias, state.accel_bias, &NOISE);
                assert_eq!(motion, whole, "{index}");
            }
            let wrong = if index < 4 { &start } else { &other };
            assert!(ahead.known(node, newest, wrong).is_none());
            assert!(ahead.motions.len() <= KEPT);
        }
    }
}
