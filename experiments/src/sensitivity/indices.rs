//! Variance-based sensitivity indices from the values of a Saltelli design.
//!
//! With `f_A`, `f_B` the values at the rows of two independent samples and `f_i` those at the rows of `A` with the numbers of
//! factor `i` from `B`,
//!
//! ```text
//! S_i = mean(f_B (f_i - f_A)) / V        first order: the share of the variance that goes if factor i is known
//! T_i = mean((f_A - f_i)^2) / (2 V)      total: the share that stays if all factors but i are known
//! ```
//!
//! References: A. Saltelli et al., "Variance based sensitivity analysis of model output", Computer Physics Communications 181,
//! 2010 (`S_i`); M. J. W. Jansen, "Analysis of variance designs for model output", Computer Physics Communications 117, 1999
//! (`T_i`). Intervals are percentiles of a bootstrap over the rows (G. E. B. Archer, A. Saltelli, I. M. Sobol', Journal of
//! Statistical Computation and Simulation 58, 1997).

use crate::{
    data::quantile,
    streams::{Stream, stream},
};
use rand::RngExt;

/// Resamples of the bootstrap.
const RESAMPLES: usize = 1000;
/// Fewer rows say nothing.
const MIN_ROWS: usize = 4;

/// The values at one row of the samples.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Row {
    pub(crate) a: f64,
    pub(crate) b: f64,
    /// By factor.
    pub(crate) mixed: Vec<f64>,
}

/// A number with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Interval {
    pub(crate) value: f64,
    pub(crate) low: f64,
    pub(crate) high: f64,
}

/// The indices of a factor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Index {
    pub(crate) first: Interval,
    pub(crate) total: Interval,
}

/// All indices of a metric.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Indices {
    pub(crate) rows: usize,
    pub(crate) mean: f64,
    pub(crate) deviation: f64,
    /// By factor.
    pub(crate) factors: Vec<Index>,
}

/// The indices of `factors` factors; nothing where the values do not vary or there are too few rows.
pub(crate) fn indices(rows: &[Row], factors: usize) -> Option<Indices> {
    if rows.len() < MIN_ROWS {
        return None;
    }
    let all: Vec<&Row> = rows.iter().collect();
    let (mean, variance) = moments(&all);
    let estimated = estimate(&all, factors)?;
    let mut rng = stream(1, Stream::Bootstrap);
    let mut samples: Vec<[Vec<f64>; 2]> = vec![[Vec::new(), Vec::new()]; factors];
    for _ in 0..RESAMPLES {
        let again: Vec<&Row> =
            rows.iter().map(|_| &rows[rng.random_range(0..rows.len())]).collect();
        // A resample of one and the same row does not vary.
        let Some(found) = estimate(&again, factors) else { continue };
        for (sample, pair) in samples.iter_mut().zip(found) {
            sample.iter_mut().zip(pair).for_each(|(sample, value)| sample.push(value));
        }
    }
    let interval = |value: f64, sample: &mut Vec<f64>| {
        sample.sort_by(f64::total_cmp);
        Interval { value, low: quantile(sample, 0.025), high: quantile(sample, 0.975) }
    };
    let factors = estimated
        .into_iter()
        .zip(&mut samples)
        .map(|([first, total], [firsts, totals])| Index {
            first: interval(first, firsts),
            total: interval(total, totals),
        })
        .collect();
    Some(Indices { rows: rows.len(), mean, deviation: variance.sqrt(), factors })
}

/// Mean and variance over both samples.
fn moments(rows: &[&Row]) -> (f64, f64) {
    let count = 2.0 * rows.len() as f64;
    let mean = rows.iter().map(|row| row.a + row.b).sum::<f64>() / count;
    let squares: f64 = rows.iter().map(|row| (row.a - mean).powi(2) + (row.b - mean).powi(2)).sum();
    (mean, squares / count)
}

