//! Wakes a thread that has parked.

use std::sync::{Arc, OnceLock};
use std::thread::Thread;

/// Known to both sides before the thread is; takes no lock to ring.
#[derive(Clone, Default)]
pub(super) struct Bell(Arc<OnceLock<Thread>>);

impl Bell {
    /// From now on `thread` is woken, and once now: it may have parked before.
    pub(super) fn hang(&self, thread: &Thread) {
        self.0.get_or_init(|| thread.clone());
        self.ring();
    }

    /// Wakes the thread, or lets it not park the next time.
    pub(super) fn ring(&self) {
        if let Some(thread) = self.0.get() {
            thread.unpark();
        }
    }
}
