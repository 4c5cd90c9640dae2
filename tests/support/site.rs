//! A machine's peer, and a person's HTTP client, for the site server under test.
#![allow(dead_code, reason = "each test takes what it needs")]

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use holdfast::config;
use holdfast::state::{GnssState, Health, Mode, OutageReport};
use holdfast::time::Stamp;
use holdfast::wire::{
    self, Attachment, BootId, Header, MachineReport, Odometry, Origin, RigidMotion, RosMessage as _, Topic,
};
use serde_json::Value;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

/// Nothing in here takes so long unless it is broken.
pub const PATIENCE: Duration = Duration::from_secs(20);

pub fn now() -> Stamp {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970");
    Stamp::from_nanos(i64::try_from(since_epoch.as_nanos()).expect("before 2262"))
}

/// A folder that goes with the test.
pub struct Folder(pub PathBuf);

impl Folder {
    pub fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("holdfast-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).expect("a temporary folder");
        Self(path)
    }

    pub fn config(&self) -> config::Site {
        let text = "id = \"quarry\"\nname = \"Quarry\"\n[world]\nlatitude_deg = 47.0\nlongitude_deg = 8.0\n\
                    altitude_m = 400.0\n[http]\nlisten = \"127.0.0.1:0\"\n\
                    [zenoh]\nlisten = [\"tcp/127.0.0.1:0\"]\n";
        let mut config: config::Site = config::parse(text, Path::new("site.toml")).expect("valid");
        config.record.directory = self.0.clone();
        // Tests ask without a pause, as people do not.
        config.http.requests_per_s = 10_000.0;
        config
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A peer that publishes as a machine does.
pub struct Machine {
    pub id: &'static str,
    pub session: zenoh::Session,
    pub token: Option<zenoh::liveliness::LivelinessToken>,
    pub boot: BootId,
    pub sequences: BTreeMap<Topic, u64>,
    pub mode: Mode,
    pub gnss: GnssState,
    pub outage: Option<OutageReport>,
}

impl Machine {
    pub async fn connect(id: &'static str, boot: u64, endpoint: &str) -> Self {
        let mut settings = zenoh::Config::default();
        for (key, value) in [
            ("mode", "\"peer\"".to_owned()),
            ("listen/endpoints", "[]".to_owned()),
            ("connect/endpoints", format!("[\"{endpoint}\"]")),
            ("scouting/multicast/enabled", "false".to_owned()),
            ("scouting/gossip/enabled", "false".to_owned()),
        ] {
            settings.insert_json5(key, &value).expect("a known key");
        }
        let machine = Self::over(settings, id, boot).await;
        // What is put before the site's subscription is known here is lost.
        let publisher = machine.session.declare_publisher(wire::topic_key("quarry", id, Topic::Health));
        let publisher = publisher.await.expect("declares");
        let heard = async {
            while !publisher.matching_status().await.expect("a status").matching() {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::time::timeout(PATIENCE, heard).await.expect("the site subscribes in time");
        drop(publisher);
        machine
    }

    /// Over a link of one's own.
    pub async fn over(settings: zenoh::Config, id: &'static str, boot: u64) -> Self {
        let session = zenoh::open(settings).await.expect("opens");
        let boot = BootId(boot);
        let token =
            session.liveliness().declare_token(wire::alive_key("quarry", id, boot)).await.expect("token");
        let (mode, gnss) = (Mode::Main, GnssState::Fixed);
        Self { id, session, token: Some(token), boot, sequences: BTreeMap::new(), mode, gnss, outage: None }
    }

    pub async fn put(&mut self, topic: Topic, payload: Vec<u8>) {
        let sequence = self.sequences.entry(topic).or_default();
        let attachment = Attachment { sequence: *sequence, boot: self.boot, stamp: now(), sent: now() };
        *sequence += 1;
        let key = wire::topic_key("quarry", self.id, topic);
        let put = self.session.put(key, payload).attachment(attachment.encode().to_vec());
        put.await.expect("put");
    }

    /// A pose 10 m east, 20 m north; looking north, which is a quarter turn from east.
    pub async fn pose(&mut self) {
        let mut covariance = [0.0; 36];
        for (axis, variance) in [1e-4, 4e-4, 9e-4, 1e-6, 1e-6, 1e-6].into_iter().enumerate() {
            covariance[7 * axis] = variance;
        }
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let message = Odometry {
            header: Header::new(now(), "world"),
            child_frame_id: "imu".to_owned(),
            position: [10.0, 20.0, 1.0],
            orientation: [0.0, 0.0, half, half],
            pose_covariance: covariance,
            linear: [0.3, 0.4, 0.0],
            angular: [0.0; 3],
            twist_covariance: [0.0; 36],
        };
        self.put(Topic::Pose, message.encode()).await;
    }

    pub async fn health(&mut self) {
        let report = MachineReport {
            id: self.id.to_owned(),
            name: "Number one".to_owned(),
            software: "0".to_owned(),
            boot: self.boot,
            world: Origin { latitude_deg: 47.0, longitude_deg: 8.0, altitude_m: 400.0 },
            cabin_from_imu: RigidMotion {
                translation_m: [0.0, 0.0, 2.0],
                quaternion_xyzw: [0.0, 0.0, 0.0, 1.0],
            },
            world_from_odom: None,
            estimate_age_s: Some(0.01),
            prediction: None,
            record: None,
            health: Health {
                stamp_ns: now().as_nanos(),
                mode: self.mode,
                waits_for: None,
                gnss: self.gnss,
                gnss_inflation: [1.0, 1.0],
                position_sigma_m: Some(0.02),
                heading_sigma_deg: Some(0.1),
                worst_test_ratio: 0.2,
                worst_test_sensor: None,
                sensors: vec![],
                outage: self.outage.clone(),
                updates: 1,
                update_us: 1.0,
                gyro_bias: [0.0; 3],
                accel_bias: [0.0; 3],
            },
        };
        self.put(Topic::Health, wire::encode_json("machine report", &report).expect("JSON")).await;
    }

    /// Speaks until `done` says that it was heard: what is put before the link stands is lost.
    pub async fn speak_until<F: AsyncFnMut() -> bool>(&mut self, mut done: F) {
        let speaking = async {
            loop {
                self.health().await;
                self.pose().await;
                if done().await {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        };
        tokio::time::timeout(PATIENCE, speaking).await.expect("heard in time");
    }
}

pub struct Answer {
    pub status: u16,
    pub headers: BTreeMap<String, String>,
    pub body: Vec<u8>,
}

impl Answer {
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).expect("JSON")
    }

    pub fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", String::as_str)
    }
}

/// One HTTP exchange, by hand: so that any header and method can be sent.
pub async fn exchange(site: SocketAddr, method: &str, path: &str, headers: &[(&str, &str)]) -> Answer {
    exchange_body(site, method, path, headers, "").await
}

/// The same, with a body.
pub async fn exchange_body(
    site: SocketAddr,
    method: &str,
    path: &str,
    headers: &[(&str, &str)],
    body: &str,
) -> Answer {
    let mut stream = TcpStream::connect(site).await.expect("connects");
    let mut request = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n");
    if !headers.iter().any(|(name, _)| *name == "Host") {
        request.push_str(&format!("Host: {site}\r\n"));
    }
    for (name, value) in headers {
        request.push_str(&format!("{name}: {value}\r\n"));
    }
    if !body.is_empty() {
        request.push_str(&format!("Content-Length: {}\r\n", body.len()));
    }
    request.push_str("\r\n");
    request.push_str(body);
    // Who refuses a body may close before it is all there; what counts is the answer.
    let sent = stream.write_all(request.as_bytes()).await;
    let mut bytes = Vec::new();
    let read = tokio::time::timeout(PATIENCE, stream.read_to_end(&mut bytes)).await;
    assert!(read.expect("answered in time").is_ok() || !bytes.is_empty(), "{sent:?}");
    let end = bytes.windows(4).position(|four| four == b"\r\n\r\n").expect("a head");
    let head = std::str::from_utf8(&bytes[..end]).expect("text");
    let mut lines = head.lines();
    let status = lines.next().and_then(|line| line.split(' ').nth(1)).expect("a status");
    let headers: BTreeMap<String, String> = lines
        .filter_map(|line| line.split_once(':'))
        .map(|(name, value)| (name.to_ascii_lowercase(), value.trim().to_owned()))
        .collect();
    let mut body = bytes[end + 4..].to_vec();
    if headers.get("transfer-encoding").is_some_and(|encoding| encoding == "chunked") {
        body = unchunked(&body);
    }
    Answer { status: status.parse().expect("a number"), headers, body }
}

pub fn unchunked(mut rest: &[u8]) -> Vec<u8> {
    let mut body = Vec::new();
    loop {
        let line = rest.windows(2).position(|two| two == b"\r\n").expect("a chunk's length");
        let text = std::str::from_utf8(&rest[..line]).expect("text");
        let length = usize::from_str_radix(text, 16).expect("a number");
        if length == 0 {
            return body;
        }
        body.extend(&rest[line + 2..line + 2 + length]);
        rest = &rest[line + 2 + length + 2..];
    }
}

pub async fn get(site: SocketAddr, path: &str) -> Answer {
    exchange(site, "GET", path, &[]).await
}
