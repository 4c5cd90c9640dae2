//! Lidar odometry alone, aligned at the start: what CompSLAM's output is to the paper.
//!
//! At the first lidar pose after the start,
//! `world_from_lidarmap = world_from_imu imu_from_lidar lidarmap_from_lidar⁻¹` is fixed for good; from then on each lidar pose is an estimate, at the pose's own stamp and rate. Its covariance
//! is that of the start and of a walk with the configured sigmas of an increment.

use crate::estimator::{Admitted, Correction, Method, Options, Start, Starter};
use crate::frames::{LidarMap, Pose, World};
use crate::lie::{So3, Vec3};
use crate::preintegration::{SampleBuffer, propagate};
use crate::sensors::{Arrival, ImuSample, LidarPose, Reading};
use crate::state::{Estimate, Event, EventKind, Health, Mode, NavState, Severity, StateMatrix, row};
use crate::time::{Span, Stamp};

use super::filter::{estimate, health};
use super::lidar_pace::LidarPace;

/// While no lidar pose has come, samples are kept so long.
const SAMPLES_KEPT: Span = Span::from_millis(1_000);

/// See the file.
pub struct LidarAlone {
    options: Options,
    starter: Starter,
    phase: Phase,
    admitted: bool,
    now: Stamp,
    events: Vec<Event>,
    estimates: u64,
}

enum Phase {
    Waiting,
    /// Carried by the IMU to the first lidar pose.
    Started(Box<Started>),
    Aligned(Box<Aligned>),
}

struct Started {
    stamp: Stamp,
    state: NavState,
    covariance: StateMatrix,
    samples: SampleBuffer,
}

struct Aligned {
    world_from_lidarmap: Pose<World, LidarMap>,
    state: NavState,
    covariance: StateMatrix,
    last: Stamp,
    pace: LidarPace,
}

impl LidarAlone {
    /// One that has seen nothing yet.
    pub fn new(options: Options) -> Self {
        Self {
            starter: Starter::new(options.clone()),
            options,
            phase: Phase::Waiting,
            admitted: false,
            now: Stamp::default(),
            events: Vec::new(),
            estimates: 0,
        }
    }

    fn begin(&mut self, start: &Start) {
        let heading_sigma_deg = start.heading_sigma.to_degrees();
        let what = EventKind::Initialized { heading_from: start.heading_from.to_owned(), heading_sigma_deg };
        self.events.push(Event::new(start.stamp, Severity::Info, what));
        let mut samples = SampleBuffer::default();
        start.samples.iter().for_each(|sample| samples.push(*sample));
        let covariance = start.information.try_inverse().unwrap_or_else(StateMatrix::identity);
        let started = Started { stamp: start.stamp, state: start.state, covariance, samples };
        self.phase = Phase::Started(Box::new(started));
        for reading in &start.readings {
            if let Reading::LidarOdometry(pose) = reading {
                self.take_pose(pose);
            }
        }
    }

    fn take_pose(&mut self, pose: &LidarPose) -> Option<Estimate> {
        match &mut self.phase {
            Phase::Waiting => None,
            Phase::Started(started) => {
                let steps = started.samples.steps(started.stamp, pose.stamp)?;
                let gravity = &self.options.smoother.gravity;
                let state = steps.fold(started.state, |state, step| propagate(&state, &step, gravity));
                let lidarmap_from_imu = pose.lidarmap_from_lidar * self.options.imu_from_lidar.inverse();
                let world_from_lidarmap = state.world_from_imu() * lidarmap_from_imu.inverse();
                let covariance = started.covariance;
                let (last, pace) = (pose.stamp, LidarPace::default());
                let aligned = Aligned { world_from_lidarmap, state, covariance, last, pace };
                self.phase = Phase::Aligned(Box::new(aligned));
                None
            }
            Phase::Aligned(aligned) => {
                if pose.stamp <= aligned.last {
                    return None;
                }
                let step = aligned.follow(pose, &self.options);
                self.estimates += 1;
                Some(step)
            }
        }
    }
}

