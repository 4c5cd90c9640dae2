//! Outages and the two graphs: who answers when, what a failed trial leaves behind, and how a lidar that was blind
//! in an outage finds its place again.

use holdfast::estimator::{Estimator, split};
use holdfast::lie::{Se3, So3, Vec3};
use holdfast::sensors::{Arrival, GnssFix, Reading, Sensor};
use holdfast::state::{Event, EventKind, Graph};
use holdfast::time::Stamp;

use crate::fixtures::{simulated, true_pose};

/// Ends before the trees of the task itself.
const END_S: f64 = 200.0;
/// Driving, long after the start.
const LOST_S: f64 = 100.0;

struct Run {
    /// Stamp (s) and distance from the truth (m).
    errors: Vec<(f64, f64)>,
    /// Largest sigma of a position, m, at the same stamps.
    sigmas: Vec<f64>,
    updates: u64,
    events: Vec<Event>,
}

impl Run {
    fn worst_m(&self, from_s: f64, to_s: f64) -> f64 {
        let errors = self.errors.iter().filter(|(stamp, _)| (from_s..to_s).contains(stamp));
        let worst = errors.map(|(_, error)| *error).max_by(f64::total_cmp);
        worst.unwrap_or_else(|| panic!("no estimate from {from_s} s to {to_s} s"))
    }

    /// The graphs that answered, one after the other, from `from_s` on.
    fn graphs(&self, from_s: f64) -> Vec<Graph> {
        let changes = self.events.iter().filter(|event| event.stamp_ns as f64 > from_s * 1e9);
        changes
            .filter_map(|event| match &event.what {
                EventKind::GraphChanged { to, .. } => Some(*to),
                _ => None,
            })
            .collect()
    }

    fn refusals(&self, of: Sensor, because: &str) -> u64 {
        self.events
            .iter()
            .filter_map(|event| match &event.what {
                EventKind::Refused { sensor, reason, count } if *sensor == of && reason.contains(because) => {
                    Some(*count)
                }
                _ => None,
            })
            .sum()
    }
}

/// The first machine of the navigation task, through `change`, which may drop a reading.
fn run(change: impl Fn(f64, Reading) -> Option<Reading>) -> Run {
    let log = &simulated("navigation")[0];
    let truth = log.truth();
    let mut estimator = Estimator::new(log.options());
    let mut run = Run { errors: Vec::new(), sigmas: Vec::new(), updates: 0, events: Vec::new() };
    let end = Stamp::from_seconds(END_S);
    for arrival in log.arrivals().iter().take_while(|arrival| arrival.arrival < end) {
        let second = arrival.reading.stamp().as_seconds();
        let Some(reading) = change(second, arrival.reading) else { continue };
        let estimate = estimator.push(&Arrival { reading, ..*arrival });
        run.events.extend(estimator.take_events());
        let Some(estimate) = estimate else { continue };
        assert!(estimate.state.is_finite());
        let there = true_pose(&truth, estimate.stamp).expect("truth").pose.translation;
        run.errors.push((second, (estimate.state.position - there).norm()));
        run.sigmas.push(estimate.position_sigma_m().into_iter().fold(0.0, f64::max));
    }
    run.updates = estimator.health().updates;
    run
}

fn is_gnss(reading: &Reading) -> bool {
    matches!(reading, Reading::GnssLeft(_) | Reading::GnssRight(_))
}

/// The fix, some way further up; in the site's first metres a degree of latitude is far from a height.
fn raised(fix: GnssFix, by_m: f64) -> GnssFix {
    let mut fix = fix;
    fix.position.altitude_m += by_m;
    fix
}

#[test]
fn graphs_change_in_the_order_of_their_diagram() {
    let run = run(|second, reading| {
        let lost = is_gnss(&reading) && (LOST_S..LOST_S + 20.0).contains(&second);
        (!lost).then_some(reading)
    });
    assert_eq!(run.graphs(LOST_S), [Graph::Fallback, Graph::Trial, Graph::Main]);
    assert!(run.worst_m(LOST_S, LOST_S + 20.0) < 0.25, "{}", run.worst_m(LOST_S, LOST_S + 20.0));
    assert!(run.worst_m(LOST_S + 21.5, END_S) < 0.03, "{}", run.worst_m(LOST_S + 21.5, END_S));
}

#[test]
fn fixes_that_turn_bad_on_trial_leave_no_trace() {
    // Five good fixes, then multipath, in the middle of an outage.
    let glimpse = LOST_S + 10.0..LOST_S + 10.28;
    let multipath = LOST_S + 10.28..LOST_S + 12.0;
    let lost = LOST_S..LOST_S + 20.0;
    let with = run(|second, reading| match reading {
        reading if is_gnss(&reading) && glimpse.contains(&second) => Some(reading),
        Reading::GnssLeft(fix) if multipath.contains(&second) => Some(Reading::GnssLeft(raised(fix, 0.8))),
        Reading::GnssRight(fix) if multipath.contains(&second) => Some(Reading::GnssRight(raised(fix, 0.8))),
        reading => (!(is_gnss(&reading) && lost.contains(&second))).then_some(reading),
    });
    let graphs = with.graphs(LOST_S);
    let expected = [Graph::Fallback, Graph::Trial, Graph::Fallback, Graph::Trial, Graph::Main];
    assert_eq!(graphs, expected);
    assert!(with.refusals(Sensor::GnssLeft, "from where it is expected") >= 30);
    let without = run(|second, reading| (!(is_gnss(&reading) && lost.contains(&second))).then_some(reading));
    let pairs = with.errors.iter().zip(&without.errors).filter(|((second, _), _)| lost.contains(second));
    let furthest = pairs.map(|((_, a), (_, b))| (a - b).abs()).max_by(f64::total_cmp).expect("estimates");
    assert!(furthest < 1e-3, "a trial that failed moves the estimate by {furthest} m");
}

