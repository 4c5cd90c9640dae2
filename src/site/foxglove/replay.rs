//! A recorded session, played to one client.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use axum::extract::ws::WebSocket;
use serde_json::{Value, json};
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, MissedTickBehavior, sleep_until};

use super::channels::{Channel, Kind};
use super::outbox::Outbox;
use super::playback::{Playhead, check_speed};
use super::protocol::{self, Dialect, Parameter, PlaybackRequest, Request};
use super::socket::{Said, Socket};
use super::subscriptions::{Message, Subscriptions};
use crate::frames::geodesy::{Geodetic, SiteFrame};
use crate::record::{self, RecordError, Recorded, read_messages};
use crate::site::ended;
use crate::time::{Span, Stamp};
use crate::wire::Topic;

/// How often the time is sent.
const TIME_EVERY: Duration = Duration::from_millis(50);
/// Messages that are read ahead.
const READ_AHEAD: usize = 256;
const PLAYING: &str = "/playback/playing";
const SPEED: &str = "/playback/speed";
const POSITION: &str = "/playback/position_s";
/// Names in a client's list of parameters; ours are few.
const NAMES_MAX: usize = 64;

type Reader = mpsc::Receiver<Recorded<Vec<u8>>>;

/// What is played.
#[derive(Debug)]
pub(in crate::site) struct Session {
    name: String,
    files: Arc<Vec<File>>,
    /// When its first and its last message were received.
    span: (Stamp, Stamp),
    channels: Vec<Channel>,
    numbers: BTreeMap<String, u32>,
    /// `None` if the recording does not tell.
    frame: Option<SiteFrame>,
}

#[derive(Debug)]
struct File {
    path: PathBuf,
    /// When its last message was received.
    last: Stamp,
}

impl Session {
    /// Of files in the order of their numbers; `None` if there is no message in them. Reads the disk; a file that was
    /// not closed, all of it.
    ///
    /// # Errors
    /// [`RecordError`] if one of the files cannot be read.
    pub fn open(name: String, paths: Vec<PathBuf>) -> Result<Option<Self>, RecordError> {
        let mut files = Vec::new();
        let mut span: Option<(Stamp, Stamp)> = None;
        let mut topics: BTreeMap<String, BTreeSet<Topic>> = BTreeMap::new();
        let mut frame = None;
        for path in paths {
            for channel in record::channels(&path)?.0 {
                if let Some((machine, topic)) = channel.ours() {
                    topics.entry(machine.to_owned()).or_default().insert(topic);
                }
            }
            if frame.is_none() {
                frame = record::metadata(&path, record::SITE)?.and_then(|site| site_frame(&site));
            }
            let Some((first, last)) = span_of(&path)? else { continue };
            span = Some(span.map_or((first, last), |(from, to)| (from.min(first), to.max(last))));
            files.push(File { path, last });
        }
        let Some(span) = span else { return Ok(None) };
        let mut channels = Vec::new();
        let mut numbers = BTreeMap::new();
        for (number, (machine, topics)) in (0..).zip(topics) {
            let shared: Arc<str> = machine.as_str().into();
            let mut of_machine: Vec<Channel> = Vec::new();
            for kind in topics.into_iter().flat_map(Kind::of) {
                let channel = Channel::new(number, &shared, *kind);
                if !of_machine.contains(&channel) {
                    of_machine.push(channel);
                }
            }
            channels.extend(of_machine);
            numbers.insert(machine, number);
        }
        Ok(Some(Self { name, files: Arc::new(files), span, channels, numbers, frame }))
    }

    /// Messages from there on.
    fn read_from(&self, from: Stamp) -> Reader {
        let (sender, reader) = mpsc::channel(READ_AHEAD);
        let files = Arc::clone(&self.files);
        tokio::task::spawn_blocking(move || read(&files, from, &sender));
        reader
    }
}

/// When the first and the last message of a file were received. One that was not closed does not say so.
fn span_of(path: &Path) -> Result<Option<(Stamp, Stamp)>, RecordError> {
    match record::inspect(path) {
        Err(RecordError::Unfinished { .. }) => {
            let mut span: Option<(Stamp, Stamp)> = None;
            for message in read_messages(path)? {
                let at = message?.received;
                span = Some(span.map_or((at, at), |(first, last)| (first.min(at), last.max(at))));
            }
            Ok(span)
        }
        inspected => Ok(inspected?.span),
    }
}

fn site_frame(site: &BTreeMap<String, String>) -> Option<SiteFrame> {
    let number = |key| site.get(key).and_then(|text: &String| text.parse().ok());
    Some(SiteFrame::new(Geodetic {
        latitude_deg: number("latitude_deg")?,
        longitude_deg: number("longitude_deg")?,
        altitude_m: number("altitude_m")?,
    }))
}

