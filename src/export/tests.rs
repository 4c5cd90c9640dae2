//! Behaviour of tracks, their formats, and the spool.

use std::path::PathBuf;

use super::*;
use crate::frames::geodesy::{Geodetic, SiteFrame};
use crate::lie::Vec3;
use crate::record::{RecordWriter, Recorded, SITE};
use crate::state::{Event, EventKind, GnssState, OutageReport, Severity};
use crate::time::Span;
use crate::wire::{Header, Odometry, RosMessage, Topic, encode_json};

const ORIGIN: Geodetic = Geodetic { latitude_deg: 47.0, longitude_deg: 8.0, altitude_m: 400.0 };

fn at(ms: i64) -> Stamp {
    Stamp::from_nanos(1_790_000_000_000_000_000) + Span::from_millis(ms)
}

fn pose(ms: i64) -> TrackPose {
    let position = Vec3::new(0.001 * ms as f64, 2.0, 1.0 / 3.0);
    TrackPose { stamp: at(ms), position, quaternion_xyzw: [0.0, 0.0, 0.0, 1.0] }
}

fn outage(from_ms: i64, to_ms: Option<i64>) -> Outage {
    Outage { start: at(from_ms), end: to_ms.map(at), cause: "lost".to_owned() }
}

fn options(format: Format) -> Options {
    Options { format, site: Some(SiteFrame::new(ORIGIN)), gap: Span::from_millis(1_000), period: None }
}

/// One track, as text.
fn write(options: Options, outages: Option<Vec<Outage>>, poses: &[TrackPose]) -> (String, Written) {
    let mut writer = TrackWriter::new(Vec::new(), options).expect("begun");
    writer.begin_track("a<b", outages).expect("begun");
    poses.iter().for_each(|pose| writer.pose(pose).expect("written"));
    let (bytes, written) = writer.finish().expect("ended");
    (String::from_utf8(bytes).expect("UTF-8"), written)
}

/// 10 Hz for 3 s, a gap of 2 s, 1 s more; no GNSS from 1 s to 2 s.
fn walk() -> (Vec<TrackPose>, Vec<Outage>) {
    let poses = (0..30).chain(50..60).map(|index| pose(100 * index)).collect();
    (poses, vec![outage(1_000, Some(2_000))])
}

#[test]
fn geojson_is_cut_at_gaps_and_outages_and_lines_meet_where_there_is_no_gap() {
    let (poses, outages) = walk();
    let (text, written) = write(options(Format::GeoJson), Some(outages), &poses);
    let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let features = json["features"].as_array().expect("features");
    let told: Vec<(&str, u64, usize, usize)> = features
        .iter()
        .map(|feature| {
            let properties = &feature["properties"];
            (
                properties["gnss"].as_str().expect("gnss"),
                properties["poses"].as_u64().expect("poses"),
                feature["geometry"]["coordinates"].as_array().expect("line").len(),
                properties["coordTimes"].as_array().expect("times").len(),
            )
        })
        .collect();
    assert_eq!(
        told,
        [("good", 10, 10, 10), ("outage", 10, 11, 11), ("good", 10, 11, 11), ("good", 10, 10, 10)]
    );
    assert_eq!(features[1]["geometry"]["coordinates"][0], features[0]["geometry"]["coordinates"][9]);
    assert_eq!(features[1]["properties"]["cause"], "lost");
    assert_eq!(features[0]["properties"]["machine"], "a<b");
    assert_eq!(features[0]["properties"]["coordTimes"][1], "2026-09-21T14:13:20.1Z");
    let first = &features[0]["geometry"]["coordinates"][0];
    let place = SiteFrame::new(ORIGIN).to_geodetic(&poses[0].position);
    assert!((first[0].as_f64().expect("longitude") - place.longitude_deg).abs() < 1e-9);
    assert!((first[1].as_f64().expect("latitude") - place.latitude_deg).abs() < 1e-9);
    assert_eq!(written, Written { tracks: 1, poses: 40, thinned: 0, gaps: 1 });
}

