//! `holdfast demo`: a site and two simulated excavators, each a process of its own.

use std::error::Error;
use std::fs;
use std::io::Write as _;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use tokio::io::{AsyncBufReadExt as _, BufReader, Lines};
use tokio::process::{Child, ChildStdout, Command};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;

use super::logging;
use crate::accounts::Accounts;
use crate::{config, site};

/// Show two excavators on a site, simulated
///
/// Starts the site server and two simulated excavators as processes of their own, which talk over Zenoh as
/// real ones do. Prints the dashboard's address and the Zenoh endpoint; ends on Ctrl-C. A process that dies is
/// reported, and not started again: kill one and see what the dashboard says.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Address of the dashboard; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
    /// Where recordings and the demo's configuration go
    #[arg(long, value_name = "DIR", default_value = "holdfast-data")]
    pub data: PathBuf,
    /// End by itself after so many seconds
    #[arg(long, value_name = "S", value_parser = seconds)]
    pub duration: Option<f64>,
    /// Simulated seconds in a second
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = speed)]
    pub speed: f64,
}

/// What the demo needs, in the binary, so that it runs from any folder: where it is written to, and the text.
/// The folders are as in the repository, because scenarios name machine files beside them.
const FILES: [(&str, &str); 4] = [
    (SITE_FILE, include_str!("../../config/site.toml")),
    (SCENARIO_FILE, include_str!("../../config/scenarios/demo.toml")),
    (MACHINE_FILES[0], include_str!("../../config/machines/simulated-roof.toml")),
    (MACHINE_FILES[1], include_str!("../../config/machines/simulated-floor.toml")),
];
const SITE_FILE: &str = "site.toml";
const SCENARIO_FILE: &str = "scenarios/demo.toml";
const MACHINE_FILES: [&str; 2] = ["machines/simulated-roof.toml", "machines/simulated-floor.toml"];

/// The site opens its endpoints in less; else something is wrong.
const START_TIMEOUT: Duration = Duration::from_secs(30);
/// A process that was asked to end has so long.
const END_TIMEOUT: Duration = Duration::from_secs(15);

/// Up to what a timer takes.
fn seconds(text: &str) -> Result<f64, String> {
    within(text, 0.0, 1e9)
}

fn speed(text: &str) -> Result<f64, String> {
    within(text, 0.01, 1000.0)
}

fn within(text: &str, low: f64, high: f64) -> Result<f64, String> {
    let value = text.parse().ok().filter(|value| (low..=high).contains(value));
    value.ok_or_else(|| format!("must be a number from {low} to {high}"))
}

/// Runs the command.
///
/// # Errors
/// The files cannot be written, or the site does not start: its own message is on stderr then.
pub fn run(arguments: Arguments) -> Result<(), Box<dyn Error>> {
    // One thread, the main one: children are told to end when the thread that started them does.
    logging::start();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(demo(&arguments))
}

async fn demo(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    let http = config::Http { listen: arguments.listen, ..config::Http::default() };
    site::may_listen(&http, &Accounts::of(&arguments.data)?, "--listen")?;
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    fs::create_dir_all(&arguments.data).map_err(|error| format!("{}: {error}", arguments.data.display()))?;
    let data = fs::canonicalize(&arguments.data)?;
    let folder = data.join("demo");
    write_files(&folder, &data)?;

    let (exit_sender, mut exits) = mpsc::channel(FILES.len());
    let mut family = Family { members: Vec::new(), exits: exit_sender };
    let started = tokio::select! {
        started = start(&mut family, &folder, arguments) => Some(started),
        _ = terminate.recv() => None,
        _ = interrupt.recv() => None,
    };
    match started {
        Some(Ok(())) => {}
        ended => {
            family.end().await;
            return ended.unwrap_or(Ok(()));
        }
    }

    let duration = arguments.duration.map_or(Duration::MAX, Duration::from_secs_f64);
    let end = tokio::time::sleep(duration);
    tokio::pin!(end);
    let mut alive = family.members.len();
    let mut outcome = Ok(());
    while alive > 0 {
        tokio::select! {
            // A signal may reach the children before us: it is looked for first.
            biased;
            _ = terminate.recv() => break,
            _ = interrupt.recv() => break,
            () = &mut end => break,
            Some((name, status)) = exits.recv() => {
                alive -= 1;
                eprintln!("holdfast demo: {name} ended: {status}; the demo goes on without it");
                if alive == 0 {
                    outcome = Err("all processes of the demo ended".into());
                }
            }
        }
    }
    family.end().await;
    outcome
}

