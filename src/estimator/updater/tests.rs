use std::path::Path;

use super::*;
use crate::simulate::{Scenario, Simulation};
use crate::state::{EventKind, Graph};

#[test]
fn failed_trial_is_told_with_its_own_reason() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/scenarios/construction.toml");
    let scenario = Scenario::load(&root).expect("a valid scenario");
    let end = scenario.file.gnss_condition.iter().map(|condition| condition.end_s).fold(0.0, f64::max);
    let simulation = Simulation::new(&scenario, 0).ending_at(Stamp::from_seconds(end + 10.0));
    let options = simulation.machine().estimator_options();
    let mut updater = Updater::new(options.clone());
    let mut first = None;
    for arrival in simulation {
        updater.push(&arrival);
        if let Reading::GnssLeft(fix) = arrival.reading {
            first.get_or_insert(fix);
        }
        let Phase::Running(running) = &updater.phase else { continue };
        if running.graphs.state() != Graph::Trial {
            continue;
        }
        updater.take_events();
        // The window no longer reaches back to it.
        updater.try_fix(&first.expect("a fix"), &options.antenna_left);
        let events = updater.take_events();
        let [EventKind::GraphChanged { from: Graph::Trial, to: Graph::Fallback, reason }] =
            &events.iter().map(|event| event.what.clone()).collect::<Vec<_>>()[..]
        else {
            panic!("{events:?}")
        };
        assert!(reason.starts_with("main could not take a fix on trial: it is "), "{reason}");
        assert!(reason.ends_with("older than the window"), "{reason}");
        return;
    }
    panic!("no trial");
}
