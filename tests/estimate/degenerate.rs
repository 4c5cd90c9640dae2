//! Streams that fail: the output stays finite, says what it rests on, and comes back.

use std::collections::BTreeSet;

use holdfast::frames::{Lidar, LidarMap, Pose};
use holdfast::lie::{Se3, So3, Vec3};
use holdfast::sensors::{Arrival, Reading, Sensor};
use holdfast::state::{Estimate, GnssState, Mode};
use holdfast::time::Span;

use crate::degraded::{END_S, Run, at, is_gnss, is_lidar, run, run_changed, within, without};
use crate::fixtures::simulated;

#[test]
fn lost_gnss_is_held_by_lidar_and_taken_back() {
    for machine in 0..2 {
        let run = run(machine, without(is_gnss, 50.0, 70.0));
        let (drift_m, settled_m) = (run.worst_m(50.0, 70.5), run.worst_m(75.0, END_S));
        run.tell(
            "GNSS lost for 20 s",
            &format!("{:.1} cm, after it {:.1} cm", 100.0 * drift_m, 100.0 * settled_m),
        );
        assert_eq!(run.restarts(), 0);
        assert_eq!(run.modes(52.0, 70.0), [Mode::Fallback]);
        assert_eq!(run.modes(72.0, END_S), [Mode::Main]);
        assert!(drift_m < 0.3, "{drift_m}");
        assert!(settled_m < 0.05, "{settled_m}");
    }
}

#[test]
fn lost_lidar_does_no_harm_while_gnss_is_good() {
    for machine in 0..2 {
        let run = run(machine, without(is_lidar, 50.0, 70.0));
        run.tell("lidar lost for 20 s", &format!("at most {:.1} cm off", 100.0 * run.worst_m(40.0, END_S)));
        assert_eq!(run.restarts(), 0);
        assert_eq!(run.modes(10.0, END_S), [Mode::Main]);
        assert!(run.worst_m(10.0, END_S) < 0.05);
    }
}

#[test]
fn imu_alone_says_so_and_is_taken_back() {
    for machine in 0..2 {
        let run = run(machine, without(|arrival| is_gnss(arrival) || is_lidar(arrival), 50.0, 70.0));
        let (drift_m, settled_m) = (run.worst_m(50.0, 70.5), run.worst_m(85.0, END_S));
        run.tell("IMU alone for 20 s", &format!("{drift_m:.2} m, after it {:.1} cm", 100.0 * settled_m));
        assert_eq!(run.restarts(), 0);
        assert_eq!(run.modes(53.0, 70.0), [Mode::ImuOnly]);
        assert_eq!(run.modes(85.0, END_S), [Mode::Main]);
        assert!(drift_m < 20.0, "{drift_m}");
        assert!(settled_m < 0.05, "{settled_m}");
    }
}

/// With the IMU alone, an error of the tilt of a tenth of a degree would be 13 cm after four seconds.
#[test]
fn standing_machine_without_chassis_sensors_holds_its_position() {
    for machine in 0..2 {
        let run = run(machine, |arrival| {
            let lost = match arrival.reading.sensor() {
                Sensor::BaseImu | Sensor::CabinTurn | Sensor::LidarOdometry => true,
                Sensor::GnssLeft | Sensor::GnssRight => within(arrival.reading.stamp(), 5.0, 9.0),
                Sensor::Imu => false,
            };
            (!lost).then_some(Span::default())
        });
        let worst_m = run.worst_m(5.0, 9.0);
        run.tell("standing with the IMU alone for 4 s", &format!("{:.1} cm", 100.0 * worst_m));
        assert!(run.modes(6.5, 9.0).contains(&Mode::ImuOnly));
        assert!(worst_m < 0.02, "{}: {worst_m} m", run.name);
    }
}

fn position_sigma_m(estimate: &Estimate) -> f64 {
    estimate.position_sigma_m().into_iter().fold(0.0, f64::max)
}

