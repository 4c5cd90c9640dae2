//! Whether the server lives, and whether it can do its work. Machines that are offline are not its fault.

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::Shared;

/// Whether the server can do its work.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct ReadyView {
    ready: bool,
    /// What is wrong, in words; empty if it is ready.
    reasons: Vec<String>,
}

/// Answers as long as the server lives.
#[utoipa::path(get, path = "/healthz", tag = "operation",
    responses((status = OK, content_type = "text/plain", body = String)))]
pub(super) async fn healthz() -> impl IntoResponse {
    ([(CONTENT_TYPE, "text/plain; charset=utf-8")], "alive\n")
}

/// Whether the server can do its work: machines can dial in, and what they say is recorded.
#[utoipa::path(get, path = "/readyz", tag = "operation",
    responses((status = OK, body = ReadyView), (status = SERVICE_UNAVAILABLE, body = ReadyView)))]
pub(super) async fn readyz(State(shared): State<Shared>) -> Response {
    let reasons = reasons(&shared);
    let status = if reasons.is_empty() { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    (status, Json(ReadyView { ready: reasons.is_empty(), reasons })).into_response()
}

fn reasons(shared: &Shared) -> Vec<String> {
    let mut reasons = Vec::new();
    if shared.session.is_closed() {
        reasons.push("the Zenoh session is closed: machines cannot dial in".to_owned());
    }
    let frame_age_s = shared.clock.now().seconds_since(shared.frame().view.time.0);
    if frame_age_s > 2.0 {
        reasons.push(format!("the fleet was not updated for {frame_age_s:.1} s"));
    }
    if let Some(progress) = shared.progress() {
        reasons.extend(progress.troubles(shared.clock.now()));
    }
    reasons
}
