//! The samples of the window, and the steps between any two stamps in it.

use std::collections::VecDeque;

use crate::lie::Vec3;
use crate::sensors::ImuSample;
use crate::time::Stamp;

/// A stretch of constant angular rate and specific force.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Length, s.
    pub span_s: f64,
    /// rad/s, as measured.
    pub angular_rate: Vec3,
    /// m/s², as measured.
    pub specific_force: Vec3,
    /// How much both readings changed from one end to the other: what lies in between is not known better.
    pub change: [Vec3; 2],
}

impl Step {
    /// From one sample to the next: the mean of both (the trapezoid rule).
    pub fn between(from: &ImuSample, to: &ImuSample) -> Self {
        Self {
            span_s: to.stamp.seconds_since(from.stamp),
            angular_rate: (from.angular_rate + to.angular_rate) * 0.5,
            specific_force: (from.specific_force + to.specific_force) * 0.5,
            change: [to.angular_rate - from.angular_rate, to.specific_force - from.specific_force],
        }
    }
}

/// IMU samples in order of their stamps; what lies between two of them is interpolated linearly.
#[derive(Clone, Debug, Default)]
pub struct SampleBuffer {
    samples: VecDeque<ImuSample>,
}

impl SampleBuffer {
    /// Appends a sample, which must be newer than all others.
    pub fn push(&mut self, sample: ImuSample) {
        debug_assert!(
            self.newest().is_none_or(|newest| newest.stamp < sample.stamp),
            "samples come in order"
        );
        self.samples.push_back(sample);
    }

    /// Forgets what is not needed for steps from `stamp` on.
    pub fn forget_before(&mut self, stamp: Stamp) {
        while self.samples.len() > 2 && self.samples[1].stamp <= stamp {
            self.samples.pop_front();
        }
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.samples.clear();
    }

    /// The newest sample.
    pub fn newest(&self) -> Option<&ImuSample> {
        self.samples.back()
    }

    /// The oldest sample.
    pub fn oldest(&self) -> Option<&ImuSample> {
        self.samples.front()
    }

    /// The samples, oldest first.
    pub fn iter(&self) -> impl DoubleEndedIterator<Item = &ImuSample> + ExactSizeIterator {
        self.samples.iter()
    }

    /// The samples newer than `stamp`, oldest first.
    pub fn after(&self, stamp: Stamp) -> impl Iterator<Item = &ImuSample> {
        self.samples.range(self.samples.partition_point(|sample| sample.stamp <= stamp)..)
    }

    /// What the IMU would have read at `stamp`; `None` outside of the samples.
    pub fn at(&self, stamp: Stamp) -> Option<ImuSample> {
        let after = self.samples.partition_point(|sample| sample.stamp < stamp);
        let right = self.samples.get(after)?;
        if right.stamp == stamp {
            return Some(*right);
        }
        let left = self.samples.get(after.checked_sub(1)?)?;
        let weight = stamp.seconds_since(left.stamp) / right.stamp.seconds_since(left.stamp);
        Some(ImuSample {
            stamp,
            angular_rate: left.angular_rate + (right.angular_rate - left.angular_rate) * weight,
            specific_force: left.specific_force + (right.specific_force - left.specific_force) * weight,
        })
    }

    /// The steps from one stamp to another: at the samples in between, and at the stamps themselves.
    /// `None` if the samples do not reach over both.
    pub fn steps(&self, from: Stamp, to: Stamp) -> Option<impl Iterator<Item = Step> + '_> {
        let (first, last) = (self.at(from)?, self.at(to)?);
        let begin = self.samples.partition_point(|sample| sample.stamp <= from);
        let end = self.samples.partition_point(|sample| sample.stamp < to).max(begin);
        let inner = self.samples.range(begin..end).copied();
        let mut previous = first;
        let ends = if to > from { Some(last) } else { None };
        Some(inner.chain(ends).map(move |sample| {
            let step = Step::between(&previous, &sample);
            previous = sample;
            step
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn buffer() -> SampleBuffer {
        let mut buffer = SampleBuffer::default();
        for index in 0..10_i32 {
            buffer.push(ImuSample {
                stamp: Stamp::from_nanos(i64::from(index) * 10_000_000),
                angular_rate: Vec3::repeat(f64::from(index)),
                specific_force: Vec3::repeat(2.0 * f64::from(index)),
            });
        }
        buffer
    }

    #[test]
    fn steps_split_at_any_stamp_and_sum_to_the_whole() {
        let buffer = buffer();
        let stamps = [0_i64, 3_000_000, 10_000_000, 47_123_456, 90_000_000].map(Stamp::from_nanos);
        let integral = |from: Stamp, to: Stamp| -> f64 {
            buffer.steps(from, to).expect("covered").map(|step| step.span_s * step.angular_rate.x).sum()
        };
        let whole = integral(stamps[0], stamps[4]);
        let parts: f64 = stamps.windows(2).map(|pair| integral(pair[0], pair[1])).sum();
        assert!((whole - 0.5 * 9.0 * 0.09).abs() < 1e-12, "{whole}");
        assert!((whole - parts).abs() < 1e-12);
        assert_eq!(buffer.steps(stamps[1], stamps[1]).expect("covered").count(), 0);
    }

    #[test]
    fn nothing_is_made_up_outside_of_the_samples() {
        let buffer = buffer();
        assert!(buffer.at(Stamp::from_nanos(-1)).is_none());
        assert!(buffer.steps(Stamp::from_nanos(0), Stamp::from_nanos(90_000_001)).is_none());
    }

    #[test]
    fn forgetting_keeps_what_the_oldest_stamp_needs() {
        let mut buffer = buffer();
        let stamp = Stamp::from_nanos(35_000_000);
        let before = buffer.at(stamp);
        buffer.forget_before(stamp);
        assert_eq!(buffer.at(stamp), before);
        assert_eq!(buffer.iter().len(), 7);
    }
}
