//! The plants of rows along which leaves have closed: how many, where, and how sure, by a conditional random field over their places.
//!
//! Sets of plants `x_1 < x_2 < ...` on a row have probabilities proportional to
//!
//! `exp( sum_i a^T f(x_i) + sum_i b^T g(x_i, x_{i+1}) + ends )`,
//!
//! `f` what the votes show at a place (height, local contrast, peakedness, leaf mass, and how these depend
//! on the field's own contrast, cover and spacing), `g` what they show between neighbours (log density of
//! the gap, votes that both claim, how deep the votes fall between them, leaf mass that neither covers).
//! The weights maximise the likelihood of the true plants of synthetic fields given what their masks show, and change with the width of leaves, which
//! are wider on maps made of photos than on masks that are drawn ([`LeafWeights`]).
//! At that maximum the expected features are the true ones, the number of plants
//! among them, which no other score of places promises.
//!
//! All probabilities are sums over neighbours, so they are found exactly ([`row_posteriors`]). The best set of plants is a poor count:
//! where evidence is weak, a plant's probability is spread over many places and the best set leaves it out. Plants are therefore as many as are expected,
//! and stand where most of their probability is together ([`likeliest_places`]).
//!
//! The spacing enters both and is found before, with weights by hand ([`Weights::by_hand`]): the one whose sum over all sets of plants is greatest
//! ([`Lattice::log_sum`]), then alternating between the best set ([`Lattice::best`]) and the gaps between its plants. Lengths in pixels of the reduced grid; the weights are those of `weights.csv`, which `experiments
//! fit-stand-count` makes.
//!
//! Reference: J. Lafferty, A. McCallum and F. Pereira, "Conditional random fields: probabilistic models
//! for segmenting and labeling sequence data", ICML 2001.

mod features;
mod lattice;
mod places;
mod weights;

use super::{plant_spacing::Spacing, row_profile::Profile};
pub use features::RowFeatures;
pub use lattice::Lattice;
pub use places::likeliest_places;
use rayon::prelude::*;
use rowgram_optim::engine::SolveError;
use weights::fitted;
pub use weights::{LeafWeights, PAIR_FEATURES, PLACE_FEATURES, Weights};

/// Number of features of a place.
pub const PLACE: usize = 27;
/// Number of features of two neighbours.
pub const PAIR: usize = 11;

/// What the whole field shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Overall {
    /// Mean votes of a place.
    pub mean: f64,
    /// Mean leaf mass of a place.
    pub mass: f64,
    /// Standard deviation of the square root of the votes over their mean.
    pub contrast: f64,
    /// Width of leaves, pixels of the reduced grid.
    pub leaf_width: f64,
    /// Share of leaf in the bands along the rows.
    pub cover: f64,
    /// Share of all leaf that is outside these bands.
    pub outside: f64,
}

/// What is probable in a row.
#[derive(Debug, Clone, PartialEq)]
pub struct RowPosterior {
    /// Expected number of plants at each place.
    pub marginals: Vec<f64>,
    /// Expected number of plants if a plant is worth what the weights say.
    pub count: f64,
    /// Variance of that.
    pub count_variance: f64,
}

/// The probabilities of the plants of each row, where one more is worth `plant_log_odds` more than the weights say.
///
/// # Errors
/// [`SolveError::Misuse`] where the file of weights is damaged.
pub fn row_posteriors(
    profiles: &[&Profile],
    overall: &Overall,
    spacing: &Spacing,
    plant_log_odds: f64,
) -> Result<Vec<RowPosterior>, SolveError> {
    let weights = fitted().map_err(SolveError::Misuse)?.at(overall.leaf_width);
    let of_row = |profile: &&Profile| {
        let lattice = Lattice::new(&RowFeatures::new(profile, overall, spacing), &weights);
        let marginals = lattice.marginals(plant_log_odds);
        let (count, count_variance) = lattice.count(0.0);
        RowPosterior { marginals, count, count_variance }
    };
    Ok(profiles.par_iter().map(of_row).collect())
}

/// By how much more than the weights say a plant has to be worth for `count` of them to be expected; the greatest that is looked at where that
/// is not enough.
///
/// # Errors
/// [`SolveError::Misuse`] where the file of weights is damaged.
pub fn log_odds_of(
    count: usize,
    profiles: &[&Profile],
    overall: &Overall,
    spacing: &Spacing,
) -> Result<f64, SolveError> {
    /// At such odds, e^20, plants stand as densely as the score allows, or none does.
    const MAX_LOG_ODDS: f64 = 20.0;
    /// Halvings of the range, to 0.04: the number of plants is met exactly afterwards, by taking the likeliest places.
    const HALVINGS: usize = 10;
    let weights = fitted().map_err(SolveError::Misuse)?.at(overall.leaf_width);
    let scores =
        |profile: &&Profile| Lattice::new(&RowFeatures::new(profile, overall, spacing), &weights);
    let lattices: Vec<Lattice> = profiles.par_iter().map(scores).collect();
    let expected = |odds: f64| -> f64 {
        let counts: Vec<f64> = lattices.par_iter().map(|lattice| lattice.count(odds).0).collect();
        counts.iter().sum()
    };
    let (mut low, mut high) = (-MAX_LOG_ODDS, MAX_LOG_ODDS);
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if expected(middle) > count as f64 { high = middle } else { low = middle }
    }
    Ok(0.5 * (low + high))
}
