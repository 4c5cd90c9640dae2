//! ROS 2 bags in MCAP: which files they are, and the readings in them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::ImportError;
use super::bag_folder::{BagFolder, mcap_files};
use super::ros::{self, Refusal};
use crate::config::Topics;
use crate::export::Faults;
use crate::record::{self, Channel, RecordError, read_any};
use crate::sensors::{Arrival, Sensor};
use crate::time::{Span, Stamp};

/// Readings are held for so long, to be put into the order of their arrival.
const ORDER_WITHIN: Span = Span::from_millis(2_000);
/// At most so many of them: a second of 20 machines.
const HELD_MAX: usize = 20_000;
/// Messages between two calls of `progress`.
const PROGRESS_EVERY: u64 = 4_096;

/// When a reading of a bag reached the machine's computer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArrivalTime {
    /// When the bag's recorder received it.
    Received,
    /// At its stamp: for bags whose recorder went by another clock than the sensors.
    Stamped,
}

/// A bag, as far as it is known before its messages are read.
#[derive(Clone, Debug)]
pub struct Bag {
    files: Vec<PathBuf>,
    bytes: u64,
    /// Of each sensor that is in it, its topic.
    topics: BTreeMap<Sensor, String>,
    /// The joint that is the cabin turn.
    joint: String,
    /// What is strange about it, such as a topic of the map that it does not have.
    faults: Faults,
}

/// What was read of a bag.
#[derive(Clone, Debug)]
pub struct BagReport {
    /// Of each sensor, how many messages there were on its topic, and how many became readings.
    pub sensors: BTreeMap<Sensor, BagTopic>,
    /// What could not be used, or not as it was.
    pub faults: Faults,
}

/// What was read of one topic.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BagTopic {
    /// Its name.
    pub topic: String,
    /// Messages on it.
    pub messages: u64,
    /// Messages that became readings.
    pub readings: u64,
    /// Fixes that say that they are none.
    pub no_fix: u64,
}

impl Bag {
    /// Opens a bag folder or a single MCAP file; `topics` says where the readings of the machine `id` are.
    ///
    /// # Errors
    /// [`ImportError`] if it is no bag, or has no readings of the IMU, or a topic is of another type than its
    /// sensor; the message lists what is there.
    pub fn open(path: &Path, topics: &Topics, id: &str) -> Result<Self, ImportError> {
        let BagFolder { files, mut faults } = mcap_files(path)?;
        let mut found: BTreeMap<String, Channel> = BTreeMap::new();
        let (mut bytes, mut lost_bytes) = (0, 0);
        for file in &files {
            let unreadable = |source| ImportError::Unreadable { path: file.clone(), source };
            bytes += std::fs::metadata(file).map_err(unreadable)?.len();
            let (channels, lost) = record::channels(file)?;
            lost_bytes += lost;
            for channel in channels {
                match found.get(&channel.topic) {
                    Some(other) if *other != channel => {
                        let message = format!(
                            "topic {} is {} here, and {} elsewhere in the bag",
                            channel.topic,
                            kind(&channel),
                            kind(other)
                        );
                        return Err(ImportError::Bag { path: file.clone(), message });
                    }
                    _ => {
                        found.insert(channel.topic.clone(), channel);
                    }
                }
            }
        }
        let refuse = |message| Err(ImportError::Bag { path: path.to_owned(), message });
        let mut there = BTreeMap::new();
        for sensor in Sensor::ALL {
            let ours = topics.is_empty().then(|| format!("/{id}/sensor/{sensor}"));
            let Some(topic) = topics.of(sensor).map(str::to_owned).or(ours) else { continue };
            match found.get(&topic) {
                Some(channel) => {
                    let right = ros::types_of(sensor);
                    if channel.encoding != "cdr" || !right.contains(&channel.message_type.as_str()) {
                        return refuse(format!(
                            "topic {topic} is {}, but {sensor} must be {} in cdr",
                            kind(channel),
                            right.join(" or ")
                        ));
                    }
                    there.insert(sensor, topic);
                }
                None if sensor == Sensor::Imu => {
                    return refuse(format!(
                        "has no topic {topic}, which must be that of the cabin IMU; {}",
                        list(&found, lost_bytes)
                    ));
                }
                // Where nothing was said, nothing is missing.
                None if topics.is_empty() => {}
                None => {
                    let kind = format!("{}: topics of the machine file that are not there", path.display());
                    faults.note(&kind, || format!("{topic} of {sensor}; {}", list(&found, lost_bytes)));
                }
            }
        }
        Ok(Self { files, bytes, topics: there, joint: topics.cabin_turn_joint.clone(), faults })
    }

