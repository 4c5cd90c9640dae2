//! What machines did: in a session, for replay; in the last hour, for plots.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE, ETAG};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::Shared;
use super::input::{Parameters, is_known, malformed};
use super::problem::Problem;
use super::query::{bad, time};
use super::sessions::ask;
use crate::fleet::{PoseView, StatePoint, UtcTime};
use crate::record::RecordError;
use crate::site::sessions::{EVENTS_MAX, Events, POSES_MAX, STEP_LEAST, Track, Tracks, Wanted};
use crate::site::sessions::{events as read_events, tracks as read_tracks};
use crate::state::Event;
use crate::time::{Span, Stamp};

/// Recordings that are read for replay at once: each takes a core.
static READING: tokio::sync::Semaphore = tokio::sync::Semaphore::const_new(2);
const STEP_MOST_S: f64 = 3_600.0;

/// Which part of a session.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct TrackQuery {
    /// Only this machine.
    machine: Option<String>,
    /// From here on, by the machines' clocks, RFC 3339.
    #[param(format = DateTime)]
    from: Option<String>,
    /// Before this, by the machines' clocks, RFC 3339.
    #[param(format = DateTime)]
    to: Option<String>,
    /// From one pose to the next, s; 0.2 if it is left out. Doubled until there are not too many poses.
    #[param(minimum = 0.05, maximum = 3600)]
    step_s: Option<f64>,
}

/// Poses of a machine, a list for each value, all of one length.
#[derive(Debug, Default, Serialize, utoipa::ToSchema)]
pub(super) struct PoseColumns {
    /// Since `start`, s.
    time_s: Vec<f64>,
    /// Of the cabin IMU in the site frame: east, north, up, m.
    position_m: Vec<[f64; 3]>,
    /// A point of the axis about which the cabin turns, m.
    cabin_position_m: Vec<[f64; 3]>,
    /// Of the cabin's x axis, clockwise from north.
    heading_deg: Vec<f64>,
    /// One sigma.
    heading_sigma_deg: Vec<f64>,
    /// Of the chassis' x axis, where it is known.
    chassis_heading_deg: Vec<Option<f64>>,
    /// Origin of the chassis frame: east, north, up, m.
    chassis_position_m: Vec<Option<[f64; 3]>>,
    /// Of the cabin IMU, m/s.
    speed_mps: Vec<f64>,
    /// One sigma: east, north, up, m.
    position_sigma_m: Vec<[f64; 3]>,
    /// 95 % ellipse: longer half axis, shorter half axis, m; bearing of the longer one, degrees.
    ellipse95: Vec<[f64; 3]>,
}

/// A span without any pose.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct SilenceView {
    /// Since `start`, s.
    from_s: f64,
    /// Since `start`, s.
    to_s: f64,
}

/// One machine in a session.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct MachineTrack {
    /// Its id.
    id: String,
    /// For people.
    name: String,
    /// Version of its software, as it told last; empty if it did not.
    software: String,
    /// What was added to its times, since its clock was not the site's, s.
    clock_shift_s: f64,
    /// Thinned.
    poses: PoseColumns,
    /// What it said of itself: once a second or less often, and at each change of mode or fixes.
    states: Vec<StatePoint>,
    /// Two seconds and more without a pose: from the last one before to the first one after.
    silences: Vec<SilenceView>,
    /// Poses that were sent, but are not in the recording.
    poses_missing: u64,
}

/// What the machines of a session did.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct TrackAnswer {
    /// The session's id.
    session: String,
    /// Times count from here; `null` if there is nothing.
    #[schema(value_type = Option<String>, format = DateTime)]
    start: Option<UtcTime>,
    /// From the first to the last, s.
    length_s: f64,
    /// From one pose to the next, s: longer than was asked for where there would be too many.
    step_s: f64,
    /// Whether nothing is added to the session any more.
    finished: bool,
    /// In the order of their ids.
    machines: Vec<MachineTrack>,
}

/// An event of a machine.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct SessionEvent {
    /// By the machine's stamps.
    #[schema(value_type = String, format = DateTime)]
    time: UtcTime,
    /// Whose.
    machine: String,
    /// What.
    event: Event,
}

/// What happened in a session.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct EventsAnswer {
    /// The session's id.
    session: String,
    /// In order of time, 5000 at most.
    events: Vec<SessionEvent>,
    /// Events that were left out, refused readings first.
    left_out: u64,
}

