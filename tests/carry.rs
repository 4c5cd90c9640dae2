//! Import and export by the command line, without anybody else's tools.

#[path = "support/command.rs"]
mod command;
#[path = "carry/recording.rs"]
mod recording;

use std::fs;
use std::path::{Path, PathBuf};

use command::{Ended, empty_folder, estimate, holdfast, repository};

const SENSORS: [&str; 6] = ["imu", "base_imu", "gnss_left", "gnss_right", "lidar_odometry", "cabin_turn"];

fn run(arguments: &[&str]) -> Ended {
    holdfast(arguments)
}

fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// The recording as if another program had written it: a bag with our topics.
fn as_bag(recording: &Path, bag: &Path) {
    let mut bytes = fs::read(recording).expect("recording");
    let name = b"holdfast ";
    let at = bytes.windows(name.len()).position(|found| found == name).expect("its writer");
    bytes[at..at + name.len()].copy_from_slice(b"somebody ");
    fs::write(bag, bytes).expect("written");
}

/// The names in a folder of what is not yet whole.
fn unfinished(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).expect("folder").map(|entry| entry.expect("entry").file_name());
    let names = entries.map(|name| name.to_string_lossy().into_owned());
    names.filter(|name| name.contains("part") || name.contains("scratch")).collect()
}

fn roof() -> PathBuf {
    repository("config/machines/simulated-roof.toml")
}

/// Logs of both machines of a scenario of `seconds`.
fn logs(folder: &Path, seconds: u32) -> PathBuf {
    recording::simulate(folder, seconds);
    folder.join("logs")
}

#[test]
fn log_folder_goes_into_a_recording_and_back_to_the_bit_and_both_estimate_the_same() {
    let folder = empty_folder("carry-round");
    let log = logs(&folder, 20).join("walker-1");
    let (mcap, back) = (folder.join("sub/a.mcap"), folder.join("back"));
    let machine = roof();
    let ended = run(&["import", text(&log), "--machine", text(&machine), "--out", text(&mcap)]);
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
    assert!(ended.stdout.contains("readings of walker-1, 20.0 s"), "{}", ended.stdout);
    let ended = run(&["import", text(&mcap), "--machine", text(&machine), "--out", text(&back)]);
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
    for sensor in SENSORS {
        let file = format!("{sensor}.csv");
        assert!(
            fs::read(log.join(&file)).expect("log") == fs::read(back.join(&file)).expect("back"),
            "{file}"
        );
    }
    let outs = [folder.join("of-log"), folder.join("of-mcap")];
    assert_eq!(estimate(&log, &machine, &outs[0]).code, 0);
    assert_eq!(estimate(&mcap, &machine, &outs[1]).code, 0);
    let [left, right] = outs.map(|out| fs::read(out.join("world.tum")).expect("poses"));
    assert!(left == right && !left.is_empty());
}

