//! Who gets in: accounts made on the command line, a site that asks for them, and what others' pages cannot do.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play people, who have clocks")]

#[path = "support/site.rs"]
mod support;

use std::io::Write as _;
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Command, Stdio};

use futures_util::StreamExt as _;
use holdfast::site::{Site, SiteError};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::{Error, Message};

use support::{Answer, Folder, Machine, PATIENCE, exchange, exchange_body, get};

const PASSWORD: &str = "correct horse battery";

/// `holdfast site ...` on the accounts in a folder; returns what it printed.
fn accounts(data: &Path, arguments: &[&str], stdin: &str) -> Result<String, String> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_holdfast"));
    command.arg("site").args(arguments).arg("--data").arg(data);
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut process = command.spawn().expect("starts");
    let _ = process.stdin.take().expect("piped").write_all(stdin.as_bytes());
    let output = process.wait_with_output().expect("ends");
    let text = |bytes| String::from_utf8(bytes).expect("text");
    if output.status.success() { Ok(text(output.stdout)) } else { Err(text(output.stderr)) }
}

fn add(data: &Path, name: &str, role: &str) {
    accounts(data, &["user", "add", name, "--role", role, "--password-stdin"], PASSWORD).expect("added");
}

async fn send(site: SocketAddr, method: &str, path: &str, headers: &[(&str, &str)], body: &Value) -> Answer {
    let json = [("Content-Type", "application/json")];
    let headers: Vec<(&str, &str)> = json.iter().chain(headers).copied().collect();
    exchange_body(site, method, path, &headers, &body.to_string()).await
}

async fn sign_in(site: SocketAddr, name: &str, password: &str) -> Answer {
    send(site, "POST", "/api/v1/sign-in", &[], &json!({"name": name, "password": password})).await
}

/// The cookie of an answer, as the browser sends it back.
fn cookie(answer: &Answer) -> String {
    assert_eq!(answer.status, 200, "{}", String::from_utf8_lossy(&answer.body));
    let cookie = answer.header("set-cookie");
    for part in ["HttpOnly", "SameSite=Strict", "Path=/"] {
        assert!(cookie.contains(part), "{cookie}");
    }
    cookie.split(';').next().expect("a cookie").to_owned()
}

