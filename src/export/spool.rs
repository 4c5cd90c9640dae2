//! Poses of many machines come in mixed, and late ones among them; they go out machine by machine in the order
//! of their stamps. What does not fit into memory is sorted in parts in a scratch file, and merged at the end.

use std::collections::{BTreeMap, VecDeque};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::PathBuf;

use super::{TrackPose, about};
use crate::lie::Vec3;
use crate::time::Stamp;

/// Poses in memory at most: some 64 MB.
const POSES_HELD: usize = 1 << 20;
/// Poses of one part of the scratch file in memory at a time.
const POSES_READ: usize = 1_024;
/// Stamp, position, quaternion.
const RECORD_BYTES: usize = 8 * 8;

/// Poses by machine; the scratch file, if it comes to one, has no name and is gone with it.
pub struct Spool {
    scratch: PathBuf,
    file: Option<File>,
    spilled: u64,
    spilled_max: u64,
    limit: usize,
    held: usize,
    tracks: BTreeMap<String, Track>,
}

#[derive(Default)]
struct Track {
    held: Vec<TrackPose>,
    parts: Vec<Part>,
}

/// Sorted poses in the scratch file, counted in records.
#[derive(Clone, Copy)]
struct Part {
    first: u64,
    count: u64,
}

/// Poses of one machine with the same stamp; only the first was given out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Repeats {
    /// Those that say the same to the bit.
    pub same: u64,
    /// Those that say something else.
    pub contradicting: u64,
    /// The first stamp at which one says something else.
    pub first_contradicting: Option<Stamp>,
}

impl Spool {
    /// `scratch` is a file that may be made if there are many poses: a name on a disk with room, of nothing that is
    /// there.
    pub fn new(scratch: PathBuf) -> Self {
        Self::with_limit(scratch, POSES_HELD)
    }

    /// The same with at most `limit` poses in memory.
    pub fn with_limit(scratch: PathBuf, limit: usize) -> Self {
        Self {
            scratch,
            file: None,
            spilled: 0,
            spilled_max: u64::MAX,
            limit: limit.max(1),
            held: 0,
            tracks: BTreeMap::new(),
        }
    }

    /// The same with so many bytes of the scratch file at most: more is refused as [`io::ErrorKind::QuotaExceeded`].
    #[must_use]
    pub fn with_scratch_max(self, bytes: u64) -> Self {
        Self { spilled_max: bytes / RECORD_BYTES as u64, ..self }
    }

    /// Adds a pose of a machine.
    ///
    /// # Errors
    /// The scratch file cannot be written.
    pub fn push(&mut self, machine: &str, pose: TrackPose) -> io::Result<()> {
        if self.held >= self.limit {
            self.spill().map_err(|error| about(&self.scratch, error))?;
        }
        self.held += 1;
        match self.tracks.get_mut(machine) {
            Some(track) => track.held.push(pose),
            None => self.tracks.entry(machine.to_owned()).or_default().held.push(pose),
        }
        Ok(())
    }

    /// The machines that have poses, sorted, and how many each.
    pub fn machines(&self) -> Vec<(String, u64)> {
        let count =
            |track: &Track| track.held.len() as u64 + track.parts.iter().map(|part| part.count).sum::<u64>();
        self.tracks.iter().map(|(machine, track)| (machine.clone(), count(track))).collect()
    }

