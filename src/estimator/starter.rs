//! The inbox and the start for estimators other than ours, so that all begin with the same knowledge.

use super::IMU_GAP_MAX;
use super::chassis_turn::ChassisTurn;
use super::inbox::{Admission, Inbox};
use super::initialization::{Initializer, Start};
use super::options::Options;
use super::resumption::Chassis;
use super::standstill::Standstill;
use super::updater::standstill_of;
use crate::sensors::{Arrival, Reading, Sensor};
use crate::state::SensorHealth;
use crate::time::Stamp;

/// What became of a reading at the door.
#[derive(Clone, Debug, PartialEq)]
pub enum Admitted {
    /// To be used.
    Yes,
    /// To be used, but what was known before is of no use any more: the IMU was silent, or its clock was set anew.
    Anew,
    /// Not to be used, and why.
    No(String),
}

/// Admits readings, and finds where an estimate can start, both as our own estimator does.
pub struct Starter {
    options: Options,
    inbox: Inbox,
    initializer: Initializer,
    chassis_turn: ChassisTurn,
    standstill: Standstill,
}

impl Starter {
    /// One that has seen nothing yet.
    pub fn new(options: Options) -> Self {
        Self {
            inbox: Inbox::default(),
            initializer: Initializer::new(options.clone(), None),
            chassis_turn: ChassisTurn::default(),
            standstill: standstill_of(&options),
            options,
        }
    }

    /// Decides on a reading.
    pub fn admit(&mut self, arrival: &Arrival) -> Admitted {
        let is_imu = matches!(arrival.reading, Reading::Imu(_));
        let previous = self.inbox.newest(Sensor::Imu);
        match self.inbox.admit(arrival) {
            Admission::Accepted => {}
            Admission::Refused(reason) => return Admitted::No(reason),
            Admission::ClockReset(_) if is_imu => return Admitted::Anew,
            Admission::ClockReset(reason) => return Admitted::No(reason),
        }
        let stamp = arrival.reading.stamp();
        if is_imu && previous.is_some_and(|previous| stamp - previous > IMU_GAP_MAX) {
            return Admitted::Anew;
        }
        Admitted::Yes
    }

    /// Forgets what was collected for a start.
    pub fn begin_anew(&mut self) {
        self.initializer = Initializer::new(self.options.clone(), None);
    }

    /// Takes a reading that was admitted; returns the start as soon as there is one.
    pub fn seek(&mut self, reading: &Reading) -> Option<Start> {
        let chassis = Chassis { gyroscope: &self.chassis_turn, encoder: &self.standstill };
        self.initializer.push(reading, &chassis)
    }

    /// What is missing, in words an operator can act on.
    pub fn waits_for(&self) -> &str {
        self.initializer.waits_for()
    }

    /// Readings that were no measurements at all or came against the clock.
    pub fn unfit(&self) -> u64 {
        self.inbox.unfit()
    }

    /// Writes down that a reading that was admitted could not be used after all.
    pub fn refuse(&mut self, sensor: Sensor, reason: String) {
        self.inbox.refuse(sensor, reason);
    }

    /// The sensors that ever spoke, with ages at `now`.
    pub fn sensors(&self, now: Stamp) -> Vec<SensorHealth> {
        self.inbox.health(now)
    }
}
