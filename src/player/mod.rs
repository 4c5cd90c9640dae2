//! The machines of a recording as peers once more: what they said is said again.
//!
//! Each machine has a Zenoh session of its own, a liveliness token for each of its boots, and a queryable that says
//! that there is no on-board record: what the recording lacks cannot be had from here. Payloads are those that were
//! recorded, and so are stamps, sending times and numbers; boots get new ids, so that a site that has seen the
//! machines before does not take them for repetitions. Nothing is estimated here.

#![allow(clippy::disallowed_methods, reason = "a player passes time")]

mod peer;
mod timing;

use std::future::Future;
use std::time::{Duration, Instant};

use crate::link::LinkError;
use crate::record::Recorded;
use crate::time::Span;

use peer::Peer;
use timing::{Due, in_turn};

/// A site that has not subscribed for so long is not there.
const AUDIENCE_TIMEOUT: Duration = Duration::from_secs(10);
/// How often it is looked for.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// From the first subscription to the first message: by then all are known.
const LEAD: Duration = Duration::from_millis(300);
/// Progress is told, and shutdown looked for, so often at least.
const TURN: Duration = Duration::from_millis(100);

/// What is played, and how.
pub struct Options {
    /// The machines.
    pub machines: Vec<Part>,
    /// Zenoh endpoint of the site.
    pub endpoint: String,
    /// Seconds of the recording in a second.
    pub speed: f64,
}

/// One machine of a recording.
pub struct Part {
    /// Its id.
    pub id: String,
    /// Id of the site: first part of its keys.
    pub site: String,
    /// All it said, in the order in which it said it.
    pub messages: Vec<Recorded<Vec<u8>>>,
}

/// How far a session is played.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Progress {
    /// Messages that were sent.
    pub sent: u64,
    /// Messages that could not be sent.
    pub unsent: u64,
    /// Of so many.
    pub messages: u64,
    /// Of the session, s.
    pub data_s: f64,
    /// Its length, s.
    pub length_s: f64,
    /// Whether it ended because that was asked for, not because all was said.
    pub interrupted: bool,
}

/// Why a session cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum PlayerError {
    /// The link to the site.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// There is no site.
    #[error(
        "nobody at {endpoint} listens to machines of site {site}: does the site server run, with that id?"
    )]
    NobodyListens {
        /// Where it was looked for.
        endpoint: String,
        /// Whose machines.
        site: String,
    },
    /// The site was there, and is not any more.
    #[error(
        "the site at {endpoint} went away: of {messages} messages, {sent} were sent, of which it lacks the last"
    )]
    WentAway {
        /// Where it was.
        endpoint: String,
        /// Messages that were sent until that was seen.
        sent: u64,
        /// Of so many.
        messages: u64,
    },
}

/// Plays the session to its end, or until `shutdown`; says how far it came.
///
/// # Errors
/// [`PlayerError`] if a session cannot be opened, nobody listens, or who listened goes away.
pub async fn play(
    options: Options,
    mut tell: impl FnMut(Progress),
    shutdown: impl Future<Output = ()>,
) -> Result<Progress, PlayerError> {
    let Options { machines, endpoint, speed } = options;
    let mut peers = Vec::with_capacity(machines.len());
    for part in &machines {
        peers.push(Peer::open(part, &endpoint).await?);
    }
    let (mut progress, mut interrupted) = (Progress::default(), false);
    let outcome = tokio::select! {
        () = shutdown => {
            interrupted = true;
            Ok(())
        }
        outcome = say_all(&mut peers, machines, (&endpoint, speed), &mut progress, &mut tell) => outcome,
    };
    for peer in peers {
        peer.close().await;
    }
    outcome.map(|()| Progress { interrupted, ..progress })
}

async fn say_all(
    peers: &mut [Peer],
    machines: Vec<Part>,
    (endpoint, speed): (&str, f64),
    progress: &mut Progress,
    tell: &mut impl FnMut(Progress),
) -> Result<(), PlayerError> {
    for (peer, part) in peers.iter().zip(&machines) {
        if tokio::time::timeout(AUDIENCE_TIMEOUT, peer.heard(LOOK_EVERY)).await.is_err() {
            let (endpoint, site) = (endpoint.to_owned(), part.site.clone());
            return Err(PlayerError::NobodyListens { endpoint, site });
        }
    }
    let turns = in_turn(machines.into_iter().map(|part| part.messages).collect());
    let seconds = |span: Span| Duration::try_from_secs_f64(span.as_seconds() / speed).unwrap_or_default();
    let last = turns.last().map_or(Span::default(), |turn| turn.due);
    *progress = Progress { messages: turns.len() as u64, length_s: last.as_seconds(), ..Progress::default() };
    let begun = Instant::now() + LEAD;
    let mut looked = Instant::now();
    for Due { due, machine, message, is_last_of_boot } in turns {
        loop {
            let wait = (begun + seconds(due)).saturating_duration_since(Instant::now());
            if wait.is_zero() {
                break;
            }
            tokio::time::sleep(wait.min(TURN)).await;
            tell(*progress);
            look(peers, endpoint, progress, &mut looked).await?;
        }
        look(peers, endpoint, progress, &mut looked).await?;
        let peer = &mut peers[machine];
        let counter = if peer.say(message).await? { &mut progress.sent } else { &mut progress.unsent };
        *counter += 1;
        // A machine that was off is off again.
        if is_last_of_boot {
            peer.end_boot().await;
        }
        progress.data_s = due.as_seconds();
        if (progress.sent + progress.unsent).is_multiple_of(1_024) {
            tell(*progress);
            // Where nothing is waited for, a signal is still to be heard.
            tokio::task::yield_now().await;
        }
    }
    // What was said since may be on its way yet, or be lost.
    tokio::time::sleep(TURN).await;
    look(peers, endpoint, progress, &mut looked).await
}

/// Now and then, looks whether the site listens yet: nothing else tells that messages are lost.
async fn look(
    peers: &[Peer],
    endpoint: &str,
    progress: &Progress,
    looked: &mut Instant,
) -> Result<(), PlayerError> {
    if looked.elapsed() < TURN {
        return Ok(());
    }
    *looked = Instant::now();
    for peer in peers {
        if !peer.is_heard().await {
            let Progress { sent, messages, .. } = *progress;
            return Err(PlayerError::WentAway { endpoint: endpoint.to_owned(), sent, messages });
        }
    }
    Ok(())
}
