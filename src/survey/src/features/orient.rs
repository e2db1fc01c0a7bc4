//! Directions of an extremum: peaks of the histogram of gradient directions around it.
//!
//! 36 bins over the full turn, each gradient weighted by its length and by a Gaussian of 1.5 times the
//! extremum's blur out to three of its standard deviations; the histogram is smoothed by
//! (1 4 6 4 1)/16, and every peak of at least 0.8 times the highest gives a direction, refined by the
//! parabola through the peak and its neighbours. Lowe 2004, section 5.

use super::{blur::MAX_LANES, gradient, pyramid::Layer};
use pulp::{Simd, WithSimd};

const BINS: usize = 36;
/// Weighting blur as a multiple of the extremum's.
const SIGMA_FACTOR: f32 = 1.5;
/// Lowest peak that counts, relative to the highest.
const PEAK_RATIO: f32 = 0.8;
/// Longest row of samples that is handled at once.
const ROW: usize = 64;

/// Directions in degrees, counted from the column axis towards the top of the picture, from 0 to 360.
pub(super) struct Directions<'a> {
    /// The layer on which the extremum was found.
    pub(super) layer: &'a Layer,
    pub(super) column: usize,
    pub(super) row: usize,
    /// Blur of the extremum in pixels of the layer.
    pub(super) sigma_px: f32,
}

impl WithSimd for Directions<'_> {
    type Output = Vec<f32>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Vec<f32> {
        let sigma = SIGMA_FACTOR * self.sigma_px;
        // At most 19 pixels: the blur is at most 1.6 * 2^(3.5 / 3) pixels.
        let radius = (3.0 * sigma).round_ties_even().clamp(0.0, (ROW / 2 - 1) as f32) as usize;
        // Column `j` from the extremum has its weight at `j + radius`.
        let mut weights = [0.0f32; ROW];
        for (k, weight) in weights.iter_mut().enumerate().take(2 * radius + 1) {
            let away = k as f32 - radius as f32;
            *weight = (-(away * away) / (2.0 * sigma * sigma)).exp();
        }
        let mut histogram = [0.0f32; BINS];
        let layer = self.layer;
        let first_row = self.row.saturating_sub(radius).max(1);
        let last_row = (self.row + radius).min(layer.height - 2);
        let first = self.column.saturating_sub(radius).max(1);
        let last = (self.column + radius).min(layer.width - 2);
        let count = last + 1 - first;
        let (mut bins, mut values) = ([0i32; ROW], [0.0f32; ROW]);
        let mut along = [0.0f32; ROW];
        along[..count].copy_from_slice(&weights[first + radius - self.column..][..count]);
        // Whole registers; what is beyond the row's last sample gets no weight.
        let padded = count.next_multiple_of(MAX_LANES);
        for row in first_row..=last_row {
            let across = weights[row + radius - self.row];
            let at = row * layer.width + first;
            let data = &layer.data;
            let (left, right) = (&data[at - 1..][..padded], &data[at + 1..][..padded]);
            let above = &data[at - layer.width..][..padded];
            let below = &data[at + layer.width..][..padded];
            for k in 0..padded {
                let dx = f32::from(right[k]) - f32::from(left[k]);
                let dy = f32::from(above[k]) - f32::from(below[k]);
                let turn = gradient::turn(dy, dx);
                let bin = gradient::round(turn * BINS as f32);
                bins[k] = if bin >= BINS as i32 { bin - BINS as i32 } else { bin };
                values[k] = (dx * dx + dy * dy).sqrt() * (along[k] * across);
            }
            for k in 0..count {
                histogram[bins[k] as usize % BINS] += values[k];
            }
        }
        peaks(&smooth(&histogram))
    }
}

fn smooth(histogram: &[f32; BINS]) -> [f32; BINS] {
    let at = |k: usize| histogram[k % BINS];
    std::array::from_fn(|k| {
        (at(k + BINS - 2) + at(k + 2)) * (1.0 / 16.0)
            + (at(k + BINS - 1) + at(k + 1)) * (4.0 / 16.0)
            + at(k) * (6.0 / 16.0)
    })
}

fn peaks(histogram: &[f32; BINS]) -> Vec<f32> {
    let highest = histogram.iter().copied().fold(0.0, f32::max);
    let mut found = Vec::new();
    for k in 0..BINS {
        let (left, right) = (histogram[(k + BINS - 1) % BINS], histogram[(k + 1) % BINS]);
        let value = histogram[k];
        if value > left && value > right && value >= PEAK_RATIO * highest {
            let bin = k as f32 + 0.5 * (left - right) / (left - 2.0 * value + right);
            found.push((bin / BINS as f32).rem_euclid(1.0) * 360.0);
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slope that rises towards `angle_deg`.
    fn slope(angle_deg: f64) -> Layer {
        let mut layer = Layer::new(64, 64);
        let (sine, cosine) = angle_deg.to_radians().sin_cos();
        for v in 0..64 {
            for u in 0..64 {
                layer.data[v * layer.width + u] =
                    (256.0 * (100.0 + 0.5 * (cosine * u as f64 - sine * v as f64))) as u16;
            }
        }
        layer
    }

    #[test]
    fn a_slope_has_one_direction_upwards() {
        for angle in [0.0, 37.0, 90.0, 145.0, 180.0, 271.0, 355.0] {
            let layer = slope(angle);
            let job = Directions { layer: &layer, column: 30, row: 33, sigma_px: 2.0 };
            let found = pulp::Arch::new().dispatch(job);
            assert_eq!(found.len(), 1, "{angle}: {found:?}");
            // All gradients fall into one bin of 10 degrees, whose centre is found.
            let off = (f64::from(found[0]) - angle + 180.0).rem_euclid(360.0) - 180.0;
            assert!(off.abs() <= 5.1, "{angle}: {found:?}");
        }
    }

    #[test]
    fn flat_ground_has_no_direction() {
        let layer = Layer::new(40, 40);
        let job = Directions { layer: &layer, column: 8, row: 8, sigma_px: 1.8 };
        assert!(pulp::Arch::new().dispatch(job).is_empty());
    }
}
