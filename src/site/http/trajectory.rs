//! Where a machine was in the last hour.

use std::sync::{Arc, Mutex, PoisonError};

use axum::Json;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

use super::Shared;
use super::input::{Parameters, malformed};
use super::problem::Problem;
use crate::fleet::{TRAIL_POINTS_MAX, TrailPoint, Trails, UtcTime};
use crate::site::aggregator::Frame;
use crate::site::ended;
use crate::time::Stamp;

/// The trails of all machines, written by [`follow`] alone.
pub(in crate::site) type SharedTrails = Arc<Mutex<Trails>>;

/// Writes down where the machines are, until `stopped` says so.
pub(in crate::site) async fn follow(
    trails: SharedTrails,
    mut frames: watch::Receiver<Arc<Frame>>,
    mut stopped: watch::Receiver<bool>,
) {
    loop {
        tokio::select! {
            () = ended(&mut stopped) => return,
            changed = frames.changed() => {
                if changed.is_err() {
                    return;
                }
                let frame = Arc::clone(&frames.borrow_and_update());
                trails.lock().unwrap_or_else(PoisonError::into_inner).observe(&frame.view);
            }
        }
    }
}

/// Which part of it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Wanted {
    since: Option<String>,
    limit: Option<usize>,
}

/// Where a machine was.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct TrajectoryView {
    /// The machine's id.
    machine: String,
    /// Oldest first, one a second at most.
    points: Vec<TrailPoint>,
    /// `since` for those that follow; `null` if there are none yet.
    #[schema(value_type = Option<String>, format = DateTime)]
    next: Option<UtcTime>,
}

/// Where a machine was in the last hour, as it was live: a point a second, while it is online. Whole sessions are
/// in their recordings.
#[utoipa::path(get, path = "/api/v1/machines/{id}/trajectory", tag = "fleet",
    params(("id" = String, Path, description = "The machine's id", min_length = 1, max_length = 64),
        ("since" = Option<String>, Query, format = DateTime,
            description = "Only points that arrived after that, RFC 3339"),
        ("limit" = Option<u32>, Query, description = "So many at most: 3600 if it is left out", minimum = 1,
            maximum = 3600)),
    responses((status = OK, body = TrajectoryView),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn trajectory(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
    Parameters(Wanted { since, limit }): Parameters<Wanted>,
) -> Result<Json<TrajectoryView>, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let bad = |detail: String| Problem::new(StatusCode::BAD_REQUEST, detail);
    let limit = limit.unwrap_or(TRAIL_POINTS_MAX);
    if !(1..=TRAIL_POINTS_MAX).contains(&limit) {
        return Err(bad(format!("limit is {limit}, must be from 1 to {TRAIL_POINTS_MAX}")));
    }
    let since = since.map(|text| moment(&text).map_err(bad)).transpose()?;
    if shared.frame().machine(&id).is_none() {
        return Err(Problem::not_found("machine", &id));
    }
    let trails = shared.trails.lock().unwrap_or_else(PoisonError::into_inner);
    let (points, more) = trails.points(&id, since, limit);
    let next = points.last().filter(|_| more).map(|point| point.time);
    Ok(Json(TrajectoryView { machine: id, points, next }))
}

/// A moment in RFC 3339; those beyond what stamps reach are as far as they do.
fn moment(text: &str) -> Result<Stamp, String> {
    let wrong = |error: jiff::Error| format!("since is no time such as 2026-11-23T05:00:00Z: {error}");
    let timestamp: jiff::Timestamp = text.parse().map_err(wrong)?;
    let nanos = timestamp.as_nanosecond().clamp(i128::from(i64::MIN), i128::from(i64::MAX));
    Ok(Stamp::from_nanos(i64::try_from(nanos).unwrap_or(i64::MAX)))
}
