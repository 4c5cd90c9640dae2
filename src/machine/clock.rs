//! The machine's clock. Here, and only here, the room reads the time.

use std::time::{Duration, Instant, SystemTime};

use crate::time::{Span, Stamp};

/// Unix time by the system's clock.
pub(super) fn wall() -> Stamp {
    match SystemTime::now().duration_since(SystemTime::UNIX_EPOCH) {
        Ok(since) => Stamp::from_nanos(i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)),
        Err(before) => {
            let nanos = i64::try_from(before.duration().as_nanos()).unwrap_or(i64::MAX);
            Stamp::from_nanos(-nanos)
        }
    }
}

/// The time by which the machine stamps and sends.
///
/// Live it is the system's clock, with its corrections. While a source is played it starts at the system's
/// time and passes at the chosen speed, so that a played machine's stamps and sending times agree; at speeds
/// other than 1 they run away from the system's clock.
#[derive(Clone, Copy, Debug)]
pub(super) struct Clock {
    played: Option<Played>,
}

#[derive(Clone, Copy, Debug)]
struct Played {
    start: Stamp,
    start_instant: Instant,
    speed: f64,
}

impl Clock {
    /// A clock that passes at `played_speed`, or the system's.
    pub(super) fn new(played_speed: Option<f64>) -> Self {
        let played = played_speed.map(|speed| Played { start: wall(), start_instant: Instant::now(), speed });
        Self { played }
    }

    /// Now.
    pub(super) fn now(&self) -> Stamp {
        match &self.played {
            None => wall(),
            Some(played) => {
                let elapsed_s = played.start_instant.elapsed().as_secs_f64();
                played.start + Span::from_seconds(elapsed_s * played.speed)
            }
        }
    }

    /// How long to wait until `stamp`; zero if it has passed.
    pub(super) fn until(&self, stamp: Stamp) -> Duration {
        let speed = self.played.map_or(1.0, |played| played.speed);
        let wait_s = stamp.seconds_since(self.now()) / speed;
        Duration::try_from_secs_f64(wait_s.max(0.0)).unwrap_or(Duration::ZERO)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn played_clock_passes_at_its_speed() {
        let clock = Clock::new(Some(100.0));
        let start = clock.now();
        let wait = clock.until(start + Span::from_seconds(50.0));
        assert!(wait <= Duration::from_millis(500) && wait > Duration::from_millis(300), "{wait:?}");
        assert_eq!(clock.until(start - Span::from_seconds(1.0)), Duration::ZERO);
        assert!((Clock::new(None).now() - wall()).as_seconds().abs() < 1.0);
    }
}
