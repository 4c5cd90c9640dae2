//! How far off the estimate is, over many seeds: with GNSS, through an outage while digging, through one while
//! driving, under multipath that the receiver does not report; and whether its covariance is meant.
//!
//! `cargo bench --no-default-features --bench accuracy -- [SEEDS]` prints the tables that the README quotes, over two
//! machines each: 25 seeds are 50 runs. The
//! yardstick of an outage is the sum of the lidar's increments with the true heading and the true standstill: what
//! lidar odometry could do at best, alone.

use std::collections::VecDeque;
use std::path::Path;

use holdfast::estimator::Estimator;
use holdfast::lie::{Se3, Vec3};
use holdfast::sensors::Reading;
use holdfast::simulate::{Action, GnssCondition, GnssConditionKind, Scenario, Simulation, Truth};
use holdfast::state::{Estimate, Mode, NavState};
use holdfast::time::Stamp;

/// What one run of one machine amounts to.
#[derive(Default)]
struct Run {
    good: Errors,
    outage: Errors,
    /// Chassis at rest, inside the outage, since its last motion.
    standing_drift_m: f64,
    /// The same from [`SETTLES_S`] after its last motion on.
    settled_drift_m: f64,
    /// Of each rest of the chassis inside the outage: distance from the truth when it began and when it ended, m.
    rests_m: Vec<[f64; 2]>,
    yardstick_m: f64,
    largest_odom_step_m: f64,
    largest_odom_turn: f64,
    correction_cm: Vec<f64>,
    /// GNSS good: how far the antenna's motion from one fix to the next is off the true one, cm.
    motion_cm: Vec<f64>,
    /// And off the motion that the fixes themselves show, along each axis, cm.
    motion_to_fixes_cm: Vec<f64>,
}

/// Where the antenna is by the estimate and in truth, for as long as fixes are under way.
#[derive(Default)]
struct Antenna {
    recent: VecDeque<(Stamp, [Vec3; 2])>,
    /// At the stamp of the newest fix, and the fix.
    at_fix: Option<(Stamp, [Vec3; 2], Vec3)>,
}

impl Antenna {
    fn note(&mut self, estimate: &Estimate, truth: &Truth, lever_arm: &Vec3) {
        let at = |state: &NavState| state.position + state.rotation * *lever_arm;
        self.recent.push_back((estimate.stamp, [at(&estimate.state), at(&truth.state)]));
        if self.recent.len() > 100 {
            self.recent.pop_front();
        }
    }

    /// The motion since the fix before, by the estimate, in truth, and by the fixes.
    fn moved(&mut self, stamp: Stamp, fix: Vec3) -> Option<[Vec3; 3]> {
        let after = self.recent.partition_point(|(recent, _)| *recent < stamp);
        let (before, after) = (self.recent.get(after.checked_sub(1)?)?, self.recent.get(after)?);
        let part = stamp.seconds_since(before.0) / after.0.seconds_since(before.0);
        let at: [Vec3; 2] = std::array::from_fn(|which| before.1[which].lerp(&after.1[which], part));
        let (last, from, last_fix) = self.at_fix.replace((stamp, at, fix))?;
        (stamp.seconds_since(last) < 0.2).then(|| [at[0] - from[0], at[1] - from[1], fix - last_fix])
    }
}

/// Errors of position and heading, and squared errors over their variances.
#[derive(Default)]
struct Errors {
    count: f64,
    position_squared: f64,
    heading_squared: f64,
    largest_m: f64,
    /// x, y, z, and rotations about them.
    normalized: [f64; 6],
}

impl Errors {
    fn note(&mut self, estimate: &Estimate, truth: &Truth) {
        let position = estimate.state.position - truth.state.position;
        let rotation = (estimate.state.rotation * truth.state.rotation.inverse()).log();
        self.count += 1.0;
        self.position_squared += position.norm_squared();
        self.heading_squared += rotation.z.powi(2);
        self.largest_m = self.largest_m.max(position.norm());
        let sigma = [estimate.position_sigma_m(), estimate.rotation_sigma()].concat();
        for (axis, error) in position.iter().chain(rotation.iter()).enumerate() {
            self.normalized[axis] += (error / sigma[axis]).powi(2);
        }
    }

