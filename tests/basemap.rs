//! The picture of the ground that a site gives to its pages: from the site file to the bytes on the wire.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play people, who have clocks")]

#[path = "support/site.rs"]
mod support;

use std::path::{Path, PathBuf};

use holdfast::accounts::{Accounts, Password, Role};
use holdfast::config;
use holdfast::site::Site;
use holdfast::time::Span;
use serde_json::{Value, json};

use support::{Folder, exchange, get, now};

const PATH: &str = "/api/v1/basemap.pmtiles";

/// A file as the site wants it: a header, and after it `bytes` bytes of tiles that count up.
fn pmtiles(folder: &Folder, name: &str, kind: u8, bytes: usize) -> PathBuf {
    let mut file = vec![0; 127];
    file[..8].copy_from_slice(b"PMTiles\x03");
    for at in [8, 24, 40, 56] {
        file[at] = 127;
    }
    file[64..72].copy_from_slice(&(bytes as u64).to_le_bytes());
    (file[97], file[98], file[99], file[100], file[101]) = (2, 1, kind, 14, 20);
    file.extend((0..bytes).map(|index| (index % 251) as u8));
    let path = folder.0.join(name);
    std::fs::write(&path, file).expect("written");
    path
}

fn with_map(folder: &Folder, file: &Path, attribution: Option<&str>) -> config::Site {
    let mut config = folder.config();
    config.map.basemap_file = Some(file.to_owned());
    config.map.attribution = attribution.map(str::to_owned);
    config
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn basemap_is_given_whole_and_in_ranges_with_its_tag() {
    let folder = Folder::new("basemap");
    let file = pmtiles(&folder, "pit.pmtiles", 2, 700_000);
    let site = Site::start(&with_map(&folder, &file, Some("© The survey"))).await.expect("starts");
    let address = site.address();
    let whole = std::fs::read(&file).expect("read");

    let map = get(address, "/api/v1/map").await;
    assert_eq!((map.status, map.json()), (200, json!({ "basemap": { "attribution": "© The survey" } })));
    let answer = get(address, PATH).await;
    assert_eq!((answer.status, answer.header("content-type")), (200, "application/vnd.pmtiles"));
    assert_eq!((answer.header("accept-ranges"), answer.header("content-length")), ("bytes", "700127"));
    assert_eq!(answer.header("content-disposition"), "", "it is drawn, not kept");
    assert!(answer.body == whole);
    let tag = answer.header("etag").to_owned();
    assert!(tag.starts_with('"') && tag.len() > 10, "{tag}");

    for (range, first, end) in [
        ("bytes=0-16383", 0, 16_384),
        ("bytes=300000-600000", 300_000, 600_001),
        ("bytes=-5", 700_122, 700_127),
    ] {
        let part = exchange(address, "GET", PATH, &[("Range", range)]).await;
        assert_eq!((part.status, part.header("etag")), (206, tag.as_str()), "{range}");
        assert_eq!(part.header("content-range"), format!("bytes {first}-{}/700127", end - 1));
        assert!(part.body == whole[first..end], "{range}");
    }
    let outside = exchange(address, "GET", PATH, &[("Range", "bytes=700127-")]).await;
    assert_eq!((outside.status, outside.header("content-range")), (416, "bytes */700127"));
    assert_eq!(outside.json()["detail"], "the basemap has 700127 bytes");

    let head = exchange(address, "HEAD", PATH, &[]).await;
    assert_eq!((head.status, head.body.len()), (200, 0));
    assert_eq!((head.header("content-length"), head.header("etag")), ("700127", tag.as_str()));
    let known = exchange(address, "GET", PATH, &[("If-None-Match", &tag)]).await;
    assert_eq!((known.status, known.body.len()), (304, 0));

    // Another file in its place is another file, also for whoever goes on with the old one.
    pmtiles(&folder, "pit.pmtiles", 2, 600_000);
    let asked = [("If-Range", tag.as_str()), ("Range", "bytes=0-9")];
    let other = exchange(address, "GET", PATH, &asked).await;
    assert_eq!((other.status, other.body.len()), (200, 600_127));
    assert_ne!(other.header("etag"), tag);
    // And one that is gone is told, not hidden.
    std::fs::remove_file(&file).expect("removed");
    let gone = get(address, PATH).await;
    assert_eq!((gone.status, &gone.json()["detail"]), (500, &Value::from("the basemap cannot be read")));
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn site_without_basemap_says_so() {
    let folder = Folder::new("basemap-none");
    let site = Site::start(&folder.config()).await.expect("starts");
    assert_eq!(get(site.address(), "/api/v1/map").await.json(), json!({ "basemap": null }));
    for method in ["GET", "HEAD"] {
        let answer = exchange(site.address(), method, PATH, &[("Range", "bytes=0-9")]).await;
        assert_eq!((answer.status, answer.header("content-type")), (404, "application/problem+json"));
    }
    let detail = get(site.address(), PATH).await.json()["detail"].clone();
    assert_eq!(detail, "this site has no basemap: map.basemap_file is not in the site file");
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_may_look_sees_the_basemap_and_nobody_else() {
    let folder = Folder::new("basemap-roles");
    let accounts = Accounts::of(&folder.0).expect("none yet");
    let password = Password::new("correct horse battery".to_owned());
    accounts.add_user("carl", Role::Viewer, &password, now()).expect("added");
    let end = now() + Span::from_seconds(3600.0);
    let (_, secret) = accounts.add_token("carl", "for tests", Role::Viewer, end, now()).expect("added");
    let bearer = format!("Bearer {}", secret.reveal());
    let file = pmtiles(&folder, "pit.pmtiles", 4, 10);
    let site = Site::start(&with_map(&folder, &file, None)).await.expect("starts");
    for path in [PATH, "/api/v1/map"] {
        assert_eq!(get(site.address(), path).await.status, 401, "{path}");
        assert_eq!(exchange(site.address(), "HEAD", path, &[]).await.status, 401, "{path}");
        let answer = exchange(site.address(), "GET", path, &[("Authorization", &bearer)]).await;
        assert_eq!(answer.status, 200, "{path}");
    }
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn site_does_not_start_with_a_basemap_that_cannot_be_drawn() {
    let folder = Folder::new("basemap-wrong");
    let vector = pmtiles(&folder, "vector.pmtiles", 1, 10);
    let text = folder.0.join("readme.pmtiles");
    std::fs::write(&text, "no picture").expect("written");
    for (file, expected) in [
        (vector, "has vector tiles; they are not drawn, must be PNG, JPEG or WebP"),
        (text, "is no PMTiles file"),
        (folder.0.join("nowhere.pmtiles"), "cannot be read"),
    ] {
        let refused = Site::start(&with_map(&folder, &file, None)).await.err().expect("refused").to_string();
        let named = format!("map.basemap_file is {}, which ", file.display());
        assert!(refused.starts_with(&named) && refused.contains(expected), "{refused}");
    }
}
