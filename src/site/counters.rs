//! What the site counts beside the fleet: for `/metrics` and `/readyz`.

use std::sync::atomic::{AtomicU64, Ordering};

/// Counts since the start; `ws_clients` and `foxglove_clients` go up and down.
#[derive(Debug, Default)]
pub(super) struct Counters {
    /// Publications under a key that is none of ours, or too long.
    pub foreign: AtomicU64,
    /// Messages dropped because the aggregator's channel was full.
    pub aggregator_dropped: AtomicU64,
    /// Messages dropped because the recorder's channel was full.
    pub recorder_dropped: AtomicU64,
    /// Tokens dropped because their channel was full.
    pub tokens_dropped: AtomicU64,
    /// Live clients that are connected.
    pub ws_clients: AtomicU64,
    /// Deltas that slow live clients did not get.
    pub ws_dropped: AtomicU64,
    /// Clients of the Foxglove protocol that are connected.
    pub foxglove_clients: AtomicU64,
    /// Messages that slow ones of them did not get.
    pub foxglove_dropped: AtomicU64,
}

/// Adds to a counter.
pub(super) fn add(counter: &AtomicU64, count: u64) {
    counter.fetch_add(count, Ordering::Relaxed);
}

/// Reads a counter.
pub(super) fn get(counter: &AtomicU64) -> u64 {
    counter.load(Ordering::Relaxed)
}
