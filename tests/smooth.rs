//! A session as one batch: against the live window, against the truth, and what `holdfast smooth` says.

#[path = "support/command.rs"]
mod command;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use holdfast::batch::{self, SmoothedNode};
use holdfast::config::{self, Machine};
use holdfast::estimator::{Estimator, Options, Solution, split};
use holdfast::evaluate;
use holdfast::import::read_tum;
use holdfast::reference::{self, Memory, ReferenceError, Step};
use holdfast::sensors::{Arrival, Reading};
use holdfast::simulate::{Scenario, Simulation};
use holdfast::smoother::PastNode;
use holdfast::state::StateVector;
use holdfast::time::{Span, Stamp};

use command::{Ended, empty_folder, holdfast, repository};

const ENOUGH: Memory = Memory { allowed_mb: 4_000, goes_on_without: false };

fn options() -> Options {
    let file = repository("config/machines/simulated-roof.toml");
    config::load::<Machine>(&file).expect("machine file").estimator_options()
}

fn construction(seconds: f64) -> Vec<Arrival> {
    let scenario = Scenario::load(&repository("config/scenarios/construction.toml")).expect("scenario");
    let end = Stamp::from_seconds(seconds);
    Simulation::new(&scenario, 0).take_while(|arrival| arrival.arrival < end).collect()
}

/// The construction task, by the shipped command.
fn simulated() -> &'static Path {
    static LOG: OnceLock<PathBuf> = OnceLock::new();
    LOG.get_or_init(|| {
        let out = empty_folder("smooth-simulated");
        let scenario = repository("config/scenarios/construction.toml");
        let ended = holdfast(&[
            "simulate".as_ref(),
            "--scenario".as_ref(),
            scenario.as_os_str(),
            "--out".as_ref(),
            out.as_os_str(),
        ]);
        assert_eq!(ended.code, 0, "{ended:?}");
        out.join("walker-1")
    })
}

fn smooth(log: &Path, out: &Path, more: &[&str]) -> Ended {
    let machine = repository("config/machines/simulated-roof.toml");
    let [log, machine, out] = [log, &machine, out].map(|path| path.to_str().expect("UTF-8"));
    let mut arguments = vec!["smooth", log, "--machine", machine, "--out", out];
    arguments.extend(more);
    holdfast(&arguments)
}

/// A node of which the guess is off by some degrees and decimetres.
fn moved(node: &PastNode, index: i32) -> Arc<PastNode> {
    let sizes = [0.05, 0.2, 0.1, 1e-3, 1e-2, 1e-4];
    let off = StateVector::from_fn(|row, _| sizes[row / 3] * (f64::from(index) + row as f64).sin());
    Arc::new(PastNode { estimate: node.estimate.plus(&off), ..node.clone() })
}

/// Live and batch over a window that holds the whole log: the largest difference of any row, and of the last
/// node's covariance to its scale.
fn apart(seconds: f64, tighten: impl FnOnce(&mut Options)) -> (f64, f64, usize) {
    let arrivals = construction(seconds);
    let mut options = options();
    options.smoother.lag = Span::from_seconds(1e4);
    tighten(&mut options);
    let (_, mut updater) = split(options.clone());
    updater.keep_history();
    let mut last: Option<Solution> = None;
    for arrival in &arrivals {
        last = updater.push(arrival).map(|solution| *solution).or(last);
    }
    let pasts = updater.take_history();
    assert_eq!(pasts.len(), 1);
    let nodes = &pasts[0].nodes;
    // From elsewhere, so that the batch finds its own way.
    let moved: Vec<Arc<PastNode>> = (0_i32..).zip(nodes).map(|(index, node)| moved(node, index)).collect();
    let solution =
        batch::solve(&moved, &batch::Options::new(options.smoother.gravity), |_| {}).expect("solved");
    assert!(solution.cost[0] > 1e6 * solution.cost[1], "the guess was bad");
    assert!(solution.converged && solution.factors.between > 50 && solution.factors.positions > 200);
    assert!(solution.factors.turns > 5, "{:?}", solution.factors);
    let rows = nodes.iter().zip(&solution.nodes).map(|(live, node)| node.state.minus(&live.estimate).amax());
    let last = last.expect("solutions");
    let (node, pose) =
        (&solution.nodes[nodes.len() - 1], last.covariance.fixed_view::<6, 6>(0, 0).into_owned());
    assert_eq!(node.stamp, last.stamp);
    let covariance = (node.covariance - pose).abs();
    let scaled = (0..36).map(|place| {
        let (row, column) = (place / 6, place % 6);
        covariance[(row, column)] / (pose[(row, row)] * pose[(column, column)]).sqrt()
    });
    (rows.fold(0.0, f64::max), scaled.fold(0.0, f64::max), nodes.len())
}

