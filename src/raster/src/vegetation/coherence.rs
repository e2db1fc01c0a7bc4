//! Neighbouring pixels made to agree: the mask of (locally) least energy for given posteriors.
//!
//! ```text
//! E(y) = sum_i -ln P(y_i) + lambda sum_(i,j) w_ij [y_i != y_j],   w_ij = exp(-(p_i - p_j)^2 / (2 s^2)),
//! ```
//!
//! over 4-neighbours, `s = 0.3`. Iterated conditional modes visit the pixels of a chessboard's colours in turn: those
//! of one colour do not see each other, so each half sweep decreases `E`, in any order and on any number of threads.
//!
//! Reference: J. Besag, "On the statistical analysis of dirty pictures", J. Royal Statistical Society B 48, 1986.

use super::VegetationError;
use crate::Mask;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// How pixels are made to agree with their neighbours.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Coherence {
    /// Not at all: vegetation is where its posterior exceeds one half.
    None,
    /// Iterated conditional modes.
    Icm {
        /// The price `lambda` of two neighbours that differ, 0..=100.
        weight: f64,
        /// Most sweeps.
        sweeps: usize,
    },
}

impl Default for Coherence {
    fn default() -> Coherence {
        Coherence::Icm { weight: 0.5, sweeps: 4 }
    }
}

/// Spread of the posterior between neighbours of one class.
const SPREAD: f32 = 0.3;

/// Prices: of calling a pixel background less that of vegetation by posterior, and of differing neighbours by the
/// difference of theirs.
struct Prices {
    unary: [f32; 256],
    pair: [f32; 256],
    /// Posteriors within these cannot be outvoted.
    sure: (u8, u8),
}

impl Prices {
    fn new(weight: f64) -> Prices {
        let weight = weight as f32;
        let unary = std::array::from_fn(|p| {
            let p = (p as f32).clamp(0.5, 254.5) / 255.0;
            (p / (1.0 - p)).ln()
        });
        let pair = std::array::from_fn(|d| {
            let d = d as f32 / 255.0 / SPREAD;
            weight * (-0.5 * d * d).exp()
        });
        let strong = |p: &usize| unary[*p] > 4.0 * weight;
        let high = (0..256).find(strong).map_or(255, |p| p as u8);
        Prices { unary, pair, sure: (255 - high, high) }
    }
}

impl Coherence {
    pub(super) fn check(&self) -> Result<(), VegetationError> {
        match *self {
            Coherence::Icm { weight, .. } if !(0.0..=100.0).contains(&weight) => {
                Err(VegetationError::Option {
                    name: "coherence weight",
                    value: weight,
                    expected: "a number from 0 to 100",
                })
            }
            _ => Ok(()),
        }
    }

    /// Rows and columns that a pixel can depend on, on either side.
    pub(super) fn reach(&self) -> usize {
        match self {
            Coherence::None => 0,
            // Each half sweep looks at the next pixel.
            Coherence::Icm { sweeps, .. } => 2 * sweeps,
        }
    }

    /// The mask for posteriors in 1/255, row by row.
    pub fn mask(&self, width: usize, height: usize, posterior: &[u8]) -> Mask {
        debug_assert_eq!(posterior.len(), width * height);
        Mask { width, height, data: self.mask_of_rows(width, 0, posterior) }
    }

    /// [`Coherence::mask`] of some rows, the first of which is row `first` of the picture.
    pub(super) fn mask_of_rows(&self, width: usize, first: usize, posterior: &[u8]) -> Vec<u8> {
        let likelier = posterior.par_iter().with_min_len(1 << 16).map(|&p| u8::from(p > 127));
        let mut mask: Vec<u8> = likelier.collect();
        if let Coherence::Icm { weight, sweeps } = *self {
            let prices = Prices::new(weight);
            for _ in 0..sweeps {
                let mut half = |colour| half_sweep(&mut mask, width, posterior, &prices, colour);
                if half(first % 2) + half(1 - first % 2) == 0 {
                    break;
                }
            }
        }
        mask
    }

