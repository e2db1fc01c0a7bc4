//! How far apart the plants of a row are.
//!
//! A planter drops seeds at a spacing `s` that it meets with a relative error `j`; a share `m` of the
//! seeds gives no plant, and a share `d` of the gaps is between two plants in one place. Gaps are then
//! independent, with the density
//!
//! `p(g) = (1-d) sum_k (1-m) m^(k-1) N(g; k s, k j^2 s^2) + d N(g; 0.24 s, (0.07 s)^2)`, k = 1, 2, ...
//!
//! The four parameters are re-estimated from the gaps of the plants found, under weak priors that
//! keep a few gaps from collapsing them. Lengths in pixels.

use serde::Serialize;
use std::f64::consts::TAU;

/// Gap plants in a row that are thought possible.
const MAX_GAP_PLANTS: usize = 6;
/// Relative jitter expected, and how many gaps that expectation weighs.
const JITTER: (f64, f64) = (0.15, 100.0);

/// Shares of missing and of double plants that no stand of a crop has both. Found where plants are leaves of beans: 0.33 to 0.50 and 0.05 to
/// 0.17 in 13 of 13 plots; on 100 maize plots 0.23 and 0.09 at most, on seedling clips both in 1 of 50. Chosen with the
/// beans in view, so beans are no set left out.
const UNEVEN: (f64, f64) = (0.325, 0.045);
/// Share of double plants that no stand has alone; 0.13 at most on the same photos of crops.
const MAX_DOUBLES: f64 = 0.18;

/// The spacing of the plants in their rows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spacing {
    /// Distance from plant to plant where none is missing.
    pub spacing: f64,
    /// Its standard deviation over the spacing.
    pub jitter: f64,
    /// Share of the places without a plant.
    pub missing: f64,
    /// Share of the gaps between two plants in one place.
    pub doubles: f64,
}

fn normal(x: f64, mean: f64, variance: f64) -> f64 {
    (-0.5 * (x - mean).powi(2) / variance).exp() / (TAU * variance).sqrt()
}

impl Spacing {
    /// What is believed of a spacing before any plant is found.
    pub fn new(spacing: f64) -> Spacing {
        Spacing { spacing, jitter: 0.2, missing: 0.1, doubles: 0.04 }
    }

    /// Whether no stand of a crop is like that: most often leaves were taken for plants.
    pub fn is_implausible(&self) -> bool {
        let (missing, doubles) = UNEVEN;
        self.missing >= missing && self.doubles >= doubles || self.doubles >= MAX_DOUBLES
    }

    /// Density of a gap, per pixel.
    pub fn density(&self, gap: f64) -> f64 {
        let singles: f64 = (1..=MAX_GAP_PLANTS).map(|k| self.skipping(gap, k)).sum();
        // Anything can happen, rarely.
        singles + self.double(gap) + 1e-5 / self.spacing
    }

    /// The part of the density with two plants in one place.
    pub(super) fn double(&self, gap: f64) -> f64 {
        let near = (0.24 * self.spacing).max(1.5);
        self.doubles * normal(gap, near, (0.07 * self.spacing).powi(2).max(0.3))
    }

    /// The part of the density with `k - 1` plants missing.
    fn skipping(&self, gap: f64, k: usize) -> f64 {
        let (steps, sd) = (k as f64, self.jitter * self.spacing);
        let weight = (1.0 - self.doubles) * (1.0 - self.missing) * self.missing.powi(k as i32 - 1);
        weight * normal(gap, steps * self.spacing, steps * sd * sd)
    }

    /// Probability of each number of plants missing in a gap: none, one, two, ...
    pub fn missing_in(&self, gap: f64) -> Vec<f64> {
        let parts: Vec<f64> = (1..=MAX_GAP_PLANTS).map(|k| self.skipping(gap, k)).collect();
        let total = self.density(gap);
        let mut shares: Vec<f64> = parts.iter().map(|part| part / total).collect();
        // Doubles and accidents have none missing.
        shares[0] += 1.0 - shares.iter().sum::<f64>();
        shares
    }