/// Ends with the last message, or when nobody wants the next.
fn read(files: &[File], from: Stamp, sender: &mpsc::Sender<Recorded<Vec<u8>>>) {
    for File { path, .. } in files.iter().filter(|file| file.last >= from) {
        let messages = match read_messages(path) {
            Ok(messages) => messages,
            Err(error) => {
                tracing::warn!("not played: {error}");
                continue;
            }
        };
        for message in messages {
            // A seek elsewhere has dropped the receiver: this place is not wanted any more.
            if sender.is_closed() {
                return;
            }
            let message = match message {
                Ok(message) => message,
                Err(error) => {
                    tracing::warn!("not played to its end: {error}");
                    break;
                }
            };
            let shown = message.received >= from && !Kind::of(message.topic).is_empty();
            if shown && sender.blocking_send(message).is_err() {
                return;
            }
        }
    }
}

/// Plays a session to a client until it goes, or the site ends.
pub(in crate::site) async fn serve(
    socket: WebSocket,
    dialect: Dialect,
    session: Session,
    speed: f64,
    mut stopped: watch::Receiver<bool>,
) {
    let outbox = Arc::new(Outbox::default());
    outbox.answer(protocol::server_info(&session.name, &session.name, dialect, Some(session.span)));
    outbox.answer(protocol::advertise(&session.channels));
    let mut socket = Socket::new(socket, Arc::clone(&outbox));
    let mut player = Player {
        head: Playhead::new(session.span, speed, Instant::now()),
        reader: Some(session.read_from(session.span.0)),
        next: None,
        subscriptions: Subscriptions::default(),
        watched: BTreeSet::new(),
        outbox,
        dialect,
        session,
    };
    player.tell_state(false, "", Instant::now());
    let mut ticks = tokio::time::interval(TIME_EVERY);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        let due = player.next.as_ref().and_then(|message| player.head.due(message.received));
        let outbox = Arc::clone(&player.outbox);
        tokio::select! {
            biased;
            () = ended(&mut stopped) => return socket.end().await,
            said = socket.hear() => match said {
                Said::Gone => return,
                Said::Nonsense(wrong) => player.complain(&wrong),
                Said::Request(request) => player.request(request),
            },
            _ = ticks.tick() => if player.head.is_playing() {
                player.outbox.time(protocol::time(player.head.position(Instant::now())));
            },
            message = read_next(&mut player.reader), if player.next.is_none() && player.reader.is_some() => {
                match message {
                    Some(message) => player.next = Some(message),
                    None => player.reader = None,
                }
            }
            () = turn(due, &outbox), if due.is_some() => player.send(),
        }
        player.end_if_done();
    }
}

async fn read_next(reader: &mut Option<Reader>) -> Option<Recorded<Vec<u8>>> {
    reader.as_mut()?.recv().await
}

/// Waits until a message is due, and the client has room for it.
async fn turn(due: Option<Instant>, outbox: &Outbox) {
    if let Some(due) = due {
        sleep_until(due).await;
    }
    outbox.room().await;
}

struct Player {
    session: Session,
    head: Playhead,
    /// `None` when all was read.
    reader: Option<Reader>,
    next: Option<Recorded<Vec<u8>>>,
    subscriptions: Subscriptions,
    /// Parameters whose changes the client wants to know.
    watched: BTreeSet<String>,
    outbox: Arc<Outbox>,
    dialect: Dialect,
}

impl Player {
    fn send(&mut self) {
        let Some(message) = self.next.take() else { return };
        self.head.sent(message.received, Instant::now());
        let Some(number) = self.session.numbers.get(&message.machine) else { return };
        let message = Message {
            number: *number,
            machine: &message.machine,
            topic: message.topic,
            payload: &message.payload,
            time: message.received,
        };
        self.subscriptions.take(&message, self.session.frame.as_ref(), &self.outbox);
    }

    fn end_if_done(&mut self) {
        if self.head.is_playing() && self.reader.is_none() && self.next.is_none() {
            self.head.end();
            let now = Instant::now();
            self.outbox.time(protocol::time(self.head.position(now)));
            self.tell_state(false, "", now);
            self.tell_changed();
        }
    }

