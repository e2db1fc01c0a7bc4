//! Rows as they run: smooth curves along the ridges of the votes.
//!
//! A detected row is straight; a planted one may bend by decimetres. Its offset `y(a)` at knots along
//! the row minimises
//!
//! `sum_k W_k (y_k - m_k)^2 + lambda mean(W) sum_k (y_{k-1} - 2 y_k + y_{k+1})^2`,
//!
//! where `W_k` and `m_k` are weight and mean of the squared votes near knot `k`, seen through a window
//! about the current curve that narrows from round to round. All lengths in pixels of the reduced
//! grid of [`Evidence`].

use super::{evidence::Evidence, rows::Row};
use crate::problems::plants::lines::Axes;
use rayon::prelude::*;

/// Distance between knots.
const KNOT: f64 = 16.0;
/// Strength of the smoothing.
const LAMBDA: f64 = 3.0;
/// Narrowest window.
const NARROWEST: f64 = 1.2;
/// Rounds; the window narrows by a quarter in each.
const ROUNDS: i32 = 8;

/// The course of one row.
#[derive(Debug, Clone, PartialEq)]
pub struct RowCurve {
    /// Where it begins, along the rows.
    pub start: f64,
    /// Where it ends.
    pub end: f64,
    /// Offset across the rows at each knot.
    pub offsets: Vec<f64>,
}

impl RowCurve {
    /// A straight row.
    pub fn straight(row: &Row) -> RowCurve {
        let knots = (row.length_px() / KNOT).ceil().max(1.0) as usize + 1;
        RowCurve { start: row.start_px, end: row.end_px, offsets: vec![row.across_px; knots] }
    }

    /// From its beginning to its end, along the rows.
    pub(super) fn length(&self) -> f64 {
        self.end - self.start
    }

    /// Offset across at a place along, held beyond the ends.
    pub fn offset(&self, along: f64) -> f64 {
        let last = self.offsets.len() - 1;
        let place = ((along - self.start) / KNOT).clamp(0.0, last as f64);
        let left = (place as usize).min(last.saturating_sub(1));
        let right = (left + 1).min(last);
        self.offsets[left] + (place - left as f64) * (self.offsets[right] - self.offsets[left])
    }

    /// The part of it between two places along the row.
    pub(super) fn part(&self, start: f64, end: f64) -> RowCurve {
        let knots = ((end - start) / KNOT).ceil().max(1.0) as usize + 1;
        let offsets = (0..knots).map(|knot| self.offset(start + KNOT * knot as f64)).collect();
        RowCurve { start, end, offsets }
    }

    fn refine(&mut self, evidence: &Evidence<'_>, axes: &Axes, window: f64, reach: f64) {
        let count = self.offsets.len();
        let (mut weights, mut means) = (vec![0.0; count], vec![0.0; count]);
        let reach = reach.floor() as i32;
        for knot in 0..count {
            let middle = self.offsets[knot];
            let (mut sum, mut product) = (0.0, 0.0);
            for step in -7..=7 {
                let along = self.start + KNOT * knot as f64 + 2.0 * f64::from(step);
                let tent = 1.0 - f64::from(step).abs() / 8.0;
                for across in -reach..=reach {
                    let away = f64::from(across);
                    let votes = evidence.at(axes.image([along, middle + away]));
                    let weight = tent * votes * votes * (-0.5 * (away / window).powi(2)).exp();
                    sum += weight;
                    product += weight * away;
                }
            }
            weights[knot] = sum;
            means[knot] = middle + if sum > 0.0 { product / sum } else { 0.0 };
        }
        let mean = weights.iter().sum::<f64>() / count as f64;
        if mean > 0.0 {
            // Where nothing votes, the curve stays, softly.
            let weights: Vec<f64> = weights.iter().map(|w| w / mean + 1e-3).collect();
            self.offsets = smooth(&weights, &means);
        }
    }
}

