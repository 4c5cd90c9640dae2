//! Many machines at once on one site, with people watching: what arrives, what is recorded, how late the page hears of
//! it, and what it costs.
//!
//! `cargo bench --bench load -- machines=20 seconds=60 clients=0`: everything of 20 machines is recorded (poses, odom,
//! all sensors). `cargo bench --bench load -- machines=100 seconds=60 clients=50 sensors=0`: poses at 100 Hz, and 50
//! live clients at 10 Hz, of which one takes nothing. Ends with an error unless each message that was published is in the
//! recording once.
//!
//! One machine is simulated and estimated before; its messages go out with the stamps of now from as many peers as
//! are asked for, all in one process beside the site, with Zenoh sessions of their own.
#![allow(clippy::disallowed_methods, reason = "machines and people have clocks")]

use std::collections::BTreeMap;
use std::io::BufRead as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use futures_util::{SinkExt as _, StreamExt as _};
use holdfast::estimator::Estimator;
use holdfast::record::{self, Recorded};
use holdfast::simulate::{Scenario, Simulation};
use holdfast::state::Health;
use holdfast::time::{Span, Stamp};
use holdfast::wire::{
    self, Attachment, BootId, MachineReport, RigidMotion, RosMessage as _, Topic, encode_reading,
};
use holdfast::{config, link};
use serde_json::Value;
use tokio_tungstenite::tungstenite::Message;
use zenoh::qos::CongestionControl;

#[path = "../tests/support/process.rs"]
mod process;

use process::{Process, repository};

/// So much of a machine's life is simulated, and goes round.
const ROUND: Span = Span::from_millis(60_000);
/// The estimator has started by then.
const BEGINS: Span = Span::from_millis(10_000);
/// CPU time is told in these, on every Linux.
const TICKS_PER_S: f64 = 100.0;

fn main() {
    let word = |name: &str| {
        let find = |argument: String| Some(argument.strip_prefix(name)?.strip_prefix('=')?.to_owned());
        std::env::args().find_map(find)
    };
    let number = |name: &str, default: usize| {
        word(name)
            .map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name}={text} is no number")))
    };
    let load = Load {
        machines: number("machines", 20),
        seconds: number("seconds", 60),
        clients: number("clients", 0),
        sensors: number("sensors", 1) != 0,
    };
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let runtime = runtime.expect("a runtime");
    match word("publish") {
        Some(endpoint) => runtime.block_on(publish(&load, &endpoint)),
        None => runtime.block_on(watch(&load)),
    }
}

struct Load {
    machines: usize,
    seconds: usize,
    clients: usize,
    sensors: bool,
}

impl Load {
    fn arguments(&self) -> [String; 3] {
        let Self { machines, seconds, sensors, .. } = self;
        [
            format!("machines={machines}"),
            format!("seconds={seconds}"),
            format!("sensors={}", u8::from(*sensors)),
        ]
    }
}

fn now() -> Stamp {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970");
    Stamp::from_nanos(i64::try_from(since_epoch.as_nanos()).expect("before 2262"))
}

/// What one machine says in a round, by the time since its beginning.
struct Round {
    messages: Vec<(Span, Topic, Vec<u8>)>,
    health: Vec<(Span, Health)>,
    machine: config::Machine,
}

impl Round {
    fn simulate(sensors: bool) -> Self {
        let path = repository("config/scenarios/demo.toml");
        let scenario = Scenario::load(&path).unwrap_or_else(|error| panic!("{error}"));
        let simulation = Simulation::new(&scenario, 0);
        let machine = simulation.machine().clone();
        let mut estimator = Estimator::new(machine.estimator_options());
        let mut messages = Vec::new();
        let mut health: Vec<(Span, Health)> = Vec::new();
        let mut first = None;
        for arrival in simulation {
            let begun = *first.get_or_insert(arrival.arrival + BEGINS);
            let at = arrival.arrival - begun;
            if at > ROUND {
                break;
            }
            let estimate = estimator.push(&arrival);
            if at < Span::default() {
                continue;
            }
            if sensors {
                let topic = Topic::Sensor(arrival.reading.sensor());
                messages.push((at, topic, encode_reading(&arrival.reading)));
            }
            if let Some(estimate) = estimate {
                messages.push((at, Topic::Pose, wire::pose_message(&estimate).encode()));
                messages.push((at, Topic::Odom, wire::odom_message(&estimate).encode()));
                if health.last().is_none_or(|(last, _)| at.as_nanos() - last.as_nanos() >= 1_000_000_000) {
                    health.push((at, estimator.health()));
                }
            }
        }
        Self { messages, health, machine }
    }
}