/// Where the machines of a session were and how they did, thinned to 24 000 poses at most: for replay.
#[utoipa::path(get, path = "/api/v1/sessions/{id}/track", operation_id = "session_track", tag = "sessions",
    params(("id" = String, Path, description = "The session's id"), TrackQuery,
        ("If-None-Match" = Option<String>, Header, description = "Tags that the client has")),
    responses((status = OK, body = TrackAnswer),
        (status = NOT_MODIFIED, description = "The client has it"),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json"),
        (status = INTERNAL_SERVER_ERROR, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn track(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
    Parameters(query): Parameters<TrackQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let wanted = wanted(query)?;
    let frame = shared.site_frame;
    answer(&shared, id, &headers, move |id, files, finished, given_up| {
        let tracks = read_tracks(files, &wanted, &frame, given_up)?;
        Ok(tracks.map(|tracks| json(&TrackAnswer::of(id, tracks, finished))))
    })
    .await
}

/// What happened to the machines of a session: modes, graphs, outages, restarts, refused readings.
#[utoipa::path(get, path = "/api/v1/sessions/{id}/events", operation_id = "session_events", tag = "sessions",
    params(("id" = String, Path, description = "The session's id"), TrackQuery,
        ("If-None-Match" = Option<String>, Header, description = "Tags that the client has")),
    responses((status = OK, body = EventsAnswer),
        (status = NOT_MODIFIED, description = "The client has it"),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json"),
        (status = INTERNAL_SERVER_ERROR, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn events(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
    Parameters(query): Parameters<TrackQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let wanted = wanted(query)?;
    answer(&shared, id, &headers, move |id, files, _, given_up| {
        let events = read_events(files, &wanted, given_up)?;
        Ok(events.map(|events| json(&EventsAnswer::of(id, events))))
    })
    .await
}

/// Reads a session's files on a thread of its own; a finished session is the same for ever.
async fn answer(
    shared: &Shared,
    id: String,
    headers: &HeaderMap,
    read: impl FnOnce(&str, &[PathBuf], bool, &AtomicBool) -> Result<Option<Vec<u8>>, RecordError>
    + Send
    + 'static,
) -> Result<Response, Problem> {
    let asked = id.clone();
    let located = ask(shared, move |catalogue, progress| {
        let located = catalogue.locate(&asked, progress)?;
        let files = located.closed.into_iter().map(|(_, path)| path);
        let files: Vec<PathBuf> = files.chain(located.open.map(|(_, path, _)| path)).collect();
        let bytes: u64 =
            files.iter().filter_map(|path| std::fs::metadata(path).ok()).map(|about| about.len()).sum();
        Some((files, located.finished, bytes))
    });
    let (files, finished, bytes) = located.await?.ok_or_else(|| Problem::not_found("session", &id))?;
    let tag = finished.then(|| format!("\"{}-{id}-{bytes}\"", env!("CARGO_PKG_VERSION")));
    if let Some(tag) = tag.as_deref().filter(|tag| is_known(headers, tag)) {
        let mut response = StatusCode::NOT_MODIFIED.into_response();
        response.headers_mut().extend(HeaderValue::from_str(tag).ok().map(|tag| (ETAG, tag)));
        return Ok(response);
    }
    // The guard drops when the client goes away: nobody waits for the rest.
    let given_up = Arc::new(AtomicBool::new(false));
    let _guard = GivesUp(Arc::clone(&given_up));
    // Never closed.
    let permit = READING.acquire().await;
    let about = id.clone();
    let read = tokio::task::spawn_blocking(move || {
        let body = read(&id, &files, finished, &given_up);
        drop(permit);
        body
    });
    let unreadable = |error: &dyn std::fmt::Display| {
        tracing::error!("session {about} cannot be replayed: {error}");
        Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the recording cannot be read")
    };
    let body = read.await.map_err(|error| unreadable(&error))?.map_err(|error| unreadable(&error))?;
    let mut response = (StatusCode::OK, body.unwrap_or_default()).into_response();
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static("application/json"));
    if let Some(tag) = tag.and_then(|tag| HeaderValue::from_str(&tag).ok()) {
        headers.insert(ETAG, tag);
        headers.insert(CACHE_CONTROL, HeaderValue::from_static("private, no-cache"));
    }
    Ok(response)
}

struct GivesUp(Arc<AtomicBool>);

impl Drop for GivesUp {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

fn json(value: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(value).expect("numbers, texts and lists have a form in JSON")
}

fn wanted(query: TrackQuery) -> Result<Wanted, Problem> {
    let TrackQuery { machine, from, to, step_s } = query;
    let least = STEP_LEAST.as_seconds();
    if let Some(step_s) = step_s.filter(|step_s| !(least..=STEP_MOST_S).contains(step_s)) {
        return Err(bad(format!("step_s is {step_s}, must be from {least} to {STEP_MOST_S}")));
    }
    let (from, to) = (time("from", from.as_deref())?, time("to", to.as_deref())?);
    if from.zip(to).is_some_and(|(from, to)| from >= to) {
        return Err(bad("from must be before to"));
    }
    Ok(Wanted { machine, from, to, step: step_s.map(Span::from_seconds) })
}

fn rounded(value: f64, places: i32) -> f64 {
    let scale = 10_f64.powi(places);
    (value * scale).round() / scale
}

fn metres(values: [f64; 3]) -> [f64; 3] {
    values.map(|value| rounded(value, 4))
}

/// With its time, s, counted from `start`.
pub(super) fn timed(at: Stamp, point: StatePoint, start: Stamp) -> StatePoint {
    StatePoint { time_s: rounded(at.seconds_since(start), 3), ..point }
}

impl PoseColumns {
    fn push(&mut self, time_s: f64, pose: &PoseView) {
        let ellipse = pose.ellipse95;
        self.time_s.push(time_s);
        self.position_m.push(metres(pose.position_m));
        self.cabin_position_m.push(metres(pose.cabin_position_m));
        self.heading_deg.push(rounded(pose.heading_deg, 3));
        self.heading_sigma_deg.push(rounded(pose.heading_sigma_deg, 4));
        self.chassis_heading_deg.push(pose.chassis_heading_deg.map(|heading| rounded(heading, 3)));
        self.chassis_position_m.push(pose.chassis_position_m.map(metres));
        self.speed_mps.push(rounded(pose.speed_mps, 3));
        self.position_sigma_m.push(metres(pose.position_sigma_m));
        self.ellipse95.push([
            rounded(ellipse.semi_major_m, 4),
            rounded(ellipse.semi_minor_m, 4),
            rounded(ellipse.bearing_deg, 1),
        ]);
    }
}

impl MachineTrack {
    fn of(track: Track, start: Stamp) -> Self {
        let mut poses = PoseColumns::default();
        for (at, pose) in &track.poses {
            poses.push(rounded(at.seconds_since(start), 3), pose);
        }
        let states = track.states.into_iter().map(|(at, state)| timed(at, state, start)).collect();
        let since = |at: Stamp| rounded(at.seconds_since(start), 3);
        let silences =
            track.silences.iter().map(|(from, to)| SilenceView { from_s: since(*from), to_s: since(*to) });
        Self {
            id: track.id,
            name: track.name,
            software: track.software,
            clock_shift_s: rounded(track.clock_shift.as_seconds(), 3),
            poses,
            states,
            silences: silences.collect(),
            poses_missing: track.poses_missing,
        }
    }
}

impl TrackAnswer {
    fn of(session: &str, tracks: Tracks, finished: bool) -> Self {
        debug_assert!(tracks.machines.iter().map(|track| track.poses.len()).sum::<usize>() <= POSES_MAX);
        let times = || {
            tracks.machines.iter().flat_map(|track| {
                let poses = track.poses.iter().map(|(at, _)| *at);
                poses.chain(track.states.iter().map(|(at, _)| *at))
            })
        };
        let (start, end) = (times().min(), times().max());
        let length_s = start.zip(end).map_or(0.0, |(start, end)| end.seconds_since(start));
        let from = start.unwrap_or_default();
        Self {
            session: session.to_owned(),
            start: start.map(UtcTime),
            length_s: rounded(length_s, 3),
            step_s: tracks.step.as_seconds(),
            finished,
            machines: tracks.machines.into_iter().map(|track| MachineTrack::of(track, from)).collect(),
        }
    }
}

impl EventsAnswer {
    fn of(session: &str, events: Events) -> Self {
        debug_assert!(events.events.len() <= EVENTS_MAX);
        let told = events.events.into_iter();
        let told = told.map(|(at, machine, event)| SessionEvent { time: UtcTime(at), machine, event });
        Self { session: session.to_owned(), events: told.collect(), left_out: events.left_out }
    }
}
