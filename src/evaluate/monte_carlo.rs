//! Many seeded runs: medians and tails of every method, and accuracy against the length of an outage and the quality of
//! the lidar.
//!
//! Each run is a value of its seed alone, and results are put together in the order of [`jobs`]: on how many threads they
//! were run does not show.

use std::collections::BTreeMap;

use serde::Serialize;

use super::Statistics;
use super::paper::margin;
use super::report::{Axis, Page, Plot, Scale, Series, Style, Table, figure};
use super::tasks::{self, Task};
use super::trial::{self, Setup};
use crate::baselines::Kind;
use crate::config::ConfigError;

/// Lengths of outages, s.
pub const LENGTHS_S: [f64; 6] = [10.0, 30.0, 60.0, 120.0, 200.0, 300.0];
/// An outage of the table begins so late, s.
const OUTAGE_BEGINS_S: f64 = 60.0;
/// What comes after it is not simulated beyond that, s.
const AFTER_OUTAGE_S: f64 = 3.0;

/// How good the lidar odometry is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Lidar {
    /// Increments half as far off as in the scenarios.
    Good,
    /// As in the scenarios: 6 mm, 0.05°, 0.15 %.
    Usual,
    /// Twice.
    Poor,
    /// Four times.
    Bad,
    /// There is none.
    Missing,
}

impl Lidar {
    /// All, the best first.
    pub const ALL: [Lidar; 5] = [Lidar::Good, Lidar::Usual, Lidar::Poor, Lidar::Bad, Lidar::Missing];

    const fn factor(self) -> f64 {
        match self {
            Lidar::Good => 0.5,
            Lidar::Usual | Lidar::Missing => 1.0,
            Lidar::Poor => 2.0,
            Lidar::Bad => 4.0,
        }
    }

    const fn title(self) -> &'static str {
        match self {
            Lidar::Good => "half the error",
            Lidar::Usual => "usual lidar",
            Lidar::Poor => "twice the error",
            Lidar::Bad => "four times",
            Lidar::Missing => "no lidar",
        }
    }
}

/// One run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Job {
    task: Task,
    kind: Kind,
    machine: usize,
    seed: u64,
    /// An outage of that length and a lidar of that quality; else the task's own.
    outage: Option<(usize, Lidar)>,
}

/// What is run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Seeded runs of each case, of two machines each.
    pub runs: u64,
    /// Seed of the first.
    pub first_seed: u64,
    /// Tasks and outages end early, s; for tries.
    pub end_s: Option<f64>,
}

/// What one run amounts to.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Outcome {
    /// With good GNSS, cm.
    pub good_rmse_cm: f64,
    /// With good GNSS, degrees.
    pub good_heading_deg: f64,
    /// Without, cm.
    pub outage_rmse_cm: f64,
    /// Without, cm.
    pub outage_largest_cm: f64,
    /// Without, degrees.
    pub outage_heading_deg: f64,
    /// When fixes come back, cm.
    pub jump_cm: f64,
    /// Of odom beyond the true motion, mm.
    pub odom_step_mm: f64,
    /// Mean of how far updates move the newest position, cm.
    pub consistency_cm: f64,
    /// Of the position, with good GNSS; 1 is as the covariance says.
    pub good_nees: f64,
    /// Of the position, without.
    pub outage_nees: f64,
}

/// All runs, those of the methods first.
pub fn jobs(limits: &Limits) -> Vec<Job> {
    let seeds = || (0..limits.runs).map(|run| limits.first_seed.wrapping_add(run));
    let mut jobs = Vec::new();
    for task in Task::ALL {
        for kind in Kind::ALL {
            for seed in seeds() {
                jobs.extend([0, 1].map(|machine| Job { task, kind, machine, seed, outage: None }));
            }
        }
    }
    for task in Task::ALL {
        for length in 0..LENGTHS_S.len() {
            for lidar in Lidar::ALL {
                for seed in seeds() {
                    let outage = Some((length, lidar));
                    jobs.extend([0, 1].map(|machine| Job { task, kind: Kind::Dual, machine, seed, outage }));
                }
            }
        }
    }
    jobs
}

