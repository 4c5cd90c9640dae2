//! What the filters have in common: the door, the start, and the way from the filter's newest state to the newest
//! IMU sample.

use std::collections::VecDeque;

use crate::estimator::{AHEAD_MAX, Admitted, Correction, Method, Options, Start, Starter};
use crate::frames::{Imu, Odom, Pose, World};
use crate::preintegration::{Preintegration, SampleBuffer, Step, propagate};
use crate::sensors::{Arrival, ImuSample, Reading};
use crate::smoother::predict_covariance;
use crate::state::{Estimate, Event, EventKind, GnssState, Health, Mode, NavState, Severity, StateMatrix};
use crate::time::{Span, Stamp};

/// Samples are kept so long at least, for readings that come late.
const SAMPLES_KEPT: Span = Span::from_millis(2_000);
/// Readings that wait for the IMU, at most.
const PENDING_MAX: usize = 1_024;
/// The covariance is brought forward every so many samples.
const COVARIANCE_EVERY: u32 = 10;

/// What became of a reading.
#[derive(Clone, Debug, PartialEq)]
pub enum Took {
    /// It is of no use to the filter.
    Nothing,
    /// The filter's state was brought forward by the IMU alone.
    Moved,
    /// The filter has a new state, by a measurement.
    Updated,
    /// It was refused, and why; the filter may have moved all the same.
    Refused(String),
}

/// The filter proper: a state at a stamp, brought forward by measurements.
pub trait Core {
    /// A filter at the start of the estimate.
    fn begin(options: &Options, start: &Start) -> Self;

    /// Takes a reading whose stamp the samples reach over; `samples` are all since the filter's oldest state.
    fn take(&mut self, options: &Options, reading: &Reading, samples: &SampleBuffer) -> Took;

    /// The newest state.
    fn newest(&self) -> (Stamp, NavState, StateMatrix);

    /// Samples before it are needed no more.
    fn needs_since(&self) -> Stamp;

    /// What the estimate rests on at `now`.
    fn mode(&self, now: Stamp) -> Mode;
}

/// A [`Core`] behind the estimator's interface.
pub struct Filter<C> {
    options: Options,
    starter: Starter,
    samples: SampleBuffer,
    running: Option<Running<C>>,
    pending: VecDeque<Reading>,
    /// Whether the reading that was predicted with last may be used.
    admitted: bool,
    now: Stamp,
    updates: u64,
    events: Vec<Event>,
}

/// A filter that has started, and where the IMU has carried its newest state.
struct Running<C> {
    core: C,
    state: NavState,
    covariance: StateMatrix,
    /// Since the filter's newest state, for the covariance.
    motion: Preintegration,
    origin: (NavState, StateMatrix),
    samples_since_covariance: u32,
}

impl<C: Core> Filter<C> {
    /// A filter that has seen nothing yet.
    pub fn new(options: Options) -> Self {
        Self {
            starter: Starter::new(options.clone()),
            options,
            samples: SampleBuffer::default(),
            running: None,
            pending: VecDeque::new(),
            admitted: false,
            now: Stamp::default(),
            updates: 0,
            events: Vec::new(),
        }
    }

    fn begin_anew(&mut self) {
        self.starter.begin_anew();
        self.samples.clear();
        self.pending.clear();
        if self.running.take().is_some() {
            let reason = "the cabin IMU was silent, or its clock was set anew".to_owned();
            self.events.push(Event::new(self.now, Severity::Warning, EventKind::Restarted { reason }));
        }
    }

    fn begin(&mut self, start: Start) {
        self.samples.clear();
        start.samples.iter().for_each(|sample| self.samples.push(*sample));
        let mut core = C::begin(&self.options, &start);
        let heading_sigma_deg = start.heading_sigma.to_degrees();
        let what = EventKind::Initialized { heading_from: start.heading_from.to_owned(), heading_sigma_deg };
        self.events.push(Event::new(start.stamp, Severity::Info, what));
        let newest = self.samples.newest().map_or(start.stamp, |sample| sample.stamp);
        for reading in start.readings {
            if reading.stamp() <= newest {
                core.take(&self.options, &reading, &self.samples);
            } else {
                self.wait(reading, newest);
            }
        }
        self.running = Running::carried(core, &self.options, &self.samples);
    }

