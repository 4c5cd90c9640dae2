//! What stands before every handler: who may ask, and what every answer says.
//!
//! There are no accounts yet, so the server is bound to loopback. A page from elsewhere can still reach it
//! through the visitor's browser: by a name that resolves to 127.0.0.1 (DNS rebinding), which the check of
//! `Host` stops, or by a WebSocket or a form, which browsers let pass between sites, and the check of `Origin`
//! stops.

use std::net::IpAddr;

use axum::extract::Request;
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, HOST, HeaderName, ORIGIN, REFERRER_POLICY, UPGRADE,
    X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::problem::Problem;

/// Everything from ourselves, and nothing inline. Images also as data and blobs: the map makes some.
const POLICY: &str = "default-src 'self'; img-src 'self' data: blob:; worker-src 'self'; connect-src 'self'; \
                      object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'";

pub(super) async fn guard(request: Request, next: Next) -> Response {
    let mut response = match admit(request.method(), request.headers(), request.uri()) {
        Ok(()) => next.run(request).await,
        Err(problem) => problem.into_response(),
    };
    let headers = response.headers_mut();
    headers.entry(CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    for (name, value) in [
        (CONTENT_SECURITY_POLICY, POLICY),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

fn admit(method: &Method, headers: &HeaderMap, uri: &Uri) -> Result<(), Problem> {
    let text = |name: HeaderName| headers.get(name).map(|value| value.to_str().unwrap_or(""));
    let host = uri.authority().map(axum::http::uri::Authority::as_str).or_else(|| text(HOST));
    let Some(host) = host else {
        return Err(Problem::new(StatusCode::BAD_REQUEST, "the request has no Host"));
    };
    if !is_loopback(host) {
        return Err(Problem::new(
            StatusCode::MISDIRECTED_REQUEST,
            "this server answers to localhost and loopback addresses only",
        ));
    }
    let only_looks = method.is_safe() && !headers.contains_key(UPGRADE);
    let Some(origin) = text(ORIGIN).filter(|_| !only_looks) else { return Ok(()) };
    let of_this_page = origin.split_once("://").is_some_and(|(_, authority)| authority == host);
    if !of_this_page {
        let detail = "WebSockets and changes are for this server's own pages only";
        return Err(Problem::new(StatusCode::FORBIDDEN, detail));
    }
    Ok(())
}

/// Whether a `host` or `host:port` is this computer by its own account, whatever DNS says.
fn is_loopback(host: &str) -> bool {
    let without_port = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    };
    if without_port.eq_ignore_ascii_case("localhost") {
        return true;
    }
    let address = without_port.trim_start_matches('[').trim_end_matches(']');
    address.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_no_dns_can_turn_are_loopback() {
        for host in
            ["localhost", "LOCALHOST:8080", "127.0.0.1", "127.0.0.1:80", "127.9.9.9", "[::1]:8080", "[::1]"]
        {
            assert!(is_loopback(host), "{host}");
        }
        for host in [
            "",
            "evil.example",
            "localhost.evil.example:80",
            "127.0.0.1.evil.example",
            "192.168.0.1:8080",
            "0.0.0.0",
        ] {
            assert!(!is_loopback(host), "{host}");
        }
    }

    #[test]
    fn websocket_or_change_of_another_origin_is_refused() {
        let admitted = |method: Method, upgrade: bool, origin: &'static str| {
            let headers = [("host", "127.0.0.1:8080"), ("origin", origin), ("upgrade", "websocket")];
            let headers = headers.into_iter().take(if upgrade { 3 } else { 2 });
            let headers =
                headers.map(|(name, value)| (HeaderName::from_static(name), HeaderValue::from_static(value)));
            let uri = Uri::from_static("/api/v1/live");
            admit(&method, &HeaderMap::from_iter(headers), &uri).is_ok()
        };
        let own = "http://127.0.0.1:8080";
        assert!(admitted(Method::GET, true, own) && admitted(Method::POST, false, own));
        for origin in ["http://evil.example", "null", "http://127.0.0.1:9090", "http://localhost:8080", ""] {
            assert!(!admitted(Method::GET, true, origin), "{origin}");
            assert!(!admitted(Method::POST, false, origin), "{origin}");
            assert!(!admitted(Method::PATCH, false, origin), "{origin}");
            assert!(admitted(Method::GET, false, origin), "{origin}");
        }
    }
}
