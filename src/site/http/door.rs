//! Where connections come in: as many as there is room for, and none that keeps us waiting.
//!
//! A client that sends its request byte by byte, or never, holds one of a bounded number of places, and not for
//! long: a head has [`HEAD_PATIENCE`] (also between two requests), a body [`BODY_PATIENCE`]. Of one address no more
//! than [`CONNECTIONS_OF_ONE`] connections are taken, so that nobody shuts out the others; a proxy speaks for many.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes, HttpBody as _};
use axum::extract::ConnectInfo;
use axum::http::Request;
use futures_util::{Stream, StreamExt as _, stream};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::task::JoinSet;
use tokio::time::Instant;

use crate::site::ended;

/// A head is there after so long, or the connection ends.
const HEAD_PATIENCE: Duration = Duration::from_secs(60);
/// A body is there after so long, or the answer is 408.
const BODY_PATIENCE: Duration = Duration::from_secs(30);
/// Connections at once. A process may have some thousand open files, or 1024.
const CONNECTIONS_MAX: usize = 768;
/// Of them, those of one address.
const CONNECTIONS_OF_ONE: usize = 256;
/// After a failure that is the system's, such as too many open files.
const PAUSE: Duration = Duration::from_millis(100);

/// The body did not come in time.
#[derive(Debug, thiserror::Error)]
#[error("the body was not there within {} s", BODY_PATIENCE.as_secs())]
pub(super) struct Late;

impl Late {
    /// Whether that is behind an error.
    pub fn is_behind(error: &(dyn std::error::Error + 'static)) -> bool {
        let mut next = Some(error);
        while let Some(error) = next {
            if error.is::<Late>() {
                return true;
            }
            next = error.source();
        }
        false
    }
}

/// Serves until `stopped` says so, then ends what is idle and waits for what is under way.
pub(super) async fn serve(
    listener: TcpListener,
    app: Router,
    proxies: &[IpAddr],
    mut stopped: watch::Receiver<bool>,
) {
    let places = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    let seats = Seats::default();
    let mut under_way = JoinSet::new();
    loop {
        let next = async {
            // Never closed.
            let place = Arc::clone(&places).acquire_owned().await.ok();
            (place, listener.accept().await)
        };
        let (place, accepted) = tokio::select! {
            next = next => next,
            Some(_) = under_way.join_next() => continue,
            () = ended(&mut stopped) => break,
        };
        let (stream, peer) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::debug!("a connection is not taken: {error}");
                tokio::time::sleep(PAUSE).await;
                continue;
            }
        };
        let most = if proxies.contains(&peer.ip()) { CONNECTIONS_MAX } else { CONNECTIONS_OF_ONE };
        match seats.take(peer.ip(), most) {
            Some(seat) => {
                let stopped = stopped.clone();
                under_way.spawn(connection(stream, peer, app.clone(), stopped, (place, seat)));
            }
            None => tracing::debug!("{} has {most} connections, and gets no more", peer.ip()),
        }
    }
    drop(listener);
    while under_way.join_next().await.is_some() {}
}

/// One connection, to its end, or to where a WebSocket takes it over; those have places of their own.
async fn connection(
    stream: TcpStream,
    peer: SocketAddr,
    app: Router,
    mut stopped: watch::Receiver<bool>,
    held: (Option<OwnedSemaphorePermit>, Seat),
) {
    if let Err(error) = stream.set_nodelay(true) {
        tracing::debug!("a connection waits to fill its packets: {error}");
    }
    let app = TowerToHyperService::new(app);
    let service = service_fn(move |request: Request<Incoming>| {
        let mut request = request.map(patient);
        request.extensions_mut().insert(ConnectInfo(peer));
        app.call(request)
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_PATIENCE)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    tokio::pin!(connection);
    let end = tokio::select! {
        end = connection.as_mut() => end,
        () = ended(&mut stopped) => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = end {
        tracing::debug!("{peer}: {error}");
    }
    drop(held);
}

/// A body that ends with [`Late`] when its time is over.
fn patient(body: Incoming) -> Body {
    if body.is_end_stream() {
        return Body::empty();
    }
    let data = Body::new(body).into_data_stream();
    Body::from_stream(until(data, Instant::now() + BODY_PATIENCE))
}

type Chunk = Result<Bytes, Box<dyn std::error::Error + Send + Sync>>;

fn until(
    data: impl Stream<Item = Result<Bytes, axum::Error>> + Send + 'static,
    end: Instant,
) -> Pin<Box<dyn Stream<Item = Chunk> + Send>> {
    let chunks = stream::unfold(Some(Box::pin(data)), move |data| async move {
        let mut data = data?;
        match tokio::time::timeout_at(end, data.next()).await {
            Ok(None) => None,
            Ok(Some(Ok(bytes))) => Some((Ok(bytes), Some(data))),
            Ok(Some(Err(error))) => Some((Err(error.into()), None)),
            Err(_) => Some((Err(Late.into()), None)),
        }
    });
    Box::pin(chunks)
}

/// How many connections each address has.
#[derive(Clone, Default)]
struct Seats(Arc<Mutex<HashMap<IpAddr, usize>>>);

/// One of them.
struct Seat {
    seats: Seats,
    of: IpAddr,
}

impl Seats {
    fn take(&self, of: IpAddr, most: usize) -> Option<Seat> {
        let mut taken = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let count = taken.entry(of).or_default();
        if *count >= most {
            return None;
        }
        *count += 1;
        Some(Seat { seats: self.clone(), of })
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        let mut taken = self.seats.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = taken.get_mut(&self.of) {
            *count -= 1;
            if *count == 0 {
                taken.remove(&self.of);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_has_so_many_seats_and_gets_them_back() {
        let (seats, one, other) =
            (Seats::default(), IpAddr::from([10, 0, 0, 1]), IpAddr::from([10, 0, 0, 2]));
        let mut held: Vec<Seat> = (0..3).filter_map(|_| seats.take(one, 3)).collect();
        assert!(held.len() == 3 && seats.take(one, 3).is_none() && seats.take(other, 3).is_some());
        held.pop();
        assert!(seats.take(one, 3).is_some());
        drop(held);
        assert!(seats.0.lock().expect("not poisoned").is_empty(), "nothing is kept of who is gone");
    }

    #[tokio::test]
    async fn a_body_that_trickles_ends_late_and_one_in_time_is_whole() {
        let trickle = || {
            stream::unfold((), |()| async {
                tokio::time::sleep(Duration::from_millis(1)).await;
                Some((Ok(Bytes::from_static(b"x")), ()))
            })
        };
        let in_time = Body::from_stream(until(trickle().take(20), Instant::now() + BODY_PATIENCE));
        assert_eq!(axum::body::to_bytes(in_time, 100).await.expect("in time").len(), 20);
        let end = Instant::now() + Duration::from_millis(50);
        let late = Body::from_stream(until(trickle(), end));
        let error = axum::body::to_bytes(late, 10_000).await.expect_err("late");
        assert!(Late::is_behind(&error) && Instant::now() >= end, "{error:?}");
    }
}
