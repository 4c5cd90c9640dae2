//! What is said, and how it looks.

use super::*;
use crate::config::{self, Machine};
use crate::estimator::Estimator;
use crate::lie::Vec3;
use crate::reference::Step;
use crate::sensors::{Arrival, GnssFix, Reading};
use crate::time::Stamp;

fn options() -> crate::estimator::Options {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let file = root.join("config/machines/simulated-roof.toml");
    config::load::<Machine>(&file).expect("machine file").estimator_options()
}

fn review() -> Review {
    Review {
        machine: "menzi-<1>".to_owned(),
        begin_s: 1.7e9,
        span_s: 3_600.0,
        in_short: Vec::new(),
        look_at: Vec::new(),
        coverage: vec![
            Share { mode: Mode::Main, time_s: 3_240.0, percent: 90.0 },
            Share { mode: Mode::Fallback, time_s: 324.0, percent: 9.0 },
            Share { mode: Mode::ImuOnly, time_s: 0.0, percent: 0.0 },
            Share { mode: Mode::Initializing, time_s: 36.0, percent: 1.0 },
        ],
        sensors: vec![SensorReview {
            sensor: "gnss_left",
            readings: 1_000,
            rate_hz: 10.0,
            silent_s: 100.0,
            silences: 2,
            longest_silence_s: 80.0,
            refused: 200,
            last_refusal: Some("is 3.00 m from where it is expected".to_owned()),
            delay_us: None,
        }],
        outages: vec![OutageReview {
            start_s: 600.0,
            end_s: 924.0,
            ended: false,
            cause: GnssState::Silent,
            travelled_m: 12.0,
            jump_m: None,
            live_off_m: None,
        }],
        innovations: Innovations { inflation: [1.0, 3.0], ..Innovations::default() },
        consistency_cm: None,
        latency: Latency::default(),
        restarts: vec![Told { at_s: 100.0, what: "the cabin IMU was silent for 2.00 s".to_owned() }],
        gain: None,
        not_smoothed: Some("has no GNSS fixes".to_owned()),
        unsure: Vec::new(),
        lost: vec!["8 bytes".to_owned()],
        seconds: vec![
            Second { at_s: 0.0, position_sigma_m: None, test_ratio: None, moved_cm: 0.0 },
            Second { at_s: 120.0, position_sigma_m: Some(0.01), test_ratio: Some(0.2), moved_cm: 0.5 },
        ],
    }
}

#[test]
fn what_stood_out_is_said_in_words_and_nothing_else() {
    let told = words::look_at(&review()).join("\n");
    for part in [
        "Part of the recording is missing: 8 bytes.",
        "The position was known only after 2 min 0 s.",
        "From 10 min 0 s to 15 min 24 s after the start satellites did not help: no fixes came",
        "gnss_left was silent twice, for 100 s in all and 80 s at most.",
        "20 % of the readings of gnss_left were refused, at last since it is 3.00 m from",
        "multiplied by up to 1.0 across the ground and 3.0 in height",
        "100 s after the start the estimate began anew: the cabin IMU was silent",
    ] {
        assert!(told.contains(part), "{part}\n{told}");
    }
    let mut quiet = review();
    (quiet.outages, quiet.sensors, quiet.restarts, quiet.lost) = Default::default();
    quiet.innovations.inflation = [1.0; 2];
    quiet.seconds.remove(0);
    quiet.seconds[0].at_s = 5.0;
    assert_eq!(words::look_at(&quiet), Vec::<String>::new());
    assert!(words::in_short(&quiet).join("\n").contains("Satellites were never lost."));
}

#[test]
fn how_far_off_is_said_only_where_it_is_known() {
    let mut review = review();
    let told = |review: &Review| words::in_short(review).join("\n");
    // A gain with no sample in the outage.
    review.gain = Some(Gain {
        compared: 0,
        without_smoothed: 10,
        parts: Vec::new(),
        points: Vec::new(),
        horizontal_m: Vec::new(),
    });
    assert!(told(&review).contains("Satellites were lost once, for 5 min 24 s."), "{}", told(&review));
    assert!(!told(&review).contains("was off by"), "{}", told(&review));
    review.outages[0].live_off_m = Some(0.123);
    assert!(
        told(&review).contains("Meanwhile the position was off by 12.3 cm at most."),
        "{}",
        told(&review)
    );
    review.outages.push(OutageReview { live_off_m: None, ..review.outages[0] });
    let part = "In the 1 of these that can be judged the position was off by 12.3 cm at most.";
    assert!(told(&review).contains(part), "{}", told(&review));
}

