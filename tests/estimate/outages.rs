//! Outages and the two graphs: who answers when, what a failed trial leaves behind, and how a lidar that was blind
//! in an outage finds its place again.

use holdfast::estimator::Estimator;
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
    let mut run = Run { errors: Vec::new(), events: Vec::new() };
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
    }
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
