//! GNSS fixes on their way into the graphs: the gate judges, the graphs move, and what is used becomes a factor.

use super::{Phase, Running, Updater};
use crate::estimator::Solution;
use crate::estimator::gate::{Candidate, Judgement, Turn};
use crate::estimator::graphs::Graphs;
use crate::estimator::options::Options;
use crate::factors::PositionFactor;
use crate::lie::Vec3;
use crate::sensors::{GnssFix, Sensor};
use crate::smoother::{Smoother, SmootherError, predicted_position_covariance};
use crate::state::{Graph, NavState, row};
use crate::time::Stamp;

/// Huber's threshold of fixes that pass the gate, in sigmas.
const HUBER_THRESHOLD: f64 = 5.0;
/// What a wrong estimate may be off in rotation (rad) and velocity (m/s), beside position.
const RESEAT_ROTATION_SIGMA: f64 = 0.05;
const RESEAT_VELOCITY_SIGMA: f64 = 0.3;
impl Updater {
    pub(super) fn process_left(&mut self, fix: &GnssFix) -> Option<Box<Solution>> {
        let Phase::Running(running) = &mut self.phase else { return None };
        let lever_arm = self.options.antenna_left;
        let candidate = match candidate(running, &self.options, fix, &lever_arm) {
            Ok(candidate) => candidate,
            Err(error) => {
                self.refuse(Sensor::GnssLeft, error.to_string());
                return None;
            }
        };
        running.last_left = Some(*fix);
        let before = running.gate.state();
        let judgement = running.gate.judge(candidate);
        let (after, used) = (running.gate.state(), judgement.used);
        self.monitor.note_test(self.now, Sensor::GnssLeft, judgement.test_ratio);
        if let Some(reason) = &judgement.refusal {
            self.refuse(Sensor::GnssLeft, reason.clone());
        }
        self.monitor.note_gnss(fix.stamp, before, after);
        let contradicts = judgement.turn == Some(Turn::Recovered) && !judgement.agrees;
        self.move_graphs_after(&judgement, fix.stamp, contradicts);
        let outcome = match (used, contradicts) {
            (true, true) => self.reseat(&candidate),
            (true, false) => self.add_fix(fix, &lever_arm),
            (false, _) => {
                if judgement.on_trial {
                    self.try_fix(fix, &lever_arm);
                }
                self.bare_node(fix.stamp)
            }
        };
        let expected = candidate.expected;
        let solution = self.solve(Sensor::GnssLeft, outcome, fix.stamp);
        let corrected = match &mut self.phase {
            Phase::Running(running) => running.graphs.active_mut().state_at(fix.stamp),
            Phase::Waiting(_) => None,
        };
        let jump_m = corrected.map(|state| (antenna(&state, &lever_arm) - expected).norm());
        self.note_turn(judgement.turn, fix.stamp, jump_m);
        solution
    }

    pub(super) fn process_right(&mut self, fix: &GnssFix) -> Option<Box<Solution>> {
        let Phase::Running(running) = &mut self.phase else { return None };
        let lever_arm = self.options.antenna_right?;
        let trusted = running.gate.trusted();
        if !trusted && running.graphs.state() != Graph::Trial {
            return None;
        }
        let candidate = match candidate(running, &self.options, fix, &lever_arm) {
            Ok(candidate) => candidate,
            Err(error) => {
                self.refuse(Sensor::GnssRight, error.to_string());
                return None;
            }
        };
        let ratio = running.gate.test_ratio(&candidate);
        let baseline = running.last_left.and_then(|left| baseline_refusal(&self.options, &left, fix));
        let refusal = running.gate.sigma_refusal(&candidate.sigma).or(baseline).or_else(|| {
            let off = (candidate.position - candidate.expected).norm();
            (ratio > 1.0)
                .then(|| format!("is {off:.2} m from where it is expected, {ratio:.1} times the limit"))
        });
        self.monitor.note_test(self.now, Sensor::GnssRight, ratio);
        if let Some(reason) = refusal {
            self.refuse(Sensor::GnssRight, reason);
            return None;
        }
        if !trusted {
            self.try_fix(fix, &lever_arm);
            return None;
        }
        let outcome = self.add_fix(fix, &lever_arm);
        self.solve(Sensor::GnssRight, outcome, fix.stamp)
    }

    /// Ties a node of main, which answers, to a fix.
    fn add_fix(&mut self, fix: &GnssFix, lever_arm: &Vec3) -> Result<bool, SmootherError> {
        let Phase::Running(running) = &mut self.phase else { return Ok(false) };
        let sigma = running.gate.usable_sigma(&fix.sigma_enu_m);
        let measured = self.options.site.to_enu(fix.position);
        let main = running.graphs.active_mut();
        let (node, factor) = position_factor(main, fix.stamp, measured, lever_arm, sigma)?;
        main.add_position(node, factor)?;
        Ok(true)
    }