#[test]
fn lidar_that_was_blind_in_an_outage_finds_its_place_in_its_map() {
    let blind = LOST_S + 5.0..LOST_S + 15.0;
    let run_with = |map: Se3, back: bool| {
        run(|second, reading| match reading {
            Reading::LidarOdometry(_) if blind.contains(&second) => None,
            Reading::LidarOdometry(_) if second >= blind.end && !back => None,
            Reading::LidarOdometry(mut pose) if second >= blind.end => {
                let moved = map * *pose.lidarmap_from_lidar.motion();
                pose.lidarmap_from_lidar = holdfast::frames::Pose::assume(moved);
                Some(Reading::LidarOdometry(pose))
            }
            reading => (!(is_gnss(&reading) && second >= LOST_S)).then_some(reading),
        })
    };
    let after = (blind.end + 1.0, blind.end + 5.0);
    let alone = run_with(Se3::identity(), false).worst_m(blind.end - 0.1, blind.end);
    let same_map = run_with(Se3::identity(), true);
    let found = same_map.worst_m(after.0, after.1);
    assert!(found < 0.25, "with the map it is {found} m off, {alone} m before");
    assert!(found < 0.7 * alone, "with the map it is {found} m off, {alone} m before");
    assert_eq!(same_map.refusals(Sensor::LidarOdometry, ""), 0);
    // A lidar that has begun a new map meanwhile is refused once, and says only how it moves from there on.
    let elsewhere = Se3::new(So3::about(&Vec3::z(), 1.0), Vec3::new(20.0, -5.0, 1.0));
    let new_map = run_with(elsewhere, true);
    assert_eq!(new_map.refusals(Sensor::LidarOdometry, "new map"), 1);
    let lost = new_map.worst_m(after.0, after.1);
    assert!(
        lost < alone + 0.8,
        "a new map brings nothing back, and takes nothing: {lost} m, {alone} m before"
    );
}

#[test]
fn lidar_that_is_lost_with_the_fixes_comes_back_as_if_it_had_never_gone() {
    let blind = LOST_S..LOST_S + 10.0;
    let run_with = |goes: bool| {
        run(|second, reading| match reading {
            Reading::LidarOdometry(_) if goes && blind.contains(&second) => None,
            reading => (!(is_gnss(&reading) && second >= LOST_S)).then_some(reading),
        })
    };
    let (gone, seeing) = (run_with(true), run_with(false));
    let at = |run: &Run, second: f64| {
        let index = run.errors.iter().position(|(stamp, _)| *stamp >= second).expect("an estimate");
        (run.errors[index].1, run.sigmas[index])
    };
    let (alone, _) = at(&gone, blind.end - 0.1);
    let ((back, sigma), (seen, sigma_seen)) = (at(&gone, blind.end + 2.0), at(&seeing, blind.end + 2.0));
    assert!((back - seen).abs() < 0.03, "{back} m off, {seen} m with lidar all the time, {alone} m before");
    assert!(
        (0.97..1.05).contains(&(sigma / sigma_seen)),
        "sigma {sigma} m, {sigma_seen} m with lidar all the time"
    );
}

/// Longer than any window is held.
#[test]
fn lidar_that_was_blind_for_minutes_brings_the_position_back_no_surer_than_it_was() {
    let (lost, blind) = (40.0, 45.0..190.0);
    let run_with = |back: bool| {
        run(|second, reading| match reading {
            Reading::LidarOdometry(_) if second >= blind.start && !(back && second >= blind.end) => None,
            reading => (!(is_gnss(&reading) && second >= lost)).then_some(reading),
        })
    };
    let (returned, gone) = (run_with(true), run_with(false));
    let at = |run: &Run, second: f64| {
        let index = run.errors.iter().position(|(stamp, _)| *stamp >= second).expect("an estimate");
        (run.errors[index].1, run.sigmas[index])
    };
    let (_, before) = at(&returned, blind.start - 0.1);
    let (alone, _) = at(&gone, END_S - 1.0);
    let (error, sigma) = at(&returned, END_S - 1.0);
    assert!(error < 0.05 * alone, "{error} m off, {alone} m without the lidar's return");
    assert!(error < 3.5 * sigma, "{error} m off, sigma {sigma} m");
    assert!(sigma > before, "sigma {sigma} m, {before} m when the lidar fell blind");
}

