//! Holds the table of rooms in `src/README.md` and the code against each other: who may import whom, who may
//! use which crate, and where the world (clocks, files, sockets, threads) may be touched.
//!
//! Reads the source as text: comments, strings and what is compiled for unit tests only are left out. Every
//! path that starts at `crate`, at `super` past the own room, at a dependency of `Cargo.toml` or at a guarded
//! part of `std` counts, whether it stands in a `use` or elsewhere.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

#[path = "layering/paths.rs"]
mod paths;

use paths::{CodePath, code_paths, test_only_modules, without_comments_and_strings, without_tests};

/// Parts of `std` that touch the world; a room that uses one says so in the table.
const GUARDED_STD: [&str; 7] = ["env", "fs", "net", "os", "process", "thread", "time"];
/// What only shells may use, whatever the table says.
const SHELLS_ONLY: [&str; 29] = [
    "argon2",
    "axum",
    "clap",
    "futures_util",
    "getrandom",
    "http_body_util",
    "hyper",
    "hyper_util",
    "indicatif",
    "lettre",
    "libc",
    "prometheus_client",
    "quick_xml",
    "ring",
    "rpassword",
    "rusqlite",
    "rust_embed",
    "std::env",
    "std::os",
    "std::process",
    "std::thread",
    "std::time",
    "tokio",
    "tokio_rustls",
    "tracing",
    "tracing_subscriber",
    "utoipa_swagger_ui",
    "webpki_roots",
    "zenoh",
];
/// Types of `std::net` that are values, not sockets.
const ADDRESSES: [&str; 6] = ["IpAddr", "Ipv4Addr", "Ipv6Addr", "SocketAddr", "SocketAddrV4", "SocketAddrV6"];
const SHELL_FLOOR: u32 = 5;
const HEADER: &str = "| Floor | Room | For | May import |";

/// One row of the table.
#[derive(Clone, Debug, PartialEq)]
struct Room {
    line: usize,
    floor: u32,
    name: String,
    may_import: Vec<String>,
}

/// One import: where, and of which room, crate or part of `std`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Import {
    file: String,
    line: usize,
    room: String,
    of: String,
}

/// A source file: its path under `src/`, and its text.
struct Source {
    path: String,
    text: String,
}

// ---------------------------------------------------------------------------------------------- the table

fn parse_table(readme: &str) -> Result<Vec<Room>, String> {
    let mut lines = readme.lines().enumerate().map(|(index, line)| (index + 1, line.trim()));
    lines.by_ref().find(|(_, line)| *line == HEADER).ok_or(format!("src/README.md has no line {HEADER}"))?;
    let mut rooms: Vec<Room> = Vec::new();
    for (line, row) in lines.skip(1).take_while(|(_, line)| line.starts_with('|')) {
        let wrong = |what: &str| format!("src/README.md:{line}: {what}");
        let cells: Vec<&str> = row.trim_matches('|').split('|').map(str::trim).collect();
        let [floor, room, purpose, may_import] = cells[..] else {
            return Err(wrong("a row has four cells"));
        };
        let floor = floor.parse().map_err(|_| wrong("the floor is no number"))?;
        let [name] = &quoted(room)[..] else { return Err(wrong("one room in backticks, please")) };
        if purpose.is_empty() {
            return Err(wrong("what is the room for?"));
        }
        if rooms.iter().any(|other| other.name == *name) {
            return Err(wrong(&format!("{name} stands twice in the table")));
        }
        rooms.push(Room { line, floor, name: name.clone(), may_import: quoted(may_import) });
    }
    Ok(rooms)
}