#[test]
fn what_the_solution_leaves_open_is_said() {
    let mut review = review();
    let unsure =
        |why: Option<&str>| Unsure { start_s: 3.0, end_s: 65.0, why_unsolved: why.map(str::to_owned) };
    review.unsure = vec![unsure(Some("is not determined")), unsure(None)];
    let told = words::look_at(&review).join("\n");
    for part in [
        "From 3.0 s to 65 s after the start the session has no solution as a whole and nothing is judged: it is not determined.",
        "From 3.0 s to 65 s after the start the solution of the whole session is not final",
    ] {
        assert!(told.contains(part), "{told}");
    }
}

#[test]
fn silence_after_the_first_reading_is_a_silence() {
    let sensors = |stamps_s: &[f64]| {
        let mut collector = Collector::default();
        let estimator = Estimator::new(options());
        for stamp_s in stamps_s {
            let stamp = Stamp::from_seconds(*stamp_s);
            let reading = Reading::GnssLeft(GnssFix {
                stamp,
                position: options().site.to_geodetic(&Vec3::zeros()),
                sigma_enu_m: Vec3::repeat(0.02),
            });
            collector.note(Step::Taken(&Arrival { arrival: stamp, reading }, None), &estimator);
        }
        let review = collector.finish("one", Err("is a test".to_owned()), Latency::default(), Vec::new());
        let sensor = &review.sensors[0];
        (sensor.silences, sensor.longest_silence_s.round(), (10.0 * sensor.rate_hz).round() / 10.0)
    };
    let steady: Vec<f64> = (0..100).map(|index| 600.0 + 0.1 * f64::from(index)).collect();
    assert_eq!(sensors(&steady), (0, 0.0, 10.0));
    let after_the_first = [&[0.0], &steady[..]].concat();
    assert_eq!(sensors(&after_the_first), (1, 600.0, 10.0));
    // So few readings that there is no period to go by.
    for few in [1, 2, 4] {
        let (silences, longest_s, _) = sensors(&after_the_first[..few + 1]);
        assert_eq!((silences, longest_s), (1, 600.0), "{few}");
    }
    let slow: Vec<f64> = (0..10).map(f64::from).collect();
    assert_eq!(sensors(&slow), (0, 0.0, 1.0));
}

#[test]
fn page_tells_all_parts_of_every_machine() {
    let mut first = review();
    (first.in_short, first.look_at) = (words::in_short(&first), words::look_at(&first));
    let html = page("A session", &[first.clone(), Review { machine: "second".to_owned(), ..first }]).html();
    for name in ["menzi-&lt;1&gt;", "second"] {
        for part in ["in short", "what to look at", "coverage", "outages of GNSS", "innovations", "latency"] {
            assert!(html.contains(&format!("<h2>{name}: {part}</h2>")), "{name} {part}");
        }
    }
    assert!(html.contains("From 2023-11-14 22:13:20 UTC, for 60 min 0 s."));
    assert!(html.contains("known for 99.0 % of the time: 90.0 % with satellites"));
    assert!(
        html.contains("goes on")
            && html.contains("The session cannot be judged as a whole: it has no GNSS fixes.")
    );
    assert!(!html.contains("NaN") && !html.contains("http") && !html.contains("<script"));
}

#[test]
fn lengths_and_spans_are_said_as_people_say_them() {
    for (metres, text) in [(0.004, "4 mm"), (0.123, "12.3 cm"), (12.0, "12.00 m"), (0.0003, "0.3 mm")] {
        assert_eq!(words::length(metres), text);
    }
    for (seconds, text) in [(1.25, "1.2 s"), (45.2, "45 s"), (150.0, "2 min 30 s"), (7_260.0, "2 h 1 min")] {
        assert_eq!(words::span(seconds), text);
    }
}
