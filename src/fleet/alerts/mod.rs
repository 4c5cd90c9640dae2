//! Alerts: what somebody should look at, until somebody did.
//!
//! Pure like the room: what the fleet shows and the time come in, alerts that changed come out.
//! ```text
//!        too much for `after`            acknowledged
//!   ─────────────────────────▶ active ────────────────▶ acknowledged
//!                               ▲  │ fine for `clear_after`    │ fine for `clear_after`
//!                   too much    │  ▼                           ▼
//!                    again      cleared_unacknowledged ──▶ cleared
//!                                           acknowledged
//! ```
//! *Too much* is above `raise`, *fine* is not above `clear`; in between nothing changes. What cannot be known (the
//! sigma of a machine that is lost) changes nothing either.

mod observe;

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::view::UtcTime;
use crate::time::{Span, Stamp};

pub use observe::{SiteState, observations};

/// Alerts that nobody acknowledged are held up to this number; the oldest that are cleared go first.
const OPEN_MAX: usize = 10_000;

/// What is watched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum RuleKind {
    /// A GNSS outage lasts.
    OutageLonger,
    /// Sigma of a machine's position over the site's tolerance.
    SigmaOverTolerance,
    /// A machine is not connected, or silent.
    MachineLost,
    /// A machine's clock is not the site's.
    ClockOff,
    /// The disk of the recordings has little left.
    DiskLow,
    /// A machine's newest estimate is old when it is told.
    EstimatorLate,
    /// A sensor that spoke is silent.
    SensorSilent,
}

impl RuleKind {
    /// All, in the order of their declaration.
    pub const ALL: [RuleKind; 7] = [
        RuleKind::OutageLonger,
        RuleKind::SigmaOverTolerance,
        RuleKind::MachineLost,
        RuleKind::ClockOff,
        RuleKind::DiskLow,
        RuleKind::EstimatorLate,
        RuleKind::SensorSilent,
    ];

    /// The name in files and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            RuleKind::OutageLonger => "outage_longer",
            RuleKind::SigmaOverTolerance => "sigma_over_tolerance",
            RuleKind::MachineLost => "machine_lost",
            RuleKind::ClockOff => "clock_off",
            RuleKind::DiskLow => "disk_low",
            RuleKind::EstimatorLate => "estimator_late",
            RuleKind::SensorSilent => "sensor_silent",
        }
    }
}

/// How much an alert matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum AlertSeverity {
    /// To know.
    Info,
    /// Look at it.
    Warning,
    /// Look at it now.
    Critical,
}

/// When a rule raises an alert, and when it clears it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AlertRule {
    /// What it watches.
    pub kind: RuleKind,
    /// How much its alerts matter.
    pub severity: AlertSeverity,
    /// Above it is too much; of [`RuleKind::DiskLow`], below it.
    pub raise: f64,
    /// Up to it is fine; of [`RuleKind::DiskLow`], from it on.
    pub clear: f64,
    /// Too much for so long raises the alert.
    pub after: Span,
    /// Fine for so long clears it.
    pub clear_after: Span,
}

/// Where an alert stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum AlertState {
    /// It goes on, and nobody said that they saw it.
    Active,
    /// It goes on, and somebody saw it.
    Acknowledged,
    /// It is over, and nobody said that they saw it.
    ClearedUnacknowledged,
    /// It is over, and somebody saw it.
    Cleared,
}

impl AlertState {
    /// The name in files and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            AlertState::Active => "active",
            AlertState::Acknowledged => "acknowledged",
            AlertState::ClearedUnacknowledged => "cleared_unacknowledged",
            AlertState::Cleared => "cleared",
        }
    }
}

/// Who saw an alert.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Acknowledgement {
    /// Who.
    pub by: String,
    /// When.
    pub at: Stamp,
    /// What they wrote; may be empty.
    pub note: String,
}

/// An alert.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Alert {
    /// Unique on the site.
    pub id: String,
    /// Which rule.
    pub rule: RuleKind,
    /// How much it matters.
    pub severity: AlertSeverity,
    /// Whose; `None` if it is the site's.
    pub machine: Option<String>,
    /// Which part of it: a sensor's name.
    pub part: Option<String>,
    /// In words, as it was when it was raised.
    pub message: String,
    /// What the rule watches, when it was raised, and at worst.
    pub value: f64,
    /// See `value`.
    pub worst: f64,
    /// Where it stands.
    pub state: AlertState,
    /// When it was raised first.
    pub raised: Stamp,
    /// How often, before somebody saw it.
    pub times: u32,
    /// When it was over.
    pub cleared: Option<Stamp>,
    /// Who saw it.
    pub acknowledged: Option<Acknowledgement>,
    /// When it changed last.
    pub changed: Stamp,
}

/// What a rule watches, of whom.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Subject {
    /// Which rule.
    pub rule: RuleKind,
    /// Whose; `None` is the site.
    pub machine: Option<String>,
    /// Which part of it.
    pub part: Option<String>,
}

