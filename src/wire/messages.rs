//! The ROS 2 messages that we send and read, field by field as their `.msg` files have them.

use super::WireError;
use super::cdr::{CdrError, CdrReader, CdrWriter};
use crate::time::Stamp;

const NANOS_PER_SECOND: i64 = 1_000_000_000;
/// More names than any joint message that concerns us holds.
const JOINTS_MAX: usize = 1024;

/// A ROS 2 message.
pub trait RosMessage: Sized {
    /// Such as `sensor_msgs/msg/Imu`.
    const TYPE: &'static str;

    /// Writes the fields.
    fn write(&self, cdr: &mut CdrWriter);

    /// Reads the fields.
    ///
    /// # Errors
    /// [`CdrError`] says what is wrong with which byte.
    fn read(cdr: &mut CdrReader<'_>) -> Result<Self, CdrError>;

    /// The message as CDR, encapsulation included.
    fn encode(&self) -> Vec<u8> {
        let mut cdr = CdrWriter::with_capacity(768);
        self.write(&mut cdr);
        cdr.finish()
    }

    /// The message from CDR.
    ///
    /// # Errors
    /// [`WireError::Cdr`] if the bytes hold less or more or something else.
    fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        let read = || {
            let mut cdr = CdrReader::new(bytes)?;
            let message = Self::read(&mut cdr)?;
            cdr.finish()?;
            Ok(message)
        };
        read().map_err(|source| WireError::Cdr { message: Self::TYPE, source })
    }
}

/// `std_msgs/Header`.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// When it was measured. On the wire these are i32 seconds: what is beyond (the year 2038) saturates.
    pub stamp: Stamp,
    /// The frame in which the content is written.
    pub frame_id: String,
}

impl Header {
    /// A header.
    pub fn new(stamp: Stamp, frame_id: &str) -> Self {
        Self { stamp, frame_id: frame_id.to_owned() }
    }

    pub(super) fn write(&self, cdr: &mut CdrWriter) {
        write_time(self.stamp, cdr);
        cdr.string(&self.frame_id);
    }

    /// Reads the fields.
    ///
    /// # Errors
    /// [`CdrError`] says what is wrong with which byte.
    pub fn read(cdr: &mut CdrReader<'_>) -> Result<Self, CdrError> {
        let stamp = read_time(cdr)?;
        Ok(Self { stamp, frame_id: cdr.string()?.to_owned() })
    }
}

/// `builtin_interfaces/Time`.
pub(super) fn write_time(stamp: Stamp, cdr: &mut CdrWriter) {
    let seconds = stamp.as_nanos().div_euclid(NANOS_PER_SECOND);
    let nanos = stamp.as_nanos().rem_euclid(NANOS_PER_SECOND);
    cdr.i32(seconds.clamp(i64::from(i32::MIN), i64::from(i32::MAX)) as i32);
    cdr.u32(nanos as u32);
}

pub(super) fn read_time(cdr: &mut CdrReader<'_>) -> Result<Stamp, CdrError> {
    let seconds = i64::from(cdr.i32()?);
    let at = cdr.at();
    let nanos = i64::from(cdr.u32()?);
    if nanos >= NANOS_PER_SECOND {
        return Err(CdrError::BadValue { at, reason: "is not nanoseconds of a second" });
    }
    Ok(Stamp::from_nanos(seconds * NANOS_PER_SECOND + nanos))
}

/// `sensor_msgs/Imu`. Covariances are row-major 3×3; -1 as their first element means that there is no value,
/// zeros that the covariance is not known.
#[derive(Clone, Debug, PartialEq)]
pub struct Imu {
    /// Stamp, and the IMU's frame.
    pub header: Header,
    /// x, y, z, w.
    pub orientation: [f64; 4],
    /// About fixed axes, rad².
    pub orientation_covariance: [f64; 9],
    /// rad/s.
    pub angular_velocity: [f64; 3],
    /// (rad/s)².
    pub angular_velocity_covariance: [f64; 9],
    /// Specific force, m/s².
    pub linear_acceleration: [f64; 3],
    /// (m/s²)².
    pub linear_acceleration_covariance: [f64; 9],
}

impl RosMessage for Imu {
    const TYPE: &'static str = "sensor_msgs/msg/Imu";

    fn write(&self, cdr: &mut CdrWriter) {
        self.header.write(cdr);
        cdr.f64_array(&self.orientation);
        cdr.f64_array(&self.orientation_covariance);
        cdr.f64_array(&self.angular_velocity);
        cdr.f64_array(&self.angular_velocity_covariance);
        cdr.f64_array(&self.linear_acceleration);
        cdr.f64_array(&self.linear_acceleration_covariance);
    }

