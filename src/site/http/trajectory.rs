//! Where a machine was in the last hour.

use axum::Json;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use serde::{Deserialize, Serialize};

use super::Shared;
use super::input::{Parameters, malformed};
use super::problem::Problem;
use super::query::{bad, time};
use crate::fleet::{TRAIL_POINTS_MAX, TrailPoint, UtcTime};

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

/// Where a machine was in the last hour, as it was live while it was online: a point a second, and one in five seconds
/// of what is older than five minutes. Whole sessions are in their recordings.
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
    let limit = limit.unwrap_or(TRAIL_POINTS_MAX);
    if !(1..=TRAIL_POINTS_MAX).contains(&limit) {
        return Err(bad(format!("limit is {limit}, must be from 1 to {TRAIL_POINTS_MAX}")));
    }
    let since = time("since", since.as_deref())?;
    if shared.frame().machine(&id).is_none() {
        return Err(Problem::not_found("machine", &id));
    }
    let (points, more) = shared.hour.read().trails.points(&id, since, limit, shared.clock.now());
    let next = points.last().filter(|_| more).map(|point| point.time);
    Ok(Json(TrajectoryView { machine: id, points, next }))
}
