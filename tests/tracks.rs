//! What the page replays: a session's tracks and events, and the last hour of a machine.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play machines and people, who have clocks")]

#[path = "support/site.rs"]
mod support;

use std::net::SocketAddr;
use std::time::Duration;

use holdfast::site::Site;
use holdfast::state::{Event, EventKind, GnssState, Mode, Severity};
use holdfast::wire::{self, Topic};
use serde_json::Value;

use support::{Folder, Machine, PATIENCE, exchange, get, now};

async fn running(site: SocketAddr) -> String {
    let list = get(site, "/api/v1/sessions").await.json();
    list["recording"]["session"].as_str().expect("a session runs").to_owned()
}

/// Asks until it is so.
async fn until<F: AsyncFnMut() -> Option<Value>>(mut found: F) -> Value {
    let waited = tokio::time::timeout(PATIENCE, async {
        loop {
            if let Some(value) = found().await {
                return value;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    });
    waited.await.expect("in time")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn session_is_told_as_tracks_and_events_and_the_past_of_a_machine_as_states() {
    let folder = Folder::new("tracks");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    let session = running(address).await;
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    machine.health().await;
    for _ in 0..10 {
        machine.pose().await;
        tokio::time::sleep(Duration::from_millis(60)).await;
    }
    (machine.mode, machine.gnss) = (Mode::Fallback, GnssState::Silent);
    machine.health().await;
    let began = EventKind::OutageBegan { cause: GnssState::Silent };
    let event = wire::encode_json("event", &Event::new(now(), Severity::Warning, began)).expect("encodes");
    machine.put(Topic::Event, event).await;
    tokio::time::sleep(Duration::from_millis(2_500)).await;
    machine.pose().await;
    machine.health().await;

    // The running session: what is on the disk.
    let path = format!("/api/v1/sessions/{session}/track?step_s=0.05");
    let track = until(async || {
        let track = get(address, &path).await.json();
        let states = track["machines"][0]["states"].as_array().map_or(0, Vec::len);
        let poses = track["machines"][0]["poses"]["time_s"].as_array().map_or(0, Vec::len);
        // Topics overtake each other: the pose that ends the silence may come after the health that followed it.
        let silences = track["machines"][0]["silences"].as_array().map_or(0, Vec::len);
        (states == 3 && poses > 3 && silences == 1).then_some(track)
    })
    .await;
    assert_eq!((&track["session"], &track["finished"]), (&session.as_str().into(), &false.into()));
    let told = &track["machines"][0];
    assert_eq!(
        (&told["id"], &told["name"], &told["software"]),
        (&"a".into(), &"Number one".into(), &"0".into())
    );
    let poses = &told["poses"];
    let count = poses["time_s"].as_array().expect("times").len();
    for (name, column) in poses.as_object().expect("columns") {
        assert_eq!(column.as_array().expect("a list").len(), count, "{name}");
    }
    assert_eq!(poses["position_m"][0], serde_json::json!([10.0, 20.0, 1.0]));
    // The IMU sits 2 m above the cabin's origin.
    assert_eq!(poses["cabin_position_m"][0], serde_json::json!([10.0, 20.0, -1.0]));
    assert_eq!(poses["heading_deg"][0], 0.0);
    assert_eq!(poses["speed_mps"][0], 0.5);
    let words: Vec<&str> = told["states"]
        .as_array()
        .expect("states")
        .iter()
        .map(|state| state["state_word"].as_str().expect("a word"))
        .collect();
    assert_eq!(words[0], "RTK FIXED");
    assert!(words[1].starts_with("HOLDING"), "{words:?}");
    let silence = &told["silences"][0];
    let silent_s = silence["to_s"].as_f64().expect("a time") - silence["from_s"].as_f64().expect("a time");
    assert!(silent_s >= 2.5, "{silence}");
    assert_eq!(told["poses_missing"], 0);

    let events = get(address, &format!("/api/v1/sessions/{session}/events")).await.json();
    assert_eq!(events["events"][0]["machine"], "a", "{events}");
    assert_eq!(events["events"][0]["event"]["kind"], "outage_began");
    assert_eq!((&events["events"].as_array().expect("events").len(), &events["left_out"]), (&1, &0.into()));

    let history = get(address, "/api/v1/machines/a/history").await.json();
    let states = history["states"].as_array().expect("states");
    assert!(states.len() >= 2, "{history}");
    assert_eq!(states[0]["time_s"], 0.0);
    let last = history["last"].as_str().expect("a time");
    let more = get(address, &format!("/api/v1/machines/a/history?since={last}")).await.json();
    assert_eq!(more["states"].as_array().expect("states").len(), 0, "{more}");

    // A finished session is the same for ever.
    let stopped = exchange(address, "POST", &format!("/api/v1/sessions/{session}/stop"), &[]).await;
    assert_eq!(stopped.status, 200);
    let whole = get(address, &path).await;
    assert_eq!(whole.json()["finished"], true);
    let tag = whole.header("etag").to_owned();
    let again = exchange(address, "GET", &path, &[("If-None-Match", &tag)]).await;
    assert_eq!((again.status, again.body.len()), (304, 0));
    let part = get(address, &format!("/api/v1/sessions/{session}/track?machine=b")).await.json();
    assert_eq!((&part["machines"], &part["start"]), (&serde_json::json!([]), &Value::Null));

    for (wrong, status) in [
        (format!("/api/v1/sessions/{session}/track?step_s=0.01"), 400),
        (format!("/api/v1/sessions/{session}/track?from=yesterday"), 400),
        (format!("/api/v1/sessions/{session}/track?from=2026-11-23T05:00:00Z&to=2026-11-23T05:00:00Z"), 400),
        (format!("/api/v1/sessions/{session}/track?colour=red"), 400),
        ("/api/v1/sessions/20000101T000000Z/track".to_owned(), 404),
        ("/api/v1/sessions/20000101T000000Z/events".to_owned(), 404),
        ("/api/v1/machines/b/history".to_owned(), 404),
        ("/api/v1/machines/a/history?since=now".to_owned(), 400),
    ] {
        let answer = get(address, &wrong).await;
        assert_eq!(answer.status, status, "{wrong}");
        assert_eq!(answer.header("content-type"), "application/problem+json", "{wrong}");
    }
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn addresses_of_views_are_the_page_and_others_are_nowhere() {
    let folder = Folder::new("views");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    let page = get(address, "/").await;
    for path in [
        "/alerts",
        "/outages",
        "/outages/walker-1.cc4940bb99910ec3.1795443516591679918",
        "/machines/menzi-1",
        "/sessions/20261123T050000Z",
        "/sign-in",
    ] {
        let view = get(address, path).await;
        assert_eq!((view.status, &view.body), (200, &page.body), "{path}");
        assert_eq!(view.header("content-type"), "text/html; charset=utf-8");
    }
    for path in ["/nowhere", "/alerts/a", "/machines/a/b", "/machines/a.js", "/sign-in/x"] {
        assert_eq!(get(address, path).await.status, 404, "{path}");
    }
    site.stop().await;
}
