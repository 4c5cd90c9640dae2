//! The tables.

use super::sheet::{Cell, Row, Sheet};
use super::{Latency, TaskStudy, published};
use crate::baselines::Kind;
use crate::evaluate::report::{figure, spread};
use crate::evaluate::trial::{Errors, Trial, bounds_of};
use crate::replay::Distribution;

/// Mean and standard deviation; NaN of nothing.
fn moments(values: impl Iterator<Item = f64> + Clone) -> [f64; 2] {
    let count = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / count;
    let variance = values.map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    [mean, variance.sqrt()]
}

impl TaskStudy {
    fn of(&self, kind: Kind) -> &[Trial] {
        self.trials.iter().find(|(other, _)| *other == kind).map_or(&[], |(_, trials)| trials)
    }

    fn cells(&self, cell: impl Fn(&[Trial]) -> Cell) -> Vec<Cell> {
        Kind::ALL.into_iter().map(|kind| cell(self.of(kind))).collect()
    }

    /// Of all machines of ours together.
    fn moments_of<'a>(&'a self, kind: Kind, of: impl Fn(&'a Trial) -> &'a Vec<f64> + Clone) -> [f64; 2] {
        moments(self.of(kind).iter().flat_map(of).copied())
    }
}

/// There are no figures that would show why.
fn unknown(_: &[Kind]) -> Option<String> {
    None
}

/// No figure of a run shows why: what is known of the methods.
fn documented(_: &[Kind]) -> Option<String> {
    Some(
        "not measured here; as src/estimator/README.md explains, a sample of ours costs a step of odom and of the chassis \
         beside that of the state"
            .to_owned(),
    )
}

impl TaskStudy {
    /// That those ahead are never corrected, if none of them is, and how far off they are meanwhile.
    fn uncorrected(&self, ahead: &[Kind]) -> Option<String> {
        let never = |kind: &Kind| self.of(*kind).iter().all(|trial| trial.correction_cm.is_empty());
        let off_cm = |kind: Kind| 100.0 * errors(self.of(kind), |trial| &trial.outage).rmse_m();
        let told = |kind: &Kind| format!("{} is off by {} cm", kind.title(), figure(off_cm(*kind)));
        ahead.iter().all(never).then(|| {
            let told: Vec<String> = ahead.iter().map(told).collect();
            let ours = figure(off_cm(Kind::Dual));
            format!("nothing corrects it; in the outage {} (RMSE), ours by {ours}", told.join(", "))
        })
    }

    /// That those ahead move less at updates and are farther from the truth for it, if all of them are.
    fn follows_late(&self, ahead: &[Kind]) -> Option<String> {
        let off_cm = |kind: Kind| {
            let mut all = errors(self.of(kind), |trial| &trial.good);
            all.add(&errors(self.of(kind), |trial| &trial.outage));
            100.0 * all.rmse_m()
        };
        let told = |kind: &Kind| format!("{} by {} cm", kind.title(), figure(off_cm(*kind)));
        ahead.iter().all(|kind| off_cm(*kind) > off_cm(Kind::Dual)).then(|| {
            let told: Vec<String> = ahead.iter().map(told).collect();
            let ours = figure(off_cm(Kind::Dual));
            format!(
                "moved less by its updates, it is farther from the truth: {}, ours by {ours} (RMSE)",
                told.join(", ")
            )
        })
    }

    /// What of this run bears on errors: whether ours are as its covariance says, how far headings drifted, and how
    /// much of the time was an outage.
    fn circumstances(&self, ahead: &[Kind]) -> Option<String> {
        let parts = |kind: Kind| {
            [errors(self.of(kind), |trial| &trial.good), errors(self.of(kind), |trial| &trial.outage)]
        };
        let [good, outage] = parts(Kind::Dual);
        if good.count() == 0.0 || outage.count() == 0.0 {
            return None;
        }
        let nees = |errors: &Errors| figure(errors.nees()[..3].iter().sum::<f64>() / 3.0);
        let heading =
            |kind: &Kind| format!("{} by {}°", kind.title(), figure(parts(*kind)[1].heading_rmse_deg()));
        let headings: Vec<String> = std::iter::once(&Kind::Dual).chain(ahead).map(heading).collect();
        Some(format!(
            "in this run the position NEES of ours is {} with GNSS good and {} in the outage, which is {:.0} % of the time; \
             headings are off in it: {} (RMSE)",
            nees(&good),
            nees(&outage),
            100.0 * outage.count() / (good.count() + outage.count()),
            headings.join(", ")
        ))
    }
}

