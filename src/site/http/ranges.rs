//! Files given out whole or in part: conditions, ranges, and the bytes block by block.

use std::collections::VecDeque;
use std::io::SeekFrom;

use axum::body::{Body, Bytes};
use axum::http::header::{
    ACCEPT_RANGES, CONTENT_DISPOSITION, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, ETAG, IF_RANGE, RANGE,
};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncSeekExt};

use super::input::is_known;
use super::problem::Problem;
use crate::record::Piece;

/// Bytes that are read at once.
const BLOCK_BYTES: u64 = 256 * 1024;

/// What is to be sent.
pub(super) struct Parcel {
    /// What it is, as people call it: "the recording".
    pub what: &'static str,
    /// Which one, for the log.
    pub which: String,
    /// By what name a browser keeps it; `None` if it is not for keeping.
    pub file_name: Option<String>,
    /// Media type.
    pub kind: &'static str,
    pub pieces: Vec<Piece>,
    /// The same as long as the bytes are; `None` while they are still written.
    pub tag: Option<String>,
}

/// The bytes that were asked for, or that the client has them already.
///
/// # Errors
/// 416 for what is beyond the end; 500 for what cannot be read, which is logged.
pub(super) async fn send(headers: &HeaderMap, parcel: Parcel) -> Result<Response, Problem> {
    let Parcel { what, which, file_name, kind, pieces, tag } = parcel;
    let bytes: u64 = pieces.iter().map(Piece::bytes).sum();
    if let Some(tag) = tag.as_deref().filter(|tag| is_known(headers, tag)) {
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
            let detail = format!("{what} has {bytes} bytes");
            let problem = Problem::new(StatusCode::RANGE_NOT_SATISFIABLE, detail);
            let whole = HeaderValue::from_str(&format!("bytes */{bytes}"));
            return Err(whole.into_iter().fold(problem, |problem, whole| problem.with(CONTENT_RANGE, whole)));
        }
    };
    let mut source = Source { pieces: cut(pieces, first, length), open: None };
    // What cannot be opened is better told now than by a broken transfer.
    let begin = source.next().await.map_err(|error| unreadable(what, &which, &error))?;
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
    set(CONTENT_TYPE, kind.to_owned());
    set(CONTENT_LENGTH, length.to_string());
    set(ACCEPT_RANGES, "bytes".to_owned());
    if let Some(name) = file_name {
        set(CONTENT_DISPOSITION, format!("attachment; filename=\"{name}\""));
    }
    if status == StatusCode::PARTIAL_CONTENT {
        set(CONTENT_RANGE, format!("bytes {first}-{}/{bytes}", first + length - 1));
    }
    if let Some(tag) = tag {
        set(ETAG, tag);
    }
    Ok(response)
}

/// What is there, but cannot be read.
pub(super) fn unreadable(what: &str, which: &str, error: &dyn std::fmt::Display) -> Problem {
    tracing::error!("{which} cannot be read: {error}");
    Problem::new(StatusCode::INTERNAL_SERVER_ERROR, format!("{what} cannot be read"))
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