/// What stands in backticks.
fn quoted(cell: &str) -> Vec<String> {
    cell.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

// ------------------------------------------------------------------------------------------- the judgement

/// Everything that is wrong, one line each, with file and line.
fn faults(readme: &str, sources: &[Source], crates: &BTreeSet<String>) -> Vec<String> {
    let rooms = match parse_table(readme) {
        Ok(rooms) => rooms,
        Err(fault) => return vec![fault],
    };
    let table: BTreeMap<&str, &Room> = rooms.iter().map(|room| (room.name.as_str(), room)).collect();
    let there: BTreeSet<String> = sources.iter().filter_map(|source| room_of(&source.path)).collect();
    let mut faults = Vec::new();
    for room in there.iter().filter(|room| !table.contains_key(room.as_str())) {
        faults.push(format!("src/README.md: the room {room} is missing from the table"));
    }
    for room in &rooms {
        let mut fault = |what: String| faults.push(format!("src/README.md:{}: {what}", room.line));
        if !there.contains(&room.name) {
            fault(format!("there is no room {} in src", room.name));
        }
        for name in &room.may_import {
            match table.get(name.as_str()) {
                Some(other) if other.floor > room.floor => fault(format!("{} looks up to {name}", room.name)),
                Some(_) => {}
                None if SHELLS_ONLY.contains(&name.as_str()) && room.floor < SHELL_FLOOR => {
                    fault(format!("{name} is for shells, and {} is none", room.name));
                }
                None if crates.contains(name) => {}
                None if name.strip_prefix("std::").is_some_and(|part| GUARDED_STD.contains(&part)) => {}
                None => fault(format!("{} may import {name}, which is no room and no crate", room.name)),
            }
        }
    }
    faults.extend(circle(&rooms));

    let imports = imports(sources, crates);
    let mut used: BTreeSet<(&str, &str)> = BTreeSet::new();
    for import in &imports {
        let Import { file, line, room, of } = import;
        let Some(own) = table.get(room.as_str()) else { continue };
        used.insert((room, of));
        if let Some(other) = table.get(of.as_str())
            && other.floor > own.floor
        {
            let floors = format!("floor {} to floor {}", own.floor, other.floor);
            faults.push(format!("src/{file}:{line}: {room} looks up from {floors}: {of}"));
        } else if !own.may_import.contains(of) {
            faults.push(format!("src/{file}:{line}: {room} imports {of}, which its row does not allow"));
        }
    }
    for room in &rooms {
        for name in room.may_import.iter().filter(|name| !used.contains(&(&room.name, name.as_str()))) {
            let Room { line, name: own, .. } = room;
            faults.push(format!("src/README.md:{line}: {own} may import {name}, but never does"));
        }
    }
    faults
}

/// Rooms of one floor that name each other in a circle.
fn circle(rooms: &[Room]) -> Option<String> {
    let mut left: Vec<&Room> = rooms.iter().collect();
    while let Some(free) = left
        .iter()
        .position(|room| !left.iter().any(|other| other != room && room.may_import.contains(&other.name)))
    {
        left.remove(free);
    }
    let names: Vec<&str> = left.iter().map(|room| room.name.as_str()).collect();
    (!names.is_empty()).then(|| format!("src/README.md: rooms import each other in a circle: {names:?}"))
}

// ------------------------------------------------------------------------------------------------ the code

/// The room of a file under `src/`; the roots of the crates are in none.
fn room_of(path: &str) -> Option<String> {
    let room = path.split('/').next().unwrap_or(path).trim_end_matches(".rs");
    (path.contains('/') || !["lib", "main"].contains(&room)).then(|| room.to_owned())
}

/// All imports of one room from elsewhere, what is compiled for tests only apart.
fn imports(sources: &[Source], crates: &BTreeSet<String>) -> Vec<Import> {
    let plain: Vec<(&Source, String)> =
        sources.iter().map(|source| (source, without_comments_and_strings(&source.text))).collect();
    let tests: BTreeSet<Vec<String>> = plain
        .iter()
        .flat_map(|(source, text)| {
            let file = module_of(&source.path);
            test_only_modules(text).into_iter().map(move |name| [file.clone(), vec![name]].concat())
        })
        .collect();
    let is_test = |path: &str| {
        let module = module_of(path);
        tests.iter().any(|test| module.starts_with(test))
    };
    let mut found = Vec::new();
    for (source, text) in plain.iter().filter(|(source, _)| !is_test(&source.path)) {
        let Some(room) = room_of(&source.path) else { continue };
        for path in code_paths(&without_tests(text)) {
            if let Some(of) = target(&source.path, &path, crates)
                && of != room
            {
                found.push(Import { file: source.path.clone(), line: path.line, room: room.clone(), of });
            }
        }
    }
    found.sort();
    found.dedup();
    found
}

/// The module of a file: `wire/keys.rs` is wire, keys; `wire/mod.rs` is wire.
fn module_of(path: &str) -> Vec<String> {
    let mut parts: Vec<String> = path.trim_end_matches(".rs").split('/').map(str::to_owned).collect();
    if parts.last().is_some_and(|last| last == "mod") || ["lib.rs", "main.rs"].contains(&path) {
        parts.pop();
    }
    parts
}

/// What a path names: a room, a crate, or a guarded part of `std`.
fn target(file: &str, path: &CodePath, crates: &BTreeSet<String>) -> Option<String> {
    let part = |index: usize| path.parts.get(index).map(String::as_str);
    match part(0)? {
        "crate" => part(1).map(str::to_owned),
        "super" => {
            let ups = path.parts.iter().take_while(|part| *part == "super").count();
            let at_root = module_of(file).len() + path.inner_modules == ups;
            at_root.then(|| part(ups).map(str::to_owned)).flatten()
        }
        "std" => {
            let guarded = part(1).filter(|part| GUARDED_STD.contains(part))?;
            let is_value = guarded == "net" && part(2).is_some_and(|name| ADDRESSES.contains(&name));
            (!is_value).then(|| format!("std::{guarded}"))
        }
        name => crates.contains(name).then(|| name.to_owned()),
    }
}

/// The crates that `Cargo.toml` names as dependencies, tests' own apart, as the code writes them.
fn crates_of(manifest: &str) -> BTreeSet<String> {
    let manifest: toml::Table = manifest.parse().expect("Cargo.toml is TOML");
    let dependencies = manifest["dependencies"].as_table().expect("a table");
    dependencies.keys().map(|name| name.replace('-', "_")).collect()
}

fn read_sources(folder: &Path, under: &str, sources: &mut Vec<Source>) {
    let mut entries: Vec<_> =
        std::fs::read_dir(folder).expect("src").map(|entry| entry.expect("entry").path()).collect();
    entries.sort();
    for entry in entries {
        let name = entry.file_name().expect("name").to_string_lossy().into_owned();
        let path = format!("{under}{name}");
        if entry.is_dir() {
            read_sources(&entry, &format!("{path}/"), sources);
        } else if name.ends_with(".rs") {
            sources.push(Source { path, text: std::fs::read_to_string(&entry).expect("source") });
        }
    }
}

// ----------------------------------------------------------------------------------------------- the tests

#[test]
fn the_table_of_rooms_tells_the_truth() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let readme = std::fs::read_to_string(root.join("src/README.md")).expect("src/README.md");
    let manifest = std::fs::read_to_string(root.join("Cargo.toml")).expect("Cargo.toml");
    let mut sources = Vec::new();
    read_sources(&root.join("src"), "", &mut sources);
    let faults = faults(&readme, &sources, &crates_of(&manifest));
    assert!(faults.is_empty(), "{} faults:\n{}", faults.len(), faults.join("\n"));
}

