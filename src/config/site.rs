//! The site file: who the site is, where its frame is tied, where it listens, what it records.

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;

use jiff::civil::Time;
use jiff::tz::TimeZone;
use serde::{Deserialize, Serialize};

use super::endpoint::{endpoints, listening, secret};
use super::tls::{Admitted, Tls};
use super::{Alerts, Checked, Map, Violation, World, identifier, violation, within};

/// One site server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Site {
    /// Letters, digits and '-'; first part of every key after `holdfast/`.
    pub id: String,
    /// For people; the id if it is empty.
    #[serde(default)]
    pub name: String,
    /// IANA name of the time zone by which days and shifts begin, and the page tells the time.
    #[serde(default = "utc")]
    pub time_zone: String,
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
    /// How good a position must be.
    #[serde(default)]
    pub tolerance: Tolerance,
    /// What is watched, and who is told.
    #[serde(default)]
    pub alerts: Alerts,
    /// What lies under the plan.
    #[serde(default)]
    pub map: Map,
    /// What telematics systems are told of the machines.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub equipment: Vec<Equipment>,
}

/// What telematics systems are told of a machine, by the names of ISO/TS 15143-3; nothing of what is left out.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Equipment {
    /// The machine's id.
    pub machine: String,
    /// Its maker.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub oem_name: Option<String>,
    /// What its maker calls it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model: Option<String>,
    /// Its maker's number.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub serial_number: Option<String>,
    /// Product identification number, ISO 10261.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pin: Option<String>,
}

/// How good a position must be.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tolerance {
    /// One sigma along the worst horizontal direction, m: up to it a machine without GNSS may work on.
    pub position_sigma_m: f64,
}

/// Page and API.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Http {
    /// Address and port.
    pub listen: SocketAddr,
    /// Names by which others reach it, beside its addresses, such as `site.example`.
    pub names: Vec<String>,
    /// Addresses of proxies, whose `X-Forwarded-For` is believed.
    pub proxies: Vec<IpAddr>,
    /// A proxy in front of it speaks HTTPS: cookies are for HTTPS alone.
    pub https: bool,
    /// Other origins whose pages may use the API with a token, such as `https://portal.example`.
    pub origins: Vec<String>,
    /// A sign-in ends after so many minutes without a request,
    pub sign_in_idle_min: f64,
    /// and after so many days in any case.
    pub sign_in_days: f64,
    /// More requests of one client are refused, after ten seconds' worth of them at once.
    pub requests_per_s: f64,
}

/// Where machines dial in.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Zenoh {
    /// Zenoh endpoints to listen on, such as `tcp/127.0.0.1:7447`.
    pub listen: Vec<String>,
    /// `listen` may be reached from other computers, and whoever dials in is believed.
    pub unauthenticated: bool,
    /// Certificates: all of `listen` is TLS, and who dials in is asked who it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls: Option<Tls>,
    /// Who may dial in, where there are certificates.
    pub admitted: Admitted,
}

impl Zenoh {
    fn check(&self) -> Result<(), Violation> {
        if self.listen.is_empty() {
            return violation(
                "zenoh.listen",
                "is empty, must name an endpoint for the machines, such as tcp/127.0.0.1:7447".to_owned(),
            );
        }
        self.admitted.check()?;
        if self.tls.is_some() {
            endpoints("zenoh.listen", &self.listen)?;
            secret("zenoh.listen", &self.listen)?;
            if self.admitted.machines.is_empty() {
                let message = "is empty, must name the machines, by the common names of their certificates";
                return violation("zenoh.admitted.machines", message.to_owned());
            }
            return Ok(());
        }
        if self.admitted != Admitted::default() {
            return violation("zenoh.admitted", "means nothing without [zenoh.tls]".to_owned());
        }
        listening("zenoh", &self.listen, self.unauthenticated, "give it certificates in [zenoh.tls], ")
    }
}

/// What is kept.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Record {
    /// Sessions go to `sessions/` in it.
    pub directory: PathBuf,
    /// Without it no session is recorded.
    pub enabled: bool,
    /// When a new session begins by itself.
    pub rotate: Rotate,
    /// When shifts begin, `HH:MM` by the site's time zone.
    pub shifts: Vec<String>,
    /// A session's next file begins after so many megabytes (10⁶ bytes),
    pub file_max_mb: f64,
    /// or after so many minutes.
    pub file_max_min: f64,
    /// When the disk has less left than so many megabytes, the recording pauses.
    pub reserve_mb: f64,
    /// Sessions that ended so many days ago are deleted; `None` keeps them for ever.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_days: Option<f64>,
    /// When all sessions are more than so many gigabytes (10⁹ bytes), the oldest are deleted; `None` keeps them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_gb: Option<f64>,
    /// Outages, alerts that were seen, and the shadow map's times are deleted when they were over so many days ago;
    /// `None` keeps them for ever.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_history_days: Option<f64>,
}

