//! The site file's `[alerts]`: what is watched, and who is told.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::{Violation, violation, within};
use crate::fleet::{AlertRule, AlertSeverity, RuleKind};
use crate::time::Span;

/// Receivers of one kind at most.
const WEBHOOKS_MAX: usize = 16;
const RECIPIENTS_MAX: usize = 50;

macro_rules! rules {
    ($($(#[$doc:meta])* $name:ident / $table:ident of $kind:ident, $severity:ident:
        $raise:ident = $raise_default:literal, $clear:ident = $clear_default:literal,
        after $after:literal, clear after $clear_after:literal;)*) => {
        $($(#[$doc])*
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct $name {
            /// Whether it is watched.
            pub enabled: bool,
            /// How much it matters.
            pub severity: AlertSeverity,
            /// What raises the alert.
            pub $raise: f64,
            /// What clears it.
            pub $clear: f64,
            /// How long it must be so before the alert is raised.
            pub after_s: f64,
            /// How long it must be well before the alert is cleared.
            pub clear_after_s: f64,
        }

        impl Default for $name {
            fn default() -> Self {
                Self {
                    enabled: true,
                    severity: AlertSeverity::$severity,
                    $raise: $raise_default,
                    $clear: $clear_default,
                    after_s: $after,
                    clear_after_s: $clear_after,
                }
            }
        })*

        /// What is watched, and who is told.
        #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct Alerts {
            $($(#[$doc])* pub $table: $name,)*
            /// PEM: authorities, beside the web's, that may have signed the receivers' certificates.
            #[serde(skip_serializing_if = "Option::is_none")]
            pub certificates_file: Option<PathBuf>,
            /// Addresses that are told by HTTP.
            #[serde(skip_serializing_if = "Vec::is_empty")]
            pub webhook: Vec<Webhook>,
            /// People who are told by e-mail.
            #[serde(skip_serializing_if = "Option::is_none")]
            pub mail: Option<Mail>,
        }

        impl Alerts {
            /// The rules that are enabled.
            pub fn rules(&self) -> Vec<AlertRule> {
                let mut rules = Vec::new();
                $(if self.$table.enabled {
                    rules.push(AlertRule {
                        kind: RuleKind::$kind,
                        severity: self.$table.severity,
                        raise: self.$table.$raise,
                        clear: self.$table.$clear,
                        after: Span::from_seconds(self.$table.after_s),
                        clear_after: Span::from_seconds(self.$table.clear_after_s),
                    });
                })*
                rules
            }

            fn check_rules(&self) -> Result<(), Violation> {
                $({
                    let table = &self.$table;
                    let key = |name: &str| format!("alerts.{}.{name}", stringify!($table));
                    within(&key(stringify!($raise)), table.$raise, 0.0, 1e9)?;
                    within(&key("after_s"), table.after_s, 0.0, 1e6)?;
                    within(&key("clear_after_s"), table.clear_after_s, 0.0, 1e6)?;
                    let (low, high) = match RuleKind::$kind {
                        RuleKind::DiskLow => (table.$raise, 1e9),
                        _ => (0.0, table.$raise),
                    };
                    within(&key(stringify!($clear)), table.$clear, low, high)?;
                })*
                Ok(())
            }
        }
    };
}

rules! {
    /// A GNSS outage lasts longer.
    OutageLonger / outage_longer of OutageLonger, Warning:
        longer_than_s = 60.0, clear_s = 0.0, after 0.0, clear after 5.0;
    /// Sigma of a machine's position over so many times the site's tolerance.
    SigmaOverTolerance / sigma_over_tolerance of SigmaOverTolerance, Critical:
        ratio = 1.0, clear_ratio = 0.8, after 2.0, clear after 5.0;
    /// A machine is not connected, or says nothing new, for longer.
    MachineLost / machine_lost of MachineLost, Warning:
        longer_than_s = 10.0, clear_s = 0.0, after 0.0, clear after 5.0;
    /// A machine's clock is further off the site's.
    ClockOff / clock_off of ClockOff, Warning:
        off_s = 0.5, clear_off_s = 0.25, after 10.0, clear after 10.0;
    /// The recordings' disk has less left.
    DiskLow / disk_low of DiskLow, Critical:
        free_gb = 5.0, clear_free_gb = 6.0, after 10.0, clear after 10.0;
    /// A machine's newest estimate is older when it is told.
    EstimatorLate / estimator_late of EstimatorLate, Warning:
        late_s = 0.5, clear_late_s = 0.2, after 5.0, clear after 5.0;
    /// A sensor that spoke says nothing for longer.
    SensorSilent / sensor_silent of SensorSilent, Warning:
        longer_than_s = 3.0, clear_s = 1.5, after 0.0, clear after 2.0;
}

/// An address that is told by HTTP.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Webhook {
    /// Letters, digits and '-'; names it in logs and in the API.
    pub name: String,
    /// `http://` or `https://`.
    pub url: String,
    /// A file with the secret by which requests are signed; without it they are not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub secret_file: Option<PathBuf>,
}

/// How the connection to the mail server is kept secret.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MailTls {
    /// From the first byte on, usually at port 465.
    #[default]
    Tls,
    /// From `STARTTLS` on, usually at port 587; not without.
    Starttls,
    /// Not at all: for servers on the same computer.
    None,
}

/// People who are told by e-mail.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mail {
    /// Name or address of the SMTP server.
    pub host: String,
    /// Its port.
    pub port: u16,
    /// How the connection is kept secret.
    #[serde(default)]
    pub tls: MailTls,
    /// Who signs in; nobody if it is left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// A file with their password.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub password_file: Option<PathBuf>,
    /// The sender, such as `holdfast@example.com`.
    pub from: String,
    /// Who is told.
    pub to: Vec<String>,
}

impl Alerts {
    /// # Errors
    /// The first value that cannot be.
    pub(super) fn check(&self) -> Result<(), Violation> {
        self.check_rules()?;
        if self.webhook.len() > WEBHOOKS_MAX {
            return violation("alerts.webhook", format!("are more than {WEBHOOKS_MAX}"));
        }
        let mut names = std::collections::BTreeSet::new();
        for webhook in &self.webhook {
            super::identifier("alerts.webhook.name", &webhook.name)?;
            if !names.insert(&webhook.name) {
                return violation("alerts.webhook.name", format!("is {:?} twice", webhook.name));
            }
            if !["http://", "https://"].iter().any(|scheme| webhook.url.starts_with(scheme)) {
                let message = format!("is {:?}, must begin with http:// or https://", webhook.url);
                return violation("alerts.webhook.url", message);
            }
            let authority = webhook.url.split('/').nth(2).unwrap_or_default();
            if authority.contains('@') {
                let message = "has a name or password in it: receivers know us by the signature".to_owned();
                return violation("alerts.webhook.url", message);
            }
        }
        let Some(mail) = &self.mail else { return Ok(()) };
        if mail.to.is_empty() || mail.to.len() > RECIPIENTS_MAX {
            let message = format!("has {} addresses, must have 1 to {RECIPIENTS_MAX}", mail.to.len());
            return violation("alerts.mail.to", message);
        }
        if mail.user.is_some() != mail.password_file.is_some() {
            return violation("alerts.mail.user", "and password_file go together".to_owned());
        }
        if mail.user.is_some() && mail.tls == MailTls::None {
            let message = "is \"none\", by which the password could be read on its way".to_owned();
            return violation("alerts.mail.tls", message);
        }
        Ok(())
    }
}
