//! The fleet with an injected clock.

use super::*;
use crate::lie::{Se3, So3, Vec3};
use crate::state::{GnssState, Mode, OutageReport, SensorHealth};

const BOOT: u64 = 0xb007;

fn at(seconds: f64) -> Stamp {
    Stamp::from_nanos(1_795_410_000_000_000_000) + Span::from_seconds(seconds)
}

fn fleet() -> Fleet {
    Fleet::new(SiteDescription {
        id: "site".to_owned(),
        name: "Gravel pit".to_owned(),
        origin: Geodetic { latitude_deg: 47.48, longitude_deg: 8.5, altitude_m: 475.0 },
        time_zone: "UTC".to_owned(),
        software: "0.0.0".to_owned(),
        tolerance_m: 0.05,
    })
}

fn publication(sequence: u64, boot: u64, sent: Stamp) -> Publication {
    Publication { sequence, boot, stamp: sent, sent }
}

/// `yaw` is counterclockwise from east.
fn sample(stamp: Stamp, yaw_deg: f64) -> PoseSample {
    let rotation = So3::from_yaw_pitch_roll(yaw_deg.to_radians(), 0.02, -0.01);
    PoseSample {
        stamp,
        world_from_imu: Pose::assume(Se3::new(rotation, Vec3::new(10.0, 20.0, 1.5))),
        covariance: Mat6::from_diagonal(&[1e-4, 4e-4, 9e-4, 1e-6, 1e-6, 4e-6].into()),
        speed_mps: 0.25,
    }
}

fn health(mode: Mode, gnss: GnssState) -> Health {
    Health {
        stamp_ns: at(0.0).as_nanos(),
        mode,
        waits_for: (mode == Mode::Initializing).then(|| "two seconds of standstill".to_owned()),
        gnss,
        gnss_inflation: [1.0; 2],
        position_sigma_m: Some(0.024),
        heading_sigma_deg: Some(0.1),
        worst_test_ratio: 0.3,
        worst_test_sensor: None,
        sensors: Vec::new(),
        outage: None,
        updates: 12,
        update_us: 300.0,
        gyro_bias: [0.0; 3],
        accel_bias: [0.0; 3],
    }
}

fn report(health: Health) -> MachineReport {
    MachineReport {
        name: "Number one".to_owned(),
        origin: Geodetic { latitude_deg: 47.48, longitude_deg: 8.5, altitude_m: 475.0 },
        cabin_from_imu: Pose::identity(),
        world_from_odom: None,
        software: "0.1.0".to_owned(),
        estimate_age_s: Some(0.01),
        prediction_p99_us: None,
        health,
    }
}

fn send_pose(fleet: &mut Fleet, sequence: u64, boot: u64, now: Stamp) -> Receipt {
    let receipt = fleet.receive("a", Topic::Pose, &publication(sequence, boot, now), now);
    if receipt == Receipt::Accepted {
        fleet.pose("a", sample(now, 0.0), now);
    }
    receipt
}

fn send_health(fleet: &mut Fleet, sequence: u64, health: Health, now: Stamp) {
    fleet.receive("a", Topic::Health, &publication(sequence, BOOT, now), now);
    fleet.report("a", report(health), now);
}

fn view(fleet: &mut Fleet, now: Stamp) -> MachineView {
    fleet.advance(now);
    fleet.view(now).machines.into_iter().find(|machine| machine.id == "a").expect("machine a was seen")
}

fn presence(fleet: &mut Fleet, now: Stamp) -> Presence {
    view(fleet, now).presence
}

