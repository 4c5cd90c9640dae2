//! Sessions: the list, what people write to them, start and stop.

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::{BytesRejection, PathRejection};
use axum::extract::{Path, State};
use axum::http::header::LOCATION;
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use tokio::sync::oneshot;

use super::Shared;
use super::audit::Page;
use super::input::{Parameters, json, json_needed, malformed, tagged_json};
use super::problem::Problem;
use crate::record::says_full;
use crate::site::sessions::{
    Answer, Catalogue, Command, Notes, NotesChange, Progress, RecordingView, Refusal, SessionDetail,
    SessionView,
};

/// All sessions.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct SessionsView {
    /// What the recorder does.
    recording: RecordingView,
    /// Newest first.
    sessions: Vec<SessionView>,
    /// The cursor of those before; `null` if there are none.
    next: Option<String>,
}

/// Recordings, and whether what arrives is recorded.
#[utoipa::path(get, path = "/api/v1/sessions", operation_id = "list_sessions", tag = "sessions",
    params(("limit" = Option<u32>, Query, description = "So many at most: 100 if it is left out", minimum = 1,
            maximum = 1000),
        ("cursor" = Option<String>, Query, description = "`next` of the answer before", min_length = 1,
            max_length = 64),
        ("If-None-Match" = Option<String>, Header, description = "Tags that the client has")),
    responses((status = OK, body = SessionsView, headers(("ETag" = String, description = "Of this answer"))),
        (status = NOT_MODIFIED, description = "The client has it")))]
pub(super) async fn list(
    State(shared): State<Shared>,
    Parameters(page): Parameters<Page>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let limit = page.limit()?;
    let recording = RecordingView::of(shared.progress().as_ref());
    let mut sessions = ask(&shared, |catalogue, progress| catalogue.list(progress)).await?;
    // Their ids are in the order of their starts, so that a cursor stays right when sessions come and go.
    if let Some(cursor) = page.cursor()? {
        sessions.retain(|session| session.id.as_str() < cursor);
    }
    let more = sessions.len() > limit;
    sessions.truncate(limit);
    let next = sessions.last().filter(|_| more).map(|session| session.id.clone());
    tagged_json(&headers, &SessionsView { recording, sessions, next })
}

