//! Alerts: the list, who saw them, and whether they arrive.

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::{BytesRejection, PathRejection};
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use futures_util::future::join_all;
use serde::{Deserialize, Serialize};
use tokio::sync::oneshot;

use super::Shared;
use super::input::{Parameters, json, malformed};
use super::outages::ask;
use super::problem::Problem;
use super::query::{bad, limit, time};
use super::visitor::Visitor;
use crate::fleet::{Alert, AlertState, AlertView, RuleKind, Unacknowledged};
use crate::site::alerts::{Acknowledge, Letter, test_alert};
use crate::site::history::{AlertFilter, Cursor};

/// A note is no longer, characters.
const NOTE_MAX: usize = 2000;

/// Which alerts.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct AlertsQuery {
    /// Only this machine's.
    machine: Option<String>,
    /// Only this rule's.
    rule: Option<RuleKind>,
    /// Only those that stand so.
    state: Option<AlertState>,
    /// Only those that were raised then or later, RFC 3339.
    #[param(format = DateTime)]
    from: Option<String>,
    /// Only those that were raised before, RFC 3339.
    #[param(format = DateTime)]
    to: Option<String>,
    /// So many at most: 100 if it is left out.
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<usize>,
    /// Where the list goes on: `next` of the answer before.
    cursor: Option<String>,
}

/// A part of the list of alerts.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct AlertsView {
    /// Newest first.
    alerts: Vec<AlertView>,
    /// The `cursor` with which the list goes on; `null` at its end.
    next: Option<String>,
}

/// What somebody writes who saw an alert.
#[derive(Debug, Default, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct AcknowledgeRequest {
    /// At most 2000 characters; may be left out.
    #[serde(default)]
    #[schema(max_length = 2000)]
    note: String,
}

/// What a receiver said to a test.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct ChannelTest {
    /// `webhook:{name}` or `mail`.
    channel: String,
    /// Whether it took the test.
    delivered: bool,
    /// What it said, or why it was not told.
    said: String,
}

/// What the receivers said to a test.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct TestView {
    /// One for each channel of the site file; none if there are no channels.
    channels: Vec<ChannelTest>,
}

/// Alerts, also those that are over.
#[utoipa::path(get, path = "/api/v1/alerts", operation_id = "alerts", tag = "alerts", params(AlertsQuery),
    responses((status = OK, body = AlertsView),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = INTERNAL_SERVER_ERROR, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list(
    State(shared): State<Shared>,
    Parameters(query): Parameters<AlertsQuery>,
) -> Result<Json<AlertsView>, Problem> {
    let cursor = |text: String| Cursor::decode(&text).ok_or_else(|| bad("cursor is none of ours"));
    let filter = AlertFilter {
        machine: query.machine,
        rule: query.rule,
        state: query.state,
        from: time("from", query.from.as_deref())?,
        to: time("to", query.to.as_deref())?,
        after: query.cursor.map(cursor).transpose()?,
        limit: limit(query.limit)?,
    };
    let (alerts, next) = ask(&shared, move |archive| archive.alerts(&filter)).await?;
    // The archive has what an alert was when it last changed; the worst of one that goes on grows on.
    let open = Arc::clone(&shared.alerts.open.borrow());
    let newest = alerts.iter().map(|alert| {
        let same = |newer: &&Alert| newer.id == alert.id && newer.changed == alert.changed;
        AlertView::from(open.iter().find(same).unwrap_or(alert))
    });
    let alerts = newest.collect();
    Ok(Json(AlertsView { alerts, next: next.map(|cursor| cursor.encode()) }))
}

/// Somebody saw the alert.
#[utoipa::path(post, path = "/api/v1/alerts/{id}/acknowledge", operation_id = "acknowledge_alert", tag = "alerts",
    params(("id" = String, Path, description = "The alert's id", min_length = 1, max_length = 200)),
    request_body(content = Option<AcknowledgeRequest>, description = "A note; may be left out"),
    responses((status = OK, body = AlertView),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json"),
        (status = CONFLICT, body = Problem, content_type = "application/problem+json"),
        (status = UNSUPPORTED_MEDIA_TYPE, body = Problem, content_type = "application/problem+json"),
        (status = SERVICE_UNAVAILABLE, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn acknowledge(
    State(shared): State<Shared>,
    visitor: Visitor,
    id: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Json<AlertView>, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let request: AcknowledgeRequest = json(&headers, body)?.unwrap_or_default();
    if request.note.chars().count() > NOTE_MAX {
        return Err(bad(format!("note has more than {NOTE_MAX} characters")));
    }
    let (answer, answered) = oneshot::channel();
    let command = Acknowledge { id: id.clone(), by: who(&visitor), note: request.note, answer };
    let ends = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "the server ends");
    shared.alerts.commands.send(command).await.map_err(|_| ends())?;
    match answered.await.map_err(|_| ends())? {
        Ok(alert) => Ok(Json(AlertView::from(&alert))),
        Err(Unacknowledged::Already) => Err(already(&id)),
        Err(Unacknowledged::Unknown) => {
            let wanted = id.clone();
            match ask(&shared, move |archive| archive.alert(&wanted)).await? {
                Some(_) => Err(already(&id)),
                None => Err(Problem::not_found("alert", &id)),
            }
        }
    }
}

fn already(id: &str) -> Problem {
    Problem::new(StatusCode::CONFLICT, format!("alert {id} is acknowledged already"))
}

/// Who asks; without accounts only this computer reaches the server.
fn who(visitor: &Visitor) -> String {
    visitor.known.as_ref().map_or_else(|| "anonymous on loopback".to_owned(), |known| known.name.clone())
}

/// Sends a test through all channels, and waits for what they say; nothing is tried twice.
#[utoipa::path(post, path = "/api/v1/alerts/test", operation_id = "test_alerts", tag = "alerts",
    responses((status = OK, body = TestView)))]
pub(super) async fn test(State(shared): State<Shared>) -> Json<TestView> {
    let now = shared.clock.now();
    let alert = test_alert(now);
    let letter = Letter { site: &shared.site, is_test: true, alert: &alert };
    let tests = shared.alerts.channels.iter().map(async |channel| {
        let said = channel.send(&letter, now).await;
        let delivered = said.is_ok();
        ChannelTest { channel: channel.name(), delivered, said: said.unwrap_or_else(|why| why) }
    });
    Json(TestView { channels: join_all(tests).await })
}