#[test]
fn machine_with_a_token_and_young_poses_is_online_then_stale_then_lost() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    assert_eq!(presence(&mut fleet, at(0.0)), Presence::Stale, "it has said nothing yet");
    send_pose(&mut fleet, 0, BOOT, at(1.0));
    assert_eq!(presence(&mut fleet, at(1.5)), Presence::Online);
    let stale = view(&mut fleet, at(2.75));
    assert_eq!(stale.presence, Presence::Stale);
    assert_eq!(stale.presence_since, UtcTime(at(1.5)), "since the pose became old, not since we looked");
    assert_eq!((stale.state_word.as_str(), stale.severity), ("STALE 0:01", Severity::Bad));
    send_pose(&mut fleet, 1, BOOT, at(3.0));
    assert_eq!(presence(&mut fleet, at(3.0)), Presence::Online);
    fleet.withdraw("a", BOOT, at(3.1));
    let lost = view(&mut fleet, at(15.2));
    assert_eq!((lost.presence, lost.presence_since), (Presence::Lost, UtcTime(at(3.1))));
    assert_eq!((lost.state_word.as_str(), lost.severity), ("OFFLINE 0:12", Severity::Offline));
    let age_s = lost.pose.expect("keeps its last values").age_s;
    assert!((age_s - 12.2).abs() < 1e-6, "{age_s}");
}

#[test]
fn before_the_start_health_decides_and_after_it_the_pose() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    send_health(&mut fleet, 0, health(Mode::Initializing, GnssState::Silent), at(0.0));
    let waiting = view(&mut fleet, at(2.5));
    assert_eq!(waiting.presence, Presence::Online);
    assert_eq!(waiting.state_word, "INITIALIZING: two seconds of standstill");
    assert_eq!(presence(&mut fleet, at(2.6)), Presence::Stale);
    send_health(&mut fleet, 1, health(Mode::Main, GnssState::Fixed), at(3.0));
    send_pose(&mut fleet, 0, BOOT, at(3.0));
    assert_eq!(presence(&mut fleet, at(3.4)), Presence::Online);
    assert_eq!(presence(&mut fleet, at(3.6)), Presence::Stale, "young health does not make up for old poses");
    // Started anew within the same boot: no poses, and that is no fault.
    send_health(&mut fleet, 2, health(Mode::Initializing, GnssState::Silent), at(3.7));
    assert_eq!(presence(&mut fleet, at(5.0)), Presence::Online);
}

#[test]
fn telling_the_same_thing_twice_changes_nothing() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    send_pose(&mut fleet, 0, BOOT, at(0.1));
    let before = view(&mut fleet, at(0.2));
    fleet.announce("a", BOOT, at(0.2));
    assert_eq!(fleet.advance(at(0.2)), 0);
    assert_eq!(view(&mut fleet, at(0.2)).presence_since, before.presence_since);
    fleet.withdraw("a", BOOT, at(0.3));
    fleet.withdraw("a", BOOT, at(0.4));
    fleet.withdraw("unknown", BOOT, at(0.4));
    assert_eq!(view(&mut fleet, at(0.5)).presence_since, UtcTime(at(0.3)));
    assert_eq!(fleet.len(), 1, "a token that goes does not make a machine");
}

#[test]
fn restart_is_a_new_boot_and_the_old_ones_ghost_does_not_matter() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    send_pose(&mut fleet, 500, BOOT, at(0.1));
    send_pose(&mut fleet, 502, BOOT, at(0.2));
    // Killed and started again before the lease of the old link ended.
    fleet.announce("a", 2, at(0.3));
    assert_eq!(view(&mut fleet, at(0.3)).presence, Presence::Stale, "the new boot has said nothing yet");
    assert_eq!(send_pose(&mut fleet, 0, 2, at(0.4)), Receipt::Accepted);
    assert_eq!(send_pose(&mut fleet, 503, BOOT, at(0.45)), Receipt::OldBoot);
    fleet.withdraw("a", BOOT, at(0.5));
    let restarted = view(&mut fleet, at(0.5));
    assert_eq!((restarted.presence, restarted.boot.as_str()), (Presence::Online, "0000000000000002"));
    assert_eq!((restarted.link.received, restarted.link.missed, restarted.link.refused), (3, 1, 1));
}

#[test]
fn link_that_comes_back_brings_back_the_same_boot() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    send_pose(&mut fleet, 0, BOOT, at(0.0));
    fleet.withdraw("a", BOOT, at(1.0));
    fleet.announce("a", BOOT, at(9.0));
    let back = view(&mut fleet, at(9.0));
    assert_eq!((back.presence, back.presence_since), (Presence::Stale, UtcTime(at(9.0))));
    send_pose(&mut fleet, 900, BOOT, at(9.1));
    let back = view(&mut fleet, at(9.1));
    assert_eq!((back.presence, back.link.missed), (Presence::Online, 899));
}

