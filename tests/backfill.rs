//! What the network loses, or the site while it is down, is fetched from the machines: everything is in the
//! recording in the end, once, and what cannot be is told.
//!
//! `HOLDFAST_LINK_SEED` repeats a run whose failure printed its seed. The long form, for hours, is
//! `cargo bench --bench link`.
#![cfg(all(feature = "shells", target_os = "linux"))]
#![allow(clippy::disallowed_methods, reason = "links are cut in real time")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use holdfast::record::{self, read_in_order, read_live_runs};
use holdfast::replay::again;
use holdfast::simulate::Scenario;
use holdfast::wire::{RosMessage as _, Topic, odom_message, pose_message};

#[path = "support/fleet.rs"]
mod fleet;

use fleet::{
    Dice, Link, Yard, assert_complete, contents, is_live, lacks_nothing, machine_view, until, until_complete,
};

const MACHINE: &str = "walker-1";
/// Live poses are back so soon after the link is; the rest is for a busy computer.
const BACK_WITHIN: Duration = Duration::from_millis(2_000);

fn yard(name: &str) -> Yard {
    Yard::new(Path::new(env!("CARGO_TARGET_TMPDIR")).join(name), env!("CARGO_BIN_EXE_holdfast"))
}

fn refs(paths: &[PathBuf]) -> impl Iterator<Item = &Path> {
    paths.iter().map(PathBuf::as_path)
}

#[test]
fn whatever_the_link_loses_is_in_the_recording_in_the_end_once_and_in_order() {
    let mut dice = Dice::seeded("HOLDFAST_LINK_SEED");
    let yard = yard("backfill-link");
    let (mut site, address) = yard.site();
    let mut machine = yard.machine(MACHINE);
    until(&address, MACHINE, "live", is_live);
    for round in 0..4 {
        std::thread::sleep(dice.millis(500, 2_500));
        let how = if round % 2 == 0 { Link::Cut } else { Link::Silent };
        yard.proxy.set(how);
        let away = dice.millis(3_000, 6_000);
        std::thread::sleep(away);
        yard.proxy.set(Link::Whole);
        let back = until(&address, MACHINE, "live", is_live);
        println!("round {round}: {how:?} for {away:?}: live again after {back:?}");
        assert!(back <= BACK_WITHIN, "round {round}: {back:?}");
    }
    let complete = until_complete(&address, MACHINE);
    println!("complete after {complete:?}");
    let view = machine_view(&address, MACHINE).expect("answers");
    assert!(view["link"]["gaps_filled"].as_u64() > Some(2_000), "{}", view["link"]);
    assert_eq!(view["link"]["gaps_lost"], 0);
    machine.end();
    std::thread::sleep(Duration::from_millis(500));
    site.end();
    let count = assert_complete(&yard, MACHINE);
    println!("{count} messages");

    // The order is the machine's, though the file is in that of the recorder.
    let files = yard.recordings();
    let recorded = read_in_order(refs(&files), MACHINE).expect("reads");
    let mut next: BTreeMap<Topic, u64> = BTreeMap::new();
    for message in &recorded {
        let next = next.entry(message.topic).or_insert(0);
        assert_eq!(message.sequence, *next, "{}", message.topic);
        *next += 1;
    }
    let of_file: Vec<_> =
        record::read_messages(&files[0]).expect("opens").map(|m| m.expect("reads")).collect();
    assert!(of_file.windows(2).any(|pair| pair[0].sent > pair[1].sent), "nothing came late");

    // What was estimated on the machine is found again to the bit.
    let runs = read_live_runs(refs(&files), MACHINE).expect("reads");
    let [run] = &runs[..] else { panic!("{} boots", runs.len()) };
    assert_eq!(run.gap, None);
    let scenario = Scenario::load(&yard.folder.join("scenarios/demo.toml")).expect("valid");
    let (mut poses, mut odoms) = (Vec::new(), Vec::new());
    again(&run.run, scenario.machines[0].estimator_options(), |estimate| {
        poses.push(pose_message(estimate).encode());
        odoms.push(odom_message(estimate).encode());
    })
    .expect("that run");
    let published = |topic| {
        let of_topic = recorded.iter().filter(move |message| message.topic == topic);
        of_topic.map(|message| message.payload.clone()).collect::<Vec<_>>()
    };
    assert!(poses.len() > 1_000 && poses == published(Topic::Pose), "{} poses", poses.len());
    assert!(odoms == published(Topic::Odom));
}