/// Errors of all machines together.
fn errors<'a>(trials: &'a [Trial], of: impl Fn(&'a Trial) -> &'a Errors) -> Errors {
    let mut all = Errors::default();
    trials.iter().for_each(|trial| all.add(of(trial)));
    all
}

/// A figure of all machines, in other units.
fn scaled(factor: f64, value: f64) -> Cell {
    Cell::new(value * factor, figure(value * factor))
}

fn largest(trials: &[Trial], of: impl Fn(&Trial) -> f64) -> f64 {
    trials.iter().map(of).fold(f64::NAN, f64::max)
}

/// Ours and the paper's.
pub(super) fn beside_the_paper(tasks: &[TaskStudy], latency: Option<&Latency>) -> Sheet {
    let tasks_names = tasks.iter().map(|task| format!("holdfast, {} (simulated)", task.task.name()));
    let header = [String::new(), "paper (real machine)".to_owned()].into_iter().chain(tasks_names);
    let row = |name: &str, paper: [f64; 2], ours: Vec<[f64; 2]>| {
        let cell = |[mean, sd]: [f64; 2]| Cell::new(mean, spread(mean, sd));
        let cells = std::iter::once(paper).chain(ours).map(cell).collect();
        Row { name: name.to_owned(), cells, verdict: String::new() }
    };
    let each = |of: fn(&Trial) -> &Vec<f64>| {
        tasks.iter().map(|task| task.moments_of(Kind::Dual, of)).collect::<Vec<_>>()
    };
    let mut rows = vec![
        row(
            "position relative to RTK, cm",
            published::RELATIVE_TO_RTK_CM,
            each(|trial| &trial.motion_to_fixes_cm),
        ),
        row(
            "update moves the prediction by, cm",
            published::CONSISTENCY_CM,
            each(|trial| &trial.correction_cm),
        ),
    ];
    if let Some(latency) = latency {
        let live = [latency.live_us.mean, latency.live_us.sd];
        rows.push(row("IMU sample to state, live, µs", published::LATENCY_US, vec![live; tasks.len()]));
    }
    Sheet {
        caption: "The paper's figures of its own method, and ours".to_owned(),
        header: header.collect(),
        rows,
        notes: vec![
            "Mean ± standard deviation. The paper: Nubert, Khattak and Hutter, ICRA 2022, on a real excavator. Ours are \
             simulated; the latency is measured on the computer that made this report, in the same run."
                .to_owned(),
        ],
    }
}

/// Table I.
pub(super) fn relative_to_rtk(tasks: &[TaskStudy]) -> Sheet {
    let mut sheet =
        Sheet::of_methods("Table I: motion from fix to fix, GNSS good, simulated; mean ± standard deviation");
    for task in tasks {
        let to_rtk = task.cells(|trials| {
            let [mean, sd] = moments(trials.iter().flat_map(|trial| &trial.motion_to_fixes_cm).copied());
            Cell::new(libm::hypot(mean, sd), spread(mean, sd))
        });
        let off_truth = |kind: Kind| {
            let [mean, sd] = task.moments_of(kind, |trial| &trial.motion_cm);
            libm::hypot(mean, sd)
        };
        let why = |ahead: &[Kind]| {
            let nearer = |kind: &Kind| off_truth(*kind) > off_truth(Kind::Dual);
            let told = |kind: &Kind| format!("{} by {} cm", kind.title(), figure(off_truth(*kind)));
            ahead.iter().all(nearer).then(|| {
                let told: Vec<String> = ahead.iter().map(told).collect();
                let ours = figure(off_truth(Kind::Dual));
                format!(
                    "nearer to the fixes, it is farther from the truth: {}, ours by {ours}",
                    told.join(", ")
                )
            })
        };
        let name = task.task.name();
        sheet.rows.push(Row::new(&format!("{name}: relative to RTK, on each axis, cm"), to_rtk, why));
        let to_truth = task.cells(|trials| {
            let [mean, sd] = moments(trials.iter().flat_map(|trial| &trial.motion_cm).copied());
            Cell::new(libm::hypot(mean, sd), spread(mean, sd))
        });
        let row_name = format!("{name}: relative to the truth, distance, cm");
        sheet.rows.push(Row::new(&row_name, to_truth, |ahead| task.uncorrected(ahead)));
        let rmse = task.cells(|trials| scaled(100.0, errors(trials, |trial| &trial.good).rmse_m()));
        let row_name = format!("{name}: position against the truth, RMSE, cm");
        sheet.rows.push(Row::new(&row_name, rmse, |ahead| task.circumstances(ahead)));
    }
    let [mean, sd] = published::RELATIVE_TO_RTK_CM;
    sheet.notes.push(format!(
        "The left antenna by the estimate as published, from each fix to the next, against the fixes (as the paper's Table I: \
         {mean} ± {sd} cm on a real machine) and against the truth. Lidar odometry has five poses a second, between which it is \
         interpolated."
    ));
    sheet
}

