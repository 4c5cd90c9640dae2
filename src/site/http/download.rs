//! Downloads of recordings, whole or in part.

use std::collections::VecDeque;
use std::io::SeekFrom;

use axum::body::{Body, Bytes};
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::header::{
    ACCEPT_RANGES, CONTENT_DISPOSITION, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, ETAG, IF_RANGE, RANGE,
};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncSeekExt};

use super::Shared;
use super::input::{Parameters, is_known, malformed};
use super::problem::Problem;
use super::sessions::ask;
use crate::record::{Piece, merge};
use crate::site::sessions::Located;

/// Bytes that are read at once.
const BLOCK_BYTES: u64 = 256 * 1024;

/// Which part of a session's recording.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Wanted {
    file: Option<u32>,
}

/// The recording of a session as one MCAP file, also if it has several: their data are put one after the other
/// on the way out. Of a running session, what is on the disk, without an index.
#[utoipa::path(get, path = "/api/v1/sessions/{id}/recording.mcap", tag = "sessions",
    params(("id" = String, Path, description = "The session's id", min_length = 1, max_length = 64),
        ("file" = Option<u32>, Query, description = "Only the session's file of that number, as it is", minimum = 0),
        ("Range" = Option<String>, Header, description = "One range of bytes"),
        ("If-Range" = Option<String>, Header, description = "Only if the tag is still that; else the whole"),
        ("If-None-Match" = Option<String>, Header, description = "Tags that the client has")),
    responses((status = OK, content_type = "application/octet-stream", body = Vec<u8>),
        (status = PARTIAL_CONTENT, content_type = "application/octet-stream", body = Vec<u8>),
        (status = NOT_MODIFIED, description = "The client has it"),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json"),
        (status = CONFLICT, description = "Its files cannot be put together: fetch them one by one",
            body = Problem, content_type = "application/problem+json"),
        (status = RANGE_NOT_SATISFIABLE, body = Problem, content_type = "application/problem+json",
            headers(("Content-Range" = String, description = "How long it is")))))]
