//! How leaf is spread about a plant: what a leaf density is, and the built-in ones.

use super::{
    assignment::{Assignment, Sums},
    index::PixelIndex,
    inner,
    options::PlantUpdate,
    quadratic::Quadratic,
};
use std::fmt::Debug;

/// Steps shorter than this end the search for a place, pixels, or, as a share of it, for the square of a scale. Not searched for.
const SHORT: f64 = 1e-6;
/// Most steps of such a search. Each lowers the cost, so that an early end does no harm.
const STEPS: usize = 100;

/// The density of leaf pixels about their plant, as minus its logarithm but for a constant: a cost that grows with the distance `d` of the
/// pixel from the plant, in units of the scale `sigma` that all plants share.
///
/// The set is open: a density of your own is one more type with the two functions below ([`Plants::with_density`](super::Plants::with_density)).
/// The provided methods lower the objective in every step for any density whose cost is concave in the squared distance: heavy tails are,
/// and so are the Gaussian and the exponential density. The built-in ones ([`PlantUpdate`]) replace them by exact minimisers.
pub trait LeafDensity: Clone + Debug + Send + Sync {
    /// The cost of a pixel at a squared distance, as `ratio2 = d^2 / sigma^2`: 0 at 0, increasing and concave.
    fn cost(&self, ratio2: f64) -> f64;

    /// The derivative of [`LeafDensity::cost`]; finite, unless [`LeafDensity::place`] is replaced.
    fn slope(&self, ratio2: f64) -> f64;

    /// How the pull of pixels that are held depends on the scale. `share` is how much of a pixel counts.
    fn weight(&self, sigma_px: f64, share: f64) -> f64 {
        share / (sigma_px * sigma_px)
    }

    /// The cost of all pixels, each at its nearest plant.
    fn total(&self, distances: &Distances<'_>, sigma_px: f64, share: f64) -> f64 {
        share * distances.sum(|d2| self.cost(d2 / (sigma_px * sigma_px)))
    }

    /// The scale that minimises `dimension * N ln sigma` + [`LeafDensity::total`] for these distances, from the present one.
    fn scale_px(&self, distances: &Distances<'_>, dimension: f64, sigma_px: f64) -> f64 {
        let mut sigma2 = sigma_px * sigma_px;
        for _ in 0..STEPS {
            let pull = distances.sum(|d2| 2.0 * d2 * self.slope(d2 / sigma2));
            let next = pull / (dimension * distances.len() as f64);
            let step = (next - sigma2).abs();
            sigma2 = next;
            if step <= SHORT * sigma2 || sigma2 <= 0.0 {
                break;
            }
        }
        sigma2.sqrt()
    }

    /// A better place for a plant whose pixels are held, as its offset from where it is: the minimum, or lower than where it was.
    fn place(&self, held: &Held<'_>) -> [f64; 2] {
        let mut at = [0.0; 2];
        for _ in 0..STEPS {
            let next = self.weighted_mean(held, at);
            let step = (next[0] - at[0]).hypot(next[1] - at[1]);
            at = next;
            if step <= SHORT {
                break;
            }
        }
        at
    }

    /// The cost of the held pixels and the prior for a plant at an offset, but for a constant.
    fn cost_at(&self, held: &Held<'_>, offset_px: [f64; 2]) -> f64 {
        let of = |ratio2| self.cost(ratio2);
        held.share * held.ratios2(offset_px).map(of).sum::<f64>() + held.prior.value(offset_px)
    }

    /// The minimum of the squared distances that lie above the cost and touch it where the plant is at `offset_px`.
    fn weighted_mean(&self, held: &Held<'_>, offset_px: [f64; 2]) -> [f64; 2] {
        let per_slope = 2.0 * held.share / (held.sigma_px * held.sigma_px);
        let mut above = held.prior;
        for (ratio2, (u, v)) in held.ratios2(offset_px).zip(held.u_px.iter().zip(held.v_px)) {
            let stiffness = per_slope * self.slope(ratio2);
            above.hessian[0] += stiffness;
            above.hessian[2] += stiffness;
            above.pull[0] += stiffness * u;
            above.pull[1] += stiffness * v;
        }
        above.minimiser()
    }
}

