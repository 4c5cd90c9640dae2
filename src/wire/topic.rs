//! The topics of a machine.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::sensors::Sensor;

/// What a machine publishes; the name is the last part of the Zenoh key and of the topic in a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Topic {
    /// Accurate pose in the site frame, `nav_msgs/Odometry`.
    Pose,
    /// Smooth pose in the odom frame, `nav_msgs/Odometry`.
    Odom,
    /// State of the machine, JSON.
    Health,
    /// What happened, JSON.
    Event,
    /// In which order the readings were taken, and where solutions were taken over: for replay, JSON.
    Journal,
    /// Readings of one sensor, ROS 2 messages.
    Sensor(Sensor),
}

impl Topic {
    /// All topics: what the machine says, then what its sensors say.
    pub const ALL: [Topic; 11] = [
        Topic::Pose,
        Topic::Odom,
        Topic::Health,
        Topic::Event,
        Topic::Journal,
        Topic::Sensor(Sensor::Imu),
        Topic::Sensor(Sensor::BaseImu),
        Topic::Sensor(Sensor::GnssLeft),
        Topic::Sensor(Sensor::GnssRight),
        Topic::Sensor(Sensor::LidarOdometry),
        Topic::Sensor(Sensor::CabinTurn),
    ];

    /// The name in keys and recordings, such as `sensor/imu`.
    pub const fn name(self) -> &'static str {
        match self {
            Topic::Pose => "pose",
            Topic::Odom => "odom",
            Topic::Health => "health",
            Topic::Event => "event",
            Topic::Journal => "journal",
            Topic::Sensor(Sensor::Imu) => "sensor/imu",
            Topic::Sensor(Sensor::BaseImu) => "sensor/base_imu",
            Topic::Sensor(Sensor::GnssLeft) => "sensor/gnss_left",
            Topic::Sensor(Sensor::GnssRight) => "sensor/gnss_right",
            Topic::Sensor(Sensor::LidarOdometry) => "sensor/lidar_odometry",
            Topic::Sensor(Sensor::CabinTurn) => "sensor/cabin_turn",
        }
    }

    /// The topic of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|topic| topic.name() == name)
    }

    /// Whether its messages are JSON; the others are CDR.
    pub const fn is_json(self) -> bool {
        matches!(self, Topic::Health | Topic::Event | Topic::Journal)
    }
}

impl From<Topic> for String {
    fn from(topic: Topic) -> String {
        topic.name().to_owned()
    }
}

impl TryFrom<String> for Topic {
    type Error = String;
    fn try_from(name: String) -> Result<Self, String> {
        Topic::from_name(&name).ok_or_else(|| format!("\"{name:.40}\" is no topic"))
    }
}

impl fmt::Display for Topic {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_come_back_and_differ() {
        for topic in Topic::ALL {
            assert_eq!(Topic::from_name(topic.name()), Some(topic));
            if let Topic::Sensor(sensor) = topic {
                assert_eq!(topic.name(), format!("sensor/{}", sensor.name()));
            }
        }
        assert_eq!(Topic::from_name("sensor/sonar"), None);
        assert_eq!(Topic::from_name(""), None);
    }
}
