//! Every operation of the OpenAPI document, asked in every wrong way: the error is one of those documented for it, a
//! problem in the sense of RFC 9457, and nothing is changed.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play people, who have clocks")]

#[path = "support/site.rs"]
mod support;

use std::collections::BTreeMap;
use std::net::SocketAddr;

use holdfast::accounts::{Accounts, Password, Role};
use holdfast::site::Site;
use holdfast::time::Span;
use serde_json::{Value, json};

use support::{Answer, Folder, Machine, exchange, exchange_body, now};

const METHODS: [&str; 8] = ["GET", "PUT", "POST", "DELETE", "OPTIONS", "HEAD", "PATCH", "TRACE"];
/// Errors that are told in another form.
const NO_PROBLEMS: [&str; 1] = ["/readyz"];

struct Api {
    site: SocketAddr,
    document: Value,
    /// `Bearer ...` by role.
    bearers: BTreeMap<&'static str, String>,
    /// What stands for `{...}` in paths: things that are there.
    names: BTreeMap<&'static str, String>,
    asked: usize,
}

impl Api {
    fn bearer(&self, role: &str) -> (&'static str, &str) {
        ("Authorization", &self.bearers[role])
    }

    async fn get(&self, path: &str) -> Answer {
        exchange(self.site, "GET", path, &[self.bearer("admin")]).await
    }

    /// Everything that a request could have changed; what goes on by itself is left out.
    async fn state(&self) -> Value {
        let sessions = self.get("/api/v1/sessions").await.json();
        let told = sessions["sessions"]
            .as_array()
            .expect("sessions")
            .iter()
            .map(|session| json!([session["id"], session["name"], session["notes"], session["tags"]]));
        let mut tokens = self.get("/api/v1/tokens").await.json();
        for token in tokens["tokens"].as_array_mut().expect("tokens") {
            token["seen"] = Value::Null;
        }
        json!({
            "sessions": told.collect::<Vec<_>>(),
            "recording": sessions["recording"]["state"],
            "users": self.get("/api/v1/users").await.json(),
            "tokens": tokens,
            "plan": self.get("/api/v1/plan").await.json(),
            "changes": self.get("/api/v1/audit").await.json()["changes"],
        })
    }

    fn operations(&self) -> Vec<(String, &'static str, Value)> {
        let mut operations = Vec::new();
        for (path, item) in self.document["paths"].as_object().expect("paths") {
            for method in METHODS {
                if let Some(operation) = item.get(method.to_lowercase()) {
                    operations.push((path.clone(), method, operation.clone()));
                }
            }
        }
        operations
    }

    /// The path with what is there put in.
    fn real(&self, path: &str) -> String {
        let mut real = path.to_owned();
        for (name, value) in &self.names {
            real = real.replace(name, value);
        }
        let real = match path.starts_with("/api/v1/machines/") {
            true => real.replace("{id}", "a"),
            false => real.replace("{id}", &self.names["{session}"]),
        };
        assert!(!real.contains('{'), "{path}: what is there of that name?");
        real
    }

