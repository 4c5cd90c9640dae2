//! Messages that are made of those that machines send.

use crate::frames::geodesy::SiteFrame;
use crate::frames::{Base, Cabin, Frame as _, Imu, Odom, World};
use crate::lie::Vec3;
use crate::state::{EventKind, Severity};
use crate::time::Stamp;
use crate::wire::{
    Header, Log, LogLevel, NavSatFix, NavSatStatus, Odometry, RigidMotion, RosMessage as _, TfMessage, Topic,
    TransformStamped, decode_event, decode_report,
};

/// `NavSatStatus.STATUS_FIX`.
const STATUS_FIX: i8 = 0;
/// `NavSatFix.COVARIANCE_TYPE_KNOWN`.
const COVARIANCE_KNOWN: u8 = 3;
/// Columns of a pose's covariance.
const POSE_DIM: usize = 6;

/// The frames that a message of `pose`, `odom` or `health` places; `None` if it places none, or cannot be read.
///
/// A frame has one parent: the IMU hangs on the world, where its place is most accurate, and the odom frame beside it.
pub(super) fn transforms(machine: &str, topic: Topic, payload: &[u8]) -> Option<Vec<u8>> {
    let own = |frame: &str| format!("{machine}/{frame}");
    let placed = |stamp: Stamp, parent: &str, child: &str, motion: RigidMotion| TransformStamped {
        header: Header::new(stamp, parent),
        child_frame_id: own(child),
        translation: motion.translation_m,
        rotation: motion.quaternion_xyzw,
    };
    let transforms = match topic {
        Topic::Pose | Topic::Odom => {
            let message = Odometry::decode(payload).ok()?;
            let parent = match topic {
                Topic::Pose => World::NAME.to_owned(),
                // Without a chassis it is the IMU once more.
                _ if message.child_frame_id != Base::NAME => return None,
                _ => own(Odom::NAME),
            };
            let child = if topic == Topic::Pose { Imu::NAME } else { Base::NAME };
            let motion =
                RigidMotion { translation_m: message.position, quaternion_xyzw: message.orientation };
            vec![placed(message.header.stamp, &parent, child, motion)]
        }
        Topic::Health => {
            let report = decode_report(payload).ok()?;
            let stamp = Stamp::from_nanos(report.health.stamp_ns);
            let imu_from_cabin = report.cabin_from_imu.pose::<Cabin, Imu>()?.inverse();
            let mut both = vec![placed(stamp, &own(Imu::NAME), Cabin::NAME, (&imu_from_cabin).into())];
            let world_from_odom = report.world_from_odom;
            both.extend(world_from_odom.map(|motion| placed(stamp, World::NAME, Odom::NAME, motion)));
            both
        }
        Topic::Event | Topic::Journal | Topic::Sensor(_) => return None,
    };
    Some(TfMessage { transforms }.encode())
}

/// Where a message of `pose` puts the IMU on the earth.
pub(super) fn location(payload: &[u8], site: &SiteFrame) -> Option<Vec<u8>> {
    let message = Odometry::decode(payload).ok()?;
    let place = site.to_geodetic(&Vec3::from(message.position));
    let covariance = |index: usize| message.pose_covariance[index / 3 * POSE_DIM + index % 3];
    let fix = NavSatFix {
        header: Header::new(message.header.stamp, Imu::NAME),
        status: NavSatStatus { status: STATUS_FIX, service: 0 },
        latitude: place.latitude_deg,
        longitude: place.longitude_deg,
        altitude: place.altitude_m,
        position_covariance: std::array::from_fn(covariance),
        position_covariance_type: COVARIANCE_KNOWN,
    };
    Some(fix.encode())
}

/// A message of `event` in words.
pub(super) fn log(machine: &str, payload: &[u8]) -> Option<Vec<u8>> {
    let event = decode_event(payload).ok()?;
    let level = match event.severity {
        Severity::Info => LogLevel::Info,
        Severity::Warning => LogLevel::Warn,
        Severity::Error => LogLevel::Error,
    };
    let log = Log {
        stamp: Stamp::from_nanos(event.stamp_ns),
        level,
        name: machine.to_owned(),
        text: words(&event.what),
    };
    Some(log.encode())
}