/// Starts the site, and when it listens, the machines.
async fn start(family: &mut Family, folder: &Path, arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    let mut site = own_command()?;
    site.arg("site").arg("--config").arg(folder.join(SITE_FILE));
    site.arg("--listen").arg(arguments.listen.to_string());
    let mut site = site.stdout(Stdio::piped()).spawn()?;
    let stdout = site.stdout.take().ok_or("the site server has no output")?;
    family.adopt("the site server", site);
    let mut lines = BufReader::new(stdout).lines();
    let dashboard = said(&mut lines, "dashboard ").await?;
    let endpoint = said(&mut lines, "zenoh ").await?;
    let data = arguments.data.display();
    // Whoever started us may have stopped reading; that is no reason to end.
    let _ = write!(std::io::stdout(), "dashboard {dashboard}\nzenoh {endpoint}\ndata {data}\n");

    for id in machine_ids(folder)? {
        let mut machine = own_command()?;
        machine.arg("machine").arg("--scenario").arg(folder.join(SCENARIO_FILE)).arg("--machine").arg(&id);
        machine.arg("--record").arg(folder.join("on-board"));
        machine.arg("--connect").arg(&endpoint).arg("--speed").arg(arguments.speed.to_string());
        family.adopt(&format!("machine {id}"), machine.stdout(Stdio::null()).spawn()?);
    }
    Ok(())
}

fn machine_ids(folder: &Path) -> Result<Vec<String>, Box<dyn Error>> {
    let load = |file: &str| config::load::<config::Machine>(&folder.join(file));
    Ok(MACHINE_FILES
        .into_iter()
        .map(|file| load(file).map(|machine| machine.id))
        .collect::<Result<_, _>>()?)
}

/// What the site says on its next line, after `prefix`.
async fn said(lines: &mut Lines<BufReader<ChildStdout>>, prefix: &str) -> Result<String, Box<dyn Error>> {
    let line = tokio::time::timeout(START_TIMEOUT, lines.next_line()).await;
    let line = line.map_err(|_| "the site server does not start")??;
    let text = line.as_deref().and_then(|line| line.strip_prefix(prefix)).map(str::to_owned);
    text.ok_or_else(|| "the site server did not start".into())
}

/// Writes the site's, the machines' and the scenario's files.
fn write_files(folder: &Path, data: &Path) -> Result<(), Box<dyn Error>> {
    for (name, text) in FILES {
        let path = folder.join(name);
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent).map_err(|error| format!("{}: {error}", parent.display()))?;
        }
        fs::write(&path, text).map_err(|error| format!("{}: {error}", path.display()))?;
    }
    let path = folder.join(SITE_FILE);
    let mut site: config::Site = config::load(&path)?;
    site.name = "Demo site".to_owned();
    // The system chooses a free port, and the site says which.
    site.zenoh.listen = vec!["tcp/127.0.0.1:0".to_owned()];
    site.record.directory = data.to_owned();
    fs::write(&path, toml::to_string(&site)?)?;
    Ok(())
}