#[test]
fn what_cannot_be_imported_is_said_and_leaves_nothing_behind() {
    let folder = empty_folder("carry-refused");
    let log = logs(&folder, 5).join("walker-1");
    let machine = roof();
    let out = folder.join("out.mcap");
    let import = |source: &Path, machine: &Path| {
        let ended = run(&["import", text(source), "--machine", text(machine), "--out", text(&out)]);
        assert!(!out.exists(), "{}", ended.stderr);
        (ended.code, ended.stderr)
    };
    let (code, errors) = import(&folder.join("nowhere"), &machine);
    assert_eq!(code, 2, "{errors}");
    let (code, errors) = import(&folder, &machine);
    assert_eq!(code, 2, "{errors}");
    assert!(errors.contains("is neither a log folder (imu.csv, ...) nor a ROS 2 bag"), "{errors}");
    let not_mcap = folder.join("x.mcap");
    fs::write(&not_mcap, "hello, this is no MCAP file").expect("written");
    let (code, errors) = import(&not_mcap, &machine);
    assert_eq!((code, errors.contains("is not an MCAP file")), (1, true), "{errors}");
    let bad = folder.join("bad.toml");
    fs::write(&bad, fs::read_to_string(&machine).expect("machine") + "[topics]\nimu = \"imu\"\n")
        .expect("written");
    assert_eq!(import(&log, &bad).0, 2);
    // Of another machine.
    let other = folder.join("other.mcap");
    let ended = run(&["import", text(&log), "--machine", text(&machine), "--out", text(&other)]);
    assert_eq!(ended.code, 0);
    let floor = repository("config/machines/simulated-floor.toml");
    let (code, errors) = import(&other, &floor);
    assert_eq!(
        (code, errors.contains("has no readings of walker-2, but topics of: walker-1")),
        (2, true),
        "{errors}"
    );
    // Onto itself.
    let ended = run(&["import", text(&log), "--machine", text(&machine), "--out", text(&log)]);
    assert_eq!((ended.code, ended.stderr.contains("would be overwritten")), (2, true), "{}", ended.stderr);
    assert!(log.join("imu.csv").exists());
    // A file that is torn off.
    let bytes = fs::read(&other).expect("recording");
    let torn = folder.join("torn.mcap");
    fs::write(&torn, &bytes[..bytes.len() * 2 / 3]).expect("written");
    let ended =
        run(&["import", text(&torn), "--machine", text(&machine), "--out", text(&folder.join("of-torn"))]);
    assert_eq!(ended.code, 3, "{}", ended.stderr);
    assert!(ended.stderr.contains("torn.mcap: bytes that are torn off or damaged: "), "{}", ended.stderr);
    assert!(folder.join("of-torn/imu.csv").exists());
}

#[test]
fn numbers_that_cannot_be_measured_and_stamps_that_go_back_are_handed_on_and_told() {
    let folder = empty_folder("carry-told");
    let log = folder.join("log");
    fs::create_dir_all(&log).expect("made");
    let rows = "t,gx,gy,gz,ax,ay,az\n1.00,0,0,0,0,0,9.8\n1.01,0,nan,0,0,0,9.8\n0.50,0,0,0,0,0,9.8\n1.02,0,0,0,0,0,9.8\n";
    fs::write(log.join("imu.csv"), rows).expect("written");
    let (mcap, machine) = (folder.join("a.mcap"), roof());
    let ended = run(&["import", text(&log), "--machine", text(&machine), "--out", text(&mcap)]);
    assert_eq!(ended.code, 3);
    let told: Vec<&str> = ended.stderr.lines().collect();
    assert_eq!(told.len(), 2, "{}", ended.stderr);
    assert!(
        told[0]
            .starts_with("imu: readings that cannot be a measurement: 1, first: reading 2 at 1.010000000: ")
    );
    assert_eq!(
        told[1],
        "imu: stamps that do not come after the one before: 1, first: reading 3: 0.500000000 after 1.010000000"
    );
    let back = folder.join("back");
    let ended = run(&["import", text(&mcap), "--machine", text(&machine), "--out", text(&back)]);
    assert_eq!(ended.code, 3);
    let rows = fs::read_to_string(back.join("imu.csv")).expect("back");
    assert_eq!(rows.lines().count(), 5);
    assert!(rows.lines().nth(2).is_some_and(|row| row.contains(",0,NaN,0,")), "{rows}");
}