/// When a new session begins by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rotate {
    /// At midnight.
    Day,
    /// When a shift begins.
    Shift,
    /// Only when the server starts.
    Never,
}

fn utc() -> String {
    "UTC".to_owned()
}

impl Default for Http {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 8080)),
            names: Vec::new(),
            proxies: Vec::new(),
            https: false,
            origins: Vec::new(),
            sign_in_idle_min: 720.0,
            sign_in_days: 30.0,
            requests_per_s: 50.0,
        }
    }
}

impl Default for Zenoh {
    fn default() -> Self {
        Self {
            listen: vec!["tcp/127.0.0.1:7447".to_owned()],
            unauthenticated: false,
            tls: None,
            admitted: Admitted::default(),
        }
    }
}

impl Default for Record {
    fn default() -> Self {
        Self {
            directory: PathBuf::from("holdfast-data"),
            enabled: true,
            rotate: Rotate::Day,
            shifts: ["06:00", "14:00", "22:00"].map(str::to_owned).into(),
            file_max_mb: 1000.0,
            file_max_min: 60.0,
            reserve_mb: 500.0,
            keep_days: None,
            keep_gb: None,
            keep_history_days: None,
        }
    }
}

impl Default for Tolerance {
    fn default() -> Self {
        Self { position_sigma_m: 0.05 }
    }
}

impl Site {
    /// What people call it.
    pub fn display_name(&self) -> &str {
        if self.name.is_empty() { &self.id } else { &self.name }
    }

    /// The site's time zone.
    ///
    /// # Errors
    /// There is no zone of that name.
    pub fn zone(&self) -> Result<TimeZone, Violation> {
        TimeZone::get(&self.time_zone).or_else(|_| {
            violation(
                "time_zone",
                format!(
                    "is {:?}, which is no time zone; must be an IANA name such as Europe/Zurich",
                    self.time_zone
                ),
            )
        })
    }
}

impl Record {
    /// When shifts begin, by the site's clock on the wall, in order.
    ///
    /// # Errors
    /// One of them is no time of day, or there are none although they are needed.
    pub fn shift_times(&self) -> Result<Vec<Time>, Violation> {
        let mut times = Vec::new();
        for text in &self.shifts {
            match Time::strptime("%H:%M", text) {
                Ok(time) => times.push(time),
                Err(_) => {
                    let message = format!("has {text:?}, must be times of day such as 06:00");
                    return violation("record.shifts", message);
                }
            }
        }
        times.sort();
        times.dedup();
        if times.is_empty() && self.rotate == Rotate::Shift {
            let message = "is empty, must say when shifts begin if record.rotate is \"shift\"";
            return violation("record.shifts", message.to_owned());
        }
        Ok(times)
    }

    fn check(&self) -> Result<(), Violation> {
        self.shift_times()?;
        let numbers = [
            ("record.file_max_mb", Some(self.file_max_mb), 1.0),
            ("record.file_max_min", Some(self.file_max_min), 0.01),
            ("record.reserve_mb", Some(self.reserve_mb), 0.0),
            ("record.keep_days", self.keep_days, 0.0),
            ("record.keep_gb", self.keep_gb, 0.0),
        ];
        for (key, value, least) in numbers {
            // A NaN is in no range.
            if value.is_some_and(|value| !(least..=1e9).contains(&value)) {
                let value = value.unwrap_or(f64::NAN);
                return violation(key, format!("is {value}, must be from {least} to 1e9"));
            }
        }
        if let Some(days) = self.keep_history_days {
            within("record.keep_history_days", days, 1.0, 36_500.0)?;
        }
        Ok(())
    }
}

impl Http {
    /// Whether others than this computer can reach it, so that there must be accounts.
    pub fn is_reachable(&self) -> bool {
        let proxied = self.https || !self.names.is_empty() || !self.proxies.is_empty();
        proxied || !self.listen.ip().is_loopback()
    }

