//! How late the poses of a recording were.

use std::path::Path;

use super::Latency;
use crate::record::{RecordError, Recorded, read_messages};
use crate::replay::Times;
use crate::wire::{BootId, Topic, decode_report, payload_stamp};

/// What a machine published of a boot.
#[derive(Default)]
pub struct Published {
    to_sent: Times,
    to_recorded: Times,
    before_sent: u64,
    /// Of the messages that tell: mean times a count, largest of a second; the count.
    prediction_us: ([f64; 2], u64),
    update_us: ([f64; 2], u64),
}

impl Published {
    /// Reads the poses and reports of a machine; of one boot, if it is told. `tell` hears how many bytes of the files
    /// are behind.
    ///
    /// # Errors
    /// [`RecordError`] if a file cannot be read or is no MCAP file.
    pub fn read<'a>(
        paths: impl IntoIterator<Item = &'a Path>,
        machine: &str,
        boot: Option<BootId>,
        mut tell: impl FnMut(u64),
    ) -> Result<Self, RecordError> {
        let mut published = Self::default();
        let (mut bytes_before, mut read) = (0, 0_u64);
        for path in paths {
            let mut messages = read_messages(path)?;
            while let Some(message) = messages.next() {
                let message = message?;
                if message.machine == machine && (boot.is_none() || message.boot == boot) {
                    published.note(&message);
                }
                read += 1;
                if read.is_multiple_of(1_024) {
                    tell(bytes_before + messages.read_bytes());
                }
            }
            bytes_before += messages.read_bytes();
        }
        Ok(published)
    }

    fn note(&mut self, message: &Recorded<Vec<u8>>) {
        match message.topic {
            Topic::Pose => {
                let stamp = payload_stamp(Topic::Pose, &message.payload);
                if let Some(nanos) =
                    stamp.and_then(|stamp| u64::try_from((message.sent - stamp).as_nanos()).ok())
                {
                    self.to_sent.note(nanos);
                }
                match u64::try_from((message.received - message.sent).as_nanos()) {
                    Ok(nanos) => self.to_recorded.note(nanos),
                    Err(_) => self.before_sent += 1,
                }
            }
            Topic::Health => {
                let Ok(report) = decode_report(&message.payload) else { return };
                if let Some(prediction) = report.prediction {
                    add(&mut self.prediction_us, prediction.mean_us, prediction.p99_us);
                }
                if report.health.update_us > 0.0 {
                    add(&mut self.update_us, report.health.update_us, report.health.update_us);
                }
            }
            _ => {}
        }
    }

    /// What comes of it.
    pub fn latency(&self) -> Latency {
        let told = |times: &Times| (times.count() > 0).then(|| times.distribution());
        let mean = |([sum, most], count): ([f64; 2], u64)| (count > 0).then(|| [sum / count as f64, most]);
        Latency {
            stamp_to_sent_us: told(&self.to_sent),
            sent_to_recorded_us: told(&self.to_recorded),
            recorded_before_sent: self.before_sent,
            prediction_us: mean(self.prediction_us),
            update_us: mean(self.update_us),
        }
    }
}

fn add(([sum, most], count): &mut ([f64; 2], u64), mean: f64, largest: f64) {
    *sum += mean;
    *most = most.max(largest);
    *count += 1;
}
