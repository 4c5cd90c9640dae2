//! What waits to be sent to one client.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Mutex, MutexGuard, PoisonError};

use axum::extract::ws::Message;
use tokio::sync::Notify;

/// Messages of all subscriptions that wait: half a second of a machine with all its topics. When there are so many,
/// the oldest of the same subscription makes room for a new one; each may have one waiting, however many there are.
const WAITING_MAX: usize = 512;
/// Answers that wait; a client that asks for more without taking them is let go.
const ANSWERS_MAX: usize = 1_024;

/// Between the task that knows what to send, and the one that sends. Nobody waits to put something in.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    inner: Mutex<Inner>,
    filled: Notify,
    emptied: Notify,
}

#[derive(Debug, Default)]
struct Inner {
    /// In order, before everything else.
    answers: VecDeque<Message>,
    /// Whose turn it is: subscriptions, each as often as it has messages.
    turns: VecDeque<u32>,
    waiting: BTreeMap<u32, VecDeque<Vec<u8>>>,
    /// The newest time, if it was not sent yet.
    time: Option<Vec<u8>>,
    dropped: u64,
    overrun: bool,
    closed: bool,
}

impl Outbox {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// An answer, or what a client must know: is not dropped.
    pub fn answer(&self, message: Message) {
        let mut inner = self.lock();
        match inner.answers.len() < ANSWERS_MAX {
            true => inner.answers.push_back(message),
            false => inner.overrun = true,
        }
        drop(inner);
        self.filled.notify_one();
    }

    /// The time; one that was not sent yet is forgotten.
    pub fn time(&self, bytes: Vec<u8>) {
        self.lock().time = Some(bytes);
        self.filled.notify_one();
    }

    /// A message of a subscription.
    pub fn data(&self, subscription: u32, bytes: Vec<u8>) {
        let mut guard = self.lock();
        let inner = &mut *guard;
        let own = inner.waiting.entry(subscription).or_default();
        own.push_back(bytes);
        if inner.turns.len() >= WAITING_MAX && own.len() > 1 {
            // Keeps its turn.
            own.pop_front();
            inner.dropped += 1;
        } else {
            inner.turns.push_back(subscription);
        }
        drop(guard);
        self.filled.notify_one();
    }

    /// Forgets what waits of all subscriptions, or of one.
    pub fn forget(&self, subscription: Option<u32>) {
        let mut inner = self.lock();
        match subscription {
            None => {
                inner.waiting.clear();
                inner.turns.clear();
            }
            Some(gone) => {
                inner.waiting.remove(&gone);
                inner.turns.retain(|turn| *turn != gone);
            }
        }
        drop(inner);
        self.emptied.notify_one();
    }

    /// Messages dropped since it was last asked.
    pub fn dropped(&self) -> u64 {
        std::mem::take(&mut self.lock().dropped)
    }

    /// Nothing will be added: what waits is sent, and then the sender ends.
    pub fn close(&self) {
        self.lock().closed = true;
        self.filled.notify_one();
    }

    /// The next message to send; `None` at the end.
    pub async fn next(&self) -> Option<Message> {
        loop {
            let filled = self.filled.notified();
            if let Some(next) = self.pop() {
                return next;
            }
            filled.await;
        }
    }

    /// Outer `None`: there is nothing yet. Inner `None`: there will be nothing.
    fn pop(&self) -> Option<Option<Message>> {
        let mut inner = self.lock();
        if inner.overrun {
            return Some(None);
        }
        if let Some(answer) = inner.answers.pop_front() {
            return Some(Some(answer));
        }
        if let Some(time) = inner.time.take() {
            return Some(Some(Message::Binary(time.into())));
        }
        if let Some(turn) = inner.turns.pop_front() {
            let bytes = inner.waiting.get_mut(&turn).and_then(VecDeque::pop_front);
            drop(inner);
            self.emptied.notify_one();
            return bytes.map(|bytes| Some(Message::Binary(bytes.into())));
        }
        inner.closed.then_some(None)
    }

    /// Waits until there is room for a few messages without dropping any.
    pub async fn room(&self) {
        loop {
            let emptied = self.emptied.notified();
            if self.lock().turns.len() < WAITING_MAX / 2 {
                return;
            }
            emptied.await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn byte(message: Option<Message>) -> u8 {
        let Some(Message::Binary(bytes)) = message else { panic!("{message:?}") };
        bytes[0]
    }

    #[tokio::test]
    async fn full_outbox_keeps_the_newest_of_every_subscription() {
        let outbox = Outbox::default();
        // A slow subscription, then a flood of another, then the slow one again.
        outbox.data(1, vec![100]);
        for count in 0..1_000_u32 {
            outbox.data(2, vec![(count % 251) as u8]);
        }
        outbox.data(1, vec![101]);
        outbox.data(3, vec![102]);
        outbox.answer(Message::Binary(vec![103].into()));
        assert_eq!(outbox.dropped(), 1_000 - 511 + 1);
        outbox.close();
        assert_eq!(byte(outbox.next().await), 103, "answers come first");
        assert_eq!(byte(outbox.next().await), 101, "in the place of the dropped one");
        let mut rest = Vec::new();
        while let Some(message) = outbox.next().await {
            rest.push(byte(Some(message)));
        }
        let newest: Vec<u8> = (1_000 - 511..1_000).map(|count: u32| (count % 251) as u8).collect();
        assert_eq!(rest[..511], newest[..]);
        assert_eq!(rest[511..], [102]);
        assert_eq!(outbox.dropped(), 0);
    }

    #[tokio::test]
    async fn what_is_forgotten_does_not_come() {
        let outbox = Outbox::default();
        outbox.data(1, vec![1]);
        outbox.data(2, vec![2]);
        outbox.data(1, vec![3]);
        outbox.forget(Some(1));
        outbox.close();
        assert_eq!(byte(outbox.next().await), 2);
        assert!(outbox.next().await.is_none());
        outbox.data(1, vec![4]);
        outbox.forget(None);
        assert!(outbox.next().await.is_none());
    }

    #[tokio::test]
    async fn client_that_asks_and_does_not_listen_is_let_go() {
        let outbox = Outbox::default();
        for _ in 0..ANSWERS_MAX + 1 {
            outbox.answer(Message::text("{}"));
        }
        assert!(outbox.next().await.is_none());
    }

    #[tokio::test]
    async fn the_newest_time_is_enough() {
        let outbox = Outbox::default();
        outbox.time(vec![1]);
        outbox.time(vec![2]);
        outbox.close();
        assert_eq!(byte(outbox.next().await), 2);
        assert!(outbox.next().await.is_none());
    }
}
