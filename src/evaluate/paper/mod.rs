//! What the paper shows, by the simulator: its tables and figures for our estimator and for the baselines.
//!
//! Nubert, Khattak, Hutter, "Graph-based Multi-sensor Fusion for Consistent Localization of Autonomous Construction
//! Robots" (ICRA 2022). Its figures are of a real machine and are only held beside ours, which are simulated.

mod figures;
mod sheet;
mod tables;

pub(super) use sheet::margin;
pub use sheet::{Cell, Row, Sheet};

use serde::Serialize;

use super::report::Page;
use super::tasks::Task;
use super::trial::{self, Setup, Trial};
use crate::baselines::Kind;
use crate::config::ConfigError;
use crate::replay::Distribution;

/// What the paper says of its own method: mean, standard deviation, unit.
pub mod published {
    /// Position relative to RTK (Table I), cm.
    pub const RELATIVE_TO_RTK_CM: [f64; 2] = [0.18, 1.28];
    /// From an IMU sample to the state (Table II), µs.
    pub const LATENCY_US: [f64; 2] = [41.0, 15.0];
    /// How far an update moves the prediction (section V-D), cm.
    pub const CONSISTENCY_CM: [f64; 2] = [0.58, 3.16];
}

/// One run of the study.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Job {
    /// The task.
    pub task: Task,
    /// The method.
    pub kind: Kind,
    /// The machine's place in the scenario.
    pub machine: usize,
}

impl Job {
    /// All runs of a study, in the order in which [`study`] takes their results.
    pub fn all() -> Vec<Job> {
        let of_task = |task| {
            Kind::ALL.into_iter().flat_map(move |kind| (0..2).map(move |machine| Job { task, kind, machine }))
        };
        Task::ALL.into_iter().flat_map(of_task).collect()
    }

    /// Runs it.
    ///
    /// # Errors
    /// [`ConfigError`] of the shipped scenario, which a test excludes.
    pub fn run(self, limits: Limits) -> Result<Trial, ConfigError> {
        let mut scenario = self.task.scenario()?;
        scenario.file.seed = scenario.file.seed.wrapping_add(limits.seed);
        let setup = Setup { traced: true, end_s: limits.end_s, ..Setup::new(self.kind, self.machine) };
        Ok(trial::run(&scenario, setup, || 0))
    }
}

/// What is run of the tasks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Limits {
    /// Added to the scenarios' own seeds.
    pub seed: u64,
    /// Tasks end early, s; for tries.
    pub end_s: Option<f64>,
}

/// How long things take on the reader's machine.
#[derive(Clone, Debug, Serialize)]
pub struct Latency {
    /// Ours on two threads, readings at their pace: from the sample to its estimate, µs.
    pub live_us: Distribution,
    /// How many times real time that pace was.
    pub live_speed: f64,
    /// Each method on one thread.
    pub methods: Vec<MethodLatency>,
}

/// How long a method takes on one thread.
#[derive(Clone, Debug, Serialize)]
pub struct MethodLatency {
    /// Its name.
    pub method: &'static str,
    /// From a reading to its estimate, µs.
    pub predict_us: Distribution,
    /// From a measurement to the update that it led to, µs.
    pub update_us: Distribution,
}

/// The study of one task: for each method its trials, one a machine.
pub(crate) struct TaskStudy {
    pub task: Task,
    pub outage: [f64; 2],
    pub trials: Vec<(Kind, Vec<Trial>)>,
}

/// All tasks, and what was measured of time.
pub struct Study {
    tasks: Vec<TaskStudy>,
    latency: Option<Latency>,
    limits: Limits,
}

/// Puts the results of [`Job::all`] together.
///
/// # Errors
/// [`ConfigError`] of a shipped scenario, which a test excludes.
pub fn study(trials: Vec<Trial>, latency: Option<Latency>, limits: Limits) -> Result<Study, ConfigError> {
    let mut trials = trials.into_iter();
    let mut tasks = Vec::new();
    for task in Task::ALL {
        let outage = trial::outage_of(&task.scenario()?).unwrap_or_default();
        let of_kind = Kind::ALL.into_iter().map(|kind| (kind, trials.by_ref().take(2).collect()));
        tasks.push(TaskStudy { task, outage, trials: of_kind.collect() });
    }
    Ok(Study { tasks, latency, limits })
}

impl Study {
    /// All tables.
    pub fn sheets(&self) -> Vec<Sheet> {
        let mut sheets = vec![tables::beside_the_paper(&self.tasks, self.latency.as_ref())];
        sheets.push(tables::relative_to_rtk(&self.tasks));
        sheets.extend(self.latency.as_ref().map(tables::latency));
        for task in &self.tasks {
            sheets.push(tables::accuracy(task));
            sheets.push(tables::consistency(task));
            sheets.push(tables::covariance(task));
        }
        sheets
    }

    /// The page: tables and figures.
    pub fn page(&self) -> Page {
        let mut page = Page::new("holdfast beside the paper and its baselines");
        page.text(
            "All runs on this page are simulated: two walking excavators with different sensor mountings, noise as in the \
             scenario files, exact truth. The paper's figures are of real machines and stand beside ours for their size, \
             not for a race. TSIF, MSF, lidar odometry and dead reckoning are written anew from their publications, start \
             where ours starts, and have the same noise figures (src/baselines/README.md).",
        );
        let seed = self.limits.seed;
        page.text(&format!(
            "Seeds: those of the scenario files{}. The same seeds give the same figures to the last bit, latencies apart.",
            if seed == 0 { String::new() } else { format!(" + {seed}") }
        ));
        let mut sheets = self.sheets().into_iter();
        page.heading("Beside the paper");
        sheets.by_ref().take(1).for_each(|sheet| _ = page.table(sheet.table()));
        page.heading("Table I: position relative to RTK");
        sheets.by_ref().take(1).for_each(|sheet| _ = page.table(sheet.table()));
        if self.latency.is_some() {
            page.heading("Table II: latency on this computer");
            sheets.by_ref().take(1).for_each(|sheet| _ = page.table(sheet.table()));
        }
        for task in &self.tasks {
            page.heading(match task.task {
                Task::Digging => "Digging task, simulated (Figs. 3 and 6)",
                Task::Navigation => "Navigation task, simulated (Figs. 4 and 6)",
            });
            let [begin_s, end_s] = task.outage;
            page.text(&format!(
                "GNSS is {} from {begin_s} s to {end_s} s. Plots are of the first machine, tables of both.",
                match task.task {
                    Task::Digging => "unreliable",
                    Task::Navigation => "shadowed by trees",
                }
            ));
            sheets.by_ref().take(3).for_each(|sheet| _ = page.table(sheet.table()));
            figures::of(task).into_iter().for_each(|plot| _ = page.plot(plot));
        }
        page
    }
}
