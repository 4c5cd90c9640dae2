//! Readings of the sensors, as they come from a machine, and what makes one unfit for use.
//!
//! The border turns bytes into a [`Reading`]; from here on everything is typed and SI. Whether a reading
//! agrees with the estimate is the gate's question, not this room's.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::frames::geodesy::Geodetic;
use crate::frames::{Lidar, LidarMap, Pose};
use crate::lie::Vec3;
use crate::time::Stamp;

/// Largest angular rate that is taken for real, rad/s: twice the range of the fastest MEMS gyroscopes.
const ANGULAR_RATE_MAX: f64 = 70.0;
/// Largest specific force that is taken for real, m/s²: 40 g.
const SPECIFIC_FORCE_MAX: f64 = 400.0;
/// Largest coordinate of a lidar pose, m.
const LIDAR_COORDINATE_MAX_M: f64 = 1.0e6;
/// Largest cabin-turn angle, rad: a thousand turns from zero.
const CABIN_TURN_MAX: f64 = 6.3e3;

/// Where a reading comes from; also the last part of its Zenoh key and the name of its log file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Sensor {
    /// Cabin IMU.
    Imu,
    /// Chassis IMU.
    BaseImu,
    /// Left GNSS antenna, the one that gives position.
    GnssLeft,
    /// Right GNSS antenna.
    GnssRight,
    /// Lidar odometry.
    LidarOdometry,
    /// Encoder between chassis and cabin.
    CabinTurn,
}

impl Sensor {
    /// All sensors, in the order of their declaration.
    pub const ALL: [Sensor; 6] = [
        Sensor::Imu,
        Sensor::BaseImu,
        Sensor::GnssLeft,
        Sensor::GnssRight,
        Sensor::LidarOdometry,
        Sensor::CabinTurn,
    ];

    /// The name in keys, files and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Sensor::Imu => "imu",
            Sensor::BaseImu => "base_imu",
            Sensor::GnssLeft => "gnss_left",
            Sensor::GnssRight => "gnss_right",
            Sensor::LidarOdometry => "lidar_odometry",
            Sensor::CabinTurn => "cabin_turn",
        }
    }

    /// The sensor of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|sensor| sensor.name() == name)
    }
}

impl fmt::Display for Sensor {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// One sample of an IMU, written in that IMU's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuSample {
    /// When it was measured.
    pub stamp: Stamp,
    /// rad/s.
    pub angular_rate: Vec3,
    /// Acceleration less gravity, m/s²: +g upward at rest.
    pub specific_force: Vec3,
}

/// One RTK fix of one antenna's phase centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GnssFix {
    /// When it was measured.
    pub stamp: Stamp,
    /// WGS84.
    pub position: Geodetic,
    /// One sigma east, north, up as the receiver reports it, m.
    pub sigma_enu_m: Vec3,
}

/// One pose of the lidar odometry.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LidarPose {
    /// When the scan ended.
    pub stamp: Stamp,
    /// The lidar in the frame in which its odometry started.
    pub lidarmap_from_lidar: Pose<LidarMap, Lidar>,
}

/// One angle of the cabin-turn encoder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CabinTurn {
    /// When it was measured.
    pub stamp: Stamp,
    /// Cabin against chassis about +z of the chassis, rad; need not be wrapped.
    pub angle_rad: f64,
}

/// One reading of any sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Reading {
    /// Cabin IMU.
    Imu(ImuSample),
    /// Chassis IMU.
    BaseImu(ImuSample),
    /// Left antenna.
    GnssLeft(GnssFix),
    /// Right antenna.
    GnssRight(GnssFix),
    /// Lidar odometry.
    LidarOdometry(LidarPose),
    /// Cabin-turn encoder.
    CabinTurn(CabinTurn),
}

/// A reading and when it reached the machine's computer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Arrival {
    /// When it arrived, by the same clock as the stamps.
    pub arrival: Stamp,
    /// What arrived.
    pub reading: Reading,
}

impl Reading {
    /// When it was measured.
    pub fn stamp(&self) -> Stamp {
        match self {
            Reading::Imu(sample) | Reading::BaseImu(sample) => sample.stamp,
            Reading::GnssLeft(fix) | Reading::GnssRight(fix) => fix.stamp,
            Reading::LidarOdometry(pose) => pose.stamp,
            Reading::CabinTurn(turn) => turn.stamp,
        }
    }

