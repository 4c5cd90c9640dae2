//! The poses of a session's recording: one file or several, one machine or all.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use super::{Faults, Format, Outage, Spool, TrackPose, TrackWriter};
use crate::frames::geodesy::Geodetic;
use crate::record::{self, AnyMessage, RecordError, read_any};
use crate::state::{Event, EventKind};
use crate::time::Stamp;
use crate::wire::{Odometry, RosMessage, Topic, decode_event};

/// Messages between two calls of `progress`.
const PROGRESS_EVERY: u64 = 4_096;

/// Which poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Frame {
    /// Cabin IMU in the site frame: topic `pose`.
    World,
    /// In the machine's odom frame, the chassis where it is known: topic `odom`.
    Odom,
}

/// What was found.
pub struct Gathered {
    /// The poses.
    pub spool: Spool,
    /// The GNSS outages of each machine whose events or health were recorded, in their order.
    pub outages: BTreeMap<String, Vec<Outage>>,
    /// Origin of the site frame, where the recording tells it and the poses are in that frame.
    pub origin: Option<Geodetic>,
    /// The machines that have any topic in the files, sorted.
    pub machines: Vec<String>,
    /// What could not be used.
    pub faults: Faults,
}

/// Why poses that were gathered cannot be written as they were asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Lack {
    /// The machine that was asked for has no topic in the files.
    Machine,
    /// There are no poses.
    Poses,
    /// The format takes one track, and there are these machines.
    OneTrack(Vec<String>),
    /// The format needs the origin of the site, and the files do not tell it.
    Origin,
}

/// Why a recording's poses cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum GatherError {
    /// A file cannot be read.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The scratch file cannot be written.
    #[error(transparent)]
    Scratch(#[from] io::Error),
}

/// Reads the poses of `machine`, or of all, out of the files of a session. What cannot be used is passed over and
/// counted. `spool` takes them; `progress` gets the bytes that were read, of all files together.
///
/// # Errors
/// [`GatherError`] if a file cannot be read or is no MCAP file, or the spool cannot be written.
pub fn gather(
    paths: &[PathBuf],
    machine: Option<&str>,
    frame: Frame,
    spool: Spool,
    mut progress: impl FnMut(u64),
) -> Result<Gathered, GatherError> {
    let mut events: BTreeMap<String, Vec<Event>> = BTreeMap::new();
    let mut gathered = Gathered {
        spool,
        outages: BTreeMap::new(),
        origin: None,
        machines: Vec::new(),
        faults: Faults::default(),
    };
    let mut bytes_before = 0;
    for path in paths {
        // The odom frame is not tied to the earth: its poses have no places.
        if frame == Frame::World {
            gathered.take_origin(path)?;
        }
        for channel in record::channels(path)?.0 {
            gathered.machines.extend(channel.ours().map(|(machine, _)| machine.to_owned()));
        }
        let mut messages = read_any(path)?;
        // Of each topic, for the message's number.
        let mut counts: BTreeMap<String, u64> = BTreeMap::new();
        let mut read = 0_u64;
        while let Some(message) = messages.next() {
            let message = message?;
            read += 1;
            if read.is_multiple_of(PROGRESS_EVERY) {
                progress(bytes_before + messages.bytes_read());
            }
            let Some((of, topic)) = message.channel.ours() else { continue };
            if machine.is_some_and(|machine| machine != of) {
                continue;
            }
            let wanted = match frame {
                Frame::World => Topic::Pose,
                Frame::Odom => Topic::Odom,
            };
            if topic != wanted && !matches!(topic, Topic::Event | Topic::Health) {
                continue;
            }
            let of = of.to_owned();
            let number = match counts.get_mut(&message.channel.topic) {
                Some(count) => count,
                None => counts.entry(message.channel.topic.clone()).or_default(),
            };
            *number += 1;
            match topic {
                Topic::Health => {
                    // Tells that outages would have been told.
                    events.entry(of).or_default();
                }
                Topic::Event => match decode_event(&message.payload) {
                    Ok(event) => events.entry(of).or_default().push(event),
                    Err(error) => gathered.unusable(path, &message, *number, &error.to_string()),
                },
                _ => match pose(&message) {
                    Ok(pose) => gathered.spool.push(&of, pose)?,
                    Err(reason) => gathered.unusable(path, &message, *number, &reason),
                },
            }
        }
        gathered.faults.note_lost(path, messages.lost_bytes());
        bytes_before += messages.bytes_read();
        progress(bytes_before);
    }
    gathered.machines.sort();
    gathered.machines.dedup();
    for (machine, events) in events {
        gathered.outages.insert(machine, outages_of_events(&events));
    }
    Ok(gathered)
}

