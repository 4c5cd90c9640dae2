//! Alerts with an injected clock.

use super::*;

fn at(seconds: f64) -> Stamp {
    Stamp::from_seconds(1_795_410_000.0 + seconds)
}

fn rule(kind: RuleKind, raise: f64, clear: f64) -> AlertRule {
    let (after, clear_after) = (Span::from_millis(2_000), Span::from_millis(5_000));
    AlertRule { kind, severity: AlertSeverity::Warning, raise, clear, after, clear_after }
}

/// One rule for machine `a`.
struct Watched {
    alerts: Alerts,
    kind: RuleKind,
}

impl Watched {
    fn new(kind: RuleKind, raise: f64, clear: f64) -> Self {
        Self { alerts: Alerts::new([rule(kind, raise, clear)], Vec::new()), kind }
    }

    /// The value holds from one second to another; what changed, and when.
    fn holds(&mut self, from: u32, to: u32, value: impl Into<Option<f64>>) -> Vec<(u32, AlertState)> {
        let value = value.into();
        let mut changed = Vec::new();
        for second in from..to {
            let subject = Subject { rule: self.kind, machine: Some("a".to_owned()), part: None };
            let observation = Observation { subject, value, message: format!("it is {value:?}") };
            let alerts = self.alerts.observe(vec![observation], at(f64::from(second)));
            changed.extend(alerts.into_iter().map(|alert| (second, alert.state)));
        }
        changed
    }

    fn id(&self) -> String {
        self.alerts.open()[0].id.clone()
    }
}

#[test]
fn alert_is_raised_after_its_delay_and_cleared_below_its_hysteresis() {
    let mut watched = Watched::new(RuleKind::ClockOff, 0.5, 0.2);
    assert_eq!(watched.holds(0, 2, 0.6), []);
    assert_eq!(watched.holds(2, 3, 0.4), [], "a moment of less starts it anew");
    assert_eq!(watched.holds(3, 10, 0.6), [(5, AlertState::Active)]);
    assert_eq!(watched.holds(10, 60, 0.3), [], "between the two");
    assert_eq!(watched.holds(60, 64, 0.1), []);
    assert_eq!(watched.holds(64, 66, 0.3), [], "starts anew");
    assert_eq!(watched.holds(66, 80, 0.1), [(71, AlertState::ClearedUnacknowledged)]);
    let open = watched.alerts.open();
    assert_eq!((open.len(), open[0].worst, open[0].cleared), (1, 0.6, Some(at(71.0))));
    assert_eq!(watched.holds(80, 90, 0.9), [(82, AlertState::Active)], "the same alert again");
    assert_eq!((watched.alerts.open()[0].times, watched.alerts.open()[0].raised), (2, at(5.0)));
}

#[test]
fn acknowledged_alert_is_gone_when_it_is_over_and_one_that_is_over_when_it_is_seen() {
    let mut watched = Watched::new(RuleKind::MachineLost, 0.0, 0.0);
    watched.holds(0, 10, 1.0);
    let id = watched.id();
    let alert = watched.alerts.acknowledge(&id, "ana", "on my way", at(10.0)).expect("there");
    assert_eq!(alert.state, AlertState::Acknowledged);
    let by = alert.acknowledged.expect("seen");
    assert_eq!((by.by.as_str(), by.note.as_str(), by.at), ("ana", "on my way", at(10.0)));
    assert_eq!(watched.alerts.acknowledge(&id, "bo", "", at(11.0)), Err(Unacknowledged::Already));
    assert_eq!(watched.holds(12, 20, 0.0), [(17, AlertState::Cleared)]);
    assert_eq!(watched.alerts.open(), []);
    assert_eq!(watched.alerts.acknowledge(&id, "bo", "", at(21.0)), Err(Unacknowledged::Unknown));

    watched.holds(30, 40, 1.0);
    assert_ne!(watched.id(), id, "another one");
    watched.holds(40, 50, 0.0);
    let id = watched.id();
    let alert = watched.alerts.acknowledge(&id, "ana", "", at(50.0)).expect("there");
    assert_eq!((alert.state, watched.alerts.open().len()), (AlertState::Cleared, 0));
}