impl Job {
    /// Runs it. GNSS is blocked in the outage: there are no fixes at all.
    ///
    /// # Errors
    /// [`ConfigError`] of the shipped scenario, which a test excludes.
    pub fn run(&self, limits: &Limits) -> Result<Outcome, ConfigError> {
        let mut scenario = self.task.scenario()?;
        scenario.file.seed = self.seed;
        let mut setup = Setup::new(self.kind, self.machine);
        setup.end_s = limits.end_s;
        match self.outage {
            None => {
                if let Some([begin_s, end_s]) = trial::outage_of(&scenario) {
                    tasks::block(&mut scenario, begin_s, end_s);
                }
            }
            Some((length, lidar)) => {
                if self.task == Task::Digging {
                    tasks::lengthen(&mut scenario);
                }
                tasks::scale_lidar(&mut scenario, lidar.factor());
                setup.without_lidar = lidar == Lidar::Missing;
                let end_s = OUTAGE_BEGINS_S + LENGTHS_S[length];
                tasks::block(&mut scenario, OUTAGE_BEGINS_S, end_s);
                let end_s = end_s + AFTER_OUTAGE_S;
                setup.end_s = Some(limits.end_s.map_or(end_s, |limit_s| limit_s.min(end_s)));
            }
        }
        let trial = trial::run(&scenario, setup, || 0);
        let mean = trial.correction_cm.iter().sum::<f64>() / trial.correction_cm.len() as f64;
        Ok(Outcome {
            good_rmse_cm: 100.0 * trial.good.rmse_m(),
            good_heading_deg: trial.good.heading_rmse_deg(),
            outage_rmse_cm: 100.0 * trial.outage.rmse_m(),
            outage_largest_cm: 100.0 * trial.outage.largest_m,
            outage_heading_deg: trial.outage.heading_rmse_deg(),
            // What is never corrected has no jump.
            jump_cm: if trial.correction_cm.is_empty() { f64::NAN } else { 100.0 * trial.return_jump_m },
            odom_step_mm: 1e3 * trial.largest_odom_step_m,
            consistency_cm: mean,
            good_nees: trial.good.position_nees.mean(),
            outage_nees: trial.outage.position_nees.mean(),
        })
    }
}

/// Of many runs: half are smaller than the median.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Tails {
    /// How many.
    pub runs: usize,
    /// Median.
    pub median: f64,
    /// 95 % are smaller.
    pub p95: f64,
    /// Greatest.
    pub max: f64,
}

impl Tails {
    fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        let values: Vec<f64> = values.filter(|value| value.is_finite()).collect();
        let runs = values.len();
        let Statistics { median, p95, max, .. } = Statistics::of(values)?;
        Some(Self { runs, median, p95, max })
    }

    fn text(tails: Option<Self>) -> String {
        tails.map_or("–".to_owned(), |Tails { median, p95, max, .. }| {
            format!("{} ({}, {})", figure(median), figure(p95), figure(max))
        })
    }
}

