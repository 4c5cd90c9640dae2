//! Alerts as people and their receivers see them: a real site, a real HTTP receiver, a real SMTP receiver.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play machines and people, who have clocks")]

#[path = "support/receivers.rs"]
#[allow(dead_code, reason = "shared with the test over TLS")]
mod receivers;
#[path = "support/site.rs"]
mod support;

use std::net::SocketAddr;
use std::path::Path;

use futures_util::{SinkExt as _, StreamExt as _};
use holdfast::config;
use holdfast::site::Site;
use serde_json::Value;
use tokio_tungstenite::tungstenite::Message;

use receivers::{HttpReceiver, MailReceiver, Request, until};
use support::{Answer, Folder, Machine, PATIENCE, exchange, exchange_body, get, now};

type Socket = tokio_tungstenite::WebSocketStream<tokio_tungstenite::MaybeTlsStream<tokio::net::TcpStream>>;

const SECRET: &str = "correct horse battery staple";

/// A site on which machines are missed soon, and that tells these receivers.
fn config(folder: &Folder, hook: SocketAddr, mail: Option<SocketAddr>) -> config::Site {
    let secret = folder.0.join("webhook.secret");
    std::fs::write(&secret, format!("{SECRET}\n")).expect("written");
    let mut text = toml::to_string(&folder.config()).expect("TOML");
    let alerts = text.find("\n[alerts").expect("all tables are written");
    text.truncate(alerts);
    text.push_str(&format!(
        "\n[alerts.machine_lost]\nlonger_than_s = 0.3\nclear_after_s = 0.3\n\
         [alerts.disk_low]\nenabled = false\n[alerts.sensor_silent]\nenabled = false\n\
         [[alerts.webhook]]\nname = \"dispatch\"\nurl = \"http://{hook}/told?by=holdfast\"\nsecret_file = {secret:?}\n"
    ));
    if let Some(mail) = mail {
        text.push_str(&format!(
            "[alerts.mail]\nhost = \"{}\"\nport = {}\ntls = \"none\"\nfrom = \"Site <site@example.com>\"\n\
             to = [\"ana@example.com\", \"bo@example.com\"]\n",
            mail.ip(),
            mail.port()
        ));
    }
    config::parse(&text, Path::new("site.toml")).unwrap_or_else(|error| panic!("{error}\n{text}"))
}

async fn list(site: SocketAddr, query: &str) -> Vec<Value> {
    get(site, &format!("/api/v1/alerts?{query}")).await.json()["alerts"].as_array().expect("alerts").clone()
}

async fn post(site: SocketAddr, path: &str, body: &str) -> Answer {
    exchange_body(site, "POST", path, &[("Content-Type", "application/json")], body).await
}

/// Whether the receiver, who knows the secret, may believe it.
fn is_signed(request: &Request) -> bool {
    let timestamp = &request.headers["holdfast-timestamp"];
    let seconds: i64 = timestamp.parse().expect("seconds");
    assert!((now().as_nanos() / 1_000_000_000 - seconds).abs() < 60, "{timestamp}");
    let key = ring::hmac::Key::new(ring::hmac::HMAC_SHA256, SECRET.as_bytes());
    let hex =
        request.headers["holdfast-signature"].strip_prefix("sha256=").expect("the algorithm").to_owned();
    let bytes: Vec<u8> =
        (0..hex.len() / 2).map(|at| u8::from_str_radix(&hex[2 * at..2 * at + 2], 16).expect("hex")).collect();
    ring::hmac::verify(&key, format!("{timestamp}.{}", request.body).as_bytes(), &bytes).is_ok()
}

fn states(requests: &[Request]) -> Vec<String> {
    let state = |request: &Request| {
        let body: Value = serde_json::from_str(&request.body).expect("JSON");
        body["alert"]["state"].as_str().expect("a state").to_owned()
    };
    requests.iter().map(state).collect()
}

