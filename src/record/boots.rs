//! What a recording holds of a machine's boots, step by step: what its estimator took, and what it published.

use std::collections::{BTreeMap, BTreeSet};

use super::RecordError;
use super::places::{Found, InOrder, Places};
use crate::sensors::{Arrival, Sensor};
use crate::wire::{BootId, JournalHead, JournalPage, Topic, decode_journal_page, decode_reading};

/// A published pose, as it was sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Published {
    /// Its number, the lower 32 bits.
    pub sequence: u32,
    /// CDR.
    pub payload: Vec<u8>,
}

/// What the estimator of a boot did next.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// It took a reading.
    Reading {
        /// Which.
        arrival: Arrival,
        /// Whether the updater took it, too, and not the predictor alone.
        seen: bool,
    },
    /// The predictor took over the solution to which the reading of this number led.
    TookOver(u64),
}

/// One boot of a machine. It is read as it is asked for, and a few seconds of it are held.
pub struct RecordedBoot<'a> {
    messages: InOrder<'a>,
    boot: Option<BootId>,
    head: Option<JournalHead>,
    /// IMU samples.
    samples: u64,
    page: Option<Page>,
    any_page: bool,
    /// Why pages before could not be read.
    unreadable: Option<String>,
    /// The numbers of the next readings.
    next: BTreeMap<Sensor, u32>,
    taken: u64,
    takeovers: u64,
    /// Readings that were read, whether they could be used or not.
    readings: u64,
    gap: Option<String>,
    ended: bool,
}

/// A page of the journal that is being worked off.
struct Page {
    sensors: std::vec::IntoIter<Sensor>,
    unseen: BTreeSet<u64>,
    taken_over: Option<u64>,
}

impl Places {
    /// The boots of a machine of which there is more than its health and its events, oldest first.
    ///
    /// # Errors
    /// [`RecordError`] if a file cannot be read any more.
    pub fn boots(&self, machine: &str) -> Result<Vec<RecordedBoot<'_>>, RecordError> {
        let mut boots = Vec::new();
        for (boot, places) in self.boots_of(machine) {
            let has_more = Topic::ALL
                .iter()
                .any(|topic| !matches!(topic, Topic::Health | Topic::Event) && places.has(*topic));
            if !has_more {
                continue;
            }
            // Whoever took the readings stands on the first page; if that is lost, all is.
            let mut pages = InOrder::new(self, machine, boot, places);
            let first = pages.next(Topic::Journal)?;
            let first = first.and_then(|first| decode_journal_page(&first.payload).ok());
            let told = first.and_then(|page| page.head).map(|head| *head);
            boots.push(RecordedBoot {
                messages: InOrder::new(self, machine, boot, places),
                boot,
                head: told.or_else(|| places.head.clone()),
                samples: places.count(Topic::Sensor(Sensor::Imu)),
                page: None,
                any_page: false,
                unreadable: None,
                next: BTreeMap::new(),
                taken: 0,
                takeovers: 0,
                readings: 0,
                gap: None,
                ended: false,
            });
        }
        Ok(boots)
    }
}

