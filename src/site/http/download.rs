//! Downloads of recordings, whole or in part.

use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use serde::Deserialize;

use super::Shared;
use super::input::{Parameters, malformed};
use super::problem::Problem;
use super::ranges::{Parcel, send, unreadable};
use super::sessions::ask;
use crate::record::{Piece, merge};
use crate::site::sessions::Located;

/// What is downloaded.
const WHAT: &str = "the recording";

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
    // A finished file is never written again, except by recovery, which changes its length.
    let bytes: u64 = pieces.iter().map(Piece::bytes).sum();
    let parcel = Parcel {
        what: WHAT,
        which: format!("session {id}"),
        file_name: Some(format!("{name}.mcap")),
        kind: "application/octet-stream",
        tag: finished.then(|| format!("\"{name}-{bytes}\"")),
        pieces,
    };
    send(&headers, parcel).await
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
        let about =
            std::fs::metadata(path).map_err(|error| unreadable(WHAT, &format!("session {id}"), &error))?;
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