/// Every ROS message of ours begins with the stamp of its header, behind the four bytes that say how it is encoded.
fn restamp(payload: &[u8], stamp: Stamp) -> Vec<u8> {
    let mut payload = payload.to_vec();
    let (seconds, nanos) = (stamp.as_nanos() / 1_000_000_000, stamp.as_nanos() % 1_000_000_000);
    payload[4..8].copy_from_slice(&(seconds as i32).to_le_bytes());
    payload[8..12].copy_from_slice(&(nanos as u32).to_le_bytes());
    payload
}

/// The child: all machines; says how many messages each published.
async fn publish(load: &Load, endpoint: &str) {
    let round = Arc::new(Round::simulate(load.sensors));
    let mut machines = Vec::new();
    for index in 0..load.machines {
        let peer = Peer::connect(Arc::clone(&round), index, endpoint).await;
        machines.push(tokio::spawn(peer.speak(Duration::from_secs(load.seconds as u64), load.machines)));
    }
    for machine in machines {
        println!("{}", machine.await.expect("speaks"));
    }
}

struct Peer {
    round: Arc<Round>,
    index: usize,
    id: String,
    boot: BootId,
    session: zenoh::Session,
    publishers: BTreeMap<Topic, zenoh::pubsub::Publisher<'static>>,
    sequences: BTreeMap<Topic, u64>,
    _alive: zenoh::liveliness::LivelinessToken,
}

impl Peer {
    async fn connect(round: Arc<Round>, index: usize, endpoint: &str) -> Self {
        let (id, boot) = (format!("load-{index}"), BootId(1 + index as u64));
        let mut to = round.machine.link.clone();
        to.connect = vec![endpoint.parse().unwrap_or_else(|error| panic!("{endpoint}: {error}"))];
        let settings = link::machine_config(&to).unwrap_or_else(|error| panic!("{error}"));
        let session = link::open(settings).await.unwrap_or_else(|error| panic!("{error}"));
        let mut publishers = BTreeMap::new();
        for topic in Topic::ALL {
            let declared = session.declare_publisher(wire::topic_key(&to.site, &id, topic));
            let publisher = declared.congestion_control(CongestionControl::Drop).await.expect("declared");
            publishers.insert(topic, publisher);
        }
        let alive = session.liveliness().declare_token(wire::alive_key(&to.site, &id, boot)).await;
        let _alive = alive.expect("declared");
        Self { round, index, id, boot, session, publishers, sequences: BTreeMap::new(), _alive }
    }

    async fn put(&mut self, topic: Topic, payload: Vec<u8>, stamp: Stamp) {
        let sequence = self.sequences.entry(topic).or_default();
        let attachment = Attachment { sequence: *sequence, boot: self.boot, stamp, sent: stamp };
        *sequence += 1;
        let put = self.publishers[&topic].put(payload).attachment(attachment.encode().to_vec());
        put.await.expect("put");
    }

    async fn speak(mut self, lasts: Duration, machines: usize) -> Value {
        // The link stands before the first message counts; and no two machines tick together.
        tokio::time::sleep(Duration::from_secs(3)).await;
        let aside = Duration::from_millis(10).mul_f64(self.index as f64 / machines as f64);
        tokio::time::sleep(aside).await;
        let round = Arc::clone(&self.round);
        let begun = Instant::now();
        let mut ticks = tokio::time::interval(Duration::from_millis(10));
        let (mut laps, mut next, mut next_health) = (0_u32, 0, 0);
        while begun.elapsed() < lasts {
            ticks.tick().await;
            // A round may be told a moment before its time is over.
            let behind = Duration::from_nanos(ROUND.as_nanos() as u64) * laps;
            let since = begun.elapsed().saturating_sub(behind);
            let due = |at: Span| at.as_nanos() <= since.as_nanos() as i64;
            while let Some((_, topic, payload)) = round.messages.get(next).filter(|message| due(message.0)) {
                let stamp = now();
                self.put(*topic, restamp(payload, stamp), stamp).await;
                next += 1;
            }
            while let Some((_, health)) = round.health.get(next_health).filter(|health| due(health.0)) {
                let report = self.report(health.clone());
                let payload = wire::encode_json("machine report", &report).expect("JSON");
                self.put(Topic::Health, payload, now()).await;
                next_health += 1;
            }
            if next == round.messages.len() {
                (laps, next, next_health) = (laps + 1, 0, 0);
            }
        }
        tokio::time::sleep(Duration::from_secs(2)).await;
        let counts: BTreeMap<String, u64> =
            self.sequences.iter().map(|(topic, count)| (topic.name().to_owned(), *count)).collect();
        self.session.close().await.expect("closes");
        serde_json::json!({ "id": self.id, "counts": counts })
    }