    fn read(cdr: &mut CdrReader<'_>) -> Result<Self, CdrError> {
        Ok(Self {
            header: Header::read(cdr)?,
            orientation: cdr.f64_array()?,
            orientation_covariance: cdr.f64_array()?,
            angular_velocity: cdr.f64_array()?,
            angular_velocity_covariance: cdr.f64_array()?,
            linear_acceleration: cdr.f64_array()?,
            linear_acceleration_covariance: cdr.f64_array()?,
        })
    }
}

/// `sensor_msgs/NavSatStatus`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NavSatStatus {
    /// -1 no fix, 0 fix, 1 with satellite-based, 2 with ground-based augmentation.
    pub status: i8,
    /// Bits: 1 GPS, 2 GLONASS, 4 BeiDou, 8 Galileo.
    pub service: u16,
}

/// `sensor_msgs/NavSatFix`.
#[derive(Clone, Debug, PartialEq)]
pub struct NavSatFix {
    /// Stamp, and the antenna's frame.
    pub header: Header,
    /// Kind of the fix.
    pub status: NavSatStatus,
    /// Degrees, north positive.
    pub latitude: f64,
    /// Degrees, east positive.
    pub longitude: f64,
    /// Above the WGS84 ellipsoid, m.
    pub altitude: f64,
    /// Row-major, east, north, up, m².
    pub position_covariance: [f64; 9],
    /// 0 unknown, 1 approximated, 2 diagonal known, 3 known.
    pub position_covariance_type: u8,
}

impl RosMessage for NavSatFix {
    const TYPE: &'static str = "sensor_msgs/msg/NavSatFix";

    fn write(&self, cdr: &mut CdrWriter) {
        self.header.write(cdr);
        cdr.i8(self.status.status);
        cdr.u16(self.status.service);
        cdr.f64(self.latitude);
        cdr.f64(self.longitude);
        cdr.f64(self.altitude);
        cdr.f64_array(&self.position_covariance);
        cdr.u8(self.position_covariance_type);
    }

    fn read(cdr: &mut CdrReader<'_>) -> Result<Self, CdrError> {
        Ok(Self {
            header: Header::read(cdr)?,
            status: NavSatStatus { status: cdr.i8()?, service: cdr.u16()? },
            latitude: cdr.f64()?,
            longitude: cdr.f64()?,
            altitude: cdr.f64()?,
            position_covariance: cdr.f64_array()?,
            position_covariance_type: cdr.u8()?,
        })
    }
}

/// `nav_msgs/Odometry`: a pose in the header's frame, a twist in the child's.
#[derive(Clone, Debug, PartialEq)]
pub struct Odometry {
    /// Stamp, and the parent's frame.
    pub header: Header,
    /// The frame whose pose it is.
    pub child_frame_id: String,
    /// Origin of the child in the parent, m.
    pub position: [f64; 3],
    /// `parent_from_child`: x, y, z, w.
    pub orientation: [f64; 4],
    /// Row-major over x, y, z (m) and rotation about the parent's fixed x, y, z axes (rad); zeros: not known.
    pub pose_covariance: [f64; 36],
    /// Of the child's origin, written in the child, m/s.
    pub linear: [f64; 3],
    /// Of the child, written in the child, rad/s.
    pub angular: [f64; 3],
    /// Row-major over linear and angular velocity; zeros: not known.
    pub twist_covariance: [f64; 36],
}

impl RosMessage for Odometry {
    const TYPE: &'static str = "nav_msgs/msg/Odometry";

    fn write(&self, cdr: &mut CdrWriter) {
        self.header.write(cdr);
        cdr.string(&self.child_frame_id);
        cdr.f64_array(&self.position);
        cdr.f64_array(&self.orientation);
        cdr.f64_array(&self.pose_covariance);
        cdr.f64_array(&self.linear);
        cdr.f64_array(&self.angular);
        cdr.f64_array(&self.twist_covariance);
    }

    fn read(cdr: &mut CdrReader<'_>) -> Result<Self, CdrError> {
        Ok(Self {
            header: Header::read(cdr)?,
            child_frame_id: cdr.string()?.to_owned(),
            position: cdr.f64_array()?,
            orientation: cdr.f64_array()?,
            pose_covariance: cdr.f64_array()?,
            linear: cdr.f64_array()?,
            angular: cdr.f64_array()?,
            twist_covariance: cdr.f64_array()?,
        })
    }
}

/// `sensor_msgs/JointState`. Position, velocity and effort each have a value for every name, or are empty.
#[derive(Clone, Debug, PartialEq)]
pub struct JointState {
    /// Stamp.
    pub header: Header,
    /// Of the joints.
    pub name: Vec<String>,
    /// rad or m.
    pub position: Vec<f64>,
    /// rad/s or m/s.
    pub velocity: Vec<f64>,
    /// Nm or N.
    pub effort: Vec<f64>,
}

