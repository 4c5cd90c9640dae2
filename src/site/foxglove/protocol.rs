//! The protocol's messages: to bytes, and from bytes.
//!
//! Sources: `docs/spec.md` of `foxglove/ws-protocol` for `foxglove.websocket.v1`; for what `foxglove.sdk.v1` adds, the
//! types in `rust/foxglove/src/protocol` of `foxglove/foxglove-sdk` 0.30. Numbers are little endian.

use axum::extract::ws::Message;
use serde::Deserialize;
use serde_json::{Value, json};

use super::channels::Channel;
use crate::time::Stamp;

/// Opcodes of binary messages of the server.
const MESSAGE_DATA: u8 = 1;
const TIME: u8 = 2;
const PLAYBACK_STATE: u8 = 5;
/// Opcode of a binary message of the client.
const PLAYBACK_CONTROL_REQUEST: u8 = 3;
/// Of status messages; 0 is information, 2 an error.
const WARNING: u8 = 1;
/// The app chooses some bytes.
const REQUEST_ID_BYTES_MAX: usize = 256;

/// Which of the two sub-protocols a client speaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::site) enum Dialect {
    /// `foxglove.websocket.v1`.
    WebSocket,
    /// `foxglove.sdk.v1`: the same, and playback control.
    Sdk,
}

impl Dialect {
    /// What is offered: of those that a client speaks, the first is taken.
    pub const ALL: [Dialect; 2] = [Dialect::Sdk, Dialect::WebSocket];

    /// As it stands in `Sec-WebSocket-Protocol`.
    pub const fn name(self) -> &'static str {
        match self {
            Dialect::WebSocket => "foxglove.websocket.v1",
            Dialect::Sdk => "foxglove.sdk.v1",
        }
    }
}

/// What playback does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PlaybackStatus {
    Playing = 0,
    Paused = 1,
    Ended = 3,
}

/// A client's wish for playback.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct PlaybackRequest {
    pub play: bool,
    pub speed: f64,
    pub seek: Option<Stamp>,
    pub id: String,
}

/// What a client asks for.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Request {
    Subscribe(Vec<(u32, u32)>),
    Unsubscribe(Vec<u32>),
    GetParameters { names: Vec<String>, id: Option<String> },
    SetParameters { parameters: Vec<Parameter>, id: Option<String> },
    SubscribeParameters(Vec<String>),
    UnsubscribeParameters(Vec<String>),
    Playback(PlaybackRequest),
}

/// A named value.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub(super) struct Parameter {
    pub name: String,
    #[serde(default)]
    pub value: Value,
}

#[derive(Deserialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
enum Asked {
    Subscribe {
        subscriptions: Vec<Subscription>,
    },
    Unsubscribe {
        subscription_ids: Vec<u32>,
    },
    GetParameters {
        #[serde(default)]
        parameter_names: Vec<String>,
        id: Option<String>,
    },
    SetParameters {
        parameters: Vec<Parameter>,
        id: Option<String>,
    },
    SubscribeParameterUpdates {
        #[serde(default)]
        parameter_names: Vec<String>,
    },
    UnsubscribeParameterUpdates {
        #[serde(default)]
        parameter_names: Vec<String>,
    },
}

/// No more of what a client said is said back to it.
const SAID_MAX: usize = 200;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Subscription {
    id: u32,
    channel_id: u32,
}

impl Request {
    /// Reads a message in JSON; says what is wrong with it.
    pub fn of_text(text: &str) -> Result<Self, String> {
        let asked = serde_json::from_str(text).map_err(|error| {
            // It quotes what it does not know, which may be long.
            format!("not understood: {}", error.to_string().chars().take(SAID_MAX).collect::<String>())
        })?;
        if let Asked::GetParameters { id: Some(id), .. } | Asked::SetParameters { id: Some(id), .. } = &asked
            && id.len() > SAID_MAX
        {
            return Err(format!("not understood: an id of more than {SAID_MAX} bytes"));
        }
        Ok(match asked {
            Asked::Subscribe { subscriptions } => {
                Self::Subscribe(subscriptions.into_iter().map(|one| (one.id, one.channel_id)).collect())
            }
            Asked::Unsubscribe { subscription_ids } => Self::Unsubscribe(subscription_ids),
            Asked::GetParameters { parameter_names: names, id } => Self::GetParameters { names, id },
            Asked::SetParameters { parameters, id } => Self::SetParameters { parameters, id },
            Asked::SubscribeParameterUpdates { parameter_names } => {
                Self::SubscribeParameters(parameter_names)
            }
            Asked::UnsubscribeParameterUpdates { parameter_names } => {
                Self::UnsubscribeParameters(parameter_names)
            }
        })
    }

