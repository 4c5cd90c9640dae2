//! Downloads of recordings, whole or in part.

use std::io::SeekFrom;
use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::header::{
    ACCEPT_RANGES, CONTENT_DISPOSITION, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, ETAG, IF_NONE_MATCH,
    RANGE,
};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncSeekExt};

use super::Shared;
use super::api::malformed;
use super::problem::Problem;
use crate::site::catalogue::SessionFile;

/// Bytes that are read at once.
const BLOCK_BYTES: u64 = 256 * 1024;

/// The recording of a session as an MCAP file; of a running session, what is finished of it.
#[utoipa::path(get, path = "/api/v1/sessions/{id}/recording.mcap", tag = "sessions",
    params(("id" = String, Path, description = "The session's id"),
        ("Range" = Option<String>, Header, description = "One range of bytes")),
    responses((status = OK, content_type = "application/octet-stream", body = Vec<u8>),
        (status = PARTIAL_CONTENT, content_type = "application/octet-stream", body = Vec<u8>),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json"),
        (status = RANGE_NOT_SATISFIABLE, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn recording(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let catalogue = Arc::clone(&shared.catalogue);
    let (progress, wanted) = (shared.progress(), id.clone());
    let located = tokio::task::spawn_blocking(move || catalogue.locate(&wanted, progress.as_ref())).await;
    let located = located.map_err(|error| unreadable(&id, &error))?;
    let SessionFile { path, bytes, finished } = located.ok_or_else(|| Problem::not_found("session", &id))?;
    // A finished file is never written again, except by recovery, which changes its length.
    let tag = finished.then(|| format!("\"{id}-{bytes}\""));
    let known = headers.get(IF_NONE_MATCH).and_then(|value| value.to_str().ok());
    if known.is_some() && known == tag.as_deref() {
        return Ok(StatusCode::NOT_MODIFIED.into_response());
    }
    let range =
        headers.get(RANGE).and_then(|value| value.to_str().ok()).map(|range| parse_range(range, bytes));
    let (status, first, length) = match range {
        None | Some(Range::Ignored) => (StatusCode::OK, 0, bytes),
        Some(Range::Part { first, last }) => (StatusCode::PARTIAL_CONTENT, first, last - first + 1),
        Some(Range::Outside) => {
            let detail = format!("the recording has {bytes} bytes");
            return Err(Problem::new(StatusCode::RANGE_NOT_SATISFIABLE, detail));
        }
    };
    let mut file = File::open(&path).await.map_err(|error| unreadable(&id, &error))?;
    file.seek(SeekFrom::Start(first)).await.map_err(|error| unreadable(&id, &error))?;
    let blocks = futures_util::stream::try_unfold((file, length), |(mut file, left)| async move {
        if left == 0 {
            return Ok::<_, std::io::Error>(None);
        }
        let mut block = vec![0; left.min(BLOCK_BYTES) as usize];
        file.read_exact(&mut block).await?;
        let left = left - block.len() as u64;
        Ok(Some((Bytes::from(block), (file, left))))
    });
    let mut response = (status, Body::from_stream(blocks)).into_response();
    let mut set = |name, value: String| {
        if let Ok(value) = HeaderValue::from_str(&value) {
            response.headers_mut().insert(name, value);
        }
    };
    set(CONTENT_TYPE, "application/octet-stream".to_owned());
    set(CONTENT_LENGTH, length.to_string());
    set(ACCEPT_RANGES, "bytes".to_owned());
    set(CONTENT_DISPOSITION, format!("attachment; filename=\"{id}.mcap\""));
    if status == StatusCode::PARTIAL_CONTENT {
        set(CONTENT_RANGE, format!("bytes {first}-{}/{bytes}", first + length - 1));
    }
    if let Some(tag) = tag {
        set(ETAG, tag);
    }
    Ok(response)
}

fn unreadable(id: &str, error: &dyn std::fmt::Display) -> Problem {
    tracing::error!("session {id} cannot be read: {error}");
    Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the recording cannot be read")
}

/// What a `Range` header asks for.
#[derive(Debug, PartialEq)]
enum Range {
    /// Several ranges, or another unit: the whole is a valid answer.
    Ignored,
    /// Both ends are part of it.
    Part { first: u64, last: u64 },
    /// Beyond the end.
    Outside,
}

fn parse_range(text: &str, bytes: u64) -> Range {
    let Some((first, last)) = text.strip_prefix("bytes=").and_then(|range| range.split_once('-')) else {
        return Range::Ignored;
    };
    let end = bytes.saturating_sub(1);
    let (first, last) = match (first.trim().parse::<u64>(), last.trim()) {
        (Ok(first), "") => (first, end),
        (Ok(first), last) => match last.parse::<u64>() {
            Ok(last) if last >= first => (first, last.min(end)),
            _ => return Range::Ignored,
        },
        (Err(_), suffix) => match suffix.parse::<u64>() {
            Ok(0) => return Range::Outside,
            Ok(count) if first.trim().is_empty() => (bytes.saturating_sub(count), end),
            _ => return Range::Ignored,
        },
    };
    if first < bytes { Range::Part { first, last } } else { Range::Outside }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_read_as_http_has_them() {
        for (text, wanted) in [
            ("bytes=0-9", Range::Part { first: 0, last: 9 }),
            ("bytes=90-", Range::Part { first: 90, last: 99 }),
            ("bytes=90-1000", Range::Part { first: 90, last: 99 }),
            ("bytes=-10", Range::Part { first: 90, last: 99 }),
            ("bytes=-1000", Range::Part { first: 0, last: 99 }),
            ("bytes=100-", Range::Outside),
            ("bytes=-0", Range::Outside),
            ("bytes=5-3", Range::Ignored),
            ("bytes=0-1,5-6", Range::Ignored),
            ("lines=0-1", Range::Ignored),
            ("bytes=a-b", Range::Ignored),
            ("bytes=", Range::Ignored),
        ] {
            assert_eq!(parse_range(text, 100), wanted, "{text}");
        }
        assert_eq!(parse_range("bytes=0-", 0), Range::Outside);
    }
}
