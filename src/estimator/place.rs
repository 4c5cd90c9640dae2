//! How sure a place is: heading and position together, and what brings one such covariance down to another.

use crate::factors::PoseFactor;
use crate::lie::Vec3;
use crate::state::{NavState, StateMatrix, row};
use nalgebra::{Cholesky, Matrix4, SymmetricEigen, Vector4};

/// Over heading (rad) and the sensor's position (m) in the world's axes: rows of a [`PoseFactor`]'s error from 2 on.
pub(super) type PlaceMatrix = Matrix4<f64>;
/// The same rows as a vector.
pub(super) type PlaceVector = Vector4<f64>;

/// Of where a pose factor's sensor is, from the covariance of the state there.
pub(super) fn covariance(factor: &PoseFactor, state: &NavState, of_state: &StateMatrix) -> PlaceMatrix {
    let jacobian = factor.error_jacobian(state);
    let place = jacobian.fixed_view::<4, 6>(2, 0);
    let pose = of_state.fixed_view::<6, 6>(row::ROTATION, row::ROTATION);
    place * pose * place.transpose()
}

/// Of a place that odometry reached from another by `moved` (m, world): the first one's heading swings what lies
/// ahead, and what the odometry's own heading walks on the way swings half of it,
///
///   F C Fᵀ + W,  F = [1 0; ẑ×d I],  W = q_φ [1 (ẑ×d)ᵀ/2; · (ẑ×d)(ẑ×d)ᵀ/3] + q_p diag(0, I).
///
/// `walked` are q_φ (rad²) and q_p (m²) over the whole way, taken as straight. Returned: F C Fᵀ, and W.
pub(super) fn carried(from: &PlaceMatrix, moved: &Vec3, walked: [f64; 2]) -> [PlaceMatrix; 2] {
    let swing = Vec3::z().cross(moved);
    let mut carry = PlaceMatrix::identity();
    carry.fixed_view_mut::<3, 1>(1, 0).copy_from(&swing);
    let [turn, shift] = walked;
    let mut walk = PlaceMatrix::from_diagonal(&PlaceVector::new(turn, shift, shift, shift));
    walk.fixed_view_mut::<3, 1>(1, 0).copy_from(&(swing * (turn / 2.0)));
    walk.fixed_view_mut::<1, 3>(0, 1).copy_from(&(swing.transpose() * (turn / 2.0)));
    let swung = walk.fixed_view::<3, 3>(1, 1) + swing * swing.transpose() * (turn / 3.0);
    walk.fixed_view_mut::<3, 3>(1, 1).copy_from(&swung);
    [carry * from * carry.transpose(), walk]
}

/// Squared Mahalanobis length of the difference between a prediction with `predicted` and a place that odometry
/// reached with `carried` and `walked`. The error that both began with cancels: what is left is the walk, and what
/// the prediction has gathered since. None: no covariances.
pub(super) fn squared_misfit(
    difference: &PlaceVector,
    predicted: &PlaceMatrix,
    [carried, walked]: &[PlaceMatrix; 2],
) -> Option<f64> {
    let since = SymmetricEigen::new(predicted - carried);
    let grown = since.eigenvectors
        * PlaceMatrix::from_diagonal(&since.eigenvalues.map(|variance| variance.max(0.0)))
        * since.eigenvectors.transpose();
    let solved = Cholesky::new(grown + walked)?.solve(difference);
    Some(difference.dot(&solved))
}

