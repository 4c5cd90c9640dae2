//! All machines, as they speak.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::ws::WebSocket;
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::watch;
use tokio::time::MissedTickBehavior;

use super::channels::Channel;
use super::feed::{Feeds, Told};
use super::outbox::Outbox;
use super::protocol::{self, Dialect, Request};
use super::socket::{Said, Socket};
use super::subscriptions::{Message, Subscriptions};
use crate::frames::geodesy::SiteFrame;
use crate::site::clock::SiteClock;
use crate::site::counters::{Counters, add};
use crate::site::ended;

/// How often the time is sent.
const TIME_EVERY: Duration = Duration::from_millis(100);
/// How often a client is told how much it lost, in times.
const TELL_EVERY: u32 = 20;

/// What a live client is served from.
pub(in crate::site) struct Site {
    pub name: String,
    pub frame: SiteFrame,
    pub feeds: Feeds,
    pub clock: SiteClock,
    pub counters: Arc<Counters>,
    pub stopped: watch::Receiver<bool>,
}

/// Serves a client until it goes, or the site ends.
pub(in crate::site) async fn serve(socket: WebSocket, dialect: Dialect, site: Site) {
    let (mut messages, mut channels) = site.feeds.follow();
    let outbox = Arc::new(Outbox::default());
    let mut client = Client { subscriptions: Subscriptions::default(), told: 0, outbox: Arc::clone(&outbox) };
    let begun = site.clock.now().as_nanos().to_string();
    outbox.answer(protocol::server_info(&site.name, &begun, dialect, None));
    client.advertise(&channels.borrow_and_update());
    let mut socket = Socket::new(socket, outbox);
    let mut stopped = site.stopped.clone();
    let mut ticks = tokio::time::interval(TIME_EVERY);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let (mut turns, mut lost) = (0, 0);
    loop {
        tokio::select! {
            biased;
            () = ended(&mut stopped) => return socket.end().await,
            said = socket.hear() => match said {
                Said::Gone => return,
                Said::Nonsense(wrong) => client.outbox.answer(protocol::warning(&wrong)),
                Said::Request(request) => client.request(request, &channels.borrow()),
            },
            changed = channels.changed() => match changed {
                Ok(()) => client.advertise(&channels.borrow_and_update()),
                Err(_) => return socket.end().await,
            },
            _ = ticks.tick() => {
                client.outbox.time(protocol::time(site.clock.now()));
                lost += client.outbox.dropped();
                turns += 1;
                if lost > 0 && turns >= TELL_EVERY {
                    turns = 0;
                    let lost = std::mem::take(&mut lost);
                    add(&site.counters.foxglove_dropped, lost);
                    let text = format!("{lost} messages were dropped: they came faster than they were taken");
                    client.outbox.answer(protocol::warning(&text));
                }
            }
            message = messages.recv() => match message {
                Ok(Told { machine, inbound }) => client.subscriptions.take(
                    &Message {
                        number: machine,
                        machine: &inbound.machine,
                        topic: inbound.topic,
                        payload: &inbound.payload,
                        time: inbound.received,
                    },
                    Some(&site.frame),
                    &client.outbox,
                ),
                Err(RecvError::Lagged(count)) => lost += count,
                Err(RecvError::Closed) => return socket.end().await,
            }
        }
    }
}

struct Client {
    subscriptions: Subscriptions,
    /// Channels that were advertised.
    told: usize,
    outbox: Arc<Outbox>,
}

impl Client {
    /// Tells of the channels that came since the last time; the first time, also that there are none.
    fn advertise(&mut self, channels: &[Channel]) {
        self.outbox.answer(protocol::advertise(&channels[self.told..]));
        self.told = channels.len();
    }

    fn request(&mut self, request: Request, channels: &[Channel]) {
        for wrong in self.subscriptions.request(request, channels, &self.outbox) {
            self.outbox.answer(protocol::warning(&wrong));
        }
    }
}