/// Table II.
pub(super) fn latency(latency: &Latency) -> Sheet {
    let mut sheet = Sheet::of_methods(
        "Table II: latency on the computer that made this report, µs; mean ± standard deviation",
    );
    let text = |distribution: &Distribution| spread(distribution.mean, distribution.sd);
    let method = |kind: Kind| latency.methods.iter().find(|method| method.method == kind.name());
    let cells = |value: fn(&super::MethodLatency) -> (f64, String)| {
        let cell = |kind| match method(kind).map(value) {
            Some((key, text)) if key > 0.0 => Cell::new(key, text),
            _ => Cell::none(),
        };
        Kind::ALL.into_iter().map(cell).collect::<Vec<_>>()
    };
    let live = |kind| match kind {
        Kind::Dual => Cell::new(latency.live_us.mean, text(&latency.live_us)),
        _ => Cell::none(),
    };
    sheet.rows.push(Row::new(
        "IMU sample to state, live, two threads",
        Kind::ALL.into_iter().map(live).collect(),
        unknown,
    ));
    sheet.rows.push(Row::new(
        "reading to estimate, one thread",
        cells(|method| (method.predict_us.mean, spread(method.predict_us.mean, method.predict_us.sd))),
        documented,
    ));
    let update_us = method(Kind::Dual).map_or(f64::NAN, |method| method.update_us.mean);
    let why = |_: &[Kind]| {
        (latency.live_us.p999 < update_us).then(|| {
            let (p999, update) = (figure(latency.live_us.p999), figure(update_us));
            format!("no sample waits for it: live, all but one in a thousand have their state after {p999} µs, an update takes {update}")
        })
    };
    sheet.rows.push(Row::new(
        "update, one thread",
        cells(|method| (method.update_us.mean, spread(method.update_us.mean, method.update_us.sd))),
        why,
    ));
    let blocked = |kind: Kind| match (kind, method(kind)) {
        (Kind::Dual, _) => Cell::new(latency.live_us.p999, figure(latency.live_us.p999)),
        (_, Some(method)) if method.update_us.p999 > 0.0 => {
            let longest = method.update_us.p999 + method.predict_us.p999;
            Cell::new(longest, figure(longest))
        }
        _ => Cell::none(),
    };
    sheet.rows.push(Row::new(
        "the longest in a thousand: a sample behind an update",
        Kind::ALL.into_iter().map(blocked).collect(),
        unknown,
    ));
    let [mean, sd] = published::LATENCY_US;
    sheet.notes.push(format!(
        "Live: readings at {} times their pace, prediction and update on two threads, as on a machine. The paper: {mean} ± {sd} µs on \
         its computer. A filter has one thread: a sample that comes during an update waits for it.",
        figure(latency.live_speed)
    ));
    sheet
}

