//! Holds what a machine published against what comes out of its readings again.

use crate::estimator::Options;
use crate::lie::{So3, Vec3};
use crate::record::{Published, RecordError, RecordedBoot, Step};
use crate::state::Estimate;
use crate::time::Stamp;
use crate::wire::{
    BootId, Odometry, PAGE_READINGS_MAX, RosMessage as _, Topic, odom_message, payload_stamp, pose_message,
};

use super::{Again, NotThatRun};

/// What came of one boot.
#[derive(Clone, Debug, PartialEq)]
pub struct Checked {
    /// Which.
    pub boot: Option<BootId>,
    /// Poses that were compared.
    pub poses: u64,
    /// Odometry messages that were compared.
    pub odoms: u64,
    /// Estimates that came out again.
    pub estimates: u64,
    /// From the first to the last reading by arrival, s.
    pub span_s: f64,
    /// Messages that were recorded otherwise than they come out again.
    pub differing: u64,
    /// The first of them, by stamp.
    pub first: Option<Difference>,
    /// What could not be checked, and why, in words.
    pub unchecked: Vec<String>,
    /// Why the run ended before its recording, if it did, whether anything is compared or not.
    pub broke_off: Option<String>,
    /// Poses and odometry after the last page of the journal: it was open when the recording ended.
    pub after_journal: u64,
}

/// A message that is not what comes out again.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Pose or odom.
    pub topic: Topic,
    /// The message's number.
    pub sequence: u32,
    /// The message's stamp; `None` if it has none that can be read.
    pub stamp: Option<Stamp>,
    /// How.
    pub how: How,
}

/// How a recorded message differs.
#[derive(Clone, Debug, PartialEq)]
pub enum How {
    /// The same sample, other bits.
    Apart {
        /// Between the positions, m.
        position_m: f64,
        /// Between the attitudes, rad.
        rotation: f64,
        /// The parts of the message that differ.
        parts: Vec<&'static str>,
    },
    /// The recorded message is no odometry.
    Unreadable(String),
    /// No such sample comes out again.
    NotAgain,
    /// Readings and takeovers lead to another run before.
    AnotherRun(String),
}

/// Runs a boot again and compares. `tell` hears now and then which part of the readings was taken.
///
/// # Errors
/// [`RecordError`] if a file cannot be read any more.
pub fn check(
    recorded: &mut RecordedBoot<'_>,
    options: Options,
    mut tell: impl FnMut(f64),
) -> Result<Checked, RecordError> {
    let mut tracks = [
        Track::new(Topic::Pose, |estimate| pose_message(estimate).encode()),
        Track::new(Topic::Odom, |estimate| odom_message(estimate).encode()),
    ];
    let samples = recorded.samples().max(1) as f64;
    let mut estimates = 0_u64;
    let mut span: Option<(Stamp, Stamp)> = None;
    let mut again = Again::new(options);
    // What is taken over after the last reading changes nothing any more.
    let mut due: Vec<u64> = Vec::new();
    let mut another: Option<NotThatRun> = None;
    'run: while let Some(step) = recorded.next_step()? {
        let (arrival, seen) = match step {
            Step::TookOver(solution_of) => {
                due.push(solution_of);
                continue;
            }
            Step::Reading { arrival, seen } => (arrival, seen),
        };
        for solution_of in due.drain(..) {
            if let Err(error) = again.take_over(solution_of) {
                another = Some(error);
                break 'run;
            }
        }
        span = Some((span.map_or(arrival.arrival, |(first, _)| first), arrival.arrival));
        let Some(estimate) = again.push(&arrival, seen) else { continue };
        estimates += 1;
        for track in &mut tracks {
            track.meet(recorded, &estimate)?;
        }
        if estimates.is_multiple_of(1_024) {
            tell((estimates as f64 / samples).min(1.0));
        }
    }
    let [first_left, last_left] = &mut tracks;
    let lefts = [first_left.drain(recorded, another.as_ref())?, last_left.drain(recorded, another.as_ref())?];
    let beyond = recorded.readings_left()?;
    let mut unchecked = Vec::new();
    let mut after_journal = 0;
    let broke_off = match (&another, recorded.gap()) {
        (Some(error), _) => Some(error.to_string()),
        (None, Some(gap)) => Some(gap.to_owned()),
        (None, None) if beyond > PAGE_READINGS_MAX as u64 => {
            Some(format!("the journal ends {beyond} readings before the recording"))
        }
        (None, None) => {
            after_journal = lefts.iter().sum();
            None
        }
    };
    if let (Some(why), None) = (&broke_off, &another) {
        unchecked.push(format!("{}: {why}", counted(lefts)));
    }
    let missing = tracks.each_ref().map(|track| track.missing(estimates));
    if missing != [0, 0] {
        unchecked.push(format!("{}: they are not in the recording", counted(missing)));
    }
    let [poses, odoms] = tracks;
    let firsts = [&poses, &odoms].into_iter().filter_map(|track| track.first.clone());
    Ok(Checked {
        boot: recorded.boot(),
        poses: poses.compared,
        odoms: odoms.compared,
        estimates,
        span_s: span.map_or(0.0, |(first, last)| last.seconds_since(first)),
        differing: poses.differing + odoms.differing,
        // Of equal stamps the pose.
        first: firsts.min_by_key(|difference| difference.stamp),
        unchecked,
        broke_off,
        after_journal,
    })
}