#[test]
fn whoever_is_killed_nothing_of_what_machines_recorded_is_missing_in_the_end() {
    const MACHINES: [&str; 2] = ["walker-1", "walker-2"];
    let mut dice = Dice::seeded("HOLDFAST_LINK_SEED");
    let yard = yard("backfill-kill");
    let mut site = Some(yard.site());
    let mut machines = MACHINES.map(|id| yard.machine(id));
    for round in 0..6 {
        std::thread::sleep(dice.millis(300, 4_000));
        let victims = 1 + round % 3;
        println!("round {round}: site {}, machine {}", victims & 1 != 0, victims & 2 != 0);
        if victims & 1 != 0 {
            site.take().expect("runs").0.kill();
        }
        if victims & 2 != 0 {
            machines[round / 3].kill();
            std::thread::sleep(dice.millis(0, 500));
            machines[round / 3] = yard.machine(MACHINES[round / 3]);
        }
        std::thread::sleep(dice.millis(0, 2_500));
        site.get_or_insert_with(|| yard.site());
    }
    let (mut site, address) = site.expect("runs");
    for id in MACHINES {
        until(&address, id, "live", is_live);
        let complete = until_complete(&address, id);
        println!(
            "{id}: complete after {complete:?}: {}",
            machine_view(&address, id).expect("answers")["link"]
        );
    }
    machines.iter_mut().for_each(fleet::Process::end);
    std::thread::sleep(Duration::from_millis(500));
    site.end();
    for id in MACHINES {
        let boots = contents(&yard.on_board(id), id).boots.len();
        let count = assert_complete(&yard, id);
        // A boot that was killed within its first second may have left nothing.
        println!("{id}: {count} messages of {boots} boots");
        assert!(count > 2_000 && boots >= 1, "{count} messages of {boots} boots");
    }
}

#[test]
fn what_was_being_fetched_when_somebody_stopped_the_recording_is_in_the_next_one() {
    let yard = yard("backfill-stop");
    let (mut site, address) = yard.site();
    let mut machine = yard.machine(MACHINE);
    until(&address, MACHINE, "live", is_live);
    yard.proxy.set(Link::Cut);
    std::thread::sleep(Duration::from_secs(15));
    yard.proxy.set(Link::Whole);
    until(&address, MACHINE, "fetched from", |view| {
        view["link"]["gaps_filled"].as_u64() > Some(0) && !lacks_nothing(view)
    });
    let session = fleet::get(&address, "/api/v1/sessions").expect("answers")["recording"]["session"].clone();
    let stop = format!("/api/v1/sessions/{}/stop", session.as_str().expect("one runs"));
    assert_eq!(fleet::post(&address, &stop).expect("answers")["state"], "complete");
    std::thread::sleep(Duration::from_secs(1));
    assert!(!lacks_nothing(&machine_view(&address, MACHINE).expect("answers")), "all was fetched before");
    assert_eq!(fleet::post(&address, "/api/v1/sessions").expect("answers")["state"], "recording");
    until_complete(&address, MACHINE);
    machine.end();
    std::thread::sleep(Duration::from_millis(500));
    site.end();
    // What came by itself while nothing was recorded, one run of each topic, is not there; all else is.
    let on_board = contents(&yard.on_board(MACHINE), MACHINE);
    let recorded = contents(&yard.recordings(), MACHINE);
    assert_eq!(recorded.doubles, []);
    let mut missing: BTreeMap<Topic, Vec<u64>> = BTreeMap::new();
    for (_, topic, number) in on_board.messages.keys().filter(|name| !recorded.messages.contains_key(*name)) {
        missing.entry(*topic).or_default().push(*number);
    }
    for (topic, numbers) in missing {
        let (first, last) = (numbers[0], numbers[numbers.len() - 1]);
        assert_eq!(last - first + 1, numbers.len() as u64, "{topic}: {numbers:?}");
        assert!(numbers.len() < 300, "{topic}: {numbers:?}");
    }
}

/// The gaps that a file tells of: topic, cause, and how many messages.
fn told_gaps(path: &Path) -> Vec<(String, String, u64)> {
    let bytes = std::fs::read(path).expect("reads");
    let summary = mcap::Summary::read(&bytes).expect("proper").expect("has one");
    let indexes = summary.metadata_indexes.iter().filter(|index| index.name == "holdfast.gap");
    let told = indexes.map(|index| {
        let entries = mcap::read::metadata(&bytes, index).expect("metadata").metadata;
        let number = |key: &str| entries[key].parse::<u64>().expect("a number");
        assert_eq!((entries["machine"].as_str(), entries["boot"].len()), (MACHINE, 16));
        (entries["topic"].clone(), entries["cause"].clone(), number("to") - number("from") + 1)
    });
    told.collect()
}

