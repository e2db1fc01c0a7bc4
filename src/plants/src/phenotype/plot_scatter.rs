//! Standard deviations of the traits of a plot from the scatter between its parts.
//!
//! The box around a plot is cut into [`PARTS`] equal parts. With a trait `f` of the whole plot and `f_k` of the plot without part
//! `k`, the jackknife estimates its standard deviation from the parts that have data, `n` of them:
//!
//! `s^2 = (n - 1) / n * sum_k (f_k - mean f)^2`
//!
//! It holds for ratios and quantiles of sums, which traits are, as far as parts are independent: it covers what differs from place to
//! place in the plot (plants, shade, noise of the mask) and not what is common to all of it (exposure, a tilted surface).
//!
//! Reference: B. Efron and C. Stein, "The jackknife estimate of variance", Annals of Statistics 9, 1981.

use super::{colour_indices::ColourSum, plots::Measured};
use rowgram_raster::{
    height_counts::{HEIGHT_CLASS_M, HeightCounts},
    polygon::Polygon,
};

/// Parts of a plot along each axis of the raster. A standard deviation from 16 parts is known to 18 %, `1 / sqrt(2 * 15)`, and a part of a
/// plot of 2 m x 5 m still holds several plants, so that neighbouring parts hardly depend on each other.
const ACROSS: usize = 4;
/// Parts of a plot.
pub const PARTS: usize = ACROSS * ACROSS;

/// The parts of the box around a plot, in pixels of a raster.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlotParts {
    first_px: [f64; 2],
    step_px: [f64; 2],
}

impl PlotParts {
    /// Of a plot.
    pub fn of(plot: &Polygon) -> PlotParts {
        let points = || plot.rings.iter().flatten();
        let bound = |axis: usize| {
            let low = points().map(|at| at[axis]).fold(f64::INFINITY, f64::min);
            let high = points().map(|at| at[axis]).fold(f64::NEG_INFINITY, f64::max);
            (low, ((high - low) / ACROSS as f64).max(f64::MIN_POSITIVE))
        };
        let [(u, width), (v, height)] = [bound(0), bound(1)];
        PlotParts { first_px: [u, v], step_px: [width, height] }
    }

    /// Of the square that reaches so far around a place.
    pub fn around([u, v]: [f64; 2], reach_px: f64) -> PlotParts {
        let side = (2.0 * reach_px / ACROSS as f64).max(f64::MIN_POSITIVE);
        PlotParts { first_px: [u - reach_px, v - reach_px], step_px: [side; 2] }
    }

    /// The part of a place, from 0; places outside belong to the nearest.
    pub fn at(&self, place_px: [f64; 2]) -> usize {
        let along = |axis: usize| {
            let step = (place_px[axis] - self.first_px[axis]) / self.step_px[axis];
            // A cast of a float saturates, and turns NaN into 0.
            (step as usize).min(ACROSS - 1)
        };
        along(1) * ACROSS + along(0)
    }
}

/// The standard deviation of a trait by the jackknife. `has_data` says which parts take part, `without` gives the trait of the
/// plot without one of them; `None` where fewer than two parts have data, or the trait is not defined without one.
pub fn jackknife(
    has_data: impl Fn(usize) -> bool,
    without: impl Fn(usize) -> Option<f64>,
) -> Option<f64> {
    let values: Vec<f64> =
        (0..PARTS).filter(|&part| has_data(part)).map(without).collect::<Option<_>>()?;
    if values.len() < 2 {
        return None;
    }
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    Some(((n - 1.0) / n * squares).sqrt())
}

/// Sum of a quantity over pixels.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ValueSum {
    /// The sum.
    pub sum: f64,
    /// Number of pixels.
    pub pixels: u64,
}

/// Sums of a quantity over the pixels of a plot, by part.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ValueParts(pub [ValueSum; PARTS]);

impl ValueParts {
    /// Adds the value of a pixel of a part; one that is not finite is left out.
    pub fn add(&mut self, part: usize, value: f32) {
        if let Some(of) = self.0.get_mut(part).filter(|_| value.is_finite()) {
            of.sum += f64::from(value);
            of.pixels += 1;
        }
    }

    /// Number of pixels.
    pub fn pixels(&self) -> u64 {
        self.0.iter().map(|of| of.pixels).sum()
    }

    /// The mean with its standard deviation; `None` without any pixel.
    pub fn mean(&self) -> Option<Measured> {
        let without = |left_out: Option<usize>| {
            let parts = self.0.iter().enumerate().filter(|(k, _)| Some(*k) != left_out);
            let (sum, pixels) =
                parts.fold((0.0, 0), |(sum, n), (_, part)| (sum + part.sum, n + part.pixels));
            (pixels > 0).then(|| sum / pixels as f64)
        };
        let sd = jackknife(|part| self.0[part].pixels > 0, |part| without(Some(part)));
        Some(Measured { value: without(None)?, sd })
    }
}

/// Heights of the canopy in the cells of a plot, by part.
#[derive(Debug, Clone)]
pub struct HeightParts {
    pub(super) means: ValueParts,
    counts: [HeightCounts; PARTS],
}

impl Default for HeightParts {
    fn default() -> HeightParts {
        let counts = std::array::from_fn(|_| HeightCounts::new(HEIGHT_CLASS_M));
        HeightParts { means: ValueParts::default(), counts }
    }
}

