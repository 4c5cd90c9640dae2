//! Errors as RFC 9457 problem details, without exception.

use axum::Json;
use axum::body::Body;
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE, RETRY_AFTER, WWW_AUTHENTICATE};
use axum::http::{HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use crate::accounts::AccountsError;

/// The media type of problem details.
pub(super) const PROBLEM: &str = "application/problem+json";
/// So much of an error in plain text is read.
const TEXT_BYTES_MAX: usize = 4096;

/// An error as RFC 9457 has it.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub(in crate::site) struct Problem {
    /// `about:blank`: the status says what kind of error it is.
    #[serde(rename = "type")]
    kind: &'static str,
    /// The status in words.
    title: &'static str,
    /// The HTTP status.
    #[schema(minimum = 400, maximum = 599)]
    status: u16,
    /// What is wrong here, and what would be right.
    pub(super) detail: String,
    #[serde(skip)]
    headers: Vec<(HeaderName, HeaderValue)>,
}

impl Problem {
    pub fn new(status: StatusCode, detail: impl Into<String>) -> Self {
        Self {
            kind: "about:blank",
            title: status.canonical_reason().unwrap_or("Error"),
            status: status.as_u16(),
            detail: detail.into(),
            headers: Vec::new(),
        }
    }

    pub fn not_found(what: &str, id: &str) -> Self {
        let id: String = id.chars().take(80).collect();
        Self::new(StatusCode::NOT_FOUND, format!("there is no {what} \"{id}\""))
    }

    /// Nobody who is known asks; `detail` says why.
    pub fn unauthorized(detail: &str) -> Self {
        let challenge = HeaderValue::from_static("Bearer realm=\"holdfast\"");
        Self::new(StatusCode::UNAUTHORIZED, detail).with(WWW_AUTHENTICATE, challenge)
    }

    /// Too much was asked for; again after so many seconds.
    pub fn too_many(detail: &str, after_s: f64) -> Self {
        let after_s = after_s.ceil().clamp(1.0, 86_400.0) as u32;
        Self::new(StatusCode::TOO_MANY_REQUESTS, format!("{detail}; try again in {after_s} s"))
            .with(RETRY_AFTER, after_s.into())
    }

    pub fn with(mut self, name: HeaderName, value: HeaderValue) -> Self {
        self.headers.push((name, value));
        self
    }
}

impl From<AccountsError> for Problem {
    fn from(error: AccountsError) -> Self {
        let status = match &error {
            AccountsError::Invalid(_) => StatusCode::BAD_REQUEST,
            AccountsError::Missing { .. } => StatusCode::NOT_FOUND,
            AccountsError::Taken(_) | AccountsError::OnlyAdmin(_) => StatusCode::CONFLICT,
            AccountsError::Unusable { .. } => {
                tracing::error!("the accounts cannot be used: {error}");
                return Self::new(StatusCode::SERVICE_UNAVAILABLE, "the accounts cannot be read or written");
            }
        };
        Self::new(status, error.to_string())
    }
}

impl IntoResponse for Problem {
    fn into_response(mut self) -> Response {
        let status = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let headers = std::mem::take(&mut self.headers);
        let mut response = (status, Json(self)).into_response();
        response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(PROBLEM));
        response.headers_mut().extend(headers);
        response
    }
}

/// An error that somebody else wrote in plain text, as a problem; everything else as it is.
pub(super) async fn as_problem(response: Response) -> Response {
    let status = response.status();
    let kind = response.headers().get(CONTENT_TYPE).and_then(|kind| kind.to_str().ok()).unwrap_or("");
    let is_ours = kind.starts_with(PROBLEM) || kind.starts_with("application/json");
    if is_ours || !(status.is_client_error() || status.is_server_error()) {
        return response;
    }
    let (mut parts, body) = response.into_parts();
    let text = axum::body::to_bytes(body, TEXT_BYTES_MAX).await.unwrap_or_default();
    let text = String::from_utf8_lossy(&text).trim().to_owned();
    let detail = if text.is_empty() { "the request cannot be answered".to_owned() } else { text };
    let (made, body): (_, Body) = Problem::new(status, detail).into_response().into_parts();
    parts.headers.remove(CONTENT_LENGTH);
    parts.headers.extend(made.headers);
    Response::from_parts(parts, body)
}
