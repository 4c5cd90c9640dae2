//! The picture of the ground under the plan: a PMTiles file that the site file names, checked when the site starts
//! and given out as it is. Which tiles are drawn, and where, is the page's business.

use std::fs::{File, Metadata};
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::UNIX_EPOCH;

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use serde::Serialize;

use super::Shared;
use super::input::tagged_json;
use super::problem::Problem;
use super::ranges::{Parcel, send, unreadable};
use crate::config::{self, Violation};
use crate::record::Piece;

const KEY: &str = "map.basemap_file";
/// Length of a PMTiles header, version 3.
const HEADER_BYTES: usize = 127;
/// No zoom is deeper: those who read PMTiles count tiles no further.
const ZOOM_MAX: u8 = 26;

/// The site's basemap.
#[derive(Debug)]
pub(in crate::site) struct Basemap {
    path: PathBuf,
    attribution: Option<String>,
}

impl Basemap {
    /// The one that the site file names, if it names one. Reads the disk.
    ///
    /// # Errors
    /// It cannot be read, or is not of the kind that the page draws.
    pub fn of(map: &config::Map) -> Result<Option<Self>, Violation> {
        let Some(path) = map.basemap_file.clone() else { return Ok(None) };
        check(&path).map_err(|why| Violation {
            key: KEY.to_owned(),
            message: format!("is {}, {why}", path.display()),
        })?;
        Ok(Some(Self { path, attribution: map.attribution.clone() }))
    }
}

/// Whether that is a PMTiles file that the page can draw; says what is wrong.
fn check(path: &Path) -> Result<(), String> {
    let unreadable = |error: std::io::Error| format!("which cannot be read: {error}");
    let mut file = File::open(path).map_err(unreadable)?;
    let about = file.metadata().map_err(unreadable)?;
    if !about.is_file() {
        return Err("which is no file".to_owned());
    }
    let mut header = Vec::new();
    file.by_ref().take(HEADER_BYTES as u64).read_to_end(&mut header).map_err(unreadable)?;
    check_header(&header, about.len())
}

/// The header as the PMTiles specification has it, version 3: integers are little-endian.
fn check_header(header: &[u8], file_bytes: u64) -> Result<(), String> {
    if !header.starts_with(b"PMTiles") {
        return Err("which is no PMTiles file; `pmtiles convert` makes one of MBTiles".to_owned());
    }
    let version = header.get(7).copied().unwrap_or(0);
    if version != 3 {
        return Err(format!("which is PMTiles version {version}, must be 3; `pmtiles convert` renews it"));
    }
    let Ok(header) = <&[u8; HEADER_BYTES]>::try_from(header) else {
        return Err(format!("which ends after {} bytes, within its header", header.len()));
    };
    let number = |at: usize| {
        let mut bytes = [0; 8];
        bytes.copy_from_slice(&header[at..at + 8]);
        u64::from_le_bytes(bytes)
    };
    for (part, at) in [("root directory", 8), ("metadata", 24), ("leaf directories", 40), ("tiles", 56)] {
        let end = number(at).checked_add(number(at + 8));
        if end.is_none_or(|end| end > file_bytes) {
            return Err(format!(
                "which has {file_bytes} bytes, and its {part} end later: it was not copied whole"
            ));
        }
    }
    match header[99] {
        2..=4 => {}
        1 | 6 => {
            return Err("which has vector tiles; they are not drawn, must be PNG, JPEG or WebP".to_owned());
        }
        kind => return Err(format!("which has tiles of kind {kind}, must be PNG (2), JPEG (3) or WebP (4)")),
    }
    for (part, at) in [("directories", 97), ("tiles", 98)] {
        if header[at] > 2 {
            let kind = header[at];
            return Err(format!("whose {part} are compressed by kind {kind}, must be none (1) or gzip (2)"));
        }
    }
    let (least, most) = (header[100], header[101]);
    if least > most || most > ZOOM_MAX {
        return Err(format!("which has zooms from {least} to {most}, must rise and be {ZOOM_MAX} at most"));
    }
    Ok(())
}

/// What lies under the plan.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct MapView {
    /// `null` where there is none.
    basemap: Option<BasemapView>,
}

/// A picture of the ground.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct BasemapView {
    /// Who is to be named beside it; empty for nobody, `null` for whom the file names in its metadata.
    attribution: Option<String>,
}

/// Whether there is a basemap under the plan, and who is to be named beside it.
#[utoipa::path(get, path = "/api/v1/map", tag = "fleet",
    params(("If-None-Match" = Option<String>, Header, description = "Tags that the client has")),
    responses((status = OK, body = MapView, headers(("ETag" = String, description = "Changes with the answer"))),
        (status = NOT_MODIFIED, description = "The client has it")))]
pub(super) async fn map(State(shared): State<Shared>, headers: HeaderMap) -> Result<Response, Problem> {
    let basemap = shared.basemap.as_ref();
    let basemap = basemap.map(|basemap| BasemapView { attribution: basemap.attribution.clone() });
    tagged_json(&headers, &MapView { basemap })
}

