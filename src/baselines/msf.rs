//! MSF: an error-state Kalman filter that takes delayed measurements by a buffer of its states.
//!
//! Lynen, Achtelik, Weiss, Chli and Siegwart, "A Robust and Modular Multi-Sensor Fusion Approach Applied to MAV
//! Navigation" (IROS 2013), cited as \[L\]. The IMU drives the prediction; a fix is an absolute measurement of an
//! antenna; a lidar pose is a relative measurement against a clone of the pose at the lidar pose before
//! (\[L\] section III-C, stochastic cloning after Roumeliotis and Burdick 2002). A measurement from the past goes to
//! the buffered state of its stamp, and all measurements since are applied again (\[L\] section III-D).
//!
//! `README.md` says what is tuned, and how this differs from the authors' code.

use std::collections::VecDeque;

use nalgebra::{SMatrix, SVector};

use super::filter::{Core, Took};
use super::fix_gate::{Fix, FixGate};
use super::lidar_pace::LidarPace;
use super::transition::transition;
use crate::estimator::{Options, Start};
use crate::factors::{BetweenFactor, PositionFactor};
use crate::lie::{Se3, So3, Vec3};
use crate::preintegration::{Preintegration, SampleBuffer};
use crate::sensors::{LidarPose, Reading};
use crate::smoother::predict_covariance;
use crate::state::{Mode, NavState, STATE_DIM, StateMatrix, row};
use crate::time::{Span, Stamp};

/// The state, and the pose at the last lidar pose: rotation, position.
const DIM: usize = STATE_DIM + 6;
const CLONE: usize = STATE_DIM;
type Vector = SVector<f64, DIM>;
type Matrix = SMatrix<f64, DIM, DIM>;

/// Measurements may come so late.
const HORIZON: Span = Span::from_millis(1_000);
/// Without measurements, a state is buffered so often.
const NODE_EVERY: Span = Span::from_millis(500);
/// 99.9 % of the sums of six squared normal numbers are smaller.
const LIDAR_LIMIT: f64 = 22.46;
/// Without lidar for so long, the IMU is alone.
const LIDAR_SILENCE: Span = Span::from_millis(1_500);

/// See the file.
pub struct Msf {
    /// In order of their stamps; the newest is the estimate.
    nodes: VecDeque<Node>,
    lidar_heard: Option<Stamp>,
}

/// A buffered state: after its measurement.
#[derive(Clone)]
struct Node {
    stamp: Stamp,
    measurement: Measurement,
    /// Settles the order of measurements of one stamp, so that it is not that of their arrival.
    rank: usize,
    belief: Belief,
}

#[derive(Clone)]
enum Measurement {
    /// Only a state.
    None,
    Fix(Fix),
    Lidar(LidarPose),
}

/// Mean and covariance, with all that judges measurements.
#[derive(Clone)]
pub(super) struct Belief {
    pub state: NavState,
    pub covariance: Matrix,
    /// The pose at the lidar pose that comes with it.
    clone: Option<(Se3, LidarPose)>,
    pace: LidarPace,
    gate: FixGate,
}

impl Belief {
    pub fn new(state: NavState, covariance: &StateMatrix) -> Self {
        let mut whole = Matrix::identity();
        whole.fixed_view_mut::<STATE_DIM, STATE_DIM>(0, 0).copy_from(covariance);
        let (pace, gate) = (LidarPace::default(), FixGate::default());
        Self { state, covariance: whole, clone: None, pace, gate }
    }

    pub fn state_covariance(&self) -> StateMatrix {
        self.covariance.fixed_view::<STATE_DIM, STATE_DIM>(0, 0).into_owned()
    }

    /// P ← F P Fᵀ + Q; the clone stays as it is, and only its correlation with the state moves (\[L\] eqs. 3 to 6).
    pub fn predict(&mut self, motion: &Preintegration, options: &Options) {
        let matrix = transition(motion, &self.state);
        let state_part =
            predict_covariance(motion, &self.state, &self.state_covariance(), &options.smoother.noise);
        let cross = matrix * self.covariance.fixed_view::<STATE_DIM, 6>(0, CLONE);
        self.covariance.fixed_view_mut::<STATE_DIM, STATE_DIM>(0, 0).copy_from(&state_part);
        self.covariance.fixed_view_mut::<STATE_DIM, 6>(0, CLONE).copy_from(&cross);
        self.covariance.fixed_view_mut::<6, STATE_DIM>(CLONE, 0).copy_from(&cross.transpose());
        self.state = motion.predict(&self.state, &options.smoother.gravity);
    }

