//! Tells an address by HTTP or HTTPS.
//!
//! `POST` with a JSON object: `type` ("alert" or "test"), `site`, `alert` as the API has it. `Holdfast-Timestamp` is
//! the Unix time of sending in seconds; with a secret, `Holdfast-Signature` is `sha256=` and the HMAC-SHA256, in
//! hex, of the timestamp, a full stop and the body. Any 2xx takes it; redirections are not followed.

use axum::http::header::{CONTENT_TYPE, HOST, USER_AGENT};
use axum::http::{Method, Request, Uri};
use http_body_util::Full;
use hyper::body::Bytes;
use hyper_util::rt::TokioIo;
use serde::Serialize;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::ServerName;

use super::authorities::Authorities;
use super::{Letter, secret};
use crate::config::{self, Violation};
use crate::fleet::AlertView;
use crate::time::Stamp;

/// One address.
pub(in crate::site) struct Hook {
    name: String,
    uri: Uri,
    host: String,
    port: u16,
    key: Option<ring::hmac::Key>,
    /// `None` for plain HTTP.
    tls: Option<TlsConnector>,
}

/// What is sent.
#[derive(Serialize)]
struct Body<'a> {
    #[serde(rename = "type")]
    kind: &'static str,
    site: &'a str,
    alert: AlertView,
}

impl Hook {
    /// # Errors
    /// The address is none, or the secret cannot be read.
    pub fn new(webhook: &config::Webhook, authorities: &Authorities) -> Result<Self, Violation> {
        let refused = |message: String| Violation { key: "alerts.webhook.url".to_owned(), message };
        let uri: Uri = webhook.url.parse().map_err(|error| refused(format!("is no address: {error}")))?;
        let host = uri.host().unwrap_or_default().trim_matches(['[', ']']).to_owned();
        if host.is_empty() {
            return Err(refused(format!("is {:?}, which names no host", webhook.url)));
        }
        let is_secret = uri.scheme_str() == Some("https");
        let tls = is_secret.then(|| authorities.connector()).transpose().map_err(refused)?;
        let key = match &webhook.secret_file {
            Some(path) => {
                let secret = secret("alerts.webhook.secret_file", path)?;
                Some(ring::hmac::Key::new(ring::hmac::HMAC_SHA256, secret.as_bytes()))
            }
            None => None,
        };
        let port = uri.port_u16().unwrap_or(if is_secret { 443 } else { 80 });
        Ok(Self { name: webhook.name.clone(), uri, host, port, key, tls })
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    pub async fn send(&self, letter: &Letter<'_>, now: Stamp) -> Result<String, String> {
        let kind = if letter.is_test { "test" } else { "alert" };
        let body = Body { kind, site: letter.site, alert: AlertView::from(letter.alert) };
        let body = serde_json::to_vec(&body).map_err(|error| error.to_string())?;
        let request = self.request(body, now)?;
        let stream = TcpStream::connect((self.host.as_str(), self.port))
            .await
            .map_err(|error| format!("cannot connect to {}:{}: {error}", self.host, self.port))?;
        match &self.tls {
            None => exchange(stream, request).await,
            Some(tls) => {
                let name = ServerName::try_from(self.host.clone()).map_err(|error| error.to_string())?;
                let stream = tls.connect(name, stream).await.map_err(|error| format!("TLS: {error}"))?;
                exchange(stream, request).await
            }
        }
    }

    fn request(&self, body: Vec<u8>, now: Stamp) -> Result<Request<Full<Bytes>>, String> {
        let timestamp = (now.as_nanos() / 1_000_000_000).to_string();
        let target = self.uri.path_and_query().map_or("/", |target| target.as_str());
        let host = self.uri.authority().map(|authority| authority.as_str()).unwrap_or_default();
        let mut request = Request::builder()
            .method(Method::POST)
            .uri(target)
            .header(HOST, host)
            .header(CONTENT_TYPE, "application/json")
            .header(USER_AGENT, concat!("holdfast/", env!("CARGO_PKG_VERSION")))
            .header("holdfast-timestamp", &timestamp);
        if let Some(key) = &self.key {
            request = request.header("holdfast-signature", signature(key, &timestamp, &body));
        }
        request.body(Full::new(Bytes::from(body))).map_err(|error| error.to_string())
    }
}

fn signature(key: &ring::hmac::Key, timestamp: &str, body: &[u8]) -> String {
    let mut context = ring::hmac::Context::with_key(key);
    context.update(timestamp.as_bytes());
    context.update(b".");
    context.update(body);
    let hex: String = context.sign().as_ref().iter().map(|byte| format!("{byte:02x}")).collect();
    format!("sha256={hex}")
}

async fn exchange<S: AsyncRead + AsyncWrite + Unpin>(
    stream: S,
    request: Request<Full<Bytes>>,
) -> Result<String, String> {
    let said = |error: hyper::Error| format!("HTTP: {error}");
    let (mut sender, connection) =
        hyper::client::conn::http1::handshake(TokioIo::new(stream)).await.map_err(said)?;
    let answer = sender.send_request(request);
    tokio::pin!(connection, answer);
    let response = tokio::select! {
        answer = &mut answer => answer.map_err(said)?,
        ended = &mut connection => match ended {
            // The answer may have come with the end.
            Ok(()) => answer.await.map_err(said)?,
            Err(error) => return Err(said(error)),
        },
    };
    let status = response.status();
    if status.is_success() { Ok(status.to_string()) } else { Err(format!("it says {status}")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signature_is_hmac_sha256_of_timestamp_and_body() {
        let key = ring::hmac::Key::new(ring::hmac::HMAC_SHA256, b"Jefe");
        // RFC 4231, case 2, with the full stop where the parts are joined.
        let whole = ring::hmac::sign(&key, b"what do ya want for nothing?");
        assert_eq!(whole.as_ref()[..4], [0x5b, 0xdc, 0xc1, 0x46]);
        let expected: String =
            ring::hmac::sign(&key, b"17.body").as_ref().iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(signature(&key, "17", b"body"), format!("sha256={expected}"));
    }
}
