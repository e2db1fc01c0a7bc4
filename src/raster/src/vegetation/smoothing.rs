//! How far colours are smoothed before they are told apart: as far as the noise of the photo asks for.
//!
//! Weights are those of the binomial distribution, along rows and columns: over 3 x 3 pixels in usual photos, and over more where noise that no neighbours share would
//! pass for leaves. A second difference both ways, which no plane and hardly any edge has, shows that noise. Noise that neighbours share, as in enlarged or strongly compressed photos, it does not show.
//! The classes are estimated from 3 x 3 pixels in all photos.
//!
//! ```text
//! n = sum_(i,j) k_i k_j z_(u+i, v+j),  k = (1, -2, 1),   sigma = median |n| / (0.6745 6).
//! ```
//!
//! Reference: J. Immerkaer, "Fast noise variance estimation", Computer Vision and Image Understanding 64, 1996.

use rowgram_optim::robust::median;

/// Pixels to either side over which colours are smoothed at most. Not compared with others.
const MAX_REACH: usize = 4;
/// The standard deviation of the noise that may be left, as a share of the distance between the means of the classes. In 146 photos of 18 sets at most 0.018 are left by 3 x 3 pixels. About
/// 0.08 are left of uncompressed noise of 5 grey levels, and with that 12 maize plots had 1,500 plants instead of 1,006. Not compared with other limits.
const MAX_NOISE: f64 = 0.06;

/// Weights of a pixel itself and of those beside it on either side, from the nearest on, along an axis. Only the pixel itself where nothing is smoothed.
pub(super) fn weights(reach: usize) -> Vec<f32> {
    // Pascal's triangle, in powers of two that are exact.
    let mut row = vec![1.0_f32];
    for _ in 0..2 * reach {
        let before = |k: usize| k.checked_sub(1).map_or(0.0, |k| row[k]);
        let next = (0..=row.len()).map(|k| 0.5 * (before(k) + row.get(k).copied().unwrap_or(0.0)));
        row = next.collect();
    }
    row.split_off(reach)
}

/// Standard deviation of noise that no neighbours share after smoothing over that before.
fn left(reach: usize) -> f64 {
    let weights = weights(reach);
    // Along both axes the sum of squares, of which the root is taken.
    weights
        .iter()
        .enumerate()
        .map(|(k, &w)| f64::from(w * w) * if k == 0 { 1.0 } else { 2.0 })
        .sum()
}

/// The second difference both ways of the 3 x 3 values around a pixel, row by row.
pub(super) fn second_difference(near: &[f64; 9]) -> f64 {
    const OF_AXIS: [f64; 3] = [1.0, -2.0, 1.0];
    near.iter().enumerate().map(|(k, value)| OF_AXIS[k / 3] * OF_AXIS[k % 3] * value).sum()
}

/// Pixels to either side over which colours are smoothed, from second differences of pixels and the distance of the classes.
pub(super) fn reach(second_differences: Vec<f64>, distance: f64) -> usize {
    /// Of a normal distribution: the median of its size over its standard deviation, and the standard deviation of second differences of unit noise.
    const MEDIAN_SIZE: f64 = 0.6745;
    const OF_SECOND_DIFFERENCE: f64 = 6.0;
    let sizes = second_differences.into_iter().map(f64::abs);
    let sigma = median(sizes).unwrap_or(0.0) / (MEDIAN_SIZE * OF_SECOND_DIFFERENCE);
    let is_enough = |reach: &usize| sigma * left(*reach) <= MAX_NOISE * distance;
    (1..MAX_REACH).find(is_enough).unwrap_or(MAX_REACH)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_binomial_and_sum_to_one() {
        assert_eq!(weights(0), [1.0]);
        assert_eq!(weights(1), [0.5, 0.25]);
        assert_eq!(weights(2), [0.375, 0.25, 0.0625]);
        for reach in 0..=MAX_REACH {
            let weights = weights(reach);
            assert_eq!(weights[0] + 2.0 * weights[1..].iter().sum::<f32>(), 1.0);
        }
        approx::assert_relative_eq!(left(1), 0.375, epsilon = 1e-12);
        approx::assert_relative_eq!(left(2), 70.0 / 256.0, epsilon = 1e-12);
    }

    #[test]
    fn noise_decides_how_far_colours_are_smoothed() {
        // Half of the second differences of noise of this standard deviation are smaller.
        let of = |sigma: f64| reach(vec![6.0 * 0.6745 * sigma, -6.0 * 0.6745 * sigma], 16.0);
        let found = [0.0, 0.8, 2.5, 3.0, 4.0, 4.5, 20.0].map(of);
        assert_eq!(found, [1, 1, 1, 2, 3, 4, 4]);
        // A plane has none, a step hardly any.
        let plane = std::array::from_fn(|k| 3.0 * (k / 3) as f64 - (k % 3) as f64);
        assert_eq!(second_difference(&plane), 0.0);
        assert_eq!(second_difference(&[0.0, 0.0, 9.0, 0.0, 0.0, 9.0, 0.0, 0.0, 9.0]), 0.0);
    }
}