    /// K = P Hᵀ (H P Hᵀ + I)⁻¹ for a whitened residual r, x ← x ⊞ −K r, P by Joseph's form, which stays symmetric and
    /// positive (\[L\] eqs. 7 to 9). False if the covariance of the innovation has no inverse.
    fn correct<const ROWS: usize>(
        &mut self,
        residual: &SVector<f64, ROWS>,
        jacobian: &SMatrix<f64, ROWS, DIM>,
    ) -> bool {
        let by_measurement = self.covariance * jacobian.transpose();
        let innovation = jacobian * by_measurement + SMatrix::<f64, ROWS, ROWS>::identity();
        let Some(factor) = innovation.cholesky() else { return false };
        let gain = factor.solve(&by_measurement.transpose()).transpose();
        self.plus(&(-gain * residual));
        let kept = Matrix::identity() - gain * jacobian;
        let covariance = kept * self.covariance * kept.transpose() + gain * gain.transpose();
        self.covariance = (covariance + covariance.transpose()) * 0.5;
        true
    }

    fn plus(&mut self, tangent: &Vector) {
        self.state = self.state.plus(&tangent.fixed_rows::<STATE_DIM>(0).into_owned());
        if let Some((pose, _)) = &mut self.clone {
            let part = |first: usize| tangent.fixed_rows::<3>(CLONE + first).into_owned();
            let turned: So3 = pose.rotation.plus(&part(row::ROTATION)).renormalized();
            *pose = Se3::new(turned, pose.translation + part(row::POSITION));
        }
    }

    pub fn take_fix(&mut self, fix: &Fix) -> Result<(), String> {
        let factor = PositionFactor {
            measured: fix.measured,
            lever_arm: fix.lever_arm,
            sigma: fix.sigma,
            huber_threshold: f64::INFINITY,
        };
        let linear = factor.linearize(&self.state);
        let mut jacobian = SMatrix::<f64, 3, DIM>::zeros();
        jacobian.fixed_view_mut::<3, 6>(0, 0).copy_from(&linear.jacobian);
        let covariance = jacobian * self.covariance * jacobian.transpose() + SMatrix::<f64, 3, 3>::identity();
        self.gate.judge(fix.stamp, &linear.residual, &covariance)?;
        if self.correct(&linear.residual, &jacobian) { Ok(()) } else { Err(degenerate()) }
    }

    pub fn take_lidar(&mut self, pose: &LidarPose, options: &Options) -> Result<(), String> {
        let result = match self.clone {
            Some((at, before)) => self.take_increment(&at, &before, pose, options),
            None => Ok(()),
        };
        self.make_clone(pose);
        result
    }

    fn take_increment(
        &mut self,
        at: &Se3,
        before: &LidarPose,
        pose: &LidarPose,
        options: &Options,
    ) -> Result<(), String> {
        let factor = BetweenFactor {
            measured: *(before.lidarmap_from_lidar.inverse() * pose.lidarmap_from_lidar).motion(),
            imu_from_sensor: *options.imu_from_lidar.motion(),
            sigma: self.pace.sigma(options.lidar_sigma, pose.stamp - before.stamp),
        };
        let then = NavState { rotation: at.rotation, position: at.translation, ..self.state };
        let linear = factor.linearize(&then, &self.state);
        let mut jacobian = SMatrix::<f64, 6, DIM>::zeros();
        jacobian.fixed_view_mut::<6, 6>(0, 0).copy_from(&linear.jacobian_j);
        jacobian.fixed_view_mut::<6, 6>(0, CLONE).copy_from(&linear.jacobian_i);
        let innovation = jacobian * self.covariance * jacobian.transpose() + SMatrix::<f64, 6, 6>::identity();
        let solved = innovation.cholesky().map(|factor| factor.solve(&linear.residual));
        let squared = solved.map_or(f64::INFINITY, |solved| linear.residual.dot(&solved));
        if squared > LIDAR_LIMIT {
            return Err(format!("squared innovation {squared:.1} is over {LIDAR_LIMIT}"));
        }
        if self.correct(&linear.residual, &jacobian) { Ok(()) } else { Err(degenerate()) }
    }

    /// The pose becomes the clone: its rows and columns are copied.
    fn make_clone(&mut self, pose: &LidarPose) {
        let rows = self.covariance.fixed_view::<6, DIM>(0, 0).into_owned();
        self.covariance.fixed_view_mut::<6, DIM>(CLONE, 0).copy_from(&rows);
        let columns = self.covariance.fixed_view::<DIM, 6>(0, 0).into_owned();
        self.covariance.fixed_view_mut::<DIM, 6>(0, CLONE).copy_from(&columns);
        self.clone = Some((Se3::new(self.state.rotation, self.state.position), *pose));
    }
}

fn degenerate() -> String {
    "the covariance of its innovation has no inverse".to_owned()
}

