//! A session once more as a whole: the graph that its estimator built, solved as one batch.
//!
//! It stands for the truth where there is none: at each moment it knows what came after, too. How far the live
//! estimate was from it is what the future adds to it, not the error of either: what misleads all measurements alike
//! misleads both. Clocks, and whose readings they are, are the caller's business.

mod gain;
mod outputs;

use std::collections::BTreeSet;

pub use gain::{Gain, Part, Point};
pub use outputs::{Outputs, PartSummary, Summary, Unsolved};

use crate::batch::{self, BatchError, FactorCounts, NODE_BYTES, SmoothedNode};
use crate::estimator::{Correction, Estimator, Options, Past};
use crate::lie::Vec3;
use crate::sensors::{Arrival, ImuSample, Reading};
use crate::state::{Estimate, Event, Mode, NavState};
use crate::time::Stamp;

/// Bytes of a node with its factors, before it is solved.
const PAST_NODE_BYTES: usize = 3_000;

/// Why there is nothing to solve.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ReferenceError {
    /// Nothing at all.
    #[error("has no readings")]
    Empty,
    /// Nothing ties it to the world.
    #[error("has no GNSS fixes: without any, nothing says where on the site the machine was")]
    NoFixes,
    /// The estimator never started.
    #[error("the estimate never started in {span_s:.1} s of readings: it waits for {waits_for}")]
    NotStarted {
        /// Of the readings, s.
        span_s: f64,
        /// In words.
        waits_for: String,
    },
    /// There is no past and no future.
    #[error(
        "is too short: {span_s:.2} s with {nodes} nodes from where the estimate started, at least {NODES_MIN} are needed"
    )]
    TooShort {
        /// After the start, s.
        span_s: f64,
        /// Of all chains.
        nodes: usize,
    },
    /// More than was allowed.
    #[error(
        "needs more memory than allowed: {allowed_mb} MB are spent after {at_s:.0} s of {span_s:.0} s. Allow more (some {whole_mb} MB by that measure), or take a part of it"
    )]
    TooMuchMemory {
        /// After the first reading, s.
        at_s: f64,
        /// Of all readings, s.
        span_s: f64,
        /// What all of them need, should they go on like this.
        whole_mb: usize,
        /// Allowed.
        allowed_mb: usize,
    },
    /// No chain has a solution.
    #[error("none of its {chains} parts can be solved; the first {why}")]
    Unsolved {
        /// How many.
        chains: usize,
        /// Why the first one was not.
        why: BatchError,
    },
}

/// A chain of fewer nodes in all is not worth a batch.
const NODES_MIN: usize = 10;

/// What was published of one IMU sample, as far as it is compared.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LiveSample {
    /// Of the sample.
    pub stamp: Stamp,
    /// The cabin IMU in the world.
    pub state: Pose,
    /// One sigma of x, y and z, m.
    pub position_sigma_m: [f64; 3],
    /// One sigma of the heading, rad.
    pub heading_sigma: f64,
    /// What it rested on.
    pub mode: Mode,
}

/// Rotation and position of the cabin IMU in the world.
pub type Pose = crate::lie::Se3;

/// A run of the estimator over the readings of a boot, and the graph it built.
pub struct Forward {
    /// What it published.
    pub live: Vec<LiveSample>,
    /// The graph.
    pub pasts: Vec<Past>,
    /// Of the site, m/s².
    pub gravity: Vec3,
    span_s: f64,
    fixes: u64,
    readings: u64,
    waits_for: String,
    /// Why the graph was given up on the way.
    spent: Option<ReferenceError>,
}

/// What a graph may take, and what to do when it would take more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Memory {
    /// Of the graph, and of its solution.
    pub allowed_mb: usize,
    /// The run goes on without a graph, for those who watch it; else it ends there.
    pub goes_on_without: bool,
}

/// What happens along [`forward`].
#[derive(Debug)]
pub enum Step<'a> {
    /// A reading was taken, the estimate of it is out, if it led to one.
    Taken(&'a Arrival, Option<&'a Estimate>),
    /// A solution was taken over.
    Corrected(Stamp, Correction),
    /// Something happened.
    Told(&'a Event),
    /// There are no more readings.
    Ended,
}