    /// Hands a reading to the filter, and carries what comes of it to the newest sample.
    fn take(&mut self, reading: &Reading) -> Option<Correction> {
        let running = self.running.as_mut()?;
        let took = running.core.take(&self.options, reading, &self.samples);
        if took == Took::Nothing {
            return None;
        }
        let before = running.state.position;
        running.carry(&self.options, &self.samples);
        let moved_m = (running.state.position - before).norm();
        let kept = self.samples.newest()?.stamp - SAMPLES_KEPT;
        self.samples.forget_before(running.core.needs_since().min(kept));
        match took {
            Took::Refused(reason) => {
                self.starter.refuse(reading.sensor(), reason);
                None
            }
            Took::Updated => {
                self.updates += 1;
                Some(Correction { correction_m: Some(moved_m) })
            }
            Took::Moved | Took::Nothing => Some(Correction { correction_m: None }),
        }
    }

    /// Keeps a reading until the IMU, now at `imu`, has come so far, unless it never will.
    fn wait(&mut self, reading: Reading, imu: Stamp) {
        let ahead = reading.stamp() - imu;
        if ahead > AHEAD_MAX || self.pending.len() >= PENDING_MAX {
            let reason = format!("is {:.3} s ahead of the cabin IMU", ahead.as_seconds());
            self.starter.refuse(reading.sensor(), reason);
        } else {
            self.pending.push_back(reading);
        }
    }

    fn work_off_pending(&mut self, imu: Stamp) -> Option<Correction> {
        let mut correction = None;
        for _ in 0..self.pending.len() {
            let Some(reading) = self.pending.pop_front() else { break };
            if reading.stamp() <= imu {
                correction = self.take(&reading).or(correction);
            } else {
                self.pending.push_back(reading);
            }
        }
        correction
    }

    fn push_sample(&mut self, sample: &ImuSample) -> Option<Estimate> {
        let previous = self.samples.newest().copied();
        self.samples.push(*sample);
        let running = self.running.as_mut()?;
        let step = Step::between(&previous?, sample);
        running.step(&step, &self.options);
        let mode = running.core.mode(sample.stamp);
        Some(estimate(sample, &running.state, &running.covariance, mode))
    }
}

impl<C: Core> Running<C> {
    fn carried(core: C, options: &Options, samples: &SampleBuffer) -> Option<Self> {
        let (_, state, covariance) = core.newest();
        let motion = Preintegration::new(state.gyro_bias, state.accel_bias);
        let origin = (state, covariance);
        let mut running = Self { core, state, covariance, motion, origin, samples_since_covariance: 0 };
        running.carry(options, samples);
        Some(running)
    }

    /// From the filter's newest state over all samples since.
    fn carry(&mut self, options: &Options, samples: &SampleBuffer) {
        let (stamp, state, covariance) = self.core.newest();
        self.origin = (state, covariance);
        self.motion = Preintegration::new(state.gyro_bias, state.accel_bias);
        self.state = state;
        let newest = samples.newest().map_or(stamp, |sample| sample.stamp);
        for step in samples.steps(stamp, newest).into_iter().flatten() {
            self.motion.add(&step, &options.smoother.noise);
            self.state = propagate(&self.state, &step, &options.smoother.gravity);
        }
        self.bring_covariance_forward(options);
    }

    fn step(&mut self, step: &Step, options: &Options) {
        self.state = propagate(&self.state, step, &options.smoother.gravity);
        self.motion.add(step, &options.smoother.noise);
        self.samples_since_covariance += 1;
        if self.samples_since_covariance >= COVARIANCE_EVERY {
            self.bring_covariance_forward(options);
        }
    }

    fn bring_covariance_forward(&mut self, options: &Options) {
        self.samples_since_covariance = 0;
        let (state, covariance) = &self.origin;
        self.covariance = predict_covariance(&self.motion, state, covariance, &options.smoother.noise);
    }
}

