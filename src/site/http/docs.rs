//! The document of the API, and a page on which to browse it: Swagger UI out of the binary.

use std::sync::{Arc, OnceLock};

use axum::Extension;
use axum::extract::Path;
use axum::extract::rejection::PathRejection;
use axum::http::header::LOCATION;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use utoipa_swagger_ui::Config;

use super::input::{malformed, tagged};
use super::problem::Problem;

/// The document as it is served.
#[derive(Clone)]
pub(super) struct Document(pub Arc<str>);

/// This document.
#[utoipa::path(get, path = "/api/openapi.json", tag = "operation",
    params(("If-None-Match" = Option<String>, Header, description = "Tags that the client has")),
    responses((status = OK, description = "OpenAPI 3.1", body = serde_json::Value,
            headers(("ETag" = String, description = "Changes with the document"))),
        (status = NOT_MODIFIED, description = "The client has it")))]
pub(super) async fn openapi(Extension(Document(text)): Extension<Document>, headers: HeaderMap) -> Response {
    tagged(&headers, "application/json", text.to_string())
}

/// Where the page is: its files are named from there.
pub(super) async fn begin() -> Response {
    (StatusCode::PERMANENT_REDIRECT, [(LOCATION, "/api/docs/")]).into_response()
}

pub(super) async fn index(headers: HeaderMap) -> Result<Response, Problem> {
    file(&headers, "index.html")
}

pub(super) async fn asset(
    path: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path(path) = path.map_err(malformed)?;
    file(&headers, &path)
}

fn file(headers: &HeaderMap, path: &str) -> Result<Response, Problem> {
    static CONFIG: OnceLock<Arc<Config<'static>>> = OnceLock::new();
    let config = CONFIG.get_or_init(|| {
        // The validator would be somebody else's server.
        let config = Config::new(["/api/openapi.json"]).validator_url("none").display_request_duration(true);
        Arc::new(config.try_it_out_enabled(false).use_base_layout())
    });
    let served = utoipa_swagger_ui::serve(path, Arc::clone(config)).map_err(|error| {
        tracing::error!("the page of the API's document: {error}");
        Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the page cannot be put together")
    })?;
    let served = served.ok_or_else(|| Problem::not_found("page or resource", path))?;
    let kind = match path.rsplit_once('.').map_or("", |(_, extension)| extension) {
        "html" => "text/html; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "js" => "text/javascript; charset=utf-8",
        "png" => "image/png",
        _ => "application/octet-stream",
    };
    Ok(tagged(headers, kind, served.bytes.into_owned()))
}