    /// Length of its files.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Hands every reading to `sink`, in the order of arrival as far as it can be had within two seconds, or within
    /// 20 000 readings if that is less.
    /// `progress` gets the bytes that were read.
    ///
    /// # Errors
    /// A file cannot be read, or what `sink` says.
    pub fn read<E: From<RecordError>>(
        &self,
        arrival_time: ArrivalTime,
        mut sink: impl FnMut(&Arrival) -> Result<(), E>,
        mut progress: impl FnMut(u64),
    ) -> Result<BagReport, E> {
        let named = |(sensor, topic): (&Sensor, &String)| {
            (*sensor, BagTopic { topic: topic.clone(), ..BagTopic::default() })
        };
        let mut report =
            BagReport { sensors: self.topics.iter().map(named).collect(), faults: self.faults.clone() };
        let sensors: BTreeMap<&str, Sensor> =
            self.topics.iter().map(|(sensor, topic)| (topic.as_str(), *sensor)).collect();
        let mut order = Order::default();
        let mut bytes_before = 0;
        for path in &self.files {
            let mut messages = read_any(path)?;
            let mut read = 0_u64;
            while let Some(message) = messages.next() {
                let message = message?;
                read += 1;
                if read.is_multiple_of(PROGRESS_EVERY) {
                    progress(bytes_before + messages.bytes_read());
                }
                let Some(sensor) = sensors.get(message.channel.topic.as_str()) else { continue };
                let topic = report.sensors.entry(*sensor).or_default();
                topic.messages += 1;
                let number = topic.messages;
                let reading = match ros::reading(*sensor, &message, &self.joint) {
                    Ok(reading) => reading,
                    Err(Refusal::NoFix) => {
                        topic.no_fix += 1;
                        continue;
                    }
                    Err(Refusal::Unusable(reason)) => {
                        let kind = about(path, &message.channel, "messages that cannot be used");
                        report.faults.note(&kind, || format!("message {number}: {reason}"));
                        continue;
                    }
                };
                topic.readings += 1;
                let arrival = match arrival_time {
                    ArrivalTime::Received => message.received,
                    ArrivalTime::Stamped => reading.stamp(),
                };
                let arrival = Arrival { arrival, reading };
                if let Some(behind) = order.push(arrival) {
                    let kind =
                        about(path, &message.channel, "messages that came too late to be put in order");
                    report.faults.note(&kind, || {
                        format!(
                            "message {number} at {}, {:.3} s before one that is written",
                            message.received,
                            behind.as_seconds()
                        )
                    });
                }
                while let Some(arrival) = order.next(false) {
                    sink(&arrival)?;
                }
            }
            report.faults.note_lost(path, messages.lost_bytes());
            bytes_before += messages.bytes_read();
            progress(bytes_before);
        }
        while let Some(arrival) = order.next(true) {
            sink(&arrival)?;
        }
        Ok(report)
    }
}

fn kind(channel: &Channel) -> String {
    let Channel { message_type, encoding, .. } = channel;
    let message_type = if message_type.is_empty() { "of no type" } else { message_type };
    format!("{message_type} in {}", if encoding.is_empty() { "no encoding" } else { encoding })
}

fn list(found: &BTreeMap<String, Channel>, lost_bytes: u64) -> String {
    let lost = match lost_bytes {
        0 => String::new(),
        lost => format!("; {lost} bytes are torn off or damaged"),
    };
    if found.is_empty() {
        return format!("it has no topics at all{lost}");
    }
    let topics: BTreeSet<String> =
        found.values().map(|channel| format!("{} ({})", channel.topic, channel.message_type)).collect();
    format!("it has {}{lost}", topics.into_iter().collect::<Vec<_>>().join(", "))
}

fn about(path: &Path, channel: &Arc<Channel>, what: &str) -> String {
    format!("{}: {}: {what}", path.display(), channel.topic)
}

/// Puts readings into the order of arrival, within bounds; those of equal arrival stay as they came.
#[derive(Default)]
struct Order {
    held: BTreeMap<(Stamp, u64), Arrival>,
    count: u64,
    given: Option<Stamp>,
}

impl Order {
    /// Takes a reading; says by how much it comes too late to be put in its place.
    fn push(&mut self, arrival: Arrival) -> Option<Span> {
        self.held.insert((arrival.arrival, self.count), arrival);
        self.count += 1;
        self.given.filter(|given| arrival.arrival < *given).map(|given| given - arrival.arrival)
    }

    fn next(&mut self, all: bool) -> Option<Arrival> {
        let (oldest, newest) = (self.held.first_key_value()?.0.0, self.held.last_key_value()?.0.0);
        if !all && newest - oldest <= ORDER_WITHIN && self.held.len() <= HELD_MAX {
            return None;
        }
        let (_, arrival) = self.held.pop_first()?;
        self.given = Some(self.given.map_or(arrival.arrival, |given| given.max(arrival.arrival)));
        Some(arrival)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensors::{CabinTurn, Reading};

    fn turn(arrival_ms: i64, angle_rad: f64) -> Arrival {
        let arrival = Stamp::default() + Span::from_millis(arrival_ms);
        Arrival { arrival, reading: Reading::CabinTurn(CabinTurn { stamp: arrival, angle_rad }) }
    }

    #[test]
    fn readings_are_put_in_order_within_two_seconds_and_told_beyond() {
        let mut order = Order::default();
        let mut out = Vec::new();
        let mut behind = Vec::new();
        for (index, ms) in [0, 1_500, 500, 500, 2_400, 5_000, 100, 5_100].into_iter().enumerate() {
            behind.extend(order.push(turn(ms, index as f64)).map(|span| (ms, span.as_nanos() / 1_000_000)));
            while let Some(arrival) = order.next(false) {
                out.push(arrival);
            }
        }
        while let Some(arrival) = order.next(true) {
            out.push(arrival);
        }
        let times: Vec<i64> = out.iter().map(|arrival| arrival.arrival.as_nanos() / 1_000_000).collect();
        assert_eq!(times, [0, 500, 500, 1_500, 2_400, 100, 5_000, 5_100]);
        assert_eq!(behind, [(100, 2_300)]);
        assert_eq!(out[1], turn(500, 2.0));
    }
}
