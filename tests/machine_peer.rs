//! A machine's peer over real Zenoh sessions, seen by somebody who knows only keys and formats.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "what runs in real time is measured in it")]

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use holdfast::config::{self, Link};
use holdfast::link;
use holdfast::machine::{Machine, Options, Source};
use holdfast::record::{RecordWriter, Recorded};
use holdfast::sensors::{Arrival, ImuSample, Reading, Sensor};
use holdfast::simulate::{Scenario, Simulation};
use holdfast::time::Stamp;
use holdfast::wire::{
    Attachment, Batch, BootId, Holdings, JournalHead, Kept, Key, Odometry, RecordRequest, RosMessage, Topic,
    Wanted, WireError, alive_selector, configuration_key, decode_event, decode_journal_page, decode_reading,
    decode_report, encode_json, encode_reading, record_key, topic_key,
};
use tokio::sync::mpsc;
use zenoh::sample::{Sample, SampleKind};

/// Longer than anything here takes, so that a failure is one and no busy computer.
const PATIENCE: Duration = Duration::from_secs(30);

fn scenario() -> Scenario {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("config/scenarios/demo.toml");
    Scenario::load(&path).expect("scenario")
}

/// So many seconds of the demo's first machine.
fn log(seconds: f64) -> (config::Machine, Vec<Arrival>) {
    let scenario = scenario();
    let simulation = Simulation::new(&scenario, 0).ending_at(Stamp::from_seconds(seconds));
    (simulation.machine().clone(), simulation.collect())
}

/// The readings of a log as a recording of the machine `id`, which is gone with the test.
struct Recording(PathBuf);

impl Recording {
    fn of(arrivals: &[Arrival], id: &str, name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("holdfast-machine-{}-{name}.mcap", std::process::id()));
        let mut writer = RecordWriter::create(&path).expect("create");
        for (sequence, arrival) in arrivals.iter().enumerate() {
            let message = Recorded {
                machine: id.to_owned(),
                topic: Topic::Sensor(arrival.reading.sensor()),
                boot: None,
                sequence: sequence as u64,
                received: arrival.arrival,
                sent: arrival.arrival,
                payload: encode_reading(&arrival.reading),
            };
            writer.write(&message).expect("write");
        }
        writer.finish().expect("finish");
        Self(path)
    }
}

impl Drop for Recording {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

struct Seen {
    key: String,
    attachment: Attachment,
    payload: Vec<u8>,
}

fn listening(endpoint: &str) -> config::Zenoh {
    config::Zenoh { listen: vec![endpoint.to_owned()], ..config::Zenoh::default() }
}

/// Somebody else's session that listens as a site does.
struct Observer {
    session: zenoh::Session,
    endpoint: String,
    samples: mpsc::Receiver<Seen>,
    tokens: mpsc::Receiver<(SampleKind, String)>,
}

impl Observer {
    async fn open() -> Self {
        let settings = link::site_config("site", &listening("tcp/127.0.0.1:0"), 2000).expect("settings");
        let session = link::open(settings).await.expect("session");
        let endpoint = session.info().locators().await[0].to_string();
        let (sample_sender, samples) = mpsc::channel(1 << 16);
        let (token_sender, tokens) = mpsc::channel(1 << 16);
        session
            .declare_subscriber("holdfast/site/**")
            .callback(move |sample: Sample| {
                let attachment = sample.attachment().expect("every publication has one").to_bytes();
                let seen = Seen {
                    key: sample.key_expr().as_str().to_owned(),
                    attachment: Attachment::decode(&attachment).expect("ours"),
                    payload: sample.payload().to_bytes().into_owned(),
                };
                sample_sender.try_send(seen).expect("room");
            })
            .background()
            .await
            .expect("subscriber");
        session
            .liveliness()
            .declare_subscriber(alive_selector("site"))
            .history(true)
            .callback(move |sample: Sample| {
                token_sender.try_send((sample.kind(), sample.key_expr().as_str().to_owned())).expect("room");
            })
            .background()
            .await
            .expect("liveliness subscriber");
        Self { session, endpoint, samples, tokens }
    }

    async fn token(&mut self) -> (SampleKind, String) {
        tokio::time::timeout(PATIENCE, self.tokens.recv()).await.expect("in time").expect("open")
    }

