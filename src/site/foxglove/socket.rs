//! The client's socket: one task writes what its outbox holds, the other reads.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::ws::{CloseFrame, Message, WebSocket, close_code};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::task::JoinHandle;

use super::outbox::Outbox;
use super::protocol::Request;

/// A client that takes no bytes for so long is let go.
const SEND_TIMEOUT: Duration = Duration::from_secs(10);

/// A connection's two halves. Dropping it ends the writing.
pub(super) struct Socket {
    requests: SplitStream<WebSocket>,
    writing: JoinHandle<()>,
    outbox: Arc<Outbox>,
}

impl Drop for Socket {
    fn drop(&mut self) {
        self.writing.abort();
    }
}

/// What a client said.
pub(super) enum Said {
    Request(Request),
    /// Not understood: why.
    Nonsense(String),
    /// Nothing more will come.
    Gone,
}

impl Socket {
    pub fn new(socket: WebSocket, outbox: Arc<Outbox>) -> Self {
        let (sink, requests) = socket.split();
        let writing = tokio::spawn(write(sink, Arc::clone(&outbox)));
        Self { requests, writing, outbox }
    }

    /// Waits for the client's next word, or for its end.
    pub async fn hear(&mut self) -> Said {
        loop {
            let message = tokio::select! {
                message = self.requests.next() => message,
                _ = &mut self.writing => return Said::Gone,
            };
            let request = match message {
                Some(Ok(Message::Text(text))) => Request::of_text(text.as_str()),
                Some(Ok(Message::Binary(bytes))) => Request::of_bytes(&bytes),
                // Pings are answered by the library.
                Some(Ok(Message::Ping(_) | Message::Pong(_))) => continue,
                Some(Ok(Message::Close(_)) | Err(_)) | None => return Said::Gone,
            };
            return match request {
                Ok(request) => Said::Request(request),
                Err(wrong) => Said::Nonsense(wrong),
            };
        }
    }

    /// Sends what waits, and that the server ends.
    pub async fn end(mut self) {
        self.outbox.forget(None);
        let reason = "the site server ends".into();
        self.outbox.answer(Message::Close(Some(CloseFrame { code: close_code::AWAY, reason })));
        self.outbox.close();
        // An error says that it was not there any more.
        let _ = tokio::time::timeout(SEND_TIMEOUT, &mut self.writing).await;
    }
}

async fn write(mut sink: SplitSink<WebSocket, Message>, outbox: Arc<Outbox>) {
    while let Some(message) = outbox.next().await {
        match tokio::time::timeout(SEND_TIMEOUT, sink.send(message)).await {
            Ok(Ok(())) => {}
            // A client that went away, or does not listen: nobody is left to tell.
            Ok(Err(_)) | Err(_) => return,
        }
    }
}
