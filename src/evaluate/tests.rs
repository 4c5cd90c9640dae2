//! Behaviour of the comparison.

use super::*;
use crate::lie::So3;

/// A bent way of 10 s at 10 Hz that turns as it goes.
fn way() -> Vec<StampedPose> {
    (0..=100)
        .map(|index| {
            let time_s = f64::from(index) * 0.1;
            let position = Vec3::new(3.0 * time_s, (0.5 * time_s).sin() * 4.0, 0.3 * (0.8 * time_s).cos());
            let rotation = So3::from_yaw_pitch_roll(0.4 * time_s, 0.05 * time_s.sin(), 3.1);
            StampedPose { stamp: Stamp::from_seconds(time_s), pose: Se3::new(rotation, position) }
        })
        .collect()
}

fn moved(way: &[StampedPose], motion: &Se3) -> Vec<StampedPose> {
    way.iter().map(|posed| StampedPose { pose: *motion * posed.pose, ..*posed }).collect()
}

#[test]
fn the_truth_has_no_error() {
    let report = compare(&way(), &way(), &Options::default()).expect("comparable");
    assert_eq!(report.compared, 101);
    assert!(report.errors.position_m.max < 1e-12 && report.errors.heading_deg.max < 1e-9);
}

#[test]
fn a_shift_and_a_turn_are_measured_apart() {
    let truth = way();
    let estimate: Vec<StampedPose> = truth
        .iter()
        .map(|posed| {
            let turned = So3::exp(&Vec3::new(0.0, 0.0, 2.0_f64.to_radians())) * posed.pose.rotation;
            let shifted = posed.pose.translation + Vec3::new(0.03, -0.04, 0.12);
            StampedPose { pose: Se3::new(turned, shifted), ..*posed }
        })
        .collect();
    let errors = compare(&truth, &estimate, &Options::default()).expect("comparable").errors;
    for (statistics, expected) in [
        (errors.position_m, 0.13),
        (errors.horizontal_m, 0.05),
        (errors.vertical_m, 0.12),
        (errors.heading_deg, 2.0),
        (errors.tilt_deg, 0.0),
    ] {
        for value in [statistics.rmse, statistics.mean, statistics.median, statistics.p95, statistics.max] {
            assert!((value - expected).abs() < 1e-9, "{errors:?}");
        }
    }
}

#[test]
fn truth_is_interpolated_between_its_poses_but_not_over_gaps() {
    let truth = vec![
        StampedPose { stamp: Stamp::from_seconds(0.0), pose: Se3::identity() },
        StampedPose {
            stamp: Stamp::from_seconds(1.0),
            pose: Se3::new(So3::exp(&(Vec3::z() * 0.8)), Vec3::x() * 2.0),
        },
        StampedPose { stamp: Stamp::from_seconds(9.0), pose: Se3::identity() },
    ];
    let quarter = StampedPose {
        stamp: Stamp::from_seconds(0.25),
        pose: Se3::new(So3::exp(&(Vec3::z() * 0.2)), Vec3::x() * 0.5),
    };
    let in_gap = StampedPose { stamp: Stamp::from_seconds(5.0), pose: Se3::identity() };
    let after = StampedPose { stamp: Stamp::from_seconds(9.5), pose: Se3::identity() };
    let report = compare(&truth, &[quarter, in_gap, after], &Options::default()).expect("comparable");
    assert_eq!((report.compared, report.without_truth), (1, 2));
    assert!(report.errors.position_m.max < 1e-12 && report.errors.heading_deg.max < 1e-9);
}

#[test]
fn alignment_takes_out_the_frame_and_nothing_else() {
    let truth = way();
    let full = Se3::new(So3::from_yaw_pitch_roll(1.2, 0.3, -0.2), Vec3::new(5.0, -7.0, 2.0));
    let level = Se3::new(So3::from_yaw_pitch_roll(-2.5, 0.0, 0.0), Vec3::new(5.0, -7.0, 2.0));
    let rmse = |motion: &Se3, alignment| {
        let options = Options { alignment, ..Options::default() };
        let errors = compare(&truth, &moved(&truth, motion), &options).expect("comparable").errors;
        errors.position_m.rmse + errors.heading_deg.rmse
    };
    assert!(rmse(&full, Alignment::Se3) < 1e-9);
    assert!(rmse(&level, Alignment::Yaw) < 1e-9);
    assert!(rmse(&full, Alignment::Yaw) > 0.1, "a tilt must stay");
    assert!(rmse(&level, Alignment::None) > 1.0);
}