/// Finds the course of every row.
pub fn trace(
    evidence: &Evidence<'_>,
    axes: &Axes,
    rows: &[Row],
    spacing: Option<f64>,
) -> Vec<RowCurve> {
    let reach = spacing.map_or(12.0, |spacing| (spacing / 4.0).min(12.0)).max(2.0);
    rows.par_iter()
        .map(|row| {
            let mut ridge = RowCurve::straight(row);
            for round in 0..ROUNDS {
                let window = (reach / 2.0 * 0.75_f64.powi(round)).max(NARROWEST);
                ridge.refine(evidence, axes, window, reach);
            }
            ridge
        })
        .collect()
}

/// Solves `(diag(w) + lambda D^T D) y = diag(w) m`, `D` the second differences: five diagonals,
/// factored as `L D L^T`.
fn smooth(weights: &[f64], means: &[f64]) -> Vec<f64> {
    let count = weights.len();
    let (mut diagonal, mut first, mut second) =
        (weights.to_vec(), vec![0.0; count], vec![0.0; count]);
    for k in 2..count {
        diagonal[k - 2] += LAMBDA;
        diagonal[k - 1] += 4.0 * LAMBDA;
        diagonal[k] += LAMBDA;
        first[k - 1] -= 2.0 * LAMBDA;
        first[k] -= 2.0 * LAMBDA;
        second[k] += LAMBDA;
    }
    // `first[k]` and `second[k]` couple knot `k` with the one and the two before it.
    let mut y: Vec<f64> = weights.iter().zip(means).map(|(w, m)| w * m).collect();
    for k in 0..count {
        let (mut own, mut one) = (diagonal[k], first[k]);
        if k >= 2 {
            let two = second[k] / diagonal[k - 2];
            one -= two * first[k - 1] * diagonal[k - 2];
            own -= two * two * diagonal[k - 2];
            second[k] = two;
            y[k] -= two * y[k - 2];
        }
        if k >= 1 {
            let factor = one / diagonal[k - 1];
            own -= factor * factor * diagonal[k - 1];
            first[k] = factor;
            y[k] -= factor * y[k - 1];
        }
        diagonal[k] = own;
    }
    for k in 0..count {
        y[k] /= diagonal[k];
    }
    for k in (0..count).rev() {
        if k >= 1 {
            y[k - 1] -= first[k] * y[k];
        }
        if k >= 2 {
            y[k - 2] -= second[k] * y[k];
        }
    }
    y
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::Mask;

    #[test]
    fn the_banded_solution_solves_the_equations() {
        let count = 9;
        let weights: Vec<f64> = (0..count).map(|k| 0.1 + (k * 5 % 7) as f64).collect();
        let means: Vec<f64> = (0..count).map(|k| (k * k % 11) as f64).collect();
        let y = smooth(&weights, &means);
        for k in 0..count {
            let mut gradient = weights[k] * (y[k] - means[k]);
            for c in 1..count - 1 {
                let bend = y[c - 1] - 2.0 * y[c] + y[c + 1];
                let part = if k == c {
                    -2.0
                } else if k.abs_diff(c) == 1 {
                    1.0
                } else {
                    0.0
                };
                gradient += LAMBDA * bend * part;
            }
            assert!(gradient.abs() < 1e-9, "{k}: {gradient}");
        }
        assert_eq!(smooth(&[2.0], &[3.0]), [3.0]);
    }

    #[test]
    fn a_bent_row_is_followed() {
        let course = |a: f64| 30.0 + 5.0 * (a / 60.0).sin();
        let mask = Mask::from_fn(300, 60, |u, v| {
            (v as f64 - course(u as f64)).abs() < 1.5 && (5..295).contains(&u)
        });
        let evidence = Evidence::new(&mask, 0.0, 1);
        let axes = Axes { origin_px: [0.0; 2], heading_rad: 0.0 };
        let row = Row { across_px: 30.0, start_px: 5.0, end_px: 295.0, pixels: 900 };
        let ridge = &trace(&evidence, &axes, &[row], None)[0];
        for a in 20..280 {
            let error = ridge.offset(f64::from(a)) - course(f64::from(a));
            assert!(error.abs() < 0.8, "{a}: {error}");
        }
    }
}
