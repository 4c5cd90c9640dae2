//! The plots: position error over time and height in the outage (Fig. 3), x and y over time (Fig. 4), consistency
//! over time (Fig. 6).

use super::TaskStudy;
use crate::baselines::Kind;
use crate::evaluate::report::{Axis, Band, Plot, Scale, Series, Style};
use crate::evaluate::tasks::Task;
use crate::evaluate::trial::{Point, Trial};

const fn style(kind: Kind) -> Style {
    match kind {
        Kind::Dual => Style::Ours,
        Kind::Tsif => Style::First,
        Kind::Msf => Style::Second,
        Kind::Lidar => Style::Third,
        Kind::DeadReckoning => Style::Fourth,
    }
}

/// All plots of a task, of its first machine.
pub(super) fn of(study: &TaskStudy) -> Vec<Plot> {
    let mut plots = vec![errors(study)];
    match study.task {
        Task::Digging => plots.push(height(study)),
        Task::Navigation => plots.extend([0, 1].map(|axis| track(study, axis))),
    }
    plots.push(heading(study));
    plots.push(consistency(study));
    plots
}

/// Ours comes last, on top.
fn methods(study: &TaskStudy) -> impl Iterator<Item = (Kind, &Trial)> {
    study.trials.iter().rev().filter_map(|(kind, trials)| Some((*kind, trials.first()?)))
}

fn lines(study: &TaskStudy, value: impl Fn(&Point) -> f64) -> Vec<Series> {
    let line = |(kind, trial): (Kind, &Trial)| {
        let points = trial.trace.iter().map(|point| (point.time_s, value(point))).collect();
        Series::new(kind.title(), style(kind), points)
    };
    methods(study).map(line).collect()
}

fn bands(study: &TaskStudy) -> Vec<Band> {
    let [from, to] = study.outage;
    let label = match study.task {
        Task::Digging => "GNSS unreliable",
        Task::Navigation => "trees in the sky",
    };
    vec![Band { from, to, label: label.to_owned() }]
}

fn errors(study: &TaskStudy) -> Plot {
    let figure = if study.task == Task::Digging { " (paper's Fig. 3)" } else { "" };
    Plot {
        title: format!("Position error over time{figure}, {} task, simulated", study.task.name()),
        description: "Distance between estimated and true position, on a logarithmic scale. Ours stays at some millimetres \
                      with GNSS and at centimetres without; filters without lidar leave within the outage."
            .to_owned(),
        x: Axis::new("time, s"),
        y: Axis::scaled("position error, m", Scale::Logarithmic(1e-4, 1e3)),
        series: lines(study, |point| (point.estimate - point.truth).norm()),
        bands: bands(study),
    }
}

fn height(study: &TaskStudy) -> Plot {
    let [begin, end] = study.outage;
    Plot {
        title: "Z axis during the outage (paper's Fig. 3), digging task, simulated".to_owned(),
        description: "Estimated less true height around the outage, in centimetres; what leaves the plot is drawn at its edge."
            .to_owned(),
        x: Axis::scaled("time, s", Scale::Between(begin - 10.0, end + 10.0)),
        y: Axis::scaled("height error, cm", Scale::Between(-20.0, 20.0)),
        series: lines(study, |point| 100.0 * (point.estimate.z - point.truth.z))
            .into_iter()
            .map(|mut series| {
                series.points.retain(|(time_s, _)| (begin - 10.0..=end + 10.0).contains(time_s));
                series
            })
            .collect(),
        bands: bands(study),
    }
}

fn track(study: &TaskStudy, axis: usize) -> Plot {
    let name = ["x (east)", "y (north)"][axis];
    let mut series = lines(study, |point| point.estimate[axis]);
    let truth: Vec<(f64, f64)> = methods(study)
        .last()
        .map(|(_, ours)| ours.trace.iter().map(|point| (point.time_s, point.truth[axis])).collect())
        .unwrap_or_default();
    let low = truth.iter().map(|point| point.1).fold(f64::INFINITY, f64::min);
    let high = truth.iter().map(|point| point.1).fold(f64::NEG_INFINITY, f64::max);
    series.push(Series::new("truth", Style::Truth, truth));
    Plot {
        title: format!("{name} during the navigation task (paper's Fig. 4), simulated"),
        description: format!("{name} of the cabin IMU in the site frame by each method, and in truth."),
        x: Axis::new("time, s"),
        y: Axis::scaled(
            &format!("{name}, m"),
            if low < high { Scale::Between(low - 15.0, high + 15.0) } else { Scale::Linear },
        ),
        series,
        bands: bands(study),
    }
}

fn heading(study: &TaskStudy) -> Plot {
    Plot {
        title: format!("Heading error over time, {} task, simulated", study.task.name()),
        description: "Turn about the vertical between estimate and truth, in degrees; what leaves the plot is drawn at its edge."
            .to_owned(),
        x: Axis::new("time, s"),
        y: Axis::scaled("heading error, °", Scale::Between(-1.0, 1.0)),
        series: lines(study, |point| point.heading_error_deg),
        bands: bands(study),
    }
}

fn consistency(study: &TaskStudy) -> Plot {
    let series = methods(study)
        .filter(|(_, trial)| !trial.corrections.is_empty())
        .map(|(kind, trial)| Series::new(kind.title(), style(kind), trial.corrections.clone()))
        .collect();
    Plot {
        title: format!("Consistency over time (paper's Fig. 6), {} task, simulated", study.task.name()),
        description: "How far each update moves the newest position, on a logarithmic scale: the distance between prediction \
                      and update."
            .to_owned(),
        x: Axis::new("time, s"),
        y: Axis::scaled("update moves the position by, cm", Scale::Logarithmic(1e-4, 1e4)),
        series,
        bands: bands(study),
    }
}
