//! How far off the estimate is, over many seeds: with GNSS, through an outage while digging, through one while
//! driving, under multipath that the receiver does not report; and whether its covariance is meant.
//!
//! `cargo bench --no-default-features --bench accuracy -- [SEEDS] [pseudo-global] [one-gyroscope]` prints the tables that
//! the README quotes, over two machines each: 25 seeds are 50 runs. `pseudo-global` takes lidar in outages as the paper
//! does, `one-gyroscope` leaves out the chassis' IMU. The yardstick of an outage is the sum of the lidar's increments with
//! the true heading and the true standstill: what lidar odometry could do at best, alone; and the same with the
//! estimate's heading: what that heading leaves of it.

use std::path::Path;

use holdfast::baselines::Kind;
use holdfast::config::LidarInOutage;
use holdfast::evaluate::trial::{Setup, Trial, run};
use holdfast::simulate::{Action, GnssCondition, GnssConditionKind, Scenario};

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn report(title: &str, runs: &[Trial]) {
    let over = |value: &dyn Fn(&Trial) -> f64| {
        let mut values: Vec<f64> = runs.iter().map(value).collect();
        let square_mean = values.iter().map(|value| value.powi(2)).sum::<f64>() / values.len() as f64;
        let middle = median(&mut values);
        [middle, values[values.len() - 1], square_mean.sqrt()]
    };
    println!("\n{title}: {} runs, median, largest and root mean square", runs.len());
    let line = |what: &str, [middle, largest, rms]: [f64; 3], unit: &str| {
        println!("  {what:<52} {middle:8.3} {largest:8.3} {rms:8.3} {unit}");
    };
    line("position RMSE, GNSS good", over(&|run| 100.0 * run.good.rmse_m()), "cm");
    line("heading RMSE, GNSS good", over(&|run| run.good.heading_rmse_deg()), "°");
    line("position RMSE in the outage", over(&|run| 100.0 * run.outage.rmse_m()), "cm");
    line("heading RMSE in the outage", over(&|run| run.outage.heading_rmse_deg()), "°");
    line("largest error in the outage", over(&|run| 100.0 * run.outage.largest_m), "cm");
    line("yardstick: lidar, true heading and standstill, RMSE", over(&|run| 100.0 * run.yardstick_m), "cm");
    line("the same with the estimate's heading", over(&|run| 100.0 * run.yardstick_own_heading_m), "cm");
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
    let spread = |what: &str, of: &dyn Fn(&Trial) -> &Vec<f64>| {
        let count = runs.iter().map(|run| of(run).len()).sum::<usize>() as f64;
        let values = || runs.iter().flat_map(|run| of(run).iter());
        let mean = values().sum::<f64>() / count;
        let variance = values().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
        println!("  {what:<66} {mean:.2} ± {:.2} cm", variance.sqrt());
    };
    spread("update moves the prediction by", &|run| &run.correction_cm);
    spread("motion from fix to fix is off the true one, GNSS good, by", &|run| &run.motion_cm);
    spread("and off that of the fixes themselves, on each axis, by", &|run| &run.motion_to_fixes_cm);
    for name in ["good", "outage"] {
        let mut runs = runs.iter().map(|run| if name == "good" { &run.good } else { &run.outage });
        let Some(first) = runs.next() else { continue };
        let mut all = first.clone();
        runs.for_each(|errors| all.add(errors));
        let nees = all.nees().map(|value| format!("{value:.2}")).join(" ");
        println!("  NEES per axis (x y z roll pitch yaw), {name:<7} {nees}");
    }
}

/// Whether the word is among the arguments.
fn told(word: &str) -> bool {
    std::env::args().any(|argument| argument == word)
}

fn load(name: &str) -> Scenario {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut scenario = Scenario::load(&root.join("config/scenarios").join(name)).expect("a valid scenario");
    if told("pseudo-global") {
        for machine in &mut scenario.machines {
            machine.lidar_odometry.in_outage = LidarInOutage::PseudoGlobal;
        }
    }
    scenario
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

fn seeded(scenario: &Scenario, conditions: &[GnssCondition], seeds: u64) -> Vec<Trial> {
    (0..seeds)
        .flat_map(|seed| {
            let mut scenario = scenario.clone();
            scenario.file.seed = 1000 + seed;
            scenario.file.gnss_condition = conditions.to_vec();
            let machines = 0..scenario.machines.len();
            let without_base_imu = told("one-gyroscope");
            let trial =
                |machine| run(&scenario, Setup { without_base_imu, ..Setup::new(Kind::Dual, machine) }, || 0);
            machines.map(trial).collect::<Vec<_>>()
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