    fn request(&mut self, request: Request) {
        match request {
            Request::Subscribe(_) | Request::Unsubscribe(_) => {
                let wrong = self.subscriptions.request(request, &self.session.channels, &self.outbox);
                wrong.iter().for_each(|wrong| self.complain(wrong));
            }
            Request::GetParameters { names, id } => self.tell_parameters(&names, id.as_deref()),
            Request::SetParameters { parameters, id } => self.set(parameters, id.as_deref()),
            Request::SubscribeParameters(names) => {
                let all = [PLAYING, SPEED, POSITION].map(str::to_owned);
                self.watched.extend(if names.is_empty() { all.to_vec() } else { names });
                while self.watched.len() > NAMES_MAX {
                    self.watched.pop_last();
                }
            }
            Request::UnsubscribeParameters(names) => match names.is_empty() {
                true => self.watched.clear(),
                false => names.iter().for_each(|name| {
                    self.watched.remove(name);
                }),
            },
            Request::Playback(_) if self.dialect != Dialect::Sdk => {
                self.complain(
                    "playback requests are of foxglove.sdk.v1: set the parameters /playback/... instead",
                );
            }
            Request::Playback(PlaybackRequest { play, speed, seek, id }) => {
                let now = Instant::now();
                let changed = check_speed(speed).map(|()| self.change(Some(play), Some(speed), seek, now));
                let did_seek = changed.unwrap_or_else(|wrong| {
                    self.complain(&wrong);
                    false
                });
                self.tell_state(did_seek, &id, now);
                self.tell_changed();
            }
        }
    }

    /// Plays or pauses, at another speed, from another place; says whether it went to another place.
    fn change(&mut self, play: Option<bool>, speed: Option<f64>, seek: Option<Stamp>, now: Instant) -> bool {
        if let Some(speed) = speed {
            self.head.set_speed(speed, now);
        }
        let is_over = self.reader.is_none() && self.next.is_none();
        // Who plays what is over, plays it again.
        let again = (play == Some(true) && is_over).then_some(self.session.span.0);
        let seek = seek.or(again);
        if let Some(to) = seek {
            self.head.seek(to, now);
            self.next = None;
            self.reader = Some(self.session.read_from(self.head.position(now)));
            // What was to come from the other place is not wanted any more.
            self.outbox.forget(None);
        }
        match play {
            Some(true) => self.head.play(now),
            Some(false) => self.head.pause(now),
            // Over there it is not over.
            None if seek.is_some() && is_over => self.head.pause(now),
            None => {}
        }
        if seek.is_some() {
            self.outbox.time(protocol::time(self.head.position(now)));
        }
        seek.is_some()
    }

    fn set(&mut self, parameters: Vec<Parameter>, id: Option<&str>) {
        let now = Instant::now();
        let mut did_seek = false;
        let mut names = Vec::new();
        for Parameter { name, value } in parameters.into_iter().take(NAMES_MAX) {
            let wrong = match (name.as_str(), value.as_bool(), value.as_f64()) {
                (PLAYING, Some(play), _) => {
                    did_seek |= self.change(Some(play), None, None, now);
                    None
                }
                (SPEED, _, Some(speed)) => match check_speed(speed) {
                    Ok(()) => {
                        self.change(None, Some(speed), None, now);
                        None
                    }
                    Err(wrong) => Some(wrong),
                },
                (POSITION, _, Some(position_s)) if position_s.is_finite() => {
                    // More than centuries is the end all the same.
                    let ahead = Span::from_seconds(position_s.clamp(0.0, 1e9));
                    did_seek |= self.change(None, None, Some(self.session.span.0 + ahead), now);
                    None
                }
                (PLAYING | SPEED | POSITION, ..) => Some(format!("{name} cannot be {value:.80}")),
                _ => Some(format!(
                    "there is no parameter {name:.80}: there are {PLAYING}, {SPEED}, {POSITION}"
                )),
            };
            wrong.iter().for_each(|wrong| self.complain(wrong));
            names.push(name);
        }
        if id.is_some() {
            self.tell_parameters(&names, id);
        }
        self.tell_state(did_seek, "", now);
        self.tell_changed();
    }

    fn parameters(&self) -> [(&'static str, Value); 3] {
        let position = self.head.position(Instant::now()).seconds_since(self.session.span.0);
        [
            (PLAYING, json!(self.head.is_playing())),
            (SPEED, json!(self.head.speed())),
            (POSITION, json!(position)),
        ]
    }

    fn tell_parameters(&self, names: &[String], id: Option<&str>) {
        let wanted = |name: &str| names.is_empty() || names.iter().any(|wanted| wanted == name);
        let values: Vec<_> = self.parameters().into_iter().filter(|(name, _)| wanted(name)).collect();
        self.outbox.answer(protocol::parameter_values(&values, id));
    }

    /// To who wants to know that playback is not as it was.
    fn tell_changed(&self) {
        let watched = self.parameters().into_iter().filter(|(name, _)| self.watched.contains(*name));
        let values: Vec<_> = watched.collect();
        if !values.is_empty() {
            self.outbox.answer(protocol::parameter_values(&values, None));
        }
    }

    fn tell_state(&self, did_seek: bool, request: &str, now: Instant) {
        if self.dialect == Dialect::Sdk {
            let at = self.head.position(now);
            let (status, speed) = (self.head.status(), self.head.speed());
            self.outbox.answer(protocol::playback_state(status, at, speed, did_seek, request));
        }
    }

    fn complain(&self, wrong: &str) {
        self.outbox.answer(protocol::warning(wrong));
    }
}