#[test]
fn session_is_exported_by_machine_with_origin_and_outages() {
    let folder = empty_folder("carry-session");
    let session = recording::session(&folder);
    let out = |name: &str| folder.join(name);
    let export = |arguments: &[&str]| {
        let mut all = vec!["export"];
        all.extend(arguments);
        run(&all)
    };
    let session_name = text(&session.folder);
    // A TUM file takes one machine.
    let ended = export(&[session_name, "--out", text(&out("a.tum"))]);
    assert_eq!(ended.code, 2, "{}", ended.stderr);
    assert!(ended.stderr.contains("choose with --machine: walker-1, walker-2"), "{}", ended.stderr);
    assert!(!out("a.tum").exists());
    for machine in ["walker-1", "walker-2"] {
        let tum = out(&format!("{machine}.tum"));
        let ended = export(&[session_name, "--machine", machine, "--out", text(&tum)]);
        assert_eq!(ended.code, 0, "{}", ended.stderr);
        // What went into the recording in the wrong order comes out in the right one, to the bit.
        assert!(fs::read_to_string(&tum).expect("tum") == session.tum[machine], "{machine}");
    }
    let ended = export(&[session_name, "--machine", "walker-3", "--out", text(&out("c.tum"))]);
    assert_eq!((ended.code, ended.stderr.contains("has no machine walker-3")), (2, true), "{}", ended.stderr);
    // Two tracks, from the origin in the recording; the same again, for the same input gives the same bytes.
    let geojson = |name: &str| {
        let ended = export(&[session_name, "--out", text(&out(name))]);
        assert_eq!(ended.code, 0, "{}", ended.stderr);
        assert!(ended.stderr.contains("of 2 tracks as geojson"), "{}", ended.stderr);
        fs::read_to_string(out(name)).expect("written")
    };
    let file = geojson("a.geojson");
    assert!(file == geojson("b.geojson"));
    let json: serde_json::Value = serde_json::from_str(&file).expect("JSON");
    let features = json["features"].as_array().expect("features");
    let outage = |machine: &str| {
        features
            .iter()
            .filter(|feature| feature["properties"]["machine"] == machine)
            .filter(|feature| feature["properties"]["gnss"] == "outage")
            .count()
    };
    assert_eq!((outage("walker-1"), outage("walker-2")), (1, 1));
    // Thinned, on stdout.
    let ended = export(&[session_name, "--rate", "1", "--format", "gpx", "--out", "-"]);
    assert_eq!(ended.code, 0);
    let points = ended.stdout.matches("<trkpt").count();
    assert!((40..=90).contains(&points), "{points}");
    // The odom frame is not tied to the earth.
    let ended = export(&[session_name, "--frame", "odom", "--out", text(&out("o.kml"))]);
    assert_eq!(ended.code, 2);
    // A torn file: what is whole is written, and the loss told.
    let torn = out("torn.mcap");
    let bytes = fs::read(&session.files[0]).expect("recording");
    fs::write(&torn, &bytes[..bytes.len() / 2]).expect("written");
    let ended = export(&[text(&torn), "--out", text(&out("torn.csv"))]);
    assert_eq!(ended.code, 3, "{}", ended.stderr);
    assert!(ended.stderr.contains("bytes that are torn off or damaged"), "{}", ended.stderr);
    let left: Vec<String> = fs::read_dir(&folder)
        .expect("folder")
        .map(|entry| entry.expect("entry").file_name().to_string_lossy().into_owned())
        .filter(|name| name.contains(".part") || name.contains("scratch"))
        .collect();
    assert_eq!(left, Vec::<String>::new());
}

#[test]
fn estimate_and_tum_are_exported_and_what_is_missing_is_said() {
    let folder = empty_folder("carry-estimate");
    let log = logs(&folder, 20).join("walker-1");
    let (machine, estimated) = (roof(), folder.join("estimate"));
    assert_eq!(estimate(&log, &machine, &estimated).code, 0);
    let tum = folder.join("a.tum");
    let ended = run(&["export", text(&estimated), "--out", text(&tum)]);
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    assert!(fs::read(&tum).expect("tum") == fs::read(estimated.join("world.tum")).expect("world"));
    let gpx = folder.join("a.gpx");
    let ended = run(&["export", text(&tum), "--out", text(&gpx)]);
    assert_eq!((ended.code, ended.stderr.contains("give --machine-file")), (2, true), "{}", ended.stderr);
    let ended = run(&["export", text(&tum), "--machine-file", text(&machine), "--out", text(&gpx)]);
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    assert!(fs::read_to_string(&gpx).expect("gpx").contains("<name>walker-1</name>"));
    let ended = run(&["export", text(&tum), "--out", text(&folder.join("what"))]);
    assert_eq!((ended.code, ended.stderr.contains("say with --format")), (2, true), "{}", ended.stderr);
    let ended = run(&["export", text(&tum), "--out", text(&tum)]);
    assert_eq!((ended.code, ended.stderr.contains("would be overwritten")), (2, true), "{}", ended.stderr);
    // Readings are no poses.
    let mcap = folder.join("readings.mcap");
    run(&["import", text(&log), "--machine", text(&machine), "--out", text(&mcap)]);
    let ended = run(&["export", text(&mcap), "--out", text(&folder.join("r.csv"))]);
    assert_eq!((ended.code, ended.stderr.contains("has no poses")), (1, true), "{}", ended.stderr);
    // A bad line: named, and no file is left.
    let bad = folder.join("bad.tum");
    fs::write(&bad, "1 0 0 0 0 0 0 1\n2 0 nan 0 0 0 0 1\n").expect("written");
    let csv = folder.join("bad.csv");
    let ended = run(&["export", text(&bad), "--out", text(&csv)]);
    assert_eq!(
        (ended.code, ended.stderr.contains("bad.tum:2:5: NaN cannot be")),
        (1, true),
        "{}",
        ended.stderr
    );
    assert!(!csv.exists());
}