#[test]
fn what_nobody_knows_changes_nothing() {
    let mut watched = Watched::new(RuleKind::SigmaOverTolerance, 1.0, 0.8);
    watched.holds(0, 10, 2.0);
    assert_eq!(watched.holds(10, 100, None), []);
    assert_eq!(watched.alerts.open()[0].state, AlertState::Active);
    assert_eq!(watched.holds(100, 105, 0.1), [], "the time before does not count");
}

#[test]
fn of_the_disk_less_is_worse() {
    let mut watched = Watched::new(RuleKind::DiskLow, 5.0, 6.0);
    assert_eq!(watched.holds(0, 10, 5.5), []);
    assert_eq!(watched.holds(10, 20, 4.0), [(12, AlertState::Active)]);
    assert_eq!(watched.holds(20, 22, 3.0), []);
    assert_eq!(watched.holds(22, 40, 5.5), []);
    assert_eq!(watched.holds(40, 50, 6.0), [(45, AlertState::ClearedUnacknowledged)]);
    assert_eq!(watched.alerts.open()[0].worst, 3.0);
}

#[test]
fn alerts_of_an_earlier_run_go_on() {
    let mut watched = Watched::new(RuleKind::MachineLost, 0.0, 0.0);
    watched.holds(0, 10, 1.0);
    let open = watched.alerts.open();
    let text = serde_json::to_string(&open).expect("JSON");
    let open: Vec<Alert> = serde_json::from_str(&text).expect("comes back");
    watched.alerts = Alerts::new([rule(RuleKind::MachineLost, 0.0, 0.0)], open);
    assert_eq!(watched.holds(20, 30, 1.0), [], "it is known");
    assert_eq!(watched.holds(30, 40, 0.0), [(35, AlertState::ClearedUnacknowledged)]);
}

#[test]
fn kind_without_a_rule_raises_nothing() {
    let mut watched = Watched::new(RuleKind::MachineLost, 0.0, 0.0);
    watched.kind = RuleKind::ClockOff;
    assert_eq!(watched.holds(0, 100, 1e9), []);
}

#[test]
fn deliveries_are_tried_again_ever_more_rarely() {
    let seconds: Vec<f64> = [0, 1, 2, 3, 10, 11, 40, u32::MAX].map(|n| retry_after(n).as_seconds()).into();
    assert_eq!(seconds, [1.0, 1.0, 2.0, 4.0, 512.0, 600.0, 600.0, 600.0]);
}

#[test]
fn alert_of_a_rule_that_is_no_more_ends_and_is_told() {
    let mut watched = Watched::new(RuleKind::MachineLost, 0.0, 0.0);
    watched.holds(0, 10, 1.0);
    let id = watched.id();
    let mut seen = watched.alerts.open();
    let mut without_it = Alerts::new([rule(RuleKind::ClockOff, 0.5, 0.2)], seen.clone());
    let ended = without_it.observe(Vec::new(), at(20.0));
    assert_eq!((ended.len(), ended[0].state), (1, AlertState::ClearedUnacknowledged));
    assert_eq!(without_it.observe(Vec::new(), at(21.0)), [], "told once");
    assert_eq!(without_it.acknowledge(&id, "ana", "", at(22.0)).expect("open").state, AlertState::Cleared);
    assert_eq!(without_it.open(), []);
    seen[0].state = AlertState::Acknowledged;
    let mut without_it = Alerts::new([rule(RuleKind::ClockOff, 0.5, 0.2)], seen);
    assert_eq!(without_it.observe(Vec::new(), at(20.0))[0].state, AlertState::Cleared);
    assert_eq!(without_it.open(), []);
}