pub(super) async fn recording(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
    Parameters(Wanted { file }): Parameters<Wanted>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let asked = id.clone();
    let download =
        ask(&shared, move |catalogue, progress| plan(catalogue.locate(&asked, progress), &asked, file))
            .await??;
    let Download { name, pieces, finished } = download;
    let bytes: u64 = pieces.iter().map(Piece::bytes).sum();
    // A finished file is never written again, except by recovery, which changes its length.
    let tag = finished.then(|| format!("\"{name}-{bytes}\""));
    if let Some(tag) = tag.as_deref().filter(|tag| is_known(&headers, tag)) {
        let mut response = StatusCode::NOT_MODIFIED.into_response();
        response.headers_mut().extend(HeaderValue::from_str(tag).ok().map(|tag| (ETAG, tag)));
        return Ok(response);
    }
    // A part of something else than the client has the beginning of would be of no use to it.
    let is_the_same = headers.get(IF_RANGE).is_none_or(|has| tag.as_deref().is_some_and(|tag| has == tag));
    let range = headers.get(RANGE).filter(|_| is_the_same).and_then(|value| value.to_str().ok());
    let range = range.map(|range| parse_range(range, bytes));
    let (status, first, length) = match range {
        None | Some(Range::Ignored) => (StatusCode::OK, 0, bytes),
        Some(Range::Part { first, last }) => (StatusCode::PARTIAL_CONTENT, first, last - first + 1),
        Some(Range::Outside) => {
            let detail = format!("the recording has {bytes} bytes");
            let problem = Problem::new(StatusCode::RANGE_NOT_SATISFIABLE, detail);
            let whole = HeaderValue::from_str(&format!("bytes */{bytes}"));
            return Err(whole.into_iter().fold(problem, |problem, whole| problem.with(CONTENT_RANGE, whole)));
        }
    };
    let mut source = Source { pieces: cut(pieces, first, length), open: None };
    // What cannot be opened is better told now than by a broken transfer.
    let begin = source.next().await.map_err(|error| unreadable(&id, &error))?;
    let blocks = futures_util::stream::try_unfold((source, begin), |(mut source, ready)| async move {
        let Some(block) = ready else { return Ok::<_, std::io::Error>(None) };
        let next = source.next().await?;
        Ok(Some((block, (source, next))))
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
    set(CONTENT_DISPOSITION, format!("attachment; filename=\"{name}.mcap\""));
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

/// What is to be sent.
struct Download {
    /// Without its ending.
    name: String,
    pieces: Vec<Piece>,
    finished: bool,
}

/// Finds out where the bytes are. Reads the disk.
fn plan(located: Option<Located>, id: &str, file: Option<u32>) -> Result<Download, Problem> {
    let Located { closed, open, finished } = located.ok_or_else(|| Problem::not_found("session", id))?;
    let numbers: Vec<String> = closed
        .iter()
        .map(|(number, _)| number)
        .chain(open.iter().map(|(number, ..)| number))
        .map(u32::to_string)
        .collect();
    let as_it_is = |path: &std::path::Path| {
        let about = std::fs::metadata(path).map_err(|error| unreadable(id, &error))?;
        Ok::<_, Problem>(vec![Piece::Of { path: path.to_owned(), start: 0, bytes: about.len() }])
    };
    if let Some(wanted) = file {
        let name = format!("{id}-{wanted:04}");
        if let Some((_, path)) = closed.iter().find(|(number, _)| *number == wanted) {
            return Ok(Download { name, pieces: as_it_is(path)?, finished: true });
        }
        return match open.filter(|(number, ..)| *number == wanted) {
            Some((_, path, bytes)) => {
                Ok(Download { name, pieces: vec![Piece::Of { path, start: 0, bytes }], finished: false })
            }
            None => {
                let detail = format!("session \"{id}\" has the files {}, not {wanted}", numbers.join(", "));
                Err(Problem::new(StatusCode::NOT_FOUND, detail))
            }
        };
    }
    let name = id.to_owned();
    if let ([(_, path)], None) = (closed.as_slice(), &open) {
        return Ok(Download { name, pieces: as_it_is(path)?, finished });
    }
    let paths: Vec<_> = closed.into_iter().map(|(_, path)| path).collect();
    let unfinished = open.as_ref().map(|(_, path, bytes)| (path.as_path(), *bytes));
    let pieces = merge(&paths, unfinished).map_err(|error| {
        tracing::warn!("session {id} has no recording in one piece: {error}");
        let detail = format!(
            "the files of this session cannot be put together ({error}); fetch them one by one with ?file=, {}",
            numbers.join(", ")
        );
        Problem::new(StatusCode::CONFLICT, detail)
    })?;
    Ok(Download { name, pieces, finished })
}

/// What is left of pieces: which bytes of each.
type Cuts = VecDeque<(Piece, u64, u64)>;

/// `length` bytes from `first` on.
fn cut(pieces: Vec<Piece>, mut first: u64, mut length: u64) -> Cuts {
    let mut cuts = Cuts::new();
    for piece in pieces {
        let bytes = piece.bytes();
        let from = first.min(bytes);
        let count = (bytes - from).min(length);
        if count > 0 {
            cuts.push_back((piece, from, count));
        }
        first -= from;
        length -= count;
    }
    cuts
}

/// The bytes, block by block.
struct Source {
    pieces: Cuts,
    /// The file that is being read, and how much of it is still wanted.
    open: Option<(File, u64)>,
}

impl Source {
    async fn next(&mut self) -> std::io::Result<Option<Bytes>> {
        loop {
            if let Some((file, left)) = &mut self.open {
                let mut block = vec![0; (*left).min(BLOCK_BYTES) as usize];
                file.read_exact(&mut block).await?;
                *left -= block.len() as u64;
                if *left == 0 {
                    self.open = None;
                }
                return Ok(Some(Bytes::from(block)));
            }
            let Some((piece, from, count)) = self.pieces.pop_front() else { return Ok(None) };
            if let Piece::Of { path, start, .. } = &piece {
                let mut file = File::open(path).await?;
                file.seek(SeekFrom::Start(start + from)).await?;
                self.open = Some((file, count));
                continue;
            }
            let loaded = tokio::task::spawn_blocking(move || piece.load()).await?;
            let loaded = Bytes::from(loaded.map_err(std::io::Error::other)?);
            return Ok(Some(loaded.slice(from as usize..(from + count) as usize)));
        }
    }
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
    fn any_range_of_several_pieces_is_what_it_is_of_the_whole() {
        let parts: [&[u8]; 4] = [b"abc", b"", b"defg", b"h"];
        let whole = parts.concat();
        for first in 0..=whole.len() {
            for length in 0..=whole.len() - first {
                let pieces = parts.map(|part| Piece::Bytes(part.to_vec())).into();
                let cuts = cut(pieces, first as u64, length as u64);
                let bytes: Vec<u8> = cuts
                    .iter()
                    .flat_map(|(piece, from, count)| {
                        let bytes = piece.load().expect("bytes");
                        bytes[*from as usize..(from + count) as usize].to_vec()
                    })
                    .collect();
                assert_eq!(bytes, whole[first..first + length]);
            }
        }
    }

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
