//! The site's clock: Unix time that never steps back.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use crate::time::{Span, Stamp};

/// Unix time as it was at the start, carried on by the monotonic clock, so that ages stay right when somebody
/// sets the system's clock. It follows such a change at the next start.
#[derive(Clone, Copy, Debug)]
pub(super) struct SiteClock {
    at_start: Stamp,
    start: Instant,
}

impl SiteClock {
    #[allow(clippy::disallowed_methods, reason = "shells read clocks, and the site does so here")]
    pub fn start() -> Self {
        let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let nanos = i64::try_from(since_epoch.as_nanos()).unwrap_or(i64::MAX);
        Self { at_start: Stamp::from_nanos(nanos), start: Instant::now() }
    }

    /// As if it were that time now.
    #[cfg(test)]
    #[allow(clippy::disallowed_methods, reason = "time goes on in tests")]
    pub fn starting_at(now: Stamp) -> Self {
        Self { at_start: now, start: Instant::now() }
    }

    pub fn now(&self) -> Stamp {
        let nanos = i64::try_from(self.start.elapsed().as_nanos()).unwrap_or(i64::MAX);
        self.at_start + Span::from_nanos(nanos)
    }
}