    /// Which sensor it is from.
    pub fn sensor(&self) -> Sensor {
        match self {
            Reading::Imu(_) => Sensor::Imu,
            Reading::BaseImu(_) => Sensor::BaseImu,
            Reading::GnssLeft(_) => Sensor::GnssLeft,
            Reading::GnssRight(_) => Sensor::GnssRight,
            Reading::LidarOdometry(_) => Sensor::LidarOdometry,
            Reading::CabinTurn(_) => Sensor::CabinTurn,
        }
    }

    /// Whether its numbers can be a measurement at all.
    ///
    /// # Errors
    /// [`Unfit`] names the field and its value.
    pub fn check(&self) -> Result<(), Unfit> {
        match self {
            Reading::Imu(sample) | Reading::BaseImu(sample) => {
                within("angular rate", &sample.angular_rate, ANGULAR_RATE_MAX, "rad/s")?;
                within("specific force", &sample.specific_force, SPECIFIC_FORCE_MAX, "m/s²")
            }
            Reading::GnssLeft(fix) | Reading::GnssRight(fix) => {
                let Geodetic { latitude_deg, longitude_deg, altitude_m } = fix.position;
                range("latitude", latitude_deg, -90.0, 90.0, "°")?;
                range("longitude", longitude_deg, -180.0, 180.0, "°")?;
                range("altitude", altitude_m, -1.0e4, 1.0e5, "m")?;
                fix.sigma_enu_m.iter().try_for_each(|sigma| range("sigma", *sigma, 0.0, 1.0e6, "m"))
            }
            Reading::LidarOdometry(pose) => {
                let translation = pose.lidarmap_from_lidar.translation();
                let rotation = Vec3::from_row_slice(&pose.lidarmap_from_lidar.rotation().to_xyzw()[..3]);
                within("rotation", &rotation, 1.0, "")?;
                within("translation", &translation, LIDAR_COORDINATE_MAX_M, "m")
            }
            Reading::CabinTurn(turn) => {
                range("angle", turn.angle_rad, -CABIN_TURN_MAX, CABIN_TURN_MAX, "rad")
            }
        }
    }
}

/// A number that cannot be a measurement.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{field} {value}{unit} is outside [{low}, {high}]{unit}")]
pub struct Unfit {
    field: &'static str,
    value: f64,
    low: f64,
    high: f64,
    unit: &'static str,
}

fn within(field: &'static str, vector: &Vec3, limit: f64, unit: &'static str) -> Result<(), Unfit> {
    vector.iter().try_for_each(|value| range(field, *value, -limit, limit, unit))
}

fn range(field: &'static str, value: f64, low: f64, high: f64, unit: &'static str) -> Result<(), Unfit> {
    // Written so that NaN fails.
    if value >= low && value <= high { Ok(()) } else { Err(Unfit { field, value, low, high, unit }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_cannot_be_measured_are_refused_by_name() {
        let good = ImuSample {
            stamp: Stamp::default(),
            angular_rate: Vec3::zeros(),
            specific_force: Vec3::z() * 9.81,
        };
        assert_eq!(Reading::Imu(good).check(), Ok(()));
        let broken = ImuSample { angular_rate: Vec3::new(0.0, f64::NAN, 0.0), ..good };
        let message = Reading::Imu(broken).check().expect_err("NaN").to_string();
        assert!(message.contains("angular rate NaN"), "{message}");
        let fix = GnssFix {
            stamp: Stamp::default(),
            position: Geodetic { latitude_deg: 91.0, longitude_deg: 8.0, altitude_m: 0.0 },
            sigma_enu_m: Vec3::repeat(0.01),
        };
        assert!(Reading::GnssLeft(fix).check().is_err());
        assert!(
            Reading::CabinTurn(CabinTurn { stamp: Stamp::default(), angle_rad: f64::INFINITY })
                .check()
                .is_err()
        );
    }

    #[test]
    fn names_come_back() {
        for sensor in Sensor::ALL {
            assert_eq!(Sensor::from_name(sensor.name()), Some(sensor));
        }
        assert_eq!(Sensor::from_name("sonar"), None);
    }
}