/// One cut under a machine file with something more in it; returns what the recording tells of gaps.
fn cut_once(
    name: &str,
    machine_extra: &str,
    speed: f64,
    away: Duration,
) -> (Yard, Vec<(String, String, u64)>) {
    let mut yard = yard(name);
    yard.machine_extra = machine_extra.to_owned();
    yard.speed = speed;
    let (mut site, address) = yard.site();
    let mut machine = yard.machine(MACHINE);
    until(&address, MACHINE, "live", is_live);
    std::thread::sleep(Duration::from_secs(1));
    yard.proxy.set(Link::Cut);
    std::thread::sleep(away);
    yard.proxy.set(Link::Whole);
    until(&address, MACHINE, "live", is_live);
    until(&address, MACHINE, "known to have lost something", |view| {
        view["link"]["gaps_lost"].as_u64() > Some(0)
    });
    until_complete(&address, MACHINE);
    let lost =
        machine_view(&address, MACHINE).expect("answers")["link"]["gaps_lost"].as_u64().expect("count");
    machine.end();
    site.end();
    let gaps: Vec<_> = yard.recordings().iter().flat_map(|path| told_gaps(path)).collect();
    assert_eq!(gaps.iter().map(|(_, _, count)| count).sum::<u64>(), lost, "{gaps:?}");
    (yard, gaps)
}

#[test]
fn gap_that_the_ring_has_overwritten_is_told_with_its_cause() {
    let extra = "\n[record]\nsize_max_mb = 1\n";
    let (yard, gaps) = cut_once("backfill-overwritten", extra, 5.0, Duration::from_secs(12));
    assert!(gaps.iter().all(|(_, cause, _)| cause == "overwritten"), "{gaps:?}");
    assert!(gaps.iter().any(|(topic, _, count)| topic == "sensor/imu" && *count > 500), "{gaps:?}");
    let on_board: u64 = yard.on_board(MACHINE).iter().map(|file| file.metadata().expect("file").len()).sum();
    assert!(on_board <= 1_000_000, "{on_board}");
    assert_complete(&yard, MACHINE);
}

#[test]
fn gap_of_a_machine_without_a_record_is_told_with_its_cause() {
    let extra = "\n[record]\nenabled = false\n";
    let (yard, gaps) = cut_once("backfill-not-kept", extra, 1.0, Duration::from_secs(3));
    assert!(gaps.iter().all(|(_, cause, _)| cause == "not_kept"), "{gaps:?}");
    assert!(gaps.iter().any(|(topic, ..)| topic == "pose"), "{gaps:?}");
    assert_eq!(yard.on_board(MACHINE), Vec::<PathBuf>::new());
}

#[test]
fn machine_that_worked_without_the_site_is_fetched_whole_and_one_that_is_gone_is_told() {
    let yard = yard("backfill-alone");
    yard.proxy.set(Link::Cut);
    // Boots that nobody saw, one of them killed.
    for kill in [true, false] {
        let mut machine = yard.machine(MACHINE);
        std::thread::sleep(Duration::from_secs(9));
        if kill { machine.kill() } else { machine.end() }
    }
    let (mut site, address) = yard.site();
    yard.proxy.set(Link::Whole);
    let mut machine = yard.machine(MACHINE);
    until(&address, MACHINE, "live", is_live);
    until_complete(&address, MACHINE);
    // The link is lost for a while, comes back, and before much can be fetched the machine is gone.
    yard.proxy.set(Link::Cut);
    std::thread::sleep(Duration::from_secs(8));
    yard.proxy.set(Link::Whole);
    until(&address, MACHINE, "known to lack something", |view| !lacks_nothing(view));
    machine.kill();
    site.end();
    let gaps: Vec<_> = yard.recordings().iter().flat_map(|path| told_gaps(path)).collect();
    assert!(gaps.iter().all(|(_, cause, _)| cause == "unreachable") && gaps.len() > 3, "{gaps:?}");
    assert_eq!(contents(&yard.recordings(), MACHINE).boots.len(), 3);
    let begun = Instant::now();
    // The next start finishes what the kill has torn, and the site fetches the last words of the killed boot.
    let (mut site, address) = yard.site();
    let mut machine = yard.machine(MACHINE);
    until(&address, MACHINE, "live", is_live);
    until_complete(&address, MACHINE);
    println!("complete after {:?}", begun.elapsed());
    machine.end();
    site.end();
    assert_complete(&yard, MACHINE);
    assert_eq!(contents(&yard.recordings(), MACHINE).boots.len(), 4);
}
