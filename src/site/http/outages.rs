//! Outages, their statistics, and the map of where they were.

use std::sync::Arc;

use axum::Json;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::IntoResponse;
use serde::{Deserialize, Serialize};

use super::Shared;
use super::input::{Parameters, malformed};
use super::problem::Problem;
use super::query::{bad, limit, time};
use crate::fleet::{CELL_M, FixState, OutageDetail, OutageView, ShadowMap, Statistics};
use crate::site::history::{Archive, Area, Cursor, Filter};
use crate::time::{Span, Stamp};

/// Statistics and maps look back so far, if nothing is said.
const LOOK_BACK: Span = Span::from_millis(7 * 86_400_000);
/// Statistics cover so much time at most.
const STATISTICS_MAX: Span = Span::from_millis(400 * 86_400_000);
/// Outages that statistics add up at most.
const ADDED_UP_MAX: usize = 100_000;
/// Cells of a map at most.
const CELLS_MAX: usize = 20_000;
/// Edge of a map's cells, m.
const CELL_MAX_M: f64 = 1000.0;
const CELL_DEFAULT_M: f64 = 5.0;

/// Whether an outage goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum OutageState {
    /// It goes on.
    Open,
    /// It is over.
    Ended,
}

/// Which outages.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct OutagesQuery {
    /// Only this machine's.
    machine: Option<String>,
    /// Only those that began so.
    cause: Option<FixState>,
    /// Only those that go on, or that are over.
    state: Option<OutageState>,
    /// Only those that went on then or later, RFC 3339.
    #[param(format = DateTime)]
    from: Option<String>,
    /// Only those that began before, RFC 3339.
    #[param(format = DateTime)]
    to: Option<String>,
    /// Only those that lasted so long, s.
    #[param(minimum = 0)]
    min_duration_s: Option<f64>,
    /// So many at most: 100 if it is left out.
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<usize>,
    /// Where the list goes on: `next` of the answer before.
    cursor: Option<String>,
}

/// A part of the list of outages.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct OutagesView {
    /// Newest first.
    outages: Vec<OutageView>,
    /// The `cursor` with which the list goes on; `null` at its end.
    next: Option<String>,
}

/// A span of time.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct SpanQuery {
    /// From here on, RFC 3339; a week before `to` if it is left out.
    #[param(format = DateTime)]
    from: Option<String>,
    /// Up to here, RFC 3339; now if it is left out.
    #[param(format = DateTime)]
    to: Option<String>,
}

/// Which map.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct MapQuery {
    /// Only this machine.
    machine: Option<String>,
    /// Length of the cells' edges: whole metres, 5 if it is left out.
    #[param(minimum = 1, maximum = 1000)]
    cell_m: Option<f64>,
    /// From here on, to the quarter of an hour, RFC 3339; a week before `to` if it is left out.
    #[param(format = DateTime)]
    from: Option<String>,
    /// Up to here, to the quarter of an hour, RFC 3339; now if it is left out.
    #[param(format = DateTime)]
    to: Option<String>,
}

