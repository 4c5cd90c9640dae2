//! The site plan: GeoJSON that people give us, checked, kept in a file, and given out as it came.

use std::fs::File;
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::header::ETAG;
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde_json::Value;
use tokio::sync::Mutex;

use super::Shared;
use super::input::{body, must_match, tag, tagged};
use super::problem::Problem;

/// No plan is longer.
pub(super) const PLAN_BYTES_MAX: usize = 4 * 1024 * 1024;
/// No plan has more points.
const POSITIONS_MAX: usize = 200_000;
/// As long as nobody gave a plan.
const EMPTY: &[u8] = br#"{"type":"FeatureCollection","features":[]}"#;
/// Media type of GeoJSON.
const KIND: &str = "application/geo+json";

/// The plan's file; one change at a time.
#[derive(Clone, Debug)]
pub(in crate::site) struct Plan {
    path: Arc<PathBuf>,
    changing: Arc<Mutex<()>>,
}

impl Plan {
    /// Of a site that keeps its data in `directory`.
    pub fn of(directory: &Path) -> Self {
        Self { path: Arc::new(directory.join("plan.geojson")), changing: Arc::default() }
    }

    async fn read(&self) -> Result<Vec<u8>, Problem> {
        match tokio::fs::read(&*self.path).await {
            Ok(bytes) => Ok(bytes),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(EMPTY.to_vec()),
            Err(error) => {
                tracing::error!("{}: {error}", self.path.display());
                Err(Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the plan cannot be read"))
            }
        }
    }

    async fn write(&self, bytes: Bytes) -> Result<(), Problem> {
        let path = Arc::clone(&self.path);
        let written = tokio::task::spawn_blocking(move || replace(&path, &bytes)).await;
        written.map_err(std::io::Error::other).flatten().map_err(|error| {
            tracing::error!("{}: {error}", self.path.display());
            Problem::new(StatusCode::INSUFFICIENT_STORAGE, format!("the plan cannot be written: {error}"))
        })
    }
}

/// Puts a new file in the place of the old one: whole or not at all, also in a power cut.
fn replace(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let folder = path.parent().unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder)?;
    let beside = path.with_extension("geojson.new");
    let mut file = File::create(&beside)?;
    let written =
        file.write_all(bytes).and_then(|()| file.sync_all()).and_then(|()| std::fs::rename(&beside, path));
    if written.is_err() {
        let _ = std::fs::remove_file(&beside);
    }
    written?;
    File::open(folder)?.sync_all()
}

/// The site plan as GeoJSON (RFC 7946) in WGS84; empty as long as nobody gave one.
#[utoipa::path(get, path = "/api/v1/plan", tag = "fleet",
    params(("If-None-Match" = Option<String>, Header, description = "Tags that the client has")),
    responses((status = OK, content_type = "application/geo+json", body = Object,
            headers(("ETag" = String, description = "Changes with the plan"))),
        (status = NOT_MODIFIED, description = "The client has it")))]
pub(super) async fn plan(State(shared): State<Shared>, headers: HeaderMap) -> Result<Response, Problem> {
    Ok(tagged(&headers, KIND, shared.plan.read().await?))
}

