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
    assert_eq!(code, 1, "{errors}");
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