async fn status(site: SocketAddr, path: &str, headers: &[(&str, &str)]) -> u16 {
    exchange(site, "GET", path, headers).await.status
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn address_that_others_reach_is_served_only_with_accounts_and_asks_for_them() {
    let folder = Folder::new("accounts-lan");
    let mut config = folder.config();
    config.http.listen = "0.0.0.0:0".parse().expect("an address");
    let refused = Site::start(&config).await.err().expect("nobody could be asked");
    let message = refused.to_string();
    assert!(matches!(refused, SiteError::Refused(_)), "{message}");
    assert!(message.contains("holdfast site user add") && message.contains("--data"), "{message}");
    add(&folder.0, "anna", "admin");
    let site = Site::start(&config).await.expect("starts");
    let address = SocketAddr::from(([127, 0, 0, 1], site.address().port()));
    for (path, expected) in [
        ("/healthz", 200),
        ("/readyz", 200),
        ("/", 200),
        ("/api/docs/", 200),
        ("/nothing", 404),
        ("/api/v1/fleet", 401),
        ("/api/v1/me", 401),
        ("/api/v1/nothing", 401),
        ("/api/openapi.json", 401),
        ("/metrics", 401),
    ] {
        assert_eq!(status(address, path, &[]).await, expected, "{path}");
    }
    assert_eq!(status(address, "/api/v1/fleet", &[("Host", "site.example")]).await, 421);
    assert_eq!(status(address, "/healthz", &[("Host", "192.168.7.7:80")]).await, 200);
    let cookie = cookie(&sign_in(address, "ANNA", PASSWORD).await);
    assert_eq!(status(address, "/api/v1/fleet", &[("Cookie", &cookie)]).await, 200);
    // The last account goes: nobody gets in, rather than everybody.
    accounts(&folder.0, &["user", "remove", "anna"], "").expect("removed");
    assert_eq!(status(address, "/api/v1/fleet", &[]).await, 401);
    assert_eq!(status(address, "/api/v1/fleet", &[("Cookie", &cookie)]).await, 401);
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn running_site_sees_what_the_command_line_does() {
    let folder = Folder::new("accounts-live");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    let me = get(address, "/api/v1/me").await.json();
    assert_eq!((&me["accounts"], &me["role"], &me["name"]), (&false.into(), &"admin".into(), &Value::Null));
    // Who reaches the server first must not be able to lock the others out.
    let first = json!({"name": "eve", "role": "admin", "password": PASSWORD});
    assert_eq!(send(address, "POST", "/api/v1/users", &[], &first).await.status, 409);
    assert_eq!(status(address, "/api/v1/fleet", &[]).await, 200);

    add(&folder.0, "anna", "operator");
    assert_eq!(status(address, "/api/v1/fleet", &[]).await, 401);
    assert_eq!(sign_in(address, "anna", "correct horse batterz").await.status, 401);
    assert_eq!(sign_in(address, "nobody", PASSWORD).await.status, 401);
    let cookie = cookie(&sign_in(address, "anna", PASSWORD).await);
    let with_cookie = [("Cookie", cookie.as_str())];
    let me = exchange(address, "GET", "/api/v1/me", &with_cookie).await.json();
    assert_eq!((&me["name"], &me["role"]), (&"anna".into(), &"operator".into()));
    assert_eq!(status(address, "/api/v1/users", &with_cookie).await, 403);
    accounts(&folder.0, &["user", "role", "anna", "admin"], "").expect("set");
    assert_eq!(status(address, "/api/v1/users", &with_cookie).await, 200);
    assert_eq!(accounts(&folder.0, &["user", "list"], "").expect("listed"), "anna\tadmin\n");

    let token = accounts(&folder.0, &["token", "add", "for tests", "--user", "anna"], "").expect("added");
    let bearer = format!("Bearer {}", token.trim());
    assert!(token.starts_with("hf_"), "the secret is all that stdout has");
    let with_token = [("Authorization", bearer.as_str())];
    assert_eq!(status(address, "/api/v1/fleet", &with_token).await, 200);
    assert_eq!(status(address, "/api/v1/users", &with_token).await, 403, "a viewer's");
    let listed = accounts(&folder.0, &["token", "list"], "").expect("listed");
    let id = listed.split('\t').next().expect("an id");
    assert!(!listed.contains(token.trim()), "{listed}");
    accounts(&folder.0, &["token", "revoke", id], "").expect("revoked");
    let revoked = exchange(address, "GET", "/api/v1/fleet", &with_token).await;
    assert_eq!((revoked.status, revoked.header("www-authenticate").starts_with("Bearer")), (401, true));

    accounts(&folder.0, &["user", "password", "anna", "--password-stdin"], "another password\n")
        .expect("set");
    assert_eq!(status(address, "/api/v1/fleet", &with_cookie).await, 401);
    assert_eq!(sign_in(address, "anna", "another password").await.status, 200);
    accounts(&folder.0, &["user", "remove", "anna"], "").expect("removed");
    assert_eq!(
        status(address, "/api/v1/fleet", &[]).await,
        200,
        "only this computer reaches it: as at first"
    );

    for (arguments, stdin, says) in [
        (&["user", "add", "bert", "--password-stdin"][..], "short", "10 to 200 characters"),
        (&["user", "add", "bert"], "", "--password-stdin"),
        (&["user", "add", "b/c", "--password-stdin"], PASSWORD, "letters"),
        (&["user", "add", "bert", "--role", "chief"], "", "viewer, operator or admin"),
        (&["user", "remove", "bert"], "", "there is no account \"bert\""),
        (&["token", "add", "x", "--user", "bert"], "", "there is no account \"bert\""),
        (&["token", "revoke", "x"], "", "there is no token"),
    ] {
        let refused = accounts(&folder.0, arguments, stdin).expect_err("refused");
        assert!(refused.contains(says), "{arguments:?}: {refused}");
    }
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pages_of_others_change_nothing_with_a_visitor_s_cookie() {
    let folder = Folder::new("accounts-origin");
    add(&folder.0, "anna", "admin");
    let mut config = folder.config();
    config.http.origins = vec!["https://portal.example".to_owned()];
    let site = Site::start(&config).await.expect("starts");
    let address = site.address();
    let cookie = cookie(&sign_in(address, "anna", PASSWORD).await);
    let token = accounts(&folder.0, &["token", "add", "x", "--user", "anna", "--role", "admin"], "");
    let bearer = format!("Bearer {}", token.expect("added").trim());
    let own = format!("http://{address}");
    let (by_cookie, by_token) = (("Cookie", cookie.as_str()), ("Authorization", bearer.as_str()));
    for (headers, expected) in [
        (&[by_cookie][..], 403),
        (&[by_cookie, ("Origin", "http://evil.example")], 403),
        (&[by_cookie, ("Origin", "null")], 403),
        (&[by_cookie, ("Origin", "https://portal.example")], 403),
        (&[by_cookie, ("Sec-Fetch-Site", "cross-site")], 403),
        (&[by_cookie, ("Sec-Fetch-Site", "same-site")], 403),
        (&[by_token, ("Origin", "http://evil.example")], 403),
        (&[by_cookie, ("Origin", &own)], 201),
        (&[by_cookie, ("Sec-Fetch-Site", "same-origin")], 201),
        (&[by_token], 201),
        (&[by_token, ("Origin", "https://portal.example")], 201),
    ] {
        let answer = exchange(address, "POST", "/api/v1/live-ticket", headers).await;
        assert_eq!(answer.status, expected, "{headers:?}");
    }
    let read = [by_token, ("Origin", "https://portal.example")];
    let read = exchange(address, "GET", "/api/v1/fleet", &read).await;
    assert_eq!(read.header("access-control-allow-origin"), "https://portal.example");
    assert_eq!(read.header("access-control-allow-credentials"), "");
    let asked = [("Origin", "https://portal.example"), ("Access-Control-Request-Method", "PATCH")];
    let preflight = exchange(address, "OPTIONS", "/api/v1/users/anna", &asked).await;
    assert_eq!((preflight.status, preflight.header("access-control-allow-methods")), (204, "DELETE, PATCH"));
    let others = [by_cookie, ("Origin", "http://evil.example")];
    let others = exchange(address, "GET", "/api/v1/fleet", &others).await;
    assert_eq!(others.header("access-control-allow-origin"), "", "no page elsewhere can read it");
    let (body, foreign) =
        (json!({"name": "anna", "password": PASSWORD}), [("Origin", "http://evil.example")]);
    let foreign = send(address, "POST", "/api/v1/sign-in", &foreign, &body);
    assert_eq!(foreign.await.status, 403, "nobody is signed in by another page");

    // Signed out: the cookie is worth nothing any more.
    let gone = exchange(address, "POST", "/api/v1/sign-out", &[by_cookie, ("Origin", &own)]).await;
    assert!(gone.status == 204 && gone.header("set-cookie").contains("Max-Age=0"));
    assert_eq!(status(address, "/api/v1/fleet", &[by_cookie]).await, 401);
    site.stop().await;
}

/// Opens the WebSocket; the status if it is refused.
async fn live(
    site: SocketAddr,
    query: &str,
    headers: &[(&'static str, &str)],
) -> Result<impl futures_util::Stream<Item = Result<Message, Error>> + use<>, u16> {
    let mut request = format!("ws://{site}/api/v1/live{query}").into_client_request().expect("a request");
    for (name, value) in headers {
        request.headers_mut().insert(*name, value.parse().expect("a value"));
    }
    match tokio_tungstenite::connect_async(request).await {
        Ok((socket, _)) => Ok(socket),
        Err(Error::Http(response)) => Err(response.status().as_u16()),
        Err(error) => panic!("{error}"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn live_socket_opens_by_cookie_token_or_one_use_ticket_and_closes_with_the_account() {
    let folder = Folder::new("accounts-socket");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    let mut unasked = live(address, "", &[]).await.expect("there are no accounts");
    unasked.next().await.expect("open").expect("a snapshot");
    add(&folder.0, "anna", "viewer");
    let cookie = cookie(&sign_in(address, "anna", PASSWORD).await);
    let own = format!("http://{address}");
    assert_eq!(live(address, "", &[]).await.err(), Some(401));
    assert_eq!(live(address, "", &[("cookie", &cookie)]).await.err(), Some(403), "no origin");
    let foreign = [("cookie", cookie.as_str()), ("origin", "http://evil.example")];
    assert_eq!(live(address, "", &foreign).await.err(), Some(403));
    let good = [("cookie", cookie.as_str()), ("origin", own.as_str())];
    let mut by_cookie = live(address, "", &good).await.expect("opens");
    let ticket = exchange(address, "POST", "/api/v1/live-ticket", &good).await;
    assert_eq!(ticket.status, 201);
    let query = format!("?ticket={}", ticket.json()["ticket"].as_str().expect("a ticket"));
    for path in ["/api/v1/fleet", "/api/v1/tokens", "/api/v1/outages"] {
        for headers in [&[][..], &[("upgrade", "websocket"), ("connection", "upgrade")]] {
            let asked = status(address, &format!("{path}{query}"), headers).await;
            assert_eq!(asked, 401, "a ticket is for WebSockets only: {path} {headers:?}");
        }
    }
    assert!(live(address, &query, &[]).await.is_ok());
    assert_eq!(live(address, &query, &[]).await.err(), Some(401), "once");
    assert_eq!(live(address, "?ticket=0", &[]).await.err(), Some(401));

    let closed =
        async |socket: &mut (dyn futures_util::Stream<Item = Result<Message, Error>> + Unpin + Send)| {
            let until = async {
                while let Some(Ok(message)) = socket.next().await {
                    if let Message::Close(Some(frame)) = message {
                        return u16::from(frame.code);
                    }
                }
                0
            };
            tokio::time::timeout(PATIENCE, until).await.expect("in time")
        };
    assert_eq!(closed(&mut unasked).await, 1008, "opened before anybody was asked");
    accounts(&folder.0, &["user", "remove", "anna"], "").expect("removed");
    assert_eq!(closed(&mut by_cookie).await, 1008);
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn guessing_passwords_is_slow_for_a_name_and_the_others_are_not_locked_out() {
    let folder = Folder::new("accounts-guess");
    add(&folder.0, "anna", "viewer");
    add(&folder.0, "bert", "viewer");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    for _ in 0..10 {
        assert_eq!(sign_in(address, "anna", "wrong password").await.status, 401);
    }
    for password in ["wrong password", PASSWORD] {
        let slow = sign_in(address, "Anna", password).await;
        assert_eq!(slow.status, 429, "right or wrong");
        let after_s: u32 = slow.header("retry-after").parse().expect("seconds");
        assert!((1..=30).contains(&after_s), "{after_s}");
    }
    assert_eq!(sign_in(address, "bert", PASSWORD).await.status, 200);
    // The same for names that are none: nothing tells which are.
    for _ in 0..10 {
        assert_eq!(sign_in(address, "carl", "wrong password").await.status, 401);
    }
    assert_eq!(sign_in(address, "carl", "wrong password").await.status, 429);
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn client_that_asks_too_often_is_told_to_wait() {
    let folder = Folder::new("accounts-often");
    let mut config = folder.config();
    config.http.requests_per_s = 1.0;
    let site = Site::start(&config).await.expect("starts");
    for _ in 0..10 {
        assert_eq!(get(site.address(), "/healthz").await.status, 200);
    }
    let refused = get(site.address(), "/healthz").await;
    assert_eq!((refused.status, refused.header("retry-after")), (429, "1"));
    tokio::time::sleep(std::time::Duration::from_millis(1100)).await;
    assert_eq!(get(site.address(), "/healthz").await.status, 200);
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn changes_stand_in_the_book_with_who_when_what_and_from_where() {
    let folder = Folder::new("accounts-book");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    let stopped = get(address, "/api/v1/sessions").await.json()["recording"]["session"].clone();
    if let Some(session) = stopped.as_str() {
        exchange(address, "POST", &format!("/api/v1/sessions/{session}/stop"), &[]).await;
    }
    assert_eq!(
        send(address, "PUT", "/api/v1/plan", &[], &json!({"type": "FeatureCollection", "features": []}))
            .await
            .status,
        204
    );
    add(&folder.0, "anna", "admin");
    assert_eq!(sign_in(address, "anna", "wrong password").await.status, 401);
    assert_eq!(sign_in(address, PASSWORD, PASSWORD).await.status, 401, "in the wrong field");
    let cookie = cookie(&sign_in(address, "anna", PASSWORD).await);
    let own = format!("http://{address}");
    let by_cookie = [("Cookie", cookie.as_str()), ("Origin", own.as_str())];
    let bert = json!({"name": "bert", "role": "operator", "password": "another password"});
    let made = send(address, "POST", "/api/v1/users", &by_cookie, &bert).await;
    assert_eq!((made.status, made.header("location")), (201, "/api/v1/users/bert"));
    let new = json!({"label": "a program", "role": "operator", "user": "bert", "days": 1});
    let token = send(address, "POST", "/api/v1/tokens", &by_cookie, &new).await;
    let secret = token.json()["secret"].as_str().expect("a secret").to_owned();
    let bearer = format!("Bearer {secret}");
    let by_token = [("Authorization", bearer.as_str())];
    assert_eq!(exchange(address, "GET", "/api/v1/me", &by_token).await.json()["name"], "bert");
    let too_much = json!({"label": "more", "role": "admin"});
    assert_eq!(send(address, "POST", "/api/v1/tokens", &by_token, &too_much).await.status, 403);
    let of_others = json!({"label": "more", "user": "anna"});
    assert_eq!(send(address, "POST", "/api/v1/tokens", &by_token, &of_others).await.status, 403);
    let long = json!({"label": "long", "days": 1000});
    let long = send(address, "POST", "/api/v1/tokens", &by_token, &long).await.json();
    assert_eq!(long["token"]["expires"], token.json()["token"]["expires"], "not beyond the one that made it");
    assert_eq!(status(address, "/api/v1/audit", &by_token).await, 403);
    assert_eq!(
        exchange(address, "DELETE", "/api/v1/users/anna", &by_cookie).await.status,
        409,
        "the only admin"
    );
    assert_eq!(exchange(address, "DELETE", "/api/v1/users/bert", &by_cookie).await.status, 204);

    let mut cursor = String::new();
    let mut changes = Vec::new();
    loop {
        let page =
            exchange(address, "GET", &format!("/api/v1/audit?limit=3{cursor}"), &by_cookie).await.json();
        changes.extend(page["changes"].as_array().expect("changes").clone());
        let Some(next) = page["next"].as_str() else { break };
        cursor = format!("&cursor={next}");
    }
    let lines: Vec<String> = changes
        .iter()
        .rev()
        .map(|change| {
            let text = |key: &str| change[key].as_str().expect("text").to_owned();
            assert!(text("time").ends_with('Z'));
            format!(
                "{} | {} | {} | {} | {}",
                text("who"),
                text("via"),
                text("from"),
                text("what"),
                text("outcome")
            )
        })
        .filter(|line| !line.contains("/stop"))
        .collect();
    let (first, long) = (token.json()["token"]["id"].clone(), long["token"]["id"].clone());
    let (first, long) = (first.as_str().expect("an id"), long.as_str().expect("an id"));
    assert_eq!(
        lines,
        [
            " | nobody | 127.0.0.1 | PUT /api/v1/plan | 204".to_owned(),
            " | command_line |  | user add anna as admin | done".to_owned(),
            "anna | nobody | 127.0.0.1 | POST /api/v1/sign-in | wrong password".to_owned(),
            "(unknown) | nobody | 127.0.0.1 | POST /api/v1/sign-in | wrong password".to_owned(),
            "anna | nobody | 127.0.0.1 | POST /api/v1/sign-in | signed in".to_owned(),
            "anna | sign_in | 127.0.0.1 | POST /api/v1/users: bert as operator | 201".to_owned(),
            format!(
                "anna | sign_in | 127.0.0.1 | POST /api/v1/tokens: {first} of bert as operator: a program | 201"
            ),
            format!("bert | token | 127.0.0.1 | POST /api/v1/tokens: {long} of bert as viewer: long | 201"),
            "anna | sign_in | 127.0.0.1 | DELETE /api/v1/users/bert | 204".to_owned(),
        ]
    );
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn secrets_are_in_no_log() {
    let folder = Folder::new("accounts-log");
    let data = folder.0.join("data");
    add(&data, "anna", "admin");
    let file = folder.0.join("site.toml");
    std::fs::write(&file, toml::to_string(&folder.config()).expect("TOML")).expect("written");
    let log = folder.0.join("log");
    let mut process = tokio::process::Command::new(env!("CARGO_BIN_EXE_holdfast"))
        .args(["site", "--config"])
        .arg(&file)
        .arg("--data")
        .arg(&data)
        .env("RUST_LOG", "trace")
        .stdout(Stdio::piped())
        .stderr(std::fs::File::create(&log).expect("a file"))
        .kill_on_drop(true)
        .spawn()
        .expect("starts");
    use tokio::io::AsyncBufReadExt as _;
    let mut lines = tokio::io::BufReader::new(process.stdout.take().expect("piped")).lines();
    let line = tokio::time::timeout(PATIENCE, lines.next_line()).await.expect("in time").expect("read");
    let line = line.expect("still running");
    let address = line.trim_start_matches("dashboard http://").trim_end_matches('/');
    let address: SocketAddr = address.parse().expect("an address");

    assert_eq!(sign_in(address, "anna", "a wrong password").await.status, 401);
    let cookie = cookie(&sign_in(address, "anna", PASSWORD).await);
    let own = format!("http://{address}");
    let by_cookie = [("Cookie", cookie.as_str()), ("Origin", own.as_str())];
    let token = send(address, "POST", "/api/v1/tokens", &by_cookie, &json!({"label": "x"})).await;
    let token = token.json()["secret"].as_str().expect("a secret").to_owned();
    assert_eq!(status(address, "/api/v1/fleet", &[("Authorization", &format!("Bearer {token}"))]).await, 200);
    let ticket = exchange(address, "POST", "/api/v1/live-ticket", &by_cookie).await.json();
    let ticket = ticket["ticket"].as_str().expect("a ticket").to_owned();
    assert!(live(address, &format!("?ticket={ticket}"), &[]).await.is_ok());
    let change = json!({"old": PASSWORD, "new": "yet another password"});
    assert_eq!(send(address, "PUT", "/api/v1/me/password", &by_cookie, &change).await.status, 204);
    process.kill().await.expect("killed");

    let log = std::fs::read_to_string(&log).expect("a log");
    assert!(log.contains("TRACE") && log.len() > 10_000, "everything is logged");
    let cookie = cookie.split_once('=').expect("a pair").1;
    for secret in ["a wrong password", PASSWORD, "yet another password", cookie, &token, &ticket] {
        assert!(!log.contains(secret), "{secret}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cookies_behind_https_are_for_https_and_for_nobody_else_s_page() {
    let folder = Folder::new("accounts-https");
    add(&folder.0, "anna", "viewer");
    let mut config = folder.config();
    config.http.https = true;
    config.http.names = vec!["site.example".to_owned()];
    config.http.proxies = vec!["127.0.0.1".parse().expect("an address")];
    let site = Site::start(&config).await.expect("starts");
    let address = site.address();
    let proxied = [("Host", "site.example"), ("X-Forwarded-For", "203.0.113.7")];
    let body = json!({"name": "anna", "password": PASSWORD});
    let answer = send(address, "POST", "/api/v1/sign-in", &proxied, &body).await;
    assert!(answer.header("strict-transport-security").starts_with("max-age="));
    let cookie_text = answer.header("set-cookie").to_owned();
    assert!(cookie_text.starts_with("__Host-holdfast=") && cookie_text.contains("; Secure"), "{cookie_text}");
    let cookie = cookie(&answer);
    for (origin, expected) in [("https://site.example", 201), ("http://site.example", 403)] {
        let headers = [("Host", "site.example"), ("Cookie", cookie.as_str()), ("Origin", origin)];
        assert_eq!(
            exchange(address, "POST", "/api/v1/live-ticket", &headers).await.status,
            expected,
            "{origin}"
        );
    }
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn plan_is_kept_checked_and_changed_only_by_who_saw_it() {
    let folder = Folder::new("accounts-plan");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    let empty = get(address, "/api/v1/plan").await;
    assert_eq!((empty.status, empty.header("content-type")), (200, "application/geo+json"));
    assert_eq!(empty.json(), json!({"type": "FeatureCollection", "features": []}));
    let plan = json!({"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"name": "pit"},
        "geometry": {"type": "Point", "coordinates": [8.5, 47.25]}}]});
    let of_empty = [("If-Match", empty.header("etag"))];
    let put = send(address, "PUT", "/api/v1/plan", &of_empty, &plan).await;
    assert_eq!(put.status, 204);
    let tag = put.header("etag").to_owned();
    assert_eq!(send(address, "PUT", "/api/v1/plan", &of_empty, &plan).await.status, 412, "changed since");
    let wrong = json!({"type": "FeatureCollection", "features": [{"type": "Feature"}]});
    assert_eq!(send(address, "PUT", "/api/v1/plan", &[], &wrong).await.status, 400);
    assert_eq!(status(address, "/api/v1/plan", &[("If-None-Match", &tag)]).await, 304);
    site.stop().await;
    let site = Site::start(&folder.config()).await.expect("starts again");
    let kept = get(site.address(), "/api/v1/plan").await;
    assert_eq!((kept.json(), kept.header("etag")), (plan, tag.as_str()));
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn trajectory_has_a_point_a_second_and_sessions_come_page_by_page() {
    let folder = Folder::new("accounts-lists");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    let path = "/api/v1/machines/a/trajectory";
    assert_eq!(status(address, path, &[]).await, 404);
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    let points = async |query: &str| get(address, &format!("{path}{query}")).await.json();
    machine
        .speak_until(async || points("").await["points"].as_array().is_some_and(|points| points.len() >= 3))
        .await;
    let all = points("").await;
    let first = &all["points"][0];
    assert_eq!(first["position_m"], json!([10.0, 20.0, 1.0]));
    assert_eq!((&first["mode"], &all["next"], &all["machine"]), (&"main".into(), &Value::Null, &"a".into()));
    let page = points("?limit=2").await;
    let next = page["next"].as_str().expect("more follow");
    assert_eq!(page["points"][1]["time"], next);
    assert_eq!(points(&format!("?since={next}")).await["points"][0], all["points"][2]);
    for query in ["?limit=0", "?limit=3601", "?since=noon", "?until=now", "?limit=1&limit=2"] {
        assert_eq!(status(address, &format!("{path}{query}"), &[]).await, 400, "{query}");
    }

    for _ in 0..4 {
        let started = exchange(address, "POST", "/api/v1/sessions", &[]).await;
        assert_eq!(started.status, 201, "{}", String::from_utf8_lossy(&started.body));
        let id = started.json()["id"].clone();
        machine
            .speak_until(async || {
                let session =
                    get(address, &format!("/api/v1/sessions/{}", id.as_str().expect("an id"))).await;
                session.json()["session"]["bytes"].as_u64() > Some(0)
            })
            .await;
    }
    let ids = |list: &Value| -> Vec<String> {
        let sessions = list["sessions"].as_array().expect("sessions").iter();
        sessions.map(|session| session["id"].as_str().expect("an id").to_owned()).collect()
    };
    let all = ids(&get(address, "/api/v1/sessions").await.json());
    assert!(all.len() >= 4, "{all:?}");
    let (mut found, mut cursor) = (Vec::new(), String::new());
    loop {
        let page = get(address, &format!("/api/v1/sessions?limit=2{cursor}")).await.json();
        found.extend(ids(&page));
        let Some(next) = page["next"].as_str() else { break };
        cursor = format!("&cursor={next}");
    }
    assert_eq!(found, all);
    let detail = get(address, &format!("/api/v1/sessions/{}", all[1])).await;
    let known = [("If-None-Match", detail.header("etag"))];
    assert_eq!(status(address, &format!("/api/v1/sessions/{}", all[1]), &known).await, 304);
    site.stop().await;
}