/// One pose, also as odom.
pub(super) fn estimate(
    sample: &ImuSample,
    state: &NavState,
    covariance: &StateMatrix,
    mode: Mode,
) -> Estimate {
    let odom_from_imu: Pose<Odom, Imu> = Pose::assume(*state.world_from_imu().motion());
    let world_from_odom: Pose<World, Odom> = Pose::identity();
    Estimate {
        stamp: sample.stamp,
        state: *state,
        angular_rate_in_imu: sample.angular_rate - state.gyro_bias,
        odom_from_imu,
        world_from_odom,
        base: None,
        covariance: *covariance,
        mode,
    }
}

/// Health of a method that watches nothing but its readings.
pub(super) fn health(
    starter: &Starter,
    now: Stamp,
    newest: Option<(&NavState, &StateMatrix, Mode)>,
    updates: u64,
) -> Health {
    let array = |vector: crate::lie::Vec3| [vector.x, vector.y, vector.z];
    let sigma = |covariance: &StateMatrix| {
        let axis = |row: usize| covariance[(row, row)].max(0.0);
        axis(crate::state::row::POSITION).max(axis(crate::state::row::POSITION + 1)).sqrt()
    };
    let heading = |(state, covariance, _): (&NavState, &StateMatrix, Mode)| {
        state.heading_variance(covariance).sqrt().to_degrees()
    };
    Health {
        stamp_ns: now.as_nanos(),
        mode: newest.map_or(Mode::Initializing, |(_, _, mode)| mode),
        waits_for: newest.is_none().then(|| starter.waits_for().to_owned()),
        gnss: match newest {
            Some((_, _, Mode::Main)) => GnssState::Fixed,
            _ => GnssState::Silent,
        },
        gnss_inflation: [1.0; 2],
        position_sigma_m: newest.map(|(_, covariance, _)| sigma(covariance)),
        heading_sigma_deg: newest.map(heading),
        worst_test_ratio: 0.0,
        worst_test_sensor: None,
        sensors: starter.sensors(now),
        outage: None,
        updates,
        update_us: 0.0,
        gyro_bias: newest.map_or([0.0; 3], |(state, _, _)| array(state.gyro_bias)),
        accel_bias: newest.map_or([0.0; 3], |(state, _, _)| array(state.accel_bias)),
    }
}

impl<C: Core> Method for Filter<C> {
    fn predict(&mut self, arrival: &Arrival) -> Option<Estimate> {
        self.now = arrival.arrival;
        self.admitted = false;
        match self.starter.admit(arrival) {
            Admitted::Yes => {}
            Admitted::Anew => self.begin_anew(),
            Admitted::No(_) => return None,
        }
        self.admitted = true;
        match &arrival.reading {
            Reading::Imu(sample) if self.running.is_some() => self.push_sample(sample),
            _ => None,
        }
    }

    fn update(&mut self, arrival: &Arrival) -> Option<Correction> {
        if !std::mem::take(&mut self.admitted) {
            return None;
        }
        let reading = &arrival.reading;
        if self.running.is_none() {
            let start = self.starter.seek(reading)?;
            self.begin(start);
            return Some(Correction { correction_m: None });
        }
        match reading {
            Reading::Imu(sample) => {
                let waited = self.work_off_pending(sample.stamp);
                self.take(reading).or(waited)
            }
            Reading::GnssLeft(_) | Reading::GnssRight(_) | Reading::LidarOdometry(_) => {
                let newest = self.samples.newest()?.stamp;
                if reading.stamp() <= newest {
                    return self.take(reading);
                }
                self.wait(*reading, newest);
                None
            }
            Reading::BaseImu(_) | Reading::CabinTurn(_) => None,
        }
    }

    fn unfit_readings(&self) -> u64 {
        self.starter.unfit()
    }

    fn health(&self) -> Health {
        let newest = self.running.as_ref().map(|running| {
            let mode = running.core.mode(self.samples.newest().map_or(self.now, |sample| sample.stamp));
            (&running.state, &running.covariance, mode)
        });
        health(&self.starter, self.now, newest, self.updates)
    }

    fn take_events(&mut self) -> Vec<Event> {
        std::mem::take(&mut self.events)
    }

    fn finish(&mut self) {}
}