fn heading_sigma_deg(estimate: &Estimate) -> f64 {
    estimate.rotation_sigma()[2].to_degrees()
}

/// One stream is lost from 50 s to 70 s: health tells, the covariance is wider than without the loss meanwhile, and
/// as before when the stream is back.
fn loss_is_told_and_covered(
    machine: usize,
    sensor: Sensor,
    also_lost: impl Fn(&Arrival) -> bool + Copy,
    sigma: impl Fn(&Estimate) -> f64 + Copy,
    wider: f64,
) -> Run {
    let whole = run(machine, without(also_lost, 50.0, 70.0));
    let of_sensor = move |arrival: &Arrival| arrival.reading.sensor() == sensor;
    let lossy = run(machine, without(move |arrival| of_sensor(arrival) || also_lost(arrival), 50.0, 70.0));
    let [with, lost] = [&whole, &lossy].map(|run| run.mean(60.0, 70.0, sigma));
    let [with_after, lost_after] = [&whole, &lossy].map(|run| run.mean(85.0, END_S, sigma));
    lossy.tell(
        &format!("{} lost for 20 s", sensor.name()),
        &format!(
            "sigma {lost:.4} for {with:.4}, after it {lost_after:.4} for {with_after:.4}; at most {:.1} cm off, then {:.1} cm",
            100.0 * lossy.worst_m(50.0, 70.5),
            100.0 * lossy.worst_m(75.0, END_S)
        ),
    );
    assert_eq!(lossy.restarts(), 0);
    assert!(lost > wider * with, "{lost} for {with}");
    assert!(lost_after < 1.1 * with_after, "{lost_after} for {with_after}");
    let told = lossy.sensor(65, sensor);
    assert!(told.rate_hz == 0.0 && told.age_s.is_some_and(|age_s| age_s > 14.0), "{told:?}");
    let told = lossy.sensor(80, sensor);
    assert!(told.rate_hz > 1.0 && told.age_s.is_some_and(|age_s| age_s < 0.5), "{told:?}");
    assert!(lossy.worst_m(75.0, END_S) < 0.05);
    lossy
}

#[test]
fn lost_right_antenna_is_told_and_covered() {
    for machine in 0..2 {
        // The chassis stands, and its ties hold most of the heading.
        let run = loss_is_told_and_covered(machine, Sensor::GnssRight, |_| false, heading_sigma_deg, 1.05);
        assert_eq!(run.modes(10.0, END_S), [Mode::Main]);
        assert!(run.worst_m(10.0, END_S) < 0.05);
    }
}

/// The chassis stands for most of it, and its ties hold a millimetre, which lidar does not: the covariance need not
/// widen. It is even less where the nodes of the lidar are not: ties wait for the first node after a second, and what
/// grows since the last tie is most of so small a sigma.
#[test]
fn lost_lidar_is_told_and_the_chassis_holds() {
    for machine in 0..2 {
        let run = loss_is_told_and_covered(machine, Sensor::LidarOdometry, is_gnss, position_sigma_m, 0.8);
        assert_eq!(run.modes(53.0, 70.0), [Mode::ImuOnly]);
        assert_eq!(run.modes(72.0, END_S), [Mode::Main]);
    }
}

#[test]
fn lost_left_antenna_is_told_and_covered() {
    for machine in 0..2 {
        let run = loss_is_told_and_covered(machine, Sensor::GnssLeft, |_| false, position_sigma_m, 1.1);
        assert_eq!(run.modes(52.0, 70.0), [Mode::Fallback]);
        assert_eq!(run.modes(72.0, END_S), [Mode::Main]);
        assert_eq!(run.health[65].gnss, GnssState::Silent);
    }
}

