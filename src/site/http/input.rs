//! What requests bring along, and answers that a client may know already.

use axum::body::Bytes;
use axum::extract::FromRequestParts;
use axum::extract::Query;
use axum::extract::rejection::{BytesRejection, PathRejection};
use axum::http::header::{CONTENT_TYPE, ETAG, IF_MATCH, IF_NONE_MATCH};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest as _, Sha256};

use super::door::Late;
use super::problem::Problem;

/// No body is longer, but for those that say so.
pub(super) const BODY_BYTES_MAX: usize = 64 * 1024;

/// Parameters of a query.
pub(super) struct Parameters<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequestParts<S> for Parameters<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        let read = Query::try_from_uri(&parts.uri);
        let Query(parameters) =
            read.map_err(|rejection| Problem::new(StatusCode::BAD_REQUEST, rejection.body_text()))?;
        Ok(Self(parameters))
    }
}

/// A part of the path that cannot be read.
pub(super) fn malformed(rejection: PathRejection) -> Problem {
    Problem::new(StatusCode::BAD_REQUEST, rejection.body_text())
}

/// A body of one of these media types.
pub(super) fn body(
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
    kinds: &[&str],
) -> Result<Bytes, Problem> {
    let body = body.map_err(|rejection| match Late::is_behind(&rejection) {
        true => Problem::new(StatusCode::REQUEST_TIMEOUT, Late.to_string()),
        false => Problem::new(rejection.status(), rejection.body_text()),
    })?;
    let kind = headers.get(CONTENT_TYPE).and_then(|value| value.to_str().ok()).unwrap_or("");
    let kind = kind.split(';').next().unwrap_or("").trim();
    if !body.is_empty() && !kinds.iter().any(|wanted| kind.eq_ignore_ascii_case(wanted)) {
        let detail = format!("the body must be {}", kinds.join(" or "));
        return Err(Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, detail));
    }
    Ok(body)
}

/// A body in JSON; `None` if there is none.
pub(super) fn json<T: DeserializeOwned>(
    headers: &HeaderMap,
    bytes: Result<Bytes, BytesRejection>,
) -> Result<Option<T>, Problem> {
    let body = body(headers, bytes, &["application/json"])?;
    if body.is_empty() {
        return Ok(None);
    }
    // Of a list, its items would be taken for the fields in order.
    if body.iter().find(|byte| !byte.is_ascii_whitespace()) != Some(&b'{') {
        return Err(Problem::new(StatusCode::BAD_REQUEST, "the body must be a JSON object"));
    }
    let wrong =
        |error: serde_json::Error| Problem::new(StatusCode::BAD_REQUEST, format!("the body: {error}"));
    serde_json::from_slice(&body).map(Some).map_err(wrong)
}

/// A body in JSON that must be there.
pub(super) fn json_needed<T: DeserializeOwned>(
    headers: &HeaderMap,
    bytes: Result<Bytes, BytesRejection>,
) -> Result<T, Problem> {
    let empty = || Problem::new(StatusCode::BAD_REQUEST, "the body is empty, must be a JSON object");
    json(headers, bytes)?.ok_or_else(empty)
}

/// A strong tag of these bytes.
pub(super) fn tag(bytes: &[u8]) -> String {
    let hash: [u8; 32] = Sha256::digest(bytes).into();
    let digits: String = hash[..16].iter().map(|byte| format!("{byte:02x}")).collect();
    format!("\"{digits}\"")
}

/// Whether a list of tags in a header has this one; `None` if there is no such header.
fn lists(headers: &HeaderMap, name: HeaderName, tag: &str) -> Option<bool> {
    let mut lists = headers.get_all(name).iter().peekable();
    lists.peek()?;
    let mut tags = lists.filter_map(|list| list.to_str().ok()).flat_map(|list| list.split(','));
    // What a proxy calls weak is the same to those who look.
    Some(tags.any(|known| ["*", tag].contains(&known.trim().trim_start_matches("W/"))))
}

/// Whether a client has this already.
pub(super) fn is_known(headers: &HeaderMap, tag: &str) -> bool {
    lists(headers, IF_NONE_MATCH, tag).unwrap_or(false)
}

/// Refuses a change by somebody who saw something else.
pub(super) fn must_match(headers: &HeaderMap, tag: &str) -> Result<(), Problem> {
    match lists(headers, IF_MATCH, tag) {
        None | Some(true) => Ok(()),
        Some(false) => {
            let detail = format!("it was changed since: its tag is {tag} now; fetch it again");
            Err(Problem::new(StatusCode::PRECONDITION_FAILED, detail))
        }
    }
}

/// Bytes with their tag, or only that they are as the client has them.
pub(super) fn tagged(headers: &HeaderMap, kind: &'static str, bytes: impl Into<Bytes>) -> Response {
    let bytes = bytes.into();
    let tag = tag(&bytes);
    let mut response = match is_known(headers, &tag) {
        true => StatusCode::NOT_MODIFIED.into_response(),
        false => ([(CONTENT_TYPE, kind)], bytes).into_response(),
    };
    if let Ok(tag) = HeaderValue::from_str(&tag) {
        response.headers_mut().insert(ETAG, tag);
    }
    // To be asked for again each time; the tag saves the bytes.
    response.headers_mut().insert(axum::http::header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    response
}

/// A value as JSON with its tag.
pub(super) fn tagged_json<T: Serialize>(headers: &HeaderMap, value: &T) -> Result<Response, Problem> {
    let bytes = serde_json::to_vec(value).map_err(|error| {
        tracing::error!("an answer has no JSON form: {error}");
        Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the answer cannot be written")
    })?;
    Ok(tagged(headers, "application/json", bytes))
}
