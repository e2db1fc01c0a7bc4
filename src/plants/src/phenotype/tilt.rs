//! Where stalks leave the ground if they are tilted.
//!
//! Leaves say where a plant's whorl is; its base `b_i` is off by a tilt that differs from plant to plant, with standard deviation
//! `t` in each direction. The spacing of the bases says where they are nevertheless: with whorls `w_i`, and `k_i` places
//! from one to the next,
//!
//! `min sum_i (b_i - w_i)^2 / (c t)^2 + sum_i (b_{i+1} - b_i - k_i s)^2 / (k_i (j s)^2)`,
//!
//! a tridiagonal system for each row. `c` is below one because the chain that found `w` has seen the spacing too. Lengths in pixels of the
//! reduced grid.

use super::plant_spacing::Spacing;

/// `c`, the part of a tilt that the chain has not undone yet: on synthetic masks with a tilt of 5 cm better than 0.65 and 0.85.
const LEFT: f64 = 0.45;
/// Gaps over more places than the first say nothing, nor do those further off than the second in standard deviations.
const MAX_GAP: (f64, f64) = (3.0, 2.5);
/// Scatter of plants across their row, as it is seen where none is tilted.
const IN_LINE: f64 = 1.0;

/// The bases of the plants of one row and their variances, from where their leaves are, in ascending order.
pub fn bases(whorls: &[f64], spacing: &Spacing, tilt: f64) -> Vec<[f64; 2]> {
    let loose = (LEFT * tilt).powi(2);
    if loose <= 0.0 {
        return whorls.iter().map(|&whorl| [whorl, 0.0]).collect();
    }
    let count = whorls.len();
    let (mut diagonal, mut off) = (vec![1.0 / loose; count], vec![0.0; count]);
    let mut right: Vec<f64> = whorls.iter().map(|whorl| whorl / loose).collect();
    let unit = (spacing.jitter * spacing.spacing).powi(2);
    for a in 1..count {
        let gap = whorls[a] - whorls[a - 1];
        let places = (gap / spacing.spacing).round();
        let (expected, variance) = (places * spacing.spacing, places * unit);
        let far = (gap - expected).abs() > MAX_GAP.1 * (variance + 2.0 * loose).sqrt();
        if places < 1.0 || places > MAX_GAP.0 || far {
            continue;
        }
        diagonal[a - 1] += 1.0 / variance;
        diagonal[a] += 1.0 / variance;
        off[a] = -1.0 / variance;
        right[a - 1] -= expected / variance;
        right[a] += expected / variance;
    }
    solve(&diagonal, &off, &right)
}

/// How much of an offset across the row is shrinkage, of the share that would be without a tilt, where plants scatter `wider` times as
/// far across their row as plants in line. The fourth power keeps the offsets of plants that really scatter (4 cm: `wider` of about 1.6).
pub fn shrinkage(tilt: f64, wider: f64) -> f64 {
    1.0 / (1.0 + (tilt / (IN_LINE * wider.powi(4))).powi(2))
}

/// Solution and diagonal of the inverse of a tridiagonal system; `off[k]` couples `k - 1` and `k`.
fn solve(diagonal: &[f64], off: &[f64], right: &[f64]) -> Vec<[f64; 2]> {
    let count = diagonal.len();
    // Pivots and right sides with everything before eliminated, and pivots with everything after.
    let (mut before, mut sides, mut after) = (vec![0.0; count], right.to_vec(), vec![0.0; count]);
    for k in 0..count {
        before[k] = diagonal[k];
        if k > 0 {
            let share = off[k] / before[k - 1];
            before[k] -= share * off[k];
            sides[k] -= share * sides[k - 1];
        }
    }
    let mut solved = vec![[0.0; 2]; count];
    for k in (0..count).rev() {
        after[k] = diagonal[k];
        let mut side = sides[k];
        if k + 1 < count {
            after[k] -= off[k + 1] * off[k + 1] / after[k + 1];
            side -= off[k + 1] * solved[k + 1][0];
        }
        solved[k] = [side / before[k], 1.0 / (before[k] + after[k] - diagonal[k])];
    }
    solved
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    const SPACING: Spacing = Spacing { spacing: 13.0, jitter: 0.15, missing: 0.1, doubles: 0.03 };

    #[test]
    fn bases_minimise_the_cost_by_its_definition() {
        // One place is empty, one has two plants.
        let whorls = [3.0, 14.0, 30.0, 54.0, 69.0, 71.5, 80.0];
        let (tilt, links) =
            (2.3, [(0, 1, 1.0), (1, 2, 1.0), (2, 3, 2.0), (3, 4, 1.0), (5, 6, 1.0)]);
        let count = whorls.len();
        let (mut a, mut b) = (DMatrix::<f64>::zeros(count, count), DVector::zeros(count));
        for (k, whorl) in whorls.iter().enumerate() {
            let weight = 1.0 / (LEFT * tilt).powi(2);
            a[(k, k)] += weight;
            b[k] += weight * whorl;
        }
        for (p, q, places) in links {
            let weight = 1.0 / (places * (0.15 * 13.0_f64).powi(2));
            a[(p, p)] += weight;
            a[(q, q)] += weight;
            a[(p, q)] -= weight;
            a[(q, p)] -= weight;
            b[p] -= weight * places * 13.0;
            b[q] += weight * places * 13.0;
        }
        let inverse = a.try_inverse().unwrap();
        let exact = &inverse * b;
        for (k, [base, variance]) in bases(&whorls, &SPACING, tilt).into_iter().enumerate() {
            approx::assert_relative_eq!(base, exact[k], epsilon = 1e-9);
            approx::assert_relative_eq!(variance, inverse[(k, k)], epsilon = 1e-12);
        }
    }

    #[test]
    fn without_a_tilt_leaves_are_over_their_stalk() {
        assert_eq!(bases(&[1.0, 15.0], &SPACING, 0.0), [[1.0, 0.0], [15.0, 0.0]]);
        assert!(bases(&[], &SPACING, 1.0).is_empty());
        assert_eq!(shrinkage(0.0, 1.0), 1.0);
    }
}
