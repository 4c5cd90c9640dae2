//! Processes of ours that live as long as a test, and the dice by which it breaks them.
#![allow(dead_code, reason = "each test takes what it needs")]

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Nothing takes so long unless it is broken.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// Seeded dice, as good as breaking things needs (SplitMix64).
pub struct Dice(u64);

impl Dice {
    /// Of a seed that is printed; the environment variable `name` repeats one.
    pub fn seeded(name: &str) -> Self {
        let told = std::env::var(name).ok().and_then(|text| text.parse().ok());
        let since = SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970");
        let seed = told.unwrap_or(since.as_nanos() as u64);
        println!("{name}={seed}");
        Self(seed)
    }

    pub fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (mixed ^ (mixed >> 31)) % end
    }

    pub fn millis(&mut self, from: u64, to: u64) -> Duration {
        Duration::from_millis(from + self.below(to - from))
    }
}

/// A process; it does not outlive the test.
pub struct Process(Child);

impl Process {
    pub fn start(command: &mut Command) -> Self {
        Self(command.spawn().expect("starts"))
    }

    pub fn id(&self) -> u32 {
        self.0.id()
    }

    pub fn kill(&mut self) {
        self.0.kill().expect("SIGKILL");
        self.0.wait().expect("ended");
    }

    /// Asks it to end, and waits for that.
    pub fn end(&mut self) {
        let id = i32::try_from(self.0.id()).expect("a process id");
        // SAFETY: a signal to a process that we started and have not waited for.
        assert_eq!(unsafe { libc::kill(id, libc::SIGTERM) }, 0);
        let deadline = Instant::now() + PATIENCE;
        while self.0.try_wait().expect("waited").is_none() {
            assert!(Instant::now() < deadline, "does not end");
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Of a site: waits until it listens. Returns where its API is, and where machines reach it.
    pub fn addresses(&mut self) -> (String, String) {
        let mut lines = BufReader::new(self.0.stdout.take().expect("piped")).lines();
        let mut said = |prefix: &str| {
            let mut said = lines.by_ref().map(|line| line.expect("text"));
            said.find_map(|line| line.strip_prefix(prefix).map(str::to_owned)).expect("the site starts")
        };
        let dashboard = said("dashboard ");
        (dashboard.trim_start_matches("http://").trim_end_matches('/').to_owned(), said("zenoh "))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts the shipped site on ports that are free, its file `site.toml` in `folder`.
pub fn site(holdfast: &Path, folder: &Path, data: &Path, stderr: Stdio) -> Process {
    let config = folder.join("site.toml");
    let text = std::fs::read_to_string(repository("config/site.toml")).expect("a site file");
    // Tests ask without a pause, as people do not.
    let text = text.replace("requests_per_s = 50.0", "requests_per_s = 10000.0");
    std::fs::write(&config, text.replace("tcp/127.0.0.1:7447", "tcp/127.0.0.1:0")).expect("written");
    let mut command = Command::new(holdfast);
    command.arg("site").arg("--config").arg(config).arg("--data").arg(data);
    command.env("RUST_LOG", "info,holdfast=debug");
    Process::start(command.args(["--listen", "127.0.0.1:0"]).stdout(Stdio::piped()).stderr(stderr))
}

/// Starts one machine of the demo, as fast as `speed` says.
pub fn machine(holdfast: &Path, id: &str, endpoint: &str, on_board: &Path, speed: &str) -> Process {
    let mut command = Command::new(holdfast);
    command.arg("machine").arg("--scenario").arg(repository("config/scenarios/demo.toml"));
    command.arg("--record").arg(on_board);
    command.args(["--machine", id, "--speed", speed, "--connect", endpoint]);
    Process::start(command.stderr(Stdio::null()))
}

/// A file of the repository.
pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}
