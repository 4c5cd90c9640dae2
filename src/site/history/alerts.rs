//! Alerts and what is to be delivered of them, in the database.

use rusqlite::{OptionalExtension as _, Result, Row, params};

use super::database::Database;
use super::outages::{Cursor, json_error};
use crate::fleet::{Alert, AlertState, RuleKind};
use crate::time::Stamp;

/// So much waits for one channel at most; the oldest are given up for the newest.
const DELIVERIES_MAX: i64 = 1000;

/// Which alerts.
#[derive(Clone, Debug, Default)]
pub(in crate::site) struct AlertFilter {
    pub machine: Option<String>,
    pub rule: Option<RuleKind>,
    pub state: Option<AlertState>,
    /// Those that were raised from here on, and before.
    pub from: Option<Stamp>,
    pub to: Option<Stamp>,
    /// Those after this one, in the order of the list.
    pub after: Option<Cursor>,
    pub limit: usize,
}

/// An alert that a channel is to be told of.
#[derive(Debug)]
pub(in crate::site) struct Delivery {
    pub id: i64,
    /// As it was then.
    pub alert: Alert,
    pub failures: u32,
    /// Waits since then, and not to be tried before.
    pub since: Stamp,
    pub due: Stamp,
}

fn body(row: &Row<'_>) -> Result<Alert> {
    let text: String = row.get(0)?;
    serde_json::from_str(&text).map_err(json_error)
}

impl Database {
    /// Keeps alerts that changed, and what the channels are to be told, both or nothing.
    pub fn put_alerts(&mut self, alerts: &[Alert], channels: &[String]) -> Result<()> {
        let transaction = self.connection.transaction()?;
        for alert in alerts {
            let body = serde_json::to_string(alert).map_err(json_error)?;
            transaction.execute(
                "INSERT INTO alerts (id, rule, machine, state, raised_ns, body) VALUES (?1, ?2, ?3, ?4, ?5, ?6)
                 ON CONFLICT (id) DO UPDATE SET state = ?4, body = ?6",
                params![
                    alert.id,
                    alert.rule.name(),
                    alert.machine,
                    alert.state.name(),
                    alert.raised.as_nanos(),
                    body
                ],
            )?;
            for channel in channels {
                transaction.execute(
                    "INSERT INTO deliveries (channel, alert, body, failures, since_ns, due_ns)
                     VALUES (?1, ?2, ?3, 0, ?4, ?4)",
                    params![channel, alert.id, body, alert.changed.as_nanos()],
                )?;
            }
        }
        for channel in channels {
            let dropped = transaction.execute(
                "DELETE FROM deliveries WHERE channel = ?1 AND id <= (SELECT id FROM deliveries
                 WHERE channel = ?1 ORDER BY id DESC LIMIT 1 OFFSET ?2)",
                params![channel, DELIVERIES_MAX],
            )?;
            if dropped > 0 {
                tracing::error!("{channel}: {dropped} alerts are given up: too many wait");
            }
        }
        transaction.commit()
    }

    /// Those that are not both over and seen.
    pub fn open_alerts(&mut self) -> Result<Vec<Alert>> {
        let mut found = self.connection.prepare("SELECT body FROM alerts WHERE state <> 'cleared'")?;
        found.query_map([], body)?.collect()
    }

    /// One alert.
    pub fn alert(&mut self, id: &str) -> Result<Option<Alert>> {
        self.connection.query_row("SELECT body FROM alerts WHERE id = ?1", [id], body).optional()
    }

    /// Newest first, and where the list goes on.
    pub fn alerts(&mut self, filter: &AlertFilter) -> Result<(Vec<Alert>, Option<Cursor>)> {
        let mut found = self.connection.prepare(
            "SELECT body FROM alerts WHERE (?1 IS NULL OR machine = ?1) AND (?2 IS NULL OR rule = ?2)
             AND (?3 IS NULL OR state = ?3) AND (?4 IS NULL OR raised_ns >= ?4) AND (?5 IS NULL OR raised_ns < ?5)
             AND (?6 IS NULL OR (raised_ns, id) < (?6, ?7)) ORDER BY raised_ns DESC, id DESC LIMIT ?8",
        )?;
        let AlertFilter { machine, rule, state, from, to, after, limit } = filter;
        let rows = found.query_map(
            params![
                machine,
                rule.map(RuleKind::name),
                state.map(AlertState::name),
                from.map(Stamp::as_nanos),
                to.map(Stamp::as_nanos),
                after.as_ref().map(|cursor| cursor.start.as_nanos()),
                after.as_ref().map(|cursor| &cursor.id),
                i64::try_from(limit + 1).unwrap_or(i64::MAX),
            ],
            body,
        )?;
        let mut alerts: Vec<Alert> = rows.collect::<Result<_>>()?;
        let goes_on = alerts.len() > *limit;
        alerts.truncate(*limit);
        let last = alerts.last().filter(|_| goes_on);
        let next = last.map(|last| Cursor { start: last.raised, id: last.id.clone() });
        Ok((alerts, next))
    }

    /// What a channel is to be told next: the oldest, whenever it is due, so that the order stays.
    pub fn next_delivery(&mut self, channel: &str) -> Result<Option<Delivery>> {
        let delivery = |row: &Row<'_>| {
            let stamp = |index| row.get(index).map(Stamp::from_nanos);
            let (since, due) = (stamp(3)?, stamp(4)?);
            Ok(Delivery { id: row.get(1)?, alert: body(row)?, failures: row.get(2)?, since, due })
        };
        let text = "SELECT body, id, failures, since_ns, due_ns FROM deliveries WHERE channel = ?1
                    ORDER BY id LIMIT 1";
        self.connection.query_row(text, [channel], delivery).optional()
    }

    /// It is delivered, or given up.
    pub fn delivered(&mut self, id: i64) -> Result<()> {
        self.connection.execute("DELETE FROM deliveries WHERE id = ?1", [id]).map(|_| ())
    }

    /// It is to be tried again.
    pub fn not_delivered(&mut self, id: i64, failures: u32, due: Stamp) -> Result<()> {
        let text = "UPDATE deliveries SET failures = ?2, due_ns = ?3 WHERE id = ?1";
        self.connection.execute(text, params![id, failures, due.as_nanos()]).map(|_| ())
    }

    /// Nothing waits for channels that are not in the site file any more.
    pub fn forget_other_channels(&mut self, channels: &[String]) -> Result<()> {
        let known = serde_json::to_string(channels).map_err(json_error)?;
        let text = "DELETE FROM deliveries WHERE channel NOT IN (SELECT value FROM json_each(?1))";
        self.connection.execute(text, [known]).map(|_| ())
    }
}