/// GNSS outages and lost links of all machines.
#[utoipa::path(get, path = "/api/v1/outages", operation_id = "outages", tag = "outages", params(OutagesQuery),
    responses((status = OK, body = OutagesView),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = INTERNAL_SERVER_ERROR, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list(
    State(shared): State<Shared>,
    Parameters(query): Parameters<OutagesQuery>,
) -> Result<Json<OutagesView>, Problem> {
    let cursor = |text: String| Cursor::decode(&text).ok_or_else(|| bad("cursor is none of ours"));
    let min_duration_s = query.min_duration_s.unwrap_or(0.0);
    if !(0.0..=1e9).contains(&min_duration_s) {
        return Err(bad(format!("min_duration_s is {min_duration_s}, must be from 0 to 1e9")));
    }
    let filter = Filter {
        machine: query.machine,
        cause: query.cause,
        open: query.state.map(|state| state == OutageState::Open),
        from: time("from", query.from.as_deref())?,
        to: time("to", query.to.as_deref())?,
        min_duration_ns: query.min_duration_s.map(|seconds| Span::from_seconds(seconds).as_nanos()),
        after: query.cursor.map(cursor).transpose()?,
        limit: limit(query.limit)?,
    };
    let now = shared.clock.now();
    let page = ask(&shared, move |archive| archive.outages(&filter, now)).await?;
    let view = |outage| OutageView::of(outage, &shared.site_frame, now);
    Ok(Json(OutagesView {
        outages: page.outages.iter().map(view).collect(),
        next: page.next.map(|cursor| cursor.encode()),
    }))
}

/// One outage, with its sigma over time and the machine's track.
#[utoipa::path(get, path = "/api/v1/outages/{id}", tag = "outages",
    params(("id" = String, Path, description = "The outage's id", min_length = 1, max_length = 200)),
    responses((status = OK, body = OutageDetail),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json"),
        (status = INTERNAL_SERVER_ERROR, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn outage(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
) -> Result<Json<OutageDetail>, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let not_found = Problem::not_found("outage", &id);
    let outage = ask(&shared, move |archive| archive.outage(&id)).await?.ok_or(not_found)?;
    Ok(Json(OutageDetail::of(&outage, &shared.site_frame, shared.clock.now())))
}

/// Outages added up by machine and by day of the site's time zone.
#[utoipa::path(get, path = "/api/v1/outages/statistics", operation_id = "outage_statistics", tag = "outages", params(SpanQuery),
    responses((status = OK, body = Statistics),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = INTERNAL_SERVER_ERROR, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn statistics(
    State(shared): State<Shared>,
    Parameters(query): Parameters<SpanQuery>,
) -> Result<Json<Statistics>, Problem> {
    let now = shared.clock.now();
    let (from, to) = span(query.from.as_deref(), query.to.as_deref(), now)?;
    if to - from > STATISTICS_MAX {
        return Err(bad(format!("from to to is more than {} days", STATISTICS_MAX.as_seconds() / 86_400.0)));
    }
    let filter = Filter { from: Some(from), to: Some(to), limit: ADDED_UP_MAX, ..Filter::default() };
    let zone = shared.time_zone.clone();
    let statistics = ask(&shared, move |archive| {
        let page = archive.outages(&filter, now)?;
        if page.next.is_some() {
            return Ok(None);
        }
        let observed = archive.observed(from, to)?;
        Ok(Some(Statistics::of(&page.outages, &observed, (from, to), &zone, now)))
    });
    let too_many = || bad(format!("there are more than {ADDED_UP_MAX} outages; ask for less time"));
    statistics.await?.map(Json).ok_or_else(too_many)
}

/// Where machines lack good GNSS: the time they spent in each cell, and the share of it without.
#[utoipa::path(get, path = "/api/v1/shadow-map", tag = "outages", params(MapQuery),
    responses((status = OK, body = ShadowMap, content_type = "application/geo+json"),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = INTERNAL_SERVER_ERROR, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn shadow_map(
    State(shared): State<Shared>,
    Parameters(query): Parameters<MapQuery>,
) -> Result<impl IntoResponse, Problem> {
    let cell_m = query.cell_m.unwrap_or(CELL_DEFAULT_M);
    if !(CELL_M..=CELL_MAX_M).contains(&cell_m) || cell_m.fract() != 0.0 {
        let detail = format!("cell_m is {cell_m}, must be a whole number from {CELL_M} to {CELL_MAX_M}");
        return Err(bad(detail));
    }
    let (from, to) = span(query.from.as_deref(), query.to.as_deref(), shared.clock.now())?;
    let multiple = (cell_m / CELL_M) as i64;
    let area = Area { machine: query.machine, from, to, multiple, limit: CELLS_MAX + 1 };
    let cells = ask(&shared, move |archive| archive.cells(&area)).await?;
    if cells.len() > CELLS_MAX {
        let detail = format!("the map has more than {CELLS_MAX} cells; ask for a larger cell_m or less time");
        return Err(bad(detail));
    }
    let map = ShadowMap::of(cells.into_iter(), multiple, &shared.site_frame);
    Ok(([(CONTENT_TYPE, "application/geo+json")], Json(map)))
}

fn span(from: Option<&str>, to: Option<&str>, now: Stamp) -> Result<(Stamp, Stamp), Problem> {
    let to = time("to", to)?.unwrap_or(now);
    let from = time("from", from)?.unwrap_or(to - LOOK_BACK);
    if from < to { Ok((from, to)) } else { Err(bad("from must be before to")) }
}

/// Asks the archive, which reads the disk.
pub(super) async fn ask<T: Send + 'static>(
    shared: &Shared,
    question: impl FnOnce(&Archive) -> rusqlite::Result<T> + Send + 'static,
) -> Result<T, Problem> {
    let archive = Arc::clone(&shared.archive);
    let failed = |error: String| {
        tracing::error!("the history cannot be read: {error}");
        Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the history cannot be read")
    };
    let answer = tokio::task::spawn_blocking(move || question(&archive)).await;
    answer.map_err(|error| failed(error.to_string()))?.map_err(|error| failed(error.to_string()))
}
