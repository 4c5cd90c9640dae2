//! Where playback stands, and when a message of the session is due.

use std::time::Duration;

use tokio::time::Instant;

use super::protocol::PlaybackStatus;
use crate::time::{Span, Stamp};

/// Seconds of a session in a second.
pub(super) const SPEEDS: (f64, f64) = (0.01, 100.0);
/// Who is further behind, because the client does not keep up or the disk is slow, goes on from where it is.
const LATE_MAX: Duration = Duration::from_millis(250);

/// Where playback stands.
#[derive(Debug)]
pub(super) struct Playhead {
    span: (Stamp, Stamp),
    /// Where it was at `since`.
    at: Stamp,
    since: Instant,
    speed: f64,
    status: PlaybackStatus,
}

/// What is wrong with a speed, if something is.
pub(in crate::site) fn check_speed(speed: f64) -> Result<(), String> {
    let (slowest, fastest) = SPEEDS;
    match (slowest..=fastest).contains(&speed) {
        true => Ok(()),
        false => Err(format!("the speed is {speed}, must be from {slowest} to {fastest}")),
    }
}

impl Playhead {
    /// Plays from the first message on.
    pub fn new(span: (Stamp, Stamp), speed: f64, now: Instant) -> Self {
        Self { span, at: span.0, since: now, speed, status: PlaybackStatus::Playing }
    }

    pub fn status(&self) -> PlaybackStatus {
        self.status
    }

    pub fn speed(&self) -> f64 {
        self.speed
    }

    pub fn is_playing(&self) -> bool {
        self.status == PlaybackStatus::Playing
    }

    /// Of the session, now.
    pub fn position(&self, now: Instant) -> Stamp {
        if !self.is_playing() {
            return self.at;
        }
        let passed = now.saturating_duration_since(self.since).as_secs_f64() * self.speed;
        (self.at + Span::from_seconds(passed)).min(self.span.1)
    }

    /// When a message of that time is to be sent; `None` while nothing is.
    pub fn due(&self, time: Stamp) -> Option<Instant> {
        let ahead = Duration::try_from_secs_f64(time.seconds_since(self.at) / self.speed).unwrap_or_default();
        self.is_playing().then(|| self.since + ahead)
    }

    /// A message of that time was sent now.
    pub fn sent(&mut self, time: Stamp, now: Instant) {
        if self.due(time).is_some_and(|due| now.saturating_duration_since(due) > LATE_MAX) {
            (self.at, self.since) = (time, now);
        }
    }

    pub fn play(&mut self, now: Instant) {
        self.hold(now);
        self.status = PlaybackStatus::Playing;
    }

    pub fn pause(&mut self, now: Instant) {
        self.hold(now);
        self.status = PlaybackStatus::Paused;
    }

    /// At another speed from now on, which must be one.
    pub fn set_speed(&mut self, speed: f64, now: Instant) {
        self.hold(now);
        self.speed = speed;
    }

    /// From there on, or from the nearest end of the session.
    pub fn seek(&mut self, to: Stamp, now: Instant) {
        (self.at, self.since) = (to.clamp(self.span.0, self.span.1), now);
    }

    /// There is nothing more.
    pub fn end(&mut self) {
        self.at = self.span.1;
        self.status = PlaybackStatus::Ended;
    }

    fn hold(&mut self, now: Instant) {
        (self.at, self.since) = (self.position(now), now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn playback_goes_as_fast_as_asked_and_stands_when_paused() {
        let stamp = |seconds| Stamp::from_seconds(seconds);
        let start = Instant::now();
        let after = |seconds| start + Duration::from_secs_f64(seconds);
        let mut head = Playhead::new((stamp(100.0), stamp(160.0)), 2.0, start);
        assert_eq!(head.position(after(3.0)), stamp(106.0));
        assert_eq!(head.due(stamp(110.0)), Some(after(5.0)));
        head.pause(after(3.0));
        assert_eq!((head.position(after(50.0)), head.due(stamp(110.0))), (stamp(106.0), None));
        head.set_speed(0.5, after(50.0));
        head.play(after(50.0));
        assert_eq!(head.position(after(54.0)), stamp(108.0));
        head.seek(stamp(10.0), after(54.0));
        assert_eq!(head.position(after(54.0)), stamp(100.0), "before the first message there is nothing");
        // A message that goes out a second late sets the clock by itself; one that is a little late does not.
        head.sent(stamp(101.0), after(56.1));
        assert_eq!(head.position(after(56.0)), stamp(101.0));
        head.sent(stamp(102.0), after(59.0));
        assert_eq!(head.position(after(61.0)), stamp(103.0));
        head.end();
        assert_eq!((head.position(after(90.0)), head.status()), (stamp(160.0), PlaybackStatus::Ended));
    }

    #[test]
    fn speeds_that_are_none_are_refused() {
        assert!(check_speed(0.01).is_ok() && check_speed(100.0).is_ok());
        for speed in [0.0, -1.0, 100.1, f64::NAN, f64::INFINITY] {
            assert!(check_speed(speed).is_err(), "{speed}");
        }
    }
}