    /// Reads a binary message; says what is wrong with it.
    pub fn of_bytes(bytes: &[u8]) -> Result<Self, String> {
        let Some((&opcode, rest)) = bytes.split_first() else { return Err("an empty message".to_owned()) };
        if opcode != PLAYBACK_CONTROL_REQUEST {
            return Err(format!("binary messages with opcode {opcode} are not taken"));
        }
        playback_request(rest).map(Self::Playback).ok_or_else(|| "the playback request is torn".to_owned())
    }
}

/// Command, speed, whether to seek, where to, length of the id, id.
fn playback_request(bytes: &[u8]) -> Option<PlaybackRequest> {
    let (command, bytes) = bytes.split_first()?;
    let (speed, bytes) = bytes.split_first_chunk::<4>()?;
    let (seeks, bytes) = bytes.split_first()?;
    let (time, bytes) = bytes.split_first_chunk::<8>()?;
    let (length, id) = bytes.split_first_chunk::<4>()?;
    let play = match command {
        0 => true,
        1 => false,
        _ => return None,
    };
    let length = usize::try_from(u32::from_le_bytes(*length)).ok()?;
    if length > REQUEST_ID_BYTES_MAX {
        return None;
    }
    let time = i64::try_from(u64::from_le_bytes(*time)).unwrap_or(i64::MAX);
    Some(PlaybackRequest {
        play,
        speed: f64::from(f32::from_le_bytes(*speed)),
        seek: (*seeks != 0).then_some(Stamp::from_nanos(time)),
        id: std::str::from_utf8(id.get(..length)?).ok()?.to_owned(),
    })
}

/// What the protocol cannot say is said as its epoch.
fn nanos(stamp: Stamp) -> u64 {
    u64::try_from(stamp.as_nanos()).unwrap_or(0)
}

/// The first message: who answers, and what can be asked. `span` is that of a session.
pub(super) fn server_info(name: &str, id: &str, dialect: Dialect, span: Option<(Stamp, Stamp)>) -> Message {
    let mut capabilities = vec!["time"];
    if span.is_some() {
        capabilities.extend(["parameters", "parametersSubscribe"]);
    }
    let software = concat!("holdfast ", env!("CARGO_PKG_VERSION"));
    let mut info = json!({"op": "serverInfo", "name": name, "capabilities": capabilities, "sessionId": id,
        "metadata": {"software": software}});
    if let (Dialect::Sdk, Some((start, end))) = (dialect, span) {
        let time = |stamp| json!({"sec": nanos(stamp) / 1_000_000_000, "nsec": nanos(stamp) % 1_000_000_000});
        capabilities.push("playbackControl");
        info["capabilities"] = json!(capabilities);
        info["dataStartTime"] = time(start);
        info["dataEndTime"] = time(end);
    }
    Message::text(info.to_string())
}

pub(super) fn advertise(channels: &[Channel]) -> Message {
    let channels: Vec<Value> = channels.iter().map(Channel::advertisement).collect();
    Message::text(json!({"op": "advertise", "channels": channels}).to_string())
}

/// What a client should know: that it asked for what there is not, or lost something.
pub(super) fn warning(message: &str) -> Message {
    Message::text(json!({"op": "status", "level": WARNING, "message": message}).to_string())
}

pub(super) fn parameter_values(parameters: &[(&str, Value)], id: Option<&str>) -> Message {
    let parameters: Vec<Value> = parameters
        .iter()
        .map(|(name, value)| match value.is_f64() {
            // So that a whole number is not taken for an integer.
            true => json!({"name": name, "value": value, "type": "float64"}),
            false => json!({"name": name, "value": value}),
        })
        .collect();
    let mut values = json!({"op": "parameterValues", "parameters": parameters});
    if let Some(id) = id {
        values["id"] = json!(id);
    }
    Message::text(values.to_string())
}

pub(super) fn message_data(subscription: u32, received: Stamp, payload: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(13 + payload.len());
    bytes.push(MESSAGE_DATA);
    bytes.extend(subscription.to_le_bytes());
    bytes.extend(nanos(received).to_le_bytes());
    bytes.extend(payload);
    bytes
}

pub(super) fn time(now: Stamp) -> Vec<u8> {
    let mut bytes = vec![TIME];
    bytes.extend(nanos(now).to_le_bytes());
    bytes
}

