//! What stands before every handler: who may ask for what, and what every answer says.
//!
//! In this order: is it addressed to us; does that client ask too often; is there such a route; who asks, and does
//! its role reach; does the page it comes from have a say. A change that was made goes into the book of changes.

use std::net::SocketAddr;
use std::sync::Arc;

use axum::extract::{ConnectInfo, MatchedPath, Request, State};
use axum::http::header::{
    ACCESS_CONTROL_ALLOW_HEADERS, ACCESS_CONTROL_ALLOW_METHODS, ACCESS_CONTROL_ALLOW_ORIGIN,
    ACCESS_CONTROL_EXPOSE_HEADERS, ACCESS_CONTROL_MAX_AGE, ALLOW, CACHE_CONTROL, CONTENT_SECURITY_POLICY,
    HeaderName, ORIGIN, REFERRER_POLICY, STRICT_TRANSPORT_SECURITY, UPGRADE, VARY, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderValue, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::origin::{self, Origin};
use super::problem::{Problem, as_problem};
use super::routes::{Need, Needs};
use super::visitor::{People, Shown, Visitor};
use crate::accounts::{By, Change, Role};

/// Everything from ourselves, and nothing inline. Images also as data and blobs: the map makes some.
const POLICY: &str = "default-src 'self'; img-src 'self' data: blob:; worker-src 'self'; connect-src 'self'; \
                      object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'";

/// What the guard goes by.
#[derive(Clone)]
pub(super) struct Gate {
    pub people: Arc<People>,
    pub needs: Arc<Needs>,
}

/// Of an answer: what the book of changes says of it beside the path.
#[derive(Clone, Debug)]
pub(super) enum Note {
    /// What was changed, in words.
    Says(String),
    /// Who it was, where the request itself did not show it; and what happened.
    Of(String, &'static str),
    /// Nothing was changed.
    Nothing,
}

pub(super) async fn guard(State(gate): State<Gate>, mut request: Request, next: Next) -> Response {
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let listed = listed_origin(&gate.people, &request);
    let admitted = gate.admit(&request);
    let mut response = match admitted {
        Ok(Admitted::Preflight(allowed)) => preflight(&allowed),
        Ok(Admitted::Visitor(visitor)) => {
            request.extensions_mut().insert(visitor.clone());
            let response = as_problem(next.run(request).await).await;
            let note = response.extensions().get::<Note>().cloned();
            let status = response.status();
            gate.book(&visitor, &method, &path, status, note).await;
            response
        }
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
        (HeaderName::from_static("permissions-policy"), "camera=(), geolocation=(), microphone=()"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    if gate.people.http.https {
        headers.insert(STRICT_TRANSPORT_SECURITY, HeaderValue::from_static("max-age=31536000"));
    }
    if !gate.people.http.origins.is_empty() {
        headers.append(VARY, HeaderValue::from_static("Origin"));
    }
    if let Some(origin) = listed {
        headers.insert(ACCESS_CONTROL_ALLOW_ORIGIN, origin);
        let exposed = "Content-Disposition, Content-Range, ETag, Holdfast-Faults, Location, Retry-After, \
             WWW-Authenticate";
        headers.insert(ACCESS_CONTROL_EXPOSE_HEADERS, HeaderValue::from_static(exposed));
    }
    response
}

enum Admitted {
    Visitor(Visitor),
    /// A browser asks whether another origin's page may ask; the methods.
    Preflight(String),
}

impl Gate {
    fn admit(&self, request: &Request) -> Result<Admitted, Problem> {
        let (method, headers, uri) = (request.method(), request.headers(), request.uri());
        let people = &self.people;
        let peer = request.extensions().get::<ConnectInfo<SocketAddr>>();
        let Some(ConnectInfo(peer)) = peer else {
            return Err(Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "nobody knows who asks"));
        };
        let from = origin::client(&people.http, headers, peer.ip());
        let host = origin::host(&people.http, headers, uri).map_err(|host| misdirected(host))?;
        people.admit(&origin::bucket(from))?;

        let path = request.extensions().get::<MatchedPath>().map(MatchedPath::as_str);
        let page = origin::origin(&people.http, headers, host);
        let need = match path {
            // Files of the page are everybody's; what is nowhere is told to those who may look around.
            None if uri.path().starts_with("/api/") => Need::Least(Role::Viewer),
            None => Need::Nothing,
            Some(path) => match self.needs.of(path, method) {
                Some(need) => need,
                None => {
                    let allowed = self
                        .needs
                        .allowed(path)
                        .ok_or_else(|| Problem::new(StatusCode::FORBIDDEN, "nobody said who may use this"))?;
                    if method == Method::OPTIONS && page == Origin::Listed {
                        return Ok(Admitted::Preflight(allowed));
                    }
                    self.known(request, self.needs.least(path))?;
                    let detail = format!("{} does not answer {method}", uri.path());
                    let allow = HeaderValue::from_str(&allowed).unwrap_or(HeaderValue::from_static(""));
                    return Err(Problem::new(StatusCode::METHOD_NOT_ALLOWED, detail).with(ALLOW, allow));
                }
            },
        };
        let (known, role, shown) = self.known(request, need)?;
        let only_looks = method.is_safe() && !headers.contains_key(UPGRADE);
        let has_a_say = match page {
            Origin::Own => true,
            // A browser that sends a cookie also says for whom, when it asks for a change.
            Origin::Untold => shown != Shown::Cookie,
            Origin::Listed => matches!(shown, Shown::Token | Shown::Ticket),
            Origin::Foreign => false,
        };
        if !only_looks && !has_a_say {
            let detail =
                "WebSockets and changes are for this server's own pages, and for programs with a token";
            return Err(Problem::new(StatusCode::FORBIDDEN, detail));
        }
        Ok(Admitted::Visitor(Visitor { known, role, from }))
    }

    /// Who asks, if that is somebody who may.
    fn known(
        &self,
        request: &Request,
        need: Need,
    ) -> Result<(Option<crate::accounts::Known>, Option<Role>, Shown), Problem> {
        let Need::Least(least) = need else { return Ok((None, None, Shown::Nothing)) };
        let found = self.people.recognize(request.headers(), request.uri())?;
        let Some((known, role, shown)) = found else {
            return Err(Problem::unauthorized("sign in first, or show a token"));
        };
        if role < least {
            let detail = format!("this is for the role {}, you have {}", least.name(), role.name());
            return Err(Problem::new(StatusCode::FORBIDDEN, detail));
        }
        Ok((known, Some(role), shown))
    }

    /// Writes down what was changed. An answer that says so waits until it stands in the book.
    async fn book(
        &self,
        visitor: &Visitor,
        method: &Method,
        path: &str,
        status: StatusCode,
        note: Option<Note>,
    ) {
        let failed_with_note = matches!(note, Some(Note::Of(..)));
        if method.is_safe() || !(status.is_success() || failed_with_note) {
            return;
        }
        let mut what = format!("{method} {}", path.chars().take(200).collect::<String>());
        let (mut who, via) = match &visitor.known {
            None => (String::new(), "nobody"),
            Some(known) => {
                let via = if matches!(known.by, By::SignIn(_)) { "sign_in" } else { "token" };
                (known.name.clone(), via)
            }
        };
        let mut outcome = status.as_u16().to_string();
        match note {
            Some(Note::Nothing) => return,
            Some(Note::Says(says)) => what = format!("{what}: {says}"),
            Some(Note::Of(name, came)) => {
                who = name;
                outcome = came.to_owned();
            }
            None => {}
        }
        let change = Change {
            time: self.people.now(),
            who,
            via: via.to_owned(),
            from: visitor.from.to_string(),
            what,
            outcome,
        };
        let people = Arc::clone(&self.people);
        let noted = tokio::task::spawn_blocking(move || {
            if let Err(error) = people.accounts.note(&change) {
                tracing::error!(
                    "a change by \"{}\" cannot be written down: {}: {error}",
                    change.who,
                    change.what
                );
            }
        });
        // An error says that the server ends.
        let _ = noted.await;
    }
}

fn misdirected(host: Option<&str>) -> Problem {
    let Some(host) = host else { return Problem::new(StatusCode::BAD_REQUEST, "the request has no Host") };
    let host: String = host.chars().take(80).collect();
    let detail = format!(
        "this server does not answer to \"{host}\": use its address, or add the name to http.names in the site file"
    );
    Problem::new(StatusCode::MISDIRECTED_REQUEST, detail)
}

fn listed_origin(people: &People, request: &Request) -> Option<HeaderValue> {
    let origin = request.headers().get(ORIGIN)?;
    people.http.origins.iter().any(|listed| origin == listed.as_str()).then(|| origin.clone())
}

fn preflight(allowed: &str) -> Response {
    let mut response = StatusCode::NO_CONTENT.into_response();
    let headers = response.headers_mut();
    if let Ok(allowed) = HeaderValue::from_str(allowed) {
        headers.insert(ACCESS_CONTROL_ALLOW_METHODS, allowed);
    }
    let names = "Authorization, Content-Type, If-Match, If-None-Match, If-Range, Range";
    headers.insert(ACCESS_CONTROL_ALLOW_HEADERS, HeaderValue::from_static(names));
    headers.insert(ACCESS_CONTROL_MAX_AGE, HeaderValue::from_static("600"));
    response
}