impl Gathered {
    /// What is missing for a file of that format of `machine`, or of all of them.
    pub fn lack(&self, machine: Option<&str>, format: Format, has_origin: bool) -> Option<Lack> {
        if machine.is_some_and(|wanted| !self.machines.iter().any(|known| known == wanted)) {
            return Some(Lack::Machine);
        }
        let tracks = self.spool.machines();
        match tracks.len() {
            0 => Some(Lack::Poses),
            1 => None,
            _ if format.one_track() => {
                Some(Lack::OneTrack(tracks.into_iter().map(|(machine, _)| machine).collect()))
            }
            _ => None,
        }
        .or_else(|| (format.needs_origin() && !has_origin).then_some(Lack::Origin))
    }

    /// Writes a track for each machine that has poses, and forgets them; `progress` hears now and then how many
    /// poses are done. Those that contradict one of the same stamp are left out, and noted as faults. Gives back
    /// how many were there twice, by machine.
    ///
    /// # Errors
    /// What the writer says, or the scratch file.
    pub fn write_tracks<W: io::Write>(
        &mut self,
        writer: &mut TrackWriter<W>,
        mut progress: impl FnMut(u64),
    ) -> io::Result<BTreeMap<String, u64>> {
        let (mut done, mut twice) = (0_u64, BTreeMap::new());
        for (machine, _) in self.spool.machines() {
            writer.begin_track(&machine, self.outages.remove(&machine))?;
            let repeats = self.spool.drain(&machine, |pose| {
                done += 1;
                if done.is_multiple_of(PROGRESS_EVERY) {
                    progress(done);
                }
                writer.pose(pose)
            })?;
            let kind = format!("{machine}: poses with the stamp of another, which were left out");
            self.faults.note_many(&kind, repeats.contradicting, || {
                repeats.first_contradicting.map_or(String::new(), |stamp| format!("at {stamp}"))
            });
            if repeats.same > 0 {
                twice.insert(machine, repeats.same);
            }
        }
        Ok(twice)
    }

    fn take_origin(&mut self, path: &Path) -> Result<(), RecordError> {
        let Some(site) = record::metadata(path, record::SITE)? else { return Ok(()) };
        let number = |key: &str| site.get(key).and_then(|value| value.parse::<f64>().ok());
        let (Some(latitude_deg), Some(longitude_deg), Some(altitude_m)) =
            (number("latitude_deg"), number("longitude_deg"), number("altitude_m"))
        else {
            return Ok(());
        };
        let origin = Geodetic { latitude_deg, longitude_deg, altitude_m };
        match self.origin {
            Some(before) if before != origin => {
                let kind = format!("{}: another origin of the site frame", path.display());
                self.faults.note(&kind, || format!("{origin:?} after {before:?}, which is taken for all"));
            }
            _ => self.origin = Some(origin),
        }
        Ok(())
    }

    fn unusable(&mut self, path: &Path, message: &AnyMessage, number: u64, reason: &str) {
        let kind = format!("{}: {}: messages that cannot be used", path.display(), message.channel.topic);
        self.faults.note(&kind, || format!("message {number}: {reason}"));
    }
}

fn pose(message: &AnyMessage) -> Result<TrackPose, String> {
    let odometry = Odometry::decode(&message.payload).map_err(|error| error.to_string())?;
    let pose = TrackPose {
        stamp: odometry.header.stamp,
        position: odometry.position.into(),
        quaternion_xyzw: odometry.orientation,
    };
    if pose.is_fit() {
        Ok(pose)
    } else {
        let [x, y, z, w] = pose.quaternion_xyzw;
        let p = pose.position;
        Err(format!("the position {} {} {} or the rotation {x} {y} {z} {w} is none", p.x, p.y, p.z))
    }
}

/// The outages that events tell of; one that began and is not told to have ended goes on. A new start of the
/// estimate ends it, for what comes then knows nothing of it.
pub fn outages_of_events(events: &[Event]) -> Vec<Outage> {
    let mut events: Vec<&Event> = events.iter().collect();
    events.sort_by_key(|event| event.stamp_ns);
    let mut outages: Vec<Outage> = Vec::new();
    let mut open: Option<Outage> = None;
    for event in events {
        let stamp = Stamp::from_nanos(event.stamp_ns);
        match &event.what {
            EventKind::OutageBegan { cause } => {
                let began = Outage { start: stamp, end: None, cause: cause.name().to_owned() };
                outages.extend(ended(open.replace(began), stamp));
            }
            EventKind::OutageEnded(report) => {
                open = None;
                outages.push(Outage {
                    start: Stamp::from_nanos(report.start_stamp_ns),
                    end: Some(report.end_stamp_ns.map_or(stamp, Stamp::from_nanos)),
                    cause: report.cause.name().to_owned(),
                });
            }
            EventKind::Restarted { .. } | EventKind::Initialized { .. } => {
                outages.extend(ended(open.take(), stamp));
            }
            _ => {}
        }
    }
    outages.extend(open);
    outages
}

fn ended(outage: Option<Outage>, end: Stamp) -> Option<Outage> {
    outage.map(|outage| Outage { end: Some(end), ..outage })
}
