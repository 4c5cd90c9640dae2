//! Where machines come in: the Zenoh session, its subscribers, and callbacks that only hand over.

use std::sync::Arc;
use std::sync::mpsc::SyncSender;

use tokio::sync::mpsc;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};

use super::clock::SiteClock;
use super::counters::{Counters, add};
use super::sessions::Command;
use super::{SiteError, zenoh_error};
use crate::config;
use crate::fleet::Gaps;
use crate::link;
use crate::time::Stamp;
use crate::wire::{Attachment, Key, Topic, WireError, alive_selector};

/// No message of ours is longer; longer ones are dropped before they are copied.
const PAYLOAD_BYTES_MAX: usize = 1 << 20;

/// What machines are told: a link without a byte from the site for so long is dead.
const LEASE_MS: u64 = 2_000;

/// A publication of a machine, as it arrived.
#[derive(Clone, Debug)]
pub(super) struct Inbound {
    pub machine: Arc<str>,
    pub topic: Topic,
    pub payload: Arc<[u8]>,
    pub attachment: Attachment,
    pub received: Stamp,
}

/// What the callbacks hand over to the aggregator.
#[derive(Debug)]
pub(super) enum Message {
    Publication(Inbound),
    /// One that cannot be used: its attachment is missing or not ours.
    Unusable {
        machine: Arc<str>,
        error: WireError,
        received: Stamp,
    },
    /// How much of a machine's messages the recording lacks.
    Gaps {
        machine: Arc<str>,
        gaps: Gaps,
    },
}

/// A liveliness token that appeared or vanished.
#[derive(Debug)]
pub(super) struct Token {
    pub machine: String,
    pub boot: u64,
    pub alive: bool,
    pub at: Stamp,
}

/// Where the callbacks hand over to.
#[derive(Clone)]
pub(super) struct Outlets {
    pub messages: mpsc::Sender<Message>,
    pub tokens: mpsc::Sender<Token>,
    pub recorder: Option<SyncSender<Command>>,
    pub counters: Arc<Counters>,
    pub clock: SiteClock,
}

/// The declared subscribers; dropping them undeclares them.
pub(super) struct Inlet {
    topics: Subscriber<()>,
    tokens: Subscriber<()>,
}

/// Opens the session and waits until its endpoints listen. Returns them with the ports that the system chose.
pub(super) async fn open(config: &config::Site) -> Result<(zenoh::Session, Vec<String>), SiteError> {
    let settings =
        link::site_config(&config.id, &config.zenoh, LEASE_MS).map_err(|error| zenoh_error(config, error))?;
    let session = link::open(settings).await.map_err(|error| zenoh_error(config, error))?;
    let endpoints = session.info().locators().await.iter().map(ToString::to_string).collect();
    Ok((session, endpoints))
}

impl Inlet {
    /// Subscribes to all machines of the site.
    pub async fn declare(
        session: &zenoh::Session,
        site: &str,
        outlets: Outlets,
    ) -> Result<Self, zenoh::Error> {
        let for_topics = outlets.clone();
        let topics = session
            .declare_subscriber(format!("holdfast/{site}/*/**"))
            .callback(move |sample| on_sample(&for_topics, &sample))
            .await?;
        let tokens = session
            .liveliness()
            .declare_subscriber(alive_selector(site))
            .history(true)
            .callback(move |sample| on_token(&outlets, &sample))
            .await?;
        Ok(Self { topics, tokens })
    }

    /// No more callbacks after this.
    pub async fn undeclare(self) {
        for subscriber in [self.topics, self.tokens] {
            if let Err(error) = subscriber.undeclare().await {
                tracing::warn!("Zenoh did not end a subscription: {error}");
            }
        }
    }
}

/// Runs on Zenoh's own threads: must not wait, whatever happens behind the channels.
fn on_sample(outlets: &Outlets, sample: &Sample) {
    let received = outlets.clock.now();
    let payload = sample.payload();
    let key = Key::parse(sample.key_expr().as_str());
    let (Ok(Key::Topic { machine, topic, .. }), SampleKind::Put) = (key, sample.kind()) else {
        return add(&outlets.counters.foreign, 1);
    };
    if payload.len() > PAYLOAD_BYTES_MAX {
        return add(&outlets.counters.foreign, 1);
    }
    let machine: Arc<str> = machine.into();
    let attachment = sample.attachment().map(|bytes| bytes.to_bytes()).unwrap_or_default();
    let message = match Attachment::decode(&attachment) {
        Err(error) => Message::Unusable { machine, error, received },
        Ok(attachment) => {
            let payload: Arc<[u8]> = payload.to_bytes().as_ref().into();
            let inbound = Inbound { machine, topic, payload, attachment, received };
            if let Some(recorder) = &outlets.recorder {
                let command = Command::Write(inbound.clone());
                if recorder.try_send(command).is_err() {
                    add(&outlets.counters.recorder_dropped, 1);
                }
            }
            Message::Publication(inbound)
        }
    };
    if outlets.messages.try_send(message).is_err() {
        add(&outlets.counters.aggregator_dropped, 1);
    }
}

fn on_token(outlets: &Outlets, sample: &Sample) {
    let at = outlets.clock.now();
    let Ok(Key::Alive { machine, boot, .. }) = Key::parse(sample.key_expr().as_str()) else {
        return add(&outlets.counters.foreign, 1);
    };
    let alive = sample.kind() == SampleKind::Put;
    let token = Token { machine: machine.to_owned(), boot: boot.0, alive, at };
    if outlets.tokens.try_send(token).is_err() {
        add(&outlets.counters.tokens_dropped, 1);
        tracing::error!("a liveliness token was dropped: the aggregator does not keep up");
    }
}
