//! Leaves counted from the area that they cover.
//!
//! With `alpha` plant pixels and `rho` of them to a leaf, `lambda = alpha / rho` leaves. `rho` comes from regions in which
//! somebody counted `lambda_k` leaves,
//!
//! ```text
//! rho = sum_k alpha_k / sum_k lambda_k,
//! ```
//!
//! and an interval from whatever varies:
//!
//! - with three regions or more, `rho` from regions drawn with replacement (a bootstrap of a ratio): how well the
//!   regions agree on the size of a leaf;
//! - else, or with `rho` given, `alpha` from squares of the plot drawn with replacement (a spatial bootstrap): how
//!   evenly the plot is covered. The error of `rho` is then not in it, and [`Interval::of`] says so.
//!
//! The area of a leaf must be the same everywhere: it is not in a photo in perspective, whose scale varies.
//!
//! Reference: Ribera et al. 2016; B. Efron and R. Tibshirani, "An introduction to the bootstrap", 1993.

use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use rowgram_raster::{Mask, polygon::Polygon};
use serde::{Deserialize, Serialize};

/// Draws of a bootstrap.
const DRAWS: usize = 2000;
/// Fewest regions whose spread means something.
const REGIONS: usize = 3;

/// A region in which leaves were counted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Region {
    /// Plant pixels, `alpha_k`.
    pub pixels: f64,
    /// Counted leaves, `lambda_k`.
    pub leaves: f64,
}

/// What an interval accounts for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum IntervalSource {
    /// The spread of the calibration regions.
    Regions,
    /// The unevenness of the plot; not the error of the calibration.
    Plot,
}

rowgram_base::choices!(IntervalSource: Regions, Plot);

/// Where the count lies with a probability of 95 percent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Its lower end, leaves.
    pub low: f64,
    /// Its upper end, leaves.
    pub high: f64,
    /// What it accounts for.
    pub of: IntervalSource,
}

/// The pixels of a leaf.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// `rho`, plant pixels per leaf.
    pub rho: f64,
    regions: Vec<Region>,
}

/// Leaves of an area.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LeafCount {
    /// Plant pixels, `alpha`.
    pub pixels: u64,
    /// Leaves, `lambda`.
    pub leaves: f64,
    /// Its interval; `None` where the plot has no plant.
    pub interval: Option<Interval>,
}

/// Leaf pixels of an area, in squares of `square_px` of the raster that it touches.
pub fn squares(mask: &Mask, area: &Polygon, square_px: usize) -> Vec<u64> {
    let across = mask.width.div_ceil(square_px);
    let mut sums = vec![None; across * mask.height.div_ceil(square_px)];
    for (v, run) in area.runs(mask.width, mask.height) {
        for square in run.start / square_px..=(run.end - 1) / square_px {
            let from = run.start.max(square * square_px);
            let to = run.end.min((square + 1) * square_px);
            let pixels = mask.row(v)[from..to].iter().map(|&pixel| u64::from(pixel != 0));
            *sums[v / square_px * across + square].get_or_insert(0) += pixels.sum::<u64>();
        }
    }
    sums.into_iter().flatten().collect()
}

impl Calibration {
    /// `rho` as given.
    ///
    /// # Errors
    /// What was expected, where it is not a positive number.
    pub fn given(rho: f64) -> Result<Calibration, String> {
        if rho.is_finite() && rho > 0.0 {
            Ok(Calibration { rho, regions: Vec::new() })
        } else {
            Err(format!("{rho} plant pixels per leaf, expected a positive number"))
        }
    }

    /// From regions with counted leaves.
    ///
    /// # Errors
    /// What is wrong, where no leaf was counted, a region has a negative count, or there is no plant pixel.
    pub fn from_regions(regions: &[Region]) -> Result<Calibration, String> {
        if let Some(k) = regions.iter().position(|r| !(r.leaves.is_finite() && r.leaves >= 0.0)) {
            let leaves = regions[k].leaves;
            return Err(format!("region {} has {leaves} leaves, expected a count", k + 1));
        }
        let (pixels, leaves) = total(regions.iter());
        if leaves <= 0.0 || pixels <= 0.0 {
            return Err(format!(
                "{} regions with {pixels} plant pixels and {leaves} leaves, expected some of both",
                regions.len()
            ));
        }
        Ok(Calibration { rho: pixels / leaves, regions: regions.to_vec() })
    }