#[test]
fn lost_cabin_turn_is_told_and_covered() {
    for machine in 0..2 {
        let run = loss_is_told_and_covered(machine, Sensor::CabinTurn, is_gnss, position_sigma_m, 1.1);
        // Without it nobody knows where the chassis points.
        let has_chassis = |from_s: f64, to_s: f64| {
            let inside = run.judged.iter().filter(|one| within(one.stamp, from_s, to_s));
            inside.map(|one| one.estimate.base.is_some()).collect::<BTreeSet<bool>>()
        };
        assert_eq!(has_chassis(51.0, 70.0), BTreeSet::from([false]));
        assert_eq!(has_chassis(70.5, END_S), BTreeSet::from([true]));
    }
}

/// With the cabin's IMU alone, no chassis either, the error grows without bound; the covariance must say by how much.
#[test]
fn imu_alone_knows_how_far_off_it_may_be() {
    for machine in 0..2 {
        let is_other = |arrival: &Arrival| !matches!(arrival.reading, Reading::Imu(_));
        let run = run(machine, without(is_other, 50.0, 70.0));
        let sigmas = [52.0, 56.0, 60.0, 65.0, 69.9].map(|second| {
            let at_second = run.judged.iter().find(|one| one.stamp >= at(second)).expect("an estimate");
            (at_second.error_m, position_sigma_m(&at_second.estimate))
        });
        run.tell("IMU alone: error and largest sigma, m", &format!("{sigmas:.2?}"));
        assert!(sigmas.is_sorted_by(|before, after| after.1 > before.1), "{sigmas:?}");
        assert!(sigmas.iter().all(|(error_m, sigma_m)| *error_m < 4.0 * sigma_m), "{sigmas:?}");
        assert!(run.mean(85.0, END_S, position_sigma_m) < 0.02);
    }
}

/// Lidar odometry that begins anew at its origin, in an outage: far from there, and so near that the jump could be
/// motion. Neither may be taken for it.
#[test]
fn lidar_that_begins_anew_in_an_outage_is_not_taken_for_motion() {
    for machine in 0..2 {
        let aside: Pose<Lidar, Lidar> =
            Pose::assume(Se3::new(So3::about(&Vec3::z(), 0.05), Vec3::new(0.3, -0.2, 0.1)));
        for nearby in [false, true] {
            let first_after = simulated("construction")[machine]
                .arrivals()
                .into_iter()
                .find_map(|arrival| match arrival.reading {
                    Reading::LidarOdometry(pose) if pose.stamp >= at(60.0) => Some(pose.lidarmap_from_lidar),
                    _ => None,
                })
                .expect("a lidar pose");
            let run_with = |restarts: bool| {
                run_changed(machine, |arrival| {
                    let mut arrival = *arrival;
                    let stamp = arrival.reading.stamp();
                    if is_gnss(&arrival) && within(stamp, 50.0, 70.0) {
                        return None;
                    }
                    if let Reading::LidarOdometry(pose) = &mut arrival.reading
                        && restarts
                        && stamp >= at(60.0)
                    {
                        let moved: Pose<Lidar, Lidar> = first_after.inverse() * pose.lidarmap_from_lidar;
                        let begin: Pose<LidarMap, Lidar> =
                            if nearby { first_after * aside } else { Pose::assume(Se3::identity()) };
                        pose.lidarmap_from_lidar = begin * moved;
                    }
                    Some(arrival)
                })
            };
            let (whole, restarted) = (run_with(false), run_with(true));
            let [before_m, after_m] = [&whole, &restarted].map(|run| run.worst_m(60.0, 70.0));
            restarted.tell(
                &format!(
                    "lidar begins anew in an outage, {}",
                    if nearby { "0.4 m aside" } else { "at its origin" }
                ),
                &format!("{:.1} cm for {:.1} cm without", 100.0 * after_m, 100.0 * before_m),
            );
            assert_eq!(restarted.sensor(75, Sensor::LidarOdometry).refused, 1);
            assert_eq!(restarted.restarts(), 0);
            assert_eq!(restarted.modes(52.0, 70.0), [Mode::Fallback]);
            assert!(after_m < before_m + 0.05, "{after_m} for {before_m}");
            assert!(restarted.worst_m(75.0, END_S) < 0.05);
        }
    }
}
