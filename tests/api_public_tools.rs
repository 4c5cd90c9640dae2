//! The API as Schemathesis finds it, which we did not write: requests of all kinds made up from the OpenAPI document,
//! against a real site with a machine. Runs if the environment variable `HOLDFAST_PYTHON` names a Python that has
//! what `tests/record/requirements.txt` lists; says so if not, and fails where every test is required.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play people, who have clocks")]

#[path = "support/process.rs"]
mod process;
#[path = "support/required.rs"]
mod required;

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
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

/// The document as the site serves it to who has the token.
fn document(address: &str, token: &str) -> String {
    let mut stream = TcpStream::connect(address).expect("connects");
    let head = format!("GET /api/openapi.json HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n");
    write!(stream, "{head}Authorization: Bearer {token}\r\n\r\n").expect("sent");
    let mut text = String::new();
    stream.read_to_string(&mut text).expect("read");
    assert!(text.starts_with("HTTP/1.1 200"), "{text}");
    text.split_once("\r\n\r\n").expect("a body").1.to_owned()
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
        .arg("openapi.json")
        .args(["--url", &format!("http://{address}")])
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
    // All at once, from one address.
    let text = std::fs::read_to_string(process::repository("config/site.toml")).expect("a site file");
    let text = text.replace("requests_per_s = 50.0", "requests_per_s = 100000.0");
    std::fs::write(folder.join("site.toml"), text.replace("127.0.0.1:7447", "127.0.0.1:0")).expect("written");
    let mut command = Command::new(holdfast);
    command.args(["site", "--listen", "127.0.0.1:0", "--config"]).arg(folder.join("site.toml"));
    command.arg("--data").arg(&data).stdout(Stdio::piped()).stderr(Stdio::from(log));
    let mut site = process::Process::start(&mut command);
    let (address, endpoint) = site.addresses();
    let _machine = process::machine(holdfast, "walker-1", &endpoint, &folder.join("on-board"), "1");

    let path = folder.join("openapi.json");
    let text = document(&address, token.reveal());
    // It can find something: a document that promises another answer. First, for later it may have revoked its token.
    let mut wrong: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let responses = &mut wrong["paths"]["/api/v1/fleet"]["get"]["responses"];
    let good = responses.as_object_mut().and_then(|responses| responses.remove("200")).expect("documented");
    responses["202"] = good;
    std::fs::write(&path, wrong.to_string()).expect("written");
    let only = ["--include-path", "/api/v1/fleet"];
    let (found_nothing, said) = schemathesis(&python, &folder, &address, token.reveal(), &only);
    assert!(!found_nothing && said.contains("Undocumented"), "{said}");

    std::fs::write(&path, text).expect("written");
    let (found_nothing, said) = schemathesis(&python, &folder, &address, token.reveal(), &[]);
    let log = std::fs::read_to_string(folder.join("log")).expect("a log");
    assert!(found_nothing, "{said}\n{log}");
    assert!(!log.contains("panicked"), "{log}");
    let changes = accounts.changes(None, 1000).expect("the book");
    let made = changes.iter().filter(|(_, change)| change.who == "anna" && change.via == "token");
    assert!(made.count() > 20, "it was let in, and changed things: {said}");
    site.end();
    std::fs::remove_dir_all(&folder).expect("removed");
}
