//! What every estimator is to its callers: readings in, estimates out.

use super::{Correction, Estimator};
use crate::sensors::Arrival;
use crate::state::{Estimate, Event, Health};

/// An estimator of one machine, ours or one that is compared with it.
///
/// Every reading goes first to [`Method::predict`], then to [`Method::update`].
pub trait Method {
    /// Takes a reading, in order of arrival; an estimate comes of it once started. What the reading itself corrects
    /// is in the next one, as it is on a machine.
    fn predict(&mut self, arrival: &Arrival) -> Option<Estimate>;

    /// Works off the reading that was given to [`Method::predict`] last; tells what it changed, if it led to an
    /// update.
    fn update(&mut self, arrival: &Arrival) -> Option<Correction>;

    /// Readings that were no measurements at all or came against the clock.
    fn unfit_readings(&self) -> u64;

    /// Health as of the newest arrival.
    fn health(&self) -> Health;

    /// Events since the last call, oldest first.
    fn take_events(&mut self) -> Vec<Event>;

    /// No more readings come.
    fn finish(&mut self);
}

impl Method for Estimator {
    fn predict(&mut self, arrival: &Arrival) -> Option<Estimate> {
        Estimator::predict(self, arrival)
    }

    fn update(&mut self, arrival: &Arrival) -> Option<Correction> {
        Estimator::update(self, arrival)
    }

    fn unfit_readings(&self) -> u64 {
        Estimator::unfit_readings(self)
    }

    fn health(&self) -> Health {
        Estimator::health(self)
    }

    fn take_events(&mut self) -> Vec<Event> {
        Estimator::take_events(self)
    }

    fn finish(&mut self) {
        Estimator::finish(self);
    }
}

impl Method for Box<dyn Method> {
    fn predict(&mut self, arrival: &Arrival) -> Option<Estimate> {
        (**self).predict(arrival)
    }

    fn update(&mut self, arrival: &Arrival) -> Option<Correction> {
        (**self).update(arrival)
    }

    fn unfit_readings(&self) -> u64 {
        (**self).unfit_readings()
    }

    fn health(&self) -> Health {
        (**self).health()
    }

    fn take_events(&mut self) -> Vec<Event> {
        (**self).take_events()
    }

    fn finish(&mut self) {
        (**self).finish();
    }
}