#[test]
fn batch_and_window_agree_where_the_window_holds_the_whole_log() {
    let (state, covariance, nodes) = apart(30.0, |options| {
        options.smoother.relinearize = [1e-9; 6];
        options.smoother.iterations_max = 20;
    });
    println!("{nodes} nodes: states {state:.1e}, covariance {covariance:.1e} of its scale");
    assert!(nodes > 500, "{nodes}");
    assert!(state < 1e-6, "{state:.2e}");
    assert!(covariance < 1e-4, "{covariance:.2e}");
}

#[test]
fn thresholds_of_the_live_window_cost_micrometres() {
    let (state, _, _) = apart(30.0, |_| {});
    println!("with the thresholds as shipped: {state:.1e}");
    assert!(state < 5e-5, "{state:.2e}");
}

#[test]
fn smoothed_is_nearer_to_the_truth_than_live_and_knows_it() {
    let log = simulated();
    let out = empty_folder("smooth-truth");
    let ended = smooth(log, &out, &[]);
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""), "{ended:?}");
    let machine = repository("config/machines/simulated-roof.toml");
    let live_out = empty_folder("smooth-live");
    assert_eq!(command::estimate(log, &machine, &live_out).code, 0);
    let truth = read_tum(&log.join("truth_imu.tum")).expect("truth");
    let errors = |path: &Path| {
        let estimate = read_tum(path).expect("estimate");
        let report = evaluate::compare(&truth, &estimate, &evaluate::Options::default()).expect("comparable");
        report.errors
    };
    let (smoothed, live) = (errors(&out.join("smoothed.tum")), errors(&live_out.join("world.tum")));
    println!(
        "rmse {:.4} m against {:.4} m live, max {:.4} against {:.4}",
        smoothed.position_m.rmse, live.position_m.rmse, smoothed.position_m.max, live.position_m.max
    );
    assert!(smoothed.poses >= live.poses, "one for each IMU sample: {} {}", smoothed.poses, live.poses);
    assert!(smoothed.position_m.rmse < 0.75 * live.position_m.rmse);
    assert!(smoothed.position_m.max < live.position_m.max);
    assert!(smoothed.heading_deg.rmse < live.heading_deg.rmse);
    let told: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(out.join("smooth.json")).expect("smooth.json"))
            .expect("JSON");
    let all = &told["gain"]["parts"][0];
    assert_eq!(all["name"], "all");
    assert_eq!(told["gain"]["without_smoothed"], 0);
    let number = |value: &serde_json::Value| value.as_f64().expect("a number");
    assert!(number(&all["smoothed_sigma_m"]) < number(&all["live_sigma_m"]));
    let covariances = fs::read_to_string(out.join("covariance.csv")).expect("covariance.csv");
    let nodes = fs::read_to_string(out.join("nodes.csv")).expect("nodes.csv");
    assert_eq!(covariances.lines().count(), nodes.lines().count());
    assert!(covariances.lines().all(|line| line.split(',').count() == 22));
    assert!(nodes.lines().all(|line| line.split(',').count() == 24));
}

#[test]
fn the_same_session_gives_the_same_bytes() {
    let log = simulated();
    let outs = ["smooth-once", "smooth-again"].map(empty_folder);
    for out in &outs {
        assert_eq!(smooth(log, out, &["--to-s", "60"]).code, 0);
    }
    for name in ["smoothed.tum", "nodes.csv", "covariance.csv"] {
        let [once, again] = outs.each_ref().map(|out| fs::read(out.join(name)).expect("written"));
        assert!(once == again && once.len() > 10_000, "{name}");
    }
}

#[test]
fn a_recording_gives_what_its_log_folder_gives() {
    let recordings = empty_folder("smooth-recording");
    let file = recordings.join("session.mcap");
    let scenario = repository("config/scenarios/construction.toml");
    let [scenario, path] = [&scenario, &file].map(|path| path.to_str().expect("UTF-8"));
    assert_eq!(holdfast(&["simulate", "--scenario", scenario, "--out", path]).code, 0);
    let outs = ["smooth-of-recording", "smooth-of-folder"].map(empty_folder);
    let ended = smooth(&recordings, &outs[0], &["--to-s", "40"]);
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""), "{ended:?}");
    assert_eq!(smooth(simulated(), &outs[1], &["--to-s", "40"]).code, 0);
    let [session, folder] = [outs[0].join("walker-1"), outs[1].clone()]
        .map(|out| fs::read(out.join("smoothed.tum")).expect("written"));
    assert!(session == folder, "the same readings");
    let ended = holdfast(&["smooth", path, "--out", outs[0].to_str().expect("UTF-8")]);
    assert_eq!(ended.code, 1, "{ended:?}");
    assert!(ended.stderr.contains("give the machine file with --machine"), "{ended:?}");
}