fn words(what: &EventKind) -> String {
    match what {
        EventKind::ModeChanged { from, to } => format!("mode: {from} to {to}"),
        EventKind::GraphChanged { from, to, reason } => format!("graph: {from:?} to {to:?}: {reason}"),
        EventKind::GnssChanged { from, to } => format!("GNSS: {} to {}", from.name(), to.name()),
        EventKind::Initialized { heading_from, heading_sigma_deg } => {
            format!("started, heading from {heading_from} to {heading_sigma_deg:.2}°")
        }
        EventKind::Refused { sensor, reason, count } => format!("{count} refused of {sensor}: {reason}"),
        EventKind::OutageBegan { cause } => format!("GNSS lost: {}", cause.name()),
        EventKind::OutageEnded(outage) => {
            let end = outage.end_stamp_ns.unwrap_or(outage.start_stamp_ns);
            let lasted_s = Stamp::from_nanos(end).seconds_since(Stamp::from_nanos(outage.start_stamp_ns));
            let jump =
                outage.jump_m.map(|jump_m| format!(", corrected by {jump_m:.3} m")).unwrap_or_default();
            format!("GNSS back after {lasted_s:.1} s and {:.1} m{jump}", outage.travelled_m)
        }
        EventKind::Restarted { reason } => format!("started anew: {reason}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::geodesy::Geodetic;
    use crate::state::{Event, GnssState};
    use crate::wire::encode_json;

    fn odometry(parent: &str, child: &str) -> Vec<u8> {
        let mut pose_covariance = [0.0; 36];
        (pose_covariance[0], pose_covariance[1], pose_covariance[6]) = (4.0, 1.0, 1.0);
        let message = Odometry {
            header: Header::new(Stamp::from_nanos(7), parent),
            child_frame_id: child.to_owned(),
            position: [10.0, 0.0, 2.0],
            orientation: [0.0, 0.0, 0.6, 0.8],
            pose_covariance,
            linear: [0.0; 3],
            angular: [0.0; 3],
            twist_covariance: [0.0; 36],
        };
        message.encode()
    }

    #[test]
    fn every_frame_has_one_parent() {
        let places = |topic, payload: &[u8]| -> Option<(String, String)> {
            let bytes = transforms("a", topic, payload)?;
            let [one] = TfMessage::decode(&bytes).expect("own bytes").transforms.try_into().expect("one");
            assert_eq!((one.translation, one.rotation), ([10.0, 0.0, 2.0], [0.0, 0.0, 0.6, 0.8]));
            Some((one.header.frame_id, one.child_frame_id))
        };
        let names = |parent: &str, child: &str| Some((parent.to_owned(), child.to_owned()));
        assert_eq!(places(Topic::Pose, &odometry("world", "imu")), names("world", "a/imu"));
        assert_eq!(places(Topic::Odom, &odometry("odom", "base")), names("a/odom", "a/base"));
        // The IMU hangs on the world already.
        assert_eq!(places(Topic::Odom, &odometry("odom", "imu")), None);
        assert_eq!(places(Topic::Pose, &[1, 2, 3]), None);
    }

    #[test]
    fn place_and_words_are_those_of_the_message() {
        let origin = Geodetic { latitude_deg: 47.0, longitude_deg: 8.0, altitude_m: 400.0 };
        let bytes = location(&odometry("world", "imu"), &SiteFrame::new(origin)).expect("a place");
        let fix = NavSatFix::decode(&bytes).expect("own bytes");
        assert!((fix.latitude - 47.0).abs() < 1e-8 && (fix.longitude - 8.000_131_5).abs() < 1e-6, "{fix:?}");
        assert!((fix.altitude - 402.0).abs() < 1e-4, "{fix:?}");
        assert_eq!(fix.position_covariance[..4], [4.0, 1.0, 0.0, 1.0]);
        let what = EventKind::OutageBegan { cause: GnssState::Silent };
        let event = Event::new(Stamp::from_nanos(9), Severity::Warning, what);
        let bytes = log("a", &encode_json("event", &event).expect("JSON")).expect("a line");
        let line = Log::decode(&bytes).expect("own bytes");
        assert_eq!((line.level, line.text.as_str()), (LogLevel::Warn, "GNSS lost: silent"));
        assert_eq!((line.stamp, line.name.as_str()), (Stamp::from_nanos(9), "a"));
    }
}
