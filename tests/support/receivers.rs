//! Who is told of alerts: a small HTTP server and a small SMTP server, both also over TLS.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::io::{
    AsyncBufReadExt as _, AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, BufReader,
};
use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::TlsAcceptor;

/// What a receiver speaks over.
trait Stream: AsyncRead + AsyncWrite + Unpin + Send {}
impl<S: AsyncRead + AsyncWrite + Unpin + Send> Stream for S {}

/// How a receiver's connections are kept secret.
#[derive(Clone)]
pub enum Secrecy {
    None,
    /// From the first byte on.
    Tls(TlsAcceptor),
    /// From `STARTTLS` on; mail alone.
    StartTls(TlsAcceptor),
}

impl Secrecy {
    /// `None` if the client broke off, because it does not believe the certificate.
    async fn open(&self, stream: TcpStream) -> Option<Box<dyn Stream>> {
        match self {
            Self::Tls(acceptor) => Some(Box::new(acceptor.accept(stream).await.ok()?)),
            Self::None | Self::StartTls(_) => Some(Box::new(stream)),
        }
    }
}

/// A request as it came.
#[derive(Clone, Debug)]
pub struct Request {
    pub line: String,
    pub headers: BTreeMap<String, String>,
    pub body: String,
}

/// Takes requests, and answers with the statuses that it was given, then with 204.
pub struct HttpReceiver {
    pub address: SocketAddr,
    requests: Arc<Mutex<Vec<Request>>>,
}

impl HttpReceiver {
    pub async fn start(address: &str, statuses: &'static [&'static str]) -> Self {
        Self::start_over(Secrecy::None, address, statuses).await
    }

    pub async fn start_over(secrecy: Secrecy, address: &str, statuses: &'static [&'static str]) -> Self {
        let listener = TcpListener::bind(address).await.expect("binds");
        let address = listener.local_addr().expect("an address");
        let requests = Arc::new(Mutex::new(Vec::new()));
        let kept = Arc::clone(&requests);
        tokio::spawn(async move {
            let mut statuses = statuses.iter();
            while let Ok((stream, _)) = listener.accept().await {
                let Some(stream) = secrecy.open(stream).await else { continue };
                let request = take(stream, statuses.next().copied().unwrap_or("204 No Content")).await;
                kept.lock().expect("not poisoned").extend(request);
            }
        });
        Self { address, requests }
    }

    pub fn requests(&self) -> Vec<Request> {
        self.requests.lock().expect("not poisoned").clone()
    }
}

async fn take(stream: impl Stream, status: &str) -> Option<Request> {
    let mut stream = BufReader::new(stream);
    let mut line = String::new();
    stream.read_line(&mut line).await.ok()?;
    let mut headers = BTreeMap::new();
    loop {
        let mut header = String::new();
        stream.read_line(&mut header).await.ok()?;
        let Some((name, value)) = header.trim_end().split_once(':') else { break };
        headers.insert(name.to_ascii_lowercase(), value.trim().to_owned());
    }
    let length = headers.get("content-length")?.parse().ok()?;
    let mut body = vec![0; length];
    stream.read_exact(&mut body).await.ok()?;
    let answer = format!("HTTP/1.1 {status}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
    stream.write_all(answer.as_bytes()).await.ok()?;
    stream.flush().await.ok()?;
    Some(Request { line: line.trim_end().to_owned(), headers, body: String::from_utf8(body).ok()? })
}

/// Takes mail; each is the envelope's lines and the message.
pub struct MailReceiver {
    pub address: SocketAddr,
    mails: Arc<Mutex<Vec<String>>>,
}

impl MailReceiver {
    pub async fn start() -> Self {
        Self::start_over(Secrecy::None).await
    }

    pub async fn start_over(secrecy: Secrecy) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("binds");
        let address = listener.local_addr().expect("an address");
        let mails = Arc::new(Mutex::new(Vec::new()));
        let kept = Arc::clone(&mails);
        tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                let (kept, secrecy) = (Arc::clone(&kept), secrecy.clone());
                tokio::spawn(async move { serve(stream, &secrecy, &kept).await });
            }
        });
        Self { address, mails }
    }

    pub fn mails(&self) -> Vec<String> {
        self.mails.lock().expect("not poisoned").clone()
    }
}

async fn serve(stream: TcpStream, secrecy: &Secrecy, mails: &Mutex<Vec<String>>) -> Option<()> {
    if let Secrecy::StartTls(acceptor) = secrecy {
        let mut stream = BufReader::new(stream);
        stream.write_all(b"220 test ESMTP\r\n").await.ok()?;
        loop {
            let mut line = String::new();
            if stream.read_line(&mut line).await.ok()? == 0 {
                return None;
            }
            match verb(&line).as_str() {
                "EHLO" => stream.write_all(b"250-test\r\n250 STARTTLS\r\n").await.ok()?,
                "STARTTLS" => break,
                _ => stream.write_all(b"530 STARTTLS first\r\n").await.ok()?,
            }
        }
        stream.write_all(b"220 go on\r\n").await.ok()?;
        return talk(acceptor.accept(stream.into_inner()).await.ok()?, mails).await;
    }
    let mut stream = secrecy.open(stream).await?;
    stream.write_all(b"220 test ESMTP\r\n").await.ok()?;
    talk(stream, mails).await
}

fn verb(line: &str) -> String {
    line.split_whitespace().next().unwrap_or_default().to_ascii_uppercase()
}

/// As much of RFC 5321 as a client needs, after the greeting.
async fn talk(stream: impl Stream, mails: &Mutex<Vec<String>>) -> Option<()> {
    let mut stream = BufReader::new(stream);
    let mut mail = String::new();
    loop {
        stream.flush().await.ok()?;
        let mut line = String::new();
        if stream.read_line(&mut line).await.ok()? == 0 {
            return None;
        }
        let answer = match verb(&line).as_str() {
            "EHLO" | "HELO" => "250 test",
            "MAIL" | "RCPT" => {
                mail.push_str(&line);
                "250 fine"
            }
            "DATA" => {
                stream.write_all(b"354 go on\r\n").await.ok()?;
                stream.flush().await.ok()?;
                loop {
                    let mut line = String::new();
                    if stream.read_line(&mut line).await.ok()? == 0 {
                        return None;
                    }
                    if line.trim_end() == "." {
                        break;
                    }
                    mail.push_str(&line);
                }
                mails.lock().expect("not poisoned").push(std::mem::take(&mut mail));
                "250 taken"
            }
            "QUIT" => {
                let _ = stream.write_all(b"221 bye\r\n").await;
                let _ = stream.flush().await;
                return Some(());
            }
            _ => "250 fine",
        };
        stream.write_all(format!("{answer}\r\n").as_bytes()).await.ok()?;
    }
}

/// Waits until something is there.
pub async fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    for _ in 0..2000 {
        if let Some(found) = look() {
            return found;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    panic!("{what} does not come");
}
