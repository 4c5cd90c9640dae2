//! The site file: who the site is, where its frame is tied, where it listens, what it records.

use std::net::SocketAddr;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::endpoint::listening;
use super::{Checked, Violation, World, identifier, violation};

/// One site server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Site {
    /// Letters, digits and '-'; first part of every key after `holdfast/`.
    pub id: String,
    /// For people; the id if it is empty.
    #[serde(default)]
    pub name: String,
    /// Origin of the site frame, the same as in the machine files.
    pub world: World,
    /// Page and API.
    #[serde(default)]
    pub http: Http,
    /// Where machines dial in.
    #[serde(default)]
    pub zenoh: Zenoh,
    /// What is kept.
    #[serde(default)]
    pub record: Record,
}

/// Page and API.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Http {
    /// Address and port; loopback only, as long as there are no accounts.
    pub listen: SocketAddr,
}

/// Where machines dial in.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Zenoh {
    /// Zenoh endpoints to listen on, such as `tcp/127.0.0.1:7447`.
    pub listen: Vec<String>,
    /// `listen` may be reached from other computers, and whoever dials in is believed.
    pub unauthenticated: bool,
}

/// What is kept.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Record {
    /// Sessions go to `sessions/` in it.
    pub directory: PathBuf,
    /// Without it nothing is written to disk.
    pub enabled: bool,
}

impl Default for Http {
    fn default() -> Self {
        Self { listen: SocketAddr::from(([127, 0, 0, 1], 8080)) }
    }
}

impl Default for Zenoh {
    fn default() -> Self {
        Self { listen: vec!["tcp/127.0.0.1:7447".to_owned()], unauthenticated: false }
    }
}

impl Default for Record {
    fn default() -> Self {
        Self { directory: PathBuf::from("holdfast-data"), enabled: true }
    }
}

impl Site {
    /// What people call it.
    pub fn display_name(&self) -> &str {
        if self.name.is_empty() { &self.id } else { &self.name }
    }
}

impl Http {
    /// Whether the address may be served: loopback only, because there are no accounts yet.
    ///
    /// # Errors
    /// Says what is wrong with the address and what would be right.
    pub fn check(&self) -> Result<(), Violation> {
        if self.listen.ip().is_loopback() {
            return Ok(());
        }
        violation(
            "http.listen",
            format!(
                "is {}, which others can reach; there are no accounts yet, so it must be a loopback address \
                 such as 127.0.0.1:{}",
                self.listen,
                self.listen.port()
            ),
        )
    }
}

impl Checked for Site {
    fn check(&self) -> Result<(), Violation> {
        identifier("id", &self.id)?;
        self.world.check("world")?;
        self.http.check()?;
        if self.zenoh.listen.is_empty() {
            return violation(
                "zenoh.listen",
                "is empty, must name an endpoint for the machines, such as tcp/127.0.0.1:7447".to_owned(),
            );
        }
        listening("zenoh", &self.zenoh.listen, self.zenoh.unauthenticated)
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::parse;
    use super::*;

    const MINIMAL: &str =
        "id = \"quarry\"\n[world]\nlatitude_deg = 47.0\nlongitude_deg = 8.0\naltitude_m = 400.0\n";

    fn error(text: &str) -> String {
        parse::<Site>(text, Path::new("s.toml")).expect_err("must be refused").to_string()
    }

    #[test]
    fn shipped_site_file_says_the_defaults() {
        let shipped: Site =
            parse(include_str!("../../config/site.toml"), Path::new("config/site.toml")).expect("valid");
        assert_eq!(shipped.http, Http::default());
        assert_eq!(shipped.zenoh, Zenoh::default());
        assert_eq!(shipped.record, Record::default());
    }

    #[test]
    fn address_that_others_can_reach_is_refused_with_its_line() {
        for address in ["0.0.0.0:8080", "192.168.1.2:80", "[::]:8080"] {
            let message = error(&format!("{MINIMAL}[http]\nlisten = \"{address}\"\n"));
            assert!(message.starts_with(&format!("s.toml:7:1: http.listen is {address}")), "{message}");
            assert!(message.contains("loopback"), "{message}");
        }
        for address in ["127.0.0.1:0", "127.1.2.3:8080", "[::1]:8080"] {
            let text = format!("{MINIMAL}[http]\nlisten = \"{address}\"\n");
            assert!(parse::<Site>(&text, Path::new("s.toml")).is_ok(), "{address}");
        }
    }

    #[test]
    fn unknown_key_and_empty_endpoints_are_refused() {
        assert!(error(&format!("{MINIMAL}[http]\nlissten = \"x\"\n")).contains("s.toml:7:1: unknown field"));
        assert!(error(&format!("{MINIMAL}[zenoh]\nlisten = []\n")).contains("zenoh.listen is empty"));
    }
}
