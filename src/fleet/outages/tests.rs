//! Outages with an injected clock.

use super::*;
use crate::fleet::PoseSample;
use crate::frames::Pose;
use crate::lie::{Mat6, Se3, So3, Vec3};
use crate::state::{Health, Mode, OutageReport};
use crate::time::Span;

const BOOT: u64 = 7;
/// The machine's clock is behind by so much.
const BEHIND: Span = Span::from_millis(5_000);

fn at(seconds: f64) -> Stamp {
    Stamp::from_nanos(1_795_410_000_000_000_000) + Span::from_seconds(seconds)
}

fn machine_ns(seconds: f64) -> i64 {
    (at(seconds) - BEHIND).as_nanos()
}

fn health(seconds: f64, mode: Mode, gnss: GnssState, outage: Option<OutageReport>) -> Health {
    Health {
        stamp_ns: machine_ns(seconds),
        mode,
        waits_for: None,
        gnss,
        gnss_inflation: [1.0; 2],
        position_sigma_m: Some(0.02),
        heading_sigma_deg: None,
        worst_test_ratio: 0.0,
        worst_test_sensor: None,
        sensors: Vec::new(),
        outage,
        updates: 1,
        update_us: 0.0,
        gyro_bias: [0.0; 3],
        accel_bias: [0.0; 3],
    }
}

fn outage(start_s: f64, end_s: Option<f64>, travelled_m: f64) -> OutageReport {
    OutageReport {
        start_stamp_ns: machine_ns(start_s),
        end_stamp_ns: end_s.map(machine_ns),
        cause: GnssState::Degraded,
        travelled_m,
        jump_m: end_s.map(|_| 0.031),
    }
}

/// A machine that moves east at half a metre a second, and the monitor that watches it.
struct Yard {
    monitor: Monitor,
    changes: Vec<Change>,
}

impl Yard {
    fn new() -> Self {
        Self { monitor: Monitor::new("a", None, at(0.0)), changes: Vec::new() }
    }

    fn says(&mut self, seconds: f64, health: &Health, boot: u64) {
        self.monitor.report(health, Some(boot), at(seconds));
        self.passes(seconds, true);
    }

    fn passes(&mut self, seconds: f64, linked: bool) {
        self.monitor.advance(linked, at(seconds));
        self.changes.extend(self.monitor.take_changes());
    }

    fn is_at(&mut self, seconds: f64, sigma_m: f64) {
        let position = Vec3::new(0.5 * seconds, 3.0, 1.0);
        let variance = sigma_m * sigma_m;
        let sample = PoseSample {
            stamp: at(seconds) - BEHIND,
            world_from_imu: Pose::assume(Se3::new(So3::identity(), position)),
            covariance: Mat6::from_diagonal(&[0.25 * variance, variance, 1.0, 0.0, 0.0, 0.0].into()),
            speed_mps: 0.5,
        };
        self.monitor.pose(&sample, at(seconds));
    }

    /// Good fixes and poses, ten a second.
    fn works(&mut self, from: i32, to: i32) {
        for tenth in from * 10..to * 10 {
            let seconds = 0.1 * f64::from(tenth);
            self.is_at(seconds, 0.01);
            if tenth % 10 == 0 {
                self.says(seconds, &health(seconds, Mode::Main, GnssState::Fixed, None), BOOT);
            }
        }
    }

    /// Without fixes since `start`: the variance grows by 2e-5 m² a second.
    fn holds(&mut self, start: i32, from: i32, to: i32) {
        for tenth in from * 10..to * 10 {
            let seconds = 0.1 * f64::from(tenth);
            let outage_s = seconds - f64::from(start);
            self.is_at(seconds, (1e-4 + 2e-5 * outage_s).sqrt());
            if tenth % 10 == 0 {
                let told = outage(f64::from(start), None, 0.5 * outage_s);
                let said = health(seconds, Mode::Fallback, GnssState::Degraded, Some(told));
                self.says(seconds, &said, BOOT);
            } else {
                self.passes(seconds, true);
            }
        }
    }

