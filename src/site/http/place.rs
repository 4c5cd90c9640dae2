//! How many sockets of a kind there may be at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::http::StatusCode;

use super::problem::Problem;
use crate::site::counters::Counters;

/// One of the clients there may be; given back when it is dropped.
pub(super) struct Place {
    counters: Arc<Counters>,
    of: fn(&Counters) -> &AtomicU64,
}

impl Place {
    /// Takes one of at most `most`, which `of` counts.
    ///
    /// # Errors
    /// 503 if there is none.
    pub fn take(
        counters: &Arc<Counters>,
        of: fn(&Counters) -> &AtomicU64,
        most: u64,
    ) -> Result<Self, Problem> {
        let one_more = |taken: u64| (taken < most).then_some(taken + 1);
        match of(counters).fetch_update(Ordering::Relaxed, Ordering::Relaxed, one_more) {
            Ok(_) => Ok(Self { counters: Arc::clone(counters), of }),
            Err(_) => {
                let detail = format!("{most} clients are connected already: close one, or try again later");
                Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, detail))
            }
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        (self.of)(&self.counters).fetch_sub(1, Ordering::Relaxed);
    }
}
