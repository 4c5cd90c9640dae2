//! Recordings of the whole site: what is being written, what there is, what is kept.
//!
//! ```text
//! inlet, late messages ── inbox ──▶ recorder thread (owns the running session and its open file)
//!            API: start, stop ─────▶      │ finished files                       │ progress (watched by API,
//!                                         ▼                                      ▼  metrics, alerts)
//! API: list, notes ──▶ catalogue (folder of files, database) ◀── housekeeping thread: recovery, retention
//! ```
//! A session is a folder: its files `{id}-0000.mcap`, `{id}-0001.mcap`, ... and `session.json` with its name,
//! notes and tags. The files are the truth; the database only knows them by heart, and is made anew from them
//! if it is lost.
//!
//! The inbox takes what machines send at any time: a message that comes late is filed where the session is when
//! it comes, with the machine's own stamps, boot and number, by which it finds its place. Who sends much at once
//! waits for room in the inbox; callbacks that must not wait drop and count.

mod catalogue;
mod database;
mod folder;
mod housekeeping;
mod recorder;
mod retention;
mod running;
mod schedule;
mod space;
mod tracks;
mod view;

#[cfg(test)]
mod tests;

pub(super) use catalogue::{Catalogue, Located};
pub(super) use folder::{Notes, NotesChange};
pub(super) use recorder::{Answer, Command, Recorder, Refusal};
pub(super) use running::Progress;
pub(super) use space::disk_free_bytes;
pub(super) use tracks::{EVENTS_MAX, Events, POSES_MAX, STEP_LEAST, Track, Tracks, Wanted, events, tracks};
pub(super) use view::{RecordingState, RecordingView, SessionDetail, SessionView};