#[test]
fn what_cannot_be_smoothed_is_refused_in_words() {
    let refused = |arrivals: &[Arrival]| {
        let forward = reference::forward(arrivals, &BTreeSet::new(), options(), ENOUGH, |_, _| {});
        reference::smooth(&forward, |_| {}).expect_err("refused")
    };
    assert_eq!(refused(&[]), ReferenceError::Empty);
    let arrivals = construction(20.0);
    let no_fixes: Vec<Arrival> = arrivals
        .iter()
        .filter(|arrival| !matches!(arrival.reading, Reading::GnssLeft(_) | Reading::GnssRight(_)))
        .copied()
        .collect();
    assert_eq!(refused(&no_fixes), ReferenceError::NoFixes);
    let until =
        |seconds: f64| arrivals.partition_point(|arrival| arrival.arrival < Stamp::from_seconds(seconds));
    let error = refused(&arrivals[..until(0.5)]);
    assert!(matches!(error, ReferenceError::NotStarted { .. }), "{error}");
    // As soon as it has started.
    let mut estimator = Estimator::new(options());
    let started = arrivals.iter().position(|arrival| estimator.push(arrival).is_some()).expect("starts");
    let error = refused(&arrivals[..started + 5]);
    assert!(matches!(error, ReferenceError::TooShort { .. }), "{error}");
}

#[test]
fn memory_is_held_to_its_limit_along_the_run() {
    let arrivals = construction(40.0);
    let run = |goes_on_without: bool| {
        let memory = Memory { allowed_mb: 2, goes_on_without };
        let (mut last_s, mut most_nodes) = (0.0, 0);
        let forward =
            reference::forward(&arrivals, &BTreeSet::new(), options(), memory, |step, estimator| {
                most_nodes = estimator.history_nodes()[0].max(most_nodes);
                if let Step::Taken(arrival, _) = step {
                    last_s = arrival.arrival.as_seconds();
                }
            });
        assert!(forward.pasts.is_empty() && forward.live.is_empty());
        let error = reference::smooth(&forward, |_| {}).expect_err("refused");
        let ReferenceError::TooMuchMemory { at_s, whole_mb, allowed_mb: 2, .. } = error else {
            panic!("{error}");
        };
        assert!(at_s > 1.0 && at_s < 15.0, "{at_s}");
        // 19 kB a node of one chain, and 25 of them a second.
        assert!((8..40).contains(&whole_mb), "{whole_mb}");
        assert!(most_nodes * 19_000 <= 2_000_000 + 19_000, "{most_nodes}");
        (at_s, last_s)
    };
    let (at_s, last_s) = run(false);
    assert!(last_s < at_s + 1.0, "{at_s} {last_s}: it ends there");
    let (_, last_s) = run(true);
    assert!(last_s > 39.0, "{last_s}: those who watch see all of it");
    // What was counted along the way is what there is at the end.
    let mut counted = [0; 2];
    let count = |_: Step<'_>, estimator: &Estimator| counted = estimator.history_nodes();
    let forward = reference::forward(&arrivals, &BTreeSet::new(), options(), ENOUGH, count);
    let nodes: usize = forward.pasts.iter().map(|past| past.nodes.len()).sum();
    assert_eq!(counted, [nodes; 2]);
}