    fn state(&self, seconds: f64) -> FixState {
        self.monitor.view(0.05, at(seconds)).state
    }

    fn ended(&self) -> Vec<&Outage> {
        self.changes.iter().map(|change| &change.outage).filter(|outage| outage.end.is_some()).collect()
    }
}

#[test]
fn outage_has_start_end_cause_way_sigma_jump_place_and_track() {
    let mut yard = Yard::new();
    yard.works(0, 10);
    assert_eq!(yard.state(10.0), FixState::Fixed);
    yard.holds(9, 10, 40);
    let view = yard.monitor.view(0.05, at(40.0));
    assert_eq!((view.state, view.mode), (FixState::Degraded, Some(Mode::Fallback)));
    let current = view.outage.expect("goes on");
    assert!((current.duration_s - 31.0).abs() < 1e-6, "by the site's clock: {}", current.duration_s);
    let budget = current.budget.expect("known");
    // 0.0025 m² is reached 120 s after the start, at half a metre a second.
    assert!((budget.time_s.expect("grows") - 89.1).abs() < 0.5, "{budget:?}");
    assert!((budget.distance_m.expect("grows") - 45.0).abs() < 1.0, "{budget:?}");

    let told = outage(9.0, Some(40.2), 15.6);
    yard.says(40.5, &health(40.5, Mode::Main, GnssState::Fixed, Some(told.clone())), BOOT);
    assert!(yard.monitor.view(0.05, at(40.5)).outage.is_none());
    let ended = yard.ended();
    assert_eq!(ended.len(), 1);
    let outage = ended[0];
    assert_eq!((outage.cause, outage.ended_by), (FixState::Degraded, Some(Ending::Recovered)));
    assert_eq!(
        (outage.start, outage.end),
        (at(9.0), Some(at(40.2))),
        "the machine's stamps on the site's clock"
    );
    assert_eq!((outage.travelled_m, outage.jump_m), (Some(15.6), Some(0.031)));
    assert!((outage.sigma_max_m.expect("known") - 0.0268).abs() < 1e-3, "{:?}", outage.sigma_max_m);
    let place = outage.place_m.expect("known");
    assert!((place[0] - 4.95).abs() < 0.06, "where it began: {place:?}");
    assert!(outage.sigma.samples().len() > 50 && outage.track.samples().len() > 30);
    let last = outage.track.samples().last().expect("some").position_m;
    assert!((last[0] - 19.9).abs() < 0.5, "{last:?}");
    // It goes on telling the outage that is over.
    yard.says(41.5, &health(41.5, Mode::Main, GnssState::Fixed, Some(told)), BOOT);
    assert_eq!(yard.ended().len(), 1);
}

#[test]
fn float_is_what_the_receiver_reports_while_the_machine_uses_it() {
    let mut yard = Yard::new();
    yard.works(0, 2);
    yard.monitor.fix(0.012, at(2.0));
    yard.passes(2.0, true);
    assert_eq!(yard.state(2.0), FixState::Fixed);
    yard.monitor.fix(0.12, at(2.1));
    yard.passes(2.1, true);
    assert_eq!(yard.state(2.1), FixState::Float);
    yard.passes(4.2, true);
    assert_eq!(yard.state(4.2), FixState::Fixed, "what was reported is old");
    yard.monitor.fix(0.12, at(4.3));
    yard.says(4.3, &health(4.3, Mode::Fallback, GnssState::Degraded, Some(outage(4.0, None, 0.0))), BOOT);
    assert_eq!(yard.state(4.3), FixState::Degraded, "the machine knows better");
    for gnss in [GnssState::Frozen, GnssState::Jumping, GnssState::Silent, GnssState::Recovering] {
        yard.says(5.0, &health(5.0, Mode::Fallback, gnss, Some(outage(4.0, None, 0.0))), BOOT);
        assert_eq!(yard.state(5.0), FixState::from(gnss));
    }
}

