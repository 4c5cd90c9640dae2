//! Who may come in: readings that are numbers, in order, and by a clock that did not jump.

use crate::sensors::{Arrival, Sensor};
use crate::state::SensorHealth;
use crate::time::{Span, Stamp};

/// A stamp that moves so much further or less than the arrival is a jump of a clock.
const CLOCK_JUMP: Span = Span::from_millis(1_000);
/// So many readings in a row against the clock make the new clock the right one.
const READINGS_TO_RESET: u32 = 50;
/// Rates are counted over so long.
const RATE_WINDOW: Span = Span::from_millis(1_000);

/// What to do with a reading.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Admission {
    /// Use it.
    Accepted,
    /// Leave it, and say why.
    Refused(String),
    /// Leave it; the clock of this sensor has been set anew, and the next reading counts from there.
    ClockReset(String),
}

/// Book of one sensor.
#[derive(Clone, Debug, Default)]
struct Book {
    newest: Option<(Stamp, Stamp)>,
    received: u64,
    refused: u64,
    against_the_clock: u32,
    last_refusal: Option<String>,
    window_start: Option<Stamp>,
    window_count: u32,
    rate_hz: f64,
}

/// Books of all sensors.
#[derive(Clone, Debug, Default)]
pub(super) struct Inbox {
    books: [Book; Sensor::ALL.len()],
    unfit: u64,
}

impl Inbox {
    /// Decides on a reading and writes it down.
    pub fn admit(&mut self, arrival: &Arrival) -> Admission {
        let reading = &arrival.reading;
        let book = &mut self.books[reading.sensor() as usize];
        book.received += 1;
        book.count_rate(arrival.arrival);
        let admission = match reading.check() {
            Err(unfit) => Admission::Refused(unfit.to_string()),
            Ok(()) => match book.judge_clock(arrival.arrival, reading.stamp()) {
                Ok(()) => Admission::Accepted,
                Err(reason) => book.count_against_the_clock(reason),
            },
        };
        match &admission {
            Admission::Accepted => {
                book.newest = Some((arrival.arrival, reading.stamp()));
                book.against_the_clock = 0;
            }
            Admission::Refused(reason) | Admission::ClockReset(reason) => {
                book.refused += 1;
                book.last_refusal = Some(reason.clone());
                self.unfit += 1;
            }
        }
        admission
    }

    /// Whether a reading would come in now; nothing is written down.
    ///
    /// # Errors
    /// Why not.
    pub fn judge(&self, arrival: &Arrival) -> Result<(), String> {
        let reading = &arrival.reading;
        reading.check().map_err(|unfit| unfit.to_string())?;
        self.books[reading.sensor() as usize].judge_clock(arrival.arrival, reading.stamp())
    }

    /// Readings that were no measurements at all or came against the clock.
    pub fn unfit(&self) -> u64 {
        self.unfit
    }

    /// Writes down that a reading that was admitted could not be used after all.
    pub fn refuse(&mut self, sensor: Sensor, reason: String) {
        let book = &mut self.books[sensor as usize];
        book.refused += 1;
        book.last_refusal = Some(reason);
    }

    /// Newest stamp of a sensor.
    pub fn newest(&self, sensor: Sensor) -> Option<Stamp> {
        self.books[sensor as usize].newest.map(|(_, stamp)| stamp)
    }

    /// When the newest reading of a sensor arrived.
    pub fn newest_arrival(&self, sensor: Sensor) -> Option<Stamp> {
        self.books[sensor as usize].newest.map(|(arrival, _)| arrival)
    }

    /// The sensors that ever spoke, with ages at `now`.
    pub fn health(&self, now: Stamp) -> Vec<SensorHealth> {
        Sensor::ALL
            .into_iter()
            .filter_map(|sensor| {
                let book = &self.books[sensor as usize];
                let silent = book.window_start.is_some_and(|start| now - start > Span::from_millis(3_000));
                (book.received > 0).then(|| SensorHealth {
                    sensor,
                    rate_hz: if silent { 0.0 } else { book.rate_hz },
                    age_s: book.newest.map(|(_, stamp)| now.seconds_since(stamp)),
                    received: book.received,
                    refused: book.refused,
                    last_refusal: book.last_refusal.clone(),
                })
            })
            .collect()
    }
}