impl Node {
    /// The node after `before`: predicted to its stamp, and its measurement applied.
    fn after(
        before: &Node,
        (stamp, rank): (Stamp, usize),
        measurement: Measurement,
        options: &Options,
        samples: &SampleBuffer,
    ) -> Result<(Self, Option<String>), String> {
        let mut belief = before.belief.clone();
        if stamp > before.stamp {
            let steps = samples.steps(before.stamp, stamp).ok_or("no IMU samples reach over it")?;
            let (gyro_bias, accel_bias) = (belief.state.gyro_bias, belief.state.accel_bias);
            let motion = Preintegration::of_steps(steps, gyro_bias, accel_bias, &options.smoother.noise);
            belief.predict(&motion, options);
        }
        let refusal = match &measurement {
            Measurement::None => Ok(()),
            Measurement::Fix(fix) => belief.take_fix(fix),
            Measurement::Lidar(pose) => belief.take_lidar(pose, options),
        };
        Ok((Self { stamp, measurement, rank, belief }, refusal.err()))
    }
}

impl Msf {
    fn insert(
        &mut self,
        place: (Stamp, usize),
        measurement: Measurement,
        options: &Options,
        samples: &SampleBuffer,
    ) -> Took {
        let stamp = place.0;
        let took = if matches!(measurement, Measurement::None) { Took::Moved } else { Took::Updated };
        let index = self.nodes.partition_point(|node| (node.stamp, node.rank) <= place);
        let Some(before) = index.checked_sub(1).map(|before| &self.nodes[before]) else {
            let oldest = self.nodes.front().map_or(0.0, |node| node.stamp.seconds_since(stamp));
            return Took::Refused(format!("is {oldest:.3} s older than the oldest state that is kept"));
        };
        let refusal = match Node::after(before, place, measurement, options, samples) {
            Ok((node, refusal)) => {
                self.nodes.insert(index, node);
                refusal
            }
            Err(reason) => return Took::Refused(reason),
        };
        for later in index + 1..self.nodes.len() {
            let node = &self.nodes[later];
            let (place, measurement) = ((node.stamp, node.rank), node.measurement.clone());
            if let Ok((again, _)) = Node::after(&self.nodes[later - 1], place, measurement, options, samples)
            {
                self.nodes[later] = again;
            }
        }
        let newest = self.nodes.back().map_or(stamp, |node| node.stamp);
        while self.nodes.len() > 1 && self.nodes[1].stamp < newest - HORIZON {
            self.nodes.pop_front();
        }
        refusal.map_or(took, Took::Refused)
    }
}

impl Core for Msf {
    fn begin(_: &Options, start: &Start) -> Self {
        let covariance = start.information.try_inverse().unwrap_or_else(StateMatrix::identity);
        let belief = Belief::new(start.state, &covariance);
        let node = Node { stamp: start.stamp, measurement: Measurement::None, rank: 0, belief };
        Self { nodes: VecDeque::from([node]), lidar_heard: None }
    }

    fn take(&mut self, options: &Options, reading: &Reading, samples: &SampleBuffer) -> Took {
        let fix = |fix, lever_arm: Vec3| FixGate::read(&options.gate, &options.site, fix, lever_arm);
        let measurement = match reading {
            Reading::Imu(sample) => {
                let newest = self.newest().0;
                if sample.stamp - newest < NODE_EVERY {
                    return Took::Nothing;
                }
                Measurement::None
            }
            Reading::GnssLeft(left) => match fix(left, options.antenna_left) {
                Ok(fix) => Measurement::Fix(fix),
                Err(reason) => return Took::Refused(reason),
            },
            Reading::GnssRight(right) => match options.antenna_right.map(|arm| fix(right, arm)) {
                Some(Ok(fix)) => Measurement::Fix(fix),
                Some(Err(reason)) => return Took::Refused(reason),
                None => return Took::Nothing,
            },
            Reading::LidarOdometry(pose) => {
                self.lidar_heard = Some(pose.stamp);
                Measurement::Lidar(*pose)
            }
            Reading::BaseImu(_) | Reading::CabinTurn(_) => return Took::Nothing,
        };
        self.insert((reading.stamp(), reading.sensor() as usize), measurement, options, samples)
    }

    fn newest(&self) -> (Stamp, NavState, StateMatrix) {
        let node = self.nodes.back().expect("there is always one");
        (node.stamp, node.belief.state, node.belief.state_covariance())
    }

    fn needs_since(&self) -> Stamp {
        self.nodes.front().expect("there is always one").stamp
    }

    fn mode(&self, now: Stamp) -> Mode {
        let trusts = self.nodes.back().is_some_and(|node| node.belief.gate.trusts(now));
        let lidar = self.lidar_heard.is_some_and(|heard| now - heard < LIDAR_SILENCE);
        match (trusts, lidar) {
            (true, _) => Mode::Main,
            (false, true) => Mode::Fallback,
            (false, false) => Mode::ImuOnly,
        }
    }
}
