//! Delivers what waits for one channel, in order, again and again until the receiver has it.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;

use super::{Channel, Letter};
use crate::fleet::retry_after;
use crate::site::clock::SiteClock;
use crate::site::ended;
use crate::site::history::{Archive, Delivery};
use crate::time::Span;

/// What could not be delivered for so long is given up.
const GIVEN_UP_AFTER: Span = Span::from_millis(24 * 3_600_000);
/// After a failure of the archive.
const PAUSE: Duration = Duration::from_secs(5);

pub(super) struct Courier {
    pub site: String,
    pub channels: Arc<Vec<Channel>>,
    /// Which of them.
    pub index: usize,
    pub archive: Arc<Archive>,
    pub clock: SiteClock,
}

impl Courier {
    pub async fn run(self, mut bell: watch::Receiver<()>, mut stopped: watch::Receiver<bool>) {
        let Some(channel) = self.channels.get(self.index) else { return };
        let name = channel.name();
        loop {
            let next = self.ask(|archive, name| archive.next_delivery(name)).await;
            let wait = match next {
                Err(error) => {
                    tracing::error!("{name}: what is to be delivered cannot be read: {error}");
                    Some(PAUSE)
                }
                Ok(None) => None,
                Ok(Some(delivery)) => {
                    let left = delivery.due - self.clock.now();
                    if left <= Span::default() {
                        tokio::select! {
                            () = ended(&mut stopped) => return,
                            () = self.deliver(channel, delivery) => continue,
                        }
                    }
                    Some(Duration::from_nanos(left.as_nanos().unsigned_abs()))
                }
            };
            let waiting = async {
                match wait {
                    Some(wait) => tokio::time::sleep(wait).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                () = ended(&mut stopped) => return,
                () = waiting => {}
                rung = bell.changed() => if rung.is_err() { return },
            }
        }
    }

    async fn deliver(&self, channel: &Channel, delivery: Delivery) {
        let now = self.clock.now();
        let letter = Letter { site: &self.site, is_test: false, alert: &delivery.alert };
        let (id, failures) = (delivery.id, delivery.failures.saturating_add(1));
        let sent = channel.send(&letter, now).await;
        let done = match sent {
            Ok(said) => {
                tracing::debug!("{}: told of alert {}: {said}", channel.name(), delivery.alert.id);
                self.ask(move |archive, _| archive.delivered(id)).await
            }
            Err(why) if now - delivery.since > GIVEN_UP_AFTER => {
                tracing::error!("{}: alert {} is given up: {why}", channel.name(), delivery.alert.id);
                self.ask(move |archive, _| archive.delivered(id)).await
            }
            Err(why) => {
                let again = retry_after(failures);
                tracing::warn!(
                    "{}: not told of alert {}: {why}; again in {} s",
                    channel.name(),
                    delivery.alert.id,
                    again.as_seconds()
                );
                let due = self.clock.now() + again;
                self.ask(move |archive, _| archive.not_delivered(id, failures, due)).await
            }
        };
        if let Err(error) = done {
            tracing::error!("{}: what became of a delivery cannot be kept: {error}", channel.name());
            // Else it would be sent again at once, and for ever.
            tokio::time::sleep(PAUSE).await;
        }
    }

    async fn ask<T: Send + 'static>(
        &self,
        question: impl FnOnce(&Archive, &str) -> rusqlite::Result<T> + Send + 'static,
    ) -> Result<T, String> {
        let archive = Arc::clone(&self.archive);
        let name = self.channels.get(self.index).map(Channel::name).unwrap_or_default();
        let answer = tokio::task::spawn_blocking(move || question(&archive, &name)).await;
        answer.map_err(|error| error.to_string())?.map_err(|error| error.to_string())
    }
}
