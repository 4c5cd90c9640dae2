//! What the machine does: the scenario's actions turned into motion of chassis and cabin.

use super::dice::Dice;
use super::glide::Track;
use super::jet::Jet;
use super::path::{Ground, Path};
use super::rigid::RigidMotion;
use super::scenario::{Action, Machine};
use crate::lie::Se3;
use crate::time::{Span, Stamp};

/// How long the chassis takes to reach its speed, s.
const DRIVE_RAMP_S: f64 = 3.0;
/// Moves of the cabin within one digging cycle: share of the cycle until the move, share of the move.
const DIG_SWING_OUT: [f64; 2] = [0.36, 0.22];
const DIG_SWING_BACK: [f64; 2] = [0.70, 0.22];

/// A machine's motion as a function of time.
#[derive(Clone, Debug)]
pub(super) struct Motion {
    path: Path,
    ground: Ground,
    base_from_cabin: Se3,
    /// After this the motion begins again, if it does.
    period: Option<Span>,
    program: Program,
}

/// Chassis and cabin at one time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bodies {
    pub base: RigidMotion,
    pub cabin: RigidMotion,
    pub cabin_turn: Jet,
}

/// The coordinates that actions move.
#[derive(Clone, Debug, Default)]
struct Program {
    time_s: f64,
    way_m: f64,
    path_parameter: Track,
    cabin_turn: Track,
    roll: Track,
    pitch: Track,
    height: Track,
}

impl Motion {
    pub(super) fn new(machine: &Machine, base_from_cabin: Se3, repeat: bool, seed: u64, id: &str) -> Self {
        let path = Path::new(&machine.path_m);
        let ground = Ground::new(machine.ground_slope_deg.to_radians(), &mut Dice::new(seed, id, "ground"));
        let mut dice = Dice::new(seed, id, "actions");
        let mut program = Program::default();
        for action in &machine.action {
            program.add(action, &path, &mut dice);
        }
        let period = repeat.then(|| Span::from_seconds(program.time_s));
        Self { path, ground, base_from_cabin, period, program }
    }

    /// Time after which the actions are done, s.
    pub(super) fn period_s(&self) -> f64 {
        self.program.time_s
    }

    /// Where the actions leave the machine against its start: what moved, in m and rad.
    pub(super) fn left_over(&self) -> [(&'static str, f64); 5] {
        let Program { way_m, cabin_turn, roll, pitch, height, .. } = &self.program;
        [
            ("drives", *way_m),
            ("turns of the cabin", cabin_turn.end()),
            ("roll", roll.end()),
            ("pitch", pitch.end()),
            ("height", height.end()),
        ]
    }

    /// The farthest way that the actions drive to, and the whole way, m.
    pub(super) fn reach_m(machine: &Machine) -> (f64, f64, f64) {
        let (mut low, mut high, mut way_m) = (0.0_f64, 0.0_f64, 0.0_f64);
        for action in &machine.action {
            if let Action::Drive { distance_m, .. } = action {
                way_m += distance_m;
                low = low.min(way_m);
                high = high.max(way_m);
            }
        }
        (low, high, Path::new(&machine.path_m).length_m())
    }

    /// Where everything is, and how it moves.
    pub(super) fn at(&self, stamp: Stamp) -> Bodies {
        let nanos = stamp.as_nanos();
        let nanos = self.period.map_or(nanos, |period| nanos.rem_euclid(period.as_nanos()));
        let time_s = Stamp::from_nanos(nanos).as_seconds();
        let program = &self.program;
        let parameter = program.path_parameter.at(time_s);
        let [east, north, heading] = self.path.at(parameter);
        // Smooth and close to the way; its exact value does not matter to the waves.
        let way = parameter * self.path.mean_spacing_m();
        let [height, pitch, roll] = self.ground.at(way);
        let base = RigidMotion::new(
            [east, north, height + program.height.at(time_s)],
            [heading, pitch + program.pitch.at(time_s), roll + program.roll.at(time_s)],
        );
        let cabin_turn = program.cabin_turn.at(time_s);
        let cabin = base.turning(cabin_turn).mounted(&self.base_from_cabin);
        Bodies { base, cabin, cabin_turn }
    }
}

impl Program {
    fn add(&mut self, action: &Action, path: &Path, dice: &mut Dice) {
        let start_s = self.time_s;
        self.time_s += match *action {
            Action::Stand { duration_s } => duration_s,
            Action::Turn { by_deg, duration_s } => {
                self.cabin_turn.glide(start_s, duration_s, 0.5 * duration_s, by_deg.to_radians());
                duration_s
            }
            Action::Dig { cycles, cycle_s, swing_deg } => {
                for cycle in 0..cycles {
                    let begin_s = start_s + f64::from(cycle) * cycle_s;
                    let swing = swing_deg.to_radians() * dice.uniform(0.85, 1.15);
                    for ([after, share], amount) in [(DIG_SWING_OUT, swing), (DIG_SWING_BACK, -swing)] {
                        let duration_s = share * cycle_s;
                        let move_s = begin_s + after * cycle_s;
                        self.cabin_turn.glide(move_s, duration_s, 0.5 * duration_s, amount);
                    }
                }
                f64::from(cycles) * cycle_s
            }
            Action::Drive { distance_m, speed_mps, turn_deg } => {
                let even_s = distance_m.abs() / speed_mps;
                let ramp_s = DRIVE_RAMP_S.min(even_s);
                let duration_s = even_s + ramp_s;
                self.way_m += distance_m;
                let amount = path.parameter(self.way_m) - self.path_parameter.end();
                self.path_parameter.glide(start_s, duration_s, ramp_s, amount);
                if turn_deg != 0.0 {
                    self.cabin_turn.glide(start_s, duration_s, 0.5 * duration_s, turn_deg.to_radians());
                }
                duration_s
            }
            Action::Level { roll_deg, pitch_deg, height_m, duration_s } => {
                let ramp_s = 0.5 * duration_s;
                self.roll.glide(start_s, duration_s, ramp_s, roll_deg.to_radians());
                self.pitch.glide(start_s, duration_s, ramp_s, pitch_deg.to_radians());
                self.height.glide(start_s, duration_s, ramp_s, height_m);
                duration_s
            }
        };
    }
}