    fn check(&self) -> Result<(), Violation> {
        let is_name = |name: &str| {
            let plain = name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b".-".contains(&byte));
            plain && (1..=253).contains(&name.len())
        };
        if let Some(name) = self.names.iter().find(|name| !is_name(name)) {
            return violation(
                "http.names",
                format!("has {name:?}, must be host names without scheme and port, such as site.example"),
            );
        }
        let is_origin = |origin: &str| {
            let rest = origin.strip_prefix("https://").or_else(|| origin.strip_prefix("http://"));
            let (name, port) = rest.map_or(("", "1"), |rest| rest.rsplit_once(':').unwrap_or((rest, "1")));
            is_name(name) && port.parse::<u16>().is_ok()
        };
        if let Some(origin) = self.origins.iter().find(|origin| !is_origin(origin)) {
            return violation(
                "http.origins",
                format!("has {origin:?}, must be origins without path, such as https://portal.example"),
            );
        }
        for (key, value, least, most) in [
            ("http.sign_in_idle_min", self.sign_in_idle_min, 1.0, 1e6),
            ("http.sign_in_days", self.sign_in_days, 0.01, 3660.0),
            ("http.requests_per_s", self.requests_per_s, 1.0, 1e6),
        ] {
            within(key, value, least, most)?;
        }
        Ok(())
    }
}

impl Checked for Site {
    fn check(&self) -> Result<(), Violation> {
        identifier("id", &self.id)?;
        self.world.check("world")?;
        self.zone()?;
        self.http.check()?;
        self.record.check()?;
        self.alerts.check()?;
        self.map.check()?;
        let mut machines = std::collections::BTreeSet::new();
        for equipment in &self.equipment {
            identifier("equipment.machine", &equipment.machine)?;
            if !machines.insert(&equipment.machine) {
                return violation("equipment.machine", format!("is {:?} twice", equipment.machine));
            }
        }
        within("tolerance.position_sigma_m", self.tolerance.position_sigma_m, 0.001, 100.0)?;
        self.zenoh.check()
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
        assert_eq!(shipped.tolerance, Tolerance::default());
        assert_eq!(shipped.alerts, Alerts::default());
        assert_eq!(shipped.map, Map::default());
        assert_eq!(shipped.time_zone, utc());
    }

    #[test]
    fn zones_shifts_and_amounts_that_are_none_are_refused() {
        for (text, expected) in [
            ("time_zone = \"Mars/Olympus\"\n", "time_zone is \"Mars/Olympus\", which is no time zone"),
            ("[record]\nshifts = [\"25:00\"]\n", "record.shifts has \"25:00\""),
            ("[record]\nrotate = \"shift\"\nshifts = []\n", "record.shifts is empty"),
            ("[record]\nfile_max_mb = 0.0\n", "record.file_max_mb is 0, must be from 1 to 1e9"),
            ("[record]\nkeep_days = nan\n", "record.keep_days is NaN"),
            ("[record]\nkeep_history_days = 0\n", "record.keep_history_days is 0, must be from 1"),
            (
                "[[equipment]]\nmachine = \"a\"\n[[equipment]]\nmachine = \"a\"\n",
                "equipment.machine is \"a\" twice",
            ),
            ("[record]\nreserve_mb = -1\n", "record.reserve_mb is -1"),
            ("[tolerance]\nposition_sigma_m = 0\n", "tolerance.position_sigma_m is 0, must be from 0.001"),
        ] {
            let (head, table) = if text.starts_with('[') { ("", text) } else { (text, "") };
            let message = error(&format!("{head}{MINIMAL}{table}"));
            assert!(message.contains(expected), "{message}");
        }
        let text =
            format!("time_zone = \"Europe/Zurich\"\n{MINIMAL}[record]\nshifts = [\"18:30\", \"06:00\"]\n");
        let site = parse::<Site>(&text, Path::new("s.toml")).expect("valid");
        let times = site.record.shift_times().expect("times");
        assert_eq!(times, [Time::constant(6, 0, 0, 0), Time::constant(18, 30, 0, 0)]);
        assert_eq!(site.zone().expect("a zone").iana_name(), Some("Europe/Zurich"));
    }

    #[test]
    fn what_others_can_reach_is_known_as_such() {
        let http = |text: &str| {
            parse::<Site>(&format!("{MINIMAL}[http]\n{text}\n"), Path::new("s.toml")).expect("valid").http
        };
        for text in ["0.0.0.0:8080", "192.168.1.2:80", "[::]:8080"] {
            assert!(http(&format!("listen = \"{text}\"")).is_reachable(), "{text}");
        }
        for text in ["127.0.0.1:0", "127.1.2.3:8080", "[::1]:8080"] {
            assert!(!http(&format!("listen = \"{text}\"")).is_reachable(), "{text}");
        }
        for text in ["names = [\"site.example\"]", "proxies = [\"127.0.0.1\"]", "https = true"] {
            assert!(http(text).is_reachable(), "{text}");
        }
        assert!(!http("origins = [\"https://portal.example\"]").is_reachable());
    }