/// This program again. It ends when we do, however that happens.
fn own_command() -> Result<Command, Box<dyn Error>> {
    let mut command = Command::new(std::env::current_exe()?);
    command.stdin(Stdio::null()).kill_on_drop(true);
    #[cfg(target_os = "linux")]
    {
        let parent = std::process::id();
        // SAFETY: prctl, getppid and _exit may be called between fork and exec.
        unsafe {
            command.pre_exec(move || {
                if libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGTERM) != 0 {
                    return Err(std::io::Error::last_os_error());
                }
                // The parent may have died before it was asked for.
                if u32::try_from(libc::getppid()) != Ok(parent) {
                    libc::_exit(1);
                }
                Ok(())
            });
        }
    }
    Ok(command)
}

/// The processes of the demo.
struct Family {
    members: Vec<Member>,
    exits: mpsc::Sender<(String, ExitStatus)>,
}

struct Member {
    end: oneshot::Sender<()>,
    keeper: JoinHandle<()>,
}

impl Family {
    /// Keeps a process until it ends, or is asked to.
    fn adopt(&mut self, name: &str, child: Child) {
        let (end, asked) = oneshot::channel();
        let keeper = tokio::spawn(keep(child, name.to_owned(), self.exits.clone(), asked));
        self.members.push(Member { end, keeper });
    }

    /// Ends all processes, machines first, so that the recording holds what they said last.
    async fn end(self) {
        for Member { end, keeper } in self.members.into_iter().rev() {
            // An error says that the process ended before.
            let _ = end.send(());
            if let Err(error) = keeper.await {
                eprintln!("holdfast demo: {error}");
            }
        }
    }
}

/// Waits until the process ends, and says so; or asks it to end, and ends it if it does not.
async fn keep(
    mut child: Child,
    name: String,
    exits: mpsc::Sender<(String, ExitStatus)>,
    asked: oneshot::Receiver<()>,
) {
    tokio::select! {
        status = child.wait() => match status {
            // Nobody listens any more when the demo itself ends.
            Ok(status) => return drop(exits.send((name, status)).await),
            Err(error) => return eprintln!("holdfast demo: {name} cannot be watched: {error}"),
        },
        _ = asked => {}
    }
    if let Some(id) = child.id().and_then(|id| i32::try_from(id).ok()) {
        // SAFETY: a signal to a child that was not waited for yet, so that the id is still its own.
        unsafe { libc::kill(id, libc::SIGTERM) };
    }
    if tokio::time::timeout(END_TIMEOUT, child.wait()).await.is_err() {
        eprintln!("holdfast demo: {name} did not end in time and is killed");
        if let Err(error) = child.kill().await {
            eprintln!("holdfast demo: {name} cannot be killed: {error}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::Scenario;

    #[test]
    fn embedded_files_are_valid_and_fit_together() {
        let mut worlds = Vec::new();
        let folder = Path::new("embedded");
        for (name, text) in FILES {
            if MACHINE_FILES.contains(&name) {
                let machine: config::Machine =
                    config::parse(text, &folder.join(name)).expect("a machine file");
                worlds.push((machine.world, machine.link.site));
            } else if name == SITE_FILE {
                let site: config::Site = config::parse(text, &folder.join(name)).expect("a site file");
                worlds.push((site.world, site.id));
            }
        }
        assert_eq!(worlds.len(), 3);
        assert!(worlds.windows(2).all(|pair| pair[0] == pair[1]), "one site, one origin: {worlds:?}");
    }

    #[test]
    fn written_files_name_the_machines_and_where_to_record() {
        let data = std::env::temp_dir().join(format!("holdfast-demo-files-{}", std::process::id()));
        let folder = data.join("demo");
        write_files(&folder, &data).expect("written");
        let site: config::Site = config::load(&folder.join(SITE_FILE)).expect("valid");
        assert_eq!(site.record.directory, data);
        let scenario = Scenario::load(&folder.join(SCENARIO_FILE)).expect("valid");
        assert_eq!(scenario.machine_ids(), machine_ids(&folder).expect("valid"));
        fs::remove_dir_all(data).expect("removed");
    }
}