/// Outage, heading, steps.
pub(super) fn accuracy(task: &TaskStudy) -> Sheet {
    let name = task.task.name();
    let mut sheet = Sheet::of_methods(&format!("Errors in the {name} task, both machines, simulated"));
    let mut row =
        |name: &str, cell: &dyn Fn(&[Trial]) -> Cell, why: fn(&TaskStudy, &[Kind]) -> Option<String>| {
            sheet.rows.push(Row::new(name, task.cells(cell), |ahead| why(task, ahead)));
        };
    row(
        "GNSS good: position RMSE, cm",
        &|all| scaled(100.0, errors(all, |trial| &trial.good).rmse_m()),
        TaskStudy::circumstances,
    );
    row(
        "GNSS good: heading RMSE, °",
        &|all| scaled(1.0, errors(all, |trial| &trial.good).heading_rmse_deg()),
        TaskStudy::circumstances,
    );
    row(
        "outage: position RMSE, cm",
        &|all| scaled(100.0, errors(all, |trial| &trial.outage).rmse_m()),
        TaskStudy::circumstances,
    );
    row(
        "outage: horizontal RMSE, cm",
        &|all| scaled(100.0, errors(all, |trial| &trial.outage).horizontal_rmse_m()),
        TaskStudy::circumstances,
    );
    row(
        "outage: height RMSE, cm",
        &|all| scaled(100.0, errors(all, |trial| &trial.outage).vertical_rmse_m()),
        TaskStudy::circumstances,
    );
    row(
        "outage: largest error, cm",
        &|all| scaled(100.0, errors(all, |trial| &trial.outage).largest_m),
        TaskStudy::circumstances,
    );
    row(
        "outage: heading RMSE, °",
        &|all| scaled(1.0, errors(all, |trial| &trial.outage).heading_rmse_deg()),
        TaskStudy::circumstances,
    );
    let jump_m =
        |all: &[Trial]| Some(largest(all, |trial| trial.return_jump_m)).filter(|jump_m| *jump_m > 0.0);
    row(
        "after the outage: largest jump of the world pose, cm",
        &|all| jump_m(all).map_or(Cell::none(), |jump_m| scaled(100.0, jump_m)),
        TaskStudy::circumstances,
    );
    row(
        "odom: largest step beyond the true motion, mm",
        &|all| scaled(1e3, largest(all, |trial| trial.largest_odom_step_m)),
        TaskStudy::uncorrected,
    );
    row(
        "odom: largest turn beyond the true motion, °",
        &|all| scaled(1.0, largest(all, |trial| trial.largest_odom_turn).to_degrees()),
        TaskStudy::uncorrected,
    );
    let yardstick_cm = 100.0 * largest(task.of(Kind::Dual), |trial| trial.yardstick_m);
    sheet.notes.push(format!(
        "What lidar odometry could do at best in the outage, alone (its increments summed up with the true heading and the true \
         standstill): RMSE {} cm on the worse machine. The baselines have one pose for all; theirs is taken for odom.",
        figure(yardstick_cm)
    ));
    sheet.notes.push(
        "This is one run of each machine; medians and tails of many are those of --monte-carlo.".to_owned(),
    );
    sheet
}

/// How far updates move the prediction.
pub(super) fn consistency(task: &TaskStudy) -> Sheet {
    let mut sheet = Sheet::of_methods(&format!(
        "Consistency of prediction and update in the {} task: how far an update moves the newest position, cm",
        task.task.name()
    ));
    let values =
        |trials: &[Trial]| trials.iter().flat_map(|trial| trial.correction_cm.clone()).collect::<Vec<f64>>();
    let why = |ahead: &[Kind]| task.follows_late(ahead);
    let cell = |trials: &[Trial]| {
        let [mean, sd] = moments(values(trials).into_iter());
        Cell::new(libm::hypot(mean, sd), spread(mean, sd))
    };
    sheet.rows.push(Row::new("mean ± standard deviation", task.cells(cell), why));
    let tail = |trials: &[Trial]| {
        let mut values = values(trials);
        values.sort_by(f64::total_cmp);
        let rank = (0.99 * values.len() as f64) as usize;
        values.get(rank).map_or(Cell::none(), |value| scaled(1.0, *value))
    };
    sheet.rows.push(Row::new("99 % are smaller than", task.cells(tail), why));
    sheet
}

/// A mean of squared errors over their variances, and its bounds, if they are known.
type Normalized = (f64, Option<[f64; 2]>);

/// What a normalized error says, beside its bounds if they are known.
fn said_of_itself(value: f64, bounds: Option<[f64; 2]>) -> String {
    match bounds {
        Some([low, high]) if (low..=high).contains(&value) => {
            "ours is within its bounds, where nobody can tell it from 1".to_owned()
        }
        _ if value < 1.0 => "the errors of ours are smaller than its covariance says".to_owned(),
        _ => "the errors of ours are larger than its covariance says".to_owned(),
    }
}

