//! The site server from outside: real HTTP, real WebSockets, a real Zenoh peer that speaks as a machine does.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play machines and people, who have clocks")]

#[path = "support/site.rs"]
mod support;

use std::net::SocketAddr;
use std::process::Stdio;
use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use holdfast::record;
use holdfast::site::{Site, SiteError};
use holdfast::wire::{self, BootId, Topic};
use serde_json::Value;
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use zenoh::Wait as _;

use support::{Folder, Machine, PATIENCE, exchange, get, now};

type Socket = tokio_tungstenite::WebSocketStream<tokio_tungstenite::MaybeTlsStream<TcpStream>>;

async fn live(site: SocketAddr) -> Socket {
    let connected = tokio_tungstenite::connect_async(format!("ws://{site}/api/v1/live")).await;
    connected.expect("connects").0
}

async fn next(socket: &mut Socket) -> Value {
    let message = tokio::time::timeout(PATIENCE, socket.next()).await.expect("in time");
    let message = message.expect("open").expect("a message");
    serde_json::from_str(message.to_text().expect("text")).expect("JSON")
}

/// Waits until machine `a` is as `presence` says, by the live deltas.
async fn wait_for_presence(socket: &mut Socket, presence: &str) -> Value {
    let waiting = async {
        loop {
            let delta = next(socket).await;
            let machines = delta["machines"].as_array().expect("a delta").clone();
            let found = machines.into_iter().find(|machine| machine["id"] == "a");
            if let Some(machine) = found.filter(|machine| machine["presence"] == presence) {
                return machine;
            }
        }
    };
    tokio::time::timeout(PATIENCE, waiting).await.expect("in time")
}

