//! Outages as remote support sees them: in time, in the history, and after a restart of the site server.
#![cfg(all(feature = "shells", target_os = "linux"))]
#![allow(clippy::disallowed_methods, reason = "tests play machines and people, who have clocks")]

#[path = "support/process.rs"]
mod process;
#[path = "support/site.rs"]
mod support;

use std::net::SocketAddr;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use holdfast::sensors::{Reading, Sensor};
use holdfast::site::Site;
use holdfast::state::{GnssState, Mode, OutageReport};
use holdfast::wire;
use serde_json::Value;

use process::{Process, repository};
use support::{Folder, Machine, PATIENCE, get, now};

const WALKER: &str = "walker-1";
/// Fixes that report more than this are refused by the machine, m.
const SIGMA_MAX_M: f64 = 0.2;

/// When the newest fix came, and the first one of those in a row that report too much.
#[derive(Clone, Copy, Default)]
struct Heard {
    newest: Option<Instant>,
    raised: Option<Instant>,
}

/// Listens to the receiver as the site does, beside it.
async fn listen(endpoint: &str) -> (zenoh::Session, Arc<Mutex<Heard>>) {
    let mut settings = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[\"{endpoint}\"]")),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        settings.insert_json5(key, &value).expect("a known key");
    }
    let session = zenoh::open(settings).await.expect("opens");
    let heard = Arc::new(Mutex::new(Heard::default()));
    let for_callback = Arc::clone(&heard);
    let key = wire::topic_key("site", WALKER, wire::Topic::Sensor(Sensor::GnssLeft));
    let subscriber = session.declare_subscriber(key).callback(move |sample| {
        let bytes = sample.payload().to_bytes();
        let Ok(Reading::GnssLeft(fix)) = wire::decode_reading(Sensor::GnssLeft, &bytes) else { return };
        let mut heard = for_callback.lock().expect("not poisoned");
        heard.newest = Some(Instant::now());
        if fix.sigma_enu_m.x.max(fix.sigma_enu_m.y) > SIGMA_MAX_M {
            heard.raised.get_or_insert(Instant::now());
        }
    });
    subscriber.background().await.expect("subscribes");
    (session, heard)
}

async fn gnss(site: SocketAddr) -> Value {
    get(site, &format!("/api/v1/machines/{WALKER}")).await.json()["gnss"].clone()
}