/// The distances of all pixels from their nearest plants, cut off where the model truncates them.
#[derive(Debug, Clone, Copy)]
pub struct Distances<'a> {
    pub(super) assignment: &'a Assignment,
    pub(super) index: &'a PixelIndex,
    pub(super) positions_px: &'a [[f64; 2]],
}

impl Distances<'_> {
    /// The number of pixels.
    #[allow(clippy::len_without_is_empty, reason = "a mask without a pixel poses no problem")]
    pub fn len(&self) -> usize {
        self.index.len()
    }

    /// The sum of a function of the squared distances in square pixels, in a fixed order.
    pub fn sum(&self, of: impl Fn(f64) -> f64) -> f64 {
        self.assignment.sum(self.index, self.positions_px, of)
    }

    /// The sums of the distances and of their squares, which are kept up to date.
    pub fn sums(&self) -> Sums {
        self.assignment.sums(self.index, self.positions_px)
    }
}

/// A plant and the pixels that are held for it.
#[derive(Debug, Clone, Copy)]
pub struct Held<'a> {
    /// Offsets of the pixels from where the plant is, in pixels.
    pub u_px: &'a [f64],
    /// The same down the image.
    pub v_px: &'a [f64],
    /// The scale of the distances.
    pub sigma_px: f64,
    /// How much of a pixel counts.
    pub share: f64,
    /// The prior of the plant, a function of the offset.
    pub prior: Quadratic,
}

impl Held<'_> {
    /// The squared distances of the pixels from an offset, in units of the squared scale.
    pub fn ratios2(&self, [u, v]: [f64; 2]) -> impl Iterator<Item = f64> {
        let sigma2 = self.sigma_px * self.sigma_px;
        let of = move |(zu, zv): (&f64, &f64)| ((zu - u).powi(2) + (zv - v).powi(2)) / sigma2;
        self.u_px.iter().zip(self.v_px).map(of)
    }
}

/// `d^2 / (2 sigma^2)` for the mean, `d / sigma` for the median, both with their exact minimisers.
impl LeafDensity for PlantUpdate {
    fn cost(&self, ratio2: f64) -> f64 {
        match self {
            PlantUpdate::Mean => 0.5 * ratio2,
            PlantUpdate::Median => ratio2.sqrt(),
        }
    }

    fn slope(&self, ratio2: f64) -> f64 {
        match self {
            PlantUpdate::Mean => 0.5,
            PlantUpdate::Median => 0.5 / ratio2.sqrt(),
        }
    }

    fn weight(&self, sigma_px: f64, share: f64) -> f64 {
        match self {
            PlantUpdate::Mean => share * (1.0 / (sigma_px * sigma_px)),
            PlantUpdate::Median => share * (1.0 / sigma_px),
        }
    }

    fn total(&self, distances: &Distances<'_>, sigma_px: f64, share: f64) -> f64 {
        let sums = distances.sums();
        self.weight(sigma_px, share)
            * match self {
                PlantUpdate::Mean => sums.square / 2.0,
                PlantUpdate::Median => sums.distance,
            }
    }

    fn scale_px(&self, distances: &Distances<'_>, dimension: f64, _sigma_px: f64) -> f64 {
        let (sums, count) = (distances.sums(), distances.len() as f64);
        match self {
            PlantUpdate::Mean => (sums.square / (dimension * count)).sqrt(),
            PlantUpdate::Median => sums.distance / (dimension * count),
        }
    }

    fn place(&self, held: &Held<'_>) -> [f64; 2] {
        let minimum = match self {
            PlantUpdate::Mean => inner::mean,
            PlantUpdate::Median => inner::median,
        };
        minimum(held.u_px, held.v_px, self.weight(held.sigma_px, held.share), &held.prior)
    }

    fn cost_at(&self, held: &Held<'_>, offset_px: [f64; 2]) -> f64 {
        let cost = match self {
            PlantUpdate::Mean => inner::mean_cost,
            PlantUpdate::Median => inner::median_cost,
        };
        let weight = self.weight(held.sigma_px, held.share);
        cost(held.u_px, held.v_px, weight, &held.prior, offset_px)
    }
}
