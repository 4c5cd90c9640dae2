//! JSON on the wire: what a machine says of itself, and its events.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::{BootId, CdrReader, Header, JournalPage, Topic, WireError};
use crate::frames::Pose;
use crate::frames::geodesy::Geodetic;
use crate::lie::{Se3, So3, Vec3};
use crate::state::{Event, Health};
use crate::time::Stamp;

/// More than any report or event of ours takes.
const JSON_BYTES_MAX: usize = 256 * 1024;

/// Origin of the site frame, WGS84.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct Origin {
    /// Degrees, north positive.
    pub latitude_deg: f64,
    /// Degrees, east positive.
    pub longitude_deg: f64,
    /// Above the ellipsoid, m.
    pub altitude_m: f64,
}

/// A rigid motion, `parent_from_child`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct RigidMotion {
    /// Origin of the child in the parent, m.
    pub translation_m: [f64; 3],
    /// Rotation of the child in the parent.
    pub quaternion_xyzw: [f64; 4],
}

/// How long something takes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct Latency {
    /// Mean, µs.
    pub mean_us: f64,
    /// 99th percentile, µs.
    pub p99_us: f64,
    /// Longest, µs.
    pub max_us: f64,
}

/// How a machine's own record does.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct OnBoardRecord {
    /// Whether there is one, now.
    pub kept: bool,
    /// Length of its files.
    pub bytes: u64,
    /// Messages that it had no room for, because the disk did not keep up.
    pub dropped: u64,
    /// Why there is none though there should be.
    pub failure: Option<String>,
}

/// Topic `health`: everything one needs to know of a machine; each message stands for itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "shells", derive(utoipa::ToSchema))]
pub struct MachineReport {
    /// The machine's id.
    pub id: String,
    /// What people call it.
    pub name: String,
    /// Version of its software.
    pub software: String,
    /// This run of its process.
    pub boot: BootId,
    /// Origin of its site frame.
    pub world: Origin,
    /// Where the IMU, whose pose is told, sits in the cabin.
    pub cabin_from_imu: RigidMotion,
    /// What takes its odom frame into the site frame; `null` before the start.
    pub world_from_odom: Option<RigidMotion>,
    /// From the newest estimate to this message, by the machine's clock, s; `null` before the start.
    pub estimate_age_s: Option<f64>,
    /// From an IMU sample to its estimate, over the last second or so; `null` before the start, and from
    /// software that does not tell.
    #[serde(default)]
    pub prediction: Option<Latency>,
    /// The machine's own record; `null` from software that does not tell.
    #[serde(default)]
    pub record: Option<OnBoardRecord>,
    /// State of the estimator.
    pub health: Health,
}

impl From<Geodetic> for Origin {
    fn from(position: Geodetic) -> Self {
        let Geodetic { latitude_deg, longitude_deg, altitude_m } = position;
        Self { latitude_deg, longitude_deg, altitude_m }
    }
}

impl From<Origin> for Geodetic {
    fn from(origin: Origin) -> Self {
        let Origin { latitude_deg, longitude_deg, altitude_m } = origin;
        Self { latitude_deg, longitude_deg, altitude_m }
    }
}

impl<A, B> From<&Pose<A, B>> for RigidMotion {
    fn from(pose: &Pose<A, B>) -> Self {
        Self { translation_m: pose.translation().into(), quaternion_xyzw: pose.rotation().to_xyzw() }
    }
}

impl RigidMotion {
    /// The motion with the frames that the caller promises; `None` if it is no rotation or not finite.
    pub fn pose<A, B>(&self) -> Option<Pose<A, B>> {
        let [x, y, z, w] = self.quaternion_xyzw;
        let rotation = So3::from_xyzw(x, y, z, w)?;
        let finite = self.translation_m.iter().all(|value| value.is_finite());
        finite.then(|| Pose::assume(Se3::new(rotation, Vec3::from(self.translation_m))))
    }
}

/// A report or an event as JSON. Numbers that are not finite become `null`.
///
/// # Errors
/// [`WireError::Json`] if the value has no JSON form; ours have.
pub fn encode_json<T: Serialize>(message: &'static str, value: &T) -> Result<Vec<u8>, WireError> {
    serde_json::to_vec(value).map_err(|source| WireError::Json { message, source })
}