#[test]
fn data_without_a_token_does_not_make_a_machine_online() {
    let mut fleet = fleet();
    send_pose(&mut fleet, 0, BOOT, at(0.0));
    assert_eq!(presence(&mut fleet, at(0.0)), Presence::Lost);
    fleet.announce("a", BOOT, at(0.1));
    assert_eq!(presence(&mut fleet, at(0.1)), Presence::Online);
}

#[test]
fn heading_is_that_of_the_cabin_by_the_compass() {
    // The IMU looks to the left of the cabin and hangs upside down; where it points is not the heading.
    let cabin_from_imu =
        Pose::assume(Se3::new(So3::from_yaw_pitch_roll(1.5, 0.0, 3.1), Vec3::new(0.3, -0.2, 0.2)));
    for (yaw_deg, heading_deg) in [(90.0, 0.0), (0.0, 90.0), (-90.0, 180.0), (180.0, 270.0), (60.0, 30.0)] {
        let mut fleet = fleet();
        let world_from_cabin: Pose<World, Cabin> = Pose::assume(Se3::new(
            So3::from_yaw_pitch_roll(f64::to_radians(yaw_deg), 0.0, 0.0),
            Vec3::new(4.0, 5.0, 6.0),
        ));
        let world_from_imu = world_from_cabin * cabin_from_imu;
        fleet.report(
            "a",
            MachineReport { cabin_from_imu, ..report(health(Mode::Main, GnssState::Fixed)) },
            at(0.0),
        );
        fleet.pose("a", PoseSample { world_from_imu, ..sample(at(0.0), 0.0) }, at(0.0));
        let pose = view(&mut fleet, at(0.0)).pose.expect("has a pose");
        let error = (pose.heading_deg - heading_deg + 180.0).rem_euclid(360.0) - 180.0;
        assert!(error.abs() < 1e-9, "{yaw_deg}: {}", pose.heading_deg);
        assert!((0.0..360.0).contains(&pose.heading_deg), "{}", pose.heading_deg);
        assert!((Vec3::from(pose.cabin_position_m) - Vec3::new(4.0, 5.0, 6.0)).norm() < 1e-12);
        assert!((Vec3::from(pose.position_m) - world_from_imu.translation()).norm() < 1e-12);
    }
}

#[test]
fn sigmas_ellipse_and_coordinates_are_those_of_the_pose() {
    let mut fleet = fleet();
    fleet.pose("a", sample(at(0.0), 0.0), at(0.0));
    let pose = view(&mut fleet, at(0.25)).pose.expect("has a pose");
    assert_eq!(pose.stamp.to_string(), "2026-11-23T05:00:00.000000000Z");
    assert!((pose.age_s - 0.25).abs() < 1e-9);
    for (sigma, wanted) in pose.position_sigma_m.into_iter().zip([0.01, 0.02, 0.03]) {
        assert!((sigma - wanted).abs() < 1e-12);
    }
    assert!((pose.heading_sigma_deg - 0.002_f64.to_degrees()).abs() < 1e-12);
    assert!((pose.ellipse95.semi_major_m - 0.048_955).abs() < 1e-6, "{:?}", pose.ellipse95);
    let origin = SiteFrame::new(Geodetic { latitude_deg: 47.48, longitude_deg: 8.5, altitude_m: 475.0 });
    let geodetic = Geodetic {
        latitude_deg: pose.latitude_deg,
        longitude_deg: pose.longitude_deg,
        altitude_m: pose.altitude_m,
    };
    assert!((origin.to_enu(geodetic) - Vec3::new(10.0, 20.0, 1.5)).norm() < 1e-7);
}

