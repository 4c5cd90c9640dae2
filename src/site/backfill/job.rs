//! One machine is asked for what the recording lacks.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::TrySendError;
use std::time::{Duration, Instant};

use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::ConsolidationMode;

use super::{Books, Outlets};
use crate::record::{Gap, Ranges};
use crate::site::inlet::Inbound;
use crate::site::sessions::Command;
use crate::wire::{Batch, BootId, Holdings, RecordRequest, Topic, Wanted, encode_json, record_key};

/// An answer that takes longer is lost: dropped for want of room on the link.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(3);
/// A piece should take no longer: the next is smaller.
const PIECE_TIME: Duration = Duration::from_millis(400);
/// Size of the smallest piece, and of the first; the largest is what Zenoh queues at one priority, two batches, so
/// that it need not be dropped on a link that is busy for a moment.
pub(super) const PIECE_BYTES: (u64, u64) = (8 * 1024, 64 * 1024);
const PIECE_BYTES_MAX: u64 = 128 * 1024;
/// Pauses between pieces are as long as the pieces took, within these.
const PAUSE: (Duration, Duration) = (Duration::from_millis(5), Duration::from_millis(500));
/// The recorder writes a piece in less, or does not write.
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);
/// Ranges of a topic in one question.
const RANGES_ASKED: usize = 100;
/// No answer of ours is longer; a piece is what was asked for, or one message. Longer ones are not copied.
const ANSWER_BYTES_MAX: usize = 4 << 20;

/// One machine is asked what it holds, and for what is missing.
pub(super) struct Job {
    pub outlets: Arc<Outlets>,
    pub books: Books,
    pub machine: Arc<str>,
    /// The run that is asked, also about earlier ones.
    pub boot: BootId,
    /// What it held some time before.
    pub before: Option<Holdings>,
    pub piece_bytes: u64,
    /// Messages that are still to be fetched.
    pub left: Arc<AtomicU64>,
}

/// What became of a job.
pub(super) struct Outcome {
    pub holdings: Option<(Instant, Holdings)>,
    pub piece_bytes: u64,
    pub result: Result<(), String>,
}

impl Outcome {
    /// Of a job that has told nothing.
    pub fn failed(reason: String) -> Self {
        Self { holdings: None, piece_bytes: PIECE_BYTES.0, result: Err(reason) }
    }
}

impl Job {
    pub async fn run(mut self) -> Outcome {
        let at = Instant::now();
        let mut holdings = None;
        let result = match self.ask_holdings().await {
            Err(reason) => Err(reason),
            Ok(held) => {
                let fetched = self.fetch(&held).await;
                holdings = Some((at, held));
                fetched
            }
        };
        Outcome { holdings, piece_bytes: self.piece_bytes, result }
    }

    async fn fetch(&mut self, holdings: &Holdings) -> Result<(), String> {
        let plan = self.books.lock().plan(&self.machine, holdings, self.before.as_ref());
        let mut left = plan.count();
        self.left.store(left, Ordering::Relaxed);
        self.warn(&plan.lost);
        // What is young is missed most.
        for (boot, mut wanted) in plan.wanted.into_iter().rev() {
            let mut lacking = BTreeMap::new();
            while !wanted.is_empty() {
                let begun = Instant::now();
                let Some(count) = self.piece(boot, &mut wanted, &mut lacking, begun).await? else { break };
                left = left.saturating_sub(count);
                self.left.store(left, Ordering::Relaxed);
            }
            lacking.retain(|_, numbers: &mut Ranges| !numbers.is_empty());
            if !lacking.is_empty() {
                // The ring may have gone on since it told what it holds.
                let holdings = self.ask_holdings().await?;
                let lost = self.books.lock().not_there(&self.machine, boot, &lacking, &holdings);
                self.warn(&lost);
            }
        }
        self.left.store(0, Ordering::Relaxed);
        Ok(())
    }

