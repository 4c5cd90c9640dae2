//! The slow half: from readings to solutions.
//!
//! Measurements wait until the IMU has come so far, pass the gate, become factors at nodes of their exact
//! stamps, and the graphs are brought up to date; each update ends in a [`Solution`] for the predictor.

mod fixes;
mod history;

use std::collections::VecDeque;

use super::chassis_turn::ChassisTurn;
use super::gate::{Gate, Turn};
use super::graphs::Graphs;
use super::inbox::{Admission, Inbox};
use super::initialization::{Initializer, Start};
use super::lidar::{LidarTrack, Taken};
use super::monitor::Monitor;
use super::options::Options;
use super::resumption::{Chassis, Known, LidarTrail};
use super::standstill::{Standstill, Stillness};
use super::ties;
use super::{AHEAD_MAX, IMU_GAP_MAX, Solution};
use crate::sensors::{Arrival, GnssFix, ImuSample, LidarPose, Reading, Sensor};
use crate::smoother::{Smoother, SmootherError};
use crate::state::{Event, GnssState, Health, Mode};
use crate::time::{Span, Stamp};
use history::History;

/// Without measurements, a node is set so often, so that links stay short.
const NODE_EVERY: Span = Span::from_millis(500);
/// Without lidar for so long, the IMU is alone.
const LIDAR_SILENCE: Span = Span::from_millis(1_500);
/// Measurements that wait for the IMU, at most.
const PENDING_MAX: usize = 1_024;

/// The slow half of the estimator; see [`super::split`].
pub struct Updater {
    options: Options,
    inbox: Inbox,
    phase: Phase,
    pending: VecDeque<Reading>,
    standstill: Standstill,
    chassis_turn: ChassisTurn,
    lidar_trail: LidarTrail,
    monitor: Monitor,
    now: Stamp,
    /// Memory of solutions that were adopted.
    #[expect(clippy::vec_box, reason = "the boxes travel")]
    used: Vec<Box<Solution>>,
    /// Where it is asked for.
    history: Option<History>,
}

enum Phase {
    Waiting(Box<Initializer>),
    Running(Box<Running>),
}

/// What exists once the estimate has started.
struct Running {
    graphs: Graphs,
    gate: Gate,
    lidar: LidarTrack,
    last_left: Option<GnssFix>,
    restart: bool,
}

impl Updater {
    pub(super) fn new(options: Options) -> Self {
        let initializer = Initializer::new(options.clone(), None);
        let standstill = standstill_of(&options);
        Self {
            options,
            inbox: Inbox::default(),
            phase: Phase::Waiting(Box::new(initializer)),
            pending: VecDeque::new(),
            standstill,
            chassis_turn: ChassisTurn::default(),
            lidar_trail: LidarTrail::default(),
            monitor: Monitor::default(),
            now: Stamp::default(),
            used: Vec::new(),
            history: None,
        }
    }

    /// Gives back a solution that the predictor has adopted: the next one needs no new memory.
    pub fn recycle(&mut self, used: Box<Solution>) {
        self.used.push(used);
    }

