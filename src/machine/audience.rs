//! Whether anybody listens to what the machine says, told to people and to the player.

use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::config;
use crate::link::{self, LinkError};
use crate::wire::{Topic, topic_key};

/// Zenoh is asked so often.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// A site that does not answer for so long after the start is worth a line.
const PATIENCE: Duration = Duration::from_secs(3);

/// The task that looks, and what it saw last.
pub(super) struct Audience {
    task: JoinHandle<()>,
    present: watch::Receiver<bool>,
}

impl Audience {
    /// Looks for subscribers of the machine's pose from now on: a site subscribes to all topics at once.
    pub(super) async fn watch(
        session: &zenoh::Session,
        machine: &config::Machine,
    ) -> Result<Self, LinkError> {
        let key = topic_key(&machine.link.site, &machine.id, Topic::Pose);
        let publisher = session.declare_publisher(key.clone()).await;
        let publisher =
            publisher.map_err(|error| LinkError::Declare { key, reason: link::reason(&error) })?;
        let (sender, present) = watch::channel(false);
        let connect = machine.link.connect.join(", ");
        // Who is refused is not told so by Zenoh.
        let hint = match &machine.link.tls {
            Some(_) => {
                "; if the site is up, see that its zenoh.admitted.machines names this machine, and that both have \
                 certificates of one authority"
            }
            None => "",
        };
        let look = async move {
            let mut waited = Duration::ZERO;
            loop {
                let listening = publisher.matching_status().await.is_ok_and(|status| status.matching());
                if sender.send_if_modified(|before| std::mem::replace(before, listening) != listening) {
                    match listening {
                        true => tracing::info!("connected: somebody listens to this machine"),
                        false => tracing::warn!("nobody listens any more; dialling {connect}{hint}"),
                    }
                    waited = PATIENCE + LOOK_EVERY;
                } else if !listening && waited <= PATIENCE {
                    waited += LOOK_EVERY;
                    if waited > PATIENCE {
                        tracing::warn!("nobody listens yet; dialling {connect}{hint}");
                    }
                }
                tokio::time::sleep(LOOK_EVERY).await;
            }
        };
        Ok(Self { task: tokio::spawn(look), present })
    }

    /// Whether somebody listens, as of the last look.
    pub(super) fn present(&self) -> watch::Receiver<bool> {
        self.present.clone()
    }

    /// Ends the looking, before the session is closed.
    pub(super) async fn stop(self) {
        self.task.abort();
        // Always an error: the task was ended.
        let _ = self.task.await;
    }
}