/// The first alert of the next live message about alerts in which it is as wanted.
async fn told(socket: &mut Socket, wanted: impl Fn(&Value) -> bool) -> Value {
    let listening = async {
        loop {
            let message = socket.next().await.expect("open").expect("a message");
            let message: Value = serde_json::from_str(message.to_text().expect("text")).expect("JSON");
            if message["type"] == "alerts" && wanted(&message["alerts"][0]) {
                return message["alerts"][0].clone();
            }
        }
    };
    tokio::time::timeout(PATIENCE, listening).await.expect("in time")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lost_machine_is_told_by_webhook_mail_and_websocket_acknowledged_and_cleared() {
    let folder = Folder::new("alerts");
    let hook = HttpReceiver::start("127.0.0.1:0", &["500 Internal Server Error", "503 Busy"]).await;
    let mail = MailReceiver::start().await;
    let config = config(&folder, hook.address, Some(mail.address));
    let site = Site::start(&config).await.expect("starts");
    let address = site.address();
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    let is_online = async || get(address, "/api/v1/machines/a").await.json()["presence"] == "online";
    machine.speak_until(is_online).await;
    let (mut socket, _) =
        tokio_tungstenite::connect_async(format!("ws://{address}/api/v1/live")).await.expect("connects");
    socket.send(Message::text(r#"{"type":"subscribe","alerts":true}"#)).await.expect("sent");

    drop(machine.token.take());
    let alert = told(&mut socket, |alert| alert.is_object()).await;
    assert_eq!((&alert["rule"], &alert["machine"]), (&"machine_lost".into(), &"a".into()), "{alert}");
    assert_eq!((&alert["state"], &alert["message"]), (&"active".into(), &"a is not connected".into()));
    // While it goes on its worst does, for those who listen and for those who ask; nothing else of it changes.
    let worst = |alert: &Value| alert["worst"].as_f64().expect("a number");
    let later = told(&mut socket, |later| later.is_object() && worst(later) > worst(&alert)).await;
    for same in ["id", "state", "value", "message", "raised", "changed", "times"] {
        assert_eq!(later[same], alert[same], "{same}");
    }
    let asked = list(address, "state=active&machine=a&rule=machine_lost").await;
    assert!(asked.len() == 1 && worst(&asked[0]) >= worst(&later), "{asked:?}");
    assert_eq!(list(address, "machine=b").await.len(), 0);

    // The receiver refuses twice, and is told again until it takes it.
    let told = until("the webhook", || hook.requests().get(2).cloned()).await;
    assert_eq!(told.line, "POST /told?by=holdfast HTTP/1.1");
    assert_eq!(told.headers["content-type"], "application/json");
    let body: Value = serde_json::from_str(&told.body).expect("JSON");
    assert_eq!((&body["type"], &body["site"]), (&"alert".into(), &"quarry".into()), "{body}");
    assert_eq!(states(&hook.requests()), ["active", "active", "active"]);
    assert!(hook.requests().iter().all(is_signed));
    let forged = Request { body: told.body.replace("active", "cleared"), ..told };
    assert!(!is_signed(&forged), "a signature that fits everything is none");
    let mailed = until("the mail", || mail.mails().first().cloned()).await;
    for part in [
        "MAIL FROM:<site@example.com>",
        "RCPT TO:<ana@example.com>",
        "RCPT TO:<bo@example.com>",
        "Subject: [quarry] alert: a is not connected",
    ] {
        assert!(mailed.contains(part), "{part} is not in\n{mailed}");
    }

    let id = alert["id"].as_str().expect("an id");
    let path = format!("/api/v1/alerts/{id}/acknowledge");
    for (path, body, status) in [
        ("/api/v1/alerts/nothing/acknowledge", "{}", 404),
        (path.as_str(), "nonsense", 400),
        (path.as_str(), r#"{"remark":""}"#, 400),
    ] {
        assert_eq!(post(address, path, body).await.status, status, "{path} {body}");
    }
    assert_eq!(exchange_body(address, "POST", &path, &[], "{}").await.status, 415);
    let seen = post(address, &path, r#"{"note":"battery is being changed"}"#).await;
    assert_eq!(seen.status, 200);
    let seen = seen.json();
    assert_eq!(seen["state"], "acknowledged");
    assert_eq!(seen["acknowledged"]["by"], "anonymous on loopback");
    assert_eq!(seen["acknowledged"]["note"], "battery is being changed");
    assert_eq!(list(address, "").await[0]["state"], "acknowledged", "at once");
    assert_eq!(post(address, &path, "{}").await.status, 409);

    let boot = holdfast::wire::BootId(2);
    machine.boot = boot;
    machine.sequences.clear();
    let key = holdfast::wire::alive_key("quarry", "a", boot);
    machine.token = Some(machine.session.liveliness().declare_token(key).await.expect("token"));
    machine.speak_until(async || list(address, "state=cleared").await.len() == 1).await;
    until("the whole story", || (hook.requests().len() == 5).then_some(())).await;
    assert_eq!(states(&hook.requests())[2..], ["active", "acknowledged", "cleared"]);
    assert_eq!(post(address, &path, "{}").await.status, 409);
    site.stop().await;

    let site = Site::start(&config).await.expect("starts again");
    let kept = list(site.address(), "").await;
    let kept = kept.iter().find(|alert| alert["id"] == id).expect("kept");
    assert_eq!((&kept["state"], &kept["acknowledged"]), (&"cleared".into(), &seen["acknowledged"]));
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_no_receiver_took_is_delivered_by_the_next_run_of_the_site_server() {
    let folder = Folder::new("alerts-restart");
    let nobody = std::net::TcpListener::bind("127.0.0.1:0").expect("binds");
    let address = nobody.local_addr().expect("an address");
    drop(nobody);
    let config = config(&folder, address, None);
    let site = Site::start(&config).await.expect("starts");
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    let is_online = async || get(site.address(), "/api/v1/machines/a").await.json()["presence"] == "online";
    machine.speak_until(is_online).await;
    drop(machine.token.take());
    for _ in 0..2000 {
        if list(site.address(), "state=active").await.len() == 1 {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(10)).await;
    }
    let before = list(site.address(), "").await;
    assert_eq!(before.len(), 1);
    site.stop().await;

    let hook = HttpReceiver::start(&address.to_string(), &[]).await;
    let site = Site::start(&config).await.expect("starts again");
    let told = until("the webhook", || hook.requests().first().cloned()).await;
    let body: Value = serde_json::from_str(&told.body).expect("JSON");
    assert_eq!(body["alert"]["id"], before[0]["id"]);
    assert!(is_signed(&told));
    assert_eq!(list(site.address(), "state=active").await.len(), 1, "it goes on");
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn test_goes_through_all_channels_and_says_what_each_said() {
    let folder = Folder::new("alerts-test");
    let hook = HttpReceiver::start("127.0.0.1:0", &["204 No Content", "418 Teapot"]).await;
    let mail = MailReceiver::start().await;
    let site = Site::start(&config(&folder, hook.address, Some(mail.address))).await.expect("starts");
    let test = async || exchange(site.address(), "POST", "/api/v1/alerts/test", &[]).await.json();
    let said = test().await;
    let channel = |said: &Value, at: usize| {
        let channel = &said["channels"][at];
        (channel["channel"].clone(), channel["delivered"].clone(), channel["said"].clone())
    };
    assert_eq!(channel(&said, 0), ("webhook:dispatch".into(), true.into(), "204 No Content".into()));
    assert_eq!(channel(&said, 1), ("mail".into(), true.into(), "250 taken".into()));
    let request = hook.requests().pop().expect("told");
    assert!(is_signed(&request) && request.body.contains("\"type\":\"test\""), "{request:?}");
    assert!(mail.mails()[0].contains("Subject: [quarry] test: this is a test"), "{:?}", mail.mails());
    let refused = test().await;
    assert_eq!(channel(&refused, 0).1, false, "{refused}");
    assert!(channel(&refused, 0).2.as_str().is_some_and(|said| said.contains("418")), "{refused}");
    assert!(!refused.to_string().contains(SECRET));
    assert_eq!(list(site.address(), "").await.len(), 0, "a test is no alert");
    site.stop().await;

    let mut missing = config(&folder, hook.address, None);
    missing.alerts.webhook[0].secret_file = Some(folder.0.join("no.secret"));
    let message = Site::start(&missing).await.err().expect("refused").to_string();
    assert!(message.contains("alerts.webhook.secret_file") && message.contains("no.secret"), "{message}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn second_machine_with_one_id_is_refused_with_an_alert() {
    let folder = Folder::new("alerts-rival");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    let mut first = Machine::connect("a", 1, &site.endpoints()[0]).await;
    first.speak_until(async || get(address, "/api/v1/machines/a").await.json()["presence"] == "online").await;
    assert_eq!(list(address, "rule=id_conflict").await, Vec::<Value>::new());
    let mut second = Machine::connect("a", 2, &site.endpoints()[0]).await;
    let alerts = async |state: &str| list(address, &format!("rule=id_conflict&state={state}")).await;
    let raised = async || {
        first.pose().await;
        alerts("active").await.len() == 1
    };
    second.speak_until(raised).await;
    let alert = alerts("active").await[0].clone();
    assert_eq!((&alert["machine"], &alert["severity"]), (&"a".into(), &"critical".into()), "{alert}");
    let shown = get(address, "/api/v1/machines/a").await.json();
    assert_eq!(shown["boot"], second.boot.to_string(), "the first one is refused");
    assert!(shown["link"]["refused"].as_u64() > Some(0), "{shown}");
    // It is switched off: the other one is heard, and nothing is wrong any more.
    drop(first);
    second.speak_until(async || alerts("cleared_unacknowledged").await.len() == 1).await;
    site.stop().await;
}