    /// Gives main, while fallback answers, a fix that may be one of those that end the outage.
    pub(super) fn try_fix(&mut self, fix: &GnssFix, lever_arm: &Vec3) {
        let Phase::Running(running) = &mut self.phase else { return };
        let sigma = running.gate.usable_sigma(&fix.sigma_enu_m);
        let measured = self.options.site.to_enu(fix.position);
        let Some(main) = running.graphs.passive_mut() else { return };
        let tried = position_factor(main, fix.stamp, measured, lever_arm, sigma)
            .and_then(|(node, factor)| running.graphs.try_position(node, factor));
        let why = match tried {
            Ok(()) => "good fixes have come back".to_owned(),
            Err(error) => {
                running.graphs.end_trial();
                format!("main could not take a fix on trial: it {error}")
            }
        };
        self.monitor.note_graph(fix.stamp, running.graphs.state(), &why);
    }

    /// The graphs follow what the gate said of a fix.
    fn move_graphs_after(&mut self, judgement: &Judgement, stamp: Stamp, contradicts: bool) {
        match judgement.turn {
            Some(Turn::Recovered) if contradicts => {
                let why = "fixes contradicted the estimate for so long that they are right";
                self.move_graphs(stamp, Graphs::recover, why);
            }
            Some(Turn::Recovered) => self.move_graphs(stamp, Graphs::recover, "fixes are good again"),
            Some(Turn::Lost { .. }) => {}
            None => {
                if judgement.refusal.is_some() {
                    self.move_graphs(stamp, Graphs::end_trial, "a fix on trial was bad");
                }
            }
        }
    }

    /// The estimate was wrong: starts the window anew where the fix says, no surer than the error it had.
    fn reseat(&mut self, candidate: &Candidate) -> Result<bool, SmootherError> {
        let Phase::Running(running) = &mut self.phase else { return Ok(false) };
        let main = running.graphs.active_mut();
        let Some((mut state, mut covariance)) = main.predict(candidate.stamp) else {
            return Ok(false);
        };
        let error = candidate.position - candidate.expected;
        state.position += error;
        for axis in 0..3 {
            covariance[(row::ROTATION + axis, row::ROTATION + axis)] += RESEAT_ROTATION_SIGMA.powi(2);
            covariance[(row::POSITION + axis, row::POSITION + axis)] += error.norm_squared();
            covariance[(row::VELOCITY + axis, row::VELOCITY + axis)] += RESEAT_VELOCITY_SIGMA.powi(2);
        }
        let information = covariance.try_inverse().ok_or(SmootherError::NotDetermined)?;
        main.start(candidate.stamp, state, &information)?;
        running.lidar.forget();
        Ok(true)
    }
}

fn antenna(state: &NavState, lever_arm: &Vec3) -> Vec3 {
    state.position + state.rotation * *lever_arm
}

/// The factor of an antenna's position in the world, and the node it ties; the position is moved by the motion
/// between its stamp and the node's.
fn position_factor(
    smoother: &mut Smoother,
    stamp: Stamp,
    mut measured: Vec3,
    lever_arm: &Vec3,
    sigma: Vec3,
) -> Result<(Stamp, PositionFactor), SmootherError> {
    let node = smoother.node_at(stamp)?;
    if node != stamp
        && let (Some(at_node), Some(at_fix)) = (smoother.state_at(node), smoother.state_at(stamp))
    {
        measured += antenna(&at_node, lever_arm) - antenna(&at_fix, lever_arm);
    }
    let factor = PositionFactor { measured, lever_arm: *lever_arm, sigma, huber_threshold: HUBER_THRESHOLD };
    Ok((node, factor))
}

/// Why two antennas of one epoch contradict their known baseline, if they do.
fn baseline_refusal(options: &Options, left: &GnssFix, right: &GnssFix) -> Option<String> {
    let apart = right.stamp - left.stamp;
    if apart.as_seconds().abs() > 0.005 {
        return None;
    }
    let known_m = (options.antenna_right? - options.antenna_left).norm();
    let seen_m = (options.site.to_enu(right.position) - options.site.to_enu(left.position)).norm();
    let limit_m = 0.02 + 5.0 * libm::hypot(left.sigma_enu_m.norm(), right.sigma_enu_m.norm());
    ((seen_m - known_m).abs() > limit_m).then(|| {
        format!("antennas are {seen_m:.2} m apart, {known_m:.2} m are known, {limit_m:.2} m is the limit")
    })
}

fn candidate(
    running: &mut Running,
    options: &Options,
    fix: &GnssFix,
    lever_arm: &Vec3,
) -> Result<Candidate, SmootherError> {
    let smoother = running.graphs.active_mut();
    let oldest = smoother.oldest_stamp().unwrap_or(fix.stamp);
    let behind_s = oldest.seconds_since(fix.stamp);
    let (state, covariance) = smoother.predict_pose(fix.stamp).ok_or(SmootherError::TooOld { behind_s })?;
    Ok(Candidate {
        stamp: fix.stamp,
        position: options.site.to_enu(fix.position),
        sigma: fix.sigma_enu_m,
        expected: antenna(&state, lever_arm),
        expected_covariance: predicted_position_covariance(&state, &covariance, lever_arm),
    })
}
