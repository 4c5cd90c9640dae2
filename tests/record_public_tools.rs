//! Our recordings, read by the tools that other people use. Runs if the environment variable
//! `HOLDFAST_PYTHON` names a Python that has `mcap`, `mcap-ros2-support` and `rosbags`; says so if not, and fails
//! where every test is required.

#[path = "support/required.rs"]
mod required;

use std::path::PathBuf;
use std::process::Command;

use holdfast::frames::Pose;
use holdfast::frames::geodesy::Geodetic;
use holdfast::lie::{Se3, So3, Vec3};
use holdfast::record::{RecordWriter, Recorded};
use holdfast::sensors::{CabinTurn, GnssFix, ImuSample, LidarPose, Reading};
use holdfast::state::{Estimate, Mode, NavState, StateMatrix};
use holdfast::time::{Span, Stamp};
use holdfast::wire::{BootId, RosMessage, Topic, encode_reading, odom_message, pose_message};

const START: Stamp = Stamp::from_nanos(1_790_000_000_000_000_000);
const SAMPLES: u64 = 300;

fn write_recording(path: &std::path::Path) {
    let mut writer = RecordWriter::create(path).expect("create");
    for index in 0..SAMPLES {
        let stamp = START + Span::from_millis(10 * index as i64);
        let wave = (0.01 * index as f64).sin();
        let mut messages = Vec::new();
        let sample = ImuSample {
            stamp,
            angular_rate: Vec3::new(0.125 + wave, 0.0, -0.5),
            specific_force: Vec3::new(0.0, wave, 9.81),
        };
        let state = NavState { position: Vec3::new(wave, 2.0, 3.0), ..NavState::identity() };
        let estimate = Estimate {
            stamp,
            state,
            angular_rate_in_imu: sample.angular_rate,
            odom_from_imu: Pose::identity(),
            world_from_odom: Pose::identity(),
            base: None,
            covariance: StateMatrix::identity() * 1e-4,
            mode: Mode::Main,
        };
        messages.push((Topic::Pose, pose_message(&estimate).encode()));
        messages.push((Topic::Odom, odom_message(&estimate).encode()));
        let mut readings = vec![Reading::Imu(sample), Reading::BaseImu(sample)];
        if index % 10 == 0 {
            let rotation = So3::from_yaw_pitch_roll(wave, 0.0, 0.1);
            let pose = Pose::assume(Se3::new(rotation, Vec3::new(wave, 1.0, 0.0)));
            let position =
                Geodetic { latitude_deg: 47.25 + 1e-6 * wave, longitude_deg: 8.5, altitude_m: 474.5 };
            let fix = GnssFix { stamp, position, sigma_enu_m: Vec3::new(0.01, 0.01, 0.02) };
            readings.push(Reading::GnssLeft(fix));
            readings.push(Reading::GnssRight(fix));
            readings.push(Reading::LidarOdometry(LidarPose { stamp, lidarmap_from_lidar: pose }));
            readings.push(Reading::CabinTurn(CabinTurn { stamp, angle_rad: wave - 0.75 }));
            messages.push((Topic::Health, format!("{{\"id\":\"a\",\"index\":{index}}}").into_bytes()));
        }
        for reading in &readings {
            messages.push((Topic::Sensor(reading.sensor()), encode_reading(reading)));
        }
        for machine in ["a", "b-1"] {
            for (topic, payload) in &messages {
                let message = Recorded {
                    machine: machine.to_owned(),
                    topic: *topic,
                    // Restarted half way: two channels of one topic.
                    boot: Some(BootId(1 + 2 * index / SAMPLES)),
                    sequence: index % (SAMPLES / 2),
                    received: stamp + Span::from_millis(3),
                    sent: stamp + Span::from_millis(2),
                    payload,
                };
                writer.write(&message).expect("write");
            }
        }
    }
    writer.finish().expect("finish");
}

#[test]
fn public_tools_read_what_we_record() {
    let what = "a Python with mcap, mcap-ros2-support and rosbags";
    let Some(python) = required::variable("HOLDFAST_PYTHON", what) else { return };
    let folder = std::env::temp_dir().join(format!("holdfast-public-tools-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("folder");
    let recording = folder.join("s-0000.mcap");
    write_recording(&recording);
    let expected = serde_json::json!({
        "topics": {
            "/a/pose": SAMPLES, "/b-1/odom": SAMPLES, "/a/sensor/imu": SAMPLES, "/b-1/sensor/base_imu": SAMPLES,
            "/a/sensor/gnss_left": SAMPLES / 10, "/a/sensor/gnss_right": SAMPLES / 10,
            "/a/sensor/lidar_odometry": SAMPLES / 10, "/a/sensor/cabin_turn": SAMPLES / 10,
            "/b-1/health": SAMPLES / 10,
        },
        "first": {
            "/a/pose": { "header.frame_id": "world", "child_frame_id": "imu", "pose.pose.position.y": 2.0,
                "pose.covariance.35": 1e-4, "header.stamp.sec": 1_790_000_000 },
            "/a/odom": { "header.frame_id": "odom", "child_frame_id": "imu" },
            "/a/sensor/imu": { "angular_velocity.x": 0.125, "linear_acceleration.z": 9.81,
                "orientation_covariance.0": -1.0 },
            "/a/sensor/gnss_left": { "latitude": 47.25, "position_covariance.0": 0.01 * 0.01,
                "position_covariance_type": 2, "status.service": 1 },
            "/a/sensor/lidar_odometry": { "header.frame_id": "lidar_map", "child_frame_id": "lidar" },
            "/a/sensor/cabin_turn": { "name.0": "cabin_turn", "position.0": -0.75 },
        },
    });
    let expected_path = folder.join("expected.json");
    std::fs::write(&expected_path, expected.to_string()).expect("write");
    let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/record/read_with_public_tools.py");
    let run = |expected: &std::path::Path| {
        let output =
            Command::new(&python).arg(&script).arg(&recording).arg(expected).output().expect("python");
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let (code, errors) = run(&expected_path);
    assert_eq!(code, Some(0), "{errors}");
    // The script can fail.
    let wrong = expected.to_string().replace("-0.75", "-0.5");
    std::fs::write(&expected_path, wrong).expect("write");
    let (code, errors) = run(&expected_path);
    assert_eq!(code, Some(1));
    assert!(errors.contains("first message has position.0 = -0.75, must be -0.5"), "{errors}");
    std::fs::remove_dir_all(&folder).expect("remove");
}
