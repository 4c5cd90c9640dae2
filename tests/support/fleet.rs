//! A site and its machines as processes of their own, with a link between them that can be cut, and what the
//! machines recorded held against what the site did.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

#[path = "process.rs"]
mod process;

use holdfast::record::{self, RecordError, Recorded};
use holdfast::wire::{BootId, Topic};
use process::repository;
pub use process::{Dice, PATIENCE, Process};
use serde_json::Value;

/// What a link does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Link {
    Whole,
    /// Connections break, and new ones do too.
    Cut,
    /// Connections stand, and nothing comes through: a dead radio.
    Silent,
}

/// A TCP link that can be cut.
pub struct Proxy {
    address: SocketAddr,
    state: Arc<Mutex<State>>,
    stopped: Arc<AtomicBool>,
}

struct State {
    link: Link,
    target: Option<SocketAddr>,
    open: Vec<TcpStream>,
}

impl Proxy {
    pub fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("bind");
        let address = listener.local_addr().expect("address");
        let state = Arc::new(Mutex::new(State { link: Link::Whole, target: None, open: vec![] }));
        let stopped = Arc::new(AtomicBool::new(false));
        let (for_thread, until) = (Arc::clone(&state), Arc::clone(&stopped));
        std::thread::spawn(move || {
            for inward in listener.incoming() {
                if until.load(Ordering::Relaxed) {
                    return;
                }
                if let Ok(inward) = inward {
                    connect(inward, &for_thread);
                }
            }
        });
        Self { address, state, stopped }
    }

    pub fn endpoint(&self) -> String {
        format!("tcp/{}", self.address)
    }

    /// Where connections go from now on, such as `tcp/127.0.0.1:7447`.
    pub fn lead_to(&self, endpoint: &str) {
        let address = endpoint.trim_start_matches("tcp/").parse().expect("an address");
        self.state.lock().expect("proxy").target = Some(address);
    }

    pub fn set(&self, link: Link) {
        let mut state = self.state.lock().expect("proxy");
        // What stood still must not go on as if nothing had been: the network has forgotten it.
        if link != Link::Silent {
            for stream in state.open.drain(..) {
                let _ = stream.shutdown(Shutdown::Both);
            }
        }
        state.link = link;
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.stopped.store(true, Ordering::Relaxed);
        self.set(Link::Cut);
        let _ = TcpStream::connect(self.address);
    }
}

fn connect(inward: TcpStream, state: &Arc<Mutex<State>>) {
    let target = {
        let state = state.lock().expect("proxy");
        if state.link == Link::Whole { state.target } else { None }
    };
    let Some(outward) = target.and_then(|target| TcpStream::connect(target).ok()) else { return };
    let _ = (inward.set_nodelay(true), outward.set_nodelay(true));
    let copies = |stream: &TcpStream| stream.try_clone().expect("handle");
    state.lock().expect("proxy").open.extend([copies(&inward), copies(&outward)]);
    for (from, to) in [(copies(&inward), copies(&outward)), (outward, inward)] {
        let state = Arc::clone(state);
        std::thread::spawn(move || forward(from, to, &state));
    }
}

fn forward(mut from: TcpStream, mut to: TcpStream, state: &Mutex<State>) {
    let mut block = vec![0; 1 << 16];
    while let Ok(count) = from.read(&mut block) {
        // A silent link takes what fits into its buffers, and keeps it.
        while state.lock().expect("proxy").link == Link::Silent {
            std::thread::sleep(Duration::from_millis(5));
        }
        if count == 0 || to.write_all(&block[..count]).is_err() {
            break;
        }
    }
    let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
}

/// Where everything of a test is: `site/` the site's data, `on-board/` the machines' records.
pub struct Yard {
    pub folder: PathBuf,
    pub proxy: Proxy,
    holdfast: PathBuf,
    /// What the machine files say beyond the demo's.
    pub machine_extra: String,
    pub speed: f64,
}

impl Yard {
    pub fn new(folder: PathBuf, holdfast: &str) -> Self {
        let _ = std::fs::remove_dir_all(&folder);
        for part in ["site", "machines", "scenarios", "logs"] {
            std::fs::create_dir_all(folder.join(part)).expect("folder");
        }
        Self {
            folder,
            proxy: Proxy::start(),
            holdfast: holdfast.into(),
            machine_extra: String::new(),
            speed: 1.0,
        }
    }

    fn log(&self, name: &str) -> Stdio {
        let path = self.folder.join("logs").join(name);
        std::fs::File::options().create(true).append(true).open(path).expect("log").into()
    }

    /// Starts the site; the machines' link leads there. Returns where its API is, too.
    pub fn site(&self) -> (Process, String) {
        let mut process =
            process::site(&self.holdfast, &self.folder, &self.folder.join("site"), self.log("site"));
        let (dashboard, endpoint) = process.addresses();
        self.proxy.lead_to(&endpoint);
        (process, dashboard)
    }

    pub fn machine(&self, id: &str) -> Process {
        let scenario = self.folder.join("scenarios/demo.toml");
        for name in ["scenarios/demo.toml", "machines/simulated-roof.toml", "machines/simulated-floor.toml"] {
            let mut text = std::fs::read_to_string(repository("config").join(name)).expect("a file of ours");
            if name.starts_with("machines") {
                text.push_str(&self.machine_extra);
            }
            let path = self.folder.join(name);
            if std::fs::read_to_string(&path).ok().as_ref() != Some(&text) {
                std::fs::write(path, text).expect("written");
            }
        }
        let mut command = Command::new(&self.holdfast);
        command.arg("machine").arg("--scenario").arg(scenario).args(["--machine", id]);
        command.arg("--record").arg(self.folder.join("on-board"));
        command.args(["--connect", &self.proxy.endpoint(), "--speed", &self.speed.to_string()]);
        Process::start(command.stdout(Stdio::null()).stderr(self.log(id)))
    }

