//! Behaviour of the readers.

use std::fs;
use std::path::PathBuf;

use super::*;
use crate::export::LogFolderWriter;
use crate::frames::Pose;
use crate::frames::geodesy::Geodetic;
use crate::lie::{Se3, So3, Vec3};
use crate::sensors::{Arrival, CabinTurn, GnssFix, ImuSample, LidarPose, Reading, Sensor};
use crate::time::Stamp;

const IMU: &str = "t,gx,gy,gz,ax,ay,az\n0.00,0,0,0,0,0,9.8\n0.01,0,0,0,0,0,9.8\n";

/// A folder of its own for each test, removed at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("holdfast-import-{name}-{}", std::process::id()));
        fs::create_dir_all(&path).expect("made");
        Self(path)
    }

    fn with(self, file: &str, text: &str) -> Self {
        fs::write(self.0.join(file), text).expect("written");
        self
    }

    fn arrivals(&self) -> Vec<Arrival> {
        read_log_folder(&self.0).expect("readable").arrivals
    }

    /// The message without the folder's name.
    fn error(&self) -> String {
        let message = read_log_folder(&self.0).expect_err("must be refused").to_string();
        message.replace(&format!("{}/", self.0.display()), "")
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

#[test]
fn what_is_written_comes_back_to_the_bit() {
    let stamp = Stamp::from_nanos(1_700_000_000_123_456_789);
    let sample = ImuSample {
        stamp,
        angular_rate: Vec3::new(0.1 + 0.2, -1e-17, 1.0 / 3.0),
        specific_force: Vec3::repeat(9.81),
    };
    let position = Geodetic { latitude_deg: 47.480_140_212_345_67, longitude_deg: -8.5, altitude_m: 1e-9 };
    let fix = GnssFix { stamp, position, sigma_enu_m: Vec3::new(0.008, 0.1, f64::INFINITY) };
    let motion = Se3::new(So3::from_yaw_pitch_roll(1.0, 0.5, 0.25), Vec3::new(1e5, -2.0, 1e-300));
    let pose = LidarPose { stamp, lidarmap_from_lidar: Pose::assume(motion) };
    let readings = [
        Reading::Imu(sample),
        Reading::BaseImu(sample),
        Reading::GnssLeft(fix),
        Reading::GnssRight(fix),
        Reading::LidarOdometry(pose),
        Reading::CabinTurn(CabinTurn { stamp, angle_rad: -12.345_678_901_234_567 }),
    ];
    let folder = Folder::new("round-trip");
    let mut writer = LogFolderWriter::create(&folder.0).expect("made");
    let arrivals =
        readings.map(|reading| Arrival { arrival: Stamp::from_nanos(stamp.as_nanos() + 7), reading });
    arrivals.iter().for_each(|arrival| writer.write(arrival).expect("written"));
    writer.finish().expect("written");
    let back = folder.arrivals();
    for (read, made) in back.iter().zip(&arrivals) {
        match (read.reading, made.reading) {
            (Reading::LidarOdometry(read), Reading::LidarOdometry(made)) => {
                assert_eq!(read.lidarmap_from_lidar.translation(), made.lidarmap_from_lidar.translation());
                let turn = read.lidarmap_from_lidar.rotation().minus(&made.lidarmap_from_lidar.rotation());
                assert!(turn.norm() < 1e-15);
            }
            _ => assert_eq!(read, made),
        }
    }
    assert_eq!(back.len(), 6);
}

#[test]
fn an_old_log_leaves_nothing_behind() {
    let folder = Folder::new("old").with("imu.csv", IMU).with("cabin_turn.csv", "t,angle\n0,1\n");
    let mut writer = LogFolderWriter::create(&folder.0).expect("made");
    let turn = CabinTurn { stamp: Stamp::default(), angle_rad: 0.5 };
    writer.write(&Arrival { arrival: Stamp::default(), reading: Reading::CabinTurn(turn) }).expect("written");
    writer.finish().expect("written");
    assert!(folder.error().starts_with("imu.csv: cannot be read"));
}

#[test]
fn files_are_merged_by_arrival_and_ties_have_an_order() {
    let folder = Folder::new("merge")
        .with("imu.csv", "t_arrival,t,gx,gy,gz,ax,ay,az\n0.02,0.00,0,0,0,0,0,9.8\n0.05,0.04,0,0,0,0,0,9.8\n")
        .with("cabin_turn.csv", "t,angle\n0.01,0.5\n0.05,0.6\n")
        .with("gnss_left.csv", "t,t_arrival,lat,lon,alt,sd_e,sd_n,sd_u\n0.00,0.05,47,8,400,0.01,0.01,0.02\n");
    let order: Vec<(Sensor, f64)> = folder
        .arrivals()
        .iter()
        .map(|arrival| (arrival.reading.sensor(), arrival.arrival.as_seconds()))
        .collect();
    let expected = [
        (Sensor::CabinTurn, 0.01),
        (Sensor::Imu, 0.02),
        (Sensor::Imu, 0.05),
        (Sensor::GnssLeft, 0.05),
        (Sensor::CabinTurn, 0.05),
    ];
    assert_eq!(order, expected);
}

#[test]
fn stamps_that_go_back_are_handed_on_in_the_order_of_the_file() {
    let text = "t,gx,gy,gz,ax,ay,az\n1.00,0,0,0,0,0,9.8\n0.50,0,0,0,0,0,9.8\n0.50,0,0,0,0,0,9.8\n1.01,0,0,0,0,0,9.8\n";
    let stamps: Vec<f64> = Folder::new("backward")
        .with("imu.csv", text)
        .arrivals()
        .iter()
        .map(|arrival| arrival.reading.stamp().as_seconds())
        .collect();
    assert_eq!(stamps, [1.0, 0.5, 0.5, 1.01]);
}

#[test]
fn numbers_that_cannot_be_measured_are_data() {
    let folder = Folder::new("nan")
        .with("imu.csv", "t,gx,gy,gz,ax,ay,az\r\n0,nan,0,0,0,0,9.8\r\n\r\n0.01,0,0,0,0,-inf,9.8\r\n")
        .with("lidar_odometry.csv", "t,x,y,z,qx,qy,qz,qw\n0,1,2,3,0,0,0,0\n0.1,1,2,NaN,0,0,0,1\n");
    let arrivals = folder.arrivals();
    assert_eq!(arrivals.len(), 4);
    assert!(arrivals.iter().all(|arrival| arrival.reading.check().is_err()));
}

#[test]
fn what_is_wrong_is_said_with_file_line_and_column() {
    let error = |name: &str, imu: &str| Folder::new(name).with("imu.csv", imu).error();
    assert!(Folder::new("missing").error().starts_with("imu.csv: cannot be read"));
    let message = error("empty", "");
    assert_eq!(message, "imu.csv:1:1: no header line, expected t_arrival,t,gx,gy,gz,ax,ay,az");
    let message = error("column", &IMU.replace("gz", "wz"));
    assert!(message.starts_with("imu.csv:1:9: column \"wz\" is unknown, expected"), "{message}");
    let message = error("absent", &IMU.replace(",az", ""));
    assert!(message.starts_with("imu.csv:1:17: column \"az\" is missing"), "{message}");
    let message = error("twice", &IMU.replace("gz", "gy"));
    assert!(message.starts_with("imu.csv:1:9: column \"gy\" comes twice"), "{message}");
    let message = error("number", &IMU.replace("0.01,0,0", "0.01,0,zero"));
    assert_eq!(message, "imu.csv:3:8: \"zero\" is not a number");
    let message = error("time", &IMU.replace("0.01", "noon"));
    assert_eq!(message, "imu.csv:3:1: \"noon\" is not a time in seconds");
    let message = error("short", &format!("{IMU}0.02,0,0\n"));
    assert_eq!(message, "imu.csv:4:9: 3 fields, expected 7");
    let folder = Folder::new("other").with("imu.csv", IMU).with("gnss_right.csv", "t,lat\n");
    assert!(folder.error().starts_with("gnss_right.csv:1:6: column \"lon\" is missing"));
}

#[test]
fn trajectories_are_read_and_refused_by_line() {
    let read = |text: &str| {
        let folder = Folder::new("tum").with("imu.csv", IMU).with("truth_imu.tum", text);
        let result = read_log_folder(&folder.0).map(|log| log.truth.expect("there"));
        result.map_err(|error| error.to_string().replace(&format!("{}/", folder.0.display()), ""))
    };
    let poses = read("# time x y z ...\n1.5 1 2 3 0 0 0 2\n1.6 1 2 3 0 0 1 0\n").expect("readable");
    assert_eq!(poses[0].stamp, Stamp::from_nanos(1_500_000_000));
    assert_eq!(poses[0].pose, Se3::new(So3::identity(), Vec3::new(1.0, 2.0, 3.0)));
    assert_eq!(poses.len(), 2);
    for (text, expected) in [
        ("1 2 3\n", "truth_imu.tum:1:6: 3 fields, expected 8"),
        ("1 1 2 nan 0 0 0 1\n", "truth_imu.tum:1:7: NaN cannot be part of a trajectory"),
        ("1 1 2 3 0 0 0 0\n", "truth_imu.tum:1:9: the quaternion has no length"),
        ("2 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n", "truth_imu.tum:2:1: time 1.000000000 does not come after"),
    ] {
        let message = read(text).expect_err("must be refused");
        assert!(message.starts_with(expected), "{message}");
    }
}
