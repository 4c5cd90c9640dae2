//! Robust losses, as weights of an iteratively re-weighted least-squares problem.

/// Weight of Huber's loss for a whitened residual of length `norm`: 1 up to `threshold` sigmas, then
/// `threshold / norm` (Huber 1964; Zhang, "Parameter estimation techniques", 1997, table 1).
pub fn huber_weight(norm: f64, threshold: f64) -> f64 {
    if norm <= threshold { 1.0 } else { threshold / norm }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn far_residuals_pull_with_a_constant_force() {
        assert_eq!(huber_weight(1.0, 2.0), 1.0);
        assert_eq!(huber_weight(10.0, 2.0) * 10.0, huber_weight(50.0, 2.0) * 50.0);
    }
}
