//! What one client wants, and messages on their way into its outbox.

use std::collections::BTreeMap;

use super::channels::{Channel, Kind};
use super::derived;
use super::outbox::Outbox;
use super::protocol::{Request, message_data};
use crate::frames::geodesy::SiteFrame;
use crate::time::Stamp;
use crate::wire::Topic;

/// What is wrong with one request, in so many messages at most.
const COMPLAINTS_MAX: usize = 8;

/// Subscriptions of a client: one at most for a channel.
#[derive(Debug, Default)]
pub(super) struct Subscriptions {
    by_channel: BTreeMap<u32, u32>,
    by_id: BTreeMap<u32, u32>,
}

impl Subscriptions {
    /// Under the client's number `id` from now on; says what is wrong with it.
    fn add(&mut self, id: u32, channel: u32) -> Result<(), String> {
        if self.by_id.contains_key(&id) {
            return Err(format!("subscription {id} is in use"));
        }
        if self.by_channel.contains_key(&channel) {
            return Err(format!("channel {channel} is subscribed to already"));
        }
        self.by_id.insert(id, channel);
        self.by_channel.insert(channel, id);
        Ok(())
    }

    fn remove(&mut self, id: u32) -> Result<(), String> {
        let channel = self.by_id.remove(&id).ok_or_else(|| format!("there is no subscription {id}"))?;
        self.by_channel.remove(&channel);
        Ok(())
    }

    /// Does what a client asks for, as far as it concerns subscriptions; says what is wrong with it.
    pub fn request(&mut self, request: Request, channels: &[Channel], outbox: &Outbox) -> Vec<String> {
        let done: Vec<Result<(), String>> = match request {
            Request::Subscribe(wanted) => wanted
                .into_iter()
                .map(|(id, channel)| match channels.iter().any(|known| known.id == channel) {
                    true => self.add(id, channel),
                    false => Err(format!("there is no channel {channel}")),
                })
                .collect(),
            Request::Unsubscribe(ids) => ids
                .into_iter()
                .map(|id| {
                    outbox.forget(Some(id));
                    self.remove(id)
                })
                .collect(),
            _ => vec![Err("there are no parameters, and there is no playback, of what is live".to_owned())],
        };
        done.into_iter().filter_map(Result::err).take(COMPLAINTS_MAX).collect()
    }

    /// Puts a message, and what comes of it, where the client wants it.
    pub fn take(&self, message: &Message<'_>, site: Option<&SiteFrame>, outbox: &Outbox) {
        let Message { number, machine, topic, payload, time } = *message;
        for kind in Kind::of(topic) {
            let Some(id) = self.by_channel.get(&kind.channel(number)) else { continue };
            let made = match kind {
                Kind::Sent(_) => {
                    outbox.data(*id, message_data(*id, time, payload));
                    continue;
                }
                Kind::Transforms => derived::transforms(machine, topic, payload),
                Kind::Location => site.and_then(|site| derived::location(payload, site)),
                Kind::Log => derived::log(machine, payload),
            };
            if let Some(made) = made {
                outbox.data(*id, message_data(*id, time, &made));
            }
        }
    }
}

/// A message of a machine.
#[derive(Clone, Copy, Debug)]
pub(super) struct Message<'a> {
    /// Of the machine.
    pub number: u32,
    pub machine: &'a str,
    pub topic: Topic,
    pub payload: &'a [u8],
    /// When it was received.
    pub time: Stamp,
}