#[test]
fn import_refuses_to_write_over_what_it_reads() {
    let folder = empty_folder("carry-onto-itself");
    let log = logs(&folder, 5).join("walker-1");
    let machine = roof();
    let recording = folder.join("a.mcap");
    let ended = run(&["import", text(&log), "--machine", text(&machine), "--out", text(&recording)]);
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    let [bag, session] = ["bag", "session"].map(|name| folder.join(name));
    for into in [&bag, &session] {
        fs::create_dir_all(into).expect("made");
    }
    as_bag(&recording, &bag.join("bag_0.mcap"));
    fs::copy(&recording, session.join("s-0000.mcap")).expect("copied");
    let linked = folder.join("linked");
    fs::create_dir_all(&linked).expect("made");
    std::os::unix::fs::symlink(log.join("imu.csv"), linked.join("imu.csv")).expect("linked");
    for (source, out, file) in [
        (&bag, bag.join("bag_0.mcap"), bag.join("bag_0.mcap")),
        (&session, session.join("s-0000.mcap"), session.join("s-0000.mcap")),
        (&log, linked, log.join("imu.csv")),
    ] {
        let before = fs::read(&file).expect("there");
        let ended = run(&["import", text(source), "--machine", text(&machine), "--out", text(&out)]);
        assert_eq!(
            (ended.code, ended.stderr.contains("would be overwritten")),
            (2, true),
            "{}",
            ended.stderr
        );
        assert!(fs::read(&file).expect("there") == before, "{}", file.display());
    }
}

/// A disk that is full after 64 blocks.
#[test]
fn import_that_fails_midway_leaves_what_was_there() {
    let folder = empty_folder("carry-midway");
    let log = logs(&folder, 20).join("walker-1");
    let machine = roof();
    let recording = folder.join("a.mcap");
    run(&["import", text(&log), "--machine", text(&machine), "--out", text(&recording)]);
    let bag = folder.join("bag.mcap");
    as_bag(&recording, &bag);
    let out = folder.join("out.mcap");
    fs::write(&out, "precious").expect("written");
    let csv = folder.join("csv");
    fs::create_dir_all(&csv).expect("made");
    fs::write(csv.join("imu.csv"), "precious").expect("written");
    fs::write(csv.join("cabin_turn.csv"), "precious").expect("written");
    for out in [&out, &csv] {
        for source in [&log, &recording, &bag] {
            let ended = std::process::Command::new("sh")
                .args(["-c", "trap '' XFSZ; ulimit -f 64; exec \"$@\"", "sh", env!("CARGO_BIN_EXE_holdfast")])
                .args(["import", text(source), "--machine", text(&machine), "--out", text(out)])
                .output()
                .expect("sh runs");
            assert_eq!(ended.status.code(), Some(1), "{}", String::from_utf8_lossy(&ended.stderr));
        }
    }
    for file in [&out, &csv.join("imu.csv"), &csv.join("cabin_turn.csv")] {
        assert_eq!(fs::read(file).expect("there"), b"precious", "{}", file.display());
    }
    assert_eq!([unfinished(&folder), unfinished(&csv)], [const { Vec::<String>::new() }; 2]);
    let fresh = folder.join("fresh.mcap");
    for out in [&out, &csv, &fresh] {
        let ended = run(&["import", text(&bag), "--machine", text(&machine), "--out", text(out)]);
        assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
    }
    assert!(fs::read(&out).expect("there") == fs::read(&fresh).expect("there"));
    assert!(fs::read(csv.join("imu.csv")).expect("there") == fs::read(log.join("imu.csv")).expect("there"));
}

