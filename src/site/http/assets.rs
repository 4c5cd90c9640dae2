//! The page, out of the binary; and what is nowhere.

use axum::http::header::{ALLOW, CACHE_CONTROL, CONTENT_TYPE, ETAG};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use rust_embed::Embed;

use super::input::is_known;
use super::problem::Problem;

/// Built from `web/` by the build script.
#[derive(Embed)]
#[folder = "$OUT_DIR/web"]
struct Page;

/// Answers for every path that no handler has.
pub(super) async fn serve(method: Method, uri: Uri, headers: HeaderMap) -> Response {
    let path = uri.path().trim_start_matches('/');
    let path = if path.is_empty() || is_view(path) { "index.html" } else { path };
    let Some(file) = Page::get(path) else {
        return Problem::not_found("page or resource", uri.path()).into_response();
    };
    if method != Method::GET && method != Method::HEAD {
        let detail = format!("{} does not answer {method}", uri.path());
        let problem = Problem::new(StatusCode::METHOD_NOT_ALLOWED, detail);
        return problem.with(ALLOW, HeaderValue::from_static("GET, HEAD")).into_response();
    }
    let hash = file.metadata.sha256_hash();
    let tag: String = hash[..16].iter().map(|byte| format!("{byte:02x}")).collect();
    let tag = format!("\"{tag}\"");
    // Vite puts a hash of the content into the names under assets/: what has such a name never changes.
    let caching = match path.starts_with("assets/") {
        true => "public, max-age=31536000, immutable",
        false => "no-cache",
    };
    let mut response = match is_known(&headers, &tag) {
        true => StatusCode::NOT_MODIFIED.into_response(),
        false => (StatusCode::OK, file.data.into_owned()).into_response(),
    };
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(content_type(path)));
    headers.insert(CACHE_CONTROL, HeaderValue::from_static(caching));
    if let Ok(tag) = HeaderValue::from_str(&tag) {
        headers.insert(ETAG, tag);
    }
    response
}

/// Whether the page has a view at this path: then it is the page that is asked for, and the page that knows which.
fn is_view(path: &str) -> bool {
    let (view, rest) = path.split_once('/').unwrap_or((path, ""));
    match view {
        "alerts" | "account" | "sign-in" => rest.is_empty(),
        // Names of machines and sessions have no dots and no slashes; those of outages are put together with dots.
        "machines" | "sessions" => !rest.contains(['/', '.']),
        "outages" => !rest.contains('/'),
        _ => false,
    }
}

fn content_type(path: &str) -> &'static str {
    match path.rsplit_once('.').map_or("", |(_, extension)| extension) {
        "html" => "text/html; charset=utf-8",
        "js" | "mjs" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "json" | "map" => "application/json",
        "webmanifest" => "application/manifest+json",
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "ico" => "image/x-icon",
        "webp" => "image/webp",
        "woff2" => "font/woff2",
        "txt" => "text/plain; charset=utf-8",
        "wasm" => "application/wasm",
        _ => "application/octet-stream",
    }
}