    fn report(&self, mut health: Health) -> MachineReport {
        health.stamp_ns = now().as_nanos();
        let machine = &self.round.machine;
        MachineReport {
            id: self.id.clone(),
            name: self.id.clone(),
            software: env!("CARGO_PKG_VERSION").to_owned(),
            boot: self.boot,
            world: machine.world.site_frame().origin().into(),
            cabin_from_imu: RigidMotion::from(
                &machine.frames.cabin_from_imu.pose::<holdfast::frames::Cabin, holdfast::frames::Imu>(),
            ),
            world_from_odom: None,
            estimate_age_s: Some(0.001),
            prediction: None,
            record: None,
            health,
        }
    }
}

/// What the site has taken of the computer.
#[derive(Clone, Copy, Default)]
struct Cost {
    cpu_s: f64,
    memory_mb: f64,
}

fn cost(process: &Process) -> Cost {
    let read = |what: &str| std::fs::read_to_string(format!("/proc/{}/{what}", process.id())).expect("runs");
    let stat = read("stat");
    let fields: Vec<&str> = stat.rsplit_once(") ").expect("a name").1.split(' ').collect();
    // User and system time are the 14th and 15th field, of which the first two are cut off.
    let ticks = [11, 12].map(|field: usize| fields[field].parse::<f64>().expect("ticks"));
    let status = read("status");
    let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("a size");
    let resident_kb: f64 = resident.trim().trim_end_matches(" kB").parse().expect("kB");
    Cost { cpu_s: ticks.iter().sum::<f64>() / TICKS_PER_S, memory_mb: resident_kb / 1024.0 }
}

/// Reads what comes; the first client looks at the stamps, too: from publication to the frame, s.
async fn client(address: String, measures: bool, frames: Arc<AtomicU64>) -> Vec<f64> {
    let connected = tokio_tungstenite::connect_async(format!("ws://{address}/api/v1/live")).await;
    let mut socket = connected.expect("connects").0;
    let wish = r#"{"type":"subscribe","rate_hz":10}"#;
    socket.send(Message::text(wish)).await.expect("sent");
    let mut latencies = Vec::new();
    // The site's end is the client's.
    while let Some(Ok(message)) = socket.next().await {
        let Message::Text(text) = message else { continue };
        frames.fetch_add(1, Ordering::Relaxed);
        if !measures {
            continue;
        }
        let received = now();
        let frame: Value = serde_json::from_str(text.as_str()).expect("JSON");
        assert_eq!(frame["dropped"].as_u64().unwrap_or(0), 0, "the client that measures is fast enough");
        for machine in frame["machines"].as_array().into_iter().flatten() {
            // Young ones only: when a machine has ended its last pose is told on and on.
            let age_s = machine["pose"]["age_s"].as_f64().unwrap_or(f64::INFINITY);
            if let Some(stamp) = machine["pose"]["stamp"].as_str().filter(|_| age_s < 0.1) {
                let published: jiff::Timestamp = stamp.parse().expect("RFC 3339");
                latencies.push((i128::from(received.as_nanos()) - published.as_nanosecond()) as f64 / 1e9);
            }
        }
    }
    latencies
}

/// Asks for frames and never reads one.
async fn stalled_client(address: String) {
    let connected = tokio_tungstenite::connect_async(format!("ws://{address}/api/v1/live")).await;
    let _open = connected.expect("connects").0;
    std::future::pending::<()>().await;
}

async fn watch(load: &Load) {
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("bench-load");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(folder.join("site")).expect("a folder");
    let log = std::fs::File::create(folder.join("log")).expect("a file");
    let holdfast = Path::new(env!("CARGO_BIN_EXE_holdfast"));
    let mut site = process::site(holdfast, &folder, &folder.join("site"), log.into());
    let (address, endpoint) = site.addresses();
    let mut generator = Command::new(std::env::current_exe().expect("this program"));
    generator.arg(format!("publish={endpoint}")).args(load.arguments()).stdout(Stdio::piped());
    let mut generator = generator.spawn().expect("starts");
    let said = std::io::BufReader::new(generator.stdout.take().expect("piped"));
    let frames = Arc::new(AtomicU64::new(0));
    let clients: Vec<_> = (0..load.clients)
        .map(|index| tokio::spawn(client(address.clone(), index == 0, Arc::clone(&frames))))
        .collect();
    let stalled = (load.clients > 0).then(|| tokio::spawn(stalled_client(address.clone())));
    // Until all speak; then the cost is that of the load.
    tokio::time::sleep(Duration::from_secs(8)).await;
    let (begun, before) = (Instant::now(), cost(&site));
    let mut memory_mb = Vec::new();
    while begun.elapsed() < Duration::from_secs(load.seconds.saturating_sub(8) as u64) {
        tokio::time::sleep(Duration::from_secs(1)).await;
        memory_mb.push(cost(&site).memory_mb);
    }
    let (after, lasted_s) = (cost(&site), begun.elapsed().as_secs_f64());
    let published = tokio::task::spawn_blocking(move || {
        let lines = said.lines().map(|line| serde_json::from_str(&line.expect("text")).expect("JSON"));
        lines.collect::<Vec<Value>>()
    });
    let published = published.await.expect("read");
    assert!(generator.wait().expect("ended").success(), "the machines spoke to the end");
    site.end();
    if let Some(stalled) = stalled {
        stalled.abort();
    }
    let mut latencies = Vec::new();
    for client in clients {
        latencies.extend(client.await.expect("reads"));
    }
    report_costs(load, lasted_s, [before, after], &memory_mb);
    if load.clients > 0 {
        latencies.sort_by(f64::total_cmp);
        let at = |share: f64| 1e3 * latencies[(share * (latencies.len() - 1) as f64) as usize];
        println!(
            "publication to WebSocket frame: p50 {:.0} ms, p99 {:.0} ms, max {:.0} ms; {} frames, {:.1} Hz a client",
            at(0.5),
            at(0.99),
            at(1.0),
            frames.load(Ordering::Relaxed),
            frames.load(Ordering::Relaxed) as f64 / load.clients as f64 / load.seconds as f64
        );
    }
    compare(&folder.join("site"), &published, load.seconds as f64);
}