fn estimate(rows: &[&Row], factors: usize) -> Option<Vec<[f64; 2]>> {
    let (mean, variance) = moments(rows);
    if !(variance > 1e-24 * mean * mean && variance > 0.0) {
        return None;
    }
    let count = rows.len() as f64;
    let index = |i: usize| {
        // Without the mean the estimate of the first order varies less.
        let first: f64 = rows.iter().map(|row| (row.b - mean) * (row.mixed[i] - row.a)).sum();
        let total: f64 = rows.iter().map(|row| (row.a - row.mixed[i]).powi(2)).sum();
        [first / count / variance, 0.5 * total / count / variance]
    };
    Some((0..factors).map(index).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensitivity::unit_points;
    use std::f64::consts::PI;

    fn rows(factors: usize, count: usize, f: impl Fn(&[f64]) -> f64) -> Vec<Row> {
        let groups: Vec<usize> = (0..factors).collect();
        unit_points(&groups, count, 3)
            .into_iter()
            .map(|point| Row {
                a: f(&point.a),
                b: f(&point.b),
                mixed: (0..factors).map(|i| f(&point.mixed(&groups, i))).collect(),
            })
            .collect()
    }

    fn near(found: &Indices, expected: &[[f64; 2]], within: f64) {
        for (k, (index, [first, total])) in found.factors.iter().zip(expected).enumerate() {
            for (found, expected) in [(index.first, first), (index.total, total)] {
                assert!((found.value - expected).abs() < within, "{k}: {found:?} for {expected}");
                assert!(found.low <= *expected + 0.01 && found.high >= *expected - 0.01, "{k}");
            }
        }
    }

    #[test]
    fn ishigami_has_its_known_indices() {
        let (a, b) = (7.0, 0.1);
        let f = |u: &[f64]| {
            let x: Vec<f64> = u.iter().map(|u| PI * (2.0 * u - 1.0)).collect();
            x[0].sin() + a * x[1].sin().powi(2) + b * x[2].powi(4) * x[0].sin()
        };
        let found = indices(&rows(3, 2048, f), 3).unwrap();
        // T. Ishigami and T. Homma, 1990, in closed form.
        let variance = a * a / 8.0 + b * PI.powi(4) / 5.0 + b * b * PI.powi(8) / 18.0 + 0.5;
        let alone = 0.5 * (1.0 + b * PI.powi(4) / 5.0).powi(2);
        let joint = 8.0 * b * b * PI.powi(8) / 225.0;
        let (s1, s2, s13) = (alone / variance, a * a / 8.0 / variance, joint / variance);
        near(&found, &[[s1, s1 + s13], [s2, s2], [0.0, s13]], 0.03);
        assert!((found.mean - a / 2.0).abs() < 0.05, "{}", found.mean);
        assert!((found.deviation.powi(2) / variance - 1.0).abs() < 0.02);
    }

    #[test]
    fn a_linear_function_is_shared_out_by_squares() {
        let weights = [1.0, 2.0, 0.0, 4.0];
        let f = |u: &[f64]| 100.0 + u.iter().zip(weights).map(|(u, w)| u * w).sum::<f64>();
        let found = indices(&rows(4, 512, f), 4).unwrap();
        let expected = weights.map(|w| [w * w / 21.0, w * w / 21.0]);
        near(&found, &expected, 0.01);
        // The intervals of a factor without effect are empty, of the others they are not.
        assert_eq!((found.factors[2].total.low, found.factors[2].total.high), (0.0, 0.0));
        assert!(found.factors[3].total.high - found.factors[3].total.low > 0.01);
    }

    #[test]
    fn grouped_factors_move_together() {
        // The first two coordinates are one factor: its index is the sum of both and their product's.
        let groups = [0, 0, 1];
        let f = |u: &[f64]| (u[0] - 0.5) * (u[1] - 0.5) + (u[2] - 0.5) / 12f64.sqrt();
        let rows: Vec<Row> = unit_points(&groups, 1024, 1)
            .into_iter()
            .map(|point| Row {
                a: f(&point.a),
                b: f(&point.b),
                mixed: (0..2).map(|i| f(&point.mixed(&groups, i))).collect(),
            })
            .collect();
        near(&indices(&rows, 2).unwrap(), &[[0.5, 0.5], [0.5, 0.5]], 0.04);
    }

    #[test]
    fn what_does_not_vary_has_no_indices() {
        assert_eq!(indices(&rows(2, 64, |_| 0.1), 2), None);
        assert_eq!(indices(&rows(2, 2, |u| u[0]), 2), None);
    }
}
