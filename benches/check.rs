//! How fast `holdfast replay --check` is: the session of two machines, reading and comparing included.
//!
//! `cargo bench --bench check -- minutes=10 runs=5` has the demo's two machines work for so many minutes at ten times
//! real time, records them at a site as always, and checks the session as often as `runs` says. `session=DIR` checks one
//! that is there. Prints medians, and ends with an error if anything does not come out to the bit.
#![allow(clippy::disallowed_methods, reason = "what is measured here is time")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

/// Simulated seconds in a second.
const SPEED: f64 = 10.0;
/// Until both machines speak, s.
const START_S: f64 = 3.0;

/// The value of `name=value` among the arguments.
fn word(name: &str) -> Option<String> {
    std::env::args().find_map(|argument| Some(argument.strip_prefix(name)?.strip_prefix('=')?.to_owned()))
}

fn number(name: &str, default: f64) -> f64 {
    word(name).map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name}={text} is no number")))
}

fn main() {
    let minutes = number("minutes", 10.0);
    let session = word("session").map_or_else(|| record(minutes), PathBuf::from);
    let (mut of_machines, mut total) = (BTreeMap::<String, Vec<f64>>::new(), Vec::new());
    for _ in 0..number("runs", 5.0) as usize {
        let checked = check(&session);
        for (id, times) in checked.of_machines {
            of_machines.entry(id).or_default().push(times);
        }
        total.push(checked.data_s / checked.wall_s);
    }
    println!("times real time, median of {} runs (least to most):", total.len());
    for (id, mut times) in of_machines {
        println!("  {id}, beside the others: {}", told(&mut times));
    }
    println!("  all, from start to end of the process: {}", told(&mut total));
}

fn told(times: &mut [f64]) -> String {
    times.sort_by(f64::total_cmp);
    let [least, .., most] = times else { return format!("{times:.0?}") };
    let (least, most) = (*least, *most);
    format!("{:.0} ({least:.0} to {most:.0})", times[times.len() / 2])
}

/// Has the demo work for so long; returns its session.
fn record(minutes: f64) -> PathBuf {
    let data = Path::new(env!("CARGO_TARGET_TMPDIR")).join("bench-check");
    let _ = std::fs::remove_dir_all(&data);
    let mut demo = Command::new(env!("CARGO_BIN_EXE_holdfast"));
    let duration_s = 60.0 * minutes / SPEED + START_S;
    demo.args(["demo", "--listen", "127.0.0.1:0", "--speed", &SPEED.to_string()]);
    demo.args(["--duration", &duration_s.to_string()]).arg("--data").arg(&data);
    let demo = demo.stdout(Stdio::null()).stderr(Stdio::piped()).output().expect("the demo starts");
    assert!(demo.status.success(), "{}", String::from_utf8_lossy(&demo.stderr));
    let sessions = std::fs::read_dir(data.join("sessions")).expect("sessions").flatten();
    let sessions: Vec<PathBuf> = sessions.map(|entry| entry.path()).filter(|path| path.is_dir()).collect();
    let [session] = &sessions[..] else { panic!("one session, please: {sessions:?}") };
    session.clone()
}

struct Checked {
    of_machines: BTreeMap<String, f64>,
    /// Of all machines together.
    data_s: f64,
    wall_s: f64,
}

fn check(session: &Path) -> Checked {
    let begun = Instant::now();
    let check =
        Command::new(env!("CARGO_BIN_EXE_holdfast")).arg("replay").arg(session).arg("--check").output();
    let wall_s = begun.elapsed().as_secs_f64();
    let check = check.expect("holdfast runs");
    let (said, talk) = (String::from_utf8_lossy(&check.stdout), String::from_utf8_lossy(&check.stderr));
    assert!(check.status.success(), "{said}{talk}");
    let (mut of_machines, mut data_s) = (BTreeMap::new(), 0.0);
    for line in said.lines() {
        // `walker-1: 60000 poses and 60000 odoms the same to the bit; 600.0 s, 1 boot, 150 times real time`
        assert!(line.contains("the same to the bit"), "{line}");
        let (id, rest) = line.split_once(": ").unwrap_or_else(|| panic!("{line}"));
        let words: Vec<&str> = rest.split([' ', ',', ';']).filter(|word| !word.is_empty()).collect();
        let before = |word: &str| {
            let at =
                words.iter().position(|found| *found == word).unwrap_or_else(|| panic!("{word} in {line}"));
            words[at - 1].parse::<f64>().unwrap_or_else(|_| panic!("a number before {word} in {line}"))
        };
        data_s += before("s");
        of_machines.insert(id.to_owned(), before("times"));
    }
    assert!(of_machines.len() >= 2, "{said}");
    println!("{data_s:.0} s of data in {wall_s:.2} s");
    Checked { of_machines, data_s, wall_s }
}