#[test]
fn chassis_is_shown_once_odom_and_world_are_tied() {
    let mut fleet = fleet();
    let odom_from_base = Pose::assume(Se3::new(So3::identity(), Vec3::new(1.0, 0.0, 0.0)));
    let quarter = So3::from_yaw_pitch_roll(90.0_f64.to_radians(), 0.0, 0.0);
    let world_from_odom = Pose::assume(Se3::new(quarter, Vec3::new(5.0, 5.0, 0.0)));
    fleet.pose("a", sample(at(0.0), 0.0), at(0.0));
    fleet.chassis("a", Some(odom_from_base), at(0.0));
    assert_eq!(view(&mut fleet, at(0.0)).pose.expect("pose").chassis_heading_deg, None);
    let described = MachineReport {
        world_from_odom: Some(world_from_odom),
        ..report(health(Mode::Main, GnssState::Fixed))
    };
    fleet.report("a", described, at(0.0));
    let pose = view(&mut fleet, at(0.0)).pose.expect("pose");
    assert!(pose.chassis_heading_deg.expect("known").abs() < 1e-9);
    let position = Vec3::from(pose.chassis_position_m.expect("known"));
    assert!((position - Vec3::new(5.0, 6.0, 0.0)).norm() < 1e-12);
}

#[test]
fn state_word_says_what_holds_the_position_and_for_how_long() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    let mut word = |mut state: Health, sequence: u64| {
        state.stamp_ns = at(42.0).as_nanos();
        send_pose(&mut fleet, sequence, BOOT, at(42.0));
        send_health(&mut fleet, sequence, state, at(42.0));
        let view = view(&mut fleet, at(42.3));
        (view.state_word, view.severity)
    };
    assert_eq!(word(health(Mode::Main, GnssState::Fixed), 0), ("RTK FIXED".to_owned(), Severity::Good));
    assert_eq!(word(health(Mode::Main, GnssState::Frozen), 1), ("FROZEN".to_owned(), Severity::Warning));
    let outage = OutageReport {
        start_stamp_ns: at(0.0).as_nanos(),
        end_stamp_ns: None,
        cause: GnssState::Degraded,
        travelled_m: 3.12,
        jump_m: None,
    };
    let holding = Health { outage: Some(outage.clone()), ..health(Mode::Fallback, GnssState::Degraded) };
    assert_eq!(word(holding, 2), ("HOLDING 0:42, 3.1 m, 2.4 cm".to_owned(), Severity::Warning));
    let imu_only = Health {
        outage: Some(outage.clone()),
        position_sigma_m: Some(1.26),
        ..health(Mode::ImuOnly, GnssState::Silent)
    };
    assert_eq!(word(imu_only, 3), ("IMU ONLY 0:42, 3.1 m, 1.3 m".to_owned(), Severity::Bad));
    let ended = OutageReport { end_stamp_ns: Some(at(40.0).as_nanos()), ..outage };
    let just_lost = Health { outage: Some(ended), ..health(Mode::Fallback, GnssState::Silent) };
    assert_eq!(word(just_lost, 4).0, "HOLDING 2.4 cm");
}

#[test]
fn machine_that_ties_its_world_elsewhere_is_not_to_be_relied_on() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    send_pose(&mut fleet, 0, BOOT, at(0.0));
    let mut elsewhere = report(health(Mode::Main, GnssState::Fixed));
    elsewhere.origin.altitude_m += 12.5;
    fleet.receive("a", Topic::Health, &publication(0, BOOT, at(0.0)), at(0.0));
    fleet.report("a", elsewhere, at(0.0));
    let view = view(&mut fleet, at(0.1));
    assert_eq!(view.state_word, "WRONG ORIGIN: 12.500 m from the site's");
    assert_eq!(view.severity, Severity::Bad);
}

#[test]
fn poses_that_are_no_numbers_are_refused_and_counted() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    send_pose(&mut fleet, 0, BOOT, at(0.0));
    let mut broken = sample(at(0.1), 0.0);
    broken.covariance[(0, 0)] = f64::NAN;
    fleet.pose("a", broken, at(0.1));
    let speed = PoseSample { speed_mps: f64::INFINITY, ..sample(at(0.1), 0.0) };
    fleet.pose("a", speed, at(0.1));
    let view = view(&mut fleet, at(0.2));
    assert_eq!(view.link.refused, 2);
    assert_eq!(view.pose.expect("the good one").stamp, UtcTime(at(0.0)));
}