impl RosMessage for JointState {
    const TYPE: &'static str = "sensor_msgs/msg/JointState";

    fn write(&self, cdr: &mut CdrWriter) {
        self.header.write(cdr);
        cdr.count(self.name.len());
        for name in &self.name {
            cdr.string(name);
        }
        for values in [&self.position, &self.velocity, &self.effort] {
            cdr.count(values.len());
            cdr.f64_array(values);
        }
    }

    fn read(cdr: &mut CdrReader<'_>) -> Result<Self, CdrError> {
        let header = Header::read(cdr)?;
        let at = cdr.at();
        // An empty string takes its length and, from most writers, a NUL.
        let count = cdr.count(4)?;
        if count > JOINTS_MAX {
            return Err(CdrError::BadValue { at, reason: "counts more than 1024 joints" });
        }
        let mut name = Vec::with_capacity(count);
        for _ in 0..count {
            name.push(cdr.string()?.to_owned());
        }
        let mut values = || {
            let count = cdr.count(8)?;
            (0..count).map(|_| cdr.f64()).collect::<Result<Vec<_>, _>>()
        };
        Ok(Self { header, name, position: values()?, velocity: values()?, effort: values()? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hexadecimal(bytes: &[u8]) -> String {
        bytes.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    #[test]
    fn joint_state_is_byte_for_byte_what_ros_writes() {
        let message = JointState {
            header: Header::new(Stamp::from_nanos(-1), "b"),
            name: vec!["cabin_turn".to_owned()],
            position: vec![1.5],
            velocity: vec![],
            effort: vec![],
        };
        let bytes = message.encode();
        let expected = concat!(
            "00010000", // Encapsulation.
            "ffffffff",
            "ffc99a3b", // -1 s and 999 999 999 ns.
            "02000000",
            "6200",
            "0000",     // "b", padded to 4.
            "01000000", // One name,
            "0b000000",
            "636162696e5f7475726e00", // "cabin_turn",
            "00",                     // padded to 4.
            "01000000",               // One position
            "000000000000f83f",       // at byte 40, a multiple of 8: no padding.
            "00000000",
            "00000000", // No velocity, no effort.
        );
        assert_eq!(hexadecimal(&bytes), expected);
        assert_eq!(JointState::decode(&bytes).expect("own bytes"), message);
    }

    #[test]
    fn nav_sat_fix_is_byte_for_byte_what_ros_writes() {
        let message = NavSatFix {
            header: Header::new(Stamp::from_nanos(1_000_000_002), "gnss_left"),
            status: NavSatStatus { status: -1, service: 0x0102 },
            latitude: 1.0,
            longitude: -2.0,
            altitude: 0.5,
            position_covariance: [0.0; 9],
            position_covariance_type: 2,
        };
        let bytes = message.encode();
        let expected = format!(
            "{}{}{}{}{}",
            "00010000",
            concat!("01000000", "02000000", "0a000000", "676e73735f6c65667400"), // 22 bytes so far.
            concat!("ff", "00", "0201", "000000000000"), // Status, service, padding to 32.
            concat!("000000000000f03f", "00000000000000c0", "000000000000e03f"),
            "00".repeat(72) + "02",
        );
        assert_eq!(hexadecimal(&bytes), expected);
        assert_eq!(NavSatFix::decode(&bytes).expect("own bytes"), message);
    }

    #[test]
    fn every_truncation_and_flipped_byte_is_an_error_or_another_message_but_no_panic() {
        let joints = JointState {
            header: Header::new(Stamp::from_nanos(5), "base"),
            name: vec!["a".to_owned(), "b".to_owned()],
            position: vec![1.0, 2.0],
            velocity: vec![0.5],
            effort: vec![],
        }
        .encode();
        let odometry = Odometry {
            header: Header::new(Stamp::from_nanos(5), "world"),
            child_frame_id: "imu".to_owned(),
            position: [1.0, 2.0, 3.0],
            orientation: [0.0, 0.0, 0.0, 1.0],
            pose_covariance: [0.1; 36],
            linear: [0.0; 3],
            angular: [0.0; 3],
            twist_covariance: [0.2; 36],
        }
        .encode();
        for length in 0..joints.len() {
            assert!(JointState::decode(&joints[..length]).is_err(), "{length}");
        }
        for length in 0..odometry.len() {
            assert!(Odometry::decode(&odometry[..length]).is_err(), "{length}");
        }
        for at in 0..joints.len() {
            for value in [0, 1, 127, 255] {
                let mut bytes = joints.clone();
                bytes[at] = value;
                let _ = JointState::decode(&bytes);
                let _ = Odometry::decode(&bytes);
            }
        }
        let message = Odometry::decode(&odometry[..100]).expect_err("cut").to_string();
        assert!(message.starts_with("nav_msgs/msg/Odometry: ends at byte 100"), "{message}");
    }
}