    async fn sample(&mut self) -> Seen {
        tokio::time::timeout(PATIENCE, self.samples.recv()).await.expect("in time").expect("open")
    }
}

fn linked(mut machine: config::Machine, endpoint: &str) -> config::Machine {
    machine.link = Link { connect: vec![endpoint.to_owned()], ..Link::default() };
    machine.record.enabled = false;
    machine
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn played_machine_is_seen_whole_by_a_third_party() {
    let mut observer = Observer::open().await;
    let (machine, arrivals) = log(6.0);
    let machine = linked(machine, &observer.endpoint);
    let recording = Recording::of(&arrivals, &machine.id, "played");
    let source = Source::Play { path: recording.0.clone(), recorded_machine: None };
    let before = std::time::SystemTime::now();
    let mut peer = Machine::start(Options { machine, source, speed: 2.0 }).await.expect("start");
    let (kind, alive) = observer.token().await;
    assert_eq!(kind, SampleKind::Put);
    let Ok(Key::Alive { machine: "walker-1", boot, .. }) = Key::parse(&alive) else { panic!("{alive}") };
    assert_eq!(boot, peer.boot());
    tokio::time::timeout(PATIENCE, peer.source_ended()).await.expect("in time");
    let report = peer.stop().await.expect("no panic");
    let (kind, gone) = observer.token().await;
    assert_eq!((kind, gone), (SampleKind::Delete, alive));

    assert_eq!(report.readings, arrivals.len() as u64);
    assert_eq!(report.lost, 0, "{report}");
    let total: u64 = report.published.values().sum();
    let mut counts: BTreeMap<Topic, u64> = BTreeMap::new();
    let mut imu = Vec::new();
    let mut poses = Vec::new();
    let (mut journaled, mut takeovers) = (0, 0);
    for _ in 0..total {
        let seen = observer.sample().await;
        let Ok(Key::Topic { machine: "walker-1", topic, .. }) = Key::parse(&seen.key) else {
            panic!("{}", seen.key)
        };
        let count = counts.entry(topic).or_default();
        assert_eq!(seen.attachment.sequence, *count, "{topic}: a gap");
        assert_eq!(seen.attachment.boot, boot);
        *count += 1;
        match topic {
            Topic::Pose | Topic::Odom => {
                let odometry = Odometry::decode(&seen.payload).expect("odometry");
                assert_eq!(odometry.header.stamp, seen.attachment.stamp);
                if topic == Topic::Pose {
                    assert_eq!(odometry.header.frame_id, "world");
                    poses.push(seen.attachment.stamp);
                }
            }
            Topic::Health => {
                let report = decode_report(&seen.payload).expect("report");
                assert_eq!((report.id.as_str(), report.boot), ("walker-1", boot));
            }
            Topic::Event => drop(decode_event(&seen.payload).expect("event")),
            Topic::Journal => {
                let page = decode_journal_page(&seen.payload).expect("page");
                assert_eq!((page.boot, page.first, page.takeovers), (boot, journaled, takeovers));
                journaled = page.end();
                takeovers += u64::from(page.taken_over.is_some());
            }
            Topic::Sensor(sensor) => {
                let reading = decode_reading(sensor, &seen.payload).expect("reading");
                if let Reading::Imu(sample) = reading {
                    imu.push((seen.attachment.sent, sample));
                }
            }
        }
    }
    assert_eq!(counts, report.published.into_iter().filter(|(_, count)| *count > 0).collect());
    assert_eq!(journaled, report.readings, "the journal has no gap");
    // The last solutions may have come after the last reading.
    let updates = report.updates;
    assert!(takeovers > 50 && takeovers <= updates, "{takeovers} takeovers, {updates} updates");
    assert!(counts[&Topic::Health] >= 3, "{counts:?}");
    // The readings are those of the log, moved to now.
    let logged: Vec<(Stamp, ImuSample)> = arrivals
        .iter()
        .filter_map(|arrival| match arrival.reading {
            Reading::Imu(sample) => Some((arrival.arrival, sample)),
            _ => None,
        })
        .collect();
    assert_eq!(imu.len(), logged.len());
    let shift = imu[0].1.stamp - logged[0].1.stamp;
    for ((sent, sample), (arrival, original)) in imu.iter().zip(&logged) {
        assert_eq!(*sample, ImuSample { stamp: original.stamp + shift, ..*original });
        // Ties of arrival are told apart by nanoseconds.
        assert!((*sent - (*arrival + shift)).as_nanos().abs() < 1000);
    }
    let started = before.duration_since(std::time::UNIX_EPOCH).expect("after 1970").as_secs_f64();
    assert!((imu[0].1.stamp.as_seconds() - started).abs() < 20.0);
    // A pose for every sample once the estimate has started, with that sample's stamp.
    assert!(poses.len() > 100, "{}", poses.len());
    let stamps: Vec<Stamp> = imu.iter().map(|(_, sample)| sample.stamp).collect();
    assert_eq!(poses, stamps[stamps.len() - poses.len()..]);
    link::close(observer.session).await;
}

/// What the machine's own record answers.
async fn ask(observer: &Observer, boot: BootId, request: &RecordRequest) -> Vec<u8> {
    let question = encode_json("question", request).expect("JSON");
    let key = record_key("site", "walker-1", boot);
    let answers = observer.session.get(key).payload(question).await.expect("asked");
    let answer =
        tokio::time::timeout(PATIENCE, answers.recv_async()).await.expect("in time").expect("answered");
    answer.result().expect("no refusal").payload().to_bytes().into_owned()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn record_on_board_gives_out_what_was_sent_as_it_was() {
    let mut observer = Observer::open().await;
    let (machine, _) = log(0.1);
    let mut machine = linked(machine, &observer.endpoint);
    let folder = std::env::temp_dir().join(format!("holdfast-on-board-asked-{}", std::process::id()));
    machine.record = config::OnBoard { directory: folder.clone(), enabled: true, ..machine.record };
    let machine_file = machine.to_toml();
    let source = Source::Simulation { scenario: Box::new(scenario()), index: 0 };
    let peer = Machine::start(Options { machine, source, speed: 1.0 }).await.expect("start");
    let boot = peer.boot();
    tokio::time::sleep(Duration::from_secs(6)).await;
    let holdings =
        Holdings::decode(&ask(&observer, peer.boot(), &RecordRequest::Holdings).await).expect("holdings");
    let key = configuration_key("site", "walker-1", boot);
    let answers = observer.session.get(key).await.expect("asked");
    let answer = answers.recv_async().await.expect("answered");
    let told = answer.result().expect("no refusal").payload().to_bytes().into_owned();
    let head: JournalHead = serde_json::from_slice(&told).expect("JSON");
    assert_eq!((head.software.as_str(), head.machine_file), (env!("CARGO_PKG_VERSION"), machine_file));
    // Of two machines with the same id each answers for itself.
    let other = record_key("site", "walker-1", BootId(!boot.0));
    let answers = observer.session.get(other).await.expect("asked");
    assert!(answers.recv_async().await.is_err(), "answered for another");
    let [held] = &holdings.boots[..] else { panic!("{holdings:?}") };
    assert_eq!((holdings.kept, held.boot, held.current), (Kept::Yes, boot, true));
    let mut wanted: Wanted = held.topics.iter().map(|(topic, range)| (*topic, vec![*range])).collect();
    assert!(wanted.contains_key(&Topic::Journal) && wanted.contains_key(&Topic::Event), "{wanted:?}");
    let mut fetched = BTreeMap::new();
    while !wanted.is_empty() {
        let request = RecordRequest::Messages { boot, wanted: wanted.clone(), bytes: 100_000 };
        let bytes = ask(&observer, boot, &request).await;
        assert!(bytes.len() < 101_000, "{}", bytes.len());
        let batch = Batch::decode(&bytes).expect("batch");
        for (topic, attachment, payload) in batch.messages {
            assert_eq!(fetched.insert((topic, attachment.sequence), (attachment, payload)), None);
        }
        wanted.retain(|topic, ranges| {
            ranges[0][0] = ranges[0][0].max(batch.done[topic]);
            ranges[0][0] <= ranges[0][1]
        });
    }
    peer.stop().await.expect("no panic");
    let mut seen = BTreeMap::new();
    while let Ok(Seen { key, attachment, payload }) = observer.samples.try_recv() {
        let Ok(Key::Topic { topic, .. }) = Key::parse(&key) else { panic!("{key}") };
        seen.insert((topic, attachment.sequence), (attachment, payload));
    }
    assert!(fetched.len() > 1_500, "{}", fetched.len());
    for (name, message) in &fetched {
        assert_eq!(seen.get(name), Some(message), "{name:?}");
    }
    link::close(observer.session).await;
    std::fs::remove_dir_all(folder).expect("removed");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn machine_whose_disk_refuses_says_so_and_works() {
    let mut observer = Observer::open().await;
    let (machine, _) = log(0.1);
    let mut machine = linked(machine, &observer.endpoint);
    // No folder can be made in a file.
    let file = std::env::temp_dir().join(format!("holdfast-on-board-refused-{}", std::process::id()));
    std::fs::write(&file, "").expect("written");
    machine.record = config::OnBoard { directory: file.clone(), enabled: true, ..machine.record };
    let source = Source::Simulation { scenario: Box::new(scenario()), index: 0 };
    let peer = Machine::start(Options { machine, source, speed: 1.0 }).await.expect("start");
    let (mut poses, mut failure) = (0, None);
    while poses < 100 || failure.is_none() {
        let seen = observer.sample().await;
        match Key::parse(&seen.key) {
            Ok(Key::Topic { topic: Topic::Health, .. }) => {
                let record = decode_report(&seen.payload).expect("report").record.expect("told");
                assert!(!record.kept);
                failure = failure.or(record.failure);
            }
            Ok(Key::Topic { topic: Topic::Pose, .. }) => poses += 1,
            _ => {}
        }
    }
    assert!(failure.expect("told").contains("cannot be created"));
    let holdings =
        Holdings::decode(&ask(&observer, peer.boot(), &RecordRequest::Holdings).await).expect("holdings");
    assert_eq!(holdings, Holdings { kept: Kept::NotNow, boots: vec![] });
    peer.stop().await.expect("no panic");
    link::close(observer.session).await;
    std::fs::remove_file(file).expect("removed");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn drivers_publish_to_the_machine_and_nonsense_is_told() {
    let mut observer = Observer::open().await;
    let (machine, arrivals) = log(3.0);
    let mut machine = linked(machine, &observer.endpoint);
    machine.link.listen = vec!["tcp/127.0.0.1:0".to_owned()];
    let key = |sensor| topic_key("site", "walker-1", Topic::Sensor(sensor));
    let peer = Machine::start(Options { machine, source: Source::Zenoh, speed: 1.0 }).await.expect("start");
    observer.token().await;
    let endpoints = peer.listening_on().await;
    let driver_link = Link { connect: endpoints, ..Link::default() };
    let driver = link::open(link::machine_config(&driver_link).expect("settings")).await.expect("driver");
    let publisher = driver.declare_publisher(key(Sensor::Imu)).await.expect("publisher");
    let matching = publisher.matching_listener().await.expect("listener");
    if !publisher.matching_status().await.expect("status").matching() {
        tokio::time::timeout(PATIENCE, matching.recv_async()).await.expect("in time").expect("status");
    }
    let samples: Vec<Reading> = arrivals
        .iter()
        .filter(|arrival| arrival.reading.sensor() == Sensor::Imu)
        .map(|arrival| arrival.reading)
        .collect();
    for reading in &samples {
        publisher.put(encode_reading(reading)).await.expect("put");
    }
    publisher.put(vec![0, 1, 0, 0, 7]).await.expect("put");
    let mut seen_imu = Vec::new();
    let mut complaint = None;
    while seen_imu.len() < samples.len() || complaint.is_none() {
        let seen = observer.sample().await;
        match Key::parse(&seen.key) {
            Ok(Key::Topic { topic: Topic::Sensor(Sensor::Imu), .. }) => {
                seen_imu.push(decode_reading(Sensor::Imu, &seen.payload).expect("reading"));
            }
            Ok(Key::Topic { topic: Topic::Event, .. }) => {
                let text = String::from_utf8(seen.payload).expect("JSON");
                if text.contains("sensor_msgs/msg/Imu: ends at byte 5") {
                    complaint = Some(text);
                }
            }
            _ => {}
        }
    }
    assert_eq!(seen_imu, samples);
    link::close(driver).await;
    let report = peer.stop().await.expect("no panic");
    // Our own republished readings did not come back in.
    assert_eq!((report.readings, report.lost), (samples.len() as u64, 1), "{report}");
    link::close(observer.session).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn machine_starts_without_its_site_is_found_when_it_comes_and_stops_at_once() {
    // An address where nobody listens: taken, and given back.
    let free = std::net::TcpListener::bind("127.0.0.1:0").expect("bind").local_addr().expect("address");
    let scenario = scenario();
    let machine = linked(scenario.machines[1].clone(), &format!("tcp/{free}"));
    let source = Source::Simulation { scenario: Box::new(scenario), index: 1 };
    let peer = Machine::start(Options { machine, source, speed: 1.0 }).await.expect("start");
    let settings = link::site_config("site", &listening(&format!("tcp/{free}")), 2000).expect("settings");
    let site = link::open(settings).await.expect("site");
    let (sender, mut receiver) = mpsc::channel(1 << 16);
    site.declare_subscriber("holdfast/site/walker-2/sensor/imu")
        .callback(move |sample: Sample| {
            sender.try_send(sample.payload().to_bytes().into_owned()).expect("room");
        })
        .background()
        .await
        .expect("subscriber");
    let payload = tokio::time::timeout(PATIENCE, receiver.recv()).await.expect("in time").expect("open");
    let reading: Result<Reading, WireError> = decode_reading(Sensor::Imu, &payload);
    assert!(reading.is_ok());
    let stopped = std::time::Instant::now();
    peer.stop().await.expect("no panic");
    assert!(stopped.elapsed() < Duration::from_secs(5), "{:?}", stopped.elapsed());
    link::close(site).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sources_that_cannot_be_played_are_refused_by_name() {
    let (machine, arrivals) = log(0.5);
    let recording = Recording::of(&arrivals, "somebody", "refused");
    let refused = |path: PathBuf, recorded_machine: Option<&str>| {
        let recorded_machine = recorded_machine.map(str::to_owned);
        let source = Source::Play { path, recorded_machine };
        let machine = linked(machine.clone(), "tcp/127.0.0.1:1");
        async move {
            match Machine::start(Options { machine, source, speed: 1.0 }).await {
                Ok(_) => panic!("must be refused"),
                Err(error) => error.to_string(),
            }
        }
    };
    let message = refused(recording.0.clone(), Some("nobody")).await;
    assert!(message.contains("holds no readings of nobody, but of: somebody"), "{message}");
    let message = refused(PathBuf::from("/nowhere/s.mcap"), None).await;
    assert!(message.contains("/nowhere/s.mcap: cannot be opened"), "{message}");
}

/// The binary, as a process of its own; killed with the test.
struct Process(std::process::Child);

impl Process {
    fn machine(endpoint: &str) -> Self {
        let scenario = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("config/scenarios/demo.toml");
        let child = std::process::Command::new(env!("CARGO_BIN_EXE_holdfast"))
            .args(["machine", "--machine", "walker-1", "--connect", endpoint, "--scenario"])
            .arg(scenario)
            .arg("--record")
            .arg(std::env::temp_dir().join(format!("holdfast-on-board-{}", std::process::id())))
            .stderr(std::process::Stdio::null())
            .spawn()
            .expect("spawn");
        Self(child)
    }

    fn signal(&self, name: &str) {
        let kill = std::process::Command::new("kill").arg(name).arg(self.0.id().to_string()).status();
        assert!(kill.expect("kill").success());
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn process_ends_cleanly_on_a_signal_and_its_death_is_seen() {
    let mut observer = Observer::open().await;
    for signal in ["-INT", "-TERM", "-KILL"] {
        let mut process = Process::machine(&observer.endpoint);
        let (kind, alive) = observer.token().await;
        assert_eq!(kind, SampleKind::Put, "{signal}");
        while Key::parse(&observer.sample().await.key).is_err() {}
        process.signal(signal);
        let signalled = std::time::Instant::now();
        assert_eq!(observer.token().await, (SampleKind::Delete, alive), "{signal}");
        assert!(signalled.elapsed() < Duration::from_secs(2), "{signal}: {:?}", signalled.elapsed());
        let status =
            tokio::task::spawn_blocking(move || process.0.wait()).await.expect("join").expect("wait");
        assert_eq!(status.success(), signal != "-KILL", "{signal}: {status}");
        while observer.samples.try_recv().is_ok() {}
    }
    link::close(observer.session).await;
}
