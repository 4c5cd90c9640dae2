//! The doors of the site that speak other people's formats: who is not let in, and who cannot hold up the others.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play machines and people, who have clocks")]

#[path = "support/site.rs"]
mod support;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use futures_util::{SinkExt as _, StreamExt as _};
use holdfast::accounts::{Accounts, Password, Role};
use holdfast::site::Site;
use holdfast::time::Span;
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::http::Response;
use tokio_tungstenite::tungstenite::{Error, Message};

use support::{Folder, Machine, PATIENCE, get, now};

type Socket = tokio_tungstenite::WebSocketStream<tokio_tungstenite::MaybeTlsStream<TcpStream>>;

async fn connect(
    site: SocketAddr,
    path: &str,
    headers: &[(&'static str, &str)],
) -> Result<(Socket, Response<Option<Vec<u8>>>), Error> {
    let mut request = format!("ws://{site}{path}").into_client_request().expect("a request");
    for (name, value) in headers {
        request.headers_mut().insert(*name, value.parse().expect("a value"));
    }
    tokio_tungstenite::connect_async(request).await
}

/// A client of `foxglove.sdk.v1`, subscribed to all topics so far that end so; and its channels.
async fn follow(site: SocketAddr, ends: &str) -> (Socket, BTreeMap<String, u64>) {
    let names = [("Sec-WebSocket-Protocol", "foxglove.websocket.v1, foxglove.sdk.v1")];
    let (mut socket, answer) = connect(site, "/foxglove", &names).await.expect("connects");
    assert_eq!(answer.headers()["sec-websocket-protocol"], "foxglove.sdk.v1", "the newer of two");
    assert_eq!(text(&mut socket).await["op"], "serverInfo");
    let advertised = text(&mut socket).await;
    assert_eq!(advertised["op"], "advertise");
    let channels: BTreeMap<String, u64> = advertised["channels"]
        .as_array()
        .expect("channels")
        .iter()
        .map(|one| (one["topic"].as_str().expect("text").to_owned(), one["id"].as_u64().expect("a number")))
        .collect();
    let wanted = channels.iter().filter(|(topic, _)| topic.ends_with(ends));
    let wanted: Vec<Value> = wanted.map(|(_, id)| json!({"id": 100 + id, "channelId": id})).collect();
    say(&mut socket, &json!({"op": "subscribe", "subscriptions": wanted})).await;
    (socket, channels)
}

async fn say(socket: &mut Socket, what: &Value) {
    socket.send(Message::text(what.to_string())).await.expect("sent");
}

async fn next(socket: &mut Socket) -> Message {
    let message = tokio::time::timeout(PATIENCE, socket.next()).await.expect("in time");
    message.expect("open").expect("a message")
}

/// The next message in JSON.
async fn text(socket: &mut Socket) -> Value {
    loop {
        if let Message::Text(text) = next(socket).await {
            return serde_json::from_str(&text).expect("JSON");
        }
    }
}

async fn is_online(site: SocketAddr) -> bool {
    get(site, "/api/v1/fleet").await.json()["machines"][0]["presence"] == "online"
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_that_cannot_be_served_are_told_why() {
    let folder = Folder::new("foxglove-refused");
    let site = Site::start(&folder.config()).await.expect("starts");
    let at = site.address();
    let named = [("Sec-WebSocket-Protocol", "foxglove.websocket.v1")];
    for (path, more, status, word) in [
        ("/foxglove", &[][..], 400, "foxglove.sdk.v1"),
        ("/foxglove", &[("Sec-WebSocket-Protocol", "chat")][..], 400, "foxglove.websocket.v1"),
        ("/foxglove?speed=0", &named[..], 400, "speed"),
        ("/foxglove?speed=fast", &named[..], 400, "speed"),
        ("/foxglove?session=nothing", &named[..], 404, "nothing"),
        ("/foxglove?session=..%2F..", &named[..], 404, "session"),
        ("/foxglove", &[named[0], ("Origin", "http://elsewhere.example")][..], 403, "pages"),
    ] {
        let Err(Error::Http(answer)) = connect(at, path, more).await else { panic!("{path} is served") };
        let problem: Value = serde_json::from_slice(answer.body().as_deref().expect("a body")).expect("JSON");
        assert_eq!(answer.status(), status, "{path}: {problem}");
        assert_eq!(answer.headers()["content-type"], "application/problem+json", "{path}");
        assert!(problem["detail"].as_str().is_some_and(|detail| detail.contains(word)), "{path}: {problem}");
    }
    let answer = get(at, "/foxglove").await;
    assert!(answer.status == 400 || answer.status == 426, "{}", answer.status);
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn channels_appear_with_machines_and_nonsense_is_answered() {
    let folder = Folder::new("foxglove-channels");
    let site = Site::start(&folder.config()).await.expect("starts");
    let (mut socket, channels) = follow(site.address(), "").await;
    assert!(channels.is_empty(), "{channels:?}");
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    machine.speak_until(async || is_online(site.address()).await).await;
    let mut topics = Vec::new();
    while topics.len() < 4 {
        let advertised = text(&mut socket).await;
        assert_eq!(advertised["op"], "advertise", "{advertised}");
        for channel in advertised["channels"].as_array().expect("channels") {
            topics.push(channel["topic"].as_str().expect("text").to_owned());
        }
    }
    topics.sort();
    assert_eq!(topics, ["/a/health", "/a/location", "/a/pose", "/a/tf"]);
    for (what, word) in [
        (json!({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 9999}]}), "no channel 9999"),
        (json!({"op": "unsubscribe", "subscriptionIds": [7]}), "no subscription 7"),
        (json!({"op": "getParameters", "parameterNames": []}), "no parameters"),
        (json!({"op": "subscribeConnectionGraph"}), "not understood"),
        (json!([]), "not understood"),
    ] {
        say(&mut socket, &what).await;
        let answer = text(&mut socket).await;
        assert_eq!((&answer["op"], &answer["level"]), (&"status".into(), &1.into()), "{what}");
        assert!(answer["message"].as_str().is_some_and(|text| text.contains(word)), "{what}: {answer}");
    }
    // Whoever unsubscribes gets no more of it.
    let (mut other, channels) = follow(site.address(), "").await;
    let pose = 100 + channels["/a/pose"];
    say(
        &mut other,
        &json!({"op": "subscribe", "subscriptions": [{"id": pose, "channelId": channels["/a/tf"]}]}),
    )
    .await;
    assert!(text(&mut other).await["message"].as_str().is_some_and(|text| text.contains("in use")));
    say(&mut other, &json!({"op": "unsubscribe", "subscriptionIds": [pose, 5]})).await;
    assert!(
        text(&mut other).await["message"].as_str().is_some_and(|text| text.contains("no subscription 5"))
    );
    machine.pose().await;
    loop {
        let Message::Binary(bytes) = next(&mut other).await else { continue };
        if bytes[0] == 1 {
            let id = u32::from_le_bytes(bytes[1..5].try_into().expect("four"));
            assert_ne!(u64::from(id), pose);
            break;
        }
    }
    // The site says that it ends.
    site.stop().await;
    let closed = async {
        loop {
            match other.next().await {
                Some(Ok(Message::Close(Some(frame)))) => return frame,
                Some(Ok(_)) => {}
                ended => panic!("{ended:?}"),
            }
        }
    };
    let frame = tokio::time::timeout(PATIENCE, closed).await.expect("in time");
    assert_eq!(frame.reason.as_str(), "the site server ends");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn client_that_does_not_listen_slows_nobody_and_gets_the_newest() {
    let folder = Folder::new("foxglove-slow");
    let site = Site::start(&folder.config()).await.expect("starts");
    let mut machine = Machine::connect("a", 1, &site.endpoints()[0]).await;
    machine.speak_until(async || is_online(site.address()).await).await;
    let (mut slow, channels) = follow(site.address(), "").await;
    let (mut quick, _) = follow(site.address(), "/pose").await;
    let pose = (100 + channels["/a/pose"]) as u32;
    // Far more than sockets and the outbox hold, while one client takes everything and the other nothing.
    const POSES: usize = 8_000;
    let is_pose = move |message: &Message| matches!(message, Message::Binary(bytes) if bytes[0] == 1 && bytes[1..5] == pose.to_le_bytes());
    // Until it is subscribed.
    machine.pose().await;
    while !is_pose(&next(&mut quick).await) {
        machine.pose().await;
    }
    let quick_took = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&quick_took);
    let taking = tokio::spawn(async move {
        loop {
            if is_pose(&next(&mut quick).await) {
                count.fetch_add(1, Ordering::Relaxed);
            }
        }
    });
    for _ in 0..POSES / 40 {
        for _ in 0..40 {
            machine.pose().await;
        }
        tokio::time::sleep(Duration::from_millis(12)).await;
    }
    // Zenoh may drop what a busy computer does not take from it; what the site got, the quick one gets.
    let received = async || {
        let fleet = get(site.address(), "/api/v1/fleet").await.json();
        let missed = fleet["machines"][0]["link"]["missed"].as_u64().expect("a number") as usize;
        (fleet, POSES - missed.min(POSES))
    };
    let waiting = async {
        while quick_took.load(Ordering::Relaxed) < received().await.1 {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    let in_time = tokio::time::timeout(PATIENCE, waiting).await;
    // The API shows the newest frame, of which there are ten a second.
    tokio::time::sleep(Duration::from_millis(500)).await;
    let (fleet, came) = received().await;
    let took = quick_took.load(Ordering::Relaxed);
    assert!(in_time.is_ok(), "the quick one has {took} of {came} messages");
    taking.abort();
    assert!(taking.await.is_err_and(|error| error.is_cancelled()), "it took to the end");
    let stamp: jiff::Timestamp =
        fleet["machines"][0]["pose"]["stamp"].as_str().expect("a stamp").parse().expect("a time");
    // What the slow one gets in the end: the newest, and how much it lost; what sockets hold is the system's choice.
    let (mut taken, mut told, mut is_newest) = (0, 0, false);
    let deadline = Instant::now() + PATIENCE;
    while !is_newest {
        assert!(
            Instant::now() < deadline,
            "the newest of {taken} messages does not come, {told} were dropped"
        );
        match next(&mut slow).await {
            Message::Text(text) => {
                let status: Value = serde_json::from_str(&text).expect("JSON");
                let message = status["message"].as_str().expect("a message");
                told += message.split(' ').next().and_then(|count| count.parse().ok()).unwrap_or(0);
            }
            Message::Binary(bytes) if bytes[0] == 1 && bytes[1..5] == pose.to_le_bytes() => {
                taken += 1;
                // The header's stamp stands behind 13 bytes of the protocol and 4 of CDR.
                let part =
                    |at: usize| i64::from(u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four")));
                is_newest = part(17) == stamp.as_second() && part(21) == i64::from(stamp.subsec_nanosecond());
            }
            _ => {}
        }
    }
    let metrics = get(site.address(), "/metrics").await;
    let metrics = String::from_utf8(metrics.body).expect("text");
    let value = |name: &str| -> u64 {
        let line = metrics.lines().find_map(|line| line.strip_prefix(name)).expect(name);
        line.trim().parse().expect("a number")
    };
    assert!(value("holdfast_foxglove_dropped_total ") >= told, "{told}");
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn more_clients_than_places_are_refused_until_one_goes() {
    let folder = Folder::new("foxglove-places");
    let site = Site::start(&folder.config()).await.expect("starts");
    let mut clients = Vec::new();
    for _ in 0..16 {
        clients.push(follow(site.address(), "").await);
    }
    let names = [("Sec-WebSocket-Protocol", "foxglove.sdk.v1")];
    let once_more = async || connect(site.address(), "/foxglove", &names).await;
    let refused = once_more().await.expect_err("refused").to_string();
    assert!(refused.contains("503"), "{refused}");
    clients.pop();
    let waiting = async {
        while once_more().await.is_err() {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    tokio::time::timeout(PATIENCE, waiting).await.expect("a place");
    drop(clients);
    site.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn socket_ends_with_the_token_that_opened_it() {
    let folder = Folder::new("foxglove-accounts");
    let accounts = Accounts::of(&folder.0).expect("none yet");
    let password = Password::new("correct horse battery".to_owned());
    accounts.add_user("anna", Role::Viewer, &password, now()).expect("added");
    let end = now() + Span::from_seconds(3600.0);
    let (token, secret) = accounts.add_token("anna", "for tests", Role::Viewer, end, now()).expect("added");
    let site = Site::start(&folder.config()).await.expect("starts");
    let bearer = format!("Bearer {}", secret.reveal());
    let names = ("Sec-WebSocket-Protocol", "foxglove.sdk.v1");
    let refused = connect(site.address(), "/foxglove", &[names]).await.expect_err("nobody").to_string();
    assert!(refused.contains("401"), "{refused}");
    let headers = [names, ("Authorization", bearer.as_str())];
    let (mut socket, _) = connect(site.address(), "/foxglove", &headers).await.expect("connects");
    assert_eq!(text(&mut socket).await["op"], "serverInfo");
    accounts.revoke_token(&token.id, None).expect("revoked");
    let over = async { while let Some(Ok(_)) = socket.next().await {} };
    tokio::time::timeout(PATIENCE, over).await.expect("ends with its token");
    site.stop().await;
}