/// What was published on one topic, and how far it was compared.
struct Track {
    topic: Topic,
    encode: fn(&Estimate) -> Vec<u8>,
    /// The message that is to be compared next.
    next: Option<Published>,
    /// Numbers of the first and the last message that was read, and how many those were.
    read: Option<(u32, u32)>,
    count: u64,
    compared: u64,
    differing: u64,
    first: Option<Difference>,
}

impl Track {
    fn new(topic: Topic, encode: fn(&Estimate) -> Vec<u8>) -> Self {
        Self { topic, encode, next: None, read: None, count: 0, compared: 0, differing: 0, first: None }
    }

    /// The next message that was published, left where it is.
    fn peek(&mut self, recorded: &mut RecordedBoot<'_>) -> Result<Option<&Published>, RecordError> {
        if self.next.is_none() {
            self.next = recorded.next_published(self.topic)?;
            if let Some(Published { sequence, .. }) = &self.next {
                self.read = Some((self.read.map_or(*sequence, |(first, _)| first), *sequence));
                self.count += 1;
            }
        }
        Ok(self.next.as_ref())
    }

    /// An estimate that came out again; not all of them are published.
    fn meet(&mut self, recorded: &mut RecordedBoot<'_>, estimate: &Estimate) -> Result<(), RecordError> {
        let topic = self.topic;
        while let Some(published) = self.peek(recorded)? {
            let stamp = payload_stamp(topic, &published.payload);
            if stamp.is_some_and(|stamp| stamp > estimate.stamp) {
                return Ok(());
            }
            let Some(published) = self.next.take() else { return Ok(()) };
            self.compared += 1;
            if stamp == Some(estimate.stamp) {
                let found = (self.encode)(estimate);
                if found != published.payload {
                    self.differs(&published, stamp, apart(&published.payload, &found));
                }
                return Ok(());
            }
            self.differs(&published, stamp, How::NotAgain);
        }
        Ok(())
    }

    fn differs(&mut self, published: &Published, stamp: Option<Stamp>, how: How) {
        self.differing += 1;
        let Published { sequence, .. } = *published;
        self.first.get_or_insert(Difference { topic: self.topic, sequence, stamp, how });
    }

    /// Reads the rest; says how many were not compared. If the run was another, the first of them differs.
    fn drain(
        &mut self,
        recorded: &mut RecordedBoot<'_>,
        another: Option<&NotThatRun>,
    ) -> Result<u64, RecordError> {
        self.peek(recorded)?;
        if let Some(error) = another {
            let how = How::AnotherRun(error.to_string());
            if let Some(published) = self.next.clone() {
                self.differs(&published, payload_stamp(self.topic, &published.payload), how);
            } else if self.first.is_none() {
                self.differing += 1;
                self.first = Some(Difference { topic: self.topic, sequence: 0, stamp: None, how });
            }
        }
        let mut left = 0;
        while self.peek(recorded)?.is_some() {
            self.next = None;
            left += 1;
        }
        Ok(left)
    }

    /// Messages whose numbers are missing before the last one. Of a boot of which nothing comes out again, those
    /// before the first one do not count: it began before the recording.
    fn missing(&self, estimates: u64) -> u64 {
        let Some((first, last)) = self.read else { return estimates };
        let from = if estimates > 0 { 0 } else { first };
        (u64::from(last - from) + 1).saturating_sub(self.count)
    }
}

/// How many of both.
fn counted([poses, odoms]: [u64; 2]) -> String {
    format!("{poses} poses and {odoms} odoms")
}

/// What differs between a recorded message and what came out again.
fn apart(recorded: &[u8], found: &[u8]) -> How {
    let (recorded, found) = match (Odometry::decode(recorded), Odometry::decode(found)) {
        (Ok(recorded), Ok(found)) => (recorded, found),
        (Err(error), _) | (_, Err(error)) => return How::Unreadable(error.to_string()),
    };
    let position = |message: &Odometry| Vec3::from(message.position);
    let rotation = |message: &Odometry| {
        let [x, y, z, w] = message.orientation;
        So3::from_xyzw(x, y, z, w)
    };
    let turned = rotation(&recorded).zip(rotation(&found));
    let same =
        |one: &[f64], other: &[f64]| one.iter().map(|v| v.to_bits()).eq(other.iter().map(|v| v.to_bits()));
    let parts = [
        ("position", same(&recorded.position, &found.position)),
        ("attitude", same(&recorded.orientation, &found.orientation)),
        ("pose covariance", same(&recorded.pose_covariance, &found.pose_covariance)),
        ("velocity", same(&recorded.linear, &found.linear)),
        ("turn rate", same(&recorded.angular, &found.angular)),
        ("twist covariance", same(&recorded.twist_covariance, &found.twist_covariance)),
        ("frames", recorded.header == found.header && recorded.child_frame_id == found.child_frame_id),
    ];
    How::Apart {
        position_m: (position(&recorded) - position(&found)).norm(),
        rotation: turned.map_or(f64::NAN, |(one, other)| (one.inverse() * other).log().norm()),
        parts: parts.into_iter().filter(|(_, same)| !same).map(|(part, _)| part).collect(),
    }
}