    fn rmse_m(&self) -> f64 {
        (self.position_squared / self.count.max(1.0)).sqrt()
    }

    fn heading_rmse_deg(&self) -> f64 {
        (self.heading_squared / self.count.max(1.0)).sqrt().to_degrees()
    }
}

/// A stop is recognised and what it says taken in after so long, s.
const SETTLES_S: f64 = 2.0;

/// Error when the chassis came to rest, when that had settled, and now.
#[derive(Default)]
struct Standing {
    since: Option<(Stamp, Vec3)>,
    settled: Option<Vec3>,
    newest: Vec3,
}

impl Standing {
    /// How far the error has moved since the chassis stands, and since it has settled, m.
    fn drift_m(&mut self, stamp: Stamp, error: &Vec3) -> [f64; 2] {
        let (since, reference) = *self.since.get_or_insert((stamp, *error));
        self.newest = *error;
        if stamp.seconds_since(since) < SETTLES_S {
            return [(error - reference).norm(), 0.0];
        }
        let settled = *self.settled.get_or_insert(*error);
        [(error - reference).norm(), (error - settled).norm()]
    }

    /// Distance from the truth at the beginning and at the end of a rest that settled, m.
    fn distances_m(&self) -> Option<[f64; 2]> {
        self.settled?;
        Some([self.since?.1.norm(), self.newest.norm()])
    }
}

