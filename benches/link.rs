//! Cuts the link between a machine and its site, and kills both, again and again; says how soon live poses are back,
//! how soon the recording is complete, and what fetching does to the live poses. Ends with an error if anything is
//! missing, twice or another in the end.
//!
//! `cargo bench --bench link -- cuts=20 seconds=60 kills=50`; each may be left out, and 0 leaves that part out.
//! `HOLDFAST_LINK_SEED` repeats a run.
#![allow(clippy::disallowed_methods, reason = "links are cut in real time")]

use std::path::Path;
use std::time::{Duration, Instant};

use holdfast::record::Checker;

#[path = "../tests/support/fleet.rs"]
mod fleet;

use fleet::{
    Dice, Link, Process, Yard, assert_complete, contents, is_live, lacks_nothing, machine_view, until,
    until_complete,
};

const MACHINES: [&str; 2] = ["walker-1", "walker-2"];
const BACK_WITHIN: Duration = Duration::from_secs(2);

/// The value of `name=value` among the arguments.
fn argument(name: &str, default: u64) -> u64 {
    let arguments: Vec<String> = std::env::args().collect();
    let told = arguments.iter().find_map(|argument| argument.strip_prefix(name)?.strip_prefix('='));
    told.map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name}={text} is no number")))
}

/// Ages of the newest pose, as somebody sees them who looks all the time, s.
#[derive(Default)]
struct Ages(Vec<f64>);

impl Ages {
    fn look(&mut self, address: &str, id: &str) -> serde_json::Value {
        let view = machine_view(address, id).unwrap_or_default();
        self.0.extend(view["pose"]["age_s"].as_f64());
        view
    }

    fn said(&mut self) -> String {
        self.0.sort_by(f64::total_cmp);
        let at =
            |share: f64| self.0.get((share * (self.0.len() as f64 - 1.0)) as usize).map_or(0.0, |s| 1e3 * s);
        format!("p50 {:.0} ms, p99 {:.0} ms, max {:.0} ms", at(0.5), at(0.99), at(1.0))
    }
}

fn yard(name: &str) -> Yard {
    Yard::new(Path::new(env!("CARGO_TARGET_TMPDIR")).join(name), env!("CARGO_BIN_EXE_holdfast"))
}

fn cut(dice: &mut Dice, cuts: u64, seconds: u64) {
    let id = MACHINES[0];
    let yard = yard("bench-link");
    let (mut site, address) = yard.site();
    let mut machine = yard.machine(id);
    until(&address, id, "live", is_live);
    let (mut before, mut during) = (Ages::default(), Ages::default());
    let begun = Instant::now();
    while begun.elapsed() < Duration::from_secs(10) {
        before.look(&address, id);
        std::thread::sleep(Duration::from_millis(20));
    }
    let (mut back, mut filled) = (Vec::new(), Vec::new());
    for round in 0..cuts {
        std::thread::sleep(dice.millis(500, 5_000));
        let how = if dice.below(2) == 0 { Link::Cut } else { Link::Silent };
        yard.proxy.set(how);
        std::thread::sleep(Duration::from_secs(seconds));
        yard.proxy.set(Link::Whole);
        let live = until(&address, id, "live", is_live);
        let begun = Instant::now();
        until(&address, id, "known to lack something", |view| !lacks_nothing(view));
        while !lacks_nothing(&during.look(&address, id)) {
            std::thread::sleep(Duration::from_millis(20));
        }
        let whole = live + begun.elapsed();
        println!(
            "cut {round}: {how:?}: live after {:.2} s, filled after {:.2} s",
            live.as_secs_f64(),
            whole.as_secs_f64()
        );
        assert!(live <= BACK_WITHIN, "cut {round}: live after {live:?}");
        back.push(live.as_secs_f64());
        filled.push(whole.as_secs_f64());
    }
    until_complete(&address, id);
    let link = machine_view(&address, id).expect("answers")["link"].clone();
    machine.end();
    std::thread::sleep(Duration::from_millis(500));
    site.end();
    let count = assert_complete(&yard, id);
    let max = |values: &[f64]| values.iter().copied().fold(0.0, f64::max);
    println!(
        "{cuts} cuts of {seconds} s: all of {count} messages on board are recorded, none twice; link {link}"
    );
    println!("live again after {:.2} s at most, filled after {:.2} s at most", max(&back), max(&filled));
    println!(
        "age of the newest pose, as seen over HTTP: undisturbed {}; while fetching {}",
        before.said(),
        during.said()
    );
}

fn kill(dice: &mut Dice, kills: u64) {
    let yard = yard("bench-kill");
    let mut site = Some(yard.site());
    let mut machines = MACHINES.map(|id| yard.machine(id));
    let mut killed = [0; 3];
    for _ in 0..kills {
        std::thread::sleep(dice.millis(50, 6_000));
        let victims = dice.below(3) as usize;
        killed[victims] += 1;
        let which = dice.below(2) as usize;
        if victims != 1 {
            site.take().expect("runs").0.kill();
        }
        if victims != 0 {
            machines[which].kill();
            std::thread::sleep(dice.millis(0, 1_500));
            machines[which] = yard.machine(MACHINES[which]);
        }
        std::thread::sleep(dice.millis(0, 3_000));
        site.get_or_insert_with(|| yard.site());
    }
    let (mut site, address) = site.expect("runs");
    for id in MACHINES {
        until(&address, id, "live", is_live);
        until_complete(&address, id);
    }
    machines.iter_mut().for_each(Process::end);
    std::thread::sleep(Duration::from_millis(500));
    site.end();
    let [sites, ones, both] = killed;
    println!("{kills} kills: {sites} of the site, {ones} of a machine, {both} of both");
    for id in MACHINES {
        let boots = contents(&yard.on_board(id), id).boots.len();
        println!("{id}: {} messages of {boots} boots: all there, none twice", assert_complete(&yard, id));
    }
    let mut files = yard.recordings();
    MACHINES.iter().for_each(|id| files.extend(yard.on_board(id)));
    for file in &files {
        let checked = Checker::default().check(file, |_| {}).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(checked.faults, Vec::<String>::new(), "{}", file.display());
    }
    println!("{} files open, and are what they say", files.len());
}

fn main() {
    // What `cargo test --benches` wants is that it starts.
    if std::env::args().any(|argument| argument == "--test") {
        return;
    }
    let mut dice = Dice::seeded("HOLDFAST_LINK_SEED");
    let (cuts, seconds, kills) = (argument("cuts", 20), argument("seconds", 60), argument("kills", 50));
    if cuts > 0 {
        cut(&mut dice, cuts, seconds);
    }
    if kills > 0 {
        kill(&mut dice, kills);
    }
}
