//! Poses of a session as files for other programs, written while they are sent.
//!
//! A recording is in the order in which messages came, a track in that of its stamps: all poses are gathered first,
//! in memory up to a bound, beyond it in a scratch file without a name. So the first byte comes after the whole
//! session was read.

use std::io::{self, BufWriter, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::body::{Body, Bytes};
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use tokio::sync::{Semaphore, mpsc, oneshot};

use super::Shared;
use super::input::{Parameters, malformed};
use super::problem::Problem;
use super::query::bad;
use super::sessions::ask;
use crate::export::{
    Format, Frame, GatherError, Gathered, Lack, Options, Spool, TrackWriter, beside, gather,
};
use crate::frames::geodesy::SiteFrame;
use crate::site::sessions::disk_free_bytes;
use crate::time::Span;

/// Exports that are made at once: each reads a whole session, and the recorder wants the disk, too.
const AT_ONCE: usize = 2;
/// Of the body, that are sent at once.
const BLOCK_BYTES: usize = 64 * 1024;
/// Between the writer and the client. When they are full, the writer waits for the client.
const BLOCKS_QUEUED: usize = 8;
/// Of the scratch file: 90 hours of a machine at 100 Hz.
const SCRATCH_BYTES_MAX: u64 = 2 << 30;
/// Poses without a line between them are so far apart unless asked otherwise, s; as in the command `export`.
const GAP_S: f64 = 1.0;

/// Who may make an export now.
pub(in crate::site) fn turnstile() -> Arc<Semaphore> {
    Arc::new(Semaphore::new(AT_ONCE))
}

/// What is wanted of a session.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Wanted {
    format: Option<String>,
    machine: Option<String>,
    frame: Option<String>,
    rate_hz: Option<f64>,
    gap_s: Option<f64>,
}

/// The poses of a session's machines as a file for other programs: of the cabin IMU in the site, as they were published
/// live, each machine a track, in the order of their stamps. Of a running session, what is on the disk.
#[utoipa::path(get, path = "/api/v1/sessions/{id}/export", tag = "sessions",
    params(("id" = String, Path, description = "The session's id", min_length = 1, max_length = 64),
        ("format" = String, Query, description = "tum, csv, geojson, gpx or kml"),
        ("machine" = Option<String>, Query, description = "Only this machine; a TUM file takes one"),
        ("frame" = Option<String>, Query,
            description = "world (the default), or odom: smooth poses without places in WGS84, as tum or csv"),
        ("rate_hz" = Option<f64>, Query, description = "At most so many poses a second; by default all"),
        ("gap_s" = Option<f64>, Query,
            description = "Poses so many seconds apart are not joined by a line; by default 1")),
    responses(
        (status = OK, description = "The file", content(
            (String = "text/plain"), (String = "text/csv"), (String = "application/geo+json"),
            (String = "application/gpx+xml"), (String = "application/vnd.google-earth.kml+xml"))),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = NOT_FOUND, description = "There is no such session, no such machine in it, or no pose",
            body = Problem, content_type = "application/problem+json"),
        (status = CONFLICT, description = "The recording does not tell where the site is on the earth",
            body = Problem, content_type = "application/problem+json"),
        (status = INSUFFICIENT_STORAGE, description = "There are too many poses: ask for one machine",
            body = Problem, content_type = "application/problem+json")))]
pub(super) async fn export(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
    Parameters(wanted): Parameters<Wanted>,
) -> Result<Response, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let asked = id.clone();
    let located = ask(&shared, move |catalogue, progress| catalogue.locate(&asked, progress)).await?;
    let located = located.ok_or_else(|| Problem::not_found("session", &id))?;
    let mut files: Vec<(u32, PathBuf)> = located.closed;
    files.extend(located.open.map(|(number, path, _)| (number, path)));
    files.sort();
    let job = Job::of(wanted, id, files.into_iter().map(|(_, path)| path).collect())?;
    let mut response = Response::default();
    for (name, value) in [
        (CONTENT_TYPE, job.options.format.media_type().to_owned()),
        (CONTENT_DISPOSITION, format!("attachment; filename=\"{}\"", job.file_name())),
    ] {
        if let Ok(value) = HeaderValue::from_str(&value) {
            response.headers_mut().insert(name, value);
        }
    }
    let ends = |_| Problem::new(StatusCode::SERVICE_UNAVAILABLE, "the server ends");
    let turn = Arc::clone(&shared.exports).acquire_owned().await.map_err(|_| ends(()))?;
    let spool = spool(&shared);
    let (told, begins) = oneshot::channel();
    let (sender, blocks) = mpsc::channel(BLOCKS_QUEUED);
    tokio::task::spawn_blocking(move || {
        let _turn = turn;
        let gathered = match job.gather(spool) {
            Ok(gathered) => gathered,
            // Whoever asked may have gone.
            Err(problem) => return drop(told.send(Err(problem))),
        };
        if told.send(Ok(())).is_ok()
            && let Err(error) = job.write(gathered, Blocks(sender.clone()))
        {
            tracing::debug!("export of session {} broke off: {error}", job.id);
            // The transfer must not look whole.
            let _ = sender.blocking_send(Err(error));
        }
    });
    begins.await.map_err(|_| ends(()))??;
    let blocks = futures_util::stream::unfold(blocks, |mut blocks| async move {
        blocks.recv().await.map(|block| (block, blocks))
    });
    *response.body_mut() = Body::from_stream(blocks);
    Ok(response.into_response())
}