/// One machine of a scenario with one seed; from the first bad condition of GNSS to the last is the outage.
fn run(scenario: &Scenario, index: usize) -> Run {
    let mut simulation = Simulation::new(scenario, index);
    let mut estimator = Estimator::new(simulation.machine().estimator_options());
    let conditions = &scenario.file.gnss_condition;
    let (first, last) = (&conditions[0], &conditions[conditions.len() - 1]);
    let (begin, end) = (Stamp::from_seconds(first.start_s), Stamp::from_seconds(last.end_s));
    // Trust comes back half a second after the last bad fix.
    let settled = Stamp::from_seconds(last.end_s + 1.0);
    let started = Stamp::from_seconds(12.0);
    let lidar_on_cabin = *simulation.machine().frames.cabin_from_lidar.pose::<(), ()>().motion();
    let imu_on_cabin = *simulation.machine().frames.cabin_from_imu.pose::<(), ()>().motion();
    let imu_from_lidar = imu_on_cabin.inverse() * lidar_on_cabin;
    let options = simulation.machine().estimator_options();
    let mut antenna = Antenna::default();
    let mut result = Run::default();
    let mut previous: Option<(Estimate, Truth)> = None;
    let mut lidar_before: Option<(Se3, Truth)> = None;
    let (mut yardstick, mut yardstick_squared, mut yardstick_count) = (Vec3::zeros(), 0.0, 0.0);
    let mut standing = Standing::default();
    while let Some(arrival) = simulation.next() {
        let estimate = estimator.predict(&arrival);
        if let Some(takeover) = estimator.update(&arrival)
            && let Some(correction_m) = takeover.correction_m
        {
            result.correction_cm.push(100.0 * correction_m);
        }
        if let Reading::GnssLeft(fix) = arrival.reading
            && let Some([moved, truly, seen]) = antenna.moved(fix.stamp, options.site.to_enu(fix.position))
            && fix.stamp > started
            && (fix.stamp < begin || fix.stamp > settled)
        {
            result.motion_cm.push(100.0 * (moved - truly).norm());
            result.motion_to_fixes_cm.extend((moved - seen).iter().map(|off_m| 100.0 * off_m));
        }
        if let Reading::LidarOdometry(pose) = arrival.reading
            && pose.stamp > begin
            && pose.stamp < end
        {
            let truth = simulation.truth(pose.stamp);
            let map_from_lidar = *pose.lidarmap_from_lidar.motion();
            if let Some((before, truth_before)) = &lidar_before {
                let moved = (truth.base.pose.translation - truth_before.base.pose.translation).norm() > 1e-6;
                let [from, to] = [truth_before, &truth].map(|truth| truth.imu.pose * imu_from_lidar);
                let error =
                    (before.inverse() * map_from_lidar).translation - (from.inverse() * to).translation;
                if moved {
                    yardstick += from.rotation * error;
                }
                yardstick_squared += yardstick.norm_squared();
                yardstick_count += 1.0;
            }
            lidar_before = Some((map_from_lidar, truth));
        }
        let Some(estimate) = estimate else { continue };
        let truth = simulation.truth(estimate.stamp);
        antenna.note(&estimate, &truth, &options.antenna_left);
        let error = estimate.state.position - truth.state.position;
        if estimate.stamp > begin && estimate.stamp < end {
            result.outage.note(&estimate, &truth);
            if truth.base.velocity.norm() > 1e-6 {
                result.rests_m.extend(std::mem::take(&mut standing).distances_m());
            } else if estimate.mode != Mode::Main {
                let [drift_m, settled_m] = standing.drift_m(estimate.stamp, &error);
                result.standing_drift_m = result.standing_drift_m.max(drift_m);
                result.settled_drift_m = result.settled_drift_m.max(settled_m);
            }
        } else if estimate.stamp > started && (estimate.stamp < begin || estimate.stamp > settled) {
            result.good.note(&estimate, &truth);
        }
        if let Some((before, truth_before)) = &previous {
            let seen = before.odom_from_imu.motion().inverse() * *estimate.odom_from_imu.motion();
            let real = truth_before.imu.pose.inverse() * truth.imu.pose;
            let step = real.inverse() * seen;
            result.largest_odom_step_m = result.largest_odom_step_m.max(step.translation.norm());
            result.largest_odom_turn = result.largest_odom_turn.max(step.rotation.log().norm());
        }
        previous = Some((estimate, truth));
    }
    result.rests_m.extend(standing.distances_m());
    result.yardstick_m = (yardstick_squared / f64::max(yardstick_count, 1.0)).sqrt();
    result
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn report(title: &str, runs: &[Run]) {
    let over = |value: &dyn Fn(&Run) -> f64| {
        let mut values: Vec<f64> = runs.iter().map(value).collect();
        let middle = median(&mut values);
        (middle, values[values.len() - 1])
    };
    println!("\n{title}: {} runs, median and largest", runs.len());
    let line = |what: &str, (middle, largest): (f64, f64), unit: &str| {
        println!("  {what:<52} {middle:8.3} {largest:8.3} {unit}");
    };
    line("position RMSE, GNSS good", over(&|run| 100.0 * run.good.rmse_m()), "cm");
    line("heading RMSE, GNSS good", over(&|run| run.good.heading_rmse_deg()), "°");
    line("position RMSE in the outage", over(&|run| 100.0 * run.outage.rmse_m()), "cm");
    line("largest error in the outage", over(&|run| 100.0 * run.outage.largest_m), "cm");
    line("yardstick: lidar, true heading and standstill, RMSE", over(&|run| 100.0 * run.yardstick_m), "cm");
    line("drift while the chassis stands in the outage", over(&|run| 100.0 * run.standing_drift_m), "cm");
    line("the same from 2 s after it stopped on", over(&|run| 100.0 * run.settled_drift_m), "cm");
    let rests: Vec<[f64; 2]> = runs.iter().flat_map(|run| run.rests_m.iter().copied()).collect();
    if !rests.is_empty() {
        let rms_cm = |end: usize| {
            let squared: f64 = rests.iter().map(|rest| rest[end].powi(2)).sum();
            100.0 * (squared / rests.len() as f64).sqrt()
        };
        println!(
            "  error as it stopped, and as it went on: RMS of {:<5} {:8.3} {:8.3} cm",
            rests.len(),
            rms_cm(0),
            rms_cm(1)
        );
    }
    line("largest step of odom beyond the true motion", over(&|run| 1e3 * run.largest_odom_step_m), "mm");
    line("largest turn of odom beyond the true motion", over(&|run| run.largest_odom_turn.to_degrees()), "°");
    let spread = |what: &str, of: &dyn Fn(&Run) -> &Vec<f64>| {
        let count = runs.iter().map(|run| of(run).len()).sum::<usize>() as f64;
        let values = || runs.iter().flat_map(|run| of(run).iter());
        let mean = values().sum::<f64>() / count;
        let variance = values().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
        println!("  {what:<66} {mean:.2} ± {:.2} cm", variance.sqrt());
    };
    spread("update moves the prediction by", &|run| &run.correction_cm);
    spread("motion from fix to fix is off the true one, GNSS good, by", &|run| &run.motion_cm);
    spread("and off that of the fixes themselves, on each axis, by", &|run| &run.motion_to_fixes_cm);
    for (name, errors) in [("good", 0), ("outage", 1)] {
        let mut sums = [0.0; 6];
        let mut count = 0.0;
        for run in runs {
            let part = if errors == 0 { &run.good } else { &run.outage };
            count += part.count;
            sums.iter_mut().zip(part.normalized).for_each(|(sum, value)| *sum += value);
        }
        let nees = sums.map(|sum| format!("{:.2}", sum / count)).join(" ");
        println!("  NEES per axis (x y z roll pitch yaw), {name:<7} {nees}");
    }
}

fn load(name: &str) -> Scenario {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    Scenario::load(&root.join("config/scenarios").join(name)).expect("a valid scenario")
}

/// After their first drive, machines dig where they stand.
fn stands_and_digs(scenario: &mut Scenario) {
    for machine in &mut scenario.file.machine {
        let moves = |action: &Action| matches!(action, Action::Drive { .. } | Action::Level { .. });
        let first = machine.action.iter().position(|action| matches!(action, Action::Drive { .. }));
        let stays = first.expect("it drives") + 1;
        for action in machine.action[stays..].iter_mut().filter(|action| moves(action)) {
            *action = Action::Dig { cycles: 1, cycle_s: 16.0, swing_deg: 80.0 };
        }
    }
}

fn condition(kind: GnssConditionKind, start_s: f64, end_s: f64) -> GnssCondition {
    GnssCondition { start_s, end_s, kind, machines: Vec::new(), offset_m: None }
}

fn seeded(scenario: &Scenario, conditions: &[GnssCondition], seeds: u64) -> Vec<Run> {
    (0..seeds)
        .flat_map(|seed| {
            let mut scenario = scenario.clone();
            scenario.file.seed = 1000 + seed;
            scenario.file.gnss_condition = conditions.to_vec();
            (0..scenario.machines.len()).map(|index| run(&scenario, index)).collect::<Vec<_>>()
        })
        .collect()
}

fn main() {
    let seeds = std::env::args().filter_map(|argument| argument.parse().ok()).next().unwrap_or(10);
    let construction = load("construction.toml");
    let blocked = GnssConditionKind::Blocked;
    report(
        "construction, GNSS blocked from 105 s to 150 s",
        &seeded(&construction, &[condition(blocked, 105.0, 150.0)], seeds),
    );
    let mut standing = construction.clone();
    stands_and_digs(&mut standing);
    report(
        "construction, the chassis stands and digs all through the outage from 105 s to 150 s",
        &seeded(&standing, &[condition(blocked, 105.0, 150.0)], seeds),
    );
    let multipath = GnssConditionKind::Multipath;
    report(
        "construction, multipath of 2 s that reports small sigmas",
        &seeded(&construction, &[condition(multipath, 60.0, 62.0)], seeds),
    );
    for (start_s, end_s) in [(127.0, 128.0), (135.0, 137.0)] {
        let wrong = GnssCondition { offset_m: Some([0.6, 1.2]), ..condition(multipath, start_s, end_s) };
        let conditions = [condition(blocked, 105.0, start_s), wrong, condition(blocked, end_s, 150.0)];
        report(
            &format!(
                "construction, GNSS blocked from 105 s to 150 s, but multipath of 0.6 to 1.2 m from {start_s} s to {end_s} s"
            ),
            &seeded(&construction, &conditions, seeds),
        );
    }
    report(
        "navigation, GNSS blocked from 220 s to 380 s",
        &seeded(&load("navigation.toml"), &[condition(blocked, 220.0, 380.0)], seeds),
    );
}