#[test]
fn a_lone_pose_is_a_point_and_a_long_line_is_cut() {
    let (text, _) = write(options(Format::GeoJson), None, &[pose(0)]);
    let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    assert_eq!(json["features"][0]["geometry"]["type"], "Point");
    assert_eq!(json["features"][0]["properties"]["gnss"], "unknown");
    let long: Vec<TrackPose> = (0..50_001).map(pose).collect();
    let (text, _) = write(options(Format::GeoJson), None, &long);
    let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let lengths: Vec<usize> = json["features"]
        .as_array()
        .expect("features")
        .iter()
        .map(|feature| feature["geometry"]["coordinates"].as_array().expect("line").len())
        .collect();
    assert_eq!(lengths, [50_000, 2]);
}

#[test]
fn gpx_is_cut_at_gaps_only_and_kml_tells_the_outage() {
    let (poses, outages) = walk();
    let (gpx, _) = write(options(Format::Gpx), Some(outages.clone()), &poses);
    assert_eq!((gpx.matches("<trkseg>").count(), gpx.matches("</trkseg>").count()), (2, 2));
    assert_eq!(gpx.matches("<trkpt ").count(), 40);
    assert!(gpx.contains("<name>a&lt;b</name>"));
    let (kml, _) = write(options(Format::Kml), Some(outages), &poses);
    assert_eq!(kml.matches("<gx:Track>").count(), 4);
    assert_eq!(kml.matches("GNSS outage: lost").count(), 1);
    assert_eq!(kml.matches("<when>").count(), kml.matches("<gx:coord>").count());
}

#[test]
fn tum_and_csv_hold_every_pose_once_to_the_bit() {
    let (poses, outages) = walk();
    let (tum, _) = write(Options { site: None, ..options(Format::Tum) }, Some(outages.clone()), &poses);
    assert_eq!(tum.lines().count(), 40);
    assert_eq!(tum.lines().next(), Some("1790000000.000000000 0 2 0.3333333333333333 0 0 0 1"));
    let (csv, _) = write(Options { site: None, ..options(Format::Csv) }, Some(outages.clone()), &poses);
    assert_eq!(csv.lines().next(), Some("machine,t,x,y,z,qx,qy,qz,qw,gnss"));
    assert_eq!(csv.matches(",outage").count(), 10);
    let (csv, _) = write(options(Format::Csv), Some(outages), &poses);
    assert!(csv.lines().next().is_some_and(|head| head.ends_with(",latitude_deg,longitude_deg,altitude_m")));
    let fields = csv.lines().nth(1).map(|line| line.split(',').count());
    assert_eq!(fields, Some(13));
}

#[test]
fn thinning_keeps_the_first_of_each_period_and_every_beginning_after_a_gap() {
    let poses: Vec<TrackPose> = (0..100).chain(305..400).map(|index| pose(10 * index)).collect();
    let thin = Options { period: Some(Span::from_millis(100)), ..options(Format::Tum) };
    let (tum, written) = write(thin, None, &poses);
    assert_eq!((written.poses, written.thinned, written.gaps), (20, 175, 1));
    assert!(tum.contains(&format!("{} ", at(3_050))), "{tum}");
}

#[test]
fn what_a_format_cannot_hold_is_refused() {
    let message = |result: io::Result<()>| result.expect_err("refused").to_string();
    let without = Options { site: None, ..options(Format::Gpx) };
    assert_eq!(message(TrackWriter::new(Vec::new(), without).map(drop)), "gpx needs the origin of the site");
    let mut writer = TrackWriter::new(Vec::new(), options(Format::Tum)).expect("begun");
    writer.begin_track("a", None).expect("the first");
    assert_eq!(message(writer.begin_track("b", None)), "a tum file takes one track");
}

fn keep(poses: &mut Vec<TrackPose>) -> impl FnMut(&TrackPose) -> io::Result<()> {
    |pose| {
        poses.push(*pose);
        Ok(())
    }
}

fn scratch(name: &str) -> PathBuf {
    std::env::temp_dir().join(format!("holdfast-export-{name}-{}", std::process::id()))
}