impl HeightParts {
    /// Adds the height of a cell of a part, metres; one that is not finite is left out.
    pub fn add(&mut self, part: usize, height_m: f32) {
        self.means.add(part, height_m);
        if let Some(counts) = self.counts.get_mut(part) {
            counts.add(f64::from(height_m));
        }
    }

    /// The height that a share of the cells does not exceed, to half a millimetre, with its standard deviation; `None` without any.
    pub fn percentile_m(&self, share: f64) -> Option<Measured> {
        let without = |left_out: Option<usize>| {
            let parts = self.counts.iter().enumerate().filter(|(k, _)| Some(*k) != left_out);
            let mut all = HeightCounts::new(HEIGHT_CLASS_M);
            parts.for_each(|(_, counts)| all.merge(counts));
            all.percentile_m(share)
        };
        let sd = jackknife(|part| self.means.0[part].pixels > 0, |part| without(Some(part)));
        Some(Measured { value: without(None)?, sd })
    }
}

/// Sums of the colours of the leaf pixels of a plot, by part.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ColourParts(pub [ColourSum; PARTS]);

impl ColourParts {
    /// The sum over all parts but one; over all where none is left out.
    pub fn sum(&self, left_out: Option<usize>) -> ColourSum {
        let parts = self.0.iter().enumerate().filter(|(k, _)| Some(*k) != left_out);
        parts.fold(ColourSum::default(), |mut sum, (_, part)| {
            sum.rgb.iter_mut().zip(part.rgb).for_each(|(sum, value)| *sum += value);
            sum.pixels += part.pixels;
            sum
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn every_pixel_has_a_part() {
        let ring = vec![[10.0, 20.0], [18.0, 20.0], [18.0, 60.0], [10.0, 60.0]];
        let parts = PlotParts::of(&Polygon { rings: vec![ring] });
        assert_eq!(parts.at([10.0, 20.0]), 0);
        assert_eq!(parts.at([13.0, 20.5]), 1);
        assert_eq!(parts.at([17.9, 31.0]), 7);
        assert_eq!(parts.at([18.0, 60.0]), PARTS - 1);
        assert_eq!(parts.at([-5.0, 900.0]), 12);
    }

    #[test]
    fn a_mean_of_pixels_leaves_out_what_is_not_known() {
        let mut parts = ValueParts::default();
        for (part, value) in [(0, 1.0), (0, 2.0), (1, f32::NAN), (2, 6.0)] {
            parts.add(part, value);
        }
        let found = parts.mean().unwrap();
        assert_eq!((parts.pixels(), found.value), (3, 3.0));
        // Means without either part: 6 and 1.5.
        assert_relative_eq!(found.sd.unwrap(), 2.25, epsilon = 1e-12);
        assert_eq!(ValueParts::default().mean(), None);
    }

    #[test]
    fn a_percentile_of_heights_scatters_by_part() {
        let mut parts = HeightParts::default();
        assert_eq!(parts.percentile_m(0.95), None);
        for part in 0..PARTS {
            (0..100).for_each(|k| parts.add(part, 0.01 * k as f32));
            parts.add(part, f32::NAN);
        }
        let alike = parts.percentile_m(0.95).unwrap();
        assert!((alike.value - 0.94).abs() <= 0.001, "{alike:?}");
        assert!(alike.sd.unwrap() < 1e-9, "{alike:?}");
        (0..100).for_each(|_| parts.add(3, 2.0));
        assert!(parts.percentile_m(0.95).unwrap().sd.unwrap() > 0.1);
    }

    #[test]
    fn of_a_mean_it_is_the_standard_error() {
        let values: Vec<f64> = (0..PARTS).map(|k| (k * k) as f64).collect();
        let total: f64 = values.iter().sum();
        let n = PARTS as f64;
        let found = jackknife(|_| true, |k| Some((total - values[k]) / (n - 1.0))).unwrap();
        let mean = total / n;
        let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0);
        assert_relative_eq!(found, (variance / n).sqrt(), epsilon = 1e-12);
        assert_eq!(jackknife(|k| k == 3, |_| Some(1.0)), None);
        assert_eq!(jackknife(|_| true, |k| (k != 3).then_some(1.0)), None);
    }

    #[test]
    fn of_a_ratio_it_is_what_samples_scatter_by() {
        // Cover of plots whose parts have random areas and leaves: over many plots the estimate is their scatter.
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let (mut shares, mut squares) = (Vec::new(), 0.0);
        for _ in 0..2000 {
            let parts: [[f64; 2]; PARTS] = std::array::from_fn(|_| {
                let area = rng.random_range(50.0..150.0);
                [area, area * rng.random_range(0.0..0.6)]
            });
            let total = |left_out: usize| -> [f64; 2] {
                let rest = parts.iter().enumerate().filter(|(k, _)| *k != left_out);
                rest.fold([0.0; 2], |[a, b], (_, part)| [a + part[0], b + part[1]])
            };
            let share = |left_out: usize| total(left_out)[1] / total(left_out)[0];
            shares.push(share(PARTS));
            squares += jackknife(|_| true, |k| Some(share(k))).unwrap().powi(2);
        }
        let mean = shares.iter().sum::<f64>() / shares.len() as f64;
        let true_variance = shares.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 1999.0;
        let ratio = squares / shares.len() as f64 / true_variance;
        // The scatter of 2000 plots is known to 3 %.
        assert!((0.9..1.1).contains(&ratio), "{ratio}");
    }
}
