//! The topic map of the machine file.

use serde::{Deserialize, Serialize};

use super::{Violation, violation};
use crate::sensors::Sensor;

/// The topics of a ROS 2 bag that hold the machine's readings, for `holdfast import`. Sensors that are left out
/// are not imported; if all are, the topics are those of a recording of ours, such as `/menzi-1/sensor/imu`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Topics {
    /// `sensor_msgs/msg/Imu`: cabin IMU.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub imu: Option<String>,
    /// `sensor_msgs/msg/Imu`: chassis IMU.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub base_imu: Option<String>,
    /// `sensor_msgs/msg/NavSatFix`: left antenna.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gnss_left: Option<String>,
    /// `sensor_msgs/msg/NavSatFix`: right antenna.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gnss_right: Option<String>,
    /// `nav_msgs/msg/Odometry`, `geometry_msgs/msg/PoseStamped` or `PoseWithCovarianceStamped`: the lidar in its
    /// start frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lidar_odometry: Option<String>,
    /// `sensor_msgs/msg/JointState`: the cabin turn is one of its joints.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cabin_turn: Option<String>,
    /// Name of that joint.
    pub cabin_turn_joint: String,
}

impl Default for Topics {
    fn default() -> Self {
        Self {
            imu: None,
            base_imu: None,
            gnss_left: None,
            gnss_right: None,
            lidar_odometry: None,
            cabin_turn: None,
            cabin_turn_joint: Sensor::CabinTurn.name().to_owned(),
        }
    }
}

impl Topics {
    /// The topic of a sensor, if one is said.
    pub fn of(&self, sensor: Sensor) -> Option<&str> {
        match sensor {
            Sensor::Imu => &self.imu,
            Sensor::BaseImu => &self.base_imu,
            Sensor::GnssLeft => &self.gnss_left,
            Sensor::GnssRight => &self.gnss_right,
            Sensor::LidarOdometry => &self.lidar_odometry,
            Sensor::CabinTurn => &self.cabin_turn,
        }
        .as_deref()
    }

    /// No topic is said.
    pub fn is_empty(&self) -> bool {
        Sensor::ALL.into_iter().all(|sensor| self.of(sensor).is_none())
    }

    pub(super) fn check(&self) -> Result<(), Violation> {
        for (index, sensor) in Sensor::ALL.into_iter().enumerate() {
            let Some(topic) = self.of(sensor) else { continue };
            let key = format!("topics.{sensor}");
            if !topic.starts_with('/') || topic.len() < 2 || topic.contains(char::is_whitespace) {
                return violation(&key, format!("is \"{topic}\", must be a topic such as /cabin/imu/data"));
            }
            if let Some(other) = Sensor::ALL[..index].iter().find(|other| self.of(**other) == Some(topic)) {
                return violation(&key, format!("is \"{topic}\", which is {other} already"));
            }
        }
        if self.cabin_turn_joint.is_empty() {
            return violation("topics.cabin_turn_joint", "is empty, must be the name of a joint".to_owned());
        }
        Ok(())
    }
}
