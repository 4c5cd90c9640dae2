//! Several estimates of files side by side against one truth: figures, page.

use serde::{Deserialize, Serialize};

use super::report::{Axis, Band, Page, Plot, Scale, Series, Style, Table, figure, spread};
use super::trial::{self, bounds_of};
use super::{
    Alignment, EvaluateError, EvoOptions, EvoReport, Options, Relation, Report, compare, evo, interpolate,
};
use crate::import::{Interval, Sigmas, StampedPose};
use crate::lie::{Mat3, Se3, Vec3, hat};
use crate::replay::{Distribution, Moments, Outage};
use crate::time::Stamp;

/// Fixes further apart are not one after the other, s.
const FIX_GAP_MAX_S: f64 = 0.2;
/// Estimates further apart are not interpolated, s.
const GAP_MAX_S: f64 = 0.3;

/// One estimate, and what there is beside it.
#[derive(Clone, Debug, Default)]
pub struct Given {
    /// In tables and plots.
    pub name: String,
    /// The poses that are judged.
    pub world: Vec<StampedPose>,
    /// Poses that should never step.
    pub odom: Vec<StampedPose>,
    /// With the poses.
    pub sigmas: Vec<Sigmas>,
    /// When an update moved the newest position, and by how much, m.
    pub corrections: Vec<(Stamp, f64)>,
    /// What the run said of itself.
    pub summary: Option<RunSummary>,
}

/// What is used of a `summary.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunSummary {
    /// From an IMU sample to its estimate, on the computer of the run.
    pub predict_us: Distribution,
    /// From a measurement to the solution taken over.
    pub update_us: Distribution,
    /// How far solutions move the position that was predicted, cm.
    pub consistency_cm: Moments,
    /// As the estimator told them.
    pub outages: Vec<Outage>,
}

/// Fixes of one antenna, to hold motions against.
#[derive(Clone, Debug)]
pub struct Fixes {
    /// The antenna in the IMU frame, m.
    pub lever_arm: Vec3,
    /// Stamp, place in the world (m), reported sigma (m); in order.
    pub fixes: Vec<(Stamp, Vec3, Vec3)>,
}

/// Figures of one estimate.
#[derive(Clone, Debug, Serialize)]
pub struct Judgement {
    /// In tables and plots.
    pub name: String,
    /// Errors, also by condition and interval.
    #[serde(flatten)]
    pub report: Report,
    /// As evo has them.
    pub evo: EvoReport,
    /// Motion of the antenna from fix to fix against that of the fixes, on each axis, cm (the paper's Table I).
    pub relative_to_rtk_cm: Option<Moments>,
    /// Largest step of odom beyond the true motion, mm.
    pub odom_step_mm: Option<f64>,
    /// Largest turn of odom beyond the true motion, degrees.
    pub odom_turn_deg: Option<f64>,
    /// Squared errors over their variances: x, y, z, and rotations about them.
    pub nees_per_axis: Option<[f64; 6]>,
    /// Mean over the axes of the position, with 95 % bounds.
    pub nees: Option<Bounded>,
    /// Squared innovations of fixes over their variances, with 95 % bounds.
    pub nis: Option<Bounded>,
    /// What the run said of itself.
    pub run: Option<RunSummary>,
}

/// A mean that should be one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Bounded {
    /// The mean.
    pub mean: f64,
    /// So many independent values would have a mean as sure.
    pub independent: f64,
    /// Hold 95 % of such means if covariances are meant.
    pub bounds: [f64; 2],
}

/// Judges one estimate.
///
/// # Errors
/// [`EvaluateError`] if nothing can be compared.
pub fn judge(
    given: &Given,
    truth: &[StampedPose],
    fixes: Option<&Fixes>,
    options: &Options,
    evo_options: &EvoOptions,
) -> Result<Judgement, EvaluateError> {
    let report = compare(truth, &given.world, options)?;
    let evo = evo(truth, &given.world, evo_options)?;
    let [step_m, turn] = steps(&given.odom, truth, options.gap_max_s).unwrap_or([f64::NAN; 2]);
    let seen = |value: f64| value.is_finite().then_some(value);
    // Sigmas are of the frame in which the estimate was made.
    let unaligned = options.alignment == Alignment::None;
    let nees = nees(given, truth, options).filter(|_| unaligned);
    let against_fixes = fixes.map(|fixes| against_fixes(given, fixes, options));
    let (relative_to_rtk_cm, nis) = against_fixes.unwrap_or_default();
    Ok(Judgement {
        name: given.name.clone(),
        report,
        evo,
        relative_to_rtk_cm,
        odom_step_mm: seen(1e3 * step_m),
        odom_turn_deg: seen(turn.to_degrees()),
        nees_per_axis: nees.map(|(axes, _)| axes),
        nees: nees.map(|(_, bounded)| bounded),
        nis,
        run: given.summary.clone(),
    })
}