#[test]
fn estimate_is_not_overwritten_by_its_export_and_odom_is_the_chassis_without_places() {
    let folder = empty_folder("carry-odom");
    let log = logs(&folder, 20).join("walker-1");
    let (machine, estimated) = (roof(), folder.join("estimate"));
    assert_eq!(estimate(&log, &machine, &estimated).code, 0);
    let files: Vec<PathBuf> =
        fs::read_dir(&estimated).expect("a folder").map(|entry| entry.expect("an entry").path()).collect();
    assert!(files.len() >= 7, "{files:?}");
    for out in files {
        let before = fs::read(&out).expect("there");
        let ended = run(&["export", text(&estimated), "--format", "csv", "--out", text(&out)]);
        assert_eq!(
            (ended.code, ended.stderr.contains("would be overwritten")),
            (2, true),
            "{}",
            ended.stderr
        );
        assert!(fs::read(&out).expect("there") == before, "{}", out.display());
    }
    let file = folder.join("machine.toml");
    fs::copy(&machine, &file).expect("copied");
    let arguments = ["export", text(&estimated), "--machine-file", text(&file), "--format", "csv", "--out"];
    let ended = run(&[&arguments[..], &[text(&file)]].concat());
    assert_eq!((ended.code, ended.stderr.contains("would be overwritten")), (2, true), "{}", ended.stderr);
    let odom = |name: &str, more: &[&str]| {
        let out = folder.join(name);
        let arguments = ["export", text(&estimated), "--frame", "odom", "--out", text(&out)];
        let ended = run(&[&arguments[..], more].concat());
        assert_eq!(ended.code, 0, "{}", ended.stderr);
        fs::read_to_string(&out).expect("written")
    };
    let of = |name: &str| fs::read_to_string(estimated.join(name)).expect("there");
    assert_ne!(of("base_odom.tum"), of("odom.tum"));
    assert!(odom("a.tum", &[]) == of("base_odom.tum"));
    // Nor does the machine file give places to what is not tied to the earth.
    for more in [&[][..], &["--machine-file", text(&file)]] {
        let csv = odom("a.csv", more);
        assert_eq!(csv.lines().next(), Some("machine,t,x,y,z,qx,qy,qz,qw,gnss"));
        assert!(csv.lines().all(|line| line.split(',').count() == 10));
    }
    fs::write(estimated.join("base_odom.tum"), "").expect("written");
    assert!(odom("b.tum", &[]) == of("odom.tum"));
}

#[test]
fn pose_nowhere_on_the_earth_is_left_out_and_told() {
    let folder = empty_folder("carry-nowhere");
    let (tum, out) = (folder.join("a.tum"), folder.join("b.tum"));
    fs::write(&tum, "1.000000000 0 0 0 0 0 0 1\n2.000000000 1e300 0 0 0 0 0 1\n").expect("written");
    let ended = run(&["export", text(&tum), "--out", text(&out)]);
    assert_eq!(ended.code, 3, "{}", ended.stderr);
    assert!(ended.stderr.contains("nowhere on the earth: 1, first: at 2.000000000"), "{}", ended.stderr);
    assert_eq!(fs::read_to_string(&out).expect("written"), "1.000000000 0 0 0 0 0 0 1\n");
}

#[test]
fn export_goes_through_links_and_pipes() {
    use std::os::unix::fs::{FileTypeExt as _, symlink};

    let folder = empty_folder("carry-special");
    let tum = folder.join("a.tum");
    fs::write(&tum, "1.000000000 0 0 0 0 0 0 1\n2.000000000 0 0 0 0 0 0 1\n").expect("written");
    let export = |out: &Path| run(&["export", text(&tum), "--format", "tum", "--out", text(out)]);
    let [pipe, link, real] = ["pipe", "link", "real"].map(|name| folder.join(name));
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo").success());
    #[expect(clippy::disallowed_methods, reason = "somebody must read the pipe meanwhile")]
    let reader = std::thread::spawn({
        let pipe = pipe.clone();
        move || fs::read(pipe)
    });
    let ended = export(&pipe);
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    assert!(fs::metadata(&pipe).expect("there").file_type().is_fifo());
    assert!(reader.join().expect("read").expect("read") == fs::read(&tum).expect("there"));
    fs::write(&real, "old").expect("written");
    symlink("real", &link).expect("linked");
    assert_eq!(export(&link).code, 0);
    assert!(link.is_symlink() && fs::read(&real).expect("there") == fs::read(&tum).expect("there"));
    // To stdout by its name, which the system makes a link.
    let ended = export(Path::new("/dev/stdout"));
    assert_eq!((ended.code, ended.stdout.into_bytes()), (0, fs::read(&tum).expect("there")));
    assert_eq!(unfinished(&folder), Vec::<String>::new());
}