/// The stamp that goes with a message, out of its payload: of the reading or of the estimate, of the report, of the
/// event. `None` for a page of the journal, whose stamp is when it was sent, and if there is none to be found.
pub fn payload_stamp(topic: Topic, payload: &[u8]) -> Option<Stamp> {
    #[derive(Deserialize)]
    struct Stamped {
        stamp_ns: i64,
    }
    #[derive(Deserialize)]
    struct Reported {
        health: Stamped,
    }
    let nanos = match topic {
        Topic::Health => serde_json::from_slice::<Reported>(payload).ok()?.health.stamp_ns,
        Topic::Event => serde_json::from_slice::<Stamped>(payload).ok()?.stamp_ns,
        Topic::Journal => return None,
        // All of them begin with a header, and a header with its stamp.
        Topic::Pose | Topic::Odom | Topic::Sensor(_) => {
            return Header::read(&mut CdrReader::new(payload).ok()?).ok().map(|header| header.stamp);
        }
    };
    Some(Stamp::from_nanos(nanos))
}

/// Reads the payload of topic `health`.
///
/// # Errors
/// [`WireError`] if it is too long or not a report.
pub fn decode_report(bytes: &[u8]) -> Result<MachineReport, WireError> {
    decode("machine report", bytes)
}

/// Reads the payload of topic `event`.
///
/// # Errors
/// [`WireError`] if it is too long or not an event.
pub fn decode_event(bytes: &[u8]) -> Result<Event, WireError> {
    decode("event", bytes)
}

/// Reads the payload of topic `journal`.
///
/// # Errors
/// [`WireError`] if it is too long or not a page.
pub fn decode_journal_page(bytes: &[u8]) -> Result<JournalPage, WireError> {
    decode("journal page", bytes)
}

fn decode<T: DeserializeOwned>(message: &'static str, bytes: &[u8]) -> Result<T, WireError> {
    if bytes.len() > JSON_BYTES_MAX {
        return Err(WireError::TooLong { message, length: bytes.len(), limit: JSON_BYTES_MAX });
    }
    serde_json::from_slice(bytes).map_err(|source| WireError::Json { message, source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensors::Sensor;
    use crate::state::{EventKind, GnssState, Mode, Severity};
    use crate::time::Stamp;

    fn report() -> MachineReport {
        MachineReport {
            id: "a".to_owned(),
            name: "Excavator A".to_owned(),
            software: "0.1.0".to_owned(),
            boot: BootId(0xab),
            world: Origin { latitude_deg: 47.480_140_2, longitude_deg: 8.499_753_25, altitude_m: 474.9 },
            cabin_from_imu: RigidMotion {
                translation_m: [0.3, -0.2, 0.1],
                quaternion_xyzw: [0.0, 0.0, 0.6, 0.8],
            },
            world_from_odom: None,
            estimate_age_s: None,
            prediction: Some(Latency { mean_us: 1.5, p99_us: 4.0, max_us: 20.0 }),
            record: Some(OnBoardRecord { kept: true, bytes: 5, dropped: 0, failure: None }),
            health: Health {
                stamp_ns: 1,
                mode: Mode::Initializing,
                waits_for: Some("a standstill".to_owned()),
                gnss: GnssState::Silent,
                gnss_inflation: [1.0; 2],
                position_sigma_m: None,
                heading_sigma_deg: None,
                worst_test_ratio: 0.0,
                worst_test_sensor: None,
                sensors: vec![],
                outage: None,
                updates: 0,
                update_us: 0.0,
                gyro_bias: [0.0; 3],
                accel_bias: [0.0; 3],
            },
        }
    }

    #[test]
    fn report_comes_back_and_has_the_agreed_fields() {
        let bytes = encode_json("machine report", &report()).expect("JSON");
        assert_eq!(decode_report(&bytes).expect("own bytes"), report());
        let value: serde_json::Value = serde_json::from_slice(&bytes).expect("JSON");
        assert_eq!(value["boot"], "00000000000000ab");
        assert!(value["world_from_odom"].is_null());
        assert_eq!(value["cabin_from_imu"]["quaternion_xyzw"][3], 0.8);
        assert_eq!(value["health"]["mode"], "initializing");
    }

    #[test]
    fn events_come_back() {
        let what = EventKind::Refused { sensor: Sensor::Imu, reason: "NaN".to_owned(), count: 3 };
        let event = Event::new(Stamp::from_nanos(5), Severity::Warning, what);
        let bytes = encode_json("event", &event).expect("JSON");
        assert_eq!(decode_event(&bytes).expect("own bytes"), event);
    }

    #[test]
    fn what_is_no_report_is_refused() {
        let bytes = encode_json("machine report", &report()).expect("JSON");
        for length in 0..bytes.len() {
            assert!(decode_report(&bytes[..length]).is_err());
        }
        let message = decode_report(&vec![b' '; JSON_BYTES_MAX + 1]).expect_err("long").to_string();
        assert_eq!(message, "machine report: 262145 bytes, at most 262144 are taken");
        assert!(decode_event("[".repeat(100_000).as_bytes()).is_err());
        let motion = RigidMotion { translation_m: [0.0; 3], quaternion_xyzw: [0.0; 4] };
        assert!(motion.pose::<crate::frames::World, crate::frames::Odom>().is_none());
    }
}