/// Largest step (m) and turn (rad) of odom beyond the true motion.
fn steps(odom: &[StampedPose], truth: &[StampedPose], gap_max_s: f64) -> Option<[f64; 2]> {
    let mut largest: Option<[f64; 2]> = None;
    let mut before: Option<(&StampedPose, Se3)> = None;
    for posed in odom {
        let Some(at) = interpolate(truth, posed.stamp, gap_max_s) else {
            before = None;
            continue;
        };
        if let Some((last, last_at)) = before {
            let seen = last.pose.inverse() * posed.pose;
            let step = (last_at.inverse() * at).inverse() * seen;
            let [way, turn] = largest.unwrap_or_default();
            largest = Some([way.max(step.translation.norm()), turn.max(step.rotation.log().norm())]);
        }
        before = Some((posed, at));
    }
    largest
}

fn bounded(series: &trial::Series) -> Option<Bounded> {
    let mean = series.mean();
    let independent = series.independent();
    mean.is_finite().then(|| Bounded { mean, independent, bounds: bounds_of(&[series]) })
}

fn nees(given: &Given, truth: &[StampedPose], options: &Options) -> Option<([f64; 6], Bounded)> {
    let mut sums = [0.0; 6];
    let mut count = 0.0;
    let mut series = trial::Series::default();
    let mut sigmas = given.sigmas.iter().peekable();
    for posed in &given.world {
        while sigmas.next_if(|sigma| sigma.stamp < posed.stamp).is_some() {}
        let Some(sigma) = sigmas.peek().filter(|sigma| sigma.stamp == posed.stamp) else { continue };
        if !options.counts(posed.stamp) {
            continue;
        }
        let Some(at) = interpolate(truth, posed.stamp, options.gap_max_s) else { continue };
        let position = posed.pose.translation - at.translation;
        let rotation = (posed.pose.rotation * at.rotation.inverse()).log();
        let squared: [f64; 6] = std::array::from_fn(|axis| {
            let error = if axis < 3 { position[axis] } else { rotation[axis - 3] };
            (error / sigma.values[axis]).powi(2)
        });
        sums.iter_mut().zip(squared).for_each(|(sum, squared)| *sum += squared);
        count += 1.0;
        series.note(posed.stamp, squared[..3].iter().sum::<f64>() / 3.0);
    }
    Some((sums.map(|sum| sum / count), bounded(&series)?))
}

/// Motions from fix to fix, and innovations.
fn against_fixes(given: &Given, fixes: &Fixes, options: &Options) -> (Option<Moments>, Option<Bounded>) {
    let mut off_cm: Vec<f64> = Vec::new();
    let mut innovations = trial::Series::default();
    let mut before: Option<(Stamp, Vec3, Vec3)> = None;
    for (stamp, place, sigma) in &fixes.fixes {
        if !options.counts(*stamp) {
            continue;
        }
        let Some(pose) = interpolate(&given.world, *stamp, GAP_MAX_S) else { continue };
        let antenna = pose * fixes.lever_arm;
        if let Some((last, from, last_place)) = before.replace((*stamp, antenna, *place))
            && stamp.seconds_since(last) < FIX_GAP_MAX_S
        {
            let off = (antenna - from) - (place - last_place);
            off_cm.extend(off.iter().map(|off_m| 100.0 * off_m));
        }
        let after = given.sigmas.partition_point(|sigma| sigma.stamp < *stamp);
        let Some(known) = given.sigmas.get(after) else { continue };
        let [x, y, z, roll, pitch, yaw] = known.values.map(|sigma| sigma * sigma);
        let by_turn = -hat(&(pose.rotation * fixes.lever_arm));
        let covariance = Mat3::from_diagonal(&Vec3::new(x, y, z))
            + by_turn * Mat3::from_diagonal(&Vec3::new(roll, pitch, yaw)) * by_turn.transpose()
            + Mat3::from_diagonal(&sigma.component_mul(sigma));
        let innovation = place - antenna;
        let solved = covariance.cholesky().map(|factor| factor.solve(&innovation));
        innovations.note(*stamp, solved.map_or(f64::NAN, |solved| innovation.dot(&solved) / 3.0));
    }
    let count = off_cm.len() as f64;
    let mean = off_cm.iter().sum::<f64>() / count;
    let variance = off_cm.iter().map(|off| (off - mean).powi(2)).sum::<f64>() / count;
    let moments = (count > 0.0).then(|| Moments { mean, sd: variance.sqrt() });
    (moments, bounded(&innovations))
}