#[test]
fn session_of_several_files_is_imported_and_estimated_as_the_machine_had_it() {
    let folder = empty_folder("carry-several");
    let session = repository("tests/replay/restarts");
    let machine = repository("tests/replay/yard-2.toml");
    let files = holdfast::record::files_of(&session).expect("files");
    assert_eq!(files.len(), 2);
    let csv = folder.join("csv");
    let import = |sources: &[&Path], out: &Path| {
        let mut arguments = vec!["import"];
        arguments.extend(sources.iter().map(|path| text(path)));
        run(&[&arguments[..], &["--machine", text(&machine), "--out", text(out)]].concat())
    };
    let ended = import(&[&session], &csv);
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
    // Each once, in the order of the machine, also those that came after the site was back.
    let mut sent = std::collections::BTreeMap::new();
    let mut by_file = Vec::new();
    for file in &files {
        for message in
            holdfast::record::read_messages(file).expect("opens").map(|message| message.expect("reads"))
        {
            if message.machine == "yard-2" && message.topic.name() == "sensor/imu" {
                by_file.push(message.sent);
                sent.insert((message.sent, message.boot, message.sequence), ());
            }
        }
    }
    assert!(!by_file.is_sorted(), "nothing of it came late");
    let rows = fs::read_to_string(csv.join("imu.csv")).expect("imu");
    let arrivals: Vec<String> =
        rows.lines().skip(1).map(|row| row.split(',').next().expect("a field").to_owned()).collect();
    assert_eq!(arrivals, sent.keys().map(|(sent, ..)| sent.to_string()).collect::<Vec<_>>());
    // Named one by one, backward; then as one recording; each estimates the same.
    let one = folder.join("one.mcap");
    let ended = import(&[&files[1], &files[0]], &one);
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
    let poses = [&session, &one].map(|log| {
        let out = folder.join("estimate");
        let ended = estimate(log, &machine, &out);
        assert_eq!(ended.code, 0, "{}", ended.stderr);
        fs::read(out.join("world.tum")).expect("poses")
    });
    assert!(poses[0] == poses[1] && !poses[0].is_empty());
    // What does not belong together is refused in words.
    let mixed = folder.join("mixed");
    fs::create_dir_all(&mixed).expect("made");
    fs::copy(&files[0], mixed.join("ours.mcap")).expect("copied");
    as_bag(&files[0], &mixed.join("theirs.mcap"));
    let ended = import(&[&mixed], &folder.join("none"));
    assert_eq!(ended.code, 1, "{}", ended.stderr);
    let told = "holds a recording of holdfast (ours.mcap) and another's (theirs.mcap)";
    assert!(ended.stderr.contains(told), "{}", ended.stderr);
    let ended = import(&[&files[0], &mixed.join("theirs.mcap")], &folder.join("none"));
    assert_eq!((ended.code, ended.stderr.contains("must all be recordings of holdfast")), (1, true));
    let ended = estimate(&mixed.join("theirs.mcap"), &machine, &folder.join("none"));
    assert_eq!((ended.code, ended.stderr.contains("is a ROS 2 bag")), (2, true), "{}", ended.stderr);
    let ended = estimate(&session, &roof(), &folder.join("none"));
    assert_eq!(
        (ended.code, ended.stderr.contains("has no readings of walker-1")),
        (2, true),
        "{}",
        ended.stderr
    );
    assert!(!folder.join("none").exists());
}