    /// The files of the site's sessions, oldest first.
    pub fn recordings(&self) -> Vec<PathBuf> {
        let sessions = std::fs::read_dir(self.folder.join("site/sessions")).into_iter().flatten().flatten();
        let files = sessions.flat_map(|session| mcap_files(&session.path()));
        let mut files: Vec<_> = files.collect();
        files.sort_by_key(|file| {
            (std::fs::metadata(file).and_then(|about| about.created()).expect("a birth time"), file.clone())
        });
        files
    }

    /// What a machine has on board, oldest first.
    pub fn on_board(&self, id: &str) -> Vec<PathBuf> {
        let mut files = mcap_files(&self.folder.join("on-board").join(id));
        files.sort();
        files
    }
}

fn mcap_files(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.filter(|path| path.extension().is_some_and(|extension| extension == "mcap")).collect()
}

/// What the API says; `None` while it does not answer.
pub fn get(address: &str, path: &str) -> Option<Value> {
    ask(address, "GET", path)
}

/// What the API says to a request without a body.
#[allow(dead_code, reason = "each test takes what it needs")]
pub fn post(address: &str, path: &str) -> Option<Value> {
    ask(address, "POST", path)
}

fn ask(address: &str, method: &str, path: &str) -> Option<Value> {
    let mut stream = TcpStream::connect(address).ok()?;
    let head = format!("{method} {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n");
    write!(stream, "{head}Content-Length: 0\r\n\r\n").ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    let (_, body) = answer.split_once("\r\n\r\n")?;
    serde_json::from_str(body).ok()
}

pub fn machine_view(address: &str, id: &str) -> Option<Value> {
    get(address, &format!("/api/v1/machines/{id}"))
}

/// Waits until something holds of a machine's view; returns how long that took.
pub fn until(address: &str, id: &str, what: &str, holds: impl Fn(&Value) -> bool) -> Duration {
    let begun = Instant::now();
    let mut last = None;
    loop {
        if let Some(view) = machine_view(address, id) {
            if holds(&view) {
                return begun.elapsed();
            }
            last = Some(view);
        }
        assert!(begun.elapsed() < PATIENCE, "{id} is not {what}: {last:#?}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Poses come, and are young.
pub fn is_live(view: &Value) -> bool {
    view["presence"] == "online" && view["pose"]["age_s"].as_f64().is_some_and(|age_s| age_s < 0.5)
}

/// The recording lacks nothing that is known to be missing.
pub fn lacks_nothing(view: &Value) -> bool {
    view["link"]["gaps_open"] == 0
}

/// Waits until nothing is missing, and still nothing some time later: the site asks every five seconds.
pub fn until_complete(address: &str, id: &str) -> Duration {
    let begun = Instant::now();
    let mut since = Instant::now();
    let mut at_end = Duration::ZERO;
    while since.elapsed() < Duration::from_secs(6) {
        let view = machine_view(address, id).unwrap_or_default();
        if !lacks_nothing(&view) {
            since = Instant::now();
            at_end = begun.elapsed();
        }
        assert!(begun.elapsed() < PATIENCE + PATIENCE, "{id} lacks {}", view["link"]);
        std::thread::sleep(Duration::from_millis(50));
    }
    at_end
}

/// One message, by its boot, topic and number.
pub type Name = (BootId, Topic, u64);

/// The messages of a machine in some files: their payloads, and those that are there more than once.
pub struct Contents {
    pub messages: BTreeMap<Name, Vec<u8>>,
    pub doubles: Vec<Name>,
    pub boots: BTreeSet<BootId>,
}

/// Reads files, and makes proper ones of those that are torn.
pub fn contents(files: &[PathBuf], machine: &str) -> Contents {
    let mut contents = Contents { messages: BTreeMap::new(), doubles: vec![], boots: BTreeSet::new() };
    for path in files {
        if let Err(RecordError::Unfinished { .. }) = record::inspect(path) {
            record::recover(path).unwrap_or_else(|error| panic!("{error}"));
        }
        for message in record::read_messages(path).expect("opens") {
            let message: Recorded<Vec<u8>> = message.expect("reads");
            if message.machine != machine {
                continue;
            }
            let boot = message.boot.expect("every recording tells boots");
            contents.boots.insert(boot);
            let name = (boot, message.topic, message.sequence);
            if contents.messages.insert(name, message.payload).is_some() {
                contents.doubles.push(name);
            }
        }
    }
    contents
}

/// Everything that is on board is recorded, as it is, and once. Returns how many messages that are.
pub fn assert_complete(yard: &Yard, id: &str) -> usize {
    let on_board = contents(&yard.on_board(id), id);
    let recorded = contents(&yard.recordings(), id);
    assert_eq!(on_board.doubles, [], "{id}: on board");
    let doubles: Vec<_> = recorded.doubles.iter().take(10).collect();
    assert!(doubles.is_empty(), "{id}: {} twice: {doubles:?}", recorded.doubles.len());
    let missing: Vec<_> =
        on_board.messages.keys().filter(|name| !recorded.messages.contains_key(*name)).collect();
    assert!(
        missing.is_empty(),
        "{id}: {} of {} are missing: {:?}",
        missing.len(),
        on_board.messages.len(),
        &missing[..missing.len().min(10)]
    );
    for (name, payload) in &on_board.messages {
        assert!(recorded.messages[name] == *payload, "{id}: {name:?} is another");
    }
    on_board.messages.len()
}