/// What is the case.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// Of what.
    pub subject: Subject,
    /// In the rule's unit; `None` if nobody knows.
    pub value: Option<f64>,
    /// In words, if it is too much.
    pub message: String,
}

/// Why an alert cannot be acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unacknowledged {
    /// There is none of that name that is open.
    Unknown,
    /// Somebody was faster.
    Already,
}

#[derive(Debug, Default)]
struct Watch {
    /// Since when it is too much, or fine, without interruption.
    bad_since: Option<Stamp>,
    fine_since: Option<Stamp>,
    /// The alert that is not both cleared and acknowledged.
    alert: Option<Alert>,
}

/// The rules, and the alerts that they raised.
#[derive(Debug)]
pub struct Alerts {
    rules: BTreeMap<RuleKind, AlertRule>,
    watches: BTreeMap<Subject, Watch>,
}

impl Alerts {
    /// At most one rule of a kind; the last one counts. `open` are alerts of an earlier run; those whose rule is gone
    /// are over, and told so with the first observation.
    pub fn new(rules: impl IntoIterator<Item = AlertRule>, open: Vec<Alert>) -> Self {
        let rules = rules.into_iter().map(|rule| (rule.kind, rule)).collect();
        let mut watches: BTreeMap<Subject, Watch> = BTreeMap::new();
        for alert in open {
            let subject =
                Subject { rule: alert.rule, machine: alert.machine.clone(), part: alert.part.clone() };
            watches.entry(subject).or_default().alert = Some(alert);
        }
        Self { rules, watches }
    }

    /// Takes in what is the case at `now`. Returns the alerts that changed.
    pub fn observe(&mut self, observations: Vec<Observation>, now: Stamp) -> Vec<Alert> {
        let mut changed = self.end_without_rule(now);
        for observation in observations {
            let Some(rule) = self.rules.get(&observation.subject.rule) else { continue };
            let watch = self.watches.entry(observation.subject.clone()).or_default();
            changed.extend(watch.observe(rule, observation, now));
        }
        self.watches.retain(|_, watch| watch.alert.is_some() || watch.bad_since.is_some());
        changed.extend(self.forget_too_many(now));
        changed
    }

    /// Somebody saw it.
    ///
    /// # Errors
    /// [`Unacknowledged`]: it is not there, or somebody was faster.
    pub fn acknowledge(
        &mut self,
        id: &str,
        by: &str,
        note: &str,
        now: Stamp,
    ) -> Result<Alert, Unacknowledged> {
        let watch = self.watches.values_mut().find(|watch| watch.alert.as_ref().is_some_and(|a| a.id == id));
        let watch = watch.ok_or(Unacknowledged::Unknown)?;
        let alert = watch.alert.as_mut().ok_or(Unacknowledged::Unknown)?;
        alert.state = match alert.state {
            AlertState::Active => AlertState::Acknowledged,
            AlertState::ClearedUnacknowledged => AlertState::Cleared,
            AlertState::Acknowledged | AlertState::Cleared => return Err(Unacknowledged::Already),
        };
        alert.acknowledged = Some(Acknowledgement { by: by.to_owned(), at: now, note: note.to_owned() });
        alert.changed = now;
        let alert = alert.clone();
        if alert.state == AlertState::Cleared {
            watch.alert = None;
        }
        Ok(alert)
    }

    /// Those that are not both over and seen, the newest first.
    pub fn open(&self) -> Vec<Alert> {
        let mut open: Vec<Alert> = self.watches.values().filter_map(|watch| watch.alert.clone()).collect();
        open.sort_by(|one, other| (other.raised, &other.id).cmp(&(one.raised, &one.id)));
        open
    }

    /// Alerts of an earlier run whose rule is not in force any more: nothing would ever end them.
    fn end_without_rule(&mut self, now: Stamp) -> Vec<Alert> {
        let orphans = self.watches.iter_mut().filter(|(subject, _)| !self.rules.contains_key(&subject.rule));
        orphans.filter_map(|(_, watch)| watch.end(now)).collect()
    }

    /// Memory is bounded: the oldest that are over are given up unseen.
    fn forget_too_many(&mut self, now: Stamp) -> Vec<Alert> {
        let open = self.watches.values().filter(|watch| watch.alert.is_some()).count();
        let mut forgotten = Vec::new();
        for _ in OPEN_MAX..open {
            let over = self.watches.values_mut().filter(|watch| {
                watch.alert.as_ref().is_some_and(|alert| alert.state == AlertState::ClearedUnacknowledged)
            });
            let oldest = over.min_by_key(|watch| watch.alert.as_ref().map(|alert| alert.raised));
            let Some(mut alert) = oldest.and_then(|watch| watch.alert.take()) else { break };
            (alert.state, alert.changed) = (AlertState::Cleared, now);
            forgotten.push(alert);
        }
        forgotten
    }
}

