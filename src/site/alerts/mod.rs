//! Alerts at work: the rules look at every frame, people acknowledge, receivers are told.
//!
//! ```text
//! frames ─▶ watcher (owns the alerts) ──▶ archive ──▶ one courier a channel ──▶ webhook, e-mail
//!             ▲        └─ open alerts (watched by live clients)
//! API: acknowledge
//! ```
//! An alert is in the archive before anybody hears of it. What is to be delivered waits there, too: a restart
//! loses nothing, and a receiver that does not answer holds up no other.

mod authorities;
mod courier;
mod mail;
mod webhook;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;

use super::aggregator::Frame;
use super::clock::SiteClock;
use super::ended;
use super::history::Archive;
use super::sessions::{Progress, RecordingState, disk_free_bytes};
use crate::config;
use crate::fleet::{
    Alert, AlertSeverity, AlertState, Alerts, RuleKind, SiteState, Unacknowledged, Unrecorded, observations,
};
use crate::time::Stamp;
use authorities::Authorities;
use courier::Courier;
use mail::Mailer;
use webhook::Hook;

/// Acknowledgements that wait for the watcher. Full, who asks waits.
const COMMANDS_QUEUED: usize = 16;
/// Room on the disk is looked at so often: frames.
const DISK_EVERY: u64 = 50;
/// While an alert goes on, the worst of it is told so often: frames.
const WORST_EVERY: u64 = 10;
/// More changes that the archive cannot take are given up, the oldest first.
const UNKEPT_MAX: usize = 10_000;
/// A receiver may take so long.
const PATIENCE: Duration = Duration::from_secs(10);

/// Somebody saw an alert.
pub(super) struct Acknowledge {
    pub id: String,
    pub by: String,
    pub note: String,
    pub answer: oneshot::Sender<Result<Alert, Unacknowledged>>,
}

/// A way to tell somebody.
pub(super) enum Channel {
    Webhook(Hook),
    Mail(Mailer),
}

/// What somebody is told.
pub(super) struct Letter<'a> {
    pub site: &'a str,
    pub is_test: bool,
    pub alert: &'a Alert,
}

impl Channel {
    /// `webhook:{name}` or `mail`; what waits for it is kept under this name.
    pub fn name(&self) -> String {
        match self {
            Channel::Webhook(hook) => format!("webhook:{}", hook.name()),
            Channel::Mail(_) => "mail".to_owned(),
        }
    }

    /// Tells it once; says what the receiver said, or why it was not told.
    pub async fn send(&self, letter: &Letter<'_>, now: Stamp) -> Result<String, String> {
        let sending = async {
            match self {
                Channel::Webhook(hook) => hook.send(letter, now).await,
                Channel::Mail(mailer) => mailer.send(letter).await,
            }
        };
        let late = |_| format!("no answer within {} s", PATIENCE.as_secs());
        tokio::time::timeout(PATIENCE, sending).await.map_err(late).and_then(|said| said)
    }
}

/// Alerts at work.
pub(super) struct Watching {
    pub commands: mpsc::Sender<Acknowledge>,
    pub open: watch::Receiver<Arc<Vec<Alert>>>,
    pub channels: Arc<Vec<Channel>>,
    pub tasks: Vec<JoinHandle<()>>,
}

/// What the watcher needs of the site.
pub(super) struct Surroundings {
    pub site: String,
    pub archive: Arc<Archive>,
    pub frames: watch::Receiver<Arc<Frame>>,
    /// `None` where nothing is recorded.
    pub record_directory: Option<PathBuf>,
    /// `None` where nothing is recorded.
    pub recording: Option<watch::Receiver<Progress>>,
    pub tolerance_m: f64,
    pub clock: SiteClock,
    pub stopped: watch::Receiver<bool>,
}

/// The channels that the site file names.
///
/// # Errors
/// A secret or the authorities cannot be read, or an address is none.
pub(super) fn channels(config: &config::Alerts) -> Result<Vec<Channel>, config::Violation> {
    let authorities = match &config.certificates_file {
        Some(path) => Authorities::read(path)?,
        None => Authorities::default(),
    };
    let mut channels = Vec::new();
    for webhook in &config.webhook {
        channels.push(Channel::Webhook(Hook::new(webhook, &authorities)?));
    }
    if let Some(mail) = &config.mail {
        channels.push(Channel::Mail(Mailer::new(mail, &authorities)?));
    }
    Ok(channels)
}

/// One line of a file that nobody else should read.
fn secret(key: &str, path: &Path) -> Result<String, config::Violation> {
    let refused = |why: String| config::Violation {
        key: key.to_owned(),
        message: format!("is {}, which {why}", path.display()),
    };
    let text = std::fs::read_to_string(path).map_err(|error| refused(format!("cannot be read: {error}")))?;
    let line = text.trim_end_matches(['\r', '\n']);
    if line.is_empty() || line.contains('\n') {
        return Err(refused("must hold one line".to_owned()));
    }
    Ok(line.to_owned())
}