/// Square root W of the information Λ = Wᵀ W that brings `predicted` P down to `reached` R where R is the surer one,
/// and says nothing where P is: with P = L Lᵀ and L⁻¹ R L⁻ᵀ = U diag(ρ) Uᵀ,
///
///   W = diag(√max(1/ρ − 1, 0)) Uᵀ L⁻¹.
///
/// For a source that shares its error with the prediction, so that P must not be fused with R as if it did not.
/// None: no covariances.
pub(super) fn bring_down(predicted: &PlaceMatrix, reached: &PlaceMatrix) -> Option<PlaceMatrix> {
    let lower = Cholesky::new(*predicted)?.l();
    let inverse = lower.solve_lower_triangular(&PlaceMatrix::identity())?;
    let eigen = SymmetricEigen::new(inverse * reached * inverse.transpose());
    if eigen.eigenvalues.iter().any(|ratio| *ratio <= 0.0) {
        return None;
    }
    let gained = eigen.eigenvalues.map(|ratio| (1.0 / ratio - 1.0).max(0.0).sqrt());
    Some(PlaceMatrix::from_diagonal(&gained) * eigen.eigenvectors.transpose() * inverse)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn some_covariance(seed: f64) -> PlaceMatrix {
        let root = PlaceMatrix::from_fn(|row, column| (seed + 3.0 * row as f64 + 1.7 * column as f64).sin());
        root * root.transpose() + PlaceMatrix::identity() * 0.1
    }

    #[test]
    fn what_is_brought_down_is_as_sure_as_the_surer_one_in_every_direction() {
        let (predicted, reached) = (some_covariance(0.3), some_covariance(1.9));
        let root = bring_down(&predicted, &reached).expect("covariances");
        let information = predicted.try_inverse().expect("regular") + root.transpose() * root;
        let fused = information.try_inverse().expect("regular");
        let [by_predicted, by_reached] =
            [predicted - fused, reached - fused].map(|left| SymmetricEigen::new(left).eigenvalues);
        assert!(by_predicted.min() > -1e-9, "{by_predicted}: surer than before, never less");
        assert!(by_predicted.max() > 0.1, "{by_predicted}: something was gained");
        // Along the directions that were brought down, the fused one is R's, else P's.
        let lower = Cholesky::new(predicted).expect("covariance").l();
        let inverse = lower.try_inverse().expect("regular");
        let whitened = SymmetricEigen::new(inverse * reached * inverse.transpose());
        for (ratio, direction) in whitened.eigenvalues.iter().zip(whitened.eigenvectors.column_iter()) {
            let along = inverse.transpose() * direction;
            let fused = (along.transpose() * fused * along)[0];
            assert!((fused - ratio.min(1.0)).abs() < 1e-9, "{fused} along a direction with {ratio}");
        }
        assert!(by_reached.max() > 0.0);
    }

    #[test]
    fn who_knows_no_more_than_the_prediction_says_nothing() {
        let predicted = some_covariance(0.3);
        let root = bring_down(&predicted, &(predicted * 2.0)).expect("covariances");
        assert!(root.norm() < 1e-9, "{root}");
    }

    #[test]
    fn a_walk_is_carried_as_many_small_ones_are() {
        let (from, way) = (some_covariance(0.7), Vec3::new(4.0, -3.0, 0.5));
        let [carried_at_once, walk] = carried(&from, &way, [1e-3, 1e-2]);
        let steps = 20_000;
        let mut covariance = from;
        for _ in 0..steps {
            let part = f64::from(steps);
            let [carried, walk] = carried(&covariance, &(way / part), [1e-3 / part, 1e-2 / part]);
            covariance = carried + walk;
        }
        let at_once = carried_at_once + walk;
        assert!((covariance - at_once).norm() < 1e-4 * at_once.norm(), "{covariance} {at_once}");
    }

    #[test]
    fn an_error_that_both_began_with_is_no_misfit() {
        let shared = PlaceMatrix::identity() * 4.0;
        let off = PlaceVector::new(0.0, 2.0, 0.0, 0.0);
        let walked = PlaceMatrix::identity() * 0.01;
        let alone = squared_misfit(&off, &shared, &[PlaceMatrix::zeros(), walked]).expect("covariances");
        let of_both = squared_misfit(&off, &shared, &[shared, walked]).expect("covariances");
        assert!((alone - 4.0 / 4.01).abs() < 1e-9, "{alone}");
        assert!((of_both - 400.0).abs() < 1e-6, "{of_both}");
    }
}