impl Watch {
    fn observe(&mut self, rule: &AlertRule, observation: Observation, now: Stamp) -> Option<Alert> {
        let Observation { subject, value, message } = observation;
        let Some(value) = value else {
            (self.bad_since, self.fine_since) = (None, None);
            return None;
        };
        // Of the disk, less is worse.
        let sign = if rule.kind == RuleKind::DiskLow { -1.0 } else { 1.0 };
        let (is_bad, is_fine) = (sign * value > sign * rule.raise, sign * value <= sign * rule.clear);
        self.bad_since = is_bad.then(|| self.bad_since.unwrap_or(now));
        self.fine_since = is_fine.then(|| self.fine_since.unwrap_or(now));
        let raises = self.bad_since.is_some_and(|since| now - since >= rule.after);
        let clears = self.fine_since.is_some_and(|since| now - since >= rule.clear_after);
        let Some(alert) = &mut self.alert else {
            if raises {
                self.alert = Some(Alert::raise(subject, rule, value, message, now));
            }
            return self.alert.clone();
        };
        alert.worst = if sign * value > sign * alert.worst { value } else { alert.worst };
        match alert.state {
            AlertState::Active | AlertState::Acknowledged if clears => self.end(now),
            AlertState::ClearedUnacknowledged if raises => {
                alert.state = AlertState::Active;
                alert.times = alert.times.saturating_add(1);
                (alert.message, alert.value) = (message, value);
                (alert.cleared, alert.changed) = (None, now);
                Some(alert.clone())
            }
            _ => None,
        }
    }
}

impl Watch {
    /// What its alert tells of is over; nothing if it was already.
    fn end(&mut self, now: Stamp) -> Option<Alert> {
        let alert = self.alert.as_mut()?;
        let seen = match alert.state {
            AlertState::Active => false,
            AlertState::Acknowledged => true,
            AlertState::ClearedUnacknowledged | AlertState::Cleared => return None,
        };
        alert.state = if seen { AlertState::Cleared } else { AlertState::ClearedUnacknowledged };
        (alert.cleared, alert.changed) = (Some(now), now);
        if seen { self.alert.take() } else { Some(alert.clone()) }
    }
}

impl Alert {
    fn raise(subject: Subject, rule: &AlertRule, value: f64, message: String, now: Stamp) -> Self {
        let Subject { rule: kind, machine, part } = subject;
        let of = [machine.as_deref(), part.as_deref()].into_iter().flatten().collect::<Vec<_>>().join(".");
        Self {
            id: format!("{}.{of}.{}", kind.name(), now.as_nanos()),
            rule: kind,
            severity: rule.severity,
            machine,
            part,
            message,
            value,
            worst: value,
            state: AlertState::Active,
            raised: now,
            times: 1,
            cleared: None,
            acknowledged: None,
            changed: now,
        }
    }
}

/// How long to wait before a delivery that failed so often is tried again: 1 s, 2 s, 4 s, ... 10 min.
pub fn retry_after(failures: u32) -> Span {
    let seconds = 1_i64.checked_shl(failures.saturating_sub(1).min(30)).unwrap_or(i64::MAX);
    Span::from_millis(1_000 * seconds.clamp(1, 600))
}

/// Who saw an alert, as the API says it.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct AcknowledgementView {
    /// Who.
    pub by: String,
    /// When.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub at: UtcTime,
    /// What they wrote; may be empty.
    pub note: String,
}

/// An alert, as the API says it.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct AlertView {
    /// Unique on the site.
    pub id: String,
    /// Which rule.
    pub rule: RuleKind,
    /// How much it matters.
    pub severity: AlertSeverity,
    /// Whose; `null` if it is the site's.
    pub machine: Option<String>,
    /// Which part of the machine: a sensor's name.
    pub part: Option<String>,
    /// In words, as it was when it was raised.
    pub message: String,
    /// What the rule watches when it was raised, in the unit of its threshold in the site file.
    pub value: f64,
    /// The worst since then.
    pub worst: f64,
    /// Where it stands.
    pub state: AlertState,
    /// When it was raised first.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub raised: UtcTime,
    /// How often it was raised before somebody saw it.
    pub times: u32,
    /// When it was over; `null` while it goes on.
    #[cfg_attr(feature = "shells", schema(value_type = Option<String>, format = DateTime))]
    pub cleared: Option<UtcTime>,
    /// Who saw it; `null` if nobody did.
    pub acknowledged: Option<AcknowledgementView>,
    /// When it changed last.
    #[cfg_attr(feature = "shells", schema(value_type = String, format = DateTime))]
    pub changed: UtcTime,
}

impl From<&Alert> for AlertView {
    fn from(alert: &Alert) -> Self {
        let acknowledged = alert.acknowledged.as_ref().map(|by| AcknowledgementView {
            by: by.by.clone(),
            at: UtcTime(by.at),
            note: by.note.clone(),
        });
        Self {
            id: alert.id.clone(),
            rule: alert.rule,
            severity: alert.severity,
            machine: alert.machine.clone(),
            part: alert.part.clone(),
            message: alert.message.clone(),
            value: alert.value,
            worst: alert.worst,
            state: alert.state,
            raised: UtcTime(alert.raised),
            times: alert.times,
            cleared: alert.cleared.map(UtcTime),
            acknowledged,
            changed: UtcTime(alert.changed),
        }
    }
}
