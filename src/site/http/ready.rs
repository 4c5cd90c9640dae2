//! Whether the server lives, and whether it can do its work. Machines that are offline are not its fault.

use std::path::Path;

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::Shared;

/// Less free space than this is not enough, bytes.
const DISK_FLOOR_BYTES: u64 = 200_000_000;
/// A recording that was not synced for so long is stuck, s.
const UNSYNCED_MAX_S: f64 = 5.0;

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
        if let Some(failure) = progress.failure {
            reasons.push(format!("nothing is recorded: {failure}"));
        }
        let unsynced_s = progress.unsynced_since.map_or(0.0, |since| shared.clock.now().seconds_since(since));
        if unsynced_s > UNSYNCED_MAX_S {
            reasons.push(format!("the recording was not synced for {unsynced_s:.1} s"));
        }
    }
    match shared.record_directory.as_deref().and_then(disk_free_bytes) {
        Some(free) if free < DISK_FLOOR_BYTES => {
            reasons.push(format!("the disk has {} MB left", free / 1_000_000));
        }
        _ => {}
    }
    reasons
}

/// Space that is left where `path` is; `None` if the system does not tell.
#[cfg(unix)]
pub(super) fn disk_free_bytes(path: &Path) -> Option<u64> {
    use std::os::unix::ffi::OsStrExt as _;
    let path = std::ffi::CString::new(path.as_os_str().as_bytes()).ok()?;
    let mut answer = std::mem::MaybeUninit::<libc::statvfs>::uninit();
    // SAFETY: the path ends with NUL and outlives the call; the answer is read only if it was written.
    let answer = unsafe {
        if libc::statvfs(path.as_ptr(), answer.as_mut_ptr()) != 0 {
            return None;
        }
        answer.assume_init()
    };
    #[allow(clippy::unnecessary_cast, reason = "the types differ between systems")]
    Some(answer.f_bavail as u64 * answer.f_frsize as u64)
}

#[cfg(not(unix))]
pub(super) fn disk_free_bytes(_path: &Path) -> Option<u64> {
    None
}
