//! When the next IMU sample is to be expected, and when to rehearse for it.

use std::time::{Duration, Instant};

/// A rehearsal is so long before the earliest time at which the sample may be there: time to wake up.
const WAKE_UP: Duration = Duration::from_micros(200);
/// Until the sample is there it is rehearsed again after so long: soon enough that the caches still hold it.
const AGAIN: Duration = Duration::from_micros(120);
/// Samples come that many mean deviations early or late at most, as far as one prepares for it.
const DEVIATIONS: u32 = 3;
/// Part of an error that moves the expectation, and the mean deviation.
const GAIN: u32 = 8;
/// Samples that follow each other faster keep the caches warm by themselves.
const PERIOD_MIN: Duration = Duration::from_millis(2);

/// What to do now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Now {
    /// Nothing but to wait for whatever comes.
    Wait,
    /// To wait for whatever comes, but not for longer.
    WaitFor(Duration),
    /// To rehearse, and then to wait like that.
    RehearseAndWaitFor(Duration),
}

/// Follows the samples' rhythm through the jitter of their arrival.
#[derive(Clone, Copy, Debug)]
pub(super) struct Anticipation {
    period: Duration,
    /// The next sample's time.
    due: Option<Instant>,
    /// How far samples are from their time, in the mean.
    deviation: Duration,
}

impl Anticipation {
    pub(super) fn new(period: Duration) -> Self {
        Self { period, due: None, deviation: Duration::ZERO }
    }

    /// A sample has come.
    pub(super) fn note_sample(&mut self, now: Instant) {
        if self.period < PERIOD_MIN {
            return;
        }
        let known =
            self.due.map(|due| (due, now.saturating_duration_since(due), due.saturating_duration_since(now)));
        let rhythm = match known {
            Some((due, late, early)) if late.max(early) < self.period / 2 => {
                let error = late.max(early);
                self.deviation = self.deviation * (GAIN - 1) / GAIN + error / GAIN;
                due + late / GAIN - early / GAIN
            }
            // The first one, or out of step.
            _ => now,
        };
        self.due = rhythm.checked_add(self.period);
    }

    pub(super) fn at(&self, now: Instant) -> Now {
        let Some(due) = self.due else { return Now::Wait };
        let spread = (self.deviation * DEVIATIONS).min(self.period / 4);
        let begin = due.checked_sub(spread + WAKE_UP).unwrap_or(now);
        if now < begin {
            Now::WaitFor(begin - now)
        } else if now < due + spread + WAKE_UP {
            Now::RehearseAndWaitFor(AGAIN)
        } else {
            Now::Wait
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Duration = Duration::from_millis(10);

    fn micros(micros: u64) -> Duration {
        Duration::from_micros(micros)
    }

    #[test]
    fn steady_samples_are_rehearsed_for_just_before_they_are_due() {
        let begin = Instant::now();
        let mut anticipation = Anticipation::new(PERIOD);
        assert_eq!(anticipation.at(begin), Now::Wait);
        (0..50).for_each(|index| anticipation.note_sample(begin + PERIOD * index));
        let last = begin + PERIOD * 49;
        assert_eq!(anticipation.at(last), Now::WaitFor(PERIOD - WAKE_UP));
        for early in [200, 100, 0] {
            assert_eq!(anticipation.at(last + PERIOD - micros(early)), Now::RehearseAndWaitFor(AGAIN));
        }
        // Nobody waits for a sample that does not come.
        assert_eq!(anticipation.at(last + PERIOD + micros(201)), Now::Wait);
    }

    #[test]
    fn samples_that_jitter_are_rehearsed_for_as_early_as_they_may_come() {
        let begin = Instant::now() + PERIOD;
        let mut anticipation = Anticipation::new(PERIOD);
        let mut found = 0;
        for index in 0..400_u32 {
            // Up to 0.8 ms early or late.
            let sample = begin + PERIOD * index + micros(u64::from(index * 7_919 % 1_600)) - micros(800);
            found += u32::from(matches!(anticipation.at(sample), Now::RehearseAndWaitFor(_)));
            anticipation.note_sample(sample);
            let wait = match anticipation.at(sample) {
                Now::WaitFor(wait) => wait,
                now => panic!("{index}: {now:?}"),
            };
            assert!(wait > PERIOD / 2, "{index}: {wait:?}");
        }
        assert!(found > 380, "{found} of 400");
    }

    #[test]
    fn rhythm_is_found_again_after_a_pause_and_fast_samples_need_none() {
        let begin = Instant::now();
        let mut anticipation = Anticipation::new(PERIOD);
        anticipation.note_sample(begin);
        let later = begin + PERIOD * 100 + micros(3_000);
        assert_eq!(anticipation.at(later), Now::Wait);
        anticipation.note_sample(later);
        assert_eq!(anticipation.at(later), Now::WaitFor(PERIOD - WAKE_UP));
        let mut fast = Anticipation::new(micros(1_000));
        fast.note_sample(begin);
        assert_eq!(fast.at(begin + micros(950)), Now::Wait);
    }
}