/// Gives the site another plan: a GeoJSON feature collection (RFC 7946) in WGS84, 4 MiB and 200 000 points at most.
/// With `If-Match`, only if the plan is still the one that was seen.
#[utoipa::path(put, path = "/api/v1/plan", operation_id = "put_plan", tag = "fleet",
    params(("If-Match" = Option<String>, Header, description = "Tag of the plan that was seen")),
    request_body(content((Object = "application/geo+json"), (Object = "application/json"))),
    responses((status = NO_CONTENT, description = "It is the plan now",
            headers(("ETag" = String, description = "Of the new plan"))),
        (status = PRECONDITION_FAILED, description = "It was changed since", body = Problem,
            content_type = "application/problem+json"),
        (status = INSUFFICIENT_STORAGE, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn put(
    State(shared): State<Shared>,
    headers: HeaderMap,
    bytes: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let bytes = body(&headers, bytes, &[KIND, "application/json"])?;
    check(&bytes).map_err(|wrong| Problem::new(StatusCode::BAD_REQUEST, wrong))?;
    let _changing = shared.plan.changing.lock().await;
    must_match(&headers, &tag(&shared.plan.read().await?))?;
    let new = tag(&bytes);
    shared.plan.write(bytes).await?;
    let mut response = StatusCode::NO_CONTENT.into_response();
    if let Ok(new) = HeaderValue::from_str(&new) {
        response.headers_mut().insert(ETAG, new);
    }
    Ok(response)
}

/// Whether that is a plan; says what is wrong, and where.
fn check(bytes: &[u8]) -> Result<(), String> {
    let plan: Value = serde_json::from_slice(bytes).map_err(|error| format!("the body: {error}"))?;
    if plan["type"] != "FeatureCollection" {
        return Err("the plan must be an object with \"type\": \"FeatureCollection\"".to_owned());
    }
    if plan.get("crs").is_some() {
        return Err("crs: GeoJSON is WGS84, longitude first, and names no other system (RFC 7946)".to_owned());
    }
    let features = plan["features"].as_array().ok_or("features must be a list")?;
    let mut left = POSITIONS_MAX;
    for (index, feature) in features.iter().enumerate() {
        let wrong = |what: String| format!("features[{index}]{what}");
        if feature["type"] != "Feature" {
            return Err(wrong(" must be an object with \"type\": \"Feature\"".to_owned()));
        }
        if !feature.get("properties").is_some_and(|value| value.is_object() || value.is_null()) {
            return Err(wrong(".properties must be an object or null".to_owned()));
        }
        match feature.get("geometry") {
            Some(Value::Null) => {}
            Some(geometry) => {
                check_geometry(geometry, &mut left).map_err(|what| wrong(format!(".geometry{what}")))?
            }
            None => return Err(wrong(".geometry must be an object or null".to_owned())),
        }
    }
    Ok(())
}

fn check_geometry(geometry: &Value, left: &mut usize) -> Result<(), String> {
    let coordinates = &geometry["coordinates"];
    match geometry["type"].as_str() {
        Some("Point") => position(coordinates, left),
        Some("MultiPoint") => each(coordinates, 0, &mut |point| position(point, left)),
        Some("LineString") => line(coordinates, left),
        Some("MultiLineString") => each(coordinates, 0, &mut |points| line(points, left)),
        Some("Polygon") => polygon(coordinates, left),
        Some("MultiPolygon") => each(coordinates, 0, &mut |rings| polygon(rings, left)),
        Some("GeometryCollection") => {
            let geometries = geometry["geometries"].as_array().ok_or(".geometries must be a list")?;
            geometries.iter().try_for_each(|geometry| check_geometry(geometry, left))
        }
        _ => Err(".type must be a geometry of GeoJSON, such as \"Polygon\"".to_owned()),
    }
}

fn each(
    list: &Value,
    least: usize,
    check: &mut dyn FnMut(&Value) -> Result<(), String>,
) -> Result<(), String> {
    let items = list.as_array().filter(|items| items.len() >= least);
    let items = items.ok_or_else(|| format!(" must have lists of at least {least} coordinates"))?;
    items.iter().try_for_each(check)
}

fn line(points: &Value, left: &mut usize) -> Result<(), String> {
    each(points, 2, &mut |point| position(point, left))
}

fn polygon(rings: &Value, left: &mut usize) -> Result<(), String> {
    each(rings, 1, &mut |ring| {
        each(ring, 4, &mut |point| position(point, left))?;
        let ends = ring.as_array().map(|points| (points.first(), points.last()));
        let is_closed = ends.is_some_and(|(first, last)| first == last);
        if is_closed { Ok(()) } else { Err(" has a ring that does not end where it begins".to_owned()) }
    })
}

/// Longitude, latitude, and perhaps height.
fn position(point: &Value, left: &mut usize) -> Result<(), String> {
    let numbers = point.as_array().filter(|numbers| (2..=3).contains(&numbers.len()));
    let numbers: Option<Vec<f64>> = numbers.and_then(|numbers| numbers.iter().map(Value::as_f64).collect());
    match numbers.as_deref() {
        Some([longitude, latitude, ..]) if longitude.abs() <= 180.0 && latitude.abs() <= 90.0 => {}
        _ => {
            return Err(format!(
                " has {point:.80}, must be [longitude, latitude] in degrees, or with height"
            ));
        }
    }
    *left = left.checked_sub(1).ok_or_else(|| format!(": there are more than {POSITIONS_MAX} points"))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(geometry: &str) -> String {
        format!(
            r#"{{"type":"FeatureCollection","features":[{{"type":"Feature","properties":null,"geometry":{geometry}}}]}}"#
        )
    }

    #[test]
    fn every_kind_of_geometry_is_a_plan() {
        for geometry in [
            "null",
            r#"{"type":"Point","coordinates":[8.5,47.25]}"#,
            r#"{"type":"MultiPoint","coordinates":[[8.5,47.25,474.5]]}"#,
            r#"{"type":"LineString","coordinates":[[8.5,47.25],[-180,-90]]}"#,
            r#"{"type":"MultiLineString","coordinates":[]}"#,
            r#"{"type":"Polygon","coordinates":[[[0,0],[1,0],[1,1],[0,0]]]}"#,
            r#"{"type":"MultiPolygon","coordinates":[[[[0,0],[1,0],[1,1],[0,0]]]]}"#,
            r#"{"type":"GeometryCollection","geometries":[{"type":"Point","coordinates":[0,0]}]}"#,
        ] {
            assert_eq!(check(of(geometry).as_bytes()), Ok(()), "{geometry}");
        }
        assert_eq!(check(EMPTY), Ok(()));
    }

    #[test]
    fn what_is_no_plan_is_refused_with_its_place() {
        for (geometry, expected) in [
            (r#"{"type":"Point","coordinates":[47.25]}"#, "features[0].geometry has [47.25], must be"),
            (r#"{"type":"Point","coordinates":[8.5,97.25]}"#, "features[0].geometry has [8.5,97.25]"),
            (r#"{"type":"Point","coordinates":["8.5",47]}"#, "must be [longitude"),
            (r#"{"type":"Circle","coordinates":[8.5,47]}"#, "features[0].geometry.type must be"),
            (r#"{"type":"LineString","coordinates":[[8.5,47]]}"#, "at least 2"),
            (r#"{"type":"Polygon","coordinates":[[[0,0],[1,0],[0,0]]]}"#, "at least 4"),
            (
                r#"{"type":"Polygon","coordinates":[[[0,0],[1,0],[1,1],[0,1]]]}"#,
                "does not end where it begins",
            ),
            (r#"{"type":"GeometryCollection"}"#, "geometries must be a list"),
            ("7", "type must be"),
        ] {
            let wrong = check(of(geometry).as_bytes()).expect_err(geometry);
            assert!(wrong.contains(expected), "{wrong}");
        }
        for (text, expected) in [
            ("", "the body: EOF"),
            ("[]", "FeatureCollection"),
            (r#"{"type":"FeatureCollection"}"#, "features must be a list"),
            (r#"{"type":"FeatureCollection","features":[{}]}"#, "features[0] must be an object"),
            (r#"{"type":"FeatureCollection","features":[],"crs":{}}"#, "crs"),
            (
                r#"{"type":"FeatureCollection","features":[{"type":"Feature","geometry":null}]}"#,
                ".properties",
            ),
            (
                r#"{"type":"FeatureCollection","features":[{"type":"Feature","properties":{}}]}"#,
                ".geometry must",
            ),
        ] {
            let wrong = check(text.as_bytes()).expect_err(text);
            assert!(wrong.contains(expected), "{wrong}");
        }
        let many = vec!["[0,0]"; POSITIONS_MAX + 1].join(",");
        let wrong = check(of(&format!(r#"{{"type":"MultiPoint","coordinates":[{many}]}}"#)).as_bytes());
        assert!(wrong.expect_err("too many").contains("more than 200000 points"));
    }
}
