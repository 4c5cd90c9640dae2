//! Clients that keep the server waiting: it serves the others, answers what comes too late, and ends all the same.
#![cfg(feature = "shells")]
#![allow(clippy::disallowed_methods, reason = "tests play clients, who have clocks")]

#[path = "support/site.rs"]
mod support;

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use holdfast::site::Site;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use support::{Folder, PATIENCE, get};

/// A connection that has said so much.
async fn say(site: SocketAddr, text: &str) -> TcpStream {
    let mut stream = TcpStream::connect(site).await.expect("connects");
    stream.write_all(text.as_bytes()).await.expect("taken");
    stream
}

/// What the server still says until it ends the connection; `None` if it leaves it open.
async fn rest(mut stream: TcpStream, patience: Duration) -> Option<String> {
    let mut said = Vec::new();
    match tokio::time::timeout(patience, stream.read_to_end(&mut said)).await {
        Ok(_) => Some(String::from_utf8_lossy(&said).into_owned()),
        Err(_) => None,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn body_that_never_ends_is_answered_and_heads_that_never_end_shut_nobody_out() {
    let folder = Folder::new("patience");
    let site = Site::start(&folder.config()).await.expect("starts");
    let address = site.address();
    let slow = say(
        address,
        "POST /api/v1/sign-in HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n\
         Content-Length: 100\r\nConnection: close\r\n\r\n{",
    )
    .await;
    // More than one address may have: those beyond are let go at once, whatever they say.
    let mut silent = Vec::new();
    for _ in 0..300 {
        silent.push(say(address, "GET /healthz HTTP/1.1\r\n").await);
    }
    let let_go = silent.pop().expect("a connection");
    assert_eq!(rest(let_go, PATIENCE).await.as_deref(), Some(""), "beyond what one address may have");
    silent.truncate(200);
    let began = Instant::now();
    while tokio::time::timeout(PATIENCE, get(address, "/healthz")).await.is_err() {
        assert!(began.elapsed() < PATIENCE, "nobody is served beside those who are silent");
    }

    let answer = rest(slow, Duration::from_secs(60)).await.expect("an end");
    assert!(answer.starts_with("HTTP/1.1 408 ") && answer.contains("application/problem+json"), "{answer}");
    assert!(answer.contains("was not there within 30 s"), "{answer}");

    let began = Instant::now();
    site.stop().await;
    assert!(began.elapsed() < PATIENCE, "those who are silent do not hold up the end");
    drop(silent);
}