/// For [`Dialect::Sdk`] only.
pub(super) fn playback_state(
    status: PlaybackStatus,
    at: Stamp,
    speed: f64,
    did_seek: bool,
    request: &str,
) -> Message {
    let mut bytes = vec![PLAYBACK_STATE, status as u8];
    bytes.extend(nanos(at).to_le_bytes());
    bytes.extend((speed as f32).to_le_bytes());
    bytes.push(u8::from(did_seek));
    bytes.extend((request.len() as u32).to_le_bytes());
    bytes.extend(request.as_bytes());
    Message::Binary(bytes.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_read_as_the_specification_writes_them() {
        let read = |text| Request::of_text(text).expect("understood");
        assert_eq!(
            read(r#"{"op":"subscribe","subscriptions":[{"id":0,"channelId":3},{"id":1,"channelId":5}]}"#),
            Request::Subscribe(vec![(0, 3), (1, 5)])
        );
        assert_eq!(read(r#"{"op":"unsubscribe","subscriptionIds":[0,1]}"#), Request::Unsubscribe(vec![0, 1]));
        assert_eq!(
            read(r#"{"op":"getParameters","parameterNames":["/a"],"id":"request-123"}"#),
            Request::GetParameters { names: vec!["/a".to_owned()], id: Some("request-123".to_owned()) }
        );
        let Request::SetParameters { parameters, id: None } =
            read(r#"{"op":"setParameters","parameters":[{"name":"/a","value":3.5,"type":"float64"}]}"#)
        else {
            panic!("not set");
        };
        assert_eq!((parameters[0].name.as_str(), &parameters[0].value), ("/a", &json!(3.5)));
        for text in [
            "",
            "[]",
            "{}",
            r#"{"op":"advertise","channels":[]}"#,
            r#"{"op":"subscribe"}"#,
            r#"{"op":"subscribe","subscriptions":[{"id":-1,"channelId":3}]}"#,
            r#"{"op":"subscribe","subscriptions":[{"id":4294967296,"channelId":3}]}"#,
        ] {
            assert!(Request::of_text(text).is_err(), "{text}");
        }
    }

    #[test]
    fn playback_requests_are_read_and_torn_ones_are_not() {
        let mut bytes = vec![3, 0];
        bytes.extend(1.5_f32.to_le_bytes());
        bytes.push(1);
        bytes.extend(100_500_000_000_u64.to_le_bytes());
        bytes.extend(7_u32.to_le_bytes());
        bytes.extend(b"some-id");
        let wish = PlaybackRequest {
            play: true,
            speed: 1.5,
            seek: Some(Stamp::from_nanos(100_500_000_000)),
            id: "some-id".to_owned(),
        };
        assert_eq!(Request::of_bytes(&bytes), Ok(Request::Playback(wish)));
        for length in 0..bytes.len() {
            assert!(Request::of_bytes(&bytes[..length]).is_err(), "{length}");
        }
        bytes[6] = 0;
        let Ok(Request::Playback(wish)) = Request::of_bytes(&bytes) else { panic!("read") };
        assert_eq!(wish.seek, None);
        for (at, value) in [(0, 1), (1, 2), (18, 255)] {
            let mut wrong = bytes.clone();
            wrong[at] = value;
            assert!(Request::of_bytes(&wrong).is_err(), "{at}");
        }
    }

    #[test]
    fn only_who_knows_playback_control_is_told_of_it() {
        let span = Some((Stamp::from_nanos(1_500_000_000), Stamp::from_nanos(3_000_000_001)));
        let info = |dialect, span| {
            let message = server_info("Quarry", "1", dialect, span);
            serde_json::from_str::<Value>(message.to_text().expect("text")).expect("JSON")
        };
        let sdk = info(Dialect::Sdk, span);
        assert_eq!(sdk["dataStartTime"], json!({"sec": 1, "nsec": 500_000_000}));
        assert_eq!(sdk["dataEndTime"], json!({"sec": 3, "nsec": 1}));
        assert_eq!(
            sdk["capabilities"],
            json!(["time", "parameters", "parametersSubscribe", "playbackControl"])
        );
        let older = info(Dialect::WebSocket, span);
        assert_eq!(older["capabilities"], json!(["time", "parameters", "parametersSubscribe"]));
        assert!(older.get("dataStartTime").is_none());
        assert_eq!(info(Dialect::Sdk, None)["capabilities"], json!(["time"]));
    }
}
