//! Sessions from outside: started and stopped, rolled, taken along in one piece, noted, kept and deleted.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play machines and people, who have clocks")]

#[path = "support/site.rs"]
mod support;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use holdfast::record::{self, Checker, RecordWriter, Recorded};
use holdfast::site::Site;
use holdfast::time::{Span, Stamp};
use holdfast::wire::{BootId, Topic};
use serde_json::{Value, json};

use support::{Answer, Folder, Machine, PATIENCE, exchange, exchange_body, get, now};

const JSON: (&str, &str) = ("Content-Type", "application/json");

async fn send(site: SocketAddr, method: &str, path: &str, body: &Value) -> Answer {
    exchange_body(site, method, path, &[JSON], &body.to_string()).await
}

async fn list(site: SocketAddr) -> Value {
    get(site, "/api/v1/sessions").await.json()
}

/// The session of that id, as the list has it; `null` if it is not in it.
async fn session(site: SocketAddr, id: &str) -> Value {
    let list = list(site).await;
    let found =
        list["sessions"].as_array().expect("a list").iter().find(|session| session["id"] == id).cloned();
    found.unwrap_or(Value::Null)
}

async fn running(site: SocketAddr) -> String {
    list(site).await["recording"]["session"].as_str().expect("a session runs").to_owned()
}

async fn wait_until<F: AsyncFnMut() -> bool>(what: &str, mut done: F) {
    let waited = tokio::time::timeout(PATIENCE, async {
        while !done().await {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    });
    waited.await.unwrap_or_else(|_| panic!("{what}: not in time"));
}

/// Checks a file that must have no fault; returns the messages that it holds.
fn check(checker: &mut Checker, path: &Path) -> u64 {
    let checked = checker.check(path, |_| {}).expect("readable");
    assert_eq!(checked.faults, Vec::<String>::new(), "{}", path.display());
    checked.summary.messages
}

fn files_of(folder: &Folder, id: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder.0.join("sessions").join(id)).expect("its folder");
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.expect("entry").path()).collect();
    files.retain(|path| path.extension().is_some_and(|ending| ending == "mcap"));
    files.sort();
    files
}