    /// Takes any reading, in order of arrival. Returns a solution if it led to one.
    pub fn push(&mut self, arrival: &Arrival) -> Option<Box<Solution>> {
        self.now = arrival.arrival;
        self.monitor.tell_refusals(self.now);
        let reading = arrival.reading;
        let sensor = reading.sensor();
        let previous_imu = self.inbox.newest(Sensor::Imu);
        match self.inbox.admit(arrival) {
            Admission::Accepted => {}
            Admission::Refused(reason) => {
                self.monitor.note_refusal(self.now, sensor, reason);
                return None;
            }
            Admission::ClockReset(reason) => {
                if sensor == Sensor::Imu {
                    let known = self.known().map(Known::by_another_clock);
                    self.forget_chassis();
                    self.begin_anew(&format!("the clock of the cabin IMU has changed: {reason}"), known);
                }
                self.monitor.note_refusal(self.now, sensor, reason);
                return None;
            }
        }
        match reading {
            Reading::Imu(sample) => {
                if let Some(previous) = previous_imu
                    && sample.stamp - previous > IMU_GAP_MAX
                {
                    let gap_s = sample.stamp.seconds_since(previous);
                    let known = self.known();
                    self.begin_anew(&format!("the cabin IMU was silent for {gap_s:.2} s"), known);
                }
                if let Some(history) = &mut self.history {
                    history.samples.push(sample);
                }
                if self.inbox.newest(Sensor::BaseImu).is_none() {
                    self.standstill.push_sample(sample);
                }
                match &mut self.phase {
                    Phase::Running(running) => running.graphs.push_sample(sample),
                    Phase::Waiting(initializer) => {
                        let chassis = Chassis { gyroscope: &self.chassis_turn, encoder: &self.standstill };
                        let start = initializer.push(&reading, &chassis)?;
                        return self.begin(start);
                    }
                }
                self.work_off_pending(sample.stamp)
            }
            Reading::BaseImu(sample) => {
                self.standstill.push_sample(sample);
                let angular_rate = self.options.base_from_base_imu.rotation() * sample.angular_rate;
                self.chassis_turn.push_sample(ImuSample { angular_rate, ..sample });
                None
            }
            Reading::CabinTurn(turn) => {
                self.standstill.push_turn(turn);
                None
            }
            Reading::GnssLeft(_) | Reading::GnssRight(_) | Reading::LidarOdometry(_) => {
                let lidar_began_anew = match &reading {
                    Reading::LidarOdometry(pose) => {
                        !self.lidar_trail.follow(pose, self.options.gate.speed_max)
                    }
                    _ => false,
                };
                if let Phase::Waiting(initializer) = &mut self.phase {
                    if lidar_began_anew {
                        initializer.note_lidar_restart();
                    }
                    let chassis = Chassis { gyroscope: &self.chassis_turn, encoder: &self.standstill };
                    return initializer.push(&reading, &chassis).and_then(|start| self.begin(start));
                }
                let imu = self.inbox.newest(Sensor::Imu).unwrap_or(reading.stamp());
                if reading.stamp() <= imu {
                    return self.process(&reading);
                }
                let ahead = reading.stamp() - imu;
                if ahead > AHEAD_MAX || self.pending.len() >= PENDING_MAX {
                    self.refuse(sensor, format!("is {:.3} s ahead of the cabin IMU", ahead.as_seconds()));
                } else {
                    self.pending.push_back(reading);
                }
                None
            }
        }
    }

    /// After an IMU sample: what waited for it, what has gone silent, and a node now and then.
    fn work_off_pending(&mut self, imu: Stamp) -> Option<Box<Solution>> {
        let mut solution = None;
        for _ in 0..self.pending.len() {
            let Some(reading) = self.pending.pop_front() else { break };
            if reading.stamp() <= imu {
                solution = self.process(&reading).or(solution);
            } else {
                self.pending.push_back(reading);
            }
        }
        let Phase::Running(running) = &mut self.phase else { return solution };
        let before = running.gate.state();
        let turn = running.gate.notice_silence(imu);
        let after = running.gate.state();
        self.monitor.note_gnss(imu, before, after);
        if after == GnssState::Silent {
            self.move_graphs(imu, Graphs::end_trial, "fixes fell silent");
        }
        self.note_turn(turn, imu, None);
        match self.bare_node(imu) {
            Ok(false) => solution,
            outcome => self.solve(Sensor::Imu, outcome, imu).or(solution),
        }
    }

    fn process(&mut self, reading: &Reading) -> Option<Box<Solution>> {
        match reading {
            Reading::GnssLeft(fix) => self.process_left(fix),
            Reading::GnssRight(fix) => self.process_right(fix),
            Reading::LidarOdometry(pose) => self.process_lidar(pose),
            Reading::Imu(_) | Reading::BaseImu(_) | Reading::CabinTurn(_) => None,
        }
    }

    /// Moves the graphs, and tells if that changed who answers.
    fn move_graphs(&mut self, stamp: Stamp, how: impl FnOnce(&mut Graphs), why: &str) {
        let Phase::Running(running) = &mut self.phase else { return };
        how(&mut running.graphs);
        self.monitor.note_graph(stamp, running.graphs.state(), why);
    }

    /// A node without measurement, if the newest has grown old.
    fn bare_node(&mut self, stamp: Stamp) -> Result<bool, SmootherError> {
        let Phase::Running(running) = &mut self.phase else { return Ok(false) };
        let active = running.graphs.active_mut();
        let newest = active.newest().map_or(stamp, |(newest, _)| newest);
        if stamp - newest <= NODE_EVERY {
            return Ok(false);
        }
        let node = active.node_at(stamp)?;
        if let Some(main) = running.graphs.passive_mut() {
            // Main is made anew from fallback or from fixes, should it fail.
            let _ = main.node_at(node);
        }
        Ok(true)
    }