#[test]
fn corrected_velocity_reaches_odom_at_a_bounded_rate() {
    let log = &simulated("navigation")[0];
    let (mut predictor, mut updater) = split(log.options());
    let mut newest = None;
    // Relative speed of odom against the solution's, m/s, at each sample after the correction.
    let mut differences = Vec::new();
    let mut corrected = None;
    for arrival in log.arrivals().iter().take_while(|arrival| arrival.arrival < Stamp::from_seconds(61.0)) {
        let estimate = predictor.push(arrival);
        if corrected.is_none()
            && let Some(solution) = updater.push(arrival)
        {
            predictor.adopt(&solution);
            newest = Some(solution);
        }
        let Some(estimate) = estimate else { continue };
        if let Some(before) =
            corrected.replace(estimate).filter(|_| arrival.arrival >= Stamp::from_seconds(60.0))
        {
            let moved = (before.odom_from_imu.inverse() * estimate.odom_from_imu).translation().norm();
            let speed = moved / estimate.stamp.seconds_since(before.stamp);
            differences.push(speed - 0.5 * (before.state.velocity + estimate.state.velocity).norm());
        } else if arrival.arrival < Stamp::from_seconds(60.0) {
            corrected = None;
        } else if let Some(solution) = &newest {
            let faster = solution.state.velocity.normalize() * 0.2;
            let mut wrong = (**solution).clone();
            wrong.state.velocity += faster;
            predictor.adopt(&wrong);
        }
    }
    // The first one compares with the speed before the correction.
    differences.remove(0);
    assert!(differences.len() > 60);
    assert!((differences[0] + 0.2).abs() < 0.02, "at first odom goes on as it went: {}", differences[0]);
    let steps = differences.windows(2).map(|pair| (pair[1] - pair[0]).abs());
    let largest = steps.max_by(f64::total_cmp).expect("steps");
    assert!(largest < 0.0065, "odom's speed steps by {largest} m/s");
    assert!(differences[55].abs() < 0.01, "half a second later it follows: {}", differences[55]);
}

#[test]
fn lidar_that_is_blind_again_and_again_makes_nobody_surer_than_one_that_sees() {
    // Late in an outage, when the estimate shares the anchor's error: counted twice, each return would take the sigma
    // down by a third.
    let lost = LOST_S - 50.0;
    let blind = |second: f64| second > LOST_S && (second - LOST_S) % 6.0 < 4.0;
    let run_with = |blinks: bool| {
        run(|second, reading| match reading {
            Reading::LidarOdometry(_) if blinks && blind(second) => None,
            reading => (!(is_gnss(&reading) && second >= lost)).then_some(reading),
        })
    };
    let (blinking, seeing) = (run_with(true), run_with(false));
    let at = |run: &Run, second: f64| {
        let index = run.errors.iter().position(|(stamp, _)| *stamp >= second).expect("an estimate");
        (run.errors[index].1, run.sigmas[index])
    };
    for gap in 0..8 {
        let second = LOST_S + 6.0 * f64::from(gap) + 5.5;
        let ((error, sigma), (_, seen)) = (at(&blinking, second), at(&seeing, second));
        assert!(sigma > 0.97 * seen, "after gap {gap}: {sigma} m, {seen} m with lidar all the time");
        assert!(error < 3.5 * sigma, "after gap {gap}: {error} m off, sigma {sigma} m");
    }
}

#[test]
fn lidar_that_diverges_in_an_outage_does_not_stop_the_updates() {
    let diverges = LOST_S + 3.0..LOST_S + 20.0;
    let run_with = |wild: bool| {
        let steps = std::cell::Cell::new(0.0);
        run(|second, reading| match reading {
            Reading::LidarOdometry(mut pose) if wild && diverges.contains(&second) => {
                // Each pose two metres further aside than the one before.
                steps.set(steps.get() + 2.0);
                let aside = Se3::new(So3::identity(), Vec3::new(0.0, steps.get(), 0.0));
                let moved = aside * *pose.lidarmap_from_lidar.motion();
                pose.lidarmap_from_lidar = holdfast::frames::Pose::assume(moved);
                Some(Reading::LidarOdometry(pose))
            }
            Reading::LidarOdometry(_) if diverges.contains(&second) => None,
            reading => {
                let lost = (LOST_S..LOST_S + 20.0).contains(&second);
                (!(is_gnss(&reading) && lost)).then_some(reading)
            }
        })
    };
    let (wild, none) = (run_with(true), run_with(false));
    assert!(wild.refusals(Sensor::LidarOdometry, "from the predicted one") > 60);
    assert!(wild.updates + 20 > none.updates, "{} updates, {} without lidar", wild.updates, none.updates);
    let end = diverges.end - 0.1;
    let sigma_at_end = |run: &Run| {
        let index = run.errors.iter().position(|(stamp, _)| *stamp >= end).expect("an estimate");
        run.sigmas[index]
    };
    let (with, without) = (sigma_at_end(&wild), sigma_at_end(&none));
    assert!((with / without - 1.0).abs() < 0.05, "sigma {with} m, {without} m without lidar");
}