    async fn ask_holdings(&self) -> Result<Holdings, String> {
        let answer = self.ask(&RecordRequest::Holdings).await?;
        Holdings::decode(&answer).map_err(|error| error.to_string())
    }

    /// Fetches a piece and takes it off `wanted`, and adds to `lacking` what should be in it and is not; says how
    /// many messages that were, `None` if there are none now.
    async fn piece(
        &mut self,
        boot: BootId,
        wanted: &mut Wanted,
        lacking: &mut BTreeMap<Topic, Ranges>,
        begun: Instant,
    ) -> Result<Option<u64>, String> {
        self.must_record()?;
        let some =
            |(topic, ranges): (&Topic, &Vec<_>)| (*topic, ranges[..ranges.len().min(RANGES_ASKED)].to_vec());
        let asked: Wanted = wanted.iter().map(some).collect();
        let request = RecordRequest::Messages { boot, wanted: asked.clone(), bytes: self.piece_bytes };
        let answer = self.ask(&request).await;
        let took = begun.elapsed();
        self.piece_bytes = match (&answer, took <= PIECE_TIME) {
            (Ok(_), true) => (self.piece_bytes * 2).min(PIECE_BYTES_MAX),
            _ => (self.piece_bytes / 2).max(PIECE_BYTES.0),
        };
        let mut batch = Batch::decode(&answer?).map_err(|error| error.to_string())?;
        batch.messages.retain(|(topic, attachment, _)| {
            let ranges = asked.get(topic).map_or(&[][..], Vec::as_slice);
            attachment.boot == boot
                && ranges.iter().any(|[first, last]| (*first..=*last).contains(&attachment.sequence))
        });
        let mut numbers: BTreeMap<Topic, Ranges> = BTreeMap::new();
        for (topic, attachment, _) in &batch.messages {
            numbers.entry(*topic).or_default().insert(attachment.sequence);
        }
        let count = batch.messages.len() as u64;
        let missing = self.books.lock().count_missing(&self.machine, boot, &numbers);
        for (topic, attachment, payload) in batch.messages {
            let machine = Arc::clone(&self.machine);
            let received = self.outlets.clock.now();
            let inbound = Inbound { machine, topic, payload: payload.into(), attachment, received };
            self.hand_over(Command::Fetched(inbound)).await?;
        }
        self.written(boot, &numbers).await?;
        let mut moved = count > 0;
        self.books.lock().filled(&self.machine, missing);
        for (topic, ranges) in &asked {
            let come = numbers.remove(topic).unwrap_or_default();
            // Of what was not asked for the answer says nothing.
            let answered = below(&set(ranges), batch.done.get(topic).copied().unwrap_or(0));
            moved |= !answered.is_empty();
            take_off(wanted, *topic, &answered, &come);
            lacking.entry(*topic).or_default().extend(&answered.without(&come));
        }
        if !moved {
            return Ok(None);
        }
        tokio::time::sleep(took.clamp(PAUSE.0, PAUSE.1)).await;
        Ok(Some(count))
    }

    /// What nobody writes need not be fetched.
    fn must_record(&self) -> Result<(), String> {
        if self.outlets.records() { Ok(()) } else { Err("nothing is recorded now".to_owned()) }
    }

