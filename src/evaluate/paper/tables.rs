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
        let [_, noise_cm] = task.moments_of(Kind::Dual, |trial| &trial.motion_to_fixes_cm);
        let to_rtk = task.cells(|trials| {
            let [mean, sd] = moments(trials.iter().flat_map(|trial| &trial.motion_to_fixes_cm).copied());
            Cell::new(libm::hypot(mean, sd), spread(mean, sd))
        });
        let why = format!(
            "{noise_cm:.2} cm of it is the noise of the fixes themselves, and whoever follows that noise is nearer; against \
             the truth see the next row"
        );
        let name = task.task.name();
        sheet.rows.push(Row::new(&format!("{name}: relative to RTK, on each axis, cm"), to_rtk, &why));
        let to_truth = task.cells(|trials| {
            let [mean, sd] = moments(trials.iter().flat_map(|trial| &trial.motion_cm).copied());
            Cell::new(libm::hypot(mean, sd), spread(mean, sd))
        });
        let why = "over a twentieth of a second the IMU alone knows the motion best, and nothing corrects it";
        sheet.rows.push(Row::new(&format!("{name}: relative to the truth, distance, cm"), to_truth, why));
        let rmse = task.cells(|trials| scaled(100.0, errors(trials, |trial| &trial.good).rmse_m()));
        let why = "it is within the noise of a fix";
        sheet.rows.push(Row::new(&format!("{name}: position against the truth, RMSE, cm"), rmse, why));
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
    let why =
        "the others publish one pose; ours carries odom, which never steps, and the chassis along with it";
    sheet.rows.push(Row::new(
        "IMU sample to state, live, two threads",
        Kind::ALL.into_iter().map(live).collect(),
        why,
    ));
    sheet.rows.push(Row::new(
        "reading to estimate, one thread",
        cells(|method| (method.predict_us.mean, spread(method.predict_us.mean, method.predict_us.sd))),
        why,
    ));
    let why = "a filter corrects one state, ours all that its window holds; on its own thread, so that no sample waits for it";
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
        "the predictor's thread was put to sleep by the system, which has other work",
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
    let mut row = |name: &str, cell: &dyn Fn(&[Trial]) -> Cell, why: &str| {
        sheet.rows.push(Row::new(name, task.cells(cell), why));
    };
    let noise = "both are within the noise of a fix";
    row(
        "GNSS good: position RMSE, cm",
        &|all| scaled(100.0, errors(all, |trial| &trial.good).rmse_m()),
        noise,
    );
    row(
        "GNSS good: heading RMSE, °",
        &|all| scaled(1.0, errors(all, |trial| &trial.good).heading_rmse_deg()),
        noise,
    );
    let drift = "an outage's error is one draw of a walk; the Monte Carlo report has its median and tails";
    row(
        "outage: position RMSE, cm",
        &|all| scaled(100.0, errors(all, |trial| &trial.outage).rmse_m()),
        drift,
    );
    row(
        "outage: horizontal RMSE, cm",
        &|all| scaled(100.0, errors(all, |trial| &trial.outage).horizontal_rmse_m()),
        drift,
    );
    row(
        "outage: height RMSE, cm",
        &|all| scaled(100.0, errors(all, |trial| &trial.outage).vertical_rmse_m()),
        drift,
    );
    row(
        "outage: largest error, cm",
        &|all| scaled(100.0, errors(all, |trial| &trial.outage).largest_m),
        drift,
    );
    row(
        "outage: heading RMSE, °",
        &|all| scaled(1.0, errors(all, |trial| &trial.outage).heading_rmse_deg()),
        drift,
    );
    let jump = "ours takes the whole correction in one step once it trusts the fixes again, a filter takes it fix by fix";
    let jump_m =
        |all: &[Trial]| Some(largest(all, |trial| trial.return_jump_m)).filter(|jump_m| *jump_m > 0.0);
    row(
        "after the outage: largest jump of the world pose, cm",
        &|all| jump_m(all).map_or(Cell::none(), |jump_m| scaled(100.0, jump_m)),
        jump,
    );
    let steps = "what nothing corrects never steps, and drifts away";
    row(
        "odom: largest step beyond the true motion, mm",
        &|all| scaled(1e3, largest(all, |trial| trial.largest_odom_step_m)),
        steps,
    );
    row(
        "odom: largest turn beyond the true motion, °",
        &|all| scaled(1.0, largest(all, |trial| trial.largest_odom_turn).to_degrees()),
        steps,
    );
    let yardstick_cm = 100.0 * largest(task.of(Kind::Dual), |trial| trial.yardstick_m);
    sheet.notes.push(format!(
        "What lidar odometry could do at best in the outage, alone (its increments summed up with the true heading and the true \
         standstill): RMSE {} cm on the worse machine. The baselines have one pose for all; theirs is taken for odom.",
        figure(yardstick_cm)
    ));
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
    let why = "ours trusts fixes that come and go only after several good ones in a row, and then corrects all at once; a \
               filter takes each as it comes";
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

/// Whether covariances are meant.
pub(super) fn covariance(task: &TaskStudy) -> Sheet {
    let mut sheet = Sheet::of_methods(&format!(
        "Squared errors over their covariance in the {} task: 1 is as the covariance says",
        task.task.name()
    ));
    let mut row = |name: &str, value: &dyn Fn(&[Trial]) -> Normalized, why: &str| {
        let cell = |trials: &[Trial]| {
            let (value, bounds) = value(trials);
            let text = match bounds {
                Some([low, high]) => format!("{} ({}–{})", figure(value), figure(low), figure(high)),
                None => figure(value),
            };
            Cell::new(libm::log(value).abs(), text)
        };
        sheet.rows.push(Row::new(name, task.cells(cell), why));
    };
    let why = "below one an estimate is better than it says, above one worse, and within the bounds nobody can tell";
    for (name, outage) in [("GNSS good", false), ("outage", true)] {
        let of = move |trial: &Trial| if outage { trial.outage.clone() } else { trial.good.clone() };
        row(
            &format!("{name}: position NEES (95 % bounds)"),
            &|all| {
                let errors: Vec<Errors> = all.iter().map(of).collect();
                let series: Vec<_> = errors.iter().map(|errors| &errors.position_nees).collect();
                let mean =
                    moments(series.iter().flat_map(|series| series.sampled.iter().map(|(_, value)| *value)))
                        [0];
                (mean, Some(bounds_of(&series)))
            },
            why,
        );
        row(
            &format!("{name}: heading NEES"),
            &|all| {
                let mut errors = Errors::default();
                all.iter().for_each(|trial| errors.add(&of(trial)));
                (errors.nees()[5], None)
            },
            why,
        );
    }
    row(
        "fixes: NIS (95 % bounds)",
        &|all| {
            let series: Vec<_> = all.iter().map(|trial| &trial.innovation).collect();
            (moments(series.iter().map(|series| series.mean()))[0], Some(bounds_of(&series)))
        },
        why,
    );
    sheet.notes.push(
        "NEES: eᵀ C⁻¹ e of the position over its three degrees of freedom, at one a second. NIS: the same of the fixes' \
         innovations against the estimate as published. Bounds hold 95 % of the means of as many independent values as the \
         series is worth (chi-square), since errors in a row are alike."
            .to_owned(),
    );
    sheet
}