#[test]
fn made_up_machine_names_do_not_fill_the_memory() {
    let mut fleet = fleet();
    for number in 0..2 * MACHINES_MAX {
        fleet.receive(&format!("m{number}"), Topic::Pose, &publication(0, 1, at(0.0)), at(0.0));
    }
    assert_eq!(fleet.len(), MACHINES_MAX);
    let receipt = fleet.receive("one-more", Topic::Pose, &publication(0, 1, at(0.0)), at(0.0));
    assert_eq!(receipt, Receipt::TooManyMachines);
}

#[test]
fn time_that_steps_back_gives_no_negative_age() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(10.0));
    send_pose(&mut fleet, 0, BOOT, at(10.0));
    let view = view(&mut fleet, at(9.0));
    assert_eq!(view.pose.expect("pose").age_s, 0.0);
    assert_eq!(view.presence, Presence::Online);
}

#[test]
fn slow_publisher_is_not_stale_between_two_poses() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    for second in 0..4 {
        send_pose(&mut fleet, second, BOOT, at(second as f64));
    }
    let between = view(&mut fleet, at(5.9));
    assert_eq!(between.presence, Presence::Online, "it sends one pose a second, and two are missing");
    assert_eq!(between.pose.expect("pose").fresh_s, 3.0);
    assert_eq!(presence(&mut fleet, at(6.1)), Presence::Stale);
    // The next boot is fast: it is judged by its own pace.
    for sample in 0..50 {
        send_pose(&mut fleet, sample, BOOT + 1, at(7.0 + 0.01 * sample as f64));
    }
    assert_eq!(view(&mut fleet, at(7.5)).pose.expect("pose").fresh_s, 0.5);
}

#[test]
fn second_machine_with_the_same_id_is_told_and_shown() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    send_pose(&mut fleet, 0, BOOT, at(0.1));
    fleet.announce("a", BOOT + 1, at(0.2));
    send_pose(&mut fleet, 0, BOOT + 1, at(0.3));
    assert_eq!(send_pose(&mut fleet, 0, BOOT, at(0.4)), Receipt::OldBoot, "it was on its way");
    send_pose(&mut fleet, 1, BOOT + 1, at(1.3));
    assert_eq!(send_pose(&mut fleet, 1, BOOT, at(1.4)), Receipt::Rival);
    assert_eq!(send_pose(&mut fleet, 2, BOOT, at(1.5)), Receipt::OldBoot, "told once");
    let shown = view(&mut fleet, at(1.5));
    assert_eq!((shown.state_word.as_str(), shown.severity), ("TWO MACHINES HAVE THIS ID", Severity::Bad));
    // It is gone: what is still on its way is a straggler.
    fleet.withdraw("a", BOOT, at(1.6));
    assert_eq!(send_pose(&mut fleet, 3, BOOT, at(1.7)), Receipt::OldBoot);
    send_pose(&mut fleet, 2, BOOT + 1, at(5.0));
    assert_ne!(view(&mut fleet, at(5.0)).state_word, "TWO MACHINES HAVE THIS ID");
}

#[test]
fn first_of_two_machines_with_one_id_is_back_when_the_second_has_ended() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    send_pose(&mut fleet, 0, BOOT, at(0.1));
    fleet.announce("a", BOOT + 1, at(0.2));
    send_pose(&mut fleet, 0, BOOT + 1, at(0.3));
    fleet.withdraw("a", BOOT + 1, at(2.0));
    assert_eq!(send_pose(&mut fleet, 20, BOOT, at(2.1)), Receipt::Accepted);
    assert_eq!(presence(&mut fleet, at(2.1)), Presence::Online);
    assert_eq!(send_pose(&mut fleet, 1, BOOT + 1, at(2.2)), Receipt::OldBoot);
}

