//! Answers who asks what runs on the machine, and how it is configured.

use zenoh::Wait as _;

use crate::config;
use crate::link::{self, LinkError};
use crate::wire::{BootId, JournalHead, configuration_key, encode_json};

/// What is needed, beside readings, to get this machine's estimates again.
pub(super) fn head(machine: &config::Machine) -> JournalHead {
    JournalHead { software: env!("CARGO_PKG_VERSION").to_owned(), machine_file: machine.to_toml() }
}

/// Answers for as long as the session is open.
pub(super) async fn answer(
    session: &zenoh::Session,
    machine: &config::Machine,
    boot: BootId,
) -> Result<(), LinkError> {
    let key = configuration_key(&machine.link.site, &machine.id, boot);
    let failed = |reason: String| LinkError::Declare { key: key.clone(), reason };
    let payload = encode_json("configuration", &head(machine)).map_err(|error| failed(error.to_string()))?;
    session
        .declare_queryable(key.clone())
        .callback(move |query| {
            if let Err(error) = query.reply(query.key_expr().clone(), payload.clone()).wait() {
                tracing::warn!(%error, "the configuration could not be told");
            }
        })
        .background()
        .await
        .map_err(|error| failed(link::reason(&error)))
}
