//! Real recordings through the built binary. They are not in the repository: the environment variable
//! `HOLDFAST_RECORDINGS` names the folder that holds them (`tests/data/convert_public.py` makes it from the
//! public originals). Without it the tests say that they do not run, and fail where every test is required.

#[path = "support/command.rs"]
mod command;
#[path = "support/required.rs"]
mod required;

use std::fs;
use std::path::{Path, PathBuf};

use holdfast::evaluate::{Errors, Options, compare};
use holdfast::import::{StampedPose, read_log_folder, read_tum};
use holdfast::sensors::{Reading, Sensor};
use holdfast::time::Stamp;
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
    assert!(began_s < 5.0, "{began_s}");
    assert!(errors.position_m.rmse <= 0.03, "{errors:?}");
    assert!(errors.position_m.max <= 0.5, "{errors:?}");
    assert!(errors.heading_deg.rmse <= 1.5, "{errors:?}");
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