/// The basemap as PMTiles (version 3) with raster tiles in Web Mercator, whole or in part.
#[utoipa::path(get, path = "/api/v1/basemap.pmtiles", tag = "fleet",
    params(("Range" = Option<String>, Header, description = "One range of bytes"),
        ("If-Range" = Option<String>, Header, description = "Only if the tag is still that; else the whole"),
        ("If-None-Match" = Option<String>, Header, description = "Tags that the client has")),
    responses((status = OK, content_type = "application/vnd.pmtiles", body = Vec<u8>,
            headers(("ETag" = String, description = "Changes with the file"))),
        (status = PARTIAL_CONTENT, content_type = "application/vnd.pmtiles", body = Vec<u8>,
            headers(("ETag" = String, description = "Changes with the file"))),
        (status = NOT_MODIFIED, description = "The client has it"),
        (status = NOT_FOUND, description = "The site has no basemap", body = Problem,
            content_type = "application/problem+json"),
        (status = RANGE_NOT_SATISFIABLE, body = Problem, content_type = "application/problem+json",
            headers(("Content-Range" = String, description = "How long it is")))))]
pub(super) async fn basemap(State(shared): State<Shared>, headers: HeaderMap) -> Result<Response, Problem> {
    let Some(basemap) = shared.basemap.as_ref().map(Arc::clone) else {
        let detail = format!("this site has no basemap: {KEY} is not in the site file");
        return Err(Problem::new(StatusCode::NOT_FOUND, detail));
    };
    let (what, which) = ("the basemap", basemap.path.display().to_string());
    let about = tokio::fs::metadata(&basemap.path).await;
    let about = about.map_err(|error| unreadable(what, &which, &error))?;
    let piece = Piece::Of { path: basemap.path.clone(), start: 0, bytes: about.len() };
    let tag = Some(tag(&about));
    let kind = "application/vnd.pmtiles";
    send(&headers, Parcel { what, which, file_name: None, kind, pieces: vec![piece], tag }).await
}

/// Another file in its place has another length or was written at another time.
fn tag(about: &Metadata) -> String {
    let written = about.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    format!("\"{:x}-{:x}\"", about.len(), written.unwrap_or_default().as_nanos())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A header of raster tiles, after which there is nothing.
    fn header() -> [u8; HEADER_BYTES] {
        let mut header = [0; HEADER_BYTES];
        header[..8].copy_from_slice(b"PMTiles\x03");
        for at in [8, 24, 40, 56] {
            header[at] = HEADER_BYTES as u8;
        }
        (header[97], header[98], header[99], header[100], header[101]) = (2, 1, 2, 14, 20);
        header
    }

    fn with(at: usize, value: u8) -> String {
        let mut header = header();
        header[at] = value;
        check_header(&header, HEADER_BYTES as u64).expect_err("must be refused")
    }

    #[test]
    fn png_jpeg_and_webp_are_drawn() {
        for kind in 2..=4 {
            let mut header = header();
            header[99] = kind;
            assert_eq!(check_header(&header, HEADER_BYTES as u64), Ok(()));
        }
    }

    #[test]
    fn what_the_page_cannot_draw_is_refused_with_the_reason() {
        for (at, value, expected) in [
            (0, b'p', "is no PMTiles file"),
            (7, 2, "PMTiles version 2, must be 3"),
            (99, 1, "has vector tiles; they are not drawn"),
            (99, 0, "tiles of kind 0, must be PNG (2)"),
            (99, 5, "tiles of kind 5"),
            (97, 3, "directories are compressed by kind 3"),
            (98, 4, "tiles are compressed by kind 4"),
            (100, 21, "zooms from 21 to 20"),
            (101, 27, "zooms from 14 to 27"),
            (16, 1, "its root directory end later: it was not copied whole"),
            (64, 1, "has 127 bytes, and its tiles end later"),
            (71, 0xff, "its tiles end later"),
        ] {
            let why = with(at, value);
            assert!(why.contains(expected), "{at}: {why}");
        }
        let why = check_header(&header()[..100], 100).expect_err("cut");
        assert!(why.contains("ends after 100 bytes, within its header"), "{why}");
        assert!(check_header(b"", 0).expect_err("empty").contains("is no PMTiles file"));
    }

    #[test]
    fn errors_name_the_key_and_the_file() {
        let of = |path: &Path| {
            let map = config::Map { basemap_file: Some(path.to_owned()), attribution: None };
            Basemap::of(&map).expect_err("must be refused").to_string()
        };
        let missing = of(Path::new("/nowhere/pit.pmtiles"));
        assert!(
            missing.starts_with("map.basemap_file is /nowhere/pit.pmtiles, which cannot be read: "),
            "{missing}"
        );
        let folder = std::env::temp_dir();
        assert!(of(&folder).ends_with("which is no file"), "{}", of(&folder));
        assert!(Basemap::of(&config::Map::default()).expect("none").is_none());
    }
}
