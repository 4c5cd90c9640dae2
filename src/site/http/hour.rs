//! The last hour of all machines: what they said of themselves, and where they were.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use axum::Json;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

use super::Shared;
use super::input::{Parameters, malformed};
use super::problem::Problem;
use super::query::time;
use super::tracks::timed;
use crate::fleet::{Past, StatePoint, Trails, UtcTime};
use crate::site::aggregator::Frame;
use crate::site::ended;

/// Written by [`Hour::follow`] alone.
#[derive(Clone, Default)]
pub(in crate::site) struct Hour(Arc<Mutex<Seen>>);

/// What was seen.
#[derive(Default)]
pub(super) struct Seen {
    pub past: Past,
    pub trails: Trails,
}

impl Hour {
    pub(super) fn read(&self) -> MutexGuard<'_, Seen> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes down how and where the machines are, until `stopped` says so.
    pub(in crate::site) async fn follow(
        self,
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
                    let mut seen = self.read();
                    seen.past.observe(&frame.view);
                    seen.trails.observe(&frame.view);
                }
            }
        }
    }
}

/// Which part of the last hour.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct HistoryQuery {
    /// Only what arrived after that, RFC 3339.
    #[param(format = DateTime)]
    since: Option<String>,
}

/// What a machine said of itself.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct HistoryView {
    /// The machine's id.
    machine: String,
    /// Times count from here, by the site's clock; `null` if there is nothing.
    #[schema(value_type = Option<String>, format = DateTime)]
    start: Option<UtcTime>,
    /// When the last of them arrived: `since` for those that follow.
    #[schema(value_type = Option<String>, format = DateTime)]
    last: Option<UtcTime>,
    /// Oldest first: one a second of the last five minutes, one in five seconds before that, and all at which mode, GNSS or
    /// severity changed.
    states: Vec<StatePoint>,
}

/// What a machine said of itself in the last hour: once a second, and thinned where it is older than five minutes.
#[utoipa::path(get, path = "/api/v1/machines/{id}/history", operation_id = "machine_history", tag = "fleet",
    params(("id" = String, Path, description = "The machine's id"), HistoryQuery),
    responses((status = OK, body = HistoryView),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn history(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
    Parameters(query): Parameters<HistoryQuery>,
) -> Result<Json<HistoryView>, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let since = time("since", query.since.as_deref())?;
    if shared.frame().machine(&id).is_none() {
        return Err(Problem::not_found("machine", &id));
    }
    let points = shared.hour.read().past.points(&id, since, shared.clock.now());
    let start = points.first().map(|(at, _)| *at);
    let last = points.last().map(|(at, _)| UtcTime(*at));
    let states = points.into_iter().map(|(at, point)| timed(at, point, start.unwrap_or(at))).collect();
    Ok(Json(HistoryView { machine: id, start: start.map(UtcTime), last, states }))
}
