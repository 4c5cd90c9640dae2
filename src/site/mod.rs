//! The site server: machines dial in by Zenoh, people by HTTP.
//!
//! Owns the one Zenoh session, the fleet (room `fleet`), the recording (room `record`) and the API. What a
//! machine's state means is said in `fleet`, what bytes mean in `wire`; this room moves them:
//! ```text
//! Zenoh callbacks ── try_send ─▶ aggregator (owns the fleet) ── newest frame ─▶ API, live clients, metrics
//!        │                                                                          ▲
//!        └────────── try_send ─▶ recorder thread (room `sessions`) ── progress ─────┘
//! aggregator ── a ring of messages ─▶ clients of the Foxglove protocol (room `foxglove`)
//! ```
//! Nothing waits for something behind it: full channels drop and count, live clients get the newest frame.

mod aggregator;
mod alerts;
mod backfill;
mod clock;
mod counters;
mod foxglove;
mod history;
mod http;
mod inlet;
mod sessions;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;

use crate::accounts::{Accounts, AccountsError};
use crate::config;
use crate::fleet::{Fleet, SiteDescription};
use crate::link;
use crate::time::Span;
use backfill::Backfill;
use clock::SiteClock;
use counters::Counters;
use history::History;
use sessions::{Catalogue, Recorder};

/// Messages between the callbacks and the aggregator: more than a second of forty machines. When it is full,
/// new messages are dropped, which the gap counters show.
const MESSAGES_QUEUED: usize = 32_768;
/// Tokens that appear or vanish between two turns of the aggregator: every machine twice.
const TOKENS_QUEUED: usize = 2 * crate::fleet::MACHINES_MAX;
/// How long the parts that wait for others may take to end.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);

