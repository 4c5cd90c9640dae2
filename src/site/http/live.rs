//! The live WebSocket: a snapshot, then what changed, at the client's rate.
//!
//! Clients are driven by the newest frame. One that does not keep up skips frames and is told how many
//! deltas it did not get; it holds up nobody. A machine's view is encoded once a frame, for all clients.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade, close_code};
use axum::response::Response;
use serde::{Deserialize, Serialize};

use super::Shared;
use super::place::Place;
use super::problem::Problem;
use super::visitor::Visitor;
use crate::fleet::{Alert, AlertView, FleetView, MachineView};
use crate::site::aggregator::{FRAME_RATE_HZ, Frame, Revision};
use crate::site::counters::add;
use crate::site::ended;

/// Rate of a client that asks for none, Hz.
const RATE_DEFAULT_HZ: f64 = 5.0;
/// The slowest rate, Hz.
const RATE_MIN_HZ: f64 = 0.1;
/// More clients at once are refused.
const CLIENTS_MAX: u64 = 256;
/// A client that takes no bytes for so long is let go.
const SEND_TIMEOUT: Duration = Duration::from_secs(10);
/// Also when nothing changed a delta comes, so that a client knows that the server is there: frames.
const QUIET_FRAMES_MAX: u64 = FRAME_RATE_HZ as u64;
/// No request is longer.
const REQUEST_BYTES_MAX: usize = 64 * 1024;
/// More names in a subscription are refused.
const MACHINES_MAX: usize = crate::fleet::MACHINES_MAX;

/// What the server sends.
#[derive(Serialize, utoipa::ToSchema)]
#[serde(tag = "type", rename_all = "snake_case")]
#[allow(
    dead_code,
    reason = "documents the messages, which are put together from parts encoded for all clients"
)]
pub(super) enum LiveMessage {
    /// First: everything.
    Snapshot {
        /// 0.
        seq: u64,
        fleet: FleetView,
    },
    /// Then: the machines that changed since the last message, each whole.
    Delta {
        /// One more than in the last message.
        seq: u64,
        /// By the site's clock; ages count up to it.
        #[schema(value_type = String, format = DateTime)]
        time: crate::fleet::UtcTime,
        machines: Vec<MachineView>,
        /// Deltas that were skipped since the last message, because this client was slow.
        dropped: u64,
    },
    /// To clients that asked for alerts, at once and whenever one changes, each second while the worst of one grows:
    /// all that are not both over and seen.
    Alerts {
        /// One more than in the last message.
        seq: u64,
        alerts: Vec<AlertView>,
    },
    /// The answer to a request that could not be understood; everything goes on as before.
    Error { detail: String },
}

/// What a client may send.
#[derive(Deserialize, utoipa::ToSchema)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum Request {
    /// Changes what is sent from now on.
    Subscribe {
        /// Deltas in a second: 5 if it is left out, 10 at most.
        #[serde(default)]
        rate_hz: Option<f64>,
        /// Only these machines; all if it is left out.
        #[serde(default)]
        machines: Option<Vec<String>>,
        /// Whether alerts are wanted, too; not if it is left out.
        #[serde(default)]
        alerts: bool,
    },
}