/// Blind for longer than a window is held, in an outage: the window brings the position back by a pose in the world.
#[test]
fn lidar_that_was_blind_for_minutes_is_tied_to_where_it_fell_blind() {
    let (lost_s, blind_s, end_s) = (40.0..200.0, 45.0..190.0, 215.0);
    let scenario = Scenario::load(&repository("config/scenarios/navigation.toml")).expect("scenario");
    let simulation = Simulation::new(&scenario, 0);
    let options = simulation.machine().estimator_options();
    let readings = Simulation::new(&scenario, 0);
    let is_fix = |reading: &Reading| matches!(reading, Reading::GnssLeft(_) | Reading::GnssRight(_));
    let arrivals: Vec<Arrival> = readings
        .take_while(|arrival| arrival.arrival < Stamp::from_seconds(end_s))
        .filter(|arrival| {
            let at_s = arrival.reading.stamp().as_seconds();
            let lost = is_fix(&arrival.reading) && lost_s.contains(&at_s);
            let blind = matches!(arrival.reading, Reading::LidarOdometry(_)) && blind_s.contains(&at_s);
            !(lost || blind)
        })
        .collect();
    // In the outage fallback answers, after it main, which never had the pose.
    for until_s in [198.0, end_s] {
        let until = arrivals.partition_point(|arrival| arrival.arrival < Stamp::from_seconds(until_s));
        let run =
            reference::forward(&arrivals[..until], &BTreeSet::new(), options.clone(), ENOUGH, |_, _| {});
        let nodes: Vec<&Arc<PastNode>> = run.pasts.iter().flat_map(|past| &past.nodes).collect();
        assert!(nodes.iter().all(|node| node.poses.is_empty()), "as one they are relative");
        let long = |node: &&&Arc<PastNode>| {
            node.edges.iter().any(|(later, _)| later.seconds_since(node.stamp) > 140.0)
        };
        assert_eq!(nodes.iter().filter(long).count(), 1, "one over all of the blindness, until {until_s} s");
        let smoothed = reference::smooth(&run, |_| {}).expect("solved");
        // Fixes that contradict the live estimate when they come back seat it anew: what was before is a chain of its own.
        assert!(smoothed.chains[0].converged && smoothed.unsolved.is_empty());
        let chain = batch::chains(&run.pasts[0].nodes).next().expect("a chain");
        // What the same session would be without it.
        let untied: Vec<Arc<PastNode>> = chain
            .iter()
            .map(|node| {
                let mut node = PastNode::clone(node);
                node.edges.retain(|(later, _)| later.seconds_since(node.stamp) < 140.0);
                Arc::new(node)
            })
            .collect();
        let untied = batch::solve(&untied, &batch::Options::new(options.smoother.gravity), |_| {});
        let untied = untied.expect("solved").nodes;
        // Of the last node before: distance from the truth, and sigma of the position, m.
        let of = |nodes: &[SmoothedNode], second: f64| {
            let last = nodes.partition_point(|node| node.stamp <= Stamp::from_seconds(second)) - 1;
            let node = &nodes[last];
            let truth = simulation.truth(node.stamp).state.position;
            let variance: f64 = (3..6).map(|axis| node.covariance[(axis, axis)]).sum();
            ((node.state.position - truth).norm(), variance.sqrt())
        };
        for second in [44.0, 50.0, 100.0, 150.0, 189.0, 195.0] {
            let ((off_m, sigma_m), (alone_m, _)) =
                (of(&smoothed.chains[0].nodes, second), of(&untied, second));
            println!(
                "until {until_s} s, {} chains: at {second} s {off_m:.3} m off, sigma {sigma_m:.3} m, {alone_m:.3} m untied",
                smoothed.chains.len()
            );
            assert!(off_m < 3.5 * sigma_m, "at {second} s {off_m} m off, sigma {sigma_m} m");
            assert!(second < 150.0 || off_m < 0.5 * alone_m, "{off_m} m, {alone_m} m untied");
        }
    }
}

#[test]
fn parts_between_which_the_estimate_began_anew_are_solved_one_by_one() {
    let mut arrivals = construction(40.0);
    let (from, to) = (Stamp::from_seconds(20.0), Stamp::from_seconds(22.0));
    arrivals.retain(
        |arrival| !matches!(&arrival.reading, Reading::Imu(sample) if (from..to).contains(&sample.stamp)),
    );
    let forward = reference::forward(&arrivals, &BTreeSet::new(), options(), ENOUGH, |_, _| {});
    let smoothed = reference::smooth(&forward, |_| {}).expect("solved");
    assert_eq!((smoothed.chains.len(), smoothed.unsolved.len()), (2, 0));
    let mut last = Stamp::default();
    let mut in_gap = 0;
    smoothed.at_samples(|stamp, _, _| {
        assert!(stamp > last, "{stamp} after {last}");
        in_gap += i32::from(stamp > from && stamp < to);
        last = stamp;
    });
    assert_eq!(in_gap, 0);
    assert!(last.seconds_since(Stamp::from_seconds(39.5)) > 0.0);
    let gain = smoothed.gain(&forward.live);
    assert!(gain.compared > 2_500 && gain.parts[0].horizontal_m.rmse < 0.1, "{gain:?}");
}

#[test]
fn arguments_that_cannot_be_used_end_with_2() {
    let out = empty_folder("smooth-arguments");
    let out = out.to_str().expect("UTF-8");
    let log = simulated().to_str().expect("UTF-8");
    let ended = holdfast(&["smooth", "/no/such/log", "--out", out]);
    assert_eq!((ended.code, ended.stderr.contains("there is no such file")), (2, true), "{ended:?}");
    let ended = holdfast(&["smooth", log, "--out", out]);
    assert_eq!((ended.code, ended.stderr.contains("give --machine")), (2, true), "{ended:?}");
    let ended = smooth(simulated(), Path::new(out), &["--from-s", "20", "--to-s", "10"]);
    assert_eq!((ended.code, ended.stderr.contains("--to-s must be after")), (2, true), "{ended:?}");
    let empty = empty_folder("smooth-empty-log");
    fs::write(empty.join("imu.csv"), "t_arrival,t,gx,gy,gz,ax,ay,az\n").expect("written");
    let ended = smooth(&empty, Path::new(out), &[]);
    assert_eq!((ended.code, ended.stderr.contains("has no readings")), (1, true), "{ended:?}");
}
