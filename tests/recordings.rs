//! Real recordings through the built binary. They are not in the repository: the environment variable
//! `HOLDFAST_RECORDINGS` names the folder that holds them (`tests/data/convert_public.py` makes it from the
//! public originals). Without it the tests say that they do not run, and fail where every test is required.

#[path = "support/command.rs"]
mod command;
#[path = "support/required.rs"]
mod required;

use std::fs;
use std::path::{Path, PathBuf};

use holdfast::config::{self, Machine};
use holdfast::estimator::Estimator;
use holdfast::evaluate::{Errors, Options, compare};
use holdfast::import::{StampedPose, read_log_folder, read_tum};
use holdfast::sensors::{Arrival, Reading, Sensor};
use holdfast::state::Mode;
use holdfast::time::{Span, Stamp};
use serde_json::Value;

use command::{empty_folder, estimate, repository};

/// What the first motion is given to settle, s.
const SETTLE_S: f64 = 30.0;

fn recording(name: &str) -> Option<PathBuf> {
    let folder = required::variable("HOLDFAST_RECORDINGS", "the folder of the real recordings")?;
    let path = Path::new(&folder).join(name);
    assert!(path.is_dir(), "{} is no folder", path.display());
    Some(path)
}

/// Runs the recording; checks exit code and that every IMU sample since the start has its estimate.
fn run(log: &Path, machine: &str) -> (PathBuf, Vec<StampedPose>) {
    let out = empty_folder(&format!("recording-{machine}"));
    let ended = estimate(log, &repository(&format!("config/machines/{machine}.toml")), &out);
    assert_eq!(ended.code, 0, "{ended:?}");
    assert!(ended.stderr.is_empty(), "{}", ended.stderr);
    print!("{}", ended.stdout);
    let world = read_tum(&out.join("world.tum")).expect("world.tum");
    let arrivals = read_log_folder(log).expect("log").arrivals;
    let imu = arrivals.iter().filter(|arrival| arrival.reading.sensor() == Sensor::Imu);
    let sampled: Vec<Stamp> =
        imu.map(|arrival| arrival.reading.stamp()).filter(|stamp| *stamp >= world[0].stamp).collect();
    let stamps: Vec<Stamp> = world.iter().map(|pose| pose.stamp).collect();
    assert_eq!(stamps.len(), sampled.len(), "one estimate for every IMU sample since the start");
    assert!(stamps == sampled);
    let events = fs::read_to_string(out.join("events.jsonl")).expect("events");
    assert!(!events.contains("\"restarted\""), "{events}");
    (out, world)
}

fn errors(truth: &[StampedPose], estimate: &[StampedPose]) -> Errors {
    compare(truth, estimate, &Options::default()).expect("something to compare").errors
}

fn tell(what: &str, errors: &Errors) {
    let Errors { position_m, horizontal_m, vertical_m, heading_deg, .. } = errors;
    println!(
        "{what}: position RMSE {:.1} cm (horizontal {:.1}, vertical {:.1}, worst {:.1}), heading RMSE {:.2}°",
        100.0 * position_m.rmse,
        100.0 * horizontal_m.rmse,
        100.0 * vertical_m.rmse,
        100.0 * position_m.max,
        heading_deg.rmse
    );
}

#[test]
fn car_with_one_antenna_is_followed_to_centimetres() {
    let Some(log) = recording("rtk_drive0708") else { return };
    let (_, world) = run(&log, "rtk-drive");
    let truth = read_tum(&log.join("truth_imu.tum")).expect("truth");
    // It stands still first; the estimate starts when it begins to move.
    let moving = truth
        .iter()
        .find(|pose| (pose.pose.translation - truth[0].pose.translation).norm() > 0.5)
        .expect("it moves")
        .stamp;
    let began_s = world[0].stamp.seconds_since(moving);
    let settled: Vec<StampedPose> =
        world.iter().filter(|pose| pose.stamp.seconds_since(moving) >= SETTLE_S).copied().collect();
    println!("rtk_drive0708: moves at {moving} s, estimate from {began_s:.1} s after that");
    let all = errors(&truth, &world);
    tell("rtk_drive0708, all", &all);
    assert!(all.position_m.rmse <= 0.04 && all.position_m.max <= 0.5, "{all:?}");
    let errors = errors(&truth, &settled);
    tell("rtk_drive0708, from 30 s of motion on", &errors);
    let to_fixes_m = rmse_to_fixes(&log, &settled);
    println!("rtk_drive0708, from 30 s of motion on: RMSE to the fixes {:.2} cm", 100.0 * to_fixes_m);
    // What is required, 2 cm, and 1.99 cm are measured: it cannot be much less. The fixes themselves are good to 1.00 cm
    // east and north and 1.07 cm up by their own report, 1.77 cm in all, which whoever does not know them yet sees in
    // full. So the prediction's own part is 0.9 cm.
    assert!(to_fixes_m <= 0.02, "{to_fixes_m}");
    assert!(began_s < 5.0, "{began_s}");
    assert!(errors.position_m.rmse <= 0.03, "{errors:?}");
    assert!(errors.position_m.max <= 0.5, "{errors:?}");
    assert!(errors.heading_deg.rmse <= 1.5, "{errors:?}");
}

/// Sigmas that are larger come without fixed ambiguities, m.
const FIXED_SIGMA_M: f64 = 0.05;

