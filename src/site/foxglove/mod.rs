//! Machines and sessions for Foxglove and Lichtblick, by the Foxglove WebSocket protocol.
//!
//! Two sub-protocols are spoken: `foxglove.websocket.v1` as `foxglove/ws-protocol` specifies it (Lichtblick, and
//! whatever uses `@foxglove/ws-protocol`), and `foxglove.sdk.v1`, its successor in `foxglove/foxglove-sdk`, which the
//! Foxglove app asks for and which adds playback control. The crate `foxglove` is a server of its own, with its own
//! listener and no way in for a request that another server has accepted and checked; so the protocol is written here.
//!
//! # Channels
//! A machine has a channel for each topic it has spoken on, but the journal: same name, encoding, schema and bytes as
//! in a recording, so that a recording and a live connection look alike. Beside them are three that are made here:
//!
//! | Channel | Is |
//! |---|---|
//! | `/{machine}/tf` | `world` → `{machine}/imu` (of `pose`); `world` → `{machine}/odom` and `{machine}/imu` → `{machine}/cabin` (of `health`); `{machine}/odom` → `{machine}/base` (of `odom`, where the chassis is known) |
//! | `/{machine}/location` | the pose's position as `NavSatFix`, with its covariance |
//! | `/{machine}/log` | events as `rcl_interfaces/Log`, in words |
//!
//! The time of a message is when it was received, as in a recording.
//!
//! # Live
//! ```text
//! aggregator ── Feed (a ring) ─▶ a task for each client ── outbox ─▶ its socket
//! ```
//! The aggregator never waits: it puts a message into a ring, from which each client's task takes what that client has
//! subscribed to. What a client does not take in time is dropped, the oldest of each channel first, so that the newest
//! always comes; the client is told by a status message how many it lost.
//!
//! # Sessions
//! `?session=ID` plays a recording, `speed` times as fast as it was. `foxglove.sdk.v1` has playback control for that
//! (play, pause, seek, speed); for the older protocol, which has none, and for everybody else, there are three
//! parameters that can be set: `/playback/playing`, `/playback/speed` and `/playback/position_s` (from the session's
//! first message). Nothing is dropped: playback waits for its client, and nobody else does.

mod channels;
mod derived;
mod feed;
mod live;
mod outbox;
mod playback;
mod protocol;
mod replay;
mod socket;
mod subscriptions;

pub(super) use feed::{Feed, Feeds};
pub(super) use live::{Site, serve as serve_live};
pub(super) use playback::check_speed;
pub(super) use protocol::Dialect;
pub(super) use replay::{Session, serve as serve_session};