    #[test]
    fn names_origins_and_limits_that_are_none_are_refused() {
        for (text, expected) in [
            ("names = [\"http://a\"]", "s.toml:7:1: http.names has \"http://a\""),
            ("origins = [\"https://a/\"]", "http.origins has \"https://a/\""),
            ("origins = [\"a.example\"]", "http.origins has"),
            ("origins = [\"https://a:x\"]", "http.origins has"),
            ("sign_in_idle_min = 0", "http.sign_in_idle_min is 0, must be from 1"),
            ("requests_per_s = nan", "http.requests_per_s is NaN"),
            ("proxies = [\"proxy\"]", "invalid IP address"),
        ] {
            let message = error(&format!("{MINIMAL}[http]\n{text}\n"));
            assert!(message.contains(expected), "{message}");
        }
        let text = "[http]\norigins = [\"https://portal.example:8443\", \"http://a\"]\n";
        assert!(parse::<Site>(&format!("{MINIMAL}{text}"), Path::new("s.toml")).is_ok());
    }

    #[test]
    fn alerts_that_cannot_be_are_refused_with_their_line() {
        let hook = |rest: &str| format!("[[alerts.webhook]]\nname = \"a\"\n{rest}\n");
        let mail = |rest: &str| {
            format!("[alerts.mail]\nhost = \"m\"\nport = 25\nfrom = \"a@b.c\"\nto = [\"d@e.f\"]\n{rest}\n")
        };
        for (text, expected) in [
            ("[alerts.disk_low]\nfre_gb = 1\n".to_owned(), "s.toml:7:1: unknown field `fre_gb`"),
            ("[alerts.disk]\nfree_gb = 1\n".to_owned(), "s.toml:6:9: unknown field `disk`"),
            ("[alerts.clock_off]\nafter_s = -1\n".to_owned(), "s.toml:7:1: alerts.clock_off.after_s is -1"),
            ("[alerts.clock_off]\nclear_off_s = 0.6\n".to_owned(), "must be from 0 to 0.5"),
            ("[alerts.disk_low]\nclear_free_gb = 4\n".to_owned(), "must be from 5 to"),
            (hook("url = \"ftp://x\""), "s.toml:8:1: alerts.webhook.url is \"ftp://x\""),
            (mail("user = \"u\""), "alerts.mail.user and password_file go together"),
            (mail("user = \"u\"\npassword_file = \"p\"\ntls = \"none\""), "alerts.mail.tls is \"none\""),
        ] {
            let message = error(&format!("{MINIMAL}{text}"));
            assert!(message.contains(expected), "{message}");
        }
        let off = format!(
            "{MINIMAL}[alerts.disk_low]\nenabled = false\n[alerts.outage_longer]\nlonger_than_s = 5\n"
        );
        let rules = parse::<Site>(&off, Path::new("s.toml")).expect("valid").alerts.rules();
        assert_eq!((rules.len(), rules[0].raise), (8, 5.0));
    }

    #[test]
    fn basemap_is_optional_and_what_is_wrong_with_it_is_told_with_its_line() {
        let text = format!("{MINIMAL}[map]\nbasemap_file = \"pit.pmtiles\"\nattribution = \"© A & B\"\n");
        let map = parse::<Site>(&text, Path::new("s.toml")).expect("valid").map;
        assert_eq!(map.basemap_file.as_deref(), Some(Path::new("pit.pmtiles")));
        assert_eq!(map.attribution.as_deref(), Some("© A & B"));
        let long = "x".repeat(301);
        for (text, expected) in [
            ("basemap = \"x\"", "s.toml:7:1: unknown field `basemap`"),
            ("attribution = \"A\"", "s.toml:7:1: map.attribution means nothing without map.basemap_file"),
            ("basemap_file = \"x\"\nattribution = \"a\\nb\"", "s.toml:8:1: map.attribution has 3 characters"),
            (&format!("basemap_file = \"x\"\nattribution = \"{long}\""), "must be one line of 300 at most"),
        ] {
            let message = error(&format!("{MINIMAL}[map]\n{text}\n"));
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn unknown_key_and_empty_endpoints_are_refused() {
        assert!(error(&format!("{MINIMAL}[http]\nlissten = \"x\"\n")).contains("s.toml:7:1: unknown field"));
        assert!(error(&format!("{MINIMAL}[zenoh]\nlisten = []\n")).contains("zenoh.listen is empty"));
    }
}