const SMALL_TABLE: &str = "\
# A small house
| Floor | Room | For | May import |
|---|---|---|---|
| 0 | `time` | Stamps. | |
| 0 | `lie` | Groups. | `time` |
| 2 | `fleet` | The site as a value. | `time`, `serde` |
| 5 | `site` | The server. | `fleet`, `zenoh`, `std::net` |
";

fn small_house() -> Vec<Source> {
    [
        ("lib.rs", "pub mod time;\npub mod lie;\nuse crate::site::main;\n"),
        ("time.rs", "/// As [`crate::site`] needs it.\npub struct Stamp;\n"),
        ("lie/mod.rs", "mod so3;\nuse crate::time::Stamp;\n"),
        ("lie/so3.rs", "use super::Stamp;\nuse super::super::time as t;\n"),
        ("fleet/mod.rs", "use {crate::time::Stamp, serde::Serialize};\n#[cfg(test)]\nmod tests;\n"),
        ("fleet/tests.rs", "use crate::site::Server;\nuse zenoh::Session;\n"),
        (
            "site/mod.rs",
            "use crate::fleet;\nuse std::{io, net::TcpListener};\nfn f() { zenoh::open(\"crate::lie::x\"); }\n",
        ),
    ]
    .map(|(path, text)| Source { path: path.to_owned(), text: text.to_owned() })
    .into()
}

/// What the checker says of the small house with one file changed.
fn judge(table: &str, path: &str, text: &str) -> Vec<String> {
    let crates: BTreeSet<String> = ["serde", "tokio", "zenoh"].map(str::to_owned).into();
    let mut house = small_house();
    house.retain(|source| source.path != path);
    house.push(Source { path: path.to_owned(), text: text.to_owned() });
    faults(table, &house, &crates)
}

