//! The loops over tiles in which the smoother spends its time.
//!
//! Each is compiled twice: for every x86-64 and for those with AVX2, chosen when it runs. Both do the same
//! operations in the same order, without fused multiply-add, so the choice changes no bit; a test holds them
//! together. On other processors there is the first alone.

#![allow(
    clippy::needless_range_loop,
    reason = "rows, columns and lanes are numbers here, as in the equations"
)]

use super::elimination::{NODE_TILES, NotPositive, lower_place};
use super::tile::{LANES, Quad, Tile};

type Panel = [[Tile; NODE_TILES]];
type Node = [Quad; NODE_TILES];

/// Makes `$name` from the plain function `$plain`.
macro_rules! for_this_processor {
    ($(#[$doc:meta])* $name:ident = $plain:ident $(<const $size:ident: usize>)?
        ($($argument:ident: $kind:ty),*) -> $result:ty) => {
        $(#[$doc])*
        pub(super) fn $name$(<const $size: usize>)?($($argument: $kind),*) -> $result {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn wide$(<const $size: usize>)?($($argument: $kind),*) -> $result {
                    $plain($($argument),*)
                }
                if std::arch::is_x86_feature_detected!("avx2") {
                    // SAFETY: the processor has what the function is compiled for.
                    return unsafe { wide($($argument),*) };
                }
            }
            $plain($($argument),*)
        }
    };
}

for_this_processor! {
    /// Adds the lower half of a square of tiles, and its right-hand side, to a front; its tile `i` belongs at
    /// `places[i]`, and places ascend.
    add = add_plain(
        panel: &mut Panel, right: &mut Node, rest: &mut [Tile], rest_right: &mut [Quad],
        places: &[usize], tiles: &[Tile], added_right: &[Quad]
    ) -> ()
}

for_this_processor! {
    /// Partial Cholesky factorization: the node's columns become L and Y, its right-hand side d, and what they
    /// say of the rest is taken from it. Cost for n rows: about 16 n²/2 multiplications.
    eliminate = eliminate_plain(
        panel: &mut Panel, right: &mut Node, scales: &mut Node, rest: &mut [Tile], rest_right: &mut [Quad]
    ) -> Result<(), NotPositive>
}

for_this_processor! {
    /// Back-substitution, Lᵀ δ = d − Yᵀ δ_r, with δ_r in `solution[NODE_TILES..]` and δ written before it.
    solve = solve_plain(panel: &Panel, right: &Node, scales: &Node, solution: &mut [Quad]) -> ()
}

for_this_processor! {
    /// The lower half of (L Lᵀ)⁻¹.
    inverse = inverse_plain(panel: &Panel, scales: &Node) -> [[Tile; NODE_TILES]; NODE_TILES]
}

for_this_processor! {
    /// The lower half of JᵀJ, column of tiles by column of tiles, and −Jᵀr, of rows with their residuals.
    square = square_plain<const SIDE: usize>(
        rows: &[([Quad; SIDE], f64)], tiles: &mut [Tile], right: &mut [Quad; SIDE]
    ) -> ()
}

#[inline(always)]
fn add_plain(
    panel: &mut Panel,
    right: &mut Node,
    rest: &mut [Tile],
    rest_right: &mut [Quad],
    places: &[usize],
    tiles: &[Tile],
    added_right: &[Quad],
) {
    let side = rest_right.len();
    let mut sources = tiles.iter();
    for (index, column) in places.iter().enumerate() {
        if let Some(later) = column.checked_sub(NODE_TILES) {
            let targets = &mut rest[lower_place(side, later, later)..][..side - later];
            for (row, source) in places[index..].iter().zip(&mut sources) {
                targets[row - column].add(source);
            }
        } else {
            for (row, source) in places[index..].iter().zip(&mut sources) {
                panel[*row][*column].add(source);
            }
        }
    }
    for (place, source) in places.iter().zip(added_right) {
        let target = match place.checked_sub(NODE_TILES) {
            Some(later) => &mut rest_right[later],
            None => &mut right[*place],
        };
        for lane in 0..LANES {
            target[lane] += source[lane];
        }
    }
}

#[inline(always)]
fn eliminate_plain(
    panel: &mut Panel,
    right: &mut Node,
    scales: &mut Node,
    rest: &mut [Tile],
    rest_right: &mut [Quad],
) -> Result<(), NotPositive> {
    for pivot in 0..NODE_TILES {
        let (above, from_pivot) = panel.split_at_mut(pivot + 1);
        let own = &mut above[pivot];
        let mut diagonal = own[pivot];
        let mut known = right[pivot];
        for before in 0..pivot {
            diagonal = diagonal.minus_product(&own[before], &own[before]);
            known = own[before].taken_from(known, &right[before]);
        }
        let (lower, scale) = diagonal.cholesky().ok_or(NotPositive)?;
        own[pivot] = lower;
        scales[pivot] = scale;
        right[pivot] = lower.solve_lower(known, &scale);
        for row in from_pivot {
            let mut tile = row[pivot];
            for before in 0..pivot {
                tile = tile.minus_product(&row[before], &own[before]);
            }
            row[pivot] = tile.times_inverse_transpose(&lower, &scale);
        }
    }
    let later = &panel[NODE_TILES..];
    let mut targets = rest.iter_mut();
    for (index, column) in later.iter().enumerate() {
        for (row, target) in later[index..].iter().zip(&mut targets) {
            *target = target.minus_products(row, column);
        }
    }
    for (row, target) in later.iter().zip(rest_right) {
        for pivot in 0..NODE_TILES {
            *target = row[pivot].taken_from(*target, &right[pivot]);
        }
    }
    Ok(())
}

#[inline(always)]
fn solve_plain(panel: &Panel, right: &Node, scales: &Node, solution: &mut [Quad]) {
    for pivot in (0..NODE_TILES).rev() {
        // Products of each column with the solution below, summed over lanes at the end.
        let mut products = Tile::ZERO;
        for (row, below) in panel[pivot + 1..].iter().zip(&solution[pivot + 1..]) {
            for (sum, column) in products.0.iter_mut().zip(&row[pivot].0) {
                for lane in 0..LANES {
                    sum[lane] += column[lane] * below[lane];
                }
            }
        }
        let mut known = right[pivot];
        for (value, product) in known.iter_mut().zip(&products.0) {
            *value -= (product[0] + product[1]) + (product[2] + product[3]);
        }
        solution[pivot] = panel[pivot][pivot].solve_lower_transpose(known, &scales[pivot]);
    }
}

#[inline(always)]
fn inverse_plain(panel: &Panel, scales: &Node) -> [[Tile; NODE_TILES]; NODE_TILES] {
    // The upper half of L⁻ᵀ, row by row; then its square.
    let mut root = [[Tile::ZERO; NODE_TILES]; NODE_TILES];
    for row in 0..NODE_TILES {
        for column in row..NODE_TILES {
            let mut tile = if row == column { Tile::IDENTITY } else { Tile::ZERO };
            for before in row..column {
                tile = tile.minus_product(&root[row][before], &panel[column][before]);
            }
            root[row][column] = tile.times_inverse_transpose(&panel[column][column], &scales[column]);
        }
    }
    let mut inverse = [[Tile::ZERO; NODE_TILES]; NODE_TILES];
    for row in 0..NODE_TILES {
        for column in 0..=row {
            let mut tile = Tile::ZERO;
            for inner in row..NODE_TILES {
                for (a, b) in root[row][inner].0.iter().zip(&root[column][inner].0) {
                    tile = tile.plus_outer(a, b);
                }
            }
            inverse[row][column] = tile;
        }
    }
    inverse
}

#[inline(always)]
fn square_plain<const SIDE: usize>(
    rows: &[([Quad; SIDE], f64)],
    tiles: &mut [Tile],
    right: &mut [Quad; SIDE],
) {
    let mut targets = tiles.iter_mut();
    for column in 0..SIDE {
        for (row, target) in (column..SIDE).zip(&mut targets) {
            let mut tile = Tile::ZERO;
            for (values, _) in rows {
                tile = tile.plus_outer(&values[row], &values[column]);
            }
            *target = tile;
        }
        let mut sum = [0.0; LANES];
        for (values, residual) in rows {
            for lane in 0..LANES {
                sum[lane] -= values[column][lane] * residual;
            }
        }
        right[column] = sum;
    }
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::smoother::tile::lower_len;

    const ROWS: usize = 24;

    /// Normal equations of a node and `LATER` tiles of later variables.
    struct Equations {
        panel: Vec<[Tile; NODE_TILES]>,
        right: Node,
        scales: Node,
        rest: Vec<Tile>,
        rest_right: Vec<Quad>,
        square: (Vec<Tile>, Vec<Quad>),
    }

    const LATER: usize = 3;
    const SIDE: usize = NODE_TILES + LATER;

    fn rows(seed: u64) -> Vec<([Quad; SIDE], f64)> {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        let mut draw = |scale: f64| -> f64 {
            let sample: f64 = StandardNormal.sample(&mut generator);
            sample * scale
        };
        // Of very different stiffness, as in a window.
        (0..ROWS + 4 * SIDE)
            .map(|row| {
                (
                    std::array::from_fn(|_| std::array::from_fn(|_| draw(f64::powi(10.0, row as i32 % 5)))),
                    draw(1.0),
                )
            })
            .collect()
    }

    fn equations(seed: u64) -> Equations {
        let (mut tiles, mut right) = (vec![Tile::ZERO; lower_len(SIDE)], [[0.0; LANES]; SIDE]);
        square_plain(&rows(seed), &mut tiles, &mut right);
        let mut sources = tiles.iter();
        let mut panel = vec![[Tile::ZERO; NODE_TILES]; SIDE];
        for column in 0..NODE_TILES {
            panel[column..].iter_mut().zip(&mut sources).for_each(|(row, tile)| row[column] = *tile);
        }
        Equations {
            panel,
            right: std::array::from_fn(|index| right[index]),
            scales: [[0.0; LANES]; NODE_TILES],
            rest: sources.copied().collect(),
            rest_right: right[NODE_TILES..].to_vec(),
            square: (tiles, right.to_vec()),
        }
    }

    type Eliminate =
        fn(&mut Panel, &mut Node, &mut Node, &mut [Tile], &mut [Quad]) -> Result<(), NotPositive>;

    fn eliminated(mut equations: Equations, eliminate: Eliminate) -> Equations {
        let Equations { panel, right, scales, rest, rest_right, .. } = &mut equations;
        eliminate(panel, right, scales, rest, rest_right).expect("positive definite");
        equations
    }

    fn bits<'a>(tiles: impl IntoIterator<Item = &'a Tile>, quads: &[Quad]) -> Vec<u64> {
        let numbers = tiles.into_iter().flat_map(|tile| tile.0).chain(quads.iter().copied());
        numbers.flatten().map(f64::to_bits).collect()
    }

    /// Where there is AVX2, this compares it with what every processor does.
    #[test]
    fn wide_instructions_change_no_bit() {
        for seed in 0..20 {
            let (plain, wide) = (equations(seed), equations(seed));
            let (plain, wide) = (eliminated(plain, eliminate_plain), eliminated(wide, eliminate));
            assert_eq!(
                bits(plain.panel.as_flattened(), &plain.right),
                bits(wide.panel.as_flattened(), &wide.right)
            );
            assert_eq!(
                bits(&plain.rest, &plain.rest_right),
                bits(&wide.rest, &wide.rest_right),
                "seed {seed}"
            );
            let mut solutions = [[[0.5; LANES]; SIDE]; 2];
            solve_plain(&plain.panel, &plain.right, &plain.scales, &mut solutions[0]);
            solve(&wide.panel, &wide.right, &wide.scales, &mut solutions[1]);
            assert_eq!(bits([], &solutions[0]), bits([], &solutions[1]), "seed {seed}");
            let inverses = [inverse_plain(&plain.panel, &plain.scales), inverse(&wide.panel, &wide.scales)];
            let [plain, wide] = inverses.map(|inverse| bits(inverse.as_flattened(), &[]));
            assert_eq!(plain, wide, "seed {seed}");
            let (mut tiles, mut right) = (vec![Tile::ZERO; lower_len(SIDE)], [[0.0; LANES]; SIDE]);
            square(&rows(seed), &mut tiles, &mut right);
            let before = equations(seed).square;
            assert_eq!(bits(&tiles, &right), bits(&before.0, &before.1), "seed {seed}");
        }
    }

    #[test]
    fn elimination_agrees_with_a_dense_solve() {
        const N: usize = SIDE * LANES;
        for seed in 0..20 {
            let Equations { square: (tiles, right), .. } = equations(seed);
            let mut dense = nalgebra::SMatrix::<f64, N, N>::zeros();
            let mut sources = tiles.iter();
            for column in 0..N / LANES {
                for row in column..N / LANES {
                    let tile = sources.next().expect("a lower half");
                    for (index, value) in tile.0.as_flattened().iter().enumerate() {
                        let place = (row * LANES + index % LANES, column * LANES + index / LANES);
                        dense[place] = *value;
                        dense[(place.1, place.0)] = *value;
                    }
                }
            }
            let right = nalgebra::SVector::<f64, N>::from_column_slice(right.as_flattened());
            let expected = dense.lu().solve(&right).expect("regular");
            let equations = eliminated(equations(seed), eliminate);
            // The later variables by what is left on them.
            let mut rest = nalgebra::SMatrix::<f64, { LATER * LANES }, { LATER * LANES }>::zeros();
            let mut sources = equations.rest.iter();
            for column in 0..LATER {
                for row in column..LATER {
                    let tile = sources.next().expect("a lower half");
                    for (index, value) in tile.0.as_flattened().iter().enumerate() {
                        let place = (row * LANES + index % LANES, column * LANES + index / LANES);
                        rest[place] = *value;
                        rest[(place.1, place.0)] = *value;
                    }
                }
            }
            let rest_right = nalgebra::SVector::<f64, { LATER * LANES }>::from_column_slice(
                equations.rest_right.as_flattened(),
            );
            let later = rest.lu().solve(&rest_right).expect("regular");
            let mut solution = [[0.0; LANES]; SIDE];
            solution[NODE_TILES..].as_flattened_mut().copy_from_slice(later.as_slice());
            solve(&equations.panel, &equations.right, &equations.scales, &mut solution);
            for (value, expected) in solution.as_flattened().iter().zip(&expected) {
                assert!(
                    (value - expected).abs() < 1e-9 * expected.abs().max(1e-3),
                    "seed {seed}: {value}, {expected}"
                );
            }
        }
    }

    #[test]
    fn equations_that_do_not_determine_are_refused() {
        let Equations { mut panel, mut right, mut scales, mut rest, mut rest_right, .. } = equations(1);
        panel[2][2].0[1] = [0.0; LANES];
        let outcome = eliminate(&mut panel, &mut right, &mut scales, &mut rest, &mut rest_right);
        assert_eq!(outcome, Err(NotPositive));
    }
}