/// The page of several estimates.
pub fn page(
    truth: &[StampedPose],
    given: &[Given],
    judgements: &[Judgement],
    options: &Options,
    title: &str,
) -> Page {
    let mut page = Page::new(title);
    page.heading("Errors against the truth").table(errors(judgements));
    page.table(evo_table(judgements)).table(consistency(judgements));
    if judgements.iter().any(|judgement| judgement.run.is_some()) {
        page.table(latency(judgements)).table(outages(judgements));
    }
    page.heading("Over time");
    let bands = bands(&options.intervals);
    let lines = |value: &dyn Fn(&Se3, &Se3) -> f64| {
        let each = given.iter().zip(judgements).enumerate().map(|(index, (given, judgement))| {
            let aligned = super::motion_of(&judgement.report);
            let points = given.world.iter().filter_map(|posed| {
                let at = interpolate(truth, posed.stamp, options.gap_max_s)?;
                let pose = super::alignment::Similarity::apply(&aligned, &posed.pose);
                Some((posed.stamp.as_seconds(), value(&pose, &at)))
            });
            Series::new(&given.name, style(index), points.collect())
        });
        // The first one on top.
        let mut lines: Vec<Series> = each.collect();
        lines.reverse();
        lines
    };
    let plot = |title: &str, description: &str, y: Axis, series: Vec<Series>| Plot {
        title: title.to_owned(),
        description: description.to_owned(),
        x: Axis::new("time, s"),
        y,
        series,
        bands: bands.clone(),
    };
    page.plot(plot(
        "Position error over time",
        "Distance between estimated and true position, on a logarithmic scale.",
        Axis::scaled("position error, m", Scale::Logarithmic(1e-4, 1e2)),
        lines(&|estimate, truth| (estimate.translation - truth.translation).norm()),
    ));
    page.plot(plot(
        "Height error over time",
        "Estimated less true height.",
        Axis::new("height error, cm"),
        lines(&|estimate, truth| 100.0 * (estimate.translation.z - truth.translation.z)),
    ));
    page.plot(plot(
        "Heading error over time",
        "Turn about the vertical between estimate and truth.",
        Axis::new("heading error, °"),
        lines(&|estimate, truth| (estimate.rotation * truth.rotation.inverse()).log().z.to_degrees()),
    ));
    let mut corrections: Vec<Series> = given
        .iter()
        .enumerate()
        .filter(|(_, given)| !given.corrections.is_empty())
        .map(|(index, given)| {
            let points =
                given.corrections.iter().map(|(stamp, moved_m)| (stamp.as_seconds(), 100.0 * moved_m));
            Series::new(&given.name, style(index), points.collect())
        })
        .collect();
    corrections.reverse();
    if !corrections.is_empty() {
        page.plot(plot(
            "Consistency of prediction and update over time",
            "How far each update moves the newest position, on a logarithmic scale.",
            Axis::scaled("update moves the position by, cm", Scale::Logarithmic(1e-4, 1e3)),
            corrections,
        ));
    }
    page
}

const fn style(index: usize) -> Style {
    match index % 5 {
        0 => Style::Ours,
        1 => Style::First,
        2 => Style::Second,
        3 => Style::Third,
        _ => Style::Fourth,
    }
}

fn bands(intervals: &[Interval]) -> Vec<Band> {
    let bad = intervals.iter().filter(|interval| interval.condition != "good");
    bad.map(|interval| Band {
        from: interval.start.as_seconds(),
        to: interval.end.as_seconds(),
        label: interval.condition.clone(),
    })
    .collect()
}

/// One column an estimate.
fn table(caption: &str, judgements: &[Judgement]) -> Table {
    let header: Vec<&str> =
        std::iter::once("").chain(judgements.iter().map(|one| one.name.as_str())).collect();
    Table::new(caption, &header)
}

fn row(table: &mut Table, name: &str, judgements: &[Judgement], cell: impl Fn(&Judgement) -> Option<String>) {
    let cells: Vec<String> =
        judgements.iter().map(|one| cell(one).unwrap_or_else(|| "–".to_owned())).collect();
    table.row(name, &cells);
}