fn report_costs(load: &Load, lasted_s: f64, [before, after]: [Cost; 2], memory_mb: &[f64]) {
    println!(
        "{} machines, {} live clients: the site takes {:.0} % of one core",
        load.machines,
        load.clients,
        100.0 * (after.cpu_s - before.cpu_s) / lasted_s
    );
    let fifth = memory_mb.len().div_ceil(5).max(1);
    let largest = |part: &[f64]| part.iter().copied().fold(0.0, f64::max);
    println!(
        "memory: at most {:.0} MB in the first fifth, {:.0} MB in the last",
        largest(&memory_mb[..fifth.min(memory_mb.len())]),
        largest(&memory_mb[memory_mb.len().saturating_sub(fifth)..])
    );
}

/// Holds the recording against what was published.
fn compare(data: &Path, published: &[Value], seconds: f64) {
    let sessions = std::fs::read_dir(data.join("sessions")).expect("sessions").flatten();
    let files =
        sessions.flat_map(|session| std::fs::read_dir(session.path()).into_iter().flatten().flatten());
    let files: Vec<PathBuf> = files
        .map(|file| file.path())
        .filter(|path| path.extension().is_some_and(|is| is == "mcap"))
        .collect();
    // How often each number is there.
    let mut recorded: BTreeMap<(String, String), BTreeMap<u64, u64>> = BTreeMap::new();
    let mut bytes = 0;
    for file in &files {
        bytes += std::fs::metadata(file).expect("a file").len();
        for message in record::read_messages(file).unwrap_or_else(|error| panic!("{error}")) {
            let message: Recorded<Vec<u8>> = message.unwrap_or_else(|error| panic!("{error}"));
            let of_topic = recorded.entry((message.machine, message.topic.name().to_owned())).or_default();
            *of_topic.entry(message.sequence).or_default() += 1;
        }
    }
    let (mut all, mut missing, mut too_many) = (0, 0, 0);
    for machine in published {
        let id = machine["id"].as_str().expect("an id");
        for (topic, count) in machine["counts"].as_object().expect("counts") {
            let count = count.as_u64().expect("a number");
            let there = recorded.remove(&(id.to_owned(), topic.clone())).unwrap_or_default();
            let lacks: Vec<u64> = (0..count).filter(|number| !there.contains_key(number)).collect();
            let more: Vec<u64> = there
                .iter()
                .filter(|(number, times)| **number >= count || **times > 1)
                .map(|one| *one.0)
                .collect();
            all += count;
            missing += lacks.len();
            too_many += more.len();
            for (what, numbers) in
                [("are not recorded", &lacks), ("are there twice, or were never sent", &more)]
            {
                if let (Some(first), Some(last)) = (numbers.first(), numbers.last()) {
                    println!("{id}: of {count} {topic}, {} {what}: {first} to {last}", numbers.len());
                }
            }
        }
    }
    // What the machines do not count, somebody else has said.
    let others: Vec<_> = recorded.keys().collect();
    assert!(others.is_empty(), "nobody published these: {others:?}");
    println!(
        "{all} messages published, {:.0} a second, {missing} of them not recorded, {too_many} twice; {:.0} MB a \
         machine-hour",
        all as f64 / seconds,
        bytes as f64 / 1e6 / (published.len() as f64 * seconds / 3600.0)
    );
    assert_eq!((missing, too_many), (0, 0), "every message is recorded, and once");
}