/// How far the antenna is from its fixes, as the estimate had it live, before the fix was known: m.
fn rmse_to_fixes(log: &Path, world: &[StampedPose]) -> f64 {
    let machine: Machine =
        config::load(&repository("config/machines/rtk-drive.toml")).expect("the machine file");
    let options = machine.estimator_options();
    let arrivals = read_log_folder(log).expect("log").arrivals;
    let fixes = arrivals.iter().filter_map(|arrival| match &arrival.reading {
        Reading::GnssLeft(fix) if fix.sigma_enu_m.amax() <= FIXED_SIGMA_M => Some(fix),
        _ => None,
    });
    let squared: Vec<f64> = fixes
        .filter_map(|fix| {
            let after = world.partition_point(|pose| pose.stamp < fix.stamp);
            let (before, after) = (world.get(after.checked_sub(1)?)?, world.get(after)?);
            let part = fix.stamp.seconds_since(before.stamp) / after.stamp.seconds_since(before.stamp);
            let antenna =
                |pose: &StampedPose| pose.pose.translation + pose.pose.rotation * options.antenna_left;
            let expected = antenna(before).lerp(&antenna(after), part);
            Some((options.site.to_enu(fix.position) - expected).norm_squared())
        })
        .collect();
    assert!(squared.len() > 1_000, "{}", squared.len());
    (squared.iter().sum::<f64>() / squared.len() as f64).sqrt()
}

/// The recording has no truth of its own; its GNSS is made from its lidar odometry, so that the fixes less their
/// white noise are where the antenna was.
#[test]
fn tilted_handheld_lidar_is_followed_through_all_rotations() {
    let Some(log) = recording("handheld_lio") else { return };
    let (out, world) = run(&log, "handheld-lio");
    let arrivals = read_log_folder(&log).expect("log").arrivals;
    // Lidar odometry is the pose of the IMU in the frame that GNSS was made in, but for a constant motion.
    let lidar: Vec<StampedPose> = arrivals
        .iter()
        .filter_map(|arrival| match &arrival.reading {
            Reading::LidarOdometry(pose) => {
                Some(StampedPose { stamp: pose.stamp, pose: *pose.lidarmap_from_lidar.motion() })
            }
            _ => None,
        })
        .collect();
    let start = world[0].stamp;
    let settled: Vec<StampedPose> =
        world.iter().filter(|pose| pose.stamp.seconds_since(start) >= SETTLE_S).copied().collect();
    let errors = errors(&lidar, &settled);
    tell("handheld_lio against its lidar odometry, from 30 s after the start on", &errors);
    assert!(errors.position_m.rmse <= 0.03, "{errors:?}");
    let summary = fs::read_to_string(out.join("summary.json")).expect("summary");
    let summary: Value = serde_json::from_str(&summary).expect("JSON");
    assert_eq!(summary["unfit_readings"], 0);
}

/// Fixes are withheld for so long, s.
const WITHHELD_S: f64 = 10.0;
/// At ten places, 45 s apart, three times over: the second and third ten begin 15 s and 30 s later than the first.
const PLACES: usize = 10;
const FIRST_PLACE_S: [f64; 3] = [90.0, 105.0, 120.0];
const PLACES_APART_S: f64 = 45.0;

/// How far off the IMU alone is at the end of a stretch without fixes that begins at `begin`, m.
fn withheld(machine: &Machine, arrivals: &[Arrival], truth: &[StampedPose], begin: Stamp) -> f64 {
    let end = begin + Span::from_seconds(WITHHELD_S);
    let mut estimator = Estimator::new(machine.estimator_options());
    let mut last = None;
    for arrival in arrivals.iter().take_while(|arrival| arrival.reading.stamp() <= end) {
        if arrival.reading.sensor() == Sensor::Imu || arrival.reading.stamp() < begin {
            last = estimator.push(arrival).or(last);
        }
    }
    let last = last.expect("an estimate");
    assert_eq!(last.mode, Mode::ImuOnly);
    let pose = StampedPose { stamp: last.stamp, pose: *last.state.world_from_imu().motion() };
    errors(truth, &[pose]).position_m.max
}

/// What the same recording costs others: a batch smoother over the 100 s before, then the IMU alone, ends 3.1 m off.
#[test]
fn car_without_fixes_for_ten_seconds_is_followed_by_its_imu_alone() {
    let Some(log) = recording("rtk_drive0708") else { return };
    let machine: Machine =
        config::load(&repository("config/machines/rtk-drive.toml")).expect("the machine file");
    let arrivals = read_log_folder(&log).expect("log").arrivals;
    let truth = read_tum(&log.join("truth_imu.tum")).expect("truth");
    for first_s in FIRST_PLACE_S {
        let mut off_m: Vec<f64> = (0..PLACES)
            .map(|place| {
                let begin_s = first_s + PLACES_APART_S * place as f64;
                let begin = arrivals[0].reading.stamp() + Span::from_seconds(begin_s);
                withheld(&machine, &arrivals, &truth, begin)
            })
            .collect();
        off_m.sort_by(f64::total_cmp);
        let median_m = 0.5 * (off_m[PLACES / 2 - 1] + off_m[PLACES / 2]);
        println!(
            "rtk_drive0708, IMU alone for {WITHHELD_S} s at ten places from {first_s} s on: median {median_m:.2} m off, all {off_m:.2?}"
        );
        assert!(median_m <= 2.5, "{off_m:?}");
    }
}
