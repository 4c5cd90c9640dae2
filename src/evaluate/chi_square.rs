//! The chi-square distribution: what squared errors over their variances may be.

/// Part of the distribution with `degrees` of freedom below `value`: the regularized incomplete gamma function
/// P(k/2, x/2), by its series or by its continued fraction (Abramowitz and Stegun 6.5.29 and 6.5.31).
pub fn chi_square_below(value: f64, degrees: f64) -> f64 {
    let (shape, x) = (0.5 * degrees, 0.5 * value);
    if x <= 0.0 {
        return 0.0;
    }
    let front = libm::exp(shape * libm::log(x) - x - libm::lgamma(shape));
    if x < shape + 1.0 {
        let mut term = 1.0 / shape;
        let mut sum = term;
        let mut index = shape;
        while term > sum * 1e-16 {
            index += 1.0;
            term *= x / index;
            sum += term;
        }
        return front * sum;
    }
    // Lentz's method.
    let tiny = 1e-300;
    let mut b = x + 1.0 - shape;
    let mut c = 1.0 / tiny;
    let mut d = 1.0 / b;
    let mut fraction = d;
    for index in 1..10_000 {
        let index = f64::from(index);
        let a = index * (shape - index);
        b += 2.0;
        d = a * d + b;
        d = 1.0 / if d.abs() < tiny { tiny } else { d };
        c = b + a / c;
        c = if c.abs() < tiny { tiny } else { c };
        let change = c * d;
        fraction *= change;
        if (change - 1.0).abs() < 1e-15 {
            break;
        }
    }
    1.0 - front * fraction
}

/// The value below which `part` (between 0 and 1) of the distribution lies, by halving.
pub fn chi_square_quantile(part: f64, degrees: f64) -> f64 {
    let (mut low, mut high) = (0.0, degrees + 10.0);
    while chi_square_below(high, degrees) < part {
        high *= 2.0;
    }
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if chi_square_below(middle, degrees) < part {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

/// Bounds that hold 95 % of the means of `count` independent values, each a chi-square of `degrees` of freedom
/// divided by them: 1 is in their middle.
pub fn mean_bounds(count: f64, degrees: f64) -> [f64; 2] {
    let whole = (count * degrees).max(1e-9);
    [0.025, 0.975].map(|part| chi_square_quantile(part, whole) / whole)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_tables() {
        for (part, degrees, value) in [
            (0.95, 1.0, 3.841_458_820_694_124),
            (0.95, 3.0, 7.814_727_903_251_178),
            (0.999, 3.0, 16.266_236_196_238_13),
            (0.999, 6.0, 22.457_744_484_825_326),
            (0.025, 10.0, 3.246_972_780_236_842),
            (0.975, 100.0, 129.561_197_187_596_5),
        ] {
            let found = chi_square_quantile(part, degrees);
            assert!((found / value - 1.0).abs() < 1e-10, "{part} {degrees}: {found}");
        }
    }

    #[test]
    fn bounds_close_in_on_one() {
        let [few, many] = [10.0, 10_000.0].map(|count| mean_bounds(count, 3.0));
        assert!(few[0] < many[0] && many[0] < 1.0 && 1.0 < many[1] && many[1] < few[1]);
        assert!((many[1] - 1.0) < 0.02);
    }
}