    /// The energy `E` of a mask, in nats.
    #[cfg(test)]
    fn energy(&self, mask: &Mask, posterior: &[u8]) -> f64 {
        let weight = if let Coherence::Icm { weight, .. } = *self { weight } else { 0.0 };
        let prices = Prices::new(weight);
        let (width, y) = (mask.width, &mask.data);
        let mut energy = 0.0;
        for (i, (&label, &p)) in y.iter().zip(posterior).enumerate() {
            let p = f64::from(p).clamp(0.5, 254.5) / 255.0;
            energy -= if label != 0 { p.ln() } else { (1.0 - p).ln() };
            let right = Some(i + 1).filter(|next| next % width != 0);
            let below = Some(i + width).filter(|&next| next < y.len());
            for next in right.into_iter().chain(below).filter(|&next| y[next] != label) {
                energy +=
                    f64::from(prices.pair[usize::from(posterior[i].abs_diff(posterior[next]))]);
            }
        }
        energy
    }
}

/// Decides the pixels of one colour of the chessboard again; the number of those that changed.
fn half_sweep(
    mask: &mut [u8],
    width: usize,
    posterior: &[u8],
    prices: &Prices,
    colour: usize,
) -> usize {
    if width == 0 {
        return 0;
    }
    let height = mask.len() / width;
    let before = &*mask;
    // Only pixels of the other colour are read, and those do not change: flips can be collected row by row.
    let flips: Vec<Vec<usize>> = (0..height)
        .into_par_iter()
        .with_min_len(16)
        .map(|v| {
            let mut flips = Vec::new();
            let first = v * width;
            for u in ((v + colour) % 2..width).step_by(2) {
                let i = first + u;
                let p = posterior[i];
                if p < prices.sure.0 || p > prices.sure.1 {
                    continue;
                }
                let mut gain = prices.unary[usize::from(p)];
                let mut vote = |next: usize| {
                    let price = prices.pair[usize::from(p.abs_diff(posterior[next]))];
                    gain += if before[next] != 0 { price } else { -price };
                };
                if u > 0 {
                    vote(i - 1);
                }
                if u + 1 < width {
                    vote(i + 1);
                }
                if v > 0 {
                    vote(i - width);
                }
                if v + 1 < height {
                    vote(i + width);
                }
                if gain != 0.0 && (gain > 0.0) != (before[i] != 0) {
                    flips.push(i);
                }
            }
            flips
        })
        .collect();
    let mut count = 0;
    for i in flips.into_iter().flatten() {
        mask[i] ^= 1;
        count += 1;
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn every_sweep_decreases_the_energy() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let (width, height) = (61, 47);
        let posterior: Vec<u8> = (0..width * height).map(|_| rng.random_range(40..215)).collect();
        let mut energies = Vec::new();
        for sweeps in 0..6 {
            let coherence = Coherence::Icm { weight: 0.5, sweeps };
            let mask = coherence.mask(width, height, &posterior);
            energies.push(coherence.energy(&mask, &posterior));
        }
        assert!(energies.windows(2).all(|e| e[1] <= e[0] + 1e-3), "{energies:?}");
        assert!(energies[1] < energies[0] - 10.0, "{energies:?}");
    }

    #[test]
    fn weak_specks_go_and_strong_ones_stay() {
        let (width, height) = (9, 9);
        let mut posterior = vec![90; width * height];
        posterior[4 * width + 4] = 140;
        posterior[width + 1] = 255;
        let mask = Coherence::default().mask(width, height, &posterior);
        assert!(!mask.get(4, 4) && mask.get(1, 1));
        let raw = Coherence::None.mask(width, height, &posterior);
        assert!(raw.get(4, 4) && raw.get(1, 1));
    }
}