/// Starts the watcher and a courier for each channel.
pub(super) fn start(config: &config::Alerts, channels: Vec<Channel>, site: Surroundings) -> Watching {
    let open = site.archive.open_alerts().unwrap_or_else(|error| {
        tracing::error!("the alerts of the last run cannot be read: {error}");
        Vec::new()
    });
    let names: Vec<String> = channels.iter().map(Channel::name).collect();
    if let Err(error) = site.archive.forget_other_channels(&names) {
        tracing::error!("what waits for receivers that are gone cannot be removed: {error}");
    }
    let alerts = Alerts::new(config.rules(), open);
    let (open_sender, open) = watch::channel(Arc::new(alerts.open()));
    let (commands, commands_receiver) = mpsc::channel(COMMANDS_QUEUED);
    let channels = Arc::new(channels);
    let (bell, _) = watch::channel(());
    let mut tasks: Vec<JoinHandle<()>> = (0..channels.len())
        .map(|index| {
            let courier = Courier {
                site: site.site.clone(),
                channels: Arc::clone(&channels),
                index,
                archive: Arc::clone(&site.archive),
                clock: site.clock,
            };
            tokio::spawn(courier.run(bell.subscribe(), site.stopped.clone()))
        })
        .collect();
    let watcher = Watcher { alerts, site, names, open: open_sender, unkept: Vec::new(), bell };
    tasks.push(tokio::spawn(watcher.run(commands_receiver)));
    Watching { commands, open, channels, tasks }
}

/// An alert that says that alerts arrive.
pub(super) fn test_alert(now: Stamp) -> Alert {
    Alert {
        id: format!("test.{}", now.as_nanos()),
        rule: RuleKind::MachineLost,
        severity: AlertSeverity::Info,
        machine: None,
        part: None,
        message: "this is a test: alerts of this site arrive here".to_owned(),
        value: 0.0,
        worst: 0.0,
        state: AlertState::Active,
        raised: now,
        times: 1,
        cleared: None,
        acknowledged: None,
        changed: now,
    }
}

/// For how long what should be recorded is not, and why; `since` is kept from one time to the next.
fn unrecorded(told: &watch::Receiver<Progress>, now: Stamp, since: &mut Option<Stamp>) -> Unrecorded {
    let progress = told.borrow();
    // Who ends the server has the recorder say so before it goes.
    let is_gone = told.has_changed().is_err() && progress.state != RecordingState::Stopped;
    let troubles = match is_gone {
        true => vec!["nothing is recorded: the recorder has ended by a fault of its own".to_owned()],
        false => progress.troubles(now),
    };
    *since = (!troubles.is_empty()).then(|| since.unwrap_or(now));
    let for_s = since.map_or(0.0, |since| now.seconds_since(since));
    Unrecorded { for_s, why: troubles.join("; ") }
}

struct Watcher {
    alerts: Alerts,
    site: Surroundings,
    /// Of the channels.
    names: Vec<String>,
    open: watch::Sender<Arc<Vec<Alert>>>,
    /// Changes that the archive could not take, the oldest first.
    unkept: Vec<Alert>,
    /// Rung when something is to be delivered.
    bell: watch::Sender<()>,
}

impl Watcher {
    async fn run(mut self, mut commands: mpsc::Receiver<Acknowledge>) {
        let mut stopped = self.site.stopped.clone();
        let mut frames = self.site.frames.clone();
        let mut state = SiteState { tolerance_m: self.site.tolerance_m, ..SiteState::default() };
        let (mut disk_due, mut worst_due) = (0, 0);
        let mut unrecorded_since = None;
        loop {
            tokio::select! {
                biased;
                () = ended(&mut stopped) => return,
                Some(command) = commands.recv() => {
                    let Acknowledge { id, by, note, answer } = command;
                    let done = self.alerts.acknowledge(&id, &by, &note, self.site.clock.now());
                    if let Ok(alert) = &done {
                        tracing::info!("alert {id}: acknowledged by {by:?}");
                        self.tell(vec![alert.clone()]).await;
                    }
                    // Who asked may be gone.
                    let _ = answer.send(done);
                }
                changed = frames.changed() => {
                    if changed.is_err() {
                        return;
                    }
                    let frame = Arc::clone(&frames.borrow_and_update());
                    if frame.number >= disk_due {
                        disk_due = frame.number + DISK_EVERY;
                        if !self.unkept.is_empty() {
                            self.tell(Vec::new()).await;
                        }
                        state.disk_free_bytes = self.site.record_directory.as_deref().and_then(disk_free_bytes);
                    }
                    let now = frame.view.time.0;
                    state.unrecorded =
                        self.site.recording.as_ref().map(|told| unrecorded(told, now, &mut unrecorded_since));
                    let changed = self.alerts.observe(observations(&frame.view, &state), now);
                    if !changed.is_empty() {
                        changed.iter().for_each(|alert| {
                            tracing::warn!("alert {}: {}: {}", alert.id, alert.state.name(), alert.message);
                        });
                        self.tell(changed).await;
                    } else if frame.number >= worst_due {
                        worst_due = frame.number + WORST_EVERY;
                        self.tell_worst();
                    }
                }
            }
        }
    }

    /// The clock and the numbers of those that go on; nothing is written, and nobody is written to.
    fn tell_worst(&self) {
        let open = self.alerts.open();
        self.open.send_if_modified(|told| {
            let grew = **told != open;
            if grew {
                *told = Arc::new(open);
            }
            grew
        });
    }

    /// Keeps what changed, then tells it. What cannot be kept is tried again with the disk's room, or the next change.
    async fn tell(&mut self, changed: Vec<Alert>) {
        self.unkept.extend(changed);
        self.unkept.drain(..self.unkept.len().saturating_sub(UNKEPT_MAX));
        let (archive, names, unkept) =
            (Arc::clone(&self.site.archive), self.names.clone(), self.unkept.clone());
        let kept = tokio::task::spawn_blocking(move || archive.put_alerts(&unkept, &names)).await;
        match kept {
            Ok(Ok(())) => self.unkept.clear(),
            Ok(Err(error)) => tracing::error!("alerts cannot be kept, and will be tried again: {error}"),
            Err(error) => tracing::error!("alerts cannot be kept, and will be tried again: {error}"),
        }
        self.open.send_replace(Arc::new(self.alerts.open()));
        self.bell.send_replace(());
    }
}