/// Bytes that cannot be compressed, so that it is known how many go to the disk.
fn noise(bytes: usize) -> Vec<u8> {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    (0..bytes).map(|_| next()).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn file_that_is_large_enough_is_followed_by_another_and_nothing_is_lost_between_them() {
    const EVENT_BYTES: usize = 40_000;
    let folder = Folder::new("large");
    let mut config = folder.config();
    config.record.file_max_mb = 1.0;
    let site = Site::start(&config).await.expect("starts");
    let address = site.address();
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    let id = running(address).await;
    let noise = noise(EVENT_BYTES);
    wait_until("three files are full", async || {
        machine.put(Topic::Event, noise.clone()).await;
        session(address, &id).await["files"].as_u64() > Some(3)
    })
    .await;
    site.stop().await;
    let files = files_of(&folder, &id);
    let (mut checker, mut messages) = (Checker::default(), 0);
    for (number, file) in files.iter().enumerate() {
        messages += check(&mut checker, file);
        let bytes = std::fs::metadata(file).expect("a file").len();
        // Looked at some times a second: what comes meanwhile, and waits for the next sync, is in it, too.
        let is_full = (1_000_000..4_000_000).contains(&bytes);
        assert!(is_full || number + 1 == files.len(), "{bytes} bytes in {}", file.display());
    }
    assert!(files.len() > 3 && messages >= 3 * 1_000_000 / EVENT_BYTES as u64, "{messages} in {files:?}");
    assert_eq!((checker.missing(), checker.repeated()), (vec![], vec![]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn session_of_many_files_is_taken_along_in_one_piece_or_file_by_file() {
    let folder = Folder::new("rolled");
    let mut config = folder.config();
    config.record.file_max_min = 0.7 / 60.0;
    let site = Site::start(&config).await.expect("starts");
    let address = site.address();
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    let id = running(address).await;
    machine.speak_until(async || session(address, &id).await["files"].as_u64() > Some(3)).await;
    machine.speak_until(async || session(address, &id).await["bytes"].as_u64() > Some(4_000)).await;
    let path = format!("/api/v1/sessions/{id}/recording.mcap");

    // While it runs, there is what is on the disk: as much as if the power were cut now.
    let download = get(address, &path).await;
    assert_eq!((download.status, download.header("etag")), (200, ""));
    let copy = folder.0.join("running.mcap");
    std::fs::write(&copy, &download.body).expect("written");
    assert!(record::read_messages(&copy).expect("opens").count() > 20);
    record::recover(&copy).expect("recovers");
    check(&mut Checker::default(), &copy);
    site.stop().await;

    config.record.file_max_min = 60.0;
    let site = Site::start(&config).await.expect("starts again");
    let address = site.address();
    let detail = get(address, &format!("/api/v1/sessions/{id}")).await.json();
    assert_eq!(detail["session"], session(address, &id).await);
    assert_eq!(detail["session"]["state"], "complete");
    let files = files_of(&folder, &id);
    let listed = detail["files"].as_array().expect("files");
    assert!(files.len() > 3 && listed.len() == files.len(), "{detail}");
    let mut checker = Checker::default();
    let mut messages = 0;
    for (number, file) in files.iter().enumerate() {
        let count = check(&mut checker, file);
        let about = (&listed[number]["number"], &listed[number]["messages"], &listed[number]["state"]);
        assert_eq!(about, (&json!(number), &json!(count), &json!("complete")));
        messages += count;
        let alone = get(address, &format!("{path}?file={number}")).await;
        assert_eq!((alone.status, alone.body), (200, std::fs::read(file).expect("read")));
        assert!(alone.headers["content-disposition"].contains(&format!("{id}-{number:04}.mcap")));
    }
    assert_eq!(checker.missing(), [], "nothing is lost between two files");
    assert_eq!(detail["session"]["messages"], messages);

    let whole = get(address, &path).await;
    assert_eq!(whole.status, 200);
    assert!(whole.header("content-disposition").contains(&format!("\"{id}.mcap\"")));
    let merged = folder.0.join("merged.mcap");
    std::fs::write(&merged, &whole.body).expect("written");
    let mut checker = Checker::default();
    assert_eq!(check(&mut checker, &merged), messages);
    assert_eq!((checker.missing(), checker.repeated()), (vec![], vec![]));
    // Ranges within, and across, the files of which it is made.
    let bytes = whole.body.len();
    for (first, last) in [(0, 7), (bytes / 3, 2 * bytes / 3), (bytes - 9, bytes - 1), (5, 5)] {
        let range = format!("bytes={first}-{last}");
        let part = exchange(address, "GET", &path, &[("Range", &range)]).await;
        assert_eq!((part.status, part.body.as_slice()), (206, &whole.body[first..=last]), "{range}");
        assert_eq!(part.header("content-range"), format!("bytes {first}-{last}/{bytes}"));
    }
    let unchanged = exchange(address, "GET", &path, &[("If-None-Match", whole.header("etag"))]).await;
    assert_eq!(unchanged.status, 304);

    let missing = get(address, &format!("{path}?file=99")).await;
    assert_eq!(missing.status, 404);
    assert!(missing.json()["detail"].as_str().is_some_and(|detail| detail.contains("has the files 0, 1, 2")));
    assert_eq!(get(address, &format!("{path}?file=x")).await.status, 400);

    // A file of somebody else among them: what can be had is told.
    let stranger = files[1].clone();
    let mut writer = RecordWriter::create(&stranger).expect("creates");
    let at = now();
    let (machine, topic) = ("stranger".to_owned(), Topic::Event);
    let message = Recorded { machine, topic, boot: None, sequence: 0, received: at, sent: at, payload: "{}" };
    writer.write(&message).expect("written");
    writer.finish().expect("finished");
    let apart = get(address, &path).await;
    assert_eq!((apart.status, apart.header("content-type")), (409, "application/problem+json"));
    let detail = apart.json()["detail"].as_str().expect("words").to_owned();
    assert!(detail.contains("?file=, 0, 1, 2"), "{detail}");
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sessions_are_started_and_stopped_by_api_and_no_message_is_lost_between_two() {
    let folder = Folder::new("start-stop");
    let mut config = folder.config();
    config.record.rotate = holdfast::config::Rotate::Never;
    let site = Site::start(&config).await.expect("starts");
    let address = site.address();
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    let first = running(address).await;
    machine.speak_until(async || session(address, &first).await["messages"].as_u64() > Some(20)).await;
    assert_eq!(list(address).await["recording"]["next_session"], Value::Null);

    let wanted = json!({"name": "Trench 4", "tags": ["trench", "night"]});
    let started = send(address, "POST", "/api/v1/sessions", &wanted).await;
    assert_eq!(started.status, 201);
    let view = started.json();
    let second = view["id"].as_str().expect("an id").to_owned();
    assert_ne!(first, second);
    assert_eq!(started.header("location"), format!("/api/v1/sessions/{second}"));
    assert_eq!(
        (&view["name"], &view["notes"], &view["tags"]),
        (&wanted["name"], &json!(""), &wanted["tags"])
    );
    assert_eq!(view["state"], "recording");
    assert_eq!(session(address, &first).await["state"], "complete");
    machine.speak_until(async || session(address, &second).await["messages"].as_u64() > Some(20)).await;

    let not_running = exchange(address, "POST", &format!("/api/v1/sessions/{first}/stop"), &[]).await;
    assert_eq!(not_running.status, 409);
    let stopped = exchange(address, "POST", &format!("/api/v1/sessions/{second}/stop"), &[]).await;
    assert_eq!((stopped.status, &stopped.json()["state"]), (200, &json!("complete")));
    let recording = list(address).await["recording"].clone();
    assert_eq!((&recording["state"], &recording["session"]), (&json!("stopped"), &Value::Null));
    assert!(recording["why"].is_string());
    assert_eq!(get(address, "/readyz").await.status, 200, "as it was asked to be");
    for _ in 0..5 {
        machine.pose().await;
    }
    let mut checker = Checker::default();
    let counts: Vec<u64> = [&first, &second]
        .iter()
        .flat_map(|id| files_of(&folder, id))
        .map(|file| check(&mut checker, &file))
        .collect();
    assert_eq!(counts.len(), 2);
    assert_eq!(
        (checker.missing(), checker.repeated()),
        (vec![], vec![]),
        "every message is in one of the two"
    );

    // Without a body it has no name.
    let third = exchange(address, "POST", "/api/v1/sessions", &[]).await;
    assert_eq!((third.status, &third.json()["name"]), (201, &json!("")));
    for (method, path, headers, body, status) in [
        ("POST", "/api/v1/sessions".to_owned(), &[JSON][..], "{\"nmae\":\"x\"}", 400),
        ("POST", "/api/v1/sessions".to_owned(), &[JSON], "{", 400),
        ("POST", "/api/v1/sessions".to_owned(), &[("Content-Type", "text/plain")], "{}", 415),
        ("POST", "/api/v1/sessions".to_owned(), &[("Origin", "http://evil.example")], "", 403),
        ("POST", "/api/v1/sessions/nothing/stop".to_owned(), &[], "", 404),
        ("POST", format!("/api/v1/sessions/{second}/stop"), &[], "", 409),
        ("PATCH", format!("/api/v1/sessions/{second}"), &[JSON], "{\"tags\":[\"\"]}", 400),
        ("PATCH", format!("/api/v1/sessions/{second}"), &[JSON], "", 400),
        ("PATCH", "/api/v1/sessions/nothing".to_owned(), &[JSON], "{}", 404),
        ("PATCH", "/api/v1/sessions/..%2f..".to_owned(), &[JSON], "{}", 404),
        ("GET", "/api/v1/sessions/nothing".to_owned(), &[], "", 404),
        ("DELETE", format!("/api/v1/sessions/{second}"), &[], "", 405),
    ] {
        let answer = exchange_body(address, method, &path, headers, body).await;
        assert_eq!(
            answer.status,
            status,
            "{method} {path} {body}: {}",
            String::from_utf8_lossy(&answer.body)
        );
        assert_eq!(answer.header("content-type"), "application/problem+json", "{method} {path} {body}");
        assert_eq!(answer.json()["status"], status);
    }
    // Something is in the way: that is no want of room.
    let notes = folder.0.join("sessions").join(&second).join("session.json");
    std::fs::remove_file(&notes).and_then(|()| std::fs::create_dir(&notes)).expect("in the way");
    let path = format!("/api/v1/sessions/{second}");
    let refused = exchange_body(address, "PATCH", &path, &[JSON], "{\"name\":\"x\"}").await;
    assert_eq!((refused.status, &refused.json()["status"]), (503, &json!(503)));
    site.stop().await;
}

/// What the API says of all sessions that have ended.
async fn ended(site: SocketAddr) -> Vec<Value> {
    let mut sessions = list(site).await["sessions"].as_array().expect("a list").clone();
    sessions.retain(|session| session["state"] != "recording");
    sessions
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lost_or_damaged_database_is_made_anew_from_the_files_with_what_people_wrote() {
    let folder = Folder::new("catalogue");
    let config = folder.config();
    let site = Site::start(&config).await.expect("starts");
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    let id = running(site.address()).await;
    machine.speak_until(async || session(site.address(), &id).await["messages"].as_u64() > Some(4)).await;
    let change = json!({"name": "First day", "notes": "Fog until ten.\nThen \"sun\".", "tags": ["fog"]});
    let edited = send(site.address(), "PATCH", &format!("/api/v1/sessions/{id}"), &change).await;
    assert_eq!((edited.status, &edited.json()["notes"]), (200, &change["notes"]));
    let only_tags = json!({"tags": ["fog", "trench"]});
    let edited = send(site.address(), "PATCH", &format!("/api/v1/sessions/{id}"), &only_tags).await;
    assert_eq!((&edited.json()["name"], &edited.json()["tags"]), (&change["name"], &only_tags["tags"]));
    drop(machine);
    site.stop().await;

    let database = folder.0.join("sessions/catalogue.sqlite");
    let site = Site::start(&config).await.expect("starts");
    let before = session(site.address(), &id).await;
    assert_eq!((&before["state"], &before["name"]), (&json!("complete"), &change["name"]));
    assert!(before["messages"].as_u64() > Some(4));
    site.stop().await;
    for round in 0..3 {
        match round {
            0 => std::fs::remove_file(&database).expect("removed"),
            1 => std::fs::write(&database, vec![0x5a; 100_000]).expect("overwritten"),
            // The other way round: what is in the file is lost, and the database knows it.
            _ => std::fs::remove_file(folder.0.join("sessions").join(&id).join("session.json"))
                .expect("removed"),
        }
        let site = Site::start(&config).await.expect("starts");
        wait_until("listed again", async || session(site.address(), &id).await == before).await;
        site.stop().await;
        assert!(database.is_file());
        assert!(folder.0.join("sessions").join(&id).join("session.json").is_file());
    }
    // Deleted by hand: it is gone from the list as well. Ids are seconds: a session of the same one would have it.
    tokio::time::sleep(Duration::from_millis(1_100)).await;
    std::fs::remove_dir_all(folder.0.join("sessions").join(&id)).expect("removed");
    let site = Site::start(&config).await.expect("starts");
    wait_until("gone", async || session(site.address(), &id).await == Value::Null).await;
    site.stop().await;

    // A site that does not record shows what there is, and writes nothing there.
    let mut only_looks = config.clone();
    only_looks.record.enabled = false;
    std::fs::remove_file(&database).expect("removed");
    let site = Site::start(&only_looks).await.expect("starts");
    assert!(!ended(site.address()).await.is_empty());
    let recording = list(site.address()).await["recording"].clone();
    assert_eq!(recording["state"], "off");
    assert_eq!(exchange(site.address(), "POST", "/api/v1/sessions", &[]).await.status, 409);
    site.stop().await;
    assert!(!database.exists());
}

/// A session of earlier, with one message an hour.
fn earlier(folder: &Folder, id: &str, start: Stamp, payload_bytes: usize) {
    let session = folder.0.join("sessions").join(id);
    std::fs::create_dir_all(&session).expect("created");
    let mut writer = RecordWriter::create(&session.join(format!("{id}-0000.mcap"))).expect("created");
    let mut dice = 1_u64;
    let mut random = || {
        dice = dice.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (dice >> 56) as u8
    };
    for sequence in 0..3 {
        let at = start + Span::from_seconds(3600.0 * sequence as f64);
        let payload: Vec<u8> = (0..payload_bytes).map(|_| random()).collect();
        let machine = "a".to_owned();
        let boot = Some(BootId(1));
        let message = Recorded {
            machine,
            topic: Topic::Event,
            boot,
            sequence,
            received: at,
            sent: at,
            payload: &payload,
        };
        writer.write(&message).expect("written");
    }
    writer.finish().expect("finished");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sessions_are_deleted_only_by_the_rules_of_the_site_file() {
    let folder = Folder::new("retention");
    let ids = ["20200101T000000Z", "20200102T000000Z", "20200103T000000Z", "20200104T000000Z"];
    for (days_ago, id) in [(40.0, ids[0]), (20.0, ids[1]), (10.0, ids[2]), (5.0, ids[3])] {
        earlier(&folder, id, now() - Span::from_seconds(86_400.0 * days_ago), 1_000_000);
    }
    let left = async |config: &holdfast::config::Site, expected: &[&str]| {
        let site = Site::start(config).await.expect("starts");
        let expected: Vec<&str> = expected.to_vec();
        wait_until("kept and deleted", async || {
            let sessions = ended(site.address()).await;
            let mut there: Vec<String> =
                sessions.iter().map(|session| session["id"].as_str().expect("an id").to_owned()).collect();
            there.retain(|id| ids.contains(&id.as_str()));
            there.reverse();
            there == expected
        })
        .await;
        site.stop().await;
        for id in ids {
            assert_eq!(folder.0.join("sessions").join(id).exists(), expected.contains(&id), "{id}");
        }
    };
    let mut config = folder.config();
    left(&config, &ids).await;
    // The first look at what is to be kept is over long before the site has said what it records.
    tokio::time::sleep(Duration::from_millis(300)).await;
    config.record.keep_days = Some(30.0);
    left(&config, &ids[1..]).await;
    config.record.keep_gb = Some(0.007);
    left(&config, &ids[2..]).await;
    config.record.keep_gb = Some(0.0);
    let site = Site::start(&config).await.expect("starts");
    wait_until("all are gone", async || ended(site.address()).await.is_empty()).await;
    assert_eq!(list(site.address()).await["recording"]["state"], "recording");
    let running = running(site.address()).await;
    assert!(
        folder.0.join("sessions").join(running).exists(),
        "the running one stays, whatever the rules are"
    );
    site.stop().await;
}