    fn process_lidar(&mut self, pose: &LidarPose) -> Option<Box<Solution>> {
        let Phase::Running(running) = &mut self.phase else { return None };
        let solution = match running.lidar.take(&mut running.graphs, &self.options, pose) {
            Ok(Taken::Used) => self.solve(Sensor::LidarOdometry, Ok(true), pose.stamp),
            Ok(Taken::First) => None,
            Ok(Taken::Refused(misfit)) => {
                self.refuse(Sensor::LidarOdometry, misfit);
                None
            }
            Err(error) => {
                self.refuse(Sensor::LidarOdometry, error.to_string());
                return None;
            }
        };
        if let Phase::Running(running) = &mut self.phase {
            running.lidar.anchor(&mut running.graphs, &self.options);
        }
        solution
    }

    /// Updates the smoother and makes a solution of its newest node.
    fn solve(
        &mut self,
        sensor: Sensor,
        outcome: Result<bool, SmootherError>,
        stamp: Stamp,
    ) -> Option<Box<Solution>> {
        if outcome == Ok(true) {
            self.tie_chassis();
        }
        let Phase::Running(running) = &mut self.phase else { return None };
        let updated = match outcome {
            Ok(false) => return None,
            Ok(true) => running.graphs.update(),
            Err(error) => Err(error),
        };
        match updated {
            Ok(()) => {}
            Err(SmootherError::NotDetermined | SmootherError::NotStarted) => {
                self.begin_anew("the estimate was no longer determined by its measurements", None);
                return None;
            }
            Err(error) => {
                self.refuse(sensor, error.to_string());
                return None;
            }
        }
        self.monitor.note_graph(stamp, running.graphs.state(), "main could not be solved");
        let (newest, state) = running.graphs.active().newest()?;
        if !state.is_finite() {
            self.begin_anew("the estimate was no longer finite", None);
            return None;
        }
        let covariance = *running.graphs.active().newest_covariance();
        let restart = std::mem::take(&mut running.restart);
        let trusted = running.gate.trusted();
        let mode = self.mode(trusted, stamp);
        self.monitor.note_update(newest, &state, &covariance, mode);
        let solution = Solution { stamp: newest, state, covariance, mode, restart };
        let Some(mut used) = self.used.pop() else { return Some(Box::new(solution)) };
        *used = solution;
        Some(used)
    }

    /// Ties two nodes by what the chassis' sensors say, about once a second.
    fn tie_chassis(&mut self) {
        let Phase::Running(running) = &mut self.phase else { return };
        let turns = self.inbox.newest(Sensor::BaseImu).is_some();
        ties::tie_chassis(&mut running.graphs, &self.options, &mut self.standstill, turns);
        ties::tie_turn(&mut running.graphs, &self.options, &mut self.chassis_turn, &self.standstill);
    }

    fn mode(&self, gnss_trusted: bool, now: Stamp) -> Mode {
        let lidar = self.inbox.newest(Sensor::LidarOdometry);
        if gnss_trusted {
            Mode::Main
        } else if lidar.is_some_and(|stamp| now - stamp <= LIDAR_SILENCE) {
            Mode::Fallback
        } else {
            Mode::ImuOnly
        }
    }

    /// Starts the window and works off what came since.
    fn begin(&mut self, start: Start) -> Option<Box<Solution>> {
        let mut smoother = Smoother::new(self.options.smoother);
        if self.history.is_some() {
            smoother.keep_history();
        }
        start.samples.iter().for_each(|sample| smoother.push_sample(*sample));
        if let Err(error) = smoother.start(start.stamp, start.state, &start.information) {
            self.begin_anew(&format!("the start failed: it {error}"), None);
            return None;
        }
        // A start in motion lies seconds back and is far from linear: nothing of it is laid down before all that is
        // known of it has been heard.
        smoother.hold(Some(start.stamp));
        let (mut gate, mut graphs) = (Gate::new(self.options.gate), Graphs::new(smoother));
        if start.fixes_agree {
            gate.begin_trusted(start.stamp);
            self.monitor.end_outage(start.stamp, None);
        } else {
            graphs.lose();
            self.monitor.begin_outage(start.stamp, start.stamp, GnssState::Silent);
        }
        let why = if start.fixes_agree { "a new start with fixes" } else { "no fix confirms the new start" };
        self.monitor.note_graph(start.stamp, graphs.state(), why);
        self.monitor.note_start(start.stamp, start.heading_from, start.heading_sigma);
        self.phase = Phase::Running(Box::new(Running {
            graphs,
            gate,
            lidar: LidarTrack::default(),
            last_left: None,
            restart: true,
        }));
        let mut solution = self.solve(Sensor::Imu, Ok(true), start.stamp);
        for reading in &start.readings {
            let newest = self.process(reading);
            if let (Some(first), Some(newest)) = (&solution, newest) {
                let restart = first.restart || newest.restart;
                solution = Some(Box::new(Solution { restart, ..*newest }));
            }
        }
        if let Phase::Running(running) = &mut self.phase {
            running.graphs.release();
            running.lidar.hold(&mut running.graphs, &self.options);
        }
        solution
    }