#[test]
fn scale_and_origin_are_taken_out_where_asked() {
    let truth = way();
    let motion = Se3::new(So3::from_yaw_pitch_roll(1.2, 0.3, -0.2), Vec3::new(5.0, -7.0, 2.0));
    let mut estimate = moved(&truth, &motion);
    let rmse = |estimate: &[StampedPose], alignment| {
        let options = Options { alignment, ..Options::default() };
        compare(&truth, estimate, &options).expect("comparable").errors.position_m.rmse
    };
    assert!(rmse(&estimate, Alignment::Origin) < 1e-9);
    estimate.iter_mut().for_each(|posed| posed.pose.translation *= 1.1);
    assert!(rmse(&estimate, Alignment::Sim3) < 1e-9);
    assert!(rmse(&estimate, Alignment::Se3) > 0.1, "the scale must stay");
    let options = Options { alignment: Alignment::Sim3, ..Options::default() };
    let scale = compare(&truth, &estimate, &options).expect("comparable").aligned_by_scale;
    assert!((scale * 1.1 - 1.0).abs() < 1e-9, "{scale}");
    let mut scaled = truth.clone();
    scaled.iter_mut().for_each(|posed| posed.pose.translation *= 0.8);
    assert!(rmse(&scaled, Alignment::Scale) < 1e-9);
}

#[test]
fn a_machine_that_stood_cannot_be_aligned() {
    let stood: Vec<StampedPose> =
        way().into_iter().map(|posed| StampedPose { pose: Se3::identity(), ..posed }).collect();
    let options = Options { alignment: Alignment::Se3, ..Options::default() };
    assert_eq!(compare(&stood, &stood, &options), Err(EvaluateError::NoAlignment));
    assert!(compare(&stood, &stood, &Options::default()).is_ok());
}

#[test]
fn errors_are_told_for_each_interval_and_condition() {
    let truth = way();
    let (good, bad) = ("good".to_owned(), "blocked".to_owned());
    let interval = |start_s, end_s, condition: &String| Interval {
        start: Stamp::from_seconds(start_s),
        end: Stamp::from_seconds(end_s),
        condition: condition.clone(),
    };
    let intervals = vec![interval(0.0, 3.0, &good), interval(3.0, 5.0, &bad), interval(5.0, 11.0, &good)];
    let estimate: Vec<StampedPose> = truth
        .iter()
        .map(|posed| {
            let off = if intervals[1].holds(posed.stamp) { 0.5 } else { 0.01 };
            StampedPose {
                pose: Se3::new(posed.pose.rotation, posed.pose.translation + Vec3::y() * off),
                ..*posed
            }
        })
        .collect();
    let options = Options { intervals, ..Options::default() };
    let report = compare(&truth, &estimate, &options).expect("comparable");
    let counts: Vec<usize> = report.intervals.iter().map(|one| one.errors.poses).collect();
    assert_eq!(counts, [30, 20, 51]);
    assert_eq!(report.conditions.len(), 2);
    assert_eq!(report.conditions[1].condition, "good");
    assert_eq!(report.conditions[1].errors.poses, 81);
    assert!((report.conditions[0].errors.position_m.rmse - 0.5).abs() < 1e-12);
    assert!((report.conditions[1].errors.position_m.max - 0.01).abs() < 1e-12);

    let only = Options { only: Some(bad), ..options };
    let report = compare(&truth, &estimate, &only).expect("comparable");
    assert_eq!((report.compared, report.outside_intervals), (20, 81));
    let text = serde_json::to_string(&report).expect("serializable");
    assert!(text.contains("\"rmse\":0.5"), "{text}");
}

#[test]
fn what_cannot_be_compared_is_said() {
    let late: Vec<StampedPose> = way()
        .iter()
        .map(|posed| StampedPose {
            stamp: Stamp::from_nanos(posed.stamp.as_nanos() + 60_000_000_000),
            ..*posed
        })
        .collect();
    let message = compare(&way(), &late, &Options::default()).expect_err("apart").to_string();
    assert!(message.contains("from 0.000000000 s to 10.000000000 s"), "{message}");
    assert_eq!(compare(&way(), &[], &Options::default()), Err(EvaluateError::Empty("estimate")));
}

#[test]
fn quantiles_lie_between_ranks() {
    let statistics = Statistics::of(vec![4.0, 0.0, 1.0, 3.0]).expect("some");
    assert_eq!((statistics.median, statistics.mean, statistics.max), (2.0, 2.0, 4.0));
    assert!((statistics.p95 - 3.85).abs() < 1e-12 && (statistics.rmse - 6.5_f64.sqrt()).abs() < 1e-12);
    assert_eq!(Statistics::of(Vec::new()), None);
}
