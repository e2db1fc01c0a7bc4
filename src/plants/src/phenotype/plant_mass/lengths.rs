//! How long components of one and more plants are along their row.

use super::model::{MOST, Measured, log_prior_of_spread};
use serde::{Deserialize, Serialize};

/// How much longer a heavier component of as many plants is: both in logarithms. Leaves as long as broad have 0.5; singles of the three sets 0.53
/// to 0.60.
pub(super) const LONGER: f64 = 0.55;
/// Length `c` of one plant before the photo is seen and what that is worth in plants; the spread of lengths and what that is worth; the
/// distance `d` of two that touch and what that is worth in pairs. On the three sets `c` is 0.28 to 0.36, `d` 1.1 to 1.35.
const LENGTH: [(f64, f64); 3] = [(0.32, 1.0), (0.3, 8.0), (1.2, 10.0)];
/// Spread of the lengths of specks. With 0.5 numbers of the three sets change by 0.1 % at most.
const SPECK_LENGTH: f64 = 0.35;
/// The least density of a length: some are like nothing. A guess, not searched for.
const ODD_LENGTH: f64 = 1e-4;

/// Lengths of components of one and more plants, in square roots of the mass of a plant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LengthModel {
    /// Standard deviation of the pixels of one plant along the row.
    pub single: f64,
    /// Standard deviation of the logarithms of lengths.
    pub spread: f64,
    /// Distance of two plants that touch.
    pub apart: f64,
}

impl LengthModel {
    /// What is known before the photo is seen.
    pub(super) const BEFORE: LengthModel =
        LengthModel { single: LENGTH[0].0, spread: LENGTH[1].0, apart: LENGTH[2].0 };

    /// One step of EM, given the mass of a plant and the probabilities of numbers of plants.
    pub(super) fn updated(
        &self,
        plant: f64,
        measured: &[Measured],
        posteriors: &[[f64; MOST + 1]],
    ) -> LengthModel {
        let [(single, single_worth), (spread, spread_worth), (apart, apart_worth)] = LENGTH;
        // The length that it would have with the usual mass of its plants.
        let usual_length = |of: &Measured, k: f64| {
            of.relative(plant).map(|(length, heavier)| length - LONGER * (heavier - k.ln()))
        };
        let (mut singles, mut sum) = (0.0, 0.0);
        for (c, p) in measured.iter().zip(posteriors) {
            singles += p[1];
            sum += p[1] * usual_length(c, 1.0).unwrap_or(self.single.ln());
        }
        let middle = (sum + single_worth * single.ln()) / (singles + single_worth);
        let alone = LengthModel { single: middle.exp(), spread, apart };
        let (mut squares, mut longer, mut pairs) = (0.0, 0.0, 0.0);
        for (c, p) in measured.iter().zip(posteriors) {
            squares += p[1] * (usual_length(c, 1.0).unwrap_or(middle) - middle).powi(2);
            longer += p[2] * usual_length(c, 2.0).unwrap_or(alone.of(2.0));
            pairs += p[2];
        }
        let variance = (squares + spread_worth * spread * spread) / (singles + spread_worth);
        let pair = (longer + apart_worth * alone.of(2.0)) / (pairs + apart_worth);
        let apart = 2.0 * ((2.0 * pair).exp() - alone.single.powi(2)).max(0.025).sqrt();
        LengthModel { apart, spread: variance.sqrt().clamp(0.08, 0.4), ..alone }
    }

    /// Logarithm of the length of `k` plants of the usual mass.
    fn of(&self, k: f64) -> f64 {
        0.5 * (self.single.powi(2) + self.apart.powi(2) * (k * k - 1.0) / 12.0).ln()
    }

    /// The density of a length where a component holds 0 (a speck), 1, .., [`MOST`] plants; `heavier` is the logarithm of its mass in plants.
    pub(super) fn densities(&self, length: f64, heavier: f64) -> [f64; MOST + 1] {
        let normal = |k: f64, sigma: f64| {
            let mean = self.of(k) + LONGER * (heavier - k.ln());
            ((-0.5 * ((length - mean) / sigma).powi(2)).exp() / sigma).max(ODD_LENGTH)
        };
        let mut p = [normal(1.0, SPECK_LENGTH); MOST + 1];
        for (k, p) in p.iter_mut().enumerate().skip(1) {
            *p = normal(k as f64, self.spread);
        }
        p
    }

    /// Logarithm of its density before the photo is seen, up to a constant.
    pub(super) fn log_prior(&self) -> f64 {
        let [(single, single_worth), (sigma, worth), (apart, apart_worth)] = LENGTH;
        let away = |of: f64, usual: f64| -0.5 * ((of / usual).ln() / sigma).powi(2);
        worth * log_prior_of_spread(self.spread, sigma)
            + single_worth * away(self.single, single)
            + apart_worth * away(self.apart, apart)
    }
}