    /// Asks, and holds the answer against the document; `statuses` are those that would be right.
    async fn wrong(
        &mut self,
        (path, method, operation): &(String, &'static str, Value),
        suffix: &str,
        headers: &[(&str, &str)],
        body: &str,
        statuses: &[u16],
    ) {
        self.asked += 1;
        let answer =
            exchange_body(self.site, method, &format!("{}{suffix}", self.real(path)), headers, body).await;
        let said = String::from_utf8_lossy(&answer.body).chars().take(300).collect::<String>();
        let shown = body.chars().take(40).collect::<String>();
        let asked = format!("{method} {path}{suffix} {headers:?} {shown:?}: {} {said}", answer.status);
        assert!(statuses.contains(&answer.status), "{asked}");
        let documented = operation["responses"].get(answer.status.to_string());
        assert!(documented.is_some(), "not documented: {asked}");
        if *method != "HEAD" && !NO_PROBLEMS.contains(&path.as_str()) {
            assert_eq!(answer.header("content-type"), "application/problem+json", "{asked}");
            let problem = answer.json();
            assert_eq!(problem["status"], answer.status, "{asked}");
            for key in ["type", "title", "detail"] {
                assert!(problem[key].as_str().is_some_and(|text| !text.is_empty()), "{asked}");
            }
        }
    }
}

async fn api(folder: &Folder) -> (Api, Site, Machine) {
    let accounts = Accounts::of(&folder.0).expect("none yet");
    let mut bearers = BTreeMap::new();
    let mut token = None;
    for (name, role) in [("anna", Role::Admin), ("bert", Role::Operator), ("carl", Role::Viewer)] {
        let password = Password::new("correct horse battery".to_owned());
        accounts.add_user(name, role, &password, now()).expect("added");
        let end = now() + Span::from_seconds(3600.0);
        let (made, secret) = accounts.add_token(name, "for tests", role, end, now()).expect("added");
        bearers.insert(role.name(), format!("Bearer {}", secret.reveal()));
        token = Some(made.id);
    }
    let mut config = folder.config();
    // All at once, from one address.
    config.http.requests_per_s = 10_000.0;
    let site = Site::start(&config).await.expect("starts");
    let address = site.address();
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    let bearer = bearers["admin"].clone();
    let authorized = [("Authorization", bearer.as_str())];
    let session = async || {
        let list = exchange(address, "GET", "/api/v1/sessions", &authorized).await.json();
        list["sessions"][0]["id"].as_str().map(str::to_owned)
    };
    machine.speak_until(async || session().await.is_some()).await;
    let names = BTreeMap::from([
        ("{session}", session().await.expect("a session")),
        ("{name}", "bert".to_owned()),
        ("{page}", "1".to_owned()),
        ("tokens/{id}", format!("tokens/{}", token.expect("a token"))),
    ]);
    let document = exchange(address, "GET", "/api/openapi.json", &authorized).await.json();
    (Api { site: address, document, bearers, names, asked: 0 }, site, machine)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_operation_asked_wrongly_answers_as_documented_and_changes_nothing() {
    let folder = Folder::new("contract");
    let (mut api, site, _machine) = api(&folder).await;
    let before = api.state().await;
    let operations = api.operations();
    assert!(operations.len() > 20, "{}", operations.len());
    let large = |path: &str| {
        let most = if path == "/api/v1/plan" { 4 * 1024 * 1024 } else { 64 * 1024 };
        format!("{{\"name\":\"{}\"}}", "a".repeat(most))
    };
    for operation in &operations {
        let (path, method, about) = operation;
        let least = about["security"][0]["session"][0].as_str();
        let admin = api.bearers["admin"].clone();
        let admin = ("Authorization", admin.as_str());

        // Nobody, somebody unknown, and somebody whose role does not reach.
        if let Some(least) = least {
            let unknown = format!("Bearer hf_{}", "0".repeat(64));
            for headers in [
                &[][..],
                &[("Authorization", unknown.as_str())],
                &[("Authorization", "Bearer")],
                &[("Authorization", "Basic YW5uYTphbm5h")],
                &[("Cookie", "holdfast=0000")],
            ] {
                api.wrong(operation, "", headers, "", &[401]).await;
            }
            let order = ["viewer", "operator", "admin"];
            for role in order.iter().take_while(|role| **role != least) {
                let bearer = api.bearers[role].clone();
                api.wrong(operation, "", &[("Authorization", &bearer)], "", &[403]).await;
            }
            if !["GET", "HEAD"].contains(method) {
                api.wrong(operation, "", &[admin, ("Origin", "http://evil.example")], "", &[403]).await;
            }
        }
        api.wrong(operation, "", &[admin, ("Host", "evil.example")], "", &[421]).await;

        // Bodies that are none.
        if about["requestBody"].is_object() {
            let json = ("Content-Type", "application/json");
            for body in ["{", "[]", "[1]", "7", "\"text\"", "{\"nonsense\":1}", "\u{1}", "{\"name\":7}"] {
                api.wrong(operation, "", &[admin, json], body, &[400]).await;
            }
            for kind in ["text/plain", "application/xml", "multipart/form-data"] {
                api.wrong(operation, "", &[admin, ("Content-Type", kind)], "{}", &[415]).await;
            }
            api.wrong(operation, "", &[admin], "{}", &[415]).await;
            api.wrong(operation, "", &[admin, json], &large(path), &[413]).await;
            if about["requestBody"]["required"] == true {
                api.wrong(operation, "", &[admin, json], "", &[400]).await;
            }
        }

        // Parameters of another type, out of bounds, twice, or unknown.
        let parameters = about["parameters"].as_array().cloned().unwrap_or_default();
        let of_kind =
            |kind: &str| parameters.iter().filter(|at| at["in"] == kind).cloned().collect::<Vec<_>>();
        let query = of_kind("query");
        for parameter in &query {
            let name = parameter["name"].as_str().expect("a name");
            let schema = &parameter["schema"];
            let is_number = schema.to_string().contains("integer");
            let mut bad = Vec::new();
            if is_number {
                bad.extend(["x", "-1", "1e9", "99999999999999999999", ""].map(str::to_owned));
                bad.extend(schema["maximum"].as_i64().map(|most| (most + 1).to_string()));
            }
            if schema["format"] == "date-time" || schema.get("pattern").is_some() {
                bad.extend(["x", "%ff", "2026-13-45T99:00:00Z"].map(str::to_owned));
            }
            for value in bad {
                api.wrong(operation, &format!("?{name}={value}"), &[admin], "", &[400]).await;
            }
        }
        if !query.is_empty() && path != "/api/v1/live" {
            api.wrong(operation, "?nonsense=1", &[admin], "", &[400]).await;
        }

        // Things that are not there.
        if !of_kind("path").is_empty() {
            let nowhere = api.names.clone();
            for value in ["nobody", "..%2f..%2fetc", "%00", "a%20b", "%ff", &"a".repeat(500)] {
                for name in ["{session}", "{name}", "{page}"] {
                    api.names.insert(name, value.to_owned());
                }
                api.names.insert("tokens/{id}", format!("tokens/{value}"));
                api.names.insert("machines/{id}", format!("machines/{value}"));
                let json = ("Content-Type", "application/json");
                let body = if about["requestBody"].is_object() { "{}" } else { "" };
                api.wrong(operation, "", &[admin, json], body, &[404, 400]).await;
            }
            api.names = nowhere;
        }
    }

    // Methods that a path does not answer to.
    let paths = api.document["paths"].as_object().expect("paths").clone();
    for (path, item) in &paths {
        let has = |method: &str| item.get(method.to_lowercase()).is_some();
        // Who answers GET answers HEAD.
        let answers = |method: &str| has(if method == "HEAD" { "GET" } else { method });
        let others = METHODS.into_iter().filter(|method| !answers(method));
        for method in others {
            let answer = exchange(api.site, method, &api.real(path), &[api.bearer("admin")]).await;
            assert_eq!(answer.status, 405, "{method} {path}");
            let mut allowed: Vec<&str> =
                answer.header("allow").split(", ").filter(|name| *name != "HEAD").collect();
            allowed.sort_unstable();
            let mut documented: Vec<&str> = METHODS.into_iter().filter(|method| has(method)).collect();
            documented.sort_unstable();
            assert_eq!(allowed, documented, "{method} {path}");
            if method != "HEAD" {
                assert_eq!(answer.json()["status"], 405, "{method} {path}");
            }
        }
    }
    assert!(api.asked > 300, "{}", api.asked);
    assert_eq!(api.state().await, before, "nothing is changed");
    site.stop().await;
}
