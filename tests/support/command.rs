//! Runs the built binary, in folders that belong to one test.
#![allow(dead_code, reason = "each test takes what it needs")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// How a run ended.
#[derive(Debug)]
pub struct Ended {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

/// Runs `holdfast` with these arguments to its end.
pub fn holdfast<S: AsRef<std::ffi::OsStr>>(arguments: &[S]) -> Ended {
    let output =
        Command::new(env!("CARGO_BIN_EXE_holdfast")).args(arguments).output().expect("holdfast runs");
    Ended {
        code: output.status.code().expect("not killed"),
        stdout: String::from_utf8(output.stdout).expect("stdout is UTF-8"),
        stderr: String::from_utf8(output.stderr).expect("stderr is UTF-8"),
    }
}

/// `holdfast estimate LOG --machine MACHINE --out OUT`.
pub fn estimate(log: &Path, machine: &Path, out: &Path) -> Ended {
    holdfast(&[
        "estimate".as_ref(),
        log.as_os_str(),
        "--machine".as_ref(),
        machine.as_os_str(),
        "--out".as_ref(),
        out.as_os_str(),
    ])
}

/// An empty folder under the build's own, kept after the test for a look at what went wrong.
pub fn empty_folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    match fs::remove_dir_all(&folder) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => panic!("{}: {error}", folder.display()),
        _ => fs::create_dir_all(&folder).expect("folder"),
    }
    folder
}

/// A file of the repository.
pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}