    /// What outlasts a silence of the IMU.
    fn known(&mut self) -> Option<Known> {
        match &mut self.phase {
            Phase::Waiting(initializer) => initializer.take_known(),
            Phase::Running(running) => {
                let smoother = running.graphs.active_mut();
                let (stamp, state) = smoother.newest()?;
                let lidar = running.lidar.newest().filter(|pose| self.lidar_trail.holds(pose.stamp));
                let lidar = lidar.and_then(|pose| Some((pose, smoother.state_at(pose.stamp)?)));
                let covariance = *smoother.newest_covariance();
                let fixes_trusted = running.gate.trusted();
                Some(Known { stamp, state, covariance, lidar, fixes_trusted, same_clock: true })
            }
        }
    }

    /// What the chassis' sensors said is by a clock that no longer counts.
    fn forget_chassis(&mut self) {
        self.standstill = standstill_of(&self.options);
        self.chassis_turn = ChassisTurn::default();
    }

    /// Gives up the estimate and waits for a new start.
    fn begin_anew(&mut self, reason: &str, known: Option<Known>) {
        let was_running = matches!(self.phase, Phase::Running(_));
        self.close_history();
        self.phase = Phase::Waiting(Box::new(Initializer::new(self.options.clone(), known)));
        self.pending.clear();
        self.standstill.end();
        self.chassis_turn.tied = None;
        if was_running {
            self.monitor.note_restart(self.now, reason);
        }
    }

    fn refuse(&mut self, sensor: Sensor, reason: String) {
        self.inbox.refuse(sensor, reason.clone());
        self.monitor.note_refusal(self.now, sensor, reason);
    }

    fn note_turn(&mut self, turn: Option<Turn>, stamp: Stamp, jump_m: Option<f64>) {
        let Phase::Running(running) = &self.phase else { return };
        let cause = running.gate.state();
        match turn {
            None => {}
            Some(Turn::Lost { since }) => {
                self.move_graphs(stamp, Graphs::lose, "fixes are lost");
                if let Phase::Running(running) = &mut self.phase {
                    // The lidar may have been lost with them.
                    running.lidar.hold(&mut running.graphs, &self.options);
                }
                self.monitor.begin_outage(stamp, since, cause);
            }
            Some(Turn::Recovered) => self.monitor.end_outage(stamp, jump_m),
        }
        let mode = self.mode(cause == GnssState::Fixed, stamp);
        self.monitor.note_mode(stamp, mode);
    }

    /// Health as of the newest arrival.
    pub fn health(&self) -> Health {
        let (waits_for, gnss) = match &self.phase {
            Phase::Waiting(initializer) => {
                let gnss = match self.inbox.newest(Sensor::GnssLeft) {
                    Some(stamp) if self.now - stamp < Span::from_millis(1_500) => GnssState::Recovering,
                    _ => GnssState::Silent,
                };
                (Some(initializer.waits_for().to_owned()), (gnss, [1.0; 2]))
            }
            Phase::Running(running) => {
                let inflation = running.gate.inflation();
                (None, (running.gate.state(), [inflation.x, inflation.z]))
            }
        };
        self.monitor.health(self.now, waits_for, gnss, self.inbox.health(self.now))
    }

    /// Readings that were no measurements at all or came against the clock: bad data, unlike a fix that the
    /// gate refused.
    pub fn unfit_readings(&self) -> u64 {
        self.inbox.unfit()
    }

    /// No more readings come: tells what was held back for being told too often.
    pub fn finish(&mut self) {
        self.monitor.tell_rest(self.now);
    }

    /// Events since the last call, oldest first.
    pub fn take_events(&mut self) -> Vec<Event> {
        self.monitor.take_events()
    }

    /// Tells how long the last update took by the caller's clock; the estimator has none.
    pub fn note_update_time(&mut self, micros: f64) {
        self.monitor.note_update_time(micros);
    }
}

pub(super) fn standstill_of(options: &Options) -> Standstill {
    let noise = &options.smoother.noise;
    Standstill::new(Stillness::of(noise.gyroscope_noise_density, noise.accelerometer_noise_density))
}

#[cfg(test)]
mod tests;