fn errors(judgements: &[Judgement]) -> Table {
    let mut errors = table("Position (RMSE and largest), cm, and heading (RMSE), °", judgements);
    let text = |errors: &super::Errors| {
        format!(
            "{} (max {}), {}°",
            figure(100.0 * errors.position_m.rmse),
            figure(100.0 * errors.position_m.max),
            figure(errors.heading_deg.rmse)
        )
    };
    row(&mut errors, "all", judgements, |one| Some(text(&one.report.errors)));
    let mut names: Vec<&str> = judgements
        .iter()
        .flat_map(|one| one.report.conditions.iter().map(|part| part.condition.as_str()))
        .collect();
    names.sort_unstable();
    names.dedup();
    for name in names {
        row(&mut errors, name, judgements, |one| {
            let part = one.report.conditions.iter().find(|part| part.condition == name)?;
            Some(text(&part.errors))
        });
    }
    row(&mut errors, "horizontal, cm", judgements, |one| {
        Some(figure(100.0 * one.report.errors.horizontal_m.rmse))
    });
    row(&mut errors, "height, cm", judgements, |one| Some(figure(100.0 * one.report.errors.vertical_m.rmse)));
    row(&mut errors, "poses", judgements, |one| Some(one.report.compared.to_string()));
    errors
}

fn evo_table(judgements: &[Judgement]) -> Table {
    let mut table = table("APE and RPE by evo's definitions: RMSE, mean, largest", judgements);
    let names = [(Relation::TranslationPart, "translation, m"), (Relation::RotationAngleDeg, "rotation, °")];
    for (relation, name) in names {
        for (metric, relative) in [("APE", false), ("RPE", true)] {
            row(&mut table, &format!("{metric}, {name}"), judgements, |one| {
                let of = if relative { &one.evo.rpe } else { &one.evo.ape };
                let found = of.get(&relation)?;
                Some(format!("{}, {}, {}", figure(found.rmse), figure(found.mean), figure(found.max)))
            });
        }
    }
    table.note("All relations of poses and all statistics are in report.json. Poses are paired by the nearest stamp.");
    table
}

fn consistency(judgements: &[Judgement]) -> Table {
    let mut table = table("Consistency", judgements);
    let moments = |moments: &Moments| spread(moments.mean, moments.sd);
    let bounded = |bounded: &Bounded| {
        let [low, high] = bounded.bounds;
        format!("{} ({}–{})", figure(bounded.mean), figure(low), figure(high))
    };
    row(&mut table, "motion from fix to fix against RTK, on each axis, cm", judgements, |one| {
        one.relative_to_rtk_cm.as_ref().map(moments)
    });
    row(&mut table, "update moves the prediction by, cm", judgements, |one| {
        one.run.as_ref().map(|run| moments(&run.consistency_cm))
    });
    row(&mut table, "odom: largest step beyond the true motion, mm", judgements, |one| {
        one.odom_step_mm.map(figure)
    });
    row(&mut table, "odom: largest turn beyond the true motion, °", judgements, |one| {
        one.odom_turn_deg.map(figure)
    });
    row(&mut table, "NEES of the position (95 % bounds)", judgements, |one| one.nees.as_ref().map(bounded));
    row(&mut table, "NEES of the heading", judgements, |one| one.nees_per_axis.map(|axes| figure(axes[5])));
    row(&mut table, "NIS of the fixes (95 % bounds)", judgements, |one| one.nis.as_ref().map(bounded));
    table.note(
        "NEES and NIS are squared errors over their variances, one where covariances are meant; from files they are made of \
         the standard deviations alone. Bounds are of the chi-square distribution, for as many independent values as there are.",
    );
    table
}

fn latency(judgements: &[Judgement]) -> Table {
    let mut table = table("Latency as the runs measured it, on their computers, µs", judgements);
    type Part = (&'static str, fn(&RunSummary) -> &Distribution);
    let parts: [Part; 2] =
        [("IMU sample to estimate", |run| &run.predict_us), ("update", |run| &run.update_us)];
    for (name, part) in parts {
        row(&mut table, &format!("{name}: mean ± sd"), judgements, |one| {
            let times = part(one.run.as_ref()?);
            Some(spread(times.mean, times.sd))
        });
        row(&mut table, &format!("{name}: 99 %, largest"), judgements, |one| {
            let times = part(one.run.as_ref()?);
            Some(format!("{}, {}", figure(times.p99), figure(times.max)))
        });
    }
    table
}

fn outages(judgements: &[Judgement]) -> Table {
    let header = ["estimate and outage", "cause", "way, m", "corrected by, cm"];
    let mut table = Table::new("Outages of GNSS as the estimators told them", &header);
    for judgement in judgements {
        for outage in judgement.run.iter().flat_map(|run| &run.outages) {
            let end = outage.end_s.map_or("the end".to_owned(), |end_s| format!("{end_s:.1} s"));
            let jump = outage.jump_m.map_or("–".to_owned(), |jump_m| figure(100.0 * jump_m));
            let name = format!("{}: {:.1} s to {end}", judgement.name, outage.start_s);
            table.row(&name, &[outage.cause.name().to_owned(), figure(outage.travelled_m), jump]);
        }
    }
    table
}
