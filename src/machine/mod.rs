//! The excavator's peer: readings in, estimates out, on the machine itself.
//!
//! Four things run, each owned by one thread or task and joined by bounded channels:
//!
//! ```text
//! source ──readings──▶ predictor ──readings──▶ updater      (threads of the room `live`)
//!                       ▲   │ │                  │ │
//!                       └───┼─┼─────solutions────┘ └──health, events──▶ outbox ──▶ sender  (tasks of tokio)
//!                           │ └──readings, estimates, takeovers───────▶   │
//!                                                                         └─────▶ keeper  (thread, owns the ring)
//! ```
//!
//! The predictor never waits for any of the others: what does not fit into a channel is counted and told.
//! The estimator never runs on Zenoh's threads, and nothing is put on the network or on a disk from the
//! estimator's. What the outbox has numbered is in the on-board record whether it could be sent or not.
//!
//! The outbox keeps the journal: in which order the readings were taken and before which of them a solution was
//! taken over. With the journal and the readings of a boot, a session's recording gives the estimates again to
//! the bit ([`crate::record::read_live_runs`], [`crate::replay::again`]). What did not fit into a channel on
//! the way to the outbox, or was lost on the network, shows as a gap there.
//! What the estimate is worth is decided in the `estimator` room; what the fleet shows, on the site.

#![allow(
    clippy::disallowed_methods,
    reason = "shells read clocks: here for stamps of arrival and for what is measured"
)]

mod audience;
mod clock;
mod configuration;
mod counters;
mod keeper;
mod outbox;
mod pipeline;
mod sender;
mod source;

use std::collections::BTreeMap;
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use zenoh::liveliness::LivelinessToken;

use crate::link::{self, LinkError};
use crate::wire::{BootId, alive_key};
use crate::{config, estimator, record};

pub use counters::Report;
pub use source::{Source, SourceError};

use audience::Audience;
use clock::Clock;
use counters::Counters;
use keeper::Keeper;
use outbox::Outbox;
use pipeline::Pipeline;
use source::{Feed, Surroundings};

/// What a machine's peer needs to start.
pub struct Options {
    /// The machine file.
    pub machine: config::Machine,
    /// Where its readings come from.
    pub source: Source,
    /// How fast a played source passes; 1 is real time. Live readings come as they come.
    pub speed: f64,
}

/// Why a machine's peer does not run.
#[derive(Debug, thiserror::Error)]
pub enum MachineError {
    /// The link to the site.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The source of readings.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// A mistake of ours; the process had better be started anew.
    #[error("the estimator has panicked")]
    Panicked,
    /// The system gives no thread.
    #[error("the thread of the {name} cannot be started: {source}")]
    Thread {
        /// Whose thread.
        name: &'static str,
        /// What the system says.
        source: std::io::Error,
    },
}

/// A running peer.
pub struct Machine {
    boot: BootId,
    session: zenoh::Session,
    token: LivelinessToken,
    audience: Audience,
    feed: Feed,
    pipeline: Pipeline,
    outbox: Outbox,
    keeper: Keeper,
    counters: Arc<Counters>,
}

