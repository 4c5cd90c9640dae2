//! A quantity with its first and second derivative in time, carried exactly through formulas.

use std::ops::{Add, Mul, Sub};

/// Value, first and second time derivative.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Jet {
    pub value: f64,
    pub rate: f64,
    pub acceleration: f64,
}

impl Jet {
    pub(super) const fn new(value: f64, rate: f64, acceleration: f64) -> Self {
        Self { value, rate, acceleration }
    }

    pub(super) const fn constant(value: f64) -> Self {
        Self::new(value, 0.0, 0.0)
    }

    /// `f(self)` from `f`, `f'` and `f''` at `self.value`: the chain rule.
    pub(super) fn through(self, [f, f1, f2]: [f64; 3]) -> Self {
        Self::new(f, f1 * self.rate, f2 * self.rate * self.rate + f1 * self.acceleration)
    }

    pub(super) fn sin_cos(self) -> (Self, Self) {
        let (sin, cos) = self.value.sin_cos();
        (self.through([sin, cos, -sin]), self.through([cos, -sin, -cos]))
    }

    /// The angle of the vector (`x`, `y`), which must not be zero.
    pub(super) fn atan2(y: Self, x: Self) -> Self {
        let squared = x * x + y * y;
        // Its rate is (x y' - y x') / (x² + y²); the parts of that quotient and their derivatives follow.
        let numerator = x.value * y.rate - y.value * x.rate;
        let numerator_rate = x.value * y.acceleration - y.value * x.acceleration;
        let rate = numerator / squared.value;
        let acceleration = (numerator_rate - rate * squared.rate) / squared.value;
        Self::new(y.value.atan2(x.value), rate, acceleration)
    }
}

impl Add for Jet {
    type Output = Jet;
    fn add(self, other: Jet) -> Jet {
        Jet::new(self.value + other.value, self.rate + other.rate, self.acceleration + other.acceleration)
    }
}

impl Sub for Jet {
    type Output = Jet;
    fn sub(self, other: Jet) -> Jet {
        self + other * -1.0
    }
}

impl Mul for Jet {
    type Output = Jet;
    fn mul(self, other: Jet) -> Jet {
        Jet::new(
            self.value * other.value,
            self.rate * other.value + self.value * other.rate,
            self.acceleration * other.value + 2.0 * self.rate * other.rate + self.value * other.acceleration,
        )
    }
}

impl Mul<f64> for Jet {
    type Output = Jet;
    fn mul(self, factor: f64) -> Jet {
        Jet::new(self.value * factor, self.rate * factor, self.acceleration * factor)
    }
}