#[test]
fn lost_link_is_an_outage_of_its_own_that_ends_with_the_link() {
    let mut yard = Yard::new();
    yard.works(0, 5);
    yard.passes(8.0, false);
    assert_eq!(yard.state(8.0), FixState::LinkLost);
    let current = yard.monitor.view(0.05, at(8.0)).outage.expect("goes on");
    assert_eq!((current.cause, current.start.0), (FixState::LinkLost, at(4.9)), "since it was last heard");
    assert_eq!((current.travelled_m, current.budget), (None, None), "nobody knows");
    yard.says(30.0, &health(30.0, Mode::Main, GnssState::Fixed, None), BOOT);
    let outage = yard.ended()[0];
    assert_eq!((outage.end, outage.ended_by), (Some(at(30.0)), Some(Ending::LinkBack)));
    assert_eq!(yard.state(30.0), FixState::Fixed);
}

#[test]
fn outage_goes_on_through_a_lost_link_and_ends_when_the_machine_says_it_did() {
    let mut yard = Yard::new();
    yard.works(0, 5);
    yard.holds(4, 5, 10);
    yard.passes(20.0, false);
    assert_eq!(yard.state(20.0), FixState::LinkLost);
    assert_eq!(yard.monitor.view(0.05, at(20.0)).outage.expect("goes on").cause, FixState::Degraded);
    let told = outage(4.0, Some(15.0), 5.5);
    yard.says(60.0, &health(60.0, Mode::Main, GnssState::Fixed, Some(told)), BOOT);
    let ended = yard.ended();
    assert_eq!((ended.len(), ended[0].end), (1, Some(at(15.0))));
}

#[test]
fn outage_during_a_lost_link_is_told_late() {
    let mut yard = Yard::new();
    yard.works(0, 5);
    yard.passes(8.0, false);
    let told = outage(9.0, Some(15.0), 2.5);
    yard.says(20.0, &health(20.0, Mode::Main, GnssState::Fixed, Some(told.clone())), BOOT);
    let late: Vec<_> = yard.changes.iter().filter(|change| change.told_late).collect();
    assert_eq!(late.len(), 1);
    assert_eq!((late[0].outage.start, late[0].outage.end), (at(9.0), Some(at(15.0))));
    yard.says(21.0, &health(21.0, Mode::Main, GnssState::Fixed, Some(told)), BOOT);
    assert_eq!(yard.changes.iter().filter(|change| change.told_late).count(), 1, "told once");
}

#[test]
fn restart_and_an_unheard_end_close_the_outage_where_it_was_last_heard() {
    let mut yard = Yard::new();
    yard.works(0, 5);
    yard.holds(4, 5, 10);
    yard.says(14.0, &health(14.0, Mode::Initializing, GnssState::Silent, None), BOOT + 1);
    let ended = yard.ended();
    assert_eq!((ended[0].ended_by, ended[0].end), (Some(Ending::Restarted), Some(at(9.9))));

    let mut yard = Yard::new();
    yard.works(0, 5);
    yard.holds(4, 5, 10);
    let next = outage(18.0, None, 1.0);
    yard.says(20.0, &health(20.0, Mode::Fallback, GnssState::Degraded, Some(next)), BOOT);
    assert_eq!((yard.ended()[0].ended_by, yard.ended()[0].end), (Some(Ending::Unheard), Some(at(9.9))));
    let current = yard.monitor.view(0.05, at(20.0)).outage.expect("the next one");
    assert_eq!(current.start.0, at(18.0));
}

#[test]
fn outage_is_carried_on_by_the_next_run_of_the_site_server() {
    let mut yard = Yard::new();
    yard.works(0, 5);
    yard.holds(4, 5, 10);
    let open = yard.changes.last().expect("told once a second").outage.clone();
    let text = serde_json::to_string(&open).expect("JSON");
    // Numbers come back to the last digit but one.
    let open = serde_json::from_str::<Outage>(&text).expect("comes back");
    assert_eq!((open.start, open.machine_start_ns, open.boot), (at(4.0), Some(machine_ns(4.0)), Some(BOOT)));

    yard.monitor = Monitor::new("a", Some(open.clone()), at(12.0));
    yard.changes.clear();
    yard.passes(12.0, false);
    yard.holds(4, 15, 18);
    let current = yard.monitor.view(0.05, at(18.0)).outage.expect("goes on");
    assert_eq!((current.id.clone(), current.start.0), (open.id.clone(), at(4.0)));
    let told = outage(4.0, Some(18.0), 7.0);
    yard.says(18.5, &health(18.5, Mode::Main, GnssState::Fixed, Some(told)), BOOT);
    assert_eq!((yard.ended()[0].id.clone(), yard.ended()[0].end), (open.id, Some(at(18.0))));
}