async fn is_online(site: SocketAddr) -> bool {
    get(site, "/api/v1/machines/a").await.json()["presence"] == "online"
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn machine_that_speaks_is_on_the_fleet_with_its_pose_and_health() {
    let folder = Folder::new("fleet");
    let site = Site::start(&folder.config()).await.expect("starts");
    let empty = get(site.address(), "/api/v1/fleet").await;
    assert_eq!((empty.status, empty.header("content-type")), (200, "application/json"));
    assert_eq!(empty.json()["machines"], Value::Array(vec![]));
    assert_eq!(empty.json()["site"]["world"]["longitude_deg"], 8.0);

    let mut machine = Machine::connect("a", 0xb007, &site.endpoints()[0]).await;
    machine.speak_until(async || is_online(site.address()).await).await;
    let fleet = get(site.address(), "/api/v1/fleet").await.json();
    let view = &fleet["machines"][0];
    assert_eq!((&view["id"], &view["name"]), (&"a".into(), &"Number one".into()));
    assert_eq!((&view["state_word"], &view["severity"]), (&"RTK FIXED".into(), &"good".into()));
    assert_eq!(view["boot"], "000000000000b007");
    let pose = &view["pose"];
    assert_eq!(pose["position_m"], serde_json::json!([10.0, 20.0, 1.0]));
    assert_eq!(pose["speed_mps"], 0.5);
    assert!((pose["latitude_deg"].as_f64().expect("number") - 47.00018).abs() < 1e-5, "{pose}");
    assert!(pose["heading_deg"].as_f64().expect("number").abs() < 1e-9, "{pose}");
    assert!(pose["age_s"].as_f64().expect("number") < 0.5, "{pose}");
    assert_eq!(view["link"]["missed"], 0);
    assert!(view["link"]["clock_offset_s"].as_f64().expect("number").abs() < 0.5);
    assert!(fleet["time"].as_str().is_some_and(|time| time.ends_with('Z') && time.len() == 30));
    let machines = get(site.address(), "/api/v1/machines").await.json();
    assert_eq!(machines["machines"].as_array().map(Vec::len), Some(1));

    // What cannot be used is counted, and the rest goes on.
    let key = wire::topic_key("quarry", "a", Topic::Pose);
    machine.session.put(&key, vec![1, 2, 3]).await.expect("put without attachment");
    machine.put(Topic::Health, b"{}".to_vec()).await;
    machine
        .speak_until(async || get(site.address(), "/api/v1/machines/a").await.json()["link"]["refused"] == 2)
        .await;
    machine.speak_until(async || is_online(site.address()).await).await;
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn live_client_gets_a_snapshot_and_deltas_in_sequence() {
    let folder = Folder::new("live");
    let site = Site::start(&folder.config()).await.expect("starts");
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    machine.speak_until(async || is_online(site.address()).await).await;
    let mut socket = live(site.address()).await;
    let snapshot = next(&mut socket).await;
    assert_eq!((&snapshot["type"], &snapshot["seq"]), (&"snapshot".into(), &0.into()));
    assert_eq!(snapshot["fleet"]["machines"][0]["id"], "a");

    let subscribe = r#"{"type":"subscribe","rate_hz":10,"machines":["a"]}"#;
    socket.send(Message::text(subscribe)).await.expect("sent");
    let mut received = 0;
    for sequence in 1..=10 {
        machine.pose().await;
        let delta = next(&mut socket).await;
        assert_eq!((&delta["type"], &delta["seq"]), (&"delta".into(), &sequence.into()));
        assert_eq!(delta["dropped"], 0);
        for view in delta["machines"].as_array().expect("machines") {
            let count = view["link"]["received"].as_u64().expect("number");
            assert!(count >= received, "newer than before");
            received = count;
        }
    }
    socket.send(Message::text("nonsense")).await.expect("sent");
    let answer = tokio::time::timeout(PATIENCE, async {
        loop {
            let message = next(&mut socket).await;
            if message["type"] == "error" {
                return message;
            }
        }
    });
    assert!(answer.await.expect("an answer")["detail"].as_str().is_some_and(|detail| !detail.is_empty()));
    // The end of the site is told.
    site.stop().await;
    let closed = tokio::time::timeout(PATIENCE, async {
        while let Some(Ok(message)) = socket.next().await {
            if let Message::Close(Some(frame)) = message {
                return Some(u16::from(frame.code));
            }
        }
        None
    });
    assert_eq!(closed.await.expect("closed in time"), Some(1001));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn machine_without_its_token_is_lost_within_two_seconds_and_comes_back() {
    let folder = Folder::new("lost");
    let site = Site::start(&folder.config()).await.expect("starts");
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    machine.speak_until(async || is_online(site.address()).await).await;
    let mut socket = live(site.address()).await;
    next(&mut socket).await;
    let dropped = now();
    drop(machine.token.take());
    let lost = wait_for_presence(&mut socket, "lost").await;
    assert!(now().seconds_since(dropped) < 2.0);
    assert_eq!(lost["severity"], "offline");
    assert!(lost["state_word"].as_str().is_some_and(|word| word.starts_with("OFFLINE 0:")));
    assert_eq!(lost["pose"]["position_m"][0], 10.0, "keeps its last values");

    let boot = BootId(2);
    machine.boot = boot;
    machine.sequences.clear();
    let key = wire::alive_key("quarry", "a", boot);
    machine.token = Some(machine.session.liveliness().declare_token(key).await.expect("token"));
    machine.speak_until(async || is_online(site.address()).await).await;
    assert_eq!(wait_for_presence(&mut socket, "online").await["boot"], "0000000000000002");
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn machine_that_is_started_anew_is_restarted_until_it_says_where_it_is() {
    let folder = Folder::new("restarted");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    let endpoint = site.endpoints()[0].clone();
    let mut machine = Machine::connect("a", 1, &endpoint).await;
    machine.speak_until(async || is_online(address).await).await;
    // It is killed: its token goes with its session, and another boot comes.
    machine.session.close().await.expect("closes");
    let mut machine = Machine::connect("a", 2, &endpoint).await;
    let view = async || get(address, "/api/v1/machines/a").await.json();
    let deadline = std::time::Instant::now() + support::PATIENCE;
    let restarted = loop {
        machine.health().await;
        let view = view().await;
        if view["presence"] == "restarted" {
            break view;
        }
        assert!(std::time::Instant::now() < deadline, "{view}");
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    };
    assert_eq!((&restarted["boot"], &restarted["severity"]), (&"0000000000000002".into(), &"warning".into()));
    assert!(
        restarted["state_word"].as_str().is_some_and(|word| word.starts_with("RESTARTED 0:")),
        "{restarted}"
    );
    assert!(
        restarted["pose"]["age_s"].as_f64().is_some_and(|age_s| age_s > 0.0),
        "the last one: {restarted}"
    );
    // It is there: who watches machines by Prometheus need not be woken.
    let metrics = String::from_utf8(get(address, "/metrics").await.body).expect("text");
    assert!(metrics.contains("holdfast_machine_up{machine=\"a\"} 1"), "{}", metrics);
    machine.speak_until(async || is_online(address).await).await;
    assert_eq!(view().await["state_word"], "RTK FIXED");
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn configuration_is_asked_of_the_machine_itself() {
    let folder = Folder::new("configuration");
    let site = Site::start(&folder.config()).await.expect("starts");
    let mut machine = Machine::connect("a", 7, &site.endpoints()[0]).await;
    machine.speak_until(async || is_online(site.address()).await).await;
    let path = "/api/v1/machines/a/configuration";
    let silent = get(site.address(), path).await;
    assert_eq!((silent.status, silent.header("content-type")), (503, "application/problem+json"));
    let head = wire::JournalHead { software: "1.2.3".to_owned(), machine_file: "id = \"a\"\n".to_owned() };
    let payload = wire::encode_json("configuration", &head).expect("JSON");
    let key = wire::configuration_key("quarry", "a", machine.boot);
    let declared = machine.session.declare_queryable(key);
    let answering = declared.callback(move |query| {
        query.reply(query.key_expr().clone(), payload.clone()).wait().expect("replied");
    });
    answering.background().await.expect("declared");
    machine.speak_until(async || get(site.address(), path).await.status == 200).await;
    let told = get(site.address(), path).await.json();
    assert_eq!((&told["software"], &told["machine_file"]), (&"1.2.3".into(), &"id = \"a\"\n".into()));
    assert_eq!((&told["machine"], &told["boot"]), (&"a".into(), &machine.boot.to_string().into()));
    assert_eq!(get(site.address(), "/api/v1/machines/b/configuration").await.status, 404);
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn everything_that_arrives_is_recorded_and_can_be_downloaded() {
    let folder = Folder::new("record");
    let site = Site::start(&folder.config()).await.expect("starts");
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    machine.speak_until(async || is_online(site.address()).await).await;
    let session = async || get(site.address(), "/api/v1/sessions").await.json()["sessions"][0].clone();
    machine.speak_until(async || session().await["machines"] == serde_json::json!(["a"])).await;
    let recording = session().await;
    assert_eq!((&recording["state"], &recording["ended"]), (&"recording".into(), &Value::Null));
    let id = recording["id"].as_str().expect("an id").to_owned();
    // A running session can be downloaded as far as it is on the disk.
    machine.speak_until(async || session().await["bytes"].as_u64() > Some(2000)).await;
    let path = format!("/api/v1/sessions/{id}/recording.mcap");
    let part = exchange(site.address(), "GET", &path, &[("Range", "bytes=0-7")]).await;
    assert_eq!((part.status, part.body.as_slice()), (206, &b"\x89MCAP0\r\n"[..]));
    let second = Site::start(&folder.config()).await;
    assert!(matches!(second, Err(SiteError::Record { .. })), "two writers in one folder");
    let endpoint_of_the_first = site.address();
    site.stop().await;
    assert!(TcpStream::connect(endpoint_of_the_first).await.is_err(), "the port is free again");

    let site = Site::start(&folder.config()).await.expect("starts again");
    let list = get(site.address(), "/api/v1/sessions").await.json();
    let complete = list["sessions"].as_array().expect("sessions").iter().find(|session| session["id"] == *id);
    let complete = complete.expect("the session is listed").clone();
    assert_eq!(complete["state"], "complete");
    assert!(complete["ended"].is_string() && complete["messages"].as_u64() > Some(2), "{complete}");
    let download = get(site.address(), &path).await;
    assert_eq!(download.status, 200);
    assert!(download.header("content-disposition").contains(&format!("{id}.mcap")));
    assert_eq!(download.body.len() as u64, complete["bytes"].as_u64().expect("number"));
    let unchanged =
        exchange(site.address(), "GET", &path, &[("If-None-Match", download.header("etag"))]).await;
    assert_eq!(unchanged.status, 304);
    let copy = folder.0.join("copy.mcap");
    std::fs::write(&copy, &download.body).expect("written");
    let messages: Vec<_> =
        record::read_messages(&copy).expect("readable").collect::<Result<_, _>>().expect("whole");
    assert_eq!(messages.len() as u64, complete["messages"].as_u64().expect("number"));
    assert!(messages.iter().any(|message| message.topic == Topic::Pose && message.machine == "a"));
    assert!(messages.iter().any(|message| message.topic == Topic::Health));
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn errors_are_problem_details_and_every_answer_is_guarded() {
    let folder = Folder::new("errors");
    let mut config = folder.config();
    config.record.enabled = false;
    let site = Site::start(&config).await.expect("starts");
    let address = site.address();
    for (method, path, headers, status) in [
        ("GET", "/api/v1/machines/nobody", &[][..], 404),
        ("GET", "/api/v1/machines/%ff", &[], 400),
        ("GET", "/api/v1/nothing", &[], 404),
        ("GET", "/nothing", &[], 404),
        ("GET", "/../../etc/passwd", &[], 404),
        ("GET", "/api/v1/sessions/nothing/recording.mcap", &[], 404),
        ("GET", "/api/v1/sessions/..%2f..%2fetc/recording.mcap", &[], 404),
        ("POST", "/api/v1/fleet", &[], 405),
        ("DELETE", "/api/v1/machines/a", &[], 405),
        ("POST", "/api/openapi.json", &[], 405),
        ("GET", "/api/v1/live", &[], 400),
        ("GET", "/api/v1/fleet", &[("Host", "evil.example")], 421),
        ("GET", "/api/v1/live", &[("Upgrade", "websocket"), ("Origin", "http://evil.example")], 403),
    ] {
        let answer = exchange(address, method, path, headers).await;
        let said = format!("{method} {path}: {}", String::from_utf8_lossy(&answer.body));
        assert_eq!(answer.status, status, "{said}");
        assert_eq!(answer.header("content-type"), "application/problem+json", "{said}");
        let problem = answer.json();
        assert_eq!(problem["status"], status, "{said}");
        assert!(problem["title"].is_string() && problem["detail"].is_string(), "{said}");
        assert_eq!(problem["type"], "about:blank", "{said}");
        assert_eq!(answer.header("cache-control"), "no-store", "{said}");
        assert_eq!(answer.header("x-content-type-options"), "nosniff", "{said}");
        assert!(answer.header("content-security-policy").contains("default-src 'self'"), "{said}");
    }
    let allowed = exchange(address, "POST", "/api/v1/fleet", &[]).await;
    assert!(allowed.header("allow").contains("GET"), "{:?}", allowed.headers);
    for (method, path) in [("HEAD", "/api/v1/fleet"), ("GET", "/healthz"), ("GET", "/readyz")] {
        assert_eq!(exchange(address, method, path, &[]).await.status, 200, "{path}");
    }
    let sessions = get(address, "/api/v1/sessions").await.json();
    assert_eq!(sessions["sessions"], Value::Array(vec![]), "nothing is recorded");
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn openapi_and_metrics_name_what_there_is() {
    let folder = Folder::new("openapi");
    let site = Site::start(&folder.config()).await.expect("starts");
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    machine.speak_until(async || is_online(site.address()).await).await;
    let openapi = get(site.address(), "/api/openapi.json").await.json();
    assert!(openapi["openapi"].as_str().is_some_and(|version| version.starts_with("3.1")), "{openapi}");
    for path in [
        "/api/v1/fleet",
        "/api/v1/machines",
        "/api/v1/machines/{id}",
        "/api/v1/live",
        "/api/v1/sessions",
        "/api/v1/sessions/{id}/recording.mcap",
        "/healthz",
        "/readyz",
        "/metrics",
    ] {
        assert!(openapi["paths"][path]["get"].is_object(), "{path}");
    }
    for schema in ["FleetView", "MachineView", "PoseView", "Health", "LiveMessage", "Request", "Problem"] {
        assert!(openapi["components"]["schemas"][schema].is_object(), "{schema}");
    }
    let metrics = get(site.address(), "/metrics").await;
    let text = String::from_utf8(metrics.body.clone()).expect("text");
    for line in [
        "holdfast_machine_up{machine=\"a\"} 1",
        "holdfast_pose_age_seconds{machine=\"a\"} ",
        "holdfast_position_sigma_meters{machine=\"a\",axis=\"semi_major\"} 0.02",
        "holdfast_gnss_fix{machine=\"a\",type=\"fixed\"} 1",
        "holdfast_gnss_fix{machine=\"a\",type=\"silent\"} 0",
        "holdfast_clock_offset_seconds{machine=\"a\"} ",
        "holdfast_samples_received_total{machine=\"a\"} ",
        "holdfast_samples_missed_total{machine=\"a\"} 0",
        "holdfast_ws_clients 0",
        "holdfast_recording_bytes_total ",
        "holdfast_recording_unsynced_seconds ",
        "holdfast_disk_free_bytes ",
        "holdfast_build_info{version=",
    ] {
        assert!(text.lines().any(|found| found.starts_with(line)), "{line} is not in\n{text}");
    }
    assert!(text.ends_with("# EOF\n"));
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn address_that_is_taken_or_reachable_is_refused_in_words() {
    let folder = Folder::new("address");
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("binds");
    let mut config = folder.config();
    config.http.listen = taken.local_addr().expect("address");
    let message = Site::start(&config).await.err().expect("taken").to_string();
    assert!(message.contains("--listen"), "{message}");
    config.http.listen = "0.0.0.0:0".parse().expect("address");
    let message = Site::start(&config).await.err().expect("refused").to_string();
    assert!(message.contains("loopback"), "{message}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn killed_site_leaves_a_recording_that_the_next_start_recovers() {
    let folder = Folder::new("killed");
    let file = folder.0.join("site.toml");
    std::fs::write(&file, toml::to_string(&folder.config()).expect("TOML")).expect("written");
    let mut process = tokio::process::Command::new(env!("CARGO_BIN_EXE_holdfast"))
        .arg("site")
        .arg("--config")
        .arg(&file)
        .stdout(Stdio::piped())
        .kill_on_drop(true)
        .spawn()
        .expect("starts");
    let mut lines = BufReader::new(process.stdout.take().expect("piped")).lines();
    let mut said = async |before: &str, after: &str| {
        let line = tokio::time::timeout(PATIENCE, lines.next_line()).await.expect("in time");
        let line = line.expect("read").expect("still running");
        let told = line.strip_prefix(before).and_then(|line| line.strip_suffix(after));
        told.expect("as documented").to_owned()
    };
    let address: SocketAddr = said("dashboard http://", "/").await.parse().expect("an address");
    let endpoint = said("zenoh ", "").await;
    let mut machine = Machine::connect("a", 1, &endpoint).await;
    machine
        .speak_until(async || {
            let sessions = get(address, "/api/v1/sessions").await.json();
            sessions["sessions"][0]["bytes"].as_u64() > Some(5000)
        })
        .await;
    let before = get(address, "/api/v1/sessions").await.json()["sessions"][0].clone();
    process.kill().await.expect("killed");

    let site = Site::start(&folder.config()).await.expect("starts");
    let recovered = tokio::time::timeout(PATIENCE, async {
        loop {
            let list = get(site.address(), "/api/v1/sessions").await.json();
            let sessions = list["sessions"].as_array().expect("sessions").clone();
            let found = sessions.into_iter().find(|session| session["id"] == before["id"]).expect("listed");
            if found["state"] == "recovered" {
                return found;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await
    .expect("recovered in time");
    assert_eq!(recovered["machines"], serde_json::json!(["a"]));
    let id = recovered["id"].as_str().expect("an id");
    let path = folder.0.join("sessions").join(id).join(format!("{id}-0000.mcap"));
    let messages =
        record::read_messages(&path).expect("opens").collect::<Result<Vec<_>, _>>().expect("whole");
    assert_eq!(messages.len() as u64, recovered["messages"].as_u64().expect("number"));
    assert!(messages.iter().filter(|message| message.topic == Topic::Pose).count() > 3);
    site.stop().await;
}