/// Waits until it holds of the machine's fixes; the first time at which the API said so, and what it said.
async fn when(site: SocketAddr, what: &str, holds: impl Fn(&Value) -> bool) -> (Instant, Value) {
    let begun = Instant::now();
    loop {
        let said = gnss(site).await;
        if holds(&said) {
            return (Instant::now(), said);
        }
        assert!(begun.elapsed() < Duration::from_secs(60), "not {what}: {said}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn outage_is_on_the_api_half_a_second_after_the_covariance_rises_and_1500_ms_after_silence() {
    let folder = Folder::new("outage-latency");
    for part in ["machines", "scenarios"] {
        std::fs::create_dir_all(folder.0.join(part)).expect("a folder");
    }
    for name in ["machines/simulated-roof.toml", "machines/simulated-floor.toml"] {
        std::fs::copy(repository("config").join(name), folder.0.join(name)).expect("copied");
    }
    let demo = std::fs::read_to_string(repository("config/scenarios/demo.toml")).expect("a scenario");
    let (head, rest) = demo.split_once("[[gnss_condition]]").expect("as shipped");
    let machines = &rest[rest.find("[[machine]]").expect("as shipped")..];
    let condition = |start_s: f64, end_s: f64, kind: &str| {
        format!("[[gnss_condition]]\nstart_s = {start_s:?}\nend_s = {end_s:?}\nkind = \"{kind}\"\n")
    };
    let conditions = condition(14.0, 22.0, "unreliable") + &condition(34.0, 42.0, "blocked");
    let scenario = folder.0.join("scenarios/outages.toml");
    std::fs::write(&scenario, format!("{head}{conditions}{machines}")).expect("written");

    let holdfast = Path::new(env!("CARGO_BIN_EXE_holdfast"));
    let mut server = process::site(holdfast, &folder.0, &folder.0.join("site"), Stdio::null());
    let (address, endpoint) = server.addresses();
    let site: SocketAddr = address.parse().expect("an address");
    let (_session, heard) = listen(&endpoint).await;
    let mut command = Command::new(holdfast);
    command.arg("machine").arg("--scenario").arg(&scenario).args(["--machine", WALKER, "--speed", "1"]);
    command.args(["--connect", &endpoint]).stdout(Stdio::null()).stderr(Stdio::null());
    let mut machine = Process::start(&mut command);

    let is_good =
        |said: &Value| said["state"] == "fixed" && said["mode"] == "main" && said["outage"].is_null();
    let holds = |said: &Value| said["outage"].is_object();
    let presence = tokio::time::timeout(PATIENCE, async {
        while get(site, &format!("/api/v1/machines/{WALKER}")).await.status != 200 {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    });
    presence.await.expect("the machine is there");
    when(site, "good", is_good).await;
    heard.lock().expect("not poisoned").raised = None;
    let (seen, said) = when(site, "in an outage", holds).await;
    let raised = heard.lock().expect("not poisoned").raised.expect("the receiver's covariance rose before");
    let late = seen.duration_since(raised);
    println!("{late:?} after the covariance rose: {said}");
    assert!(late <= Duration::from_millis(500), "{late:?}: {said}");
    assert!(said["mode"] == "fallback" || said["mode"] == "main", "{said}");

    // It holds with lidar: the budget is told, and shrinks.
    let (_, told) = when(site, "sure of its budget", |said| !said["outage"]["budget"].is_null()).await;
    assert_eq!(told["outage"]["budget"]["tolerance_m"], 0.05, "{told}");
    when(site, "good again", is_good).await;
    let (seen, said) = when(site, "silent", holds).await;
    let newest = heard.lock().expect("not poisoned").newest.expect("fixes came");
    let late = seen.duration_since(newest);
    println!("{late:?} after the last fix: {said}");
    assert!(late > Duration::from_millis(500), "fixes came: {late:?}");
    assert!(late <= Duration::from_millis(1500), "{late:?}: {said}");
    assert_eq!((&said["state"], &said["outage"]["cause"]), (&"silent".into(), &"silent".into()));
    when(site, "good once more", is_good).await;
    machine.end();

    let list = get(site, "/api/v1/outages?state=ended").await.json();
    let outages = list["outages"].as_array().expect("outages");
    let silent = outages.iter().find(|outage| outage["cause"] == "silent").expect("listed");
    assert_eq!((&silent["ended_by"], &silent["machine"]), (&"recovered".into(), &WALKER.into()), "{silent}");
    let duration_s = silent["duration_s"].as_f64().expect("a number");
    assert!((8.0..11.0).contains(&duration_s), "{silent}");
    assert!(silent["jump_m"].as_f64().is_some_and(|jump_m| jump_m < 0.5), "{silent}");
    let id = silent["id"].as_str().expect("an id");
    let detail = get(site, &format!("/api/v1/outages/{id}")).await.json();
    // Two a second, if the computer has the time.
    assert!(detail["sigma"].as_array().expect("samples").len() > 3, "{detail}");
    assert!(!detail["track"].as_array().expect("points").is_empty(), "{detail}");
    let place = &detail["track"][0];
    assert!((place["latitude_deg"].as_f64().expect("a number") - 47.48).abs() < 0.01, "{place}");
    server.end();
}

/// Says health and poses until something holds.
async fn says(machine: &mut Machine, site: SocketAddr, path: &str, holds: impl Fn(&Value) -> bool) -> Value {
    let mut said = Value::Null;
    machine
        .speak_until(async || {
            said = get(site, path).await.json();
            holds(&said)
        })
        .await;
    said
}

fn ids(list: &Value) -> Vec<String> {
    let id = |outage: &Value| outage["id"].as_str().expect("an id").to_owned();
    list["outages"].as_array().expect("outages").iter().map(id).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn outage_that_goes_on_when_the_server_ends_is_carried_on_by_the_next_and_the_history_stays() {
    let folder = Folder::new("outage-restart");
    let site = Site::start(&folder.config()).await.expect("starts");
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    let is_good = |view: &Value| view["gnss"]["state"] == "fixed";
    says(&mut machine, site.address(), "/api/v1/machines/a", is_good).await;
    // Three short ones, then one that lasts.
    let start = now();
    let outage = |number: i64, is_over: bool| OutageReport {
        start_stamp_ns: start.as_nanos() + number * 1_000_000,
        end_stamp_ns: is_over.then(|| start.as_nanos() + number * 1_000_000 + 500_000),
        cause: if number == 1 { GnssState::Frozen } else { GnssState::Silent },
        travelled_m: 0.5,
        jump_m: is_over.then_some(0.02),
    };
    for number in 0..4 {
        (machine.mode, machine.gnss) = (Mode::Fallback, GnssState::Silent);
        machine.outage = Some(outage(number, false));
        let count = usize::try_from(number).expect("small") + 1;
        let path = "/api/v1/outages";
        says(&mut machine, site.address(), path, |list| ids(list).len() == count).await;
        if number < 3 {
            (machine.mode, machine.gnss) = (Mode::Main, GnssState::Fixed);
            machine.outage = Some(outage(number, true));
            let path = "/api/v1/outages?state=ended";
            says(&mut machine, site.address(), path, |list| ids(list).len() == count).await;
        }
    }
    let view = get(site.address(), "/api/v1/machines/a").await.json();
    let current = &view["gnss"]["outage"];
    assert_eq!((&view["gnss"]["mode"], &current["cause"]), (&"fallback".into(), &"silent".into()), "{view}");
    let id = current["id"].as_str().expect("an id").to_owned();
    let open = get(site.address(), "/api/v1/outages?state=open").await.json();
    assert_eq!(ids(&open), [id.as_str()]);
    site.stop().await;

    let site = Site::start(&folder.config()).await.expect("starts again");
    let address = site.address();
    let open = get(address, "/api/v1/outages?state=open").await.json();
    assert_eq!(ids(&open), [id.as_str()], "before the machine is heard");
    let outage_before = machine.outage.clone();
    drop(machine);
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    (machine.mode, machine.gnss, machine.outage) = (Mode::Fallback, GnssState::Silent, outage_before);
    let goes_on = |view: &Value| view["gnss"]["outage"]["id"] == id.as_str();
    says(&mut machine, address, "/api/v1/machines/a", goes_on).await;
    (machine.mode, machine.gnss, machine.outage) = (Mode::Main, GnssState::Fixed, Some(outage(3, true)));
    says(&mut machine, address, "/api/v1/outages?state=ended", |list| ids(list).len() == 4).await;

    // Pages join to the whole list, and filters choose.
    let all = ids(&get(address, "/api/v1/outages").await.json());
    let first = get(address, "/api/v1/outages?limit=3").await.json();
    let next = first["next"].as_str().expect("goes on");
    let second = get(address, &format!("/api/v1/outages?limit=3&cursor={next}")).await.json();
    assert_eq!((ids(&first).len(), ids(&second).len(), &second["next"]), (3, 1, &Value::Null));
    assert_eq!([ids(&first), ids(&second)].concat(), all);
    for (query, count) in [
        ("cause=frozen", 1),
        ("cause=silent&machine=a", 3),
        ("machine=b", 0),
        ("min_duration_s=3600", 0),
        ("to=2020-01-01T00:00:00Z", 0),
        ("from=2020-01-01T00:00:00%2B02:00", 4),
    ] {
        let list = get(address, &format!("/api/v1/outages?{query}")).await.json();
        assert_eq!(ids(&list).len(), count, "{query}: {list}");
    }
    let statistics = get(address, "/api/v1/outages/statistics").await.json();
    let total = &statistics["machines"][0]["total"];
    assert_eq!((&statistics["machines"][0]["machine"], &total["outages"]), (&"a".into(), &4.into()));
    assert!(total["observed_s"].as_f64() > Some(0.05), "what the first run saw: {statistics}");
    assert!(statistics["machines"][0]["days"][0]["day"].as_str().is_some_and(|day| day.len() == 10));
    let map = get(address, "/api/v1/shadow-map?cell_m=5").await;
    assert_eq!(map.header("content-type"), "application/geo+json");
    let map = map.json();
    assert_eq!(
        (&map["type"], map["features"].as_array().map(Vec::len)),
        (&"FeatureCollection".into(), Some(1))
    );
    let properties = &map["features"][0]["properties"];
    assert_eq!((&properties["east_m"], &properties["north_m"]), (&10.0.into(), &20.0.into()));
    let share = properties["share_without_gnss"].as_f64().expect("a number");
    assert!(share > 0.0 && share < 1.0, "{properties}");
    for path in [
        "/api/v1/outages?cursor=nonsense",
        "/api/v1/outages?limit=0",
        "/api/v1/outages?limit=1001",
        "/api/v1/outages?from=yesterday",
        "/api/v1/outages?cause=sleep",
        "/api/v1/outages?colour=red",
        "/api/v1/outages?min_duration_s=-1",
        "/api/v1/outages/statistics?from=2026-01-02T00:00:00Z&to=2026-01-01T00:00:00Z",
        "/api/v1/outages/statistics?from=1990-01-01T00:00:00Z",
        "/api/v1/shadow-map?cell_m=0.5",
        "/api/v1/shadow-map?cell_m=2.5",
    ] {
        let answer = get(address, path).await;
        assert_eq!(answer.status, 400, "{path}");
        assert_eq!(answer.header("content-type"), "application/problem+json", "{path}");
    }
    assert_eq!(get(address, "/api/v1/outages/nothing").await.status, 404);
    site.stop().await;
}