    /// Counts the leaves of a plot from the plant pixels of its squares. `seed` decides the draws.
    pub fn count(&self, squares: &[u64], seed: u64) -> LeafCount {
        let pixels: u64 = squares.iter().sum();
        let leaves = pixels as f64 / self.rho;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let of = if self.regions.len() >= REGIONS {
            IntervalSource::Regions
        } else {
            IntervalSource::Plot
        };
        let mut draws: Vec<f64> = (0..DRAWS)
            .filter_map(|_| match of {
                IntervalSource::Regions => {
                    let n = self.regions.len();
                    let drawn = (0..n).map(|_| &self.regions[rng.random_range(0..n)]);
                    let (alpha, lambda) = total(drawn);
                    (alpha > 0.0).then(|| pixels as f64 * lambda / alpha)
                }
                IntervalSource::Plot => {
                    let n = squares.len();
                    let drawn = (0..n).map(|_| squares[rng.random_range(0..n)]);
                    Some(drawn.sum::<u64>() as f64 / self.rho)
                }
            })
            .collect();
        draws.sort_by(f64::total_cmp);
        let quantile = |q: f64| draws.get((q * (draws.len() - 1) as f64).round() as usize).copied();
        let interval = (pixels > 0 && !draws.is_empty())
            .then(|| Some(Interval { low: quantile(0.025)?, high: quantile(0.975)?, of }))
            .flatten();
        LeafCount { pixels, leaves, interval }
    }
}

fn total<'a>(regions: impl Iterator<Item = &'a Region>) -> (f64, f64) {
    regions.fold((0.0, 0.0), |(a, l), region| (a + region.pixels, l + region.leaves))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rho_is_the_ratio_of_the_sums() {
        let regions = [(90.0, 9.0), (220.0, 20.0), (0.0, 0.0)]
            .map(|(pixels, leaves)| Region { pixels, leaves });
        let calibration = Calibration::from_regions(&regions).unwrap();
        approx::assert_relative_eq!(calibration.rho, 310.0 / 29.0, epsilon = 1e-12);
        let count = calibration.count(&[310, 310], 1);
        approx::assert_relative_eq!(count.leaves, 58.0, epsilon = 1e-12);
        let interval = count.interval.unwrap();
        assert_eq!(interval.of, IntervalSource::Regions);
        // Whatever is drawn, rho lies between the regions' own: 10 and 11.
        assert!(
            interval.low >= 620.0 / 11.0 - 1e-9 && interval.high <= 62.0 + 1e-9,
            "{interval:?}"
        );
    }

    #[test]
    fn the_interval_covers_the_truth_about_as_often_as_it_says() {
        // Regions of 25 leaves whose mean size varies by 10 percent from region to region.
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut covered = 0;
        let trials = 200;
        for trial in 0..trials {
            let regions: Vec<Region> = (0..12)
                .map(|_| {
                    let noise: f64 = (0..12).map(|_| rng.random_range(-0.5..0.5)).sum();
                    Region { pixels: 25.0 * 100.0 * (1.0 + 0.1 * noise), leaves: 25.0 }
                })
                .collect();
            let calibration = Calibration::from_regions(&regions).unwrap();
            let interval = calibration.count(&[100_000], trial).interval.unwrap();
            covered += u32::from((interval.low..interval.high).contains(&1000.0));
        }
        // 95 % of 200 with the small-sample shortfall of a percentile bootstrap; 4 binomial deviations.
        let share = f64::from(covered) / trials as f64;
        assert!((0.84..=0.99).contains(&share), "{share}");
    }

    #[test]
    fn few_regions_leave_the_unevenness_of_the_plot() {
        let calibration = Calibration::given(10.0).unwrap();
        let even = calibration.count(&[50; 20], 1).interval.unwrap();
        assert_eq!((even.low, even.high, even.of), (100.0, 100.0, IntervalSource::Plot));
        let mut squares = [0; 20];
        squares[3] = 1000;
        let uneven = calibration.count(&squares, 1).interval.unwrap();
        assert!(uneven.low < 50.0 && uneven.high > 200.0, "{uneven:?}");
        assert_eq!(calibration.count(&[0, 0], 1).interval, None);
        assert_eq!(calibration.count(&[], 1).leaves, 0.0);
    }

    #[test]
    fn what_cannot_be_a_calibration_is_refused() {
        for rho in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(Calibration::given(rho).is_err());
        }
        let region = |pixels, leaves| Region { pixels, leaves };
        for regions in
            [vec![], vec![region(0.0, 5.0)], vec![region(9.0, 0.0)], vec![region(9.0, -1.0)]]
        {
            assert!(Calibration::from_regions(&regions).is_err(), "{regions:?}");
        }
    }
}