/// Live data as a WebSocket: one `snapshot`, then a `delta` at each turn. See the schemas `LiveMessage` and
/// `Request`.
#[utoipa::path(get, path = "/api/v1/live", tag = "fleet",
    params(("ticket" = Option<String>, Query, max_length = 64,
        description = "From `POST /api/v1/live-ticket`, for those who can send neither cookie nor token")),
    responses((status = SWITCHING_PROTOCOLS, description = "A WebSocket", body = LiveMessage),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = UPGRADE_REQUIRED, body = Problem, content_type = "application/problem+json"),
        (status = SERVICE_UNAVAILABLE, body = Problem, content_type = "application/problem+json"),
        (status = FORBIDDEN, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn live(
    State(shared): State<Shared>,
    visitor: Visitor,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let upgrade = upgrade.map_err(|rejection| Problem::new(rejection.status(), rejection.body_text()))?;
    let place = Place::take(&shared.counters, |counters| &counters.ws_clients, CLIENTS_MAX)?;
    let upgrade = upgrade.max_message_size(REQUEST_BYTES_MAX);
    Ok(upgrade.on_upgrade(async move |mut socket| {
        let _place = place;
        // An error is a client that went away: nobody is left to tell.
        let _ = talk(&mut socket, &shared, &visitor).await;
    }))
}

async fn talk(socket: &mut WebSocket, shared: &Shared, visitor: &Visitor) -> Result<(), axum::Error> {
    let mut frames = shared.frames.clone();
    let mut stopped = shared.stopped.clone();
    let mut open = shared.alerts.open.clone();
    let frame = Arc::clone(&frames.borrow_and_update());
    let mut client = Client::new(frame.number);
    let snapshot = client.snapshot(&frame);
    send(socket, snapshot).await?;
    let gone = shared.people.gone(visitor);
    tokio::pin!(gone);
    loop {
        tokio::select! {
            () = ended(&mut stopped) => {
                let reason = "the site server ends".into();
                let close = CloseFrame { code: close_code::AWAY, reason };
                return send(socket, Message::Close(Some(close))).await;
            }
            () = &mut gone => {
                let reason = "who opened this is not known any more".into();
                let close = CloseFrame { code: close_code::POLICY, reason };
                return send(socket, Message::Close(Some(close))).await;
            }
            request = socket.recv() => match request {
                None => return Ok(()),
                Some(Err(error)) => return Err(error),
                Some(Ok(Message::Text(text))) => {
                    let had_alerts = client.alerts;
                    if let Err(detail) = client.request(text.as_str()) {
                        let answer = serde_json::json!({"type": "error", "detail": detail});
                        send(socket, Message::text(answer.to_string())).await?;
                    }
                    if client.alerts && !had_alerts {
                        let alerts = Arc::clone(&open.borrow_and_update());
                        send(socket, client.alerts(&alerts)).await?;
                    }
                }
                // Pings are answered by the library.
                Some(Ok(_)) => {}
            },
            Ok(()) = open.changed(), if client.alerts => {
                let alerts = Arc::clone(&open.borrow_and_update());
                send(socket, client.alerts(&alerts)).await?;
            }
            changed = frames.changed() => {
                if changed.is_err() {
                    return Ok(());
                }
                let frame = Arc::clone(&frames.borrow_and_update());
                let skipped = client.skipped(&frame);
                add(&shared.counters.ws_dropped, skipped);
                if let Some(delta) = client.delta(&frame) {
                    send(socket, delta).await?;
                }
            }
        }
    }
}

async fn send(socket: &mut WebSocket, message: Message) -> Result<(), axum::Error> {
    match tokio::time::timeout(SEND_TIMEOUT, socket.send(message)).await {
        Ok(sent) => sent,
        Err(late) => Err(axum::Error::new(late)),
    }
}

/// What is known of one client.
struct Client {
    /// Frames from one delta to the next.
    period: u64,
    only: Option<Vec<String>>,
    /// Whether it asked for alerts.
    alerts: bool,
    sent: BTreeMap<String, Revision>,
    seq: u64,
    /// Number of the frame that was looked at last.
    looked_at: u64,
    /// Number of the frame of the last message.
    said_at: u64,
    dropped: u64,
}

impl Client {
    fn new(number: u64) -> Self {
        Self {
            period: period(RATE_DEFAULT_HZ),
            only: None,
            alerts: false,
            sent: BTreeMap::new(),
            seq: 0,
            looked_at: number,
            said_at: number,
            dropped: 0,
        }
    }

    fn snapshot(&mut self, frame: &Frame) -> Message {
        let views = &frame.view.machines;
        self.sent =
            views.iter().enumerate().map(|(at, view)| (view.id.clone(), frame.revision(at))).collect();
        let fleet = serde_json::to_string(&frame.view).unwrap_or_else(|_| "null".to_owned());
        Message::text(format!("{{\"type\":\"snapshot\",\"seq\":0,\"fleet\":{fleet}}}"))
    }

    /// Counts the deltas between the last frame that was looked at and this one, if it is this one's turn.
    fn skipped(&mut self, frame: &Frame) -> u64 {
        let periods = frame.number.saturating_sub(self.looked_at) / self.period;
        let skipped = periods.saturating_sub(1);
        self.dropped += skipped;
        skipped
    }

    /// What to send of this frame: nothing if it is not its turn, or if nothing changed for less than a second.
    fn delta(&mut self, frame: &Frame) -> Option<Message> {
        if frame.number < self.looked_at + self.period {
            return None;
        }
        self.looked_at = frame.number;
        let mut machines = Vec::new();
        for (at, view) in frame.view.machines.iter().enumerate() {
            let wanted = self.only.as_ref().is_none_or(|only| only.contains(&view.id));
            let revision = frame.revision(at);
            if wanted && self.sent.get(&view.id) != Some(&revision) {
                self.sent.insert(view.id.clone(), revision);
                machines.push(frame.json(at));
            }
        }
        if machines.is_empty() && self.dropped == 0 && frame.number < self.said_at + QUIET_FRAMES_MAX {
            return None;
        }
        self.said_at = frame.number;
        self.seq += 1;
        let (seq, time, dropped) = (self.seq, frame.view.time, std::mem::take(&mut self.dropped));
        let machines = machines.join(",");
        Some(Message::text(format!(
            "{{\"type\":\"delta\",\"seq\":{seq},\"time\":\"{time}\",\"machines\":[{machines}],\"dropped\":{dropped}}}"
        )))
    }

    /// All alerts that are open, of the machines that it wants, and the site's.
    fn alerts(&mut self, open: &[Alert]) -> Message {
        self.seq += 1;
        let is_wanted = |alert: &&Alert| match (&self.only, &alert.machine) {
            (Some(only), Some(machine)) => only.contains(machine),
            _ => true,
        };
        let alerts: Vec<AlertView> = open.iter().filter(is_wanted).map(AlertView::from).collect();
        let message = serde_json::json!({"type": "alerts", "seq": self.seq, "alerts": alerts});
        Message::text(message.to_string())
    }

    fn request(&mut self, text: &str) -> Result<(), String> {
        let Request::Subscribe { rate_hz, machines, alerts } =
            serde_json::from_str(text).map_err(|error| error.to_string())?;
        let rate_hz = rate_hz.unwrap_or(RATE_DEFAULT_HZ);
        if !rate_hz.is_finite() || rate_hz <= 0.0 {
            return Err(format!("rate_hz is {rate_hz}, must be above 0"));
        }
        if machines.as_ref().is_some_and(|machines| machines.len() > MACHINES_MAX) {
            return Err(format!("more than {MACHINES_MAX} machines"));
        }
        self.period = period(rate_hz);
        self.alerts = alerts;
        if machines != self.only {
            // Those that were not wanted before may have changed in the meantime.
            self.sent.clear();
            self.only = machines;
        }
        Ok(())
    }
}

/// Frames from one delta to the next: a whole number, so that clients of the same rate share their frames.
fn period(rate_hz: f64) -> u64 {
    (f64::from(FRAME_RATE_HZ) / rate_hz.clamp(RATE_MIN_HZ, f64::from(FRAME_RATE_HZ))).round() as u64
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;
    use crate::fleet::{Fleet, Publication, SiteDescription, Topic};
    use crate::frames::geodesy::Geodetic;
    use crate::time::Stamp;

    fn fleet() -> Fleet {
        Fleet::new(SiteDescription {
            id: "site".to_owned(),
            name: "Site".to_owned(),
            origin: Geodetic { latitude_deg: 47.0, longitude_deg: 8.0, altitude_m: 400.0 },
            time_zone: "UTC".to_owned(),
            software: "0".to_owned(),
            tolerance_m: 0.05,
        })
    }

    fn hear(fleet: &mut Fleet, machine: &str, sequence: u64) {
        let stamp = Stamp::from_nanos(sequence as i64);
        fleet.receive(machine, Topic::Pose, &Publication { sequence, boot: 1, stamp, sent: stamp }, stamp);
    }

    fn frame(fleet: &Fleet, number: u64) -> Frame {
        Frame::of(fleet, number, Stamp::from_nanos(number as i64 * 1_000_000))
    }

    fn delta(client: &mut Client, frame: &Frame) -> Option<Value> {
        client.skipped(frame);
        let message = client.delta(frame)?;
        Some(serde_json::from_str(message.to_text().expect("text")).expect("JSON"))
    }

    #[test]
    fn delta_holds_what_changed_and_nothing_else() {
        let mut fleet = fleet();
        hear(&mut fleet, "a", 0);
        hear(&mut fleet, "b", 0);
        let mut client = Client::new(10);
        client.snapshot(&frame(&fleet, 10));
        hear(&mut fleet, "b", 1);
        assert_eq!(delta(&mut client, &frame(&fleet, 11)), None, "5 Hz: every second frame");
        let changed = delta(&mut client, &frame(&fleet, 12)).expect("b changed");
        assert_eq!(
            (&changed["type"], &changed["seq"], &changed["dropped"]),
            (&"delta".into(), &1.into(), &0.into())
        );
        assert_eq!(changed["machines"].as_array().map(Vec::len), Some(1));
        assert_eq!(changed["machines"][0]["id"], "b");
        assert_eq!(delta(&mut client, &frame(&fleet, 14)), None);
        let quiet = delta(&mut client, &frame(&fleet, 22)).expect("a sign of life");
        assert_eq!((&quiet["seq"], &quiet["machines"]), (&2.into(), &Value::Array(vec![])));
    }

    #[test]
    fn slow_client_gets_the_newest_and_is_told_what_it_missed() {
        let mut fleet = fleet();
        let mut client = Client::new(0);
        client.snapshot(&frame(&fleet, 0));
        hear(&mut fleet, "a", 0);
        hear(&mut fleet, "a", 1);
        let late = delta(&mut client, &frame(&fleet, 20)).expect("changed");
        assert_eq!((&late["seq"], &late["dropped"]), (&1.into(), &9.into()));
        assert_eq!(late["machines"][0]["link"]["received"], 2);
        hear(&mut fleet, "a", 2);
        assert_eq!(delta(&mut client, &frame(&fleet, 22)).expect("changed")["dropped"], 0);
    }

    #[test]
    fn subscription_changes_rate_and_machines() {
        let mut fleet = fleet();
        hear(&mut fleet, "a", 0);
        hear(&mut fleet, "b", 0);
        let mut client = Client::new(0);
        client.snapshot(&frame(&fleet, 0));
        client.request(r#"{"type":"subscribe","rate_hz":100,"machines":["b"]}"#).expect("understood");
        let all = delta(&mut client, &frame(&fleet, 1)).expect("at 10 Hz, the cap");
        assert_eq!(all["machines"].as_array().map(Vec::len), Some(1));
        assert_eq!(all["machines"][0]["id"], "b");
        hear(&mut fleet, "a", 1);
        assert_eq!(delta(&mut client, &frame(&fleet, 2)), None, "a is not wanted");
        assert_eq!((period(10.0), period(5.0), period(3.0), period(1.0), period(1e-9)), (1, 2, 3, 10, 100));
        for text in [
            "",
            "{}",
            "[]",
            r#"{"type":"subscribe","rate_hz":-1}"#,
            r#"{"type":"subscribe","rate_hz":0}"#,
            r#"{"type":"subscribe","rate":5}"#,
            r#"{"type":"shout"}"#,
            r#"{"type":"subscribe","rate_hz":1e999}"#,
        ] {
            assert!(client.request(text).is_err(), "{text}");
        }
    }
}