impl Machine {
    /// Opens the session and starts threads and tasks. Needs a tokio runtime of several threads, as Zenoh does.
    ///
    /// # Errors
    /// [`MachineError`] if the session cannot be opened or the source cannot be read. That the site does not
    /// answer is no error: it is dialled until it does.
    pub async fn start(options: Options) -> Result<Self, MachineError> {
        let Options { machine, source, speed } = options;
        // The source first: a missing file should not show on the site as a machine that came and went.
        let seed = source.seed();
        let prepared = source.prepare(&machine)?;
        let session = link::open(link::machine_config(&machine.link)?).await?;
        let boot = random_boot();
        let clock = Clock::new(prepared.is_played().then_some(speed));
        let counters = Arc::new(Counters::default());
        let about = about(&machine, boot, seed);
        let (keeper, record) = Keeper::start(&session, &machine, boot, about, Arc::clone(&counters)).await?;
        let (outbox, outlets) =
            Outbox::start(&session, &machine, boot, clock, Arc::clone(&counters), record).await?;
        let halves = estimator::split(machine.estimator_options());
        let passes = if prepared.is_played() { speed } else { 1.0 };
        let imu_period = Duration::from_secs_f64(1.0 / machine.imu.update_rate / passes);
        let (pipeline, inlet) = Pipeline::start(halves, imu_period, outlets.clone(), Arc::clone(&counters))?;
        configuration::answer(&session, &machine, boot).await?;
        let audience = Audience::watch(&session, &machine).await?;
        let surroundings = Surroundings { outlets, clock, counters: Arc::clone(&counters) };
        let feed = prepared.start(&session, &machine, inlet, surroundings, audience.present()).await?;
        let key = alive_key(&machine.link.site, &machine.id, boot);
        let token = session
            .liveliness()
            .declare_token(key.clone())
            .await
            .map_err(|error| LinkError::Declare { key, reason: link::reason(&error) })?;
        tracing::info!(
            machine = %machine.id,
            %boot,
            site = %machine.link.site,
            connect = ?machine.link.connect,
            "the machine's peer runs"
        );
        Ok(Self { boot, session, token, audience, feed, pipeline, outbox, keeper, counters })
    }

    /// This run.
    pub fn boot(&self) -> BootId {
        self.boot
    }

    /// Where drivers can reach the machine: its listening endpoints with the ports that they got.
    pub async fn listening_on(&self) -> Vec<String> {
        self.session.info().locators().await.iter().map(ToString::to_string).collect()
    }

    /// Waits until the source has ended; live sources and repeating scenarios do not.
    pub async fn source_ended(&mut self) {
        self.feed.ended().await;
    }

    /// Ends everything in the order of the flow, so that what was read is still estimated and sent: source,
    /// predictor, updater, outbox, record, token, session.
    ///
    /// # Errors
    /// [`MachineError::Panicked`] if the estimator did not live to see it.
    pub async fn stop(self) -> Result<Report, MachineError> {
        let Self { boot, session, token, audience, feed, pipeline, outbox, keeper, counters } = self;
        feed.stop().await;
        let estimated = pipeline.stop().await;
        let published = outbox.stop().await;
        keeper.stop().await;
        audience.stop().await;
        if let Err(error) = token.undeclare().await {
            tracing::warn!(%error, "the liveliness token could not be taken back");
        }
        link::close(session).await;
        let report = counters.report(published);
        tracing::info!(%boot, %report, "the machine's peer has ended");
        estimated.map(|()| report)
    }
}

/// Runs a machine's peer until its source ends or `shutdown` does.
///
/// # Errors
/// As [`Machine::start`] and [`Machine::stop`].
pub async fn run(options: Options, shutdown: impl Future<Output = ()>) -> Result<Report, MachineError> {
    let mut machine = Machine::start(options).await?;
    let Machine { feed, pipeline, .. } = &mut machine;
    tokio::select! {
        () = shutdown => {}
        () = pipeline.ended() => {}
        () = feed.ended() => {}
    }
    machine.stop().await
}

/// What every file of the on-board record says: whose it is, how the machine is configured, and where what it saw
/// came from if that was simulated.
fn about(
    machine: &config::Machine,
    boot: BootId,
    seed: Option<u64>,
) -> Vec<(String, BTreeMap<String, String>)> {
    let mut entries = vec![
        ("machine", machine.id.clone()),
        ("boot", boot.to_string()),
        ("software", env!("CARGO_PKG_VERSION").to_owned()),
        ("config", machine.to_toml()),
    ];
    entries.extend(seed.map(|seed| ("simulation_seed", seed.to_string())));
    let entries = entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    vec![(record::MACHINE.to_owned(), entries)]
}

/// Differs from run to run; the standard library's hasher is seeded by the system.
fn random_boot() -> BootId {
    use std::hash::{BuildHasher, Hasher};
    let mut hasher = std::hash::RandomState::new().build_hasher();
    hasher.write_u32(std::process::id());
    hasher.write_i64(clock::wall().as_nanos());
    BootId(hasher.finish())
}