/// Whether covariances are meant.
pub(super) fn covariance(task: &TaskStudy) -> Sheet {
    let mut sheet = Sheet::of_methods(&format!(
        "Squared errors over their covariance in the {} task: 1 is as the covariance says",
        task.task.name()
    ));
    let mut row = |name: &str, value: &dyn Fn(&[Trial]) -> Normalized| {
        let cell = |trials: &[Trial]| {
            let (value, bounds) = value(trials);
            let text = match bounds {
                Some([low, high]) => format!("{} ({}–{})", figure(value), figure(low), figure(high)),
                None => figure(value),
            };
            Cell::new(libm::log(value).abs(), text)
        };
        let (ours, bounds) = value(task.of(Kind::Dual));
        let why = |_: &[Kind]| Some(said_of_itself(ours, bounds));
        sheet.rows.push(Row::new(name, task.cells(cell), why));
    };
    for (name, outage) in [("GNSS good", false), ("outage", true)] {
        let of = move |trial: &Trial| if outage { trial.outage.clone() } else { trial.good.clone() };
        row(&format!("{name}: position NEES (95 % bounds)"), &|all| {
            let errors: Vec<Errors> = all.iter().map(of).collect();
            let series: Vec<_> = errors.iter().map(|errors| &errors.position_nees).collect();
            let mean =
                moments(series.iter().flat_map(|series| series.sampled.iter().map(|(_, value)| *value)))[0];
            (mean, Some(bounds_of(&series)))
        });
        row(&format!("{name}: heading NEES"), &|all| {
            let mut errors = Errors::default();
            all.iter().for_each(|trial| errors.add(&of(trial)));
            (errors.nees()[5], None)
        });
    }
    row("fixes: NIS (95 % bounds)", &|all| {
        let series: Vec<_> = all.iter().map(|trial| &trial.innovation).collect();
        (moments(series.iter().map(|series| series.mean()))[0], Some(bounds_of(&series)))
    });
    sheet.notes.push(
        "NEES: eᵀ C⁻¹ e of the position over its three degrees of freedom, at one a second. NIS: the same of the fixes' \
         innovations against the estimate as published. Bounds hold 95 % of the means of as many independent values as the \
         series is worth (chi-square), since errors in a row are alike. Who is ahead, and by how much, goes by the size of the \
         logarithm: half and twice are as far from 1."
            .to_owned(),
    );
    sheet
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::tasks::Task;

    #[test]
    fn reasons_follow_the_figures() {
        assert!(said_of_itself(0.9, Some([0.8, 1.2])).contains("within its bounds"));
        assert!(said_of_itself(0.7, Some([0.8, 1.2])).contains("smaller than"));
        assert!(said_of_itself(1.3, None).contains("larger than"));
        let trials = |kind: Kind| {
            let correction_cm = if kind == Kind::DeadReckoning { Vec::new() } else { vec![0.1] };
            // Further from the truth than ours, but for dead reckoning.
            let motion_cm = vec![if kind == Kind::DeadReckoning { 0.01 } else { 1.0 + kind as u8 as f64 }; 3];
            let motion_to_fixes_cm = vec![1.0 / (1.0 + kind as u8 as f64); 3];
            (kind, vec![Trial { correction_cm, motion_cm, motion_to_fixes_cm, ..Trial::default() }])
        };
        let study = |kinds: &[Kind]| TaskStudy {
            task: Task::Digging,
            outage: [0.0; 2],
            trials: kinds.iter().map(|kind| trials(*kind)).collect(),
        };
        let task = study(&Kind::ALL);
        assert!(task.uncorrected(&[Kind::DeadReckoning]).expect("true").starts_with("nothing corrects it"));
        assert_eq!(task.uncorrected(&[Kind::DeadReckoning, Kind::Msf]), None);
        assert_eq!(task.circumstances(&[Kind::Msf]), None, "it was never judged");
        let to_fixes = |task| relative_to_rtk(&[task]).rows[0].verdict.clone();
        assert!(to_fixes(study(&[Kind::Dual, Kind::Tsif])).contains("farther from the truth"));
        // Dead reckoning is nearer to both.
        assert!(to_fixes(task).ends_with("of ours)"));
    }
    #[test]
    fn circumstances_and_lateness_are_those_of_the_run() {
        let study = |msf_off_m: f64| TaskStudy {
            task: Task::Digging,
            outage: [0.0; 2],
            trials: [(Kind::Dual, 1.0), (Kind::Msf, msf_off_m)]
                .map(|(kind, off_m)| {
                    let [good, outage] = [Errors::off_by(off_m, 1.0), Errors::off_by(2.0 * off_m, 1.0)];
                    (kind, vec![Trial { good, outage, ..Trial::default() }])
                })
                .into(),
        };
        let told = study(0.5).circumstances(&[Kind::Msf]).expect("it was judged");
        for part in ["NEES of ours is 1.00 with GNSS good and 4.00 in the outage", "50 % of the time"] {
            assert!(told.contains(part), "{told}");
        }
        assert!(told.contains(", MSF by "), "{told}");
        assert_eq!(study(0.5).follows_late(&[Kind::Msf]), None);
        let told = study(2.0).follows_late(&[Kind::Msf]).expect("it is farther");
        assert!(told.contains("farther from the truth: MSF by "), "{told}");
    }
}
