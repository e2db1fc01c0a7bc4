//! Camera positions against a block: how accurate they are, how long their errors stay alike, and which of them are wrong.

use super::{block::Block, georeference::Known};
use crate::scene::{CameraPosition, Role};
use rowgram_optim::robust::{median, sigma_of_errors};
use serde::Serialize;

/// From so many control points on these fix where a block is.
const FIXED_BY: usize = 3;

/// Camera positions against the block.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PositionFit {
    /// Standard deviations that the block suggests, horizontal and vertical, metres.
    pub sigma_m: [f64; 2],
    /// Over how many photos errors stay alike, horizontally and vertically.
    pub together: [f64; 2],
    /// Factors that told standard deviations were multiplied by along X, Y and Z, because errors exceed them; 1 where they hold.
    pub told_factors: [f64; 3],
    /// Images whose positions are far out, with the distance, metres.
    pub outliers: Vec<(u32, f64)>,
}

/// Over how many of its values a series stays alike: the integrated autocorrelation `1 + 2 sum rho_k`, up to the first
/// lag at which it is gone.
///
/// Reference: C. J. Geyer, "Practical Markov chain Monte Carlo", Statistical Science 7 (1992).
fn correlation_length(series: &[Vec<f64>]) -> f64 {
    let longest = series.iter().map(Vec::len).max().unwrap_or(0);
    let at_lag = |lag: usize| -> f64 {
        let product = |values: &Vec<f64>| {
            values.iter().zip(values.iter().skip(lag)).map(|(a, b)| a * b).sum::<f64>()
        };
        series.iter().map(product).sum()
    };
    let variance = at_lag(0);
    let shares = (1..longest / 2).map(|lag| at_lag(lag) / variance.max(f64::MIN_POSITIVE));
    1.0 + 2.0 * shares.take_while(|&share| share > 0.0).sum::<f64>()
}

/// Standard deviations that were told are believed up to this many times of them.
const TOLD_SIGMA_RATIO: f64 = 3.0;

/// How camera positions fit the block: robust standard deviations, which those whose accuracy nobody has told get, and
/// positions that are beyond five of them, which are taken out. Told ones are made larger together where they cannot be true.
///
/// Errors of a receiver drift: neighbours have nearly the same one, and together they would outweigh control that fixes the
/// block far better. Where there is control, standard deviations are made larger by the root of how long errors stay
/// alike. `told` are those that somebody has told, image by image.
pub fn weigh_positions(
    block: &Block<'_>,
    known: &mut Known,
    told: &[Option<[f64; 3]>],
) -> Option<PositionFit> {
    let left = |position: &CameraPosition| -> Option<[f64; 3]> {
        let centre = block.poses[position.image as usize]?.centre_m();
        Some(std::array::from_fn(|k| position.position_m[k] - centre[k]))
    };
    let all: Vec<[f64; 3]> = known.positions.iter().filter_map(left).collect();
    if all.len() < 4 {
        return None;
    }
    let scale = |axes: &[usize]| {
        let errors = all.iter().flat_map(|d| axes.iter().map(|&k| d[k]));
        sigma_of_errors(errors).unwrap_or(0.0).max(0.01)
    };
    let sigma_m = [scale(&[0, 1]), scale(&[2])];
    let mut outliers = Vec::new();
    // What a receiver says of its accuracy may be far from true.
    let usual = |axis: usize| {
        let of = known.positions.iter().filter_map(|p| *told.get(p.image as usize)?);
        median(of.map(|sigma| sigma[axis])).unwrap_or(0.0)
    };
    let larger: [f64; 3] = std::array::from_fn(|k| {
        (sigma_m[usize::from(k == 2)] / (TOLD_SIGMA_RATIO * usual(k)).max(1e-9)).max(1.0)
    });
    for position in &mut known.positions {
        position.sigma_m = match told.get(position.image as usize) {
            Some(Some(sigma)) => std::array::from_fn(|k| sigma[k] * larger[k]),
            _ => [sigma_m[0], sigma_m[0], sigma_m[1]],
        };
        if let Some(d) = left(position) {
            let limit = |k: usize| 5.0 * position.sigma_m[k].max(sigma_m[usize::from(k == 2)]);
            if (0..3).any(|k| d[k].abs() > limit(k)) {
                let distance = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
                outliers.push((position.image, distance));
            }
        }
    }
    known.positions.retain(|p| !outliers.iter().any(|(image, _)| *image == p.image));
    let mut together = [1.0; 2];
    if known.ground.iter().filter(|point| point.role == Role::Control).count() >= FIXED_BY {
        let mut ordered: Vec<(u32, [f64; 3])> =
            known.positions.iter().filter_map(|p| Some((p.image, left(p)?))).collect();
        ordered.sort_by_key(|(image, _)| *image);
        let axis = |k: usize| -> Vec<f64> {
            let mean = ordered.iter().map(|(_, d)| d[k]).sum::<f64>() / ordered.len().max(1) as f64;
            ordered.iter().map(|(_, d)| d[k] - mean).collect()
        };
        together = [correlation_length(&[axis(0), axis(1)]), correlation_length(&[axis(2)])];
        for position in &mut known.positions {
            for (k, sigma) in position.sigma_m.iter_mut().enumerate() {
                *sigma *= together[usize::from(k == 2)].sqrt();
            }
        }
    }
    Some(PositionFit { sigma_m, together, told_factors: larger, outliers })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn errors_that_drift_are_alike_for_as_long_as_they_do() {
        // Of a first-order autoregression, (1 + phi) / (1 - phi) on average.
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for (phi, expected) in [(0.0, 1.0), (0.5, 3.0), (0.9, 19.0)] {
            let mut series = || {
                let mut value = 0.0;
                let step = |_| {
                    value = phi * value + rng.random_range(-1.0..1.0);
                    value
                };
                (0..3000).map(step).collect::<Vec<f64>>()
            };
            let found = correlation_length(&[series(), series()]);
            assert!((found / expected - 1.0).abs() < 0.35, "{phi}: {found}");
        }
        // Too short to tell, or all the same.
        assert_eq!(correlation_length(&[vec![1.0, -1.0]]), 1.0);
        assert_eq!(correlation_length(&[vec![0.0; 20]]), 1.0);
        assert_eq!(correlation_length(&[]), 1.0);
    }
}
