//! How Zenoh sessions are opened and closed, for machines and for the site.
//!
//! A star: the site listens, machines dial out, and nobody is found by multicast or gossip, which fails in
//! containers and lets peers go round the site. The session's id is random at every start: a fixed one makes
//! the other side take a restarted peer's samples for old. What is said over a session is not decided here.

use std::time::Duration;

use serde_json::json;

use crate::config;

/// How long a session may take to close.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(3);
/// Keep-alives for each lease.
const KEEP_ALIVES: u32 = 4;

/// Why there is no session.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// An endpoint or another setting is refused.
    #[error("link: {0}")]
    Settings(String),
    /// The session cannot be opened; most often an address is in use.
    #[error("link: the session cannot be opened: {0}")]
    Open(String),
    /// A key cannot be declared.
    #[error("link: {key} cannot be declared: {reason}")]
    Declare {
        /// Which key.
        key: String,
        /// What Zenoh says.
        reason: String,
    },
}

/// Settings of a machine's session: it dials the site until it answers, and listens for drivers only.
///
/// # Errors
/// [`LinkError::Settings`] names the setting that Zenoh refuses.
pub fn machine_config(link: &config::Link) -> Result<zenoh::Config, LinkError> {
    settings(&link.listen, &link.connect, link.lease_ms)
}

/// Settings of the site's session: it listens, and dials nobody.
///
/// # Errors
/// [`LinkError::Settings`] names the setting that Zenoh refuses.
pub fn site_config(listen: &[String], lease_ms: u64) -> Result<zenoh::Config, LinkError> {
    settings(listen, &[], lease_ms)
}

fn settings(listen: &[String], connect: &[String], lease_ms: u64) -> Result<zenoh::Config, LinkError> {
    let settings = json!({
        "mode": "peer",
        "listen": { "endpoints": listen },
        "connect": {
            "endpoints": connect,
            "timeout_ms": -1,
            "exit_on_failure": false,
            "retry": { "period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5 },
        },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
        "transport": { "link": { "tx": { "lease": lease_ms, "keep_alive": KEEP_ALIVES } } },
    });
    zenoh::Config::from_json5(&settings.to_string()).map_err(|error| LinkError::Settings(error.to_string()))
}

/// Opens a session. For one that dials, this does not wait until somebody answers.
///
/// # Errors
/// [`LinkError::Open`].
pub async fn open(settings: zenoh::Config) -> Result<zenoh::Session, LinkError> {
    zenoh::open(settings).await.map_err(|error| LinkError::Open(error.to_string()))
}

/// Closes a session and waits for it, though not for ever: on a dead link it would take long. Everything that
/// was declared on it must be gone by then.
pub async fn close(session: zenoh::Session) {
    match tokio::time::timeout(CLOSE_TIMEOUT, session.close()).await {
        Ok(Ok(())) => {}
        Ok(Err(error)) => tracing::warn!(%error, "the Zenoh session did not close cleanly"),
        Err(_) => {
            tracing::warn!(timeout_s = CLOSE_TIMEOUT.as_secs_f64(), "the Zenoh session did not close in time")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sessions_listen_where_told_and_are_found_by_nobody() {
        let link = config::Link {
            connect: vec!["tcp/127.0.0.1:7447".to_owned()],
            lease_ms: 1234,
            ..config::Link::default()
        };
        let config = machine_config(&link).expect("valid");
        let told = |key: &str| config.get_json(key).expect(key);
        assert_eq!(told("scouting/multicast/enabled"), "false");
        assert_eq!(told("scouting/gossip/enabled"), "false");
        assert!(told("listen/endpoints").contains("[]"), "{}", told("listen/endpoints"));
        assert_eq!(told("transport/link/tx/lease"), "1234");
        assert!(site_config(&["tcp/127.0.0.1:0".to_owned()], 2000).is_ok());
    }

    #[test]
    fn endpoint_that_is_none_is_refused_by_name() {
        let message = site_config(&["127.0.0.1".to_owned()], 2000).expect_err("no protocol").to_string();
        assert!(message.contains("127.0.0.1"), "{message}");
    }
}