#[test]
fn scratch_file_is_none_that_is_there() {
    let path = scratch("taken");
    std::fs::write(&path, "of another").expect("written");
    let mut spool = Spool::with_limit(path.clone(), 1);
    spool.push("a", pose(0)).expect("held");
    let error = spool.push("a", pose(1)).expect_err("the name is taken");
    assert_eq!(error.kind(), io::ErrorKind::AlreadyExists);
    assert_eq!(std::fs::read(&path).expect("there"), b"of another");
    std::fs::remove_file(&path).expect("removed");
}

#[test]
fn scratch_file_is_bounded() {
    let mut spool = Spool::with_limit(scratch("bounded"), 10).with_scratch_max(20 * 64);
    (0..30).for_each(|ms| spool.push("a", pose(ms)).expect("held, and spilled twice"));
    assert_eq!(spool.spilled(), 20);
    let error = spool.push("a", pose(30)).expect_err("the scratch file is full");
    assert_eq!(error.kind(), io::ErrorKind::QuotaExceeded);
}

#[test]
fn pose_that_is_nowhere_on_the_earth_is_unfit() {
    let good = pose(0);
    assert!(good.is_fit());
    for x in [f64::NAN, f64::INFINITY, 1e300, -2.1e7] {
        assert!(!TrackPose { position: Vec3::new(0.0, x, 0.0), ..good }.is_fit(), "{x}");
    }
    for x in [f64::NAN, 0.0, 1e-3, 2.0, 1e300] {
        assert!(!TrackPose { quaternion_xyzw: [0.0, x, 0.0, 0.0], ..good }.is_fit(), "{x}");
    }
}

#[test]
fn spool_sorts_what_comes_mixed_the_same_in_memory_and_on_disk() {
    // Two machines; the second tenth of b comes late, c is there twice, and contradicts itself once.
    let mut coming: Vec<(&str, TrackPose)> = Vec::new();
    for ms in (0..10_000).filter(|ms| !(1_000..2_000).contains(ms)).chain(1_000..2_000) {
        coming.push(("b", pose(ms)));
        coming.push(("a", pose(ms + 1)));
    }
    for ms in (0..3_000).chain(0..3_000) {
        coming.push(("c", pose(ms)));
    }
    coming.push(("c", TrackPose { position: Vec3::zeros(), ..pose(77) }));
    let drained = |limit: usize, name: &str| {
        let path = scratch(name);
        let mut spool = Spool::with_limit(path.clone(), limit);
        coming.iter().for_each(|(machine, pose)| spool.push(machine, *pose).expect("taken"));
        assert_eq!(spool.spilled() > 0, limit < coming.len(), "{limit}");
        assert!(!path.exists());
        let counts = [("a", 10_000), ("b", 10_000), ("c", 6_001)].map(|(id, count)| (id.to_owned(), count));
        assert_eq!(spool.machines(), counts);
        let mut out = Vec::new();
        let mut repeats = Vec::new();
        for machine in ["c", "a", "b"] {
            let mut poses = Vec::new();
            repeats.push(spool.drain(machine, keep(&mut poses)).expect("drained"));
            assert!(poses.windows(2).all(|pair| pair[0].stamp < pair[1].stamp));
            out.push(poses);
        }
        (out, repeats)
    };
    let in_memory = drained(1 << 20, "memory");
    assert_eq!(in_memory.0.iter().map(Vec::len).collect::<Vec<_>>(), [3_000, 10_000, 10_000]);
    let contradicting = Repeats { same: 3_000, contradicting: 1, first_contradicting: Some(at(77)) };
    assert_eq!(in_memory.1, [contradicting, Repeats::default(), Repeats::default()]);
    for limit in [1_000, 4_097] {
        assert!(drained(limit, &format!("disk-{limit}")) == in_memory, "{limit}");
    }
}

fn event(ms: i64, what: EventKind) -> Event {
    Event::new(at(ms), Severity::Warning, what)
}

fn ended(from_ms: i64, to_ms: i64) -> EventKind {
    EventKind::OutageEnded(OutageReport {
        start_stamp_ns: at(from_ms).as_nanos(),
        end_stamp_ns: Some(at(to_ms).as_nanos()),
        cause: GnssState::Degraded,
        travelled_m: 0.0,
        jump_m: None,
    })
}

