//! A short simulated log with its truth, and estimates of it.
#![allow(dead_code, reason = "each test takes what it needs")]

use std::fs;
use std::path::{Path, PathBuf};

use crate::command::{holdfast, repository};

/// One machine of the construction task, cut after so many seconds; unreliable GNSS between the two times.
pub fn simulate(folder: &Path, seconds: u32, outage_s: [u32; 2]) -> PathBuf {
    let root = repository("config");
    let text = fs::read_to_string(root.join("scenarios/construction.toml")).expect("scenario");
    let text = text
        .replace("../machines/", &format!("{}/", root.join("machines").display()))
        .replace("duration_s = 200.0", &format!("duration_s = {seconds}.0"))
        .replace("start_s = 105.0", &format!("start_s = {}.0", outage_s[0]))
        .replace("end_s = 150.0", &format!("end_s = {}.0", outage_s[1]));
    assert!(text.contains(&format!("duration_s = {seconds}.0")) && text.contains("start_s = "));
    let scenario = folder.join("scenario.toml");
    fs::write(&scenario, text).expect("written");
    let logs = folder.join("logs");
    let ended = run(&["simulate", "--scenario"], &[&scenario], &["--out"], &[&logs]);
    assert_eq!(ended.0, 0, "{ended:?}");
    logs.join("walker-1")
}

/// `holdfast estimate` by a method.
pub fn estimate(log: &Path, method: &str, out: &Path) {
    let machine = repository("config/machines/simulated-roof.toml");
    let ended = run(&["estimate", "--method", method, "--machine"], &[&machine], &["--out"], &[out, log]);
    assert_eq!(ended.0, 0, "{ended:?}");
}

/// Words and paths, in turn: code, stdout and stderr.
pub fn run(words: &[&str], paths: &[&Path], more: &[&str], rest: &[&Path]) -> (i32, String, String) {
    let text = |path: &&Path| path.to_str().expect("UTF-8").to_owned();
    let arguments: Vec<String> = words
        .iter()
        .map(|word| (*word).to_owned())
        .chain(paths.iter().map(text))
        .chain(more.iter().map(|word| (*word).to_owned()))
        .chain(rest.iter().map(text))
        .collect();
    let ended = holdfast(&arguments);
    (ended.code, ended.stdout, ended.stderr)
}