/// Runs the estimator over readings, keeping its graph; of those with their number in `unseen` its updater does not
/// know. `watch` hears of every step, and may look at the estimator.
///
/// What the graph takes is looked at all along: one that could not be solved within `memory` is given up at once, and
/// [`smooth`] then tells.
pub fn forward(
    arrivals: &[Arrival],
    unseen: &BTreeSet<u64>,
    options: Options,
    memory: Memory,
    mut watch: impl FnMut(Step<'_>, &Estimator),
) -> Forward {
    let gravity = options.smoother.gravity;
    let mut estimator = Estimator::new(options);
    estimator.keep_history();
    let mut live = Vec::new();
    let mut fixes = 0;
    let mut spent = None;
    let ends = arrivals.first().zip(arrivals.last());
    let span_s = ends.map_or(0.0, |(first, last)| last.arrival.seconds_since(first.arrival));
    for (number, arrival) in (0_u64..).zip(arrivals) {
        fixes += u64::from(matches!(arrival.reading, Reading::GnssLeft(_)));
        let estimate = estimator.predict(arrival);
        if spent.is_none() {
            live.extend(estimate.as_ref().map(LiveSample::of));
        }
        watch(Step::Taken(arrival, estimate.as_ref()), &estimator);
        if unseen.contains(&number) {
            continue;
        }
        if let Some(correction) = estimator.update(arrival) {
            watch(Step::Corrected(arrival.arrival, correction), &estimator);
        }
        for event in estimator.take_events() {
            watch(Step::Told(&event), &estimator);
        }
        if spent.is_none() && needed_mb(estimator.history_nodes()) > memory.allowed_mb {
            let at_s = arrival.arrival.seconds_since(arrivals[0].arrival);
            // A graph grows with time.
            let whole_mb = (memory.allowed_mb as f64 * span_s / at_s.max(1e-3)).ceil() as usize;
            let allowed_mb = memory.allowed_mb;
            spent = Some(ReferenceError::TooMuchMemory { at_s, span_s, whole_mb, allowed_mb });
            estimator.forget_history();
            live = Vec::new();
            if !memory.goes_on_without {
                break;
            }
        }
    }
    estimator.finish();
    for event in estimator.take_events() {
        watch(Step::Told(&event), &estimator);
    }
    watch(Step::Ended, &estimator);
    Forward {
        live,
        pasts: estimator.take_history(),
        gravity,
        span_s,
        fixes,
        readings: arrivals.len() as u64,
        waits_for: estimator.health().waits_for.unwrap_or_else(|| "more readings".to_owned()),
        spent,
    }
}

/// What a graph of so many nodes in all and in its longest chain takes when it is solved.
fn needed_mb([nodes, longest]: [usize; 2]) -> usize {
    (nodes * PAST_NODE_BYTES + longest * NODE_BYTES).div_ceil(1_000_000)
}

impl LiveSample {
    fn of(estimate: &Estimate) -> Self {
        Self {
            stamp: estimate.stamp,
            state: Pose::new(estimate.state.rotation, estimate.state.position),
            position_sigma_m: estimate.position_sigma_m(),
            heading_sigma: estimate.state.heading_variance(&estimate.covariance).sqrt(),
            mode: estimate.mode,
        }
    }
}

/// One chain, solved.
#[derive(Clone, Debug)]
pub struct SolvedChain {
    /// Its nodes, oldest first.
    pub nodes: Vec<SmoothedNode>,
    /// Steps of the solve.
    pub iterations: usize,
    /// Whether the last step was within the tolerance.
    pub converged: bool,
    /// Before the first step and after the last.
    pub cost: [f64; 2],
    /// By kind.
    pub factors: FactorCounts,
    samples: Vec<ImuSample>,
    /// Where the next chain of the same clock begins.
    until: Option<Stamp>,
}

/// All chains of a run, solved.
#[derive(Clone, Debug)]
pub struct Smoothed {
    /// In the order in which they began.
    pub chains: Vec<SolvedChain>,
    /// Those that could not be.
    pub unsolved: Vec<Unsolved>,
    gravity: Vec3,
}

/// Solves what a run has built, chain by chain; `tell` hears of each step which part of the whole is done, by and by.
///
/// # Errors
/// [`ReferenceError`].
pub fn smooth(forward: &Forward, mut tell: impl FnMut(f64)) -> Result<Smoothed, ReferenceError> {
    forward.check()?;
    let options = batch::Options::new(forward.gravity);
    let all: usize = forward.pasts.iter().map(|past| past.nodes.len()).sum();
    let mut smoothed = Smoothed { chains: Vec::new(), unsolved: Vec::new(), gravity: forward.gravity };
    let (mut done, mut first_failure) = (0, None);
    for past in &forward.pasts {
        let mut chains = batch::chains(&past.nodes).peekable();
        while let Some(chain) = chains.next() {
            let until = chains.peek().map(|next| next[0].stamp);
            let part = |steps: usize| {
                let steps = steps as f64 / (steps as f64 + 3.0);
                (done as f64 + chain.len() as f64 * steps) / all as f64
            };
            match batch::solve(chain, &options, |progress| tell(part(progress.iterations))) {
                Ok(solution) => {
                    let ends = [chain[0].stamp, until.unwrap_or(chain[chain.len() - 1].stamp)];
                    smoothed.chains.push(SolvedChain {
                        nodes: solution.nodes,
                        iterations: solution.iterations,
                        converged: solution.converged,
                        cost: solution.cost,
                        factors: solution.factors,
                        samples: samples_of(&past.samples, ends, until.is_none()),
                        until,
                    });
                }
                Err(why) => {
                    first_failure.get_or_insert(why);
                    smoothed.unsolved.push(Unsolved {
                        start_s: chain[0].stamp.as_seconds(),
                        end_s: chain[chain.len() - 1].stamp.as_seconds(),
                        nodes: chain.len(),
                        why: why.to_string(),
                    });
                }
            }
            done += chain.len();
        }
    }
    match first_failure {
        Some(why) if smoothed.chains.is_empty() => {
            Err(ReferenceError::Unsolved { chains: smoothed.unsolved.len(), why })
        }
        _ => Ok(smoothed),
    }
}

/// The samples around these stamps, or to their end.
fn samples_of(samples: &[ImuSample], [start, end]: [Stamp; 2], to_end: bool) -> Vec<ImuSample> {
    let first = samples.partition_point(|sample| sample.stamp <= start).saturating_sub(1);
    let last = samples.partition_point(|sample| sample.stamp < end) + 1;
    samples[first..if to_end { samples.len() } else { last.min(samples.len()) }].to_vec()
}

impl Forward {
    fn check(&self) -> Result<(), ReferenceError> {
        if let Some(spent) = &self.spent {
            return Err(spent.clone());
        }
        let nodes: usize = self.pasts.iter().map(|past| past.nodes.len()).sum();
        if self.readings == 0 {
            return Err(ReferenceError::Empty);
        }
        if self.fixes == 0 {
            return Err(ReferenceError::NoFixes);
        }
        if nodes == 0 {
            return Err(ReferenceError::NotStarted {
                span_s: self.span_s,
                waits_for: self.waits_for.clone(),
            });
        }
        let chains = || self.pasts.iter().flat_map(|past| batch::chains(&past.nodes));
        let span_s = |chain: &[std::sync::Arc<crate::smoother::PastNode>]| {
            chain[chain.len() - 1].stamp.seconds_since(chain[0].stamp)
        };
        if nodes < NODES_MIN {
            return Err(ReferenceError::TooShort { span_s: chains().map(span_s).sum(), nodes });
        }
        Ok(())
    }
}

impl Smoothed {
    /// Gives `say` the smoothed state at every IMU sample, with the node before it, oldest first.
    pub fn at_samples(&self, mut say: impl FnMut(Stamp, &NavState, &SmoothedNode)) {
        for chain in &self.chains {
            batch::fill(&chain.nodes, &chain.samples, &self.gravity, |stamp, state, node| {
                if chain.until.is_none_or(|until| stamp < until) {
                    say(stamp, state, node);
                }
            });
        }
    }

    /// How far the live estimate was from it.
    pub fn gain(&self, live: &[LiveSample]) -> Gain {
        gain::of(self, live)
    }
}