#[test]
fn machine_that_tells_no_outage_but_holds_has_one_and_keeps_it_when_it_tells() {
    let mut yard = Yard::new();
    yard.works(0, 5);
    yard.says(5.0, &health(5.0, Mode::ImuOnly, GnssState::Silent, None), BOOT);
    let id = yard.monitor.view(0.05, at(5.0)).outage.expect("goes on").id;
    yard.says(5.1, &health(5.1, Mode::ImuOnly, GnssState::Silent, Some(outage(4.0, None, 0.1))), BOOT);
    assert_eq!(yard.monitor.view(0.05, at(5.1)).outage.expect("the same").id, id);
    yard.says(9.0, &health(9.0, Mode::Main, GnssState::Fixed, Some(outage(4.0, Some(8.0), 2.0))), BOOT);
    assert_eq!(yard.ended()[0].end, Some(at(8.0)));
}

#[test]
fn statistics_split_outages_at_the_sites_midnight_and_keep_lost_links_apart() {
    let zone = jiff::tz::TimeZone::get("Europe/Zurich").expect("a zone");
    // Midnight in Zurich is 23:00 UTC; at(0) is 05:00 UTC.
    let midnight = 18.0 * 3600.0;
    let record = |cause: FixState, start: f64, end: f64| {
        let mut yard = Yard::new();
        yard.works(0, 5);
        yard.holds(4, 5, 6);
        let mut outage = yard.changes.last().expect("goes on").outage.clone();
        (outage.cause, outage.start, outage.end) = (cause, at(start), Some(at(end)));
        (outage.travelled_m, outage.jump_m) = (Some(7.0), Some(0.02));
        outage
    };
    let outages = [
        record(FixState::Silent, midnight - 100.0, midnight + 50.0),
        record(FixState::Frozen, midnight + 500.0, midnight + 520.0),
        record(FixState::LinkLost, midnight + 600.0, midnight + 900.0),
    ];
    let quarter = at(midnight).as_nanos() / QUARTER.as_nanos();
    let time = CellTime { observed_ns: 900_000_000_000, float_ns: 0, without_ns: 90_000_000_000 };
    let observed = [-1, 0].map(|more| Observed { machine: "a".to_owned(), quarter: quarter + more, time });
    let span = (at(midnight - 86_400.0), at(midnight + 86_400.0));
    let statistics = Statistics::of(&outages, &observed, span, &zone, at(midnight + 86_400.0));
    assert_eq!((statistics.time_zone.as_str(), statistics.machines.len()), ("Europe/Zurich", 1));
    let machine = &statistics.machines[0];
    let [first, second] = &machine.days[..] else { panic!("{:?}", machine.days) };
    assert_eq!((first.day.as_str(), second.day.as_str()), ("2026-11-23", "2026-11-24"));
    assert_eq!((first.tally.outages, first.tally.duration_s, first.tally.travelled_m), (1, 100.0, 7.0));
    assert_eq!((second.tally.outages, second.tally.duration_s, second.tally.longest_s), (1, 70.0, 50.0));
    assert_eq!((second.tally.link_losses, second.tally.link_lost_s), (1, 300.0));
    assert_eq!((first.tally.observed_s, second.tally.without_gnss_s), (900.0, 90.0));
    let causes: Vec<_> = second.tally.by_cause.iter().map(|cause| (cause.cause, cause.outages)).collect();
    assert_eq!(causes, [(FixState::Frozen, 1), (FixState::Silent, 0)]);
    assert_eq!((machine.total.outages, machine.total.duration_s), (2, 170.0));
    assert_eq!(machine.total.jump_max_m, Some(0.02));
}
