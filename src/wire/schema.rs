//! What the messages of a topic are called and how they are defined, as MCAP files and ROS tools want it.

use super::Topic;
use super::messages::{Imu, JointState, NavSatFix, Odometry, RosMessage};
use super::shown::{Log, TfMessage};
use crate::sensors::Sensor;

/// Between the definitions of one schema: a line of eighty, as `ros2msg` has it.
macro_rules! separator {
    () => {
        "================================================================================\nMSG: "
    };
}

macro_rules! header {
    () => {
        concat!(
            separator!(),
            "std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n",
            separator!(),
            "builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
        )
    };
}

macro_rules! vector3 {
    () => {
        concat!(separator!(), "geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n")
    };
}

macro_rules! quaternion {
    () => {
        concat!(separator!(), "geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n")
    };
}

const IMU: &str = concat!(
    "std_msgs/Header header\n",
    "geometry_msgs/Quaternion orientation\n",
    "float64[9] orientation_covariance\n",
    "geometry_msgs/Vector3 angular_velocity\n",
    "float64[9] angular_velocity_covariance\n",
    "geometry_msgs/Vector3 linear_acceleration\n",
    "float64[9] linear_acceleration_covariance\n",
    header!(),
    quaternion!(),
    vector3!(),
);

const NAV_SAT_FIX: &str = concat!(
    "std_msgs/Header header\n",
    "sensor_msgs/NavSatStatus status\n",
    "float64 latitude\n",
    "float64 longitude\n",
    "float64 altitude\n",
    "float64[9] position_covariance\n",
    "uint8 COVARIANCE_TYPE_UNKNOWN=0\n",
    "uint8 COVARIANCE_TYPE_APPROXIMATED=1\n",
    "uint8 COVARIANCE_TYPE_DIAGONAL_KNOWN=2\n",
    "uint8 COVARIANCE_TYPE_KNOWN=3\n",
    "uint8 position_covariance_type\n",
    header!(),
    separator!(),
    "sensor_msgs/NavSatStatus\n",
    "int8 STATUS_NO_FIX=-1\n",
    "int8 STATUS_FIX=0\n",
    "int8 STATUS_SBAS_FIX=1\n",
    "int8 STATUS_GBAS_FIX=2\n",
    "int8 status\n",
    "uint16 SERVICE_GPS=1\n",
    "uint16 SERVICE_GLONASS=2\n",
    "uint16 SERVICE_COMPASS=4\n",
    "uint16 SERVICE_GALILEO=8\n",
    "uint16 service\n",
);

const ODOMETRY: &str = concat!(
    "std_msgs/Header header\n",
    "string child_frame_id\n",
    "geometry_msgs/PoseWithCovariance pose\n",
    "geometry_msgs/TwistWithCovariance twist\n",
    header!(),
    separator!(),
    "geometry_msgs/PoseWithCovariance\nPose pose\nfloat64[36] covariance\n",
    separator!(),
    "geometry_msgs/Pose\nPoint position\nQuaternion orientation\n",
    separator!(),
    "geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n",
    quaternion!(),
    separator!(),
    "geometry_msgs/TwistWithCovariance\nTwist twist\nfloat64[36] covariance\n",
    separator!(),
    "geometry_msgs/Twist\nVector3 linear\nVector3 angular\n",
    vector3!(),
);

const JOINT_STATE: &str = concat!(
    "std_msgs/Header header\n",
    "string[] name\n",
    "float64[] position\n",
    "float64[] velocity\n",
    "float64[] effort\n",
    header!(),
);

const TF_MESSAGE: &str = concat!(
    "geometry_msgs/TransformStamped[] transforms\n",
    separator!(),
    "geometry_msgs/TransformStamped\n",
    "std_msgs/Header header\n",
    "string child_frame_id\n",
    "geometry_msgs/Transform transform\n",
    header!(),
    separator!(),
    "geometry_msgs/Transform\nVector3 translation\nQuaternion rotation\n",
    quaternion!(),
    vector3!(),
);

const LOG: &str = concat!(
    "uint8 DEBUG=10\n",
    "uint8 INFO=20\n",
    "uint8 WARN=30\n",
    "uint8 ERROR=40\n",
    "uint8 FATAL=50\n",
    "builtin_interfaces/Time stamp\n",
    "uint8 level\n",
    "string name\n",
    "string msg\n",
    "string file\n",
    "string function\n",
    "uint32 line\n",
    separator!(),
    "builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
);

/// Name and definition of a ROS 2 message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Schema {
    /// Such as `sensor_msgs/msg/Imu`.
    pub name: &'static str,
    /// The `.msg` text with the types that it uses, in the format `ros2msg`.
    pub definition: &'static str,
}

/// The schema of a topic's messages; `None` for JSON, which describes itself.
pub const fn schema_of(topic: Topic) -> Option<Schema> {
    match topic {
        Topic::Pose | Topic::Odom | Topic::Sensor(Sensor::LidarOdometry) => {
            Some(Schema { name: Odometry::TYPE, definition: ODOMETRY })
        }
        Topic::Sensor(Sensor::Imu | Sensor::BaseImu) => Some(Schema { name: Imu::TYPE, definition: IMU }),
        Topic::Sensor(Sensor::GnssLeft | Sensor::GnssRight) => {
            Some(Schema { name: NavSatFix::TYPE, definition: NAV_SAT_FIX })
        }
        Topic::Sensor(Sensor::CabinTurn) => Some(Schema { name: JointState::TYPE, definition: JOINT_STATE }),
        Topic::Health | Topic::Event | Topic::Journal => None,
    }
}

/// Of messages that are made for those who look on, and not recorded.
impl Schema {
    /// Places of frames.
    pub const TRANSFORMS: Schema = Schema { name: TfMessage::TYPE, definition: TF_MESSAGE };
    /// A place on the earth.
    pub const LOCATION: Schema = Schema { name: NavSatFix::TYPE, definition: NAV_SAT_FIX };
    /// What happened, in words.
    pub const LOG: Schema = Schema { name: Log::TYPE, definition: LOG };
}

#[cfg(test)]
mod tests {
    use super::*;

    const PRIMITIVES: [&str; 9] =
        ["float64", "int8", "uint8", "int16", "uint16", "int32", "uint32", "string", "bool"];

    #[test]
    fn every_type_that_is_used_is_defined_once() {
        let recorded = Topic::ALL.into_iter().filter_map(|topic| {
            assert_eq!(schema_of(topic).is_none(), topic.is_json(), "{topic}");
            schema_of(topic)
        });
        for schema in recorded.chain([Schema::TRANSFORMS, Schema::LOCATION, Schema::LOG]) {
            let topic = schema.name;
            let mut defined: Vec<&str> =
                schema.definition.lines().filter_map(|line| line.strip_prefix("MSG: ")).collect();
            let count = defined.len();
            defined.sort_unstable();
            defined.dedup();
            assert_eq!(defined.len(), count, "{topic}");
            for line in schema.definition.lines().filter(|line| !line.starts_with(['=', 'M'])) {
                let used = line.split([' ', '[']).next().expect("a type");
                let known = PRIMITIVES.contains(&used)
                    || defined.iter().any(|name| *name == used || name.ends_with(&format!("/{used}")));
                assert!(known, "{topic}: {used}");
            }
        }
    }
}
