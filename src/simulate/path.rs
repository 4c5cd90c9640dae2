//! The way that the chassis drives: a smooth curve over the ground, and the ground itself.

use super::dice::Dice;
use super::jet::Jet;

const DEGREE: usize = 5;
/// Steps of the length table in one segment.
const LENGTH_STEPS: usize = 32;

/// A uniform B-spline of degree 5 in the plane, drawn towards its control points. The parameter counts
/// control points; the curve begins at the first and ends at the last.
#[derive(Clone, Debug)]
pub(super) struct Path {
    /// With two more points at each end, on straight lines.
    control: Vec<[f64; 2]>,
    /// Way from the start at parameters `index / LENGTH_STEPS`, m.
    length: Vec<f64>,
}

impl Path {
    /// Needs two points at least, no two neighbours at the same place.
    pub(super) fn new(points: &[[f64; 2]]) -> Self {
        let beyond = |end: [f64; 2], before: [f64; 2], steps: f64| -> [f64; 2] {
            std::array::from_fn(|axis| end[axis] + steps * (end[axis] - before[axis]))
        };
        let last = points.len() - 1;
        let mut control = vec![beyond(points[0], points[1], 2.0), beyond(points[0], points[1], 1.0)];
        control.extend_from_slice(points);
        control.extend([1.0, 2.0].map(|steps| beyond(points[last], points[last - 1], steps)));
        let mut path = Self { control, length: vec![0.0] };
        let mut way = 0.0;
        for index in 0..last * LENGTH_STEPS {
            let middle = (index as f64 + 0.5) / LENGTH_STEPS as f64;
            let [x, y] = [0, 1].map(|axis| path.derivatives(axis, middle)[1]);
            way += x.hypot(y) / LENGTH_STEPS as f64;
            path.length.push(way);
        }
        path
    }

    /// Length of the whole way, m.
    pub(super) fn length_m(&self) -> f64 {
        self.length.last().copied().unwrap_or(0.0)
    }

    /// Mean way from one control point to the next, m.
    pub(super) fn mean_spacing_m(&self) -> f64 {
        self.length_m() * LENGTH_STEPS as f64 / (self.length.len() - 1) as f64
    }

    /// The parameter where so much of the way (m) is behind; linear between the table's entries.
    pub(super) fn parameter(&self, way_m: f64) -> f64 {
        let after = self.length.partition_point(|length| *length <= way_m).clamp(1, self.length.len() - 1);
        let (low, high) = (self.length[after - 1], self.length[after]);
        (after as f64 - 1.0 + (way_m - low) / (high - low)) / LENGTH_STEPS as f64
    }

    /// East, north and heading (rad) as the parameter moves.
    pub(super) fn at(&self, parameter: Jet) -> [Jet; 3] {
        let [x, y] = [0, 1].map(|axis| self.derivatives(axis, parameter.value));
        let along = |d: [f64; 4]| parameter.through([d[0], d[1], d[2]]);
        let tangent = |d: [f64; 4]| parameter.through([d[1], d[2], d[3]]);
        [along(x), along(y), Jet::atan2(tangent(y), tangent(x))]
    }

    /// A coordinate and its first three derivatives by the parameter.
    fn derivatives(&self, axis: usize, parameter: f64) -> [f64; 4] {
        let segments = self.control.len() - DEGREE;
        let segment = (parameter.floor().max(0.0) as usize).min(segments - 1);
        let local = parameter - segment as f64;
        let mut points: [f64; DEGREE + 1] = std::array::from_fn(|index| self.control[segment + index][axis]);
        let mut derivatives = [0.0; 4];
        for (order, derivative) in derivatives.iter_mut().enumerate() {
            let degree = DEGREE - order;
            let weights = basis(degree, local);
            *derivative = (0..=degree).map(|index| weights[index] * points[index]).sum();
            // The derivative of a uniform B-spline is the spline of its control points' differences.
            for index in 0..degree {
                points[index] = points[index + 1] - points[index];
            }
        }
        derivatives
    }
}

/// Weights of a uniform B-spline's `degree + 1` control points at `local` in 0..1 (Cox and de Boor).
fn basis(degree: usize, local: f64) -> [f64; DEGREE + 1] {
    let mut weights = [0.0; DEGREE + 1];
    weights[0] = 1.0;
    for order in 1..=degree {
        let mut carried = 0.0;
        for index in 0..order {
            let share = weights[index] / order as f64;
            weights[index] = carried + (index as f64 + 1.0 - local) * share;
            carried = (local + (order - index) as f64 - 1.0) * share;
        }
        weights[order] = carried;
    }
    weights
}

/// Ground that is not flat: waves along the way.
#[derive(Clone, Debug)]
pub(super) struct Ground {
    /// Slope (rad) and phase of each wave, along and across the way.
    waves: [[f64; 3]; 4],
}

impl Ground {
    /// Wavelengths, m.
    const WAVELENGTHS_M: [f64; 4] = [11.3, 17.9, 43.0, 97.0];

    pub(super) fn new(slope: f64, dice: &mut Dice) -> Self {
        let turn = std::f64::consts::TAU;
        let waves = [(); 4].map(|()| [0.4 * slope, dice.uniform(0.0, turn), dice.uniform(0.0, turn)]);
        Self { waves }
    }

    /// Height (m), pitch and roll (rad) where so much of the way (m) is behind. Pitch is positive with
    /// the nose down.
    pub(super) fn at(&self, way: Jet) -> [Jet; 3] {
        let mut sum = [Jet::default(); 3];
        for (wavelength_m, [slope, along, across]) in Self::WAVELENGTHS_M.into_iter().zip(self.waves) {
            let wave_number = std::f64::consts::TAU / wavelength_m;
            let (sin, cos) = (way * wave_number + Jet::constant(along)).sin_cos();
            let (sin_across, _) = (way * wave_number + Jet::constant(across)).sin_cos();
            sum[0] = sum[0] + sin * (slope / wave_number);
            sum[1] = sum[1] - cos * slope;
            sum[2] = sum[2] + sin_across * slope;
        }
        sum
    }
}
