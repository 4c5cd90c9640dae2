//! Sends what the outbox has numbered. The only place that publishes anything.

use std::collections::BTreeMap;

use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use zenoh::bytes::Encoding;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};

use super::outbox::is_published;
use crate::config;
use crate::link::{self, LinkError};
use crate::wire::{Attachment, Topic, topic_key};

/// Messages on the way to the network: some two seconds of them. Full, the newest are not sent.
const NETWORK_QUEUE: usize = 1024;

/// A message with its number.
pub(super) struct Packet {
    pub(super) topic: Topic,
    pub(super) attachment: Attachment,
    pub(super) payload: Vec<u8>,
}

/// The sending task; it ends when nobody can hand it anything.
pub(super) struct Sender(JoinHandle<()>);

impl Sender {
    /// Declares the publishers and starts the task.
    pub(super) async fn start(
        session: &zenoh::Session,
        machine: &config::Machine,
    ) -> Result<(Self, mpsc::Sender<Packet>), LinkError> {
        let mut publishers = BTreeMap::new();
        for topic in Topic::ALL.into_iter().filter(|topic| is_published(machine, *topic)) {
            let key = topic_key(&machine.link.site, &machine.id, topic);
            publishers.insert(topic, declare(session, topic, key).await?);
        }
        let (network, packets) = mpsc::channel(NETWORK_QUEUE);
        Ok((Self(tokio::spawn(send(publishers, packets))), network))
    }

    /// Waits until everything is sent.
    pub(super) async fn stop(self) {
        if let Err(error) = self.0.await {
            tracing::error!(%error, "the sending task has ended early");
        }
    }
}

/// Nothing ever blocks on a slow link: it would close the link, and stop every other topic with it.
async fn declare(
    session: &zenoh::Session,
    topic: Topic,
    key: String,
) -> Result<Publisher<'static>, LinkError> {
    let priority = match topic {
        Topic::Pose => Priority::RealTime,
        Topic::Odom => Priority::InteractiveHigh,
        Topic::Health | Topic::Event => Priority::DataHigh,
        // Of one priority, so that a page does not overtake its readings.
        Topic::Journal | Topic::Sensor(_) => Priority::Data,
    };
    let encoding = if topic.is_json() { Encoding::APPLICATION_JSON } else { Encoding::APPLICATION_CDR };
    session
        .declare_publisher(key.clone())
        .congestion_control(CongestionControl::Drop)
        .priority(priority)
        .encoding(encoding)
        .await
        .map_err(|error| LinkError::Declare { key, reason: link::reason(&error) })
}

/// Hands messages to Zenoh, which waits some milliseconds at most and then drops them: the gap in the numbers tells
/// the receiver.
async fn send(publishers: BTreeMap<Topic, Publisher<'static>>, mut packets: mpsc::Receiver<Packet>) {
    while let Some(Packet { topic, attachment, payload }) = packets.recv().await {
        let Some(publisher) = publishers.get(&topic) else { continue };
        let attachment = attachment.encode();
        if let Err(error) = publisher.put(payload).attachment(attachment.as_slice()).await {
            tracing::debug!(%error, %topic, "a message could not be sent");
        }
    }
}
