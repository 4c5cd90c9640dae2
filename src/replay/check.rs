//! Holds what a machine published against what comes out of its readings again.

use crate::estimator::Options;
use crate::lie::{So3, Vec3};
use crate::record::{Published, RecordedBoot};
use crate::sensors::Sensor;
use crate::state::Estimate;
use crate::time::Stamp;
use crate::wire::{
    BootId, Odometry, PAGE_READINGS_MAX, RosMessage as _, Topic, odom_message, payload_stamp, pose_message,
};

use super::again;

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
pub fn check(recorded: &RecordedBoot, options: Options, mut tell: impl FnMut(f64)) -> Checked {
    let run = &recorded.run;
    let mut tracks = [
        Track::new(Topic::Pose, &recorded.poses, |estimate| pose_message(estimate).encode()),
        Track::new(Topic::Odom, &recorded.odoms, |estimate| odom_message(estimate).encode()),
    ];
    let samples = run.arrivals.iter().filter(|arrival| arrival.reading.sensor() == Sensor::Imu).count();
    let mut estimates = 0_u64;
    let outcome = again(run, options, |estimate| {
        estimates += 1;
        tracks.iter_mut().for_each(|track| track.meet(estimate));
        if estimates.is_multiple_of(1_024) {
            tell(estimates as f64 / samples.max(1) as f64);
        }
    });
    let mut unchecked = Vec::new();
    let mut after_journal = 0;
    let lefts = tracks.each_ref().map(Track::left);
    let beyond = recorded.readings.saturating_sub(run.arrivals.len() as u64);
    match (&outcome, &recorded.gap) {
        (Err(error), _) => tracks.iter_mut().for_each(|track| track.another_run(&error.to_string())),
        (Ok(()), Some(gap)) => unchecked.push(format!("{}: {gap}", counted(lefts))),
        (Ok(()), None) if beyond > PAGE_READINGS_MAX as u64 => {
            let what = counted(lefts);
            unchecked.push(format!("{what}: the journal ends {beyond} readings before the recording"));
        }
        (Ok(()), None) => after_journal = lefts.iter().sum(),
    }
    let missing = tracks.each_ref().map(|track| track.missing(estimates));
    if missing != [0, 0] {
        unchecked.push(format!("{}: they are not in the recording", counted(missing)));
    }
    let [poses, odoms] = tracks;
    let span = run.arrivals.first().zip(run.arrivals.last());
    let firsts = [&poses, &odoms].into_iter().filter_map(|track| track.first.clone());
    Checked {
        boot: recorded.boot,
        poses: poses.compared,
        odoms: odoms.compared,
        estimates,
        span_s: span.map_or(0.0, |(first, last)| last.arrival.seconds_since(first.arrival)),
        differing: poses.differing + odoms.differing,
        // Of equal stamps the pose.
        first: firsts.min_by_key(|difference| difference.stamp),
        unchecked,
        after_journal,
    }
}

/// What was published on one topic, and how far it was compared.
struct Track<'a> {
    topic: Topic,
    recorded: &'a [Published],
    encode: fn(&Estimate) -> Vec<u8>,
    next: usize,
    compared: u64,
    differing: u64,
    first: Option<Difference>,
}

impl<'a> Track<'a> {
    fn new(topic: Topic, recorded: &'a [Published], encode: fn(&Estimate) -> Vec<u8>) -> Self {
        Self { topic, recorded, encode, next: 0, compared: 0, differing: 0, first: None }
    }

    /// An estimate that came out again; not all of them are published.
    fn meet(&mut self, estimate: &Estimate) {
        while let Some(published) = self.recorded.get(self.next) {
            match payload_stamp(self.topic, &published.payload) {
                Some(stamp) if stamp > estimate.stamp => return,
                Some(stamp) if stamp == estimate.stamp => {
                    let found = (self.encode)(estimate);
                    self.next += 1;
                    self.compared += 1;
                    if found != published.payload {
                        self.differs(published, Some(stamp), apart(&published.payload, &found));
                    }
                    return;
                }
                stamp => {
                    self.next += 1;
                    self.compared += 1;
                    self.differs(published, stamp, How::NotAgain);
                }
            }
        }
    }

    fn differs(&mut self, published: &Published, stamp: Option<Stamp>, how: How) {
        self.differing += 1;
        let Published { sequence, .. } = *published;
        self.first.get_or_insert(Difference { topic: self.topic, sequence, stamp, how });
    }

    /// The next message cannot be had again.
    fn another_run(&mut self, why: &str) {
        if let Some(published) = self.recorded.get(self.next) {
            let stamp = payload_stamp(self.topic, &published.payload);
            self.differs(published, stamp, How::AnotherRun(why.to_owned()));
        } else if self.first.is_none() {
            self.differing += 1;
            let how = How::AnotherRun(why.to_owned());
            self.first = Some(Difference { topic: self.topic, sequence: 0, stamp: None, how });
        }
    }

    fn left(&self) -> u64 {
        (self.recorded.len() - self.next) as u64
    }

    /// Messages whose numbers are missing before the last one. Of a boot of which nothing comes out again, those
    /// before the first one do not count: it began before the recording.
    fn missing(&self, estimates: u64) -> u64 {
        let Some((first, last)) = self.recorded.first().zip(self.recorded.last()) else {
            return estimates;
        };
        let from = if estimates > 0 { 0 } else { first.sequence };
        (u64::from(last.sequence - from) + 1).saturating_sub(self.recorded.len() as u64)
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