#[test]
fn outages_end_with_their_report_or_with_a_new_start() {
    let began = || EventKind::OutageBegan { cause: GnssState::Degraded };
    let restarted = EventKind::Restarted { reason: "a gap".to_owned() };
    let events = [
        event(2_000, ended(500, 2_000)),
        event(3_000, began()),
        event(4_000, restarted),
        event(5_000, began()),
        event(6_000, ended(4_900, 6_000)),
        event(9_000, began()),
    ];
    let found: Vec<(Stamp, Option<Stamp>)> =
        outages_of_events(&events).into_iter().map(|outage| (outage.start, outage.end)).collect();
    let expected = [(500, Some(2_000)), (3_000, Some(4_000)), (4_900, Some(6_000)), (9_000, None)];
    assert_eq!(found, expected.map(|(start, end)| (at(start), end.map(at))));
}

#[test]
fn recording_gives_poses_outages_origin_and_what_was_wrong() {
    let path = scratch("recording.mcap");
    let mut writer = RecordWriter::create(&path).expect("created");
    let site = [("latitude_deg", "47"), ("longitude_deg", "8"), ("altitude_m", "400")];
    writer
        .write_metadata(SITE, site.map(|(key, value)| (key.to_owned(), value.to_owned())).into())
        .expect("told");
    let mut put = |machine: &str, topic: Topic, ms: i64, payload: Vec<u8>| {
        let message = Recorded {
            machine: machine.to_owned(),
            topic,
            boot: None,
            sequence: 0,
            received: at(ms),
            sent: at(ms),
            payload,
        };
        writer.write(&message).expect("written");
    };
    let odometry = |ms: i64, x: f64| Odometry {
        header: Header::new(at(ms), "world"),
        child_frame_id: "imu".to_owned(),
        position: [x, 0.0, 0.0],
        orientation: [0.0, 0.0, 0.0, 1.0],
        pose_covariance: [0.0; 36],
        linear: [0.0; 3],
        angular: [0.0; 3],
        twist_covariance: [0.0; 36],
    };
    for ms in 0..100 {
        put("a", Topic::Pose, ms, odometry(ms, 1.0).encode());
        put("b", Topic::Pose, ms, odometry(ms, if ms == 7 { f64::NAN } else { 2.0 }).encode());
        put("b", Topic::Odom, ms, odometry(ms, 3.0).encode());
    }
    put("a", Topic::Pose, 101, vec![0, 1, 0, 0, 5]);
    put("a", Topic::Event, 60, encode_json("event", &event(60, ended(50, 60))).expect("JSON"));
    put("b", Topic::Event, 60, b"{}".to_vec());
    writer.finish().expect("finished");
    let spool = || Spool::new(scratch("unused"));
    let mut gathered =
        gather(std::slice::from_ref(&path), None, Frame::World, spool(), |_| ()).expect("gathered");
    assert_eq!(gathered.origin, Some(ORIGIN));
    assert_eq!(gathered.spool.machines(), [("a".to_owned(), 100), ("b".to_owned(), 99)]);
    let expected = Outage { start: at(50), end: Some(at(60)), cause: GnssState::Degraded.name().to_owned() };
    assert_eq!(gathered.outages.remove("a"), Some(vec![expected]));
    let text = gathered.faults.to_string().replace(&path.display().to_string(), "f");
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 3, "{text}");
    assert!(
        lines[0].starts_with("f: /a/pose: messages that cannot be used: 1, first: message 101: nav_msgs")
    );
    assert!(
        lines[1].starts_with("f: /b/event: messages that cannot be used: 1, first: message 1: event"),
        "{text}"
    );
    assert!(
        lines[2]
            .starts_with("f: /b/pose: messages that cannot be used: 1, first: message 8: the position NaN")
    );
    let odom =
        gather(std::slice::from_ref(&path), Some("b"), Frame::Odom, spool(), |_| ()).expect("gathered");
    assert_eq!(odom.spool.machines(), [("b".to_owned(), 100)]);
    assert_eq!(odom.machines, ["a", "b"]);
    std::fs::remove_file(&path).expect("removed");
}
