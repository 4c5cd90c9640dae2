//! From the aggregator to the clients' tasks: a ring of messages, and the channels there are.

use std::collections::BTreeMap;
use std::sync::Arc;

use tokio::sync::{broadcast, watch};

use super::channels::{Channel, Kind};
use crate::site::inlet::Inbound;

/// Messages in the ring: a fifth of a second of forty machines. A client's task that is further behind loses the
/// oldest.
const RING: usize = 8_192;
/// No message that anybody looks at is longer; the ring holds so much of each at most.
const PAYLOAD_BYTES_MAX: usize = 16 * 1024;

/// A message, and the number of its machine among those that have channels.
#[derive(Clone, Debug)]
pub(super) struct Told {
    pub machine: u32,
    pub inbound: Inbound,
}

/// The aggregator's end.
pub(in crate::site) struct Feed {
    messages: broadcast::Sender<Told>,
    channels: watch::Sender<Arc<Vec<Channel>>>,
    /// Their numbers, and which kinds of channels they have, a bit each.
    machines: BTreeMap<Arc<str>, (u32, u32)>,
}

/// The clients' end.
#[derive(Clone)]
pub(in crate::site) struct Feeds {
    messages: broadcast::Sender<Told>,
    channels: watch::Receiver<Arc<Vec<Channel>>>,
}

impl Feed {
    pub fn new() -> (Self, Feeds) {
        let (messages, _) = broadcast::channel(RING);
        let (sender, channels) = watch::channel(Arc::default());
        let feeds = Feeds { messages: messages.clone(), channels };
        (Self { messages, channels: sender, machines: BTreeMap::new() }, feeds)
    }

    /// A message that the fleet took in. Costs next to nothing while nobody listens.
    pub fn tell(&mut self, inbound: &Inbound) {
        let kinds = Kind::of(inbound.topic);
        if kinds.is_empty() || inbound.payload.len() > PAYLOAD_BYTES_MAX {
            return;
        }
        let next = self.machines.len() as u32;
        if !self.machines.contains_key(&inbound.machine) {
            self.machines.insert(Arc::clone(&inbound.machine), (next, 0));
        }
        let Some((number, known)) = self.machines.get_mut(&inbound.machine) else { return };
        let new: Vec<_> = kinds.iter().filter(|kind| *known & (1 << kind.index()) == 0).collect();
        if !new.is_empty() {
            new.iter().for_each(|kind| *known |= 1 << kind.index());
            let new = new.into_iter().map(|kind| Channel::new(*number, &inbound.machine, *kind));
            self.channels.send_modify(|channels| Arc::make_mut(channels).extend(new));
        }
        if self.messages.receiver_count() > 0 {
            // An error says that the last one has just gone.
            let _ = self.messages.send(Told { machine: *number, inbound: inbound.clone() });
        }
    }
}

impl Feeds {
    /// All messages from now on, and the channels.
    pub(super) fn follow(&self) -> (broadcast::Receiver<Told>, watch::Receiver<Arc<Vec<Channel>>>) {
        (self.messages.subscribe(), self.channels.clone())
    }
}
