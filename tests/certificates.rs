//! The wire with certificates: machines that are who they say they are, and nobody else.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play machines, who have clocks")]

#[path = "support/authority.rs"]
mod authority;
#[path = "support/site.rs"]
mod support;

use std::path::PathBuf;
use std::time::Duration;

use holdfast::{config, link, site::Site};

use authority::{Authority, Signed};
use support::{Folder, Machine, PATIENCE, get};

/// Files as an end of the wire needs them.
fn files(folder: &Folder, believed: &Authority, signed_by: &Authority, name: &str) -> config::Tls {
    let Signed { certificate, key } = signed_by.sign(name, "127.0.0.1");
    let write = |end: &str, text: String| -> PathBuf {
        let own = signed_by.file.file_stem().and_then(|stem| stem.to_str()).expect("a name");
        let path = folder.0.join(format!("{own}-{name}.{end}"));
        std::fs::write(&path, text).expect("written");
        path
    };
    config::Tls {
        authority_file: believed.file.clone(),
        certificate_file: write("pem", certificate.pem()),
        key_file: write("key", key.serialize_pem()),
    }
}

fn dial(endpoint: &str, tls: Option<config::Tls>) -> zenoh::Config {
    let link = config::Link { connect: vec![endpoint.to_owned()], tls, ..config::Link::default() };
    link::machine_config(&link).expect("settings")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_machine_speaks_for_itself_alone_and_strangers_for_nobody() {
    let folder = Folder::new("certificates");
    let (authority, other) = (Authority::new(&folder.0, "authority"), Authority::new(&folder.0, "other"));
    let mut config = folder.config();
    config.zenoh = config::Zenoh {
        listen: vec!["tls/127.0.0.1:0".to_owned()],
        tls: Some(files(&folder, &authority, &authority, "site")),
        admitted: config::Admitted {
            machines: vec!["a".to_owned(), "b".to_owned()],
            listeners: vec!["office".to_owned()],
        },
        ..config::Zenoh::default()
    };
    let site = Site::start(&config).await.expect("starts");
    let endpoint = site.endpoints()[0].clone();
    assert!(endpoint.starts_with("tls/"), "{endpoint}");
    let with = |signed_by: &Authority, name: &str| {
        dial(&endpoint, Some(files(&folder, &authority, signed_by, name)))
    };

    // Those who are not who they say they are: another machine, one that nobody admitted, one whom a stranger has
    // signed, a listener that speaks, and one that shows nothing.
    let plain = dial(&endpoint.replace("tls/", "tcp/"), None);
    let mut impostors = [
        Machine::over(with(&authority, "b"), "a", 1).await,
        Machine::over(with(&authority, "mallory"), "mallory", 2).await,
        Machine::over(with(&other, "a"), "a", 3).await,
        Machine::over(with(&authority, "office"), "a", 4).await,
        Machine::over(plain, "a", 5).await,
    ];
    // What admitted ends say is heard, so that silence of the others is no broken link.
    let mut b = Machine::over(with(&authority, "b"), "b", 6).await;
    let is_online = async |id: &str| {
        let answer = get(site.address(), &format!("/api/v1/machines/{id}")).await;
        answer.status == 200 && answer.json()["presence"] == "online"
    };
    b.speak_until(async || {
        for impostor in &mut impostors {
            impostor.health().await;
            impostor.pose().await;
        }
        is_online("b").await
    })
    .await;
    for _ in 0..20 {
        for impostor in &mut impostors {
            impostor.health().await;
            impostor.pose().await;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    let fleet = get(site.address(), "/api/v1/fleet").await.json();
    let ids: Vec<_> = fleet["machines"].as_array().expect("machines").iter().map(|one| &one["id"]).collect();
    assert_eq!(ids, ["b"], "{fleet}");

    // A listener hears every machine. As a client: a peer would be told nothing by way of the site.
    let mut settings = with(&authority, "office");
    settings.insert_json5("mode", "\"client\"").expect("a known key");
    let office = link::open(settings).await.expect("opens");
    let heard = office.declare_subscriber("holdfast/quarry/**").await.expect("subscribes");
    let mut a = Machine::over(with(&authority, "a"), "a", 7).await;
    a.speak_until(async || is_online("a").await).await;
    let hears = async {
        loop {
            a.pose().await;
            b.pose().await;
            tokio::time::sleep(Duration::from_millis(20)).await;
            let keys: Vec<String> =
                heard.drain().map(|sample| sample.key_expr().as_str().to_owned()).collect();
            if keys.iter().any(|key| key == "holdfast/quarry/b/pose") {
                return;
            }
        }
    };
    tokio::time::timeout(PATIENCE, hears).await.expect("heard in time");
    office.close().await.expect("closes");
    site.stop().await;
}

#[test]
fn endpoints_without_certificates_beside_those_with_them_are_refused() {
    let text = |zenoh: &str| {
        format!(
            "id = \"quarry\"\n[world]\nlatitude_deg = 47.0\nlongitude_deg = 8.0\naltitude_m = 400.0\n[zenoh]\n{zenoh}"
        )
    };
    let tls = "[zenoh.tls]\nauthority_file = \"a\"\ncertificate_file = \"b\"\nkey_file = \"c\"\n";
    for (zenoh, why) in [
        (format!("listen = [\"tls/0.0.0.0:7447\", \"tcp/127.0.0.1:7447\"]\n{tls}"), "must begin with tls/"),
        ("listen = [\"tls/0.0.0.0:7447\"]\n".to_owned(), "[zenoh.tls]"),
        (format!("listen = [\"tls/0.0.0.0:7447\"]\n{tls}"), "zenoh.admitted.machines is empty"),
        ("admitted = { machines = [\"a\"] }\n".to_owned(), "zenoh.admitted means nothing"),
        (
            format!("admitted = {{ machines = [\"a\"], listeners = [\"a\"] }}\nlisten = []\n{tls}"),
            "zenoh.listen is empty",
        ),
        (
            format!(
                "admitted = {{ machines = [\"a\"], listeners = [\"a\"] }}\nlisten = [\"tls/0.0.0.0:1\"]\n{tls}"
            ),
            "zenoh.admitted.listeners has \"a\", which is admitted already",
        ),
    ] {
        let parsed = config::parse::<config::Site>(&text(&zenoh), std::path::Path::new("site.toml"));
        let message = parsed.expect_err("refused").to_string();
        assert!(message.contains(why), "{message}");
    }
    let good = text(&format!("listen = [\"tls/0.0.0.0:7447\"]\n{tls}[zenoh.admitted]\nmachines = [\"a\"]\n"));
    assert!(config::parse::<config::Site>(&good, std::path::Path::new("site.toml")).is_ok());
}