impl Started {
    /// While no lidar pose comes, the state is carried along, so that the samples stay few.
    fn push(&mut self, sample: &ImuSample, gravity: &Vec3) {
        self.samples.push(*sample);
        let oldest = sample.stamp - SAMPLES_KEPT;
        if self.stamp < oldest - SAMPLES_KEPT {
            let steps = self.samples.steps(self.stamp, oldest).into_iter().flatten();
            self.state = steps.fold(self.state, |state, step| propagate(&state, &step, gravity));
            self.stamp = oldest;
            self.samples.forget_before(oldest);
        }
    }
}

impl Aligned {
    fn follow(&mut self, pose: &LidarPose, options: &Options) -> Estimate {
        let lidarmap_from_imu = pose.lidarmap_from_lidar * options.imu_from_lidar.inverse();
        let world_from_imu = self.world_from_lidarmap * lidarmap_from_imu;
        let span_s = pose.stamp.seconds_since(self.last);
        let moved = world_from_imu.translation() - self.state.position;
        let turn = world_from_imu.rotation().minus(&self.state.rotation);
        let sigma = self.pace.sigma(options.lidar_sigma, pose.stamp - self.last);
        self.walk(&moved, &turn, sigma);
        self.state = NavState {
            rotation: world_from_imu.rotation().renormalized(),
            position: world_from_imu.translation(),
            velocity: moved / span_s,
            ..self.state
        };
        self.last = pose.stamp;
        let angular_rate = turn / span_s + self.state.gyro_bias;
        let sample = ImuSample { stamp: pose.stamp, angular_rate, specific_force: Vec3::zeros() };
        estimate(&sample, &self.state, &self.covariance, Mode::Fallback)
    }

    /// Errors of rotation so far turn the motion; the increments since add their own: rad, m.
    fn walk(&mut self, moved: &Vec3, turn: &Vec3, [turn_sigma, shift_sigma]: [f64; 2]) {
        let mut by_rotation = StateMatrix::identity();
        let turned_back = So3::exp(turn).matrix().transpose();
        by_rotation.fixed_view_mut::<3, 3>(row::ROTATION, row::ROTATION).copy_from(&turned_back);
        let turned = -crate::lie::hat(moved) * self.state.rotation.matrix();
        by_rotation.fixed_view_mut::<3, 3>(row::POSITION, row::ROTATION).copy_from(&turned);
        self.covariance = by_rotation * self.covariance * by_rotation.transpose();
        for axis in 0..3 {
            self.covariance[(row::ROTATION + axis, row::ROTATION + axis)] += turn_sigma * turn_sigma;
            self.covariance[(row::POSITION + axis, row::POSITION + axis)] += shift_sigma * shift_sigma;
        }
    }
}

impl Method for LidarAlone {
    fn predict(&mut self, arrival: &Arrival) -> Option<Estimate> {
        self.now = arrival.arrival;
        self.admitted = false;
        match self.starter.admit(arrival) {
            Admitted::Yes => {}
            // Lidar odometry does without the IMU once it is aligned.
            Admitted::Anew if matches!(self.phase, Phase::Aligned(_)) => {}
            Admitted::Anew => {
                self.starter.begin_anew();
                self.phase = Phase::Waiting;
            }
            Admitted::No(_) => return None,
        }
        self.admitted = true;
        match &arrival.reading {
            Reading::LidarOdometry(pose) => self.take_pose(pose),
            _ => None,
        }
    }

    fn update(&mut self, arrival: &Arrival) -> Option<Correction> {
        if !std::mem::take(&mut self.admitted) {
            return None;
        }
        match (&mut self.phase, &arrival.reading) {
            (Phase::Waiting, reading) => {
                let start = self.starter.seek(reading)?;
                self.begin(&start);
            }
            (Phase::Started(started), Reading::Imu(sample)) => {
                started.push(sample, &self.options.smoother.gravity);
            }
            _ => {}
        }
        None
    }

    fn unfit_readings(&self) -> u64 {
        self.starter.unfit()
    }

    fn health(&self) -> Health {
        let newest = match &self.phase {
            Phase::Aligned(aligned) => Some((&aligned.state, &aligned.covariance, Mode::Fallback)),
            Phase::Started(started) => Some((&started.state, &started.covariance, Mode::ImuOnly)),
            Phase::Waiting => None,
        };
        health(&self.starter, self.now, newest, self.estimates)
    }

    fn take_events(&mut self) -> Vec<Event> {
        std::mem::take(&mut self.events)
    }

    fn finish(&mut self) {}
}