    /// Waits until the recorder has written a piece, so that never more than one is in its channel.
    async fn written(&self, boot: BootId, numbers: &BTreeMap<Topic, Ranges>) -> Result<(), String> {
        let begun = Instant::now();
        while self.books.lock().count_missing(&self.machine, boot, numbers) > 0 {
            self.must_record()?;
            if begun.elapsed() > WRITE_TIMEOUT {
                return Err("the recorder does not write".to_owned());
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        Ok(())
    }

    async fn hand_over(&self, mut command: Command) -> Result<(), String> {
        let begun = Instant::now();
        loop {
            command = match self.outlets.recorder.try_send(command) {
                Ok(()) => return Ok(()),
                Err(TrySendError::Disconnected(_)) => return Err("the recorder has ended".to_owned()),
                Err(TrySendError::Full(command)) => command,
            };
            if begun.elapsed() > WRITE_TIMEOUT {
                return Err("the recorder does not keep up".to_owned());
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    /// Of what will never be in the recording; the recorder tells it there.
    fn warn(&self, gaps: &[Gap]) {
        for gap in gaps {
            tracing::warn!(
                "machine {}, boot {}: {} {} to {} are lost: {}",
                gap.machine,
                gap.boot,
                gap.topic,
                gap.range.start,
                gap.range.end.saturating_sub(1),
                gap.cause.name()
            );
        }
    }

    async fn ask(&self, request: &RecordRequest) -> Result<Vec<u8>, String> {
        let payload = encode_json("question", request).map_err(|error| error.to_string())?;
        let key = record_key(&self.outlets.site, &self.machine, self.boot);
        let answers = self
            .outlets
            .session
            .get(key)
            .payload(payload)
            // The answer comes as the question goes: last of all, and dropped rather than in the way.
            .priority(Priority::Background)
            .congestion_control(CongestionControl::Drop)
            .consolidation(ConsolidationMode::None)
            .timeout(ANSWER_TIMEOUT)
            .await
            .map_err(|error| error.to_string())?;
        match answers.recv_async().await {
            Err(_) => Err("no answer".to_owned()),
            Ok(answer) => match answer.into_result() {
                Ok(sample) if sample.payload().len() > ANSWER_BYTES_MAX => {
                    Err(format!("an answer of {} bytes, may have {ANSWER_BYTES_MAX}", sample.payload().len()))
                }
                Ok(sample) => Ok(sample.payload().to_bytes().into_owned()),
                Err(refused) => Err(String::from_utf8_lossy(&refused.payload().to_bytes()).into_owned()),
            },
        }
    }
}

/// Takes off what was answered, and what has come.
fn take_off(wanted: &mut Wanted, topic: Topic, answered: &Ranges, come: &Ranges) {
    let Some(ranges) = wanted.get_mut(&topic) else { return };
    let left = set(ranges).without(answered).without(come);
    *ranges = left.iter().map(|range| [range.start, range.end - 1]).collect();
    if ranges.is_empty() {
        wanted.remove(&topic);
    }
}

fn set(ranges: &[[u64; 2]]) -> Ranges {
    let mut set = Ranges::default();
    ranges.iter().for_each(|[first, last]| set.insert_range(*first..last.saturating_add(1)));
    set
}

/// What of it is below `end`.
fn below(ranges: &Ranges, end: u64) -> Ranges {
    ranges.without(&Ranges::from(vec![(end, u64::MAX)]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_answered_is_taken_off_and_nothing_else() {
        let mut wanted: Wanted = [(Topic::Pose, vec![[3, 9], [20, 30]]), (Topic::Odom, vec![[0, 1]])].into();
        let come = Ranges::from(vec![(25, 27)]);
        // Only the first range was asked for, and all below 40 is in the answer.
        let answered = below(&set(&wanted[&Topic::Pose][..1]), 40);
        take_off(&mut wanted, Topic::Pose, &answered, &Ranges::default());
        assert_eq!(wanted[&Topic::Pose], [[20, 30]]);
        let answered = below(&set(&wanted[&Topic::Pose]), 22);
        take_off(&mut wanted, Topic::Pose, &answered, &come);
        assert_eq!(wanted[&Topic::Pose], [[22, 24], [27, 30]]);
        let answered = below(&set(&wanted[&Topic::Pose]), u64::MAX);
        take_off(&mut wanted, Topic::Pose, &answered, &Ranges::default());
        take_off(&mut wanted, Topic::Event, &answered, &Ranges::default());
        assert_eq!(wanted, [(Topic::Odom, vec![[0, 1]])].into());
    }
}