impl RecordedBoot<'_> {
    /// Which; `None` in recordings that do not tell, and of which there is no journal.
    pub fn boot(&self) -> Option<BootId> {
        self.boot
    }

    /// Who took the readings, if the recording tells.
    pub fn head(&self) -> Option<&JournalHead> {
        self.head.as_ref()
    }

    /// Whether a page of the journal was met so far.
    pub fn has_journal(&self) -> bool {
        self.any_page
    }

    /// Samples of the cabin IMU in the recording.
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// Readings that were given out as steps.
    pub fn taken(&self) -> u64 {
        self.taken
    }

    /// What is missing, if something is: the steps have ended before it.
    pub fn gap(&self) -> Option<&str> {
        self.gap.as_deref()
    }

    /// The next step, from the boot on; `None` where the journal ends, or something is missing.
    ///
    /// The order of the readings is that of the journal, and does not rest on times, nor on the order of the file, in
    /// which messages that were fetched later come late.
    ///
    /// # Errors
    /// [`RecordError`] if a file cannot be read any more.
    pub fn next_step(&mut self) -> Result<Option<Step>, RecordError> {
        while self.gap.is_none() && !self.ended {
            let Some(page) = &mut self.page else {
                self.turn_page()?;
                continue;
            };
            let Some(sensor) = page.sensors.next() else {
                let taken_over = page.taken_over;
                self.page = None;
                if let Some(solution_of) = taken_over {
                    self.takeovers += 1;
                    return Ok(Some(Step::TookOver(solution_of)));
                }
                continue;
            };
            let seen = !page.unseen.contains(&self.taken);
            match self.reading(sensor)? {
                Ok(arrival) => {
                    self.taken += 1;
                    return Ok(Some(Step::Reading { arrival, seen }));
                }
                Err(gap) => self.breaks_off(gap),
            }
        }
        Ok(None)
    }

    /// The next message of topic `pose` or `odom`, by number.
    ///
    /// # Errors
    /// [`RecordError`] if a file cannot be read any more.
    pub fn next_published(&mut self, topic: Topic) -> Result<Option<Published>, RecordError> {
        let found = self.messages.next(topic)?;
        Ok(found.map(|Found { sequence, payload, .. }| Published { sequence, payload }))
    }

    /// Readings in the recording that were not given out; nothing is left to be given out then.
    ///
    /// # Errors
    /// [`RecordError`] if a file cannot be read any more.
    pub fn readings_left(&mut self) -> Result<u64, RecordError> {
        for sensor in Sensor::ALL {
            while self.messages.next(Topic::Sensor(sensor))?.is_some() {
                self.readings += 1;
            }
        }
        self.ended = true;
        Ok(self.readings - self.taken)
    }

    fn turn_page(&mut self) -> Result<(), RecordError> {
        let Some(message) = self.messages.next(Topic::Journal)? else {
            self.ended = true;
            if !self.any_page {
                self.gap = Some("there is no journal of it".to_owned());
            }
            return Ok(());
        };
        match decode_journal_page(&message.payload) {
            Ok(page) => {
                self.any_page = true;
                match self.fitting(&page) {
                    Ok(page) => self.page = Some(page),
                    Err(gap) => self.breaks_off(gap),
                }
            }
            Err(error) => self.unreadable = Some(error.to_string()),
        }
        Ok(())
    }

    fn breaks_off(&mut self, gap: String) {
        self.gap = Some(match self.unreadable.take() {
            Some(reason) => format!("{gap} ({reason})"),
            None => gap,
        });
    }

    /// The page, if it goes on where the one before has ended.
    fn fitting(&self, page: &JournalPage) -> Result<Page, String> {
        if Some(page.boot) != self.boot {
            return Err(format!("the journal goes on with boot {}", page.boot));
        }
        let (taken, takeovers) = (self.taken, self.takeovers);
        if page.first != taken {
            let begun = if taken == 0 { ": the beginning of the boot is not recorded" } else { "" };
            return Err(format!("the journal goes on at reading {}, not at {taken}{begun}", page.first));
        }
        if page.takeovers != takeovers {
            return Err(format!("the journal goes on at takeover {}, not at {takeovers}", page.takeovers));
        }
        let sensors = page.sensors().map_err(|error| error.to_string())?.into_iter();
        let unseen = page.unseen.iter().copied().collect();
        Ok(Page { sensors, unseen, taken_over: page.taken_over })
    }

    /// The next reading of a sensor; the inner error says why it cannot be had.
    fn reading(&mut self, sensor: Sensor) -> Result<Result<Arrival, String>, RecordError> {
        let wanted = self.next.entry(sensor).or_default();
        let Some(Found { sequence, sent, payload }) = self.messages.next(Topic::Sensor(sensor))? else {
            return Ok(Err(format!("message {wanted} of {sensor} is missing")));
        };
        self.readings += 1;
        if sequence != *wanted {
            return Ok(Err(format!("message {wanted} of {sensor} is missing")));
        }
        *wanted = sequence.wrapping_add(1);
        let reading = decode_reading(sensor, &payload);
        let arrival = reading.map(|reading| Arrival { arrival: sent, reading });
        Ok(arrival.map_err(|error| format!("message {sequence} of {sensor}: {error}")))
    }
}