/// Where poses are gathered: beside the recordings there is room, and it is bounded.
fn spool(shared: &Shared) -> Spool {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let folder = shared.record_directory.clone().unwrap_or_else(std::env::temp_dir);
    let number = COUNT.fetch_add(1, Ordering::Relaxed);
    let scratch = beside(&folder.join("export"), &format!("{}.{number}.scratch", std::process::id()));
    // The recordings need the disk more.
    let room = disk_free_bytes(&folder).map_or(SCRATCH_BYTES_MAX, |free| free / 4);
    Spool::new(scratch).with_scratch_max(room.min(SCRATCH_BYTES_MAX))
}

/// An export that makes sense.
struct Job {
    id: String,
    files: Vec<PathBuf>,
    machine: Option<String>,
    frame: Frame,
    options: Options,
}

impl Job {
    fn of(wanted: Wanted, id: String, files: Vec<PathBuf>) -> Result<Self, Problem> {
        let formats = Format::ALL.map(Format::name).join(", ");
        let name = wanted.format.ok_or_else(|| bad(format!("say with format= which: {formats}")))?;
        let told: String = name.chars().take(80).collect();
        let format = Format::from_name(&name)
            .ok_or_else(|| bad(format!("there is no format \"{told}\", but: {formats}")))?;
        let frame = match wanted.frame.as_deref() {
            None | Some("world") => Frame::World,
            Some("odom") => Frame::Odom,
            Some(_) => return Err(bad("frame must be world or odom")),
        };
        if format.needs_origin() && frame == Frame::Odom {
            let name = format.name();
            return Err(bad(format!("{name} is in WGS84, and the odom frame is not tied to it")));
        }
        let in_range = |name: &str, value: Option<f64>| match value {
            Some(value) if !Options::RANGE.contains(&value) => Err(bad(format!(
                "{name} must be from {} to {}",
                Options::RANGE.start(),
                Options::RANGE.end()
            ))),
            value => Ok(value),
        };
        let gap = Span::from_seconds(in_range("gap_s", wanted.gap_s)?.unwrap_or(GAP_S));
        let rate_hz = in_range("rate_hz", wanted.rate_hz)?;
        let period = rate_hz.map(|rate_hz| Span::from_seconds(1.0 / rate_hz));
        let options = Options { format, site: None, gap, period };
        Ok(Self { id, files, machine: wanted.machine, frame, options })
    }

    fn file_name(&self) -> String {
        let machine = self.machine.as_deref().map_or(String::new(), |machine| format!("-{machine}"));
        format!("{}{machine}.{}", self.id, self.options.format.name())
    }

    /// Reads the session. What speaks against the export is known afterwards.
    fn gather(&self, spool: Spool) -> Result<Gathered, Problem> {
        let machine = self.machine.as_deref();
        let gathered = gather(&self.files, machine, self.frame, spool, |_| ()).map_err(|error| {
            if let GatherError::Scratch(error) = &error
                && matches!(error.kind(), io::ErrorKind::QuotaExceeded | io::ErrorKind::StorageFull)
            {
                let detail = "there are too many poses to put them in order: ask for one machine";
                return Problem::new(StatusCode::INSUFFICIENT_STORAGE, detail);
            }
            tracing::error!("session {} cannot be exported: {error}", self.id);
            Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the recording cannot be read")
        })?;
        let format = self.options.format;
        let Some(lack) = gathered.lack(machine, format, gathered.origin.is_some()) else {
            return Ok(gathered);
        };
        let known = gathered.machines.join(", ");
        Err(match lack {
            Lack::Machine => {
                let Problem { detail, .. } = Problem::not_found("machine", machine.unwrap_or_default());
                let detail = format!("{detail} in session {}, but: {known}", self.id);
                Problem::new(StatusCode::NOT_FOUND, detail)
            }
            Lack::Poses => {
                let detail = format!("session {} has no poses, but topics of: {known}", self.id);
                Problem::new(StatusCode::NOT_FOUND, detail)
            }
            Lack::OneTrack(machines) => {
                let (name, machines) = (format.name(), machines.join(", "));
                bad(format!("a {name} file takes one machine, choose with machine=: {machines}"))
            }
            Lack::Origin => {
                let detail = "the recording does not tell where the site is on the earth: ask for tum or csv";
                Problem::new(StatusCode::CONFLICT, detail)
            }
        })
    }

    fn write(&self, mut gathered: Gathered, blocks: Blocks) -> io::Result<()> {
        let options = Options { site: gathered.origin.map(SiteFrame::new), ..self.options };
        let mut writer = TrackWriter::new(BufWriter::with_capacity(BLOCK_BYTES, blocks), options)?;
        gathered.write_tracks(&mut writer, |_| ())?;
        writer.finish()?;
        if !gathered.faults.is_empty() {
            tracing::warn!("export of session {}: {}", self.id, gathered.faults.to_string().trim_end());
        }
        Ok(())
    }
}

/// The body, on its way out.
struct Blocks(mpsc::Sender<io::Result<Bytes>>);

impl Write for Blocks {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let sent = self.0.blocking_send(Ok(Bytes::copy_from_slice(bytes)));
        sent.map(|()| bytes.len()).map_err(|_| io::ErrorKind::BrokenPipe.into())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
