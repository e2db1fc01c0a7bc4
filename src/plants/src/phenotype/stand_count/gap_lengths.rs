//! How long the gaps between the plants of a row are: [`plant_spacing`](super::super::plant_spacing)'s density with the doubles of
//! the [stand count](super), re-estimated from expected numbers of gaps instead of gaps.

use super::STEP;
use std::f64::consts::TAU;

/// Gap plants in a row that are thought possible.
pub(super) const MOST: usize = 6;

/// What is expected of the gaps before any is seen, and how many gaps that weighs.
const JITTER: (f64, f64) = (0.15, 40.0);
const MISSING: (f64, f64) = (0.05, 100.0);
const DOUBLES: (f64, f64) = (0.03, 2000.0);

/// Spacing, relative jitter, share of places without a plant, share of gaps between two in one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaps {
    /// Distance of neighbouring plants, in pixels of the reduced grid.
    pub spacing: f64,
    /// Standard deviation of that distance over it.
    pub jitter: f64,
    /// Share of places without a plant.
    pub missing: f64,
    /// Share of gaps between two plants in one place.
    pub doubles: f64,
}

fn normal(x: f64, mean: f64, variance: f64) -> f64 {
    (-0.5 * (x - mean).powi(2) / variance).exp() / (TAU * variance).sqrt()
}

impl Gaps {
    /// What is expected around a spacing.
    pub fn new(spacing: f64) -> Gaps {
        Gaps { spacing, jitter: JITTER.0 + 0.01, missing: MISSING.0, doubles: DOUBLES.0 }
    }

    /// The density of a gap with `k - 1` plants missing.
    fn skipping(&self, gap: f64, k: usize) -> f64 {
        let (steps, sd) = (k as f64, self.jitter * self.spacing);
        let weight = (1.0 - self.doubles) * (1.0 - self.missing) * self.missing.powi(k as i32 - 1);
        weight * normal(gap, steps * self.spacing, steps * sd * sd)
    }

    /// The density of a gap between two plants in one place.
    pub(super) fn double(&self, gap: f64) -> f64 {
        let near = (0.24 * self.spacing).max(1.5);
        self.doubles * normal(gap, near, (0.07 * self.spacing).powi(2).max(0.3))
    }

    pub(super) fn density(&self, gap: f64) -> f64 {
        let singles: f64 = (1..=MOST).map(|k| self.skipping(gap, k)).sum();
        // Anything can happen, rarely.
        singles + self.double(gap) + 1e-5 / self.spacing
    }

    /// Re-estimates everything from how many gaps of each length (in steps) are expected in each row.
    pub fn refit(&self, rows: &[Vec<f64>]) -> Gaps {
        let mut expected = vec![0.0; rows.iter().map(Vec::len).max().unwrap_or(0)];
        for row in rows {
            expected.iter_mut().zip(row).for_each(|(sum, number)| *sum += number);
        }
        let (mut length, mut places, mut kinds) = (0.0, 0.0, 0.0);
        let (mut doubles, mut all) = (0.0, 0.0);
        let mut shares = Vec::new();
        for (steps, &number) in expected.iter().enumerate().filter(|(_, number)| **number > 1e-9) {
            let gap = steps as f64 * STEP;
            let density = self.density(gap);
            all += number;
            doubles += number * self.double(gap) / density;
            for k in 1..=MOST {
                let share = number * self.skipping(gap, k) / density;
                length += share * gap;
                places += share * k as f64;
                kinds += share;
                shares.push((gap, k as f64, share));
            }
        }
        if places < 4.0 {
            return *self;
        }
        let spacing = length / places;
        let scatter: f64 =
            shares.iter().map(|(gap, k, share)| share * (gap / spacing - k).powi(2) / k).sum();
        let pooled = |sum: f64, count: f64, (mean, weight): (f64, f64)| {
            (sum + mean * weight) / (count + weight)
        };
        let jitter2 = pooled(scatter, kinds, (JITTER.0 * JITTER.0, JITTER.1));
        Gaps {
            spacing,
            jitter: jitter2.sqrt().clamp(0.04, 0.4),
            missing: pooled(places - kinds, places, MISSING).clamp(0.003, 0.6),
            doubles: pooled(doubles, all, DOUBLES).clamp(0.002, 0.2),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_re_estimated_from_expected_ones() {
        // Ten singles for each skipped place.
        let mut expected = vec![0.0; 200];
        for (steps, number) in [(36, 250.0), (40, 500.0), (44, 250.0), (80, 100.0)] {
            expected[steps] = number;
        }
        let mut gaps = Gaps { spacing: 18.5, jitter: 0.16, missing: 0.05, doubles: 0.03 };
        for _ in 0..5 {
            gaps = gaps.refit(&[expected.clone()]);
        }
        assert!((gaps.spacing - 20.0).abs() < 0.1, "{gaps:?}");
        assert!((gaps.missing - 0.08).abs() < 0.02, "{gaps:?}");
        assert!((gaps.jitter - 0.07).abs() < 0.02, "{gaps:?}");
        let few = Gaps::new(3.0);
        assert_eq!(few.refit(&[vec![0.0; 9]]), few);
    }
}