#[test]
fn a_good_house_has_no_faults() {
    assert_eq!(judge(SMALL_TABLE, "lib.rs", ""), Vec::<String>::new());
}

#[test]
fn every_kind_of_bad_import_is_found_with_file_and_line() {
    let cases = [
        (
            "time.rs",
            "\nuse crate::fleet::Fleet;",
            "src/time.rs:2: time looks up from floor 0 to floor 2: fleet",
        ),
        ("time.rs", "fn f() { crate::lie::exp(); }", "src/time.rs:1: time imports lie, which"),
        ("time.rs", "use super::{\n    lie::So3,\n};", "src/time.rs:2: time imports lie, which"),
        ("time.rs", "mod a { use super::super::lie; }", "src/time.rs:1: time imports lie, which"),
        ("time.rs", "use crate::{\n  lie,\n  site};", "src/time.rs:3: time looks up from floor 0 to floor 5"),
        ("time.rs", "use std::{fmt,\nthread};", "src/time.rs:2: time imports std::thread, which"),
        ("time.rs", "use std::net::{IpAddr, UdpSocket};", "src/time.rs:1: time imports std::net, which"),
        ("time.rs", "#[derive(serde::Serialize)] struct A;", "src/time.rs:1: time imports serde, which"),
        ("time.rs", "/* // */ use tokio::spawn; // \"", "src/time.rs:1: time imports tokio, which"),
        ("lie/so3.rs", "#[cfg(not(test))]\nuse crate::fleet;", "src/lie/so3.rs:2: lie looks up"),
        ("time.rs", "use crate::baselines::B;", "src/time.rs:1: time imports baselines, which"),
        ("shed/mod.rs", "", "src/README.md: the room shed is missing from the table"),
        ("fleet/mod.rs", "", "src/README.md:6: fleet may import serde, but never does"),
    ];
    for (path, text, expected) in cases {
        let faults = judge(SMALL_TABLE, path, text);
        assert!(faults.iter().any(|fault| fault.starts_with(expected)), "{text:?}: {faults:?}");
    }
}

#[test]
fn what_is_no_import_is_not_found() {
    let texts = [
        "//! See [`crate::site`].\n// use crate::site;\n/* use crate::site; /* nested */ */",
        "const A: &str = \"use crate::site::x; \\\" zenoh::open\"; const B: char = '\"';",
        "const A: &str = r#\"zenoh::open(\"\")\"#; fn f<'a>(x: &'a str) { self::g() }",
        "#[cfg(test)]\nmod tests {\n    use crate::site::Server;\n    mod inner { use zenoh::Session; }\n}",
        "mod row { use super::Stamp; }\nuse std::net::{IpAddr, SocketAddr};\npub(super) fn f() {}",
        "fn f(a: A) { a.zenoh::<u8>(); local::zenoh::open(); }",
    ];
    for text in texts {
        assert_eq!(judge(SMALL_TABLE, "time.rs", text), Vec::<String>::new(), "{text}");
    }
}

#[test]
fn a_table_that_does_not_fit_the_house_is_refused() {
    let cases = [
        (
            "| 0 | `lie` | Groups. | `time` |",
            "| 0 | `lie` | Groups. | `time` |\n| 1 | `attic` | Dust. | |",
            "no room attic",
        ),
        ("| 0 | `time` | Stamps. | |", "| 0 | `time` | Stamps. | `site` |", "time looks up to site"),
        ("| `time`, `serde` |", "| `time`, `serde`, `tokio` |", "tokio is for shells, and fleet is none"),
        ("| `time`, `serde` |", "| `time`, `serde`, `std::thread` |", "std::thread is for shells"),
        ("| 0 | `time` | Stamps. | |", "| 0 | `time` | Stamps. | `lie` |", "in a circle"),
        ("| 0 | `time` | Stamps. | |", "| 0 | `time` | | |", "what is the room for?"),
        ("| 0 | `time` | Stamps. | |\n", "", "the room time is missing"),
        ("| May import |", "| Imports |", "has no line | Floor"),
    ];
    for (from, to, expected) in cases {
        assert!(SMALL_TABLE.contains(from), "{from}");
        let faults = judge(&SMALL_TABLE.replace(from, to), "lib.rs", "");
        assert!(faults.iter().any(|fault| fault.contains(expected)), "{expected}: {faults:?}");
    }
}
