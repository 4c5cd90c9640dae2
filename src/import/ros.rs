//! ROS 2 messages of other people as readings.

use crate::frames::Pose;
use crate::lie::{Se3, So3};
use crate::record::AnyMessage;
use crate::sensors::{CabinTurn, LidarPose, Reading, Sensor};
use crate::time::Stamp;
use crate::wire::{
    CdrError, CdrReader, Header, Imu, JointState, NavSatFix, Odometry, RosMessage, decode_reading,
};

const POSE: &str = "geometry_msgs/msg/PoseStamped";
const POSE_WITH_COVARIANCE: &str = "geometry_msgs/msg/PoseWithCovarianceStamped";
/// `NavSatStatus.STATUS_NO_FIX`; some drivers go below.
const STATUS_NO_FIX: i8 = -1;

/// Why a message is no reading.
#[derive(Debug, PartialEq)]
pub(super) enum Refusal {
    /// The receiver says that it has no fix: there is nothing to read.
    NoFix,
    /// The message is broken, or does not hold what it should.
    Unusable(String),
}

/// The types that a sensor's topic may have.
pub(super) const fn types_of(sensor: Sensor) -> &'static [&'static str] {
    match sensor {
        Sensor::Imu | Sensor::BaseImu => &[Imu::TYPE],
        Sensor::GnssLeft | Sensor::GnssRight => &[NavSatFix::TYPE],
        Sensor::LidarOdometry => &[Odometry::TYPE, POSE, POSE_WITH_COVARIANCE],
        Sensor::CabinTurn => &[JointState::TYPE],
    }
}

/// The reading of a sensor; its channel is of one of its types. Whether its numbers can be a measurement is not
/// asked here.
pub(super) fn reading(sensor: Sensor, message: &AnyMessage, joint: &str) -> Result<Reading, Refusal> {
    let bytes = &message.payload;
    match (sensor, message.channel.message_type.as_str()) {
        (Sensor::LidarOdometry, POSE) => pose_stamped(bytes, false),
        (Sensor::LidarOdometry, POSE_WITH_COVARIANCE) => pose_stamped(bytes, true),
        (Sensor::CabinTurn, _) => cabin_turn(bytes, joint),
        (Sensor::GnssLeft | Sensor::GnssRight, _) => {
            let fix = NavSatFix::decode(bytes).map_err(unusable)?;
            if fix.status.status <= STATUS_NO_FIX {
                return Err(Refusal::NoFix);
            }
            decode_reading(sensor, bytes).map_err(unusable)
        }
        _ => decode_reading(sensor, bytes).map_err(unusable),
    }
}

fn unusable(error: impl std::fmt::Display) -> Refusal {
    Refusal::Unusable(error.to_string())
}

/// Header, position and quaternion, perhaps with a covariance, which is not asked for.
fn pose_stamped(bytes: &[u8], with_covariance: bool) -> Result<Reading, Refusal> {
    let read = || {
        let mut cdr = CdrReader::new(bytes)?;
        let header = Header::read(&mut cdr)?;
        let parts: ([f64; 3], [f64; 4]) = (cdr.f64_array()?, cdr.f64_array()?);
        if with_covariance {
            cdr.f64_array::<36>()?;
        }
        cdr.finish()?;
        Ok::<_, CdrError>((header, parts))
    };
    let (header, (position, [x, y, z, w])) = read().map_err(unusable)?;
    let rotation = So3::from_xyzw(x, y, z, w)
        .ok_or_else(|| unusable(format!("the orientation {x} {y} {z} {w} is no rotation")))?;
    let lidarmap_from_lidar = Pose::assume(Se3::new(rotation, position.into()));
    Ok(Reading::LidarOdometry(LidarPose { stamp: header.stamp, lidarmap_from_lidar }))
}

fn cabin_turn(bytes: &[u8], joint: &str) -> Result<Reading, Refusal> {
    let message = JointState::decode(bytes).map_err(unusable)?;
    let stamp: Stamp = message.header.stamp;
    let Some(index) = message.name.iter().position(|name| name == joint) else {
        let names = message.name.join(", ");
        return Err(unusable(format!("has no joint {joint}, but: {names}")));
    };
    match message.position.get(index) {
        Some(angle) => Ok(Reading::CabinTurn(CabinTurn { stamp, angle_rad: *angle })),
        None => Err(unusable(format!("has no position of the joint {joint}"))),
    }
}
