//! The routes and the guard as a whole.

use std::net::SocketAddr;
use std::sync::Arc;

use axum::routing::{get, post};
use axum::{Router, middleware};
use serde_json::Value;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};

use super::guard::{Gate, guard};
use super::routes;
use super::routes::Need;
use super::visitor::People;
use crate::accounts::{Accounts, Role};
use crate::config;
use crate::site::clock::SiteClock;

/// Errors that are told in another form.
const NO_PROBLEMS: [(&str, &str); 1] = [("/readyz", "503")];
const METHODS: [&str; 8] = ["get", "put", "post", "delete", "options", "head", "patch", "trace"];

/// Path, method and operation of everything in the document.
fn operations(document: &Value) -> Vec<(String, String, Value)> {
    let paths = document["paths"].as_object().expect("paths");
    let operations = paths.iter().flat_map(|(path, item)| {
        METHODS.into_iter().filter_map(move |method| {
            let operation = item.get(method)?.clone();
            Some((path.clone(), method.to_uppercase(), operation))
        })
    });
    operations.collect()
}

#[test]
fn every_route_states_its_least_role_and_documents_it() {
    let (_, needs, document) = routes().finish();
    let document: Value = serde_json::to_value(&document).expect("JSON");
    let operations = operations(&document);
    assert!(operations.len() > 20, "{}", operations.len());
    let mut open = Vec::new();
    for (path, method, operation) in &operations {
        let need = needs.of(path, &method.parse().expect("a method"));
        let security = operation["security"].as_array().unwrap_or_else(|| panic!("{method} {path}"));
        match need.unwrap_or_else(|| panic!("{method} {path} states no role")) {
            Need::Nothing => {
                assert!(security.is_empty(), "{method} {path}");
                open.push(path.as_str());
            }
            Need::Least(role) => {
                assert_eq!(security.len(), 2, "{method} {path}");
                for (scheme, requirement) in ["session", "token"].into_iter().zip(security) {
                    assert_eq!(requirement[scheme], serde_json::json!([role.name()]), "{method} {path}");
                    assert!(document["components"]["securitySchemes"][scheme].is_object());
                }
                let changes = !["GET", "HEAD"].contains(&method.as_str());
                assert!(!changes || operation["responses"].get("403").is_some(), "{method} {path}");
            }
        }
    }
    assert_eq!(open, ["/api/v1/sign-in", "/healthz", "/readyz"], "everybody may use");
    // What is not in the document are pages for people.
    let pages = ["/api/docs", "/api/docs/", "/api/docs/{file}"];
    assert_eq!(needs.paths().filter(|path| document["paths"].get(path).is_none()).collect::<Vec<_>>(), pages);
}

#[test]
fn every_error_of_the_document_is_a_problem_and_every_reference_leads_somewhere() {
    let (_, _, document) = routes().finish();
    let document: Value = serde_json::to_value(&document).expect("JSON");
    let mut ids = std::collections::BTreeSet::new();
    for (path, method, operation) in operations(&document) {
        let id = operation["operationId"].as_str().expect("an id").to_owned();
        assert!(ids.insert(id), "{method} {path}: generated clients name their functions by it");
        assert!(operation["summary"].is_string(), "{method} {path}");
        for (status, response) in operation["responses"].as_object().expect("responses") {
            let target = response["$ref"].as_str().map(|reference| {
                document.pointer(reference.trim_start_matches('#')).expect("a response of that name")
            });
            let content = target.unwrap_or(response)["content"].as_object();
            let kinds: Vec<&String> = content.into_iter().flat_map(|content| content.keys()).collect();
            let is_error = status.starts_with(['4', '5']);
            let is_exception = NO_PROBLEMS.contains(&(path.as_str(), status.as_str()));
            assert!(
                !is_error || is_exception || kinds == ["application/problem+json"],
                "{method} {path} {status}: {kinds:?}"
            );
        }
    }
}

#[test]
fn the_page_s_types_are_made_of_the_document_that_is_served() {
    let (_, _, document) = routes().finish();
    let served: Value = serde_json::to_value(&document).expect("JSON");
    let saved: Value = serde_json::from_str(include_str!("../../../web/openapi.json")).expect("JSON");
    assert!(served == saved, "save the server's /api/openapi.json as web/openapi.json, then: npm run types");
}

/// Serves a router behind the guard; returns the status and the text of one answer.
async fn answer(address: SocketAddr, request: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).await.expect("connects");
    let head =
        format!("{request} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n");
    stream.write_all(head.as_bytes()).await.expect("sent");
    let mut text = String::new();
    stream.read_to_string(&mut text).await.expect("read");
    (text.split(' ').nth(1).and_then(|status| status.parse().ok()).expect("a status"), text)
}

#[tokio::test]
async fn route_that_nobody_stated_a_role_for_is_refused_also_where_nobody_is_asked() {
    let folder = std::env::temp_dir().join(format!("holdfast-guard-{}", std::process::id()));
    let accounts = Accounts::of(&folder).expect("none");
    let people = People::new(accounts, config::Http::default(), SiteClock::start());
    let (_, needs, _) = routes().finish();
    assert_eq!(needs.of("/api/v1/fleet", &axum::http::Method::GET), Some(Need::Least(Role::Viewer)));
    let gate = Gate { people: Arc::new(people), needs: Arc::new(needs) };
    let app = Router::new()
        .route("/api/v1/fleet", get(async || "the fleet").post(async || "another fleet"))
        .route("/api/v1/forgotten", post(async || "a secret"))
        .route("/forgotten", get(async || "a secret"))
        .layer(middleware::from_fn_with_state(gate, guard));
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("binds");
    let address = listener.local_addr().expect("address");
    let app = app.into_make_service_with_connect_info::<SocketAddr>();
    let server = tokio::spawn(async move { axum::serve(listener, app).await });
    assert_eq!(answer(address, "GET /api/v1/fleet").await.0, 200);
    for (request, status) in [
        ("POST /api/v1/fleet", 405),
        ("POST /api/v1/forgotten", 403),
        ("GET /forgotten", 403),
        ("GET /api/x", 404),
    ] {
        let (found, text) = answer(address, request).await;
        assert_eq!(found, status, "{request}: {text}");
        assert!(!text.contains("secret") && !text.contains("another"), "{text}");
        assert!(text.contains("application/problem+json"), "{request}: {text}");
    }
    server.abort();
}
