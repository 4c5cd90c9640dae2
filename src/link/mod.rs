//! How Zenoh sessions are opened and closed, for machines and for the site.
//!
//! A star: the site listens, machines dial out, and nobody is found by multicast or gossip, which fails in
//! containers and lets peers go round the site. The session's id is random at every start: a fixed one makes
//! the other side take a restarted peer's samples for old. What is said over a session is not decided here, but
//! with certificates who may say it: both ends show theirs, and each machine speaks for itself alone.

mod access;

use std::path::Path;
use std::time::Duration;

use serde_json::{Value, json};

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
/// [`LinkError::Settings`] names the setting that Zenoh refuses, or the certificate that cannot be read.
pub fn machine_config(link: &config::Link) -> Result<zenoh::Config, LinkError> {
    let tls = link.tls.as_ref().map(|tls| certificates("link.tls", tls, "connect")).transpose()?;
    settings(&link.listen, &link.connect, link.lease_ms, tls, None)
}

/// Settings of a site's session: it listens, and dials nobody. `site` is its id.
///
/// # Errors
/// [`LinkError::Settings`] names the setting that Zenoh refuses, or the certificate that cannot be read.
pub fn site_config(site: &str, zenoh: &config::Zenoh, lease_ms: u64) -> Result<zenoh::Config, LinkError> {
    let tls = zenoh.tls.as_ref().map(|tls| certificates("zenoh.tls", tls, "listen")).transpose()?;
    let access = tls.as_ref().map(|_| access::control(site, &zenoh.admitted));
    settings(&zenoh.listen, &[], lease_ms, tls, access)
}

/// Zenoh's part on certificates, of the end that listens or connects.
fn certificates(table: &str, tls: &config::Tls, end: &str) -> Result<Value, LinkError> {
    let text = |key: &str, path: &Path| {
        // Zenoh would find out when the first machine dials in.
        std::fs::File::open(path).map_err(|error| {
            LinkError::Settings(format!("{table}.{key} is {}, which cannot be read: {error}", path.display()))
        })?;
        path.to_str()
            .map(str::to_owned)
            .ok_or_else(|| LinkError::Settings(format!("{table}.{key} is {}, must be UTF-8", path.display())))
    };
    let mut part = json!({
        "root_ca_certificate": text("authority_file", &tls.authority_file)?,
        "enable_mtls": true,
        "verify_name_on_connect": true,
        "close_link_on_expiration": true,
    });
    part[format!("{end}_certificate")] = text("certificate_file", &tls.certificate_file)?.into();
    part[format!("{end}_private_key")] = text("key_file", &tls.key_file)?.into();
    Ok(part)
}

fn settings(
    listen: &[String],
    connect: &[String],
    lease_ms: u64,
    tls: Option<Value>,
    access: Option<Value>,
) -> Result<zenoh::Config, LinkError> {
    let mut settings = json!({
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
    if let Some(tls) = tls {
        settings["transport"]["link"]["tls"] = tls;
    }
    if let Some(access) = access {
        settings["access_control"] = access;
    }
    zenoh::Config::from_json5(&settings.to_string()).map_err(|error| LinkError::Settings(reason(&error)))
}

/// What Zenoh says, without the line of its source with which it ends.
pub fn reason(error: &zenoh::Error) -> String {
    let text = error.to_string();
    text.split(" at /").next().unwrap_or_default().trim_end_matches('.').to_owned()
}

/// Opens a session. For one that dials, this does not wait until somebody answers.
///
/// # Errors
/// [`LinkError::Open`].
pub async fn open(settings: zenoh::Config) -> Result<zenoh::Session, LinkError> {
    zenoh::open(settings).await.map_err(|error| LinkError::Open(reason(&error)))
}

/// Closes a session and waits for it, though not for ever: on a dead link it would take long. Everything that
/// was declared on it must be gone by then.
pub async fn close(session: zenoh::Session) {
    match tokio::time::timeout(CLOSE_TIMEOUT, session.close()).await {
        Ok(Ok(())) => {}
        Ok(Err(error)) => tracing::warn!(error = reason(&error), "the Zenoh session did not close cleanly"),
        Err(_) => {
            tracing::warn!(timeout_s = CLOSE_TIMEOUT.as_secs_f64(), "the Zenoh session did not close in time")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn listening(endpoint: &str) -> config::Zenoh {
        config::Zenoh { listen: vec![endpoint.to_owned()], ..config::Zenoh::default() }
    }

    #[test]
    fn certificate_that_is_not_there_is_named() {
        let here = std::path::PathBuf::from("Cargo.toml");
        let tls = config::Tls {
            authority_file: here.clone(),
            certificate_file: here,
            key_file: std::path::PathBuf::from("no.key"),
        };
        let zenoh = config::Zenoh { tls: Some(tls), ..listening("tls/127.0.0.1:0") };
        let message = site_config("quarry", &zenoh, 2000).expect_err("no key").to_string();
        assert!(message.starts_with("link: zenoh.tls.key_file is no.key, which cannot be read"), "{message}");
    }

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
        assert!(site_config("quarry", &listening("tcp/127.0.0.1:0"), 2000).is_ok());
    }

    #[test]
    fn endpoint_that_is_none_is_refused_by_name() {
        let message =
            site_config("quarry", &listening("127.0.0.1"), 2000).expect_err("no protocol").to_string();
        assert!(message.ends_with(": 127.0.0.1"), "{message}");
    }
}