const OFF_IN_OUTAGE: &str = "outage: position RMSE, cm";
const HEADING_IN_OUTAGE: &str = "outage: heading RMSE, °";
const NEES_IN_OUTAGE: &str = "outage: position NEES";
const MOVES: &str = "update moves the prediction, mean, cm";
/// What is told of every method: name, value.
type Measure = (&'static str, fn(&Outcome) -> f64);
const MEASURES: [Measure; 10] = [
    ("GNSS good: position RMSE, cm", |outcome| outcome.good_rmse_cm),
    ("GNSS good: heading RMSE, °", |outcome| outcome.good_heading_deg),
    (OFF_IN_OUTAGE, |outcome| outcome.outage_rmse_cm),
    ("outage: largest error, cm", |outcome| outcome.outage_largest_cm),
    (HEADING_IN_OUTAGE, |outcome| outcome.outage_heading_deg),
    ("jump of the world pose after it, cm", |outcome| outcome.jump_cm),
    ("odom: largest step, mm", |outcome| outcome.odom_step_mm),
    (MOVES, |outcome| outcome.consistency_cm),
    ("GNSS good: position NEES", |outcome| outcome.good_nees),
    (NEES_IN_OUTAGE, |outcome| outcome.outage_nees),
];

type ByName<T> = BTreeMap<&'static str, T>;
type Measures = ByName<Option<Tails>>;
type Lengths = Vec<(f64, Option<Tails>)>;

/// The median of a method in a measure, if it has one.
fn median(methods: &ByName<Measures>, kind: Kind, name: &str) -> Option<f64> {
    methods[kind.name()][name].map(|tails| tails.median)
}

/// Where ours is not ahead by the median: of whom, by how much, and why, as far as the figures show it.
fn behind(methods: &ByName<Measures>, name: &str) -> Option<String> {
    let ours = median(methods, Kind::Dual, name)?;
    let others = Kind::ALL.into_iter().skip(1).filter_map(|kind| Some((kind, median(methods, kind, name)?)));
    let ahead: Vec<(Kind, f64)> = others.filter(|(_, other)| *other <= ours && *other > 0.0).collect();
    if ahead.is_empty() {
        return None;
    }
    let never = |(kind, _): &(Kind, f64)| median(methods, *kind, MOVES).is_none();
    let off = |kind: Kind| median(methods, kind, OFF_IN_OUTAGE).map_or("–".to_owned(), figure);
    let why = if ahead.iter().all(never) {
        let told: Vec<String> = ahead.iter().map(|(kind, _)| off(*kind)).collect();
        format!(
            "; nothing corrects it, in the outage it is off by {} cm, ours by {}",
            told.join(" and "),
            off(Kind::Dual)
        )
    } else {
        let of = |name: &str| {
            let kinds = std::iter::once(Kind::Dual).chain(ahead.iter().map(|(kind, _)| *kind));
            let told = kinds.map(|kind| {
                let value = median(methods, kind, name).map_or("–".to_owned(), figure);
                format!("{} {value}", kind.title())
            });
            told.collect::<Vec<String>>().join(", ")
        };
        format!(
            "; medians of {HEADING_IN_OUTAGE}: {}, and of {NEES_IN_OUTAGE}: {}",
            of(HEADING_IN_OUTAGE),
            of(NEES_IN_OUTAGE)
        )
    };
    let told: Vec<String> = ahead.iter().map(|(kind, other)| margin(kind.title(), *other, ours)).collect();
    Some(format!("{name}: {}{why}", told.join(", ")))
}

/// All results.
#[derive(Clone, Debug, Serialize)]
pub struct Results {
    runs: u64,
    first_seed: u64,
    /// Task, method, measure.
    methods: ByName<ByName<Measures>>,
    /// Task, lidar, length (s): RMSE in the outage, cm.
    outages: ByName<ByName<Lengths>>,
}

/// Puts outcomes together; they are in the order of the jobs.
pub fn results(limits: &Limits, jobs: &[Job], outcomes: &[Outcome]) -> Results {
    let select = |wanted: &dyn Fn(&Job) -> bool| {
        let pairs = jobs.iter().zip(outcomes).filter(|(job, _)| wanted(job));
        pairs.map(|(_, outcome)| *outcome).collect::<Vec<_>>()
    };
    let mut methods = BTreeMap::new();
    let mut outages = BTreeMap::new();
    for task in Task::ALL {
        let of_kind = |kind: Kind| {
            let chosen = select(&|job| job.task == task && job.kind == kind && job.outage.is_none());
            let measures = MEASURES.iter().map(|(name, value)| (*name, Tails::of(chosen.iter().map(value))));
            (kind.name(), measures.collect())
        };
        methods.insert(task.name(), Kind::ALL.into_iter().map(of_kind).collect());
        let of_lidar = |lidar: Lidar| {
            let of_length = |length: usize| {
                let chosen = select(&|job| job.task == task && job.outage == Some((length, lidar)));
                (LENGTHS_S[length], Tails::of(chosen.iter().map(|outcome| outcome.outage_rmse_cm)))
            };
            (lidar.title(), (0..LENGTHS_S.len()).map(of_length).collect())
        };
        outages.insert(task.name(), Lidar::ALL.into_iter().map(of_lidar).collect());
    }
    Results { runs: limits.runs, first_seed: limits.first_seed, methods, outages }
}

impl Results {
    /// The page.
    pub fn page(&self) -> Page {
        let mut page = Page::new("holdfast over many seeds");
        page.text(&format!(
            "Simulated: {} runs of each case from seed {} on, two machines each. Figures are medians, in brackets 95 % and the \
             largest. No fixes arrive in an outage. The same seeds give the same figures to the last bit.",
            self.runs, self.first_seed
        ));
        for task in Task::ALL {
            page.heading(&format!("The {} task, every method", task.name()));
            page.table(self.methods_table(task));
        }
        for task in Task::ALL {
            page.heading(&format!(
                "Length of the outage and quality of the lidar, {} task, holdfast",
                task.name()
            ));
            page.table(self.outage_table(task));
            page.plot(self.outage_plot(task));
        }
        page
    }

    fn methods_table(&self, task: Task) -> Table {
        let header: Vec<&str> = std::iter::once("").chain(Kind::ALL.map(Kind::title)).collect();
        let mut table = Table::new(&format!("{} task: median (95 %, largest)", task.name()), &header);
        let methods = &self.methods[task.name()];
        for (name, _) in MEASURES {
            let cells = Kind::ALL.map(|kind| Tails::text(methods[kind.name()][name]));
            table.row(name, &cells);
        }
        let behind: Vec<String> = MEASURES
            .iter()
            .filter(|(name, _)| !name.contains("NEES"))
            .filter_map(|(name, _)| behind(methods, name))
            .collect();
        table.note(&if behind.is_empty() {
            "By the median, holdfast is ahead of every baseline in every row of errors.".to_owned()
        } else {
            format!("By the median, holdfast is not ahead in: {}.", behind.join(". "))
        });
        table
    }

    fn outage_table(&self, task: Task) -> Table {
        let header: Vec<&str> = std::iter::once("outage, s").chain(Lidar::ALL.map(Lidar::title)).collect();
        let caption =
            format!("{} task: position RMSE in the outage, cm, median (95 %, largest)", task.name());
        let mut table = Table::new(&caption, &header);
        let outages = &self.outages[task.name()];
        for (index, length_s) in LENGTHS_S.iter().enumerate() {
            let cells = Lidar::ALL.map(|lidar| Tails::text(outages[lidar.title()][index].1));
            table.row(&figure(*length_s), &cells);
        }
        table.note("The usual lidar is off by 6 mm, 0.05° and 0.15 % in each increment, five a second.");
        table
    }

    fn outage_plot(&self, task: Task) -> Plot {
        let styles = [Style::First, Style::Ours, Style::Second, Style::Third, Style::Fourth];
        let line = |(lidar, style): (Lidar, Style)| {
            let tails = &self.outages[task.name()][lidar.title()];
            let points =
                tails.iter().filter_map(|(length_s, tails)| Some((*length_s, tails.as_ref()?.median)));
            Series::new(lidar.title(), style, points.collect())
        };
        Plot {
            title: format!("Accuracy against the length of an outage, {} task, simulated", task.name()),
            description: "Median of the position's RMSE in the outage, in centimetres on a logarithmic scale, for lidar \
                          odometry of several qualities."
                .to_owned(),
            x: Axis::new("length of the outage, s"),
            y: Axis::scaled("RMSE in the outage, cm", Scale::Logarithmic(0.1, 1e5)),
            series: Lidar::ALL.into_iter().zip(styles).map(line).collect(),
            bands: Vec::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outcomes_are_counted_where_they_belong() {
        let limits = Limits { runs: 2, first_seed: 5, end_s: None };
        let jobs = jobs(&limits);
        assert_eq!(jobs.len(), 2 * 5 * 2 * 2 + 2 * 6 * 5 * 2 * 2);
        let outcome = |job: &Job| Outcome {
            good_rmse_cm: job.seed as f64 + job.machine as f64 * 10.0,
            good_heading_deg: 0.0,
            outage_rmse_cm: job.outage.map_or(f64::NAN, |(length, lidar)| LENGTHS_S[length] * lidar.factor()),
            outage_largest_cm: 0.0,
            outage_heading_deg: 0.0,
            jump_cm: 0.0,
            odom_step_mm: 0.0,
            consistency_cm: 0.0,
            good_nees: 1.0,
            outage_nees: 1.0,
        };
        let outcomes: Vec<Outcome> = jobs.iter().map(outcome).collect();
        let results = results(&limits, &jobs, &outcomes);
        let tails = results.methods["digging"]["msf"]["GNSS good: position RMSE, cm"].expect("some");
        assert_eq!((tails.runs, tails.median, tails.max), (4, 10.5, 16.0));
        assert_eq!(results.methods["digging"]["msf"]["outage: position RMSE, cm"], None);
        let (length_s, tails) = results.outages["navigation"]["twice the error"][2];
        assert_eq!((length_s, tails.expect("some").median), (60.0, 120.0));
        assert!(results.page().html().contains("four times"));
    }

    #[test]
    fn margins_are_told_and_reasons_only_where_figures_show_them() {
        let figures = |value: f64| Tails { runs: 1, median: value, p95: value, max: value };
        let methods: ByName<Measures> = Kind::ALL
            .into_iter()
            .map(|kind| {
                let known = |name: &str| match (kind, name) {
                    (Kind::DeadReckoning, MOVES) => None,
                    (Kind::DeadReckoning, OFF_IN_OUTAGE) => Some(figures(900.0)),
                    (Kind::DeadReckoning, "odom: largest step, mm") => Some(figures(0.1)),
                    (Kind::Tsif, "GNSS good: position RMSE, cm") => Some(figures(0.95)),
                    (Kind::Dual, _) => Some(figures(1.0)),
                    _ => Some(figures(2.0)),
                };
                (kind.name(), MEASURES.iter().map(|(name, _)| (*name, known(name))).collect())
            })
            .collect();
        assert_eq!(behind(&methods, OFF_IN_OUTAGE), None);
        let good = "GNSS good: position RMSE, cm";
        let told = behind(&methods, good).expect("behind");
        assert!(told.starts_with(&format!("{good}: TSIF (0.95 of ours); medians of ")), "{told}");
        assert!(told.ends_with("outage: position NEES: holdfast 1.00, TSIF 2.00"), "{told}");
        let step = behind(&methods, "odom: largest step, mm").expect("behind");
        assert!(step.contains("dead reckoning (0.10 of ours); nothing corrects it"), "{step}");
        assert!(step.ends_with("it is off by 900.0 cm, ours by 1.00"), "{step}");
    }

    #[test]
    fn a_seed_gives_the_same_outcome_to_the_bit() {
        let limits = Limits { runs: 1, first_seed: 3, end_s: Some(20.0) };
        let job = jobs(&limits)[0];
        let [one, two] = [0, 1].map(|_| job.run(&limits).expect("valid"));
        assert_eq!(one.good_rmse_cm.to_bits(), two.good_rmse_cm.to_bits());
        assert!(one.good_rmse_cm > 0.0 && one.outage_rmse_cm.is_nan(), "{one:?}");
    }
}
