//! One coordinate over time: rests, and smooth moves between them.

use super::jet::Jet;

/// A move by `amount` with a speed that rises in `ramp_s`, holds, and falls in `ramp_s`.
#[derive(Clone, Copy, Debug)]
struct Glide {
    start_s: f64,
    from: f64,
    amount: f64,
    duration_s: f64,
    ramp_s: f64,
}

/// A coordinate that moves in glides, one after the other, and is exactly at rest between them.
///
/// During a ramp the speed follows 35x⁴ - 84x⁵ + 70x⁶ - 20x⁷, so the coordinate is a spline of degree 8
/// whose derivatives up to the fourth are continuous.
#[derive(Clone, Debug, Default)]
pub(super) struct Track {
    glides: Vec<Glide>,
    end: f64,
}

impl Track {
    /// Where the coordinate is after the last glide.
    pub(super) fn end(&self) -> f64 {
        self.end
    }

    /// Adds a glide. Glides must be added in order of time and not overlap; ramps are at most half of one.
    pub(super) fn glide(&mut self, start_s: f64, duration_s: f64, ramp_s: f64, amount: f64) {
        debug_assert!(self.glides.last().is_none_or(|last| start_s >= last.start_s + last.duration_s - 1e-9));
        let ramp_s = ramp_s.min(0.5 * duration_s);
        self.glides.push(Glide { start_s, from: self.end, amount, duration_s, ramp_s });
        self.end += amount;
    }

    /// The coordinate and its derivatives.
    pub(super) fn at(&self, time_s: f64) -> Jet {
        match self.glides.partition_point(|glide| glide.start_s <= time_s) {
            0 => Jet::constant(0.0),
            after => self.glides[after - 1].at(time_s),
        }
    }
}

impl Glide {
    fn at(&self, time_s: f64) -> Jet {
        let elapsed = time_s - self.start_s;
        let left = self.duration_s - elapsed;
        if left <= 0.0 {
            return Jet::constant(self.from + self.amount);
        }
        let speed = self.amount / (self.duration_s - self.ramp_s);
        if elapsed < self.ramp_s {
            let rising = ramp(elapsed / self.ramp_s);
            Jet::new(
                self.from + speed * self.ramp_s * rising.value,
                speed * rising.rate,
                speed / self.ramp_s * rising.acceleration,
            )
        } else if left < self.ramp_s {
            let falling = ramp(left / self.ramp_s);
            Jet::new(
                self.from + self.amount - speed * self.ramp_s * falling.value,
                speed * falling.rate,
                -speed / self.ramp_s * falling.acceleration,
            )
        } else {
            Jet::new(self.from + speed * (elapsed - 0.5 * self.ramp_s), speed, 0.0)
        }
    }
}

/// Way, speed and acceleration of a ramp over `x` from 0 to 1: the speed rises from 0 to 1.
fn ramp(x: f64) -> Jet {
    let cube = x * x * x;
    let fourth = cube * x;
    Jet::new(
        fourth * x * (7.0 + x * (-14.0 + x * (10.0 - 2.5 * x))),
        fourth * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x))),
        cube * (140.0 + x * (-420.0 + x * (420.0 - 140.0 * x))),
    )
}