    /// The most probable number of plants missing in a gap, at least 1, and the probability that any is.
    pub fn missing_plants(&self, gap: f64) -> (usize, f64) {
        if gap > self.farthest() {
            return (((gap / self.spacing).round() as usize).saturating_sub(1).max(1), 1.0);
        }
        let shares = self.missing_in(gap);
        let likely = (1..shares.len()).fold(1, |a, b| if shares[b] > shares[a] { b } else { a });
        (likely, 1.0 - shares[0])
    }

    /// Farthest gap worth looking at.
    pub fn farthest(&self) -> f64 {
        (MAX_GAP_PLANTS as f64 - 0.5) * self.spacing
    }

    /// Re-estimates everything from gaps.
    pub fn refit(&self, gaps: &[f64]) -> Spacing {
        let (mut places, mut length, mut singles, mut doubles) = (0.0, 0.0, Vec::new(), 0.0);
        for &gap in gaps {
            if gap < 0.45 * self.spacing {
                doubles += 1.0;
                continue;
            }
            let steps = (gap / self.spacing).round().max(1.0);
            places += steps;
            length += gap;
            if steps == 1.0 {
                singles.push(gap);
            }
        }
        if places < 4.0 {
            return *self;
        }
        let (spacing, count) = (length / places, gaps.len() as f64);
        let scatter: f64 = singles.iter().map(|gap| (gap / spacing - 1.0).powi(2)).sum();
        let (jitter, weight) = JITTER;
        let jitter2 = (scatter + weight * jitter * jitter) / (singles.len() as f64 + weight);
        let skipped = places - (count - doubles);
        Spacing {
            spacing,
            jitter: jitter2.sqrt().clamp(0.04, 0.35),
            missing: ((skipped + 5.0) / (places + 60.0)).clamp(0.005, 0.5),
            doubles: ((doubles + 3.0) / (count + 100.0)).clamp(0.002, 0.2),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_density_integrates_to_one() {
        let spacing = Spacing { spacing: 13.0, jitter: 0.15, missing: 0.1, doubles: 0.03 };
        let sum: f64 = (0..20_000).map(|k| spacing.density(f64::from(k) * 0.01) * 0.01).sum();
        assert!((sum - 1.0).abs() < 2e-3, "{sum}");
        for gap in [2.0, 13.0, 26.0, 40.0] {
            let total: f64 = spacing.missing_in(gap).iter().sum();
            assert!((total - 1.0).abs() < 1e-12);
        }
        assert!(spacing.missing_in(26.0)[1] > 0.9 && spacing.missing_in(13.0)[0] > 0.99);
        // Longer than what the density describes: nothing there for 20 places.
        assert_eq!(spacing.missing_plants(260.0), (19, 1.0));
        assert_eq!(spacing.missing_plants(26.0).0, 1);
    }

    #[test]
    fn parameters_are_recovered_from_gaps() {
        // Ten singles for each skipped place and each double.
        let mut gaps = Vec::new();
        for k in 0..1000 {
            let error = 0.1 * f64::from(k % 21 - 10) / 6.06;
            gaps.push(match k % 12 {
                0 => 20.0 * (2.0 + 1.4 * error),
                1 => 3.0,
                _ => 20.0 * (1.0 + error),
            });
        }
        let mut fit = Spacing::new(17.0);
        for _ in 0..5 {
            fit = fit.refit(&gaps);
        }
        assert!((fit.spacing - 20.0).abs() < 0.3, "{fit:?}");
        assert!((fit.jitter - 0.1).abs() < 0.02, "{fit:?}");
        assert!((fit.missing - 1.0 / 12.0).abs() < 0.02, "{fit:?}");
        assert!((fit.doubles - 1.0 / 12.0).abs() < 0.02, "{fit:?}");
        assert_eq!(Spacing::new(9.0).refit(&[5.0]), Spacing::new(9.0));
    }
}
