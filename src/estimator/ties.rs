//! Edges between two nodes: by a chassis that stood, and by how its gyroscope turned. Both graphs get them; the one
//! that answers says what agrees.

use super::chassis_turn::{self, ChassisTurn};
use super::graphs::Graphs;
use super::options::Options;
use super::standstill::{FIRST_TIE, Standstill, TIE_EVERY, imu_from_base, stands};
use crate::factors::{BetweenFactor, TurnFactor};
use crate::lie::Se3;

/// A chassis gyroscope further from the estimate has a wrong encoder beside it, rad/s: any bias is less.
const TURN_MISFIT_MAX: f64 = 0.03;
/// A chassis that the estimate moves so far between two ties does not stand: m, rad.
const TIE_MISFIT_MAX: [f64; 2] = [0.02, 0.002];
/// Over a first tie, which is shorter, it moves less: m, and m/s.
const FIRST_MISFIT_MAX: [f64; 2] = [0.003, 0.02];

/// Ties two nodes of one standstill, if a second has gone by since the last tie. With `cabin_turns`, it is the
/// chassis that was watched, and the cabin may have turned in between; else all of the machine stood.
pub(super) fn tie_chassis(
    graphs: &mut Graphs,
    options: &Options,
    standstill: &mut Standstill,
    cabin_turns: bool,
) {
    let Some((since, until)) = standstill.certain() else { return };
    let smoother = graphs.active_mut();
    let oldest = smoother.oldest_stamp().unwrap_or(since);
    // Another graph may answer by now, with its nodes up to a millisecond aside.
    let tied = standstill.tied.filter(|tied| *tied >= oldest && smoother.node_before(*tied) == Some(*tied));
    let from = tied.or_else(|| smoother.node_after(since));
    let (Some(from), Some(to)) = (from, smoother.node_before(until)) else { return };
    let whole = to - from >= TIE_EVERY;
    if !whole && (standstill.tied.is_some() || to - from < FIRST_TIE) {
        return;
    }
    let turn_at = |stamp| if cabin_turns { standstill.turn_at(stamp) } else { Some(0.0) };
    let (Some(from_angle), Some(to_angle)) = (turn_at(from), turn_at(to)) else { return };
    let [at_from, at_to] = [from_angle, to_angle].map(|angle| imu_from_base(options, angle));
    let (Some(state_from), Some(state_to), Some(sample)) =
        (smoother.state_at(from), smoother.state_at(to), smoother.samples().at(to))
    else {
        return;
    };
    let measured = *(at_from * at_to.inverse()).motion();
    let predicted = *(state_from.world_from_imu().inverse() * state_to.world_from_imu()).motion();
    let misfit = measured.inverse() * predicted;
    let first_shift_max = FIRST_MISFIT_MAX[0] + FIRST_MISFIT_MAX[1] * to.seconds_since(from);
    let shift_max = if whole { TIE_MISFIT_MAX[0] } else { first_shift_max };
    let agrees = stands(&state_to, &(sample.angular_rate - state_to.gyro_bias), &at_to)
        && misfit.translation.norm() < shift_max
        && misfit.rotation.log().norm() < TIE_MISFIT_MAX[1];
    if !agrees {
        if whole {
            standstill.end();
        }
        return;
    }
    let factor = BetweenFactor { measured, imu_from_sensor: Se3::identity(), sigma: standstill.tie_sigma() };
    if graphs.add_between(from, to, factor).is_ok() {
        standstill.note_tie(to);
    }
}

/// Ties two nodes by the turn of the chassis' gyroscope, if a second has gone by since the last tie.
pub(super) fn tie_turn(
    graphs: &mut Graphs,
    options: &Options,
    chassis: &mut ChassisTurn,
    standstill: &Standstill,
) {
    let (Some((since, until)), Some(newest_turn)) = (chassis.covered(), standstill.newest_turn()) else {
        return;
    };
    let smoother = graphs.active_mut();
    let oldest = smoother.oldest_stamp().unwrap_or(since);
    let tied = chassis.tied.filter(|tied| *tied >= oldest && smoother.node_before(*tied) == Some(*tied));
    let from = tied.or_else(|| smoother.node_after(since.max(oldest)));
    let (Some(from), Some(to)) = (from, smoother.node_before(until.min(newest_turn))) else { return };
    if to - from < TIE_EVERY {
        return;
    }
    chassis.tied = Some(to);
    let (Some(from_angle), Some(to_angle)) = (standstill.turn_at(from), standstill.turn_at(to)) else {
        return;
    };
    let (Some(state_from), Some(state_to)) = (smoother.state_at(from), smoother.state_at(to)) else { return };
    let Some(measured) = chassis.turned(from, to, state_from.base_gyro_bias) else { return };
    let span_s = to.seconds_since(from);
    let factor = TurnFactor {
        measured,
        base_gyro_bias: state_from.base_gyro_bias,
        span_s,
        imu_from_base: [from_angle, to_angle].map(|angle| imu_from_base(options, angle).rotation()),
        sigma: chassis_turn::sigma(options.base_gyroscope_noise_density, span_s, to_angle - from_angle),
    };
    let misfit = factor.residual(&state_from, &state_to) * factor.sigma;
    if misfit.abs() < TURN_MISFIT_MAX * span_s {
        graphs.in_passive(from, to, |main| main.add_turn(from, to, factor));
        // Both ends are nodes of the window.
        let _ = graphs.active_mut().add_turn(from, to, factor);
    }
}
