//! The API as Schemathesis finds it, which we did not write: requests of all kinds made up from the OpenAPI document,
//! against a real site with a machine. Runs if the environment variable `HOLDFAST_PYTHON` names a Python that has
//! what `tests/record/requirements.txt` lists; says so if not, and fails where every test is required.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play people, who have clocks")]

#[path = "support/process.rs"]
mod process;
#[path = "support/required.rs"]
mod required;

use std::path::Path;
use std::process::{Command, Stdio};

use holdfast::accounts::{Accounts, Password, Role};
use holdfast::time::{Span, Stamp};

/// Says what it does not check, and why.
const SETTINGS: &str = "tests/api/schemathesis.toml";

fn now() -> Stamp {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).expect("after 1970");
    Stamp::from_nanos(i64::try_from(since.as_nanos()).expect("before 2262"))
}

/// Runs Schemathesis; what it says, and whether it found nothing.
fn schemathesis(
    python: &std::ffi::OsStr,
    folder: &Path,
    address: &str,
    token: &str,
    extra: &[&str],
) -> (bool, String) {
    let output = Command::new(python)
        .args(["-m", "schemathesis.cli", "--config-file"])
        .arg(process::repository(SETTINGS))
        .arg("run")
        .arg(format!("http://{address}/api/openapi.json"))
        .args(extra)
        .current_dir(folder)
        .env("HOLDFAST_TOKEN", token)
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .output()
        .expect("python runs");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.success(), text(&output.stdout) + &text(&output.stderr))
}

#[test]
fn schemathesis_finds_no_server_error_and_no_undocumented_answer() {
    let what = "a Python with the packages of tests/record/requirements.txt";
    let Some(python) = required::variable("HOLDFAST_PYTHON", what) else { return };
    let folder = std::env::temp_dir().join(format!("holdfast-schemathesis-{}", std::process::id()));
    let data = folder.join("data");
    std::fs::create_dir_all(&data).expect("a folder");
    let accounts = Accounts::of(&data).expect("none yet");
    let password = Password::new("correct horse battery".to_owned());
    accounts.add_user("anna", Role::Admin, &password, now()).expect("added");
    let end = now() + Span::from_seconds(86_400.0);
    let (_, token) = accounts.add_token("anna", "for tests", Role::Admin, end, now()).expect("added");

    let holdfast = Path::new(env!("CARGO_BIN_EXE_holdfast"));
    let log = std::fs::File::create(folder.join("log")).expect("a log");
    let mut site = process::site(holdfast, &folder, &data, Stdio::from(log));
    let (address, endpoint) = site.addresses();
    let _machine = process::machine(holdfast, "walker-1", &endpoint, &folder.join("on-board"), "1");

    let (found_nothing, said) = schemathesis(&python, &folder, &address, token.reveal(), &[]);
    let log = std::fs::read_to_string(folder.join("log")).expect("a log");
    assert!(found_nothing, "{said}\n{log}");
    assert!(!log.contains("panicked"), "{log}");
    // It can find something: nobody who is known gets what the document promises to somebody.
    let only = [
        "--include-path",
        "/api/v1/fleet",
        "--checks",
        "positive_data_acceptance",
        "--phases",
        "examples,coverage,fuzzing",
    ];
    let (found_nothing, said) = schemathesis(&python, &folder, &address, "nonsense", &only);
    assert!(!found_nothing, "{said}");
    site.end();
    std::fs::remove_dir_all(&folder).expect("removed");
}