#[test]
fn observations_say_what_is_the_case_and_nothing_that_nobody_knows() {
    let mut fleet = fleet();
    fleet.announce("a", BOOT, at(0.0));
    let sensor = SensorHealth {
        sensor: Sensor::LidarOdometry,
        rate_hz: 0.0,
        age_s: Some(4.5),
        received: 9,
        refused: 0,
        last_refusal: None,
    };
    let outage = OutageReport {
        start_stamp_ns: at(-30.0).as_nanos(),
        end_stamp_ns: None,
        cause: GnssState::Degraded,
        travelled_m: 3.0,
        jump_m: None,
    };
    let sensors = vec![sensor];
    let state = Health { outage: Some(outage), sensors, ..health(Mode::Fallback, GnssState::Degraded) };
    send_health(&mut fleet, 0, state, at(0.0));
    send_pose(&mut fleet, 0, BOOT, at(0.1));
    let observed = |fleet: &mut Fleet, seconds: f64| {
        fleet.advance(at(seconds));
        let state = SiteState { disk_free_bytes: Some(7_500_000_000), tolerance_m: 0.05 };
        let observations = observations(&fleet.view(at(seconds)), state);
        move |rule: RuleKind| {
            let found = observations.iter().find(|observation| observation.subject.rule == rule);
            found.map(|found| (found.value.map(|value| (value * 1e3).round() / 1e3), found.message.clone()))
        }
    };
    let value = |found: Option<(Option<f64>, String)>| found.expect("watched").0;
    let now = observed(&mut fleet, 0.2);
    assert_eq!(value(now(RuleKind::DiskLow)), Some(7.5));
    assert_eq!(value(now(RuleKind::MachineLost)), Some(0.0));
    let (outage_s, words) = now(RuleKind::OutageLonger).expect("watched");
    assert_eq!((outage_s, words.as_str()), (Some(30.2), "a is without GNSS (degraded) for 30 s"));
    assert_eq!(value(now(RuleKind::SigmaOverTolerance)), Some(0.4), "2 cm of 5");
    assert_eq!(value(now(RuleKind::ClockOff)), Some(0.0));
    assert_eq!(value(now(RuleKind::EstimatorLate)), Some(0.01));
    let (silent_s, words) = now(RuleKind::SensorSilent).expect("watched");
    assert_eq!((silent_s, words.as_str()), (Some(4.5), "a: lidar_odometry is silent for 4.5 s"));

    fleet.withdraw("a", BOOT, at(1.0));
    let later = observed(&mut fleet, 13.0);
    let (lost_s, words) = later(RuleKind::MachineLost).expect("watched");
    assert_eq!((lost_s, words.as_str()), (Some(12.0), "a is not connected"));
    for rule in
        [RuleKind::OutageLonger, RuleKind::SigmaOverTolerance, RuleKind::ClockOff, RuleKind::EstimatorLate]
    {
        assert_eq!(value(later(rule)), None, "{rule:?}");
    }
    assert!(later(RuleKind::SensorSilent).is_none());
}

#[test]
fn last_hour_of_a_machine_that_went_is_over_an_hour_later() {
    let (mut fleet, mut past, mut trails) = (fleet(), Past::default(), Trails::default());
    fleet.announce("a", BOOT, at(0.0));
    for second in 0..4_u32 {
        let now = at(f64::from(second));
        send_health(&mut fleet, u64::from(second), health(Mode::Main, GnssState::Fixed), now);
        send_pose(&mut fleet, u64::from(second), BOOT, now);
        fleet.advance(now);
        let view = fleet.view(now);
        past.observe(&view);
        trails.observe(&view);
    }
    let known = |now| (past.points("a", None, now).len(), trails.points("a", None, 100, now).0.len());
    assert_eq!(known(at(3.0)), (4, 4));
    assert_eq!(known(at(3_601.5)), (2, 2), "what is older than an hour is not told");
    assert_eq!(known(at(90_000.0)), (0, 0));
    let since = Some(at(1.0));
    assert_eq!(past.points("a", since, at(3.0)).len(), 2);
    let (first, more) = trails.points("a", since, 1, at(3.0));
    assert_eq!((first.len(), more), (1, true));
}
