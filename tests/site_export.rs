//! Exports of a session by HTTP: the bytes that the command writes, and words where there is nothing to write.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play machines, who have clocks")]

#[path = "support/command.rs"]
mod command;
#[path = "support/site.rs"]
mod support;

use holdfast::record::{RecordWriter, Recorded};
use holdfast::site::Site;
use holdfast::wire::Topic;

use command::{empty_folder, holdfast, repository};
use support::{Folder, Machine, get};

const ID: &str = "20261123T103927Z";
const TYPES: [(&str, &str); 5] = [
    ("tum", "text/plain; charset=utf-8"),
    ("csv", "text/csv; charset=utf-8"),
    ("geojson", "application/geo+json"),
    ("gpx", "application/gpx+xml"),
    ("kml", "application/vnd.google-earth.kml+xml"),
];

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn session_is_exported_as_the_command_does_it() {
    let folder = Folder::new("export");
    let mut config = folder.config();
    config.record.enabled = false;
    let sessions = folder.0.join("sessions");
    let into = sessions.join(ID);
    std::fs::create_dir_all(&into).expect("made");
    // Two files: one machine was restarted, and some of it came late.
    let files = holdfast::record::files_of(&repository("tests/replay/restarts")).expect("files");
    for (number, file) in files.iter().enumerate() {
        std::fs::copy(file, into.join(format!("{ID}-{number:04}.mcap"))).expect("copied");
    }
    // Another without poses, nor an origin.
    let poor = "20261123T120000Z";
    std::fs::create_dir_all(sessions.join(poor)).expect("made");
    let mut writer =
        RecordWriter::create(&sessions.join(poor).join(format!("{poor}-0000.mcap"))).expect("created");
    let (at, machine) = (support::now(), "yard-1".to_owned());
    let mut event = Recorded {
        machine,
        topic: Topic::Event,
        boot: None,
        sequence: 0,
        received: at,
        sent: at,
        payload: vec![],
    };
    writer.write(&event).expect("written");
    writer.finish().expect("finished");
    // And one with a pose, but without an origin.
    let nowhere = "20261123T130000Z";
    std::fs::create_dir_all(sessions.join(nowhere)).expect("made");
    let mut writer =
        RecordWriter::create(&sessions.join(nowhere).join(format!("{nowhere}-0000.mcap"))).expect("created");
    let recorded = holdfast::record::read_messages(&files[0]).expect("opens").map(|one| one.expect("reads"));
    event = recorded.into_iter().find(|one| one.topic == Topic::Pose).expect("a pose");
    writer.write(&event).expect("written");
    writer.finish().expect("finished");

    // And one of which the end is torn off.
    let torn = "20261123T140000Z";
    std::fs::create_dir_all(sessions.join(torn)).expect("made");
    let mut bytes = std::fs::read(&files[0]).expect("read");
    bytes.truncate(bytes.len() / 2);
    std::fs::write(sessions.join(torn).join(format!("{torn}-0000.mcap")), bytes).expect("written");

    let site = Site::start(&config).await.expect("starts");
    let address = site.address();
    let out = empty_folder("site-export");
    let path = format!("/api/v1/sessions/{ID}/export");
    for (format, media_type) in TYPES {
        for (name, query, options) in [
            ("one", "&machine=yard-2", &["--machine", "yard-2"][..]),
            ("all", "&rate_hz=5&gap_s=0.5", &["--rate", "5", "--gap", "0.5"]),
            ("odom", "&machine=yard-1&frame=odom", &["--machine", "yard-1", "--frame", "odom"]),
        ] {
            let file = out.join(format!("{name}.{format}"));
            let said = format!("{name} {format}");
            let mut arguments = vec!["export", into.to_str().expect("text"), "--out"];
            arguments.push(file.to_str().expect("text"));
            arguments.extend(options);
            let ended = holdfast(&arguments);
            let answer = get(address, &format!("{path}?format={format}{query}")).await;
            if ended.code == 0 {
                assert_eq!((answer.status, answer.header("content-type")), (200, media_type), "{said}");
                assert!(answer.body == std::fs::read(&file).expect("written"), "{said}: other bytes");
                assert!(answer.body.len() > 1_000, "{said}: {} bytes", answer.body.len());
                assert_eq!(answer.header("holdfast-faults"), "", "{said}");
                let disposition = answer.header("content-disposition");
                assert!(disposition.contains(ID) && disposition.contains(&format!(".{format}\"")), "{said}");
            } else {
                assert_eq!((ended.code, answer.status), (2, 400), "{said}: {}", ended.stderr);
            }
            let refused =
                (name == "all" && format == "tum") || (name == "odom" && !matches!(format, "tum" | "csv"));
            assert_eq!(ended.code != 0, refused, "{said}: {}", ended.stderr);
        }
    }
    for (path, status, words) in [
        (path.clone(), 400, "say with format= which: tum, csv, geojson, gpx, kml"),
        (format!("{path}?format=shp"), 400, "there is no format \"shp\", but: tum, csv"),
        (format!("{path}?format=csv&machine=yard-9"), 404, "no machine \"yard-9\" in session"),
        (format!("{path}?format=csv&machine=yard-9"), 404, "but: yard-1, yard-2"),
        (format!("{path}?format=tum"), 400, "choose with machine=: yard-1, yard-2"),
        (format!("{path}?format=csv&frame=moon"), 400, "frame must be world or odom"),
        (format!("{path}?format=kml&frame=odom"), 400, "the odom frame is not tied to it"),
        (format!("{path}?format=csv&rate_hz=0"), 400, "rate_hz must be from 0.001 to 1000000"),
        (format!("{path}?format=csv&gap_s=NaN"), 400, "gap_s must be from 0.001 to 1000000"),
        (format!("{path}?format=csv&machin=yard-1"), 400, "machin"),
        ("/api/v1/sessions/nothing/export?format=csv".to_owned(), 404, "there is no session"),
        ("/api/v1/sessions/..%2f..%2fetc/export?format=csv".to_owned(), 404, "there is no session"),
        (format!("/api/v1/sessions/{poor}/export?format=csv"), 404, "has no poses, but topics of: yard-1"),
        (format!("/api/v1/sessions/{nowhere}/export?format=gpx"), 409, "ask for tum or csv"),
    ] {
        let answer = get(address, &path).await;
        let said = format!("{path}: {}", String::from_utf8_lossy(&answer.body));
        assert_eq!(
            (answer.status, answer.header("content-type")),
            (status, "application/problem+json"),
            "{said}"
        );
        assert!(answer.json()["detail"].as_str().is_some_and(|detail| detail.contains(words)), "{said}");
    }
    assert_eq!(get(address, &format!("/api/v1/sessions/{nowhere}/export?format=csv")).await.status, 200);
    let part = get(address, &format!("/api/v1/sessions/{torn}/export?format=csv&machine=yard-1")).await;
    let faults = part.header("holdfast-faults");
    assert_eq!(part.status, 200);
    assert!(faults.starts_with(&format!("{torn}-0000.mcap: bytes that are torn off")), "{faults}");
    assert!(!faults.contains('/'), "{faults}");
    let openapi = get(address, "/api/openapi.json").await.json();
    let documented = &openapi["paths"]["/api/v1/sessions/{id}/export"]["get"];
    assert!(documented["responses"]["200"]["headers"]["Holdfast-Faults"].is_object(), "{documented}");
    for (_, media_type) in TYPES {
        let name = media_type.split(';').next().expect("a name");
        assert!(documented["responses"]["200"]["content"][name].is_object(), "{name} in {documented}");
    }
    site.stop().await;
    let left = std::fs::read_dir(&folder.0).expect("folder").map(|entry| entry.expect("entry").file_name());
    assert!(left.into_iter().all(|name| !name.to_string_lossy().contains("scratch")));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn running_session_is_exported_as_far_as_it_is_on_the_disk() {
    let folder = Folder::new("export-running");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    let mut lines = 0;
    machine
        .speak_until(async || {
            let list = get(address, "/api/v1/sessions").await.json();
            let id = list["sessions"][0]["id"].as_str().unwrap_or("none").to_owned();
            let answer = get(address, &format!("/api/v1/sessions/{id}/export?format=csv")).await;
            lines = if answer.status == 200 { answer.body.split(|byte| *byte == b'\n').count() } else { 0 };
            lines > 10
        })
        .await;
    assert!(lines > 10);
    site.stop().await;
}