/// One session and its files.
#[utoipa::path(get, path = "/api/v1/sessions/{id}", tag = "sessions",
    params(("id" = String, Path, description = "The session's id", min_length = 1, max_length = 64),
        ("If-None-Match" = Option<String>, Header, description = "Tags that the client has")),
    responses((status = OK, body = SessionDetail, headers(("ETag" = String, description = "Of this answer"))),
        (status = NOT_MODIFIED, description = "The client has it"),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn session(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path(id) = id.map_err(malformed)?;
    tagged_json(&headers, &detail(&shared, id).await?)
}

/// Starts a session; the one that runs ends, and no message is lost in between.
#[utoipa::path(post, path = "/api/v1/sessions", operation_id = "start_session", tag = "sessions",
    request_body(content = Option<NotesChange>, description = "What it is called; may be left out"),
    responses(
        (status = CREATED, body = SessionView, headers(("Location" = String, description = "The session"))),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = CONFLICT, body = Problem, content_type = "application/problem+json"),
        (status = UNSUPPORTED_MEDIA_TYPE, body = Problem, content_type = "application/problem+json"),
        (status = INSUFFICIENT_STORAGE, body = Problem, content_type = "application/problem+json"),
        (status = SERVICE_UNAVAILABLE, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn start(
    State(shared): State<Shared>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let change: NotesChange = json(&headers, body)?.unwrap_or_default();
    let mut notes = Notes::default();
    change.apply(&mut notes).map_err(|wrong| Problem::new(StatusCode::BAD_REQUEST, wrong))?;
    let id = command(&shared, |answer| Command::Start { notes, answer }).await?;
    let view = detail(&shared, id.clone()).await?.session;
    let mut response = (StatusCode::CREATED, Json(view)).into_response();
    if let Ok(location) = HeaderValue::from_str(&format!("/api/v1/sessions/{id}")) {
        response.headers_mut().insert(LOCATION, location);
    }
    Ok(response)
}

/// Ends the session that runs. Nothing is recorded until another one is started, or begins by itself.
#[utoipa::path(post, path = "/api/v1/sessions/{id}/stop", operation_id = "stop_session", tag = "sessions",
    params(("id" = String, Path, description = "The session's id", min_length = 1, max_length = 64)),
    responses((status = OK, body = SessionView),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json"),
        (status = CONFLICT, body = Problem, content_type = "application/problem+json"),
        (status = SERVICE_UNAVAILABLE, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn stop(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
) -> Result<Json<SessionView>, Problem> {
    let Path(id) = id.map_err(malformed)?;
    // What is not there is not found, whatever the recorder does.
    detail(&shared, id.clone()).await?;
    let id = command(&shared, |answer| Command::Stop { id, answer }).await?;
    Ok(Json(detail(&shared, id).await?.session))
}

/// Writes name, notes or tags of a session; what is left out stays as it is.
#[utoipa::path(patch, path = "/api/v1/sessions/{id}", operation_id = "edit_session", tag = "sessions",
    params(("id" = String, Path, description = "The session's id", min_length = 1, max_length = 64)),
    request_body = NotesChange,
    responses((status = OK, body = SessionView),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json"),
        (status = UNSUPPORTED_MEDIA_TYPE, body = Problem, content_type = "application/problem+json"),
        (status = INSUFFICIENT_STORAGE, body = Problem, content_type = "application/problem+json"),
        (status = SERVICE_UNAVAILABLE, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn edit(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Json<SessionView>, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let change: NotesChange = json_needed(&headers, body)?;
    let wanted = id.clone();
    match ask(&shared, move |catalogue, _| catalogue.edit(&wanted, change)).await? {
        Ok(Some(Ok(()))) => Ok(Json(detail(&shared, id).await?.session)),
        Ok(Some(Err(wrong))) => Err(Problem::new(StatusCode::BAD_REQUEST, wrong)),
        Ok(None) => Err(Problem::not_found("session", &id)),
        Err(error) => {
            tracing::error!("session {id}: what is written to it cannot be kept: {error}");
            let status = match says_full(&error) {
                true => StatusCode::INSUFFICIENT_STORAGE,
                false => StatusCode::SERVICE_UNAVAILABLE,
            };
            Err(Problem::new(status, format!("it cannot be written: {error}")))
        }
    }
}

async fn detail(shared: &Shared, id: String) -> Result<SessionDetail, Problem> {
    let not_found = Problem::not_found("session", &id);
    let detail = ask(shared, move |catalogue, progress| catalogue.detail(&id, progress)).await?;
    detail.ok_or(not_found)
}

/// Asks the catalogue, which reads the disk.
pub(super) async fn ask<T: Send + 'static>(
    shared: &Shared,
    question: impl FnOnce(&Catalogue, Option<&Progress>) -> T + Send + 'static,
) -> Result<T, Problem> {
    let catalogue = Arc::clone(&shared.catalogue);
    let progress = shared.progress();
    let answer = tokio::task::spawn_blocking(move || question(&catalogue, progress.as_ref()));
    answer.await.map_err(|error| {
        tracing::error!("the sessions cannot be read: {error}");
        Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the sessions cannot be read")
    })
}

/// Asks the recorder, and waits until it is done.
async fn command(
    shared: &Shared,
    command: impl FnOnce(oneshot::Sender<Answer>) -> Command,
) -> Result<String, Problem> {
    let Some(inbox) = shared.recorder_inbox.clone() else {
        let detail = "nothing is recorded here: the site file has record.enabled = false";
        return Err(Problem::new(StatusCode::CONFLICT, detail));
    };
    let (sender, answer) = oneshot::channel();
    let command = command(sender);
    // Waits behind the messages, which may be many.
    let sent = tokio::task::spawn_blocking(move || inbox.send(command).is_ok()).await.unwrap_or(false);
    let ends = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "the server ends");
    if !sent {
        return Err(ends());
    }
    answer.await.map_err(|_| ends())?.map_err(|refusal| match refusal {
        Refusal::NotNow(why) => Problem::new(StatusCode::CONFLICT, why),
        Refusal::NoRoom(why) => Problem::new(StatusCode::INSUFFICIENT_STORAGE, why),
        Refusal::Failed(why) => Problem::new(StatusCode::SERVICE_UNAVAILABLE, why),
    })
}