/// Why the site cannot start.
#[derive(Debug, thiserror::Error)]
pub enum SiteError {
    /// The configuration asks for what is not allowed.
    #[error("{0}")]
    Refused(#[from] config::Violation),
    /// The accounts cannot be read.
    #[error("the accounts cannot be used: {0}")]
    Accounts(#[from] AccountsError),
    /// The address of page and API cannot be used.
    #[error("cannot listen on http://{address}/: {source}{}", hint(source))]
    Listen {
        /// Which address.
        address: SocketAddr,
        /// What the system says.
        source: std::io::Error,
    },
    /// The recording cannot be started.
    #[error("cannot record to {}: {message}", directory.display())]
    Record {
        /// Where to.
        directory: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// What the site remembers cannot be kept.
    #[error("cannot keep the history: {0}")]
    History(std::io::Error),
    /// Zenoh does not open its endpoints.
    #[error("Zenoh cannot listen on {endpoints}: {message}")]
    Zenoh {
        /// Where.
        endpoints: String,
        /// What Zenoh says.
        message: String,
    },
}

fn hint(error: &std::io::Error) -> &'static str {
    match error.kind() {
        std::io::ErrorKind::AddrInUse => "; choose another port with --listen 127.0.0.1:PORT",
        _ => "",
    }
}

/// A site server that runs.
pub struct Site {
    address: SocketAddr,
    endpoints: Vec<String>,
    session: zenoh::Session,
    inlet: inlet::Inlet,
    recorder: Option<Recorder>,
    backfill: Option<Backfill>,
    history: History,
    stop: watch::Sender<bool>,
    tasks: Vec<JoinHandle<()>>,
}

impl Site {
    /// Opens everything; when it returns, machines can dial in and the page is served.
    ///
    /// # Errors
    /// [`SiteError`]: an address is taken or refused, the directory cannot be written.
    pub async fn start(config: &config::Site) -> Result<Self, SiteError> {
        let accounts = Accounts::of(&config.record.directory)?;
        may_listen(&config.http, &accounts, "http.listen")?;
        let channels = alerts::channels(&config.alerts)?;
        let basemap = http::Basemap::of(&config.map)?.map(Arc::new);
        let listen = config.http.listen;
        let listener = TcpListener::bind(listen)
            .await
            .map_err(|source| SiteError::Listen { address: listen, source })?;
        let address =
            listener.local_addr().map_err(|source| SiteError::Listen { address: listen, source })?;

        let clock = SiteClock::start();
        let counters = Arc::new(Counters::default());
        let description = SiteDescription {
            id: config.id.clone(),
            name: config.display_name().to_owned(),
            origin: config.world.site_frame().origin(),
            time_zone: config.time_zone.clone(),
            software: env!("CARGO_PKG_VERSION").to_owned(),
            tolerance_m: config.tolerance.position_sigma_m,
        };
        let (session, endpoints) = inlet::open(config).await?;
        let folder = config.record.directory.join("sessions");
        let books = backfill::open(&config.record.directory, &folder);
        let recording = match config.record.enabled {
            true => Recorder::start(config, folder, clock, Arc::clone(&counters), books.books.clone())
                .map(|recorder| (recorder.catalogue(), Some(recorder))),
            false => Catalogue::visit(folder).map(|catalogue| (Arc::new(catalogue), None)),
        };
        let (catalogue, recorder) = match recording {
            Ok(recording) => recording,
            Err(error) => {
                link::close(session).await;
                return Err(error);
            }
        };

        let history_folder = config.record.enabled.then_some(config.record.directory.as_path());
        let keep = config.record.keep_history_days.map(|days| Span::from_seconds(days * 86_400.0));
        let history = match History::start(history_folder, keep, clock) {
            Ok(history) => history,
            Err(error) => {
                link::close(session).await;
                return Err(SiteError::History(error));
            }
        };

        let (message_sender, messages) = mpsc::channel(MESSAGES_QUEUED);
        let for_backfill = message_sender.clone();
        let (token_sender, tokens) = mpsc::channel(TOKENS_QUEUED);
        let outlets = inlet::Outlets {
            messages: message_sender,
            tokens: token_sender,
            recorder: recorder.as_ref().map(Recorder::inbox),
            counters: Arc::clone(&counters),
            clock,
        };
        let inlet = inlet::Inlet::declare(&session, &config.id, outlets)
            .await
            .map_err(|error| zenoh_error(config, error))?;

        let (stop, stopped) = watch::channel(false);
        let mut fleet = Fleet::new(description);
        let archive = history.archive();
        archive.open_outages().values().for_each(|outage| fleet.carry_on(outage.clone()));
        let site_frame = *fleet.frame();
        let (frame_sender, frames) = watch::channel(Arc::new(aggregator::Frame::of(&fleet, 0, clock.now())));
        let outlets = aggregator::Outlets { frames: frame_sender, history: history.inlet() };
        let (feed, feeds) = foxglove::Feed::new();
        let aggregator = aggregator::run(fleet, messages, tokens, outlets, feed, clock, stopped.clone());
        let backfill = recorder.as_ref().map(|recorder| {
            let outlets = backfill::Outlets {
                session: session.clone(),
                site: config.id.clone(),
                recorder: recorder.inbox(),
                progress: recorder.progress(),
                messages: for_backfill,
                clock,
            };
            Backfill::start(books, outlets, frames.clone(), stopped.clone())
        });
        let hour = http::Hour::default();
        let follower = hour.clone().follow(frames.clone(), stopped.clone());
        let surroundings = alerts::Surroundings {
            site: config.id.clone(),
            archive: Arc::clone(&archive),
            frames: frames.clone(),
            record_directory: config.record.enabled.then(|| config.record.directory.clone()),
            recording: recorder.as_ref().map(Recorder::progress),
            tolerance_m: config.tolerance.position_sigma_m,
            clock,
            stopped: stopped.clone(),
        };
        let watching = alerts::start(&config.alerts, channels, surroundings);
        let shared = http::Shared {
            frames,
            feeds,
            counters,
            catalogue,
            session: session.clone(),
            record_directory: config.record.enabled.then(|| config.record.directory.clone()),
            recorder: recorder.as_ref().map(Recorder::progress),
            recorder_inbox: recorder.as_ref().map(Recorder::inbox),
            hour,
            archive,
            alerts: http::AlertsDesk {
                open: watching.open,
                commands: watching.commands,
                channels: watching.channels,
            },
            site: config.id.clone(),
            site_frame,
            time_zone: config.zone()?,
            clock,
            exports: http::turnstile(),
            stopped: stopped.clone(),
            equipment: config.equipment.as_slice().into(),
            people: Arc::new(http::People::new(accounts, config.http.clone(), clock)),
            plan: http::Plan::of(&config.record.directory),
            basemap,
        };
        let server = http::serve(listener, shared, stopped);
        let mut tasks = vec![tokio::spawn(aggregator), tokio::spawn(follower), tokio::spawn(server)];
        tasks.extend(watching.tasks);
        Ok(Self { address, endpoints, session, inlet, recorder, backfill, history, stop, tasks })
    }

    /// Where page and API are served.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Where machines dial in, with the ports that the system chose.
    pub fn endpoints(&self) -> &[String] {
        &self.endpoints
    }

    /// Ends everything in order: no more messages, the recording finished, clients told, the session closed.
    pub async fn stop(self) {
        if tokio::time::timeout(STOP_TIMEOUT, self.inlet.undeclare()).await.is_err() {
            tracing::warn!("Zenoh did not end the subscriptions in time");
        }
        let mut books = None;
        if let Some(backfill) = self.backfill {
            books = backfill.stop().await;
        }
        if let Some(recorder) = self.recorder {
            // The thread finishes its file; joining it must not hold up the others.
            let finished = tokio::task::spawn_blocking(move || recorder.finish());
            if tokio::time::timeout(2 * STOP_TIMEOUT, finished).await.is_err() {
                tracing::error!("the recording did not end in time; it is recovered at the next start");
            }
        }
        if let Some(books) = books {
            // A failure is told there; nothing waits for it.
            let _ = tokio::task::spawn_blocking(move || books.save()).await;
        }
        self.stop.send_replace(true);
        for task in self.tasks {
            let abort = task.abort_handle();
            if tokio::time::timeout(STOP_TIMEOUT, task).await.is_err() {
                abort.abort();
            }
        }
        // The aggregator is gone, and with it the last inlet.
        let _ = tokio::task::spawn_blocking(move || self.history.finish()).await;
        link::close(self.session).await;
    }
}

/// Whether page and API may be served there: where others can reach them, there must be accounts. `key` is what the
/// address is called by.
///
/// # Errors
/// There are none: says how to make one. Or they cannot be read.
pub fn may_listen(http: &config::Http, accounts: &Accounts, key: &str) -> Result<(), SiteError> {
    if !http.is_reachable() || accounts.exist()? {
        return Ok(());
    }
    let why = match http.listen.ip().is_loopback() {
        true => "others can reach it by a proxy, as http.names, http.proxies or http.https say".to_owned(),
        false => "others can reach it".to_owned(),
    };
    let directory = accounts.path().parent().unwrap_or(Path::new(".")).display();
    Err(SiteError::Refused(config::Violation {
        key: key.to_owned(),
        message: format!(
            "is {}: {why}, and there is no account yet; make one with `holdfast site user add NAME --role admin \
             --data {directory}`, or listen on a loopback address such as 127.0.0.1:{}",
            http.listen,
            http.listen.port()
        ),
    }))
}

/// Waits until the site is to end, or is gone.
async fn ended(stopped: &mut watch::Receiver<bool>) {
    // An error says that the sender is gone, and the site with it.
    let _ = stopped.wait_for(|stopped| *stopped).await;
}

fn zenoh_error(config: &config::Site, error: impl std::fmt::Display) -> SiteError {
    SiteError::Zenoh { endpoints: config.zenoh.listen.join(", "), message: error.to_string() }
}