/// One that was raised then, for tests.
#[cfg(test)]
pub(super) fn an_alert(number: i64, state: AlertState) -> Alert {
    let raised = Stamp::from_nanos(number);
    Alert {
        id: format!("disk_low..{number}"),
        rule: RuleKind::DiskLow,
        severity: crate::fleet::AlertSeverity::Critical,
        machine: None,
        part: None,
        message: "little left".to_owned(),
        value: 1.0,
        worst: 1.0,
        state,
        raised,
        times: 1,
        cleared: None,
        acknowledged: None,
        changed: raised,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_waits_is_bounded_keeps_its_order_and_goes_with_its_channel() {
        let mut database = Database::in_memory().expect("opens");
        let channels = ["mail".to_owned(), "webhook:a".to_owned()];
        for number in 0..1005 {
            database.put_alerts(&[an_alert(number, AlertState::Active)], &channels).expect("kept");
        }
        let first = database.next_delivery("mail").expect("read").expect("waits");
        assert_eq!(first.alert.id, "disk_low..5", "the oldest are given up");
        database.not_delivered(first.id, 3, Stamp::from_nanos(77)).expect("kept");
        let again = database.next_delivery("mail").expect("read").expect("waits");
        assert_eq!((again.id, again.failures, again.due), (first.id, 3, Stamp::from_nanos(77)));
        database.delivered(first.id).expect("kept");
        let next = database.next_delivery("mail").expect("read").expect("waits");
        assert_eq!(next.alert.id, "disk_low..6");
        database.forget_other_channels(&channels[..1]).expect("kept");
        assert!(database.next_delivery("webhook:a").expect("read").is_none());
        assert!(database.next_delivery("mail").expect("read").is_some());
        assert_eq!(
            database.open_alerts().expect("read").len(),
            1005,
            "alerts are kept, whatever was delivered"
        );
    }
}
