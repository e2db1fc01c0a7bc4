//! Moves that no single step of the descent can make: one plant too many here, one too few there.
//!
//! A descent from a poor start ends with two plants sharing the leaves of one and one plant holding
//! those of two. A *swap* undoes that: the plant whose pixels lose least by going to their second
//! nearest plants is taken away (it merges with its neighbours), and put to the plant whose pixels cost
//! most (which splits). Only the plants around both places are then moved, by the same exact updates
//! as in a sweep, and the swap stays where the objective has become smaller. So moves keep
//! the objective's decrease, and the number of plants.
//!
//! Reference: P. Franti, "Efficiency of random swap clustering", Journal of Big Data 5 (2018).

use super::{Field, PlantPrior, PlantUpdate, Plants, assignment::NONE};
use rowgram_optim::{
    descent::{ActiveSet, BlockCost},
    engine::SolveError,
};

/// Visits of plants after one swap, per plant that the swap touches at first.
const VISITS: usize = 12;
/// Swaps that are tried for one that is made.
const TRIES: usize = 6;

/// What the pixels of every plant cost, and what they would cost without it.
#[derive(Debug, Clone, PartialEq)]
pub struct Worth {
    /// Sum of the (truncated) distances, or of half their squares for the mean update; per plant.
    pub cost: Vec<f64>,
    /// By how much that sum grows where the plant is taken away.
    pub loss: Vec<f64>,
    /// Mean and second moments (uu, uv, vv) of the offsets of each plant's pixels, in pixels.
    pub moments: Vec<[f64; 6]>,
}

impl<P: PlantPrior> Plants<P> {
    /// What every plant is worth to the pixels, by the assignment of `x`.
    pub fn worth(&self, x: &Field<P::Latent>) -> Worth {
        let count = x.positions_px.len();
        let farthest = self.model.truncate_px.unwrap_or(f64::INFINITY);
        let price = |d2: f32| {
            let d2 = f64::from(d2).min(farthest * farthest);
            match self.model.update {
                PlantUpdate::Median => d2.sqrt(),
                PlantUpdate::Mean => 0.5 * d2,
            }
        };
        let mut worth = Worth {
            cost: vec![0.0; count],
            loss: vec![0.0; count],
            moments: vec![[0.0; 6]; count],
        };
        for (pixel, pair) in self.pairs(x).iter().enumerate() {
            let plant = pair.near as usize;
            worth.cost[plant] += price(pair.near2);
            let without = if pair.second == NONE { f32::INFINITY } else { pair.second2 };
            worth.loss[plant] += price(without) - price(pair.near2);
            let (at, [u, v]) = (x.positions_px[plant], self.index.position(pixel));
            let (du, dv) = (u - at[0], v - at[1]);
            // Also of pixels beyond the truncation: those are what a plant is missing for.
            let sums = &mut worth.moments[plant];
            for (sum, part) in sums.iter_mut().zip([1.0, du, dv, du * du, du * dv, dv * dv]) {
                *sum += part;
            }
        }
        worth
    }

    /// Tries swaps until none of a few makes the objective smaller, at most `most`; gives how many
    /// were made.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] for a model without a joint objective, in which nothing says whether a
    /// swap is better.
    pub fn swap(&self, x: &mut Field<P::Latent>, most: usize) -> Result<usize, SolveError> {
        if !self.monotone() {
            let message = "swaps need a joint objective; the conditional form has none".to_owned();
            return Err(SolveError::Misuse(message));
        }
        let mut made = 0;
        while made < most && self.swap_once(x) {
            made += 1;
        }
        Ok(made)
    }

    fn swap_once(&self, x: &mut Field<P::Latent>) -> bool {
        if self.plants < 2 {
            return false;
        }
        let worth = self.worth(x);
        let order = |values: &[f64], sign: f64| {
            let mut order: Vec<usize> = (0..values.len()).collect();
            order.sort_by(|&a, &b| {
                (sign * values[a]).total_cmp(&(sign * values[b])).then(a.cmp(&b))
            });
            order
        };
        let (missed_least, crowded) = (order(&worth.loss, 1.0), order(&worth.cost, -1.0));
        let before = self.cost(x);
        let rounding = 1e-9 * before.abs();
        let pairs = (0..TRIES).flat_map(|sum| (0..=sum).map(move |k| (k, sum - k)));
        for (from, to) in pairs.take(TRIES) {
            let (Some(&plant), Some(&split)) = (missed_least.get(from), crowded.get(to)) else {
                continue;
            };
            if plant == split {
                continue;
            }
            let mut trial = x.clone();
            self.make(&mut trial, plant, split, &worth.moments[split]);
            if self.cost(&trial) < before - rounding {
                *x = trial;
                return true;
            }
        }
        false
    }

    /// Puts `plant` beside `split`, 0.8 standard deviations to each side of their middle along the longer axis of its pixels, and lets those
    /// around both places settle.
    fn make(&self, x: &mut Field<P::Latent>, plant: usize, split: usize, moments: &[f64; 6]) {
        let [count, u, v, uu, uv, vv] = *moments;
        let count = count.max(1.0);
        let (u, v) = (u / count, v / count);
        let (uu, uv, vv) = (uu / count - u * u, uv / count - u * v, vv / count - v * v);
        let angle = 0.5 * (2.0 * uv).atan2(uu - vv);
        let (sin, cos) = angle.sin_cos();
        let spread = (cos * cos * uu + 2.0 * sin * cos * uv + sin * sin * vv).max(0.0).sqrt();
        let mut active = ActiveSet::new(self.plants, false);
        let middle = x.positions_px[split];
        for (which, side) in [(plant, 0.8 * spread), (split, -0.8 * spread)] {
            let old = x.positions_px[which];
            x.positions_px[which] = [middle[0] + u + side * cos, middle[1] + v + side * sin];
            active.mark(which);
            let Field { positions_px, work, .. } = x;
            work.assignment.follow(&self.index, positions_px, which as u32, old, |p| {
                active.mark(p as usize);
            });
        }
        self.prior.reassign(&mut x.latent, &x.positions_px);
        let mut visits = VISITS * active.count();
        while active.count() > 0 && visits > 0 {
            for block in 0..self.plants {
                if active.take(block) && visits > 0 {
                    visits -= 1;
                    self.update(x, block, &mut active);
                }
            }
        }
        self.end_sweep(x, &mut active);
    }
}