    /// Gives out the poses of a machine in the order of their stamps, and forgets them.
    ///
    /// # Errors
    /// The scratch file cannot be read, or `visit` fails.
    pub fn drain(
        &mut self,
        machine: &str,
        mut visit: impl FnMut(&TrackPose) -> io::Result<()>,
    ) -> io::Result<Repeats> {
        let mut repeats = Repeats::default();
        let Some(mut track) = self.tracks.remove(machine) else { return Ok(repeats) };
        self.held -= track.held.len();
        track.held.sort_by_key(|pose| pose.stamp);
        let mut sources: Vec<Source> = track.parts.iter().map(|part| Source::of(*part)).collect();
        sources.push(Source { ready: track.held.into(), left: Part { first: 0, count: 0 } });
        let mut last: Option<TrackPose> = None;
        loop {
            let mut next: Option<(Stamp, usize)> = None;
            for (index, source) in sources.iter_mut().enumerate() {
                if let Some(file) = &mut self.file {
                    source.refill(file).map_err(|error| about(&self.scratch, error))?;
                }
                // Parts are in the order in which their poses came: the earlier first among equals.
                if let Some(pose) = source.ready.front()
                    && next.is_none_or(|(stamp, _)| pose.stamp < stamp)
                {
                    next = Some((pose.stamp, index));
                }
            }
            let Some(pose) = next.and_then(|(_, index)| sources[index].ready.pop_front()) else { break };
            match &last {
                Some(last) if last.stamp == pose.stamp => {
                    if encode(last) == encode(&pose) {
                        repeats.same += 1;
                    } else {
                        repeats.contradicting += 1;
                        repeats.first_contradicting.get_or_insert(pose.stamp);
                    }
                }
                _ => {
                    visit(&pose)?;
                    last = Some(pose);
                }
            }
        }
        Ok(repeats)
    }

    /// Poses that went through the scratch file.
    pub fn spilled(&self) -> u64 {
        self.spilled
    }

    /// Moves all that is held into the scratch file, sorted.
    fn spill(&mut self) -> io::Result<()> {
        if self.spilled + self.held as u64 > self.spilled_max {
            return Err(io::ErrorKind::QuotaExceeded.into());
        }
        let file = match &mut self.file {
            Some(file) => file,
            None => {
                let mut options = OpenOptions::new();
                // Others write to folders such as /tmp, too: what is there is none of ours.
                options.read(true).write(true).create_new(true);
                let file = options.open(&self.scratch)?;
                // Without a name it is gone with the process, however that ends.
                fs::remove_file(&self.scratch)?;
                self.file.insert(file)
            }
        };
        file.seek(SeekFrom::End(0))?;
        let mut bytes = Vec::new();
        for track in self.tracks.values_mut().filter(|track| !track.held.is_empty()) {
            track.held.sort_by_key(|pose| pose.stamp);
            for poses in track.held.chunks(POSES_READ) {
                bytes.clear();
                poses.iter().for_each(|pose| bytes.extend(encode(pose)));
                file.write_all(&bytes)?;
            }
            let count = track.held.len() as u64;
            track.parts.push(Part { first: self.spilled, count });
            self.spilled += count;
            track.held.clear();
        }
        self.held = 0;
        Ok(())
    }
}

/// One sorted run on its way out.
struct Source {
    ready: VecDeque<TrackPose>,
    left: Part,
}

impl Source {
    fn of(part: Part) -> Self {
        Self { ready: VecDeque::new(), left: part }
    }

    fn refill(&mut self, file: &mut File) -> io::Result<()> {
        if !self.ready.is_empty() || self.left.count == 0 {
            return Ok(());
        }
        let count = self.left.count.min(POSES_READ as u64);
        let mut bytes = vec![0; count as usize * RECORD_BYTES];
        file.seek(SeekFrom::Start(self.left.first * RECORD_BYTES as u64))?;
        file.read_exact(&mut bytes)?;
        self.ready.extend(bytes.chunks_exact(RECORD_BYTES).map(decode));
        self.left = Part { first: self.left.first + count, count: self.left.count - count };
        Ok(())
    }
}

fn encode(pose: &TrackPose) -> [u8; RECORD_BYTES] {
    let mut bytes = [0; RECORD_BYTES];
    bytes[..8].copy_from_slice(&pose.stamp.as_nanos().to_le_bytes());
    let numbers = pose.position.iter().chain(&pose.quaternion_xyzw);
    for (place, number) in bytes[8..].chunks_exact_mut(8).zip(numbers) {
        place.copy_from_slice(&number.to_le_bytes());
    }
    bytes
}

fn decode(bytes: &[u8]) -> TrackPose {
    let word = |index: usize| -> [u8; 8] { std::array::from_fn(|byte| bytes[8 * index + byte]) };
    let number = |index: usize| f64::from_le_bytes(word(index));
    TrackPose {
        stamp: Stamp::from_nanos(i64::from_le_bytes(word(0))),
        position: Vec3::new(number(1), number(2), number(3)),
        quaternion_xyzw: [number(4), number(5), number(6), number(7)],
    }
}