impl Book {
    fn count_rate(&mut self, arrival: Stamp) {
        let start = *self.window_start.get_or_insert(arrival);
        self.window_count += 1;
        let elapsed = arrival - start;
        if elapsed >= RATE_WINDOW {
            self.rate_hz = f64::from(self.window_count - 1) / elapsed.as_seconds();
            self.window_start = Some(arrival);
            self.window_count = 1;
        }
    }

    #[inline(never)]
    fn judge_clock(&self, arrival: Stamp, stamp: Stamp) -> Result<(), String> {
        let Some((newest_arrival, newest)) = self.newest else { return Ok(()) };
        let advance = stamp - newest;
        let elapsed = arrival - newest_arrival;
        let disagreement = (advance.as_seconds() - elapsed.as_seconds()).abs();
        if advance.as_nanos() == 0 {
            Err("has the stamp of the reading before".to_owned())
        } else if disagreement > CLOCK_JUMP.as_seconds() {
            Err(format!("its stamp moved by {:.3} s in {:.3} s", advance.as_seconds(), elapsed.as_seconds()))
        } else if advance.as_nanos() < 0 {
            Err(format!("its stamp is {:.3} s before the reading before", -advance.as_seconds()))
        } else {
            Ok(())
        }
    }

    fn count_against_the_clock(&mut self, reason: String) -> Admission {
        self.against_the_clock += 1;
        if self.against_the_clock < READINGS_TO_RESET {
            return Admission::Refused(reason);
        }
        self.against_the_clock = 0;
        self.newest = None;
        Admission::ClockReset(reason)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lie::Vec3;
    use crate::sensors::{ImuSample, Reading};

    fn sample(arrival_ms: i64, stamp_ms: i64) -> Arrival {
        let at = |millis: i64| Stamp::from_nanos(millis * 1_000_000);
        let reading = Reading::Imu(ImuSample {
            stamp: at(stamp_ms),
            angular_rate: Vec3::zeros(),
            specific_force: Vec3::z() * 9.8,
        });
        Arrival { arrival: at(arrival_ms), reading }
    }

    #[test]
    fn repeated_and_backward_stamps_are_refused_and_counted() {
        let mut inbox = Inbox::default();
        assert_eq!(inbox.admit(&sample(0, 0)), Admission::Accepted);
        assert_eq!(inbox.admit(&sample(10, 10)), Admission::Accepted);
        assert!(matches!(inbox.admit(&sample(11, 10)), Admission::Refused(_)));
        assert!(matches!(inbox.admit(&sample(20, 5)), Admission::Refused(_)));
        assert_eq!(inbox.admit(&sample(30, 30)), Admission::Accepted);
        let health = inbox.health(Stamp::from_nanos(30_000_000));
        assert_eq!((health[0].received, health[0].refused), (5, 2));
    }

    #[test]
    fn one_wild_stamp_is_left_and_a_lasting_jump_becomes_the_clock() {
        let mut inbox = Inbox::default();
        inbox.admit(&sample(0, 0));
        assert!(matches!(inbox.admit(&sample(10, 9_000_000)), Admission::Refused(_)));
        assert_eq!(inbox.admit(&sample(20, 20)), Admission::Accepted);
        let mut resets = 0;
        for index in 0..100 {
            if let Admission::ClockReset(_) = inbox.admit(&sample(30 + 10 * index, 9_000_030 + 10 * index)) {
                resets += 1;
            }
        }
        assert_eq!(resets, 1);
        assert_eq!(inbox.newest(Sensor::Imu), Some(Stamp::from_nanos(9_001_020_000_000)));
    }

    #[test]
    fn rate_is_that_of_the_last_second() {
        let mut inbox = Inbox::default();
        (0..250)
            .for_each(|index| assert_eq!(inbox.admit(&sample(10 * index, 10 * index)), Admission::Accepted));
        let health = inbox.health(Stamp::from_nanos(2_490_000_000));
        assert!((health[0].rate_hz - 100.0).abs() < 1e-9, "{}", health[0].rate_hz);
    }
}
