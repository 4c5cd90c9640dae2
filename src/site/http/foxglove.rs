//! The door of Foxglove and Lichtblick.

use std::path::PathBuf;
use std::sync::Arc;

use axum::extract::State;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::http::StatusCode;
use axum::response::Response;
use serde::Deserialize;

use super::Shared;
use super::input::Parameters;
use super::place::Place;
use super::problem::Problem;
use super::sessions::ask;
use super::visitor::Visitor;
use crate::site::foxglove::{Dialect, Session, Site, check_speed, serve_live, serve_session};

/// More clients at once are refused: each may want every message of every machine.
const CLIENTS_MAX: u64 = 16;
/// No request is longer: some thousand subscriptions.
const REQUEST_BYTES_MAX: usize = 256 * 1024;

/// What is to be shown.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Wanted {
    session: Option<String>,
    speed: Option<f64>,
    /// The guard has taken it.
    #[serde(rename = "ticket")]
    _ticket: Option<String>,
}

/// The machines in Foxglove or Lichtblick, live, or a recorded session with playback control: a WebSocket with the
/// sub-protocol `foxglove.sdk.v1` or `foxglove.websocket.v1`. Topics, encodings and schemas are those of the
/// recordings; `/{machine}/tf`, `/{machine}/location` and `/{machine}/log` come in addition.
#[utoipa::path(get, path = "/foxglove", tag = "fleet",
    params(("session" = Option<String>, Query, description = "Play this session instead of showing what is live"),
        ("speed" = Option<f64>, Query, minimum = 0.01, maximum = 100.0,
            description = "Of the session, seconds in a second; by default 1"),
        ("ticket" = Option<String>, Query, max_length = 64,
            description = "From `POST /api/v1/live-ticket`, for those who can send neither cookie nor token")),
    responses((status = SWITCHING_PROTOCOLS, description = "A WebSocket"),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = NOT_FOUND, description = "There is no such session, or no message in it", body = Problem,
            content_type = "application/problem+json"),
        (status = UPGRADE_REQUIRED, body = Problem, content_type = "application/problem+json"),
        (status = SERVICE_UNAVAILABLE, body = Problem, content_type = "application/problem+json"),
        (status = FORBIDDEN, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn foxglove(
    State(shared): State<Shared>,
    visitor: Visitor,
    Parameters(wanted): Parameters<Wanted>,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let upgrade = upgrade.map_err(|rejection| Problem::new(rejection.status(), rejection.body_text()))?;
    let bad = |detail: String| Problem::new(StatusCode::BAD_REQUEST, detail);
    let speed = wanted.speed.unwrap_or(1.0);
    check_speed(speed).map_err(bad)?;
    let upgrade = upgrade.max_message_size(REQUEST_BYTES_MAX).protocols(Dialect::ALL.map(Dialect::name));
    let selected = upgrade.selected_protocol().and_then(|name| name.to_str().ok());
    let dialect = Dialect::ALL.into_iter().find(|dialect| Some(dialect.name()) == selected);
    let dialect = dialect.ok_or_else(|| {
        let [new, old] = Dialect::ALL.map(Dialect::name);
        bad(format!("Sec-WebSocket-Protocol must name {new} or {old}"))
    })?;
    let place = Place::take(&shared.counters, |counters| &counters.foxglove_clients, CLIENTS_MAX)?;
    let session = match wanted.session {
        Some(id) => Some(open(&shared, id).await?),
        None => None,
    };
    Ok(upgrade.on_upgrade(async move |socket| {
        let _place = place;
        let served = async {
            match session {
                Some(session) => serve_session(socket, dialect, session, speed, shared.stopped.clone()).await,
                None => serve_live(socket, dialect, site(&shared)).await,
            }
        };
        tokio::select! {
            () = served => {}
            // The socket goes with what serves it.
            () = shared.people.gone(&visitor) => {}
        }
    }))
}

fn site(shared: &Shared) -> Site {
    Site {
        name: shared.frame().view.site.name.clone(),
        frame: shared.site_frame,
        feeds: shared.feeds.clone(),
        clock: shared.clock,
        counters: Arc::clone(&shared.counters),
        stopped: shared.stopped.clone(),
    }
}

async fn open(shared: &Shared, id: String) -> Result<Session, Problem> {
    let asked = id.clone();
    let opened = ask(shared, move |catalogue, progress| {
        let located = catalogue.locate(&asked, progress)?;
        let mut files: Vec<(u32, PathBuf)> = located.closed;
        files.extend(located.open.map(|(number, path, _)| (number, path)));
        files.sort();
        Some(Session::open(asked, files.into_iter().map(|(_, path)| path).collect()))
    });
    match opened.await? {
        None => Err(Problem::not_found("session", &id)),
        Some(Ok(Some(session))) => Ok(session),
        Some(Ok(None)) => {
            Err(Problem::new(StatusCode::NOT_FOUND, format!("there is no message in session \"{id:.80}\"")))
        }
        Some(Err(error)) => {
            tracing::error!("session {id} cannot be played: {error}");
            Err(Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the recording cannot be read"))
        }
    }
}
