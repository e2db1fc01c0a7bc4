//! The plants of rows along which leaves have closed: how many, where, and how sure, by a conditional random field over their places.
//!
//! Sets of plants `x_1 < x_2 < ...` on a row have probabilities proportional to
//!
//! `exp( sum_i a^T f(x_i) + sum_i b^T g(x_i, x_{i+1}) + ends )`,
//!
//! `f` what the votes show at a place (height, local contrast, peakedness, leaf mass, and how these depend
//! on the field's own contrast, cover and spacing), `g` what they show between neighbours (log density of
//! the gap, votes that both claim, how deep the votes fall between them, leaf mass that neither covers).
//! The weights maximise the likelihood of the true plants of synthetic fields given what their masks show.
//! At that maximum the expected features are the true ones, the number of plants
//! among them, which no other score of places promises.
//!
//! All probabilities are sums over neighbours, so they are found exactly ([`row_posteriors`]). The best set of plants is a poor count:
//! where evidence is weak, a plant's probability is spread over many places and the best set leaves it out. Plants are therefore as many as are expected,
//! and stand where most of their probability is together ([`likeliest_places`]).
//!
//! The spacing enters both and is found before. Lengths in pixels of the reduced grid; the weights are those of `weights.csv`, which `experiments
//! fit-stand-count` makes.
//!
//! Reference: J. Lafferty, A. McCallum and F. Pereira, "Conditional random fields: probabilistic models
//! for segmenting and labeling sequence data", ICML 2001.

mod features;
mod places;
mod weights;

use super::{log_sum::log_sum_exp, plant_spacing::Spacing, row_profile::Profile};
pub use features::RowFeatures;
use features::UNCOVERED;
pub use places::likeliest_places;
use rayon::prelude::*;
use rowgram_optim::engine::SolveError;
use weights::fitted;
pub use weights::{PAIR_FEATURES, PLACE_FEATURES, Weights};

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

/// The scores of one row: of every place, of it as the first and as the last plant, and of pairs.
pub struct Lattice {
    own: Vec<f64>,
    first: Vec<f64>,
    last: Vec<f64>,
    /// Of a plant at a place and the one before it, by the gap between them in steps.
    pairs: Vec<Vec<f64>>,
}

/// Logarithms of the sums over everything before and after each place, and over everything.
struct Sums {
    ahead: Vec<f64>,
    behind: Vec<f64>,
    all: f64,
}

fn dot(features: &[f64], weights: &[f64]) -> f64 {
    features.iter().zip(weights).map(|(f, w)| f * w).sum()
}

impl Lattice {
    /// The scores of features under some weights.
    pub fn new(row: &RowFeatures<'_>, weights: &Weights) -> Lattice {
        let own: Vec<f64> = row.places.iter().map(|place| dot(place, &weights.places)).collect();
        let pairs = (0..own.len())
            .map(|at| {
                let mut scores = vec![0.0; row.gap_limit().min(at + 1)];
                for (gap, features) in row.before(at) {
                    scores[gap] = dot(&features, &weights.pairs);
                }
                scores
            })
            .collect();
        let end = |at, first| {
            let [cost, open] = row.end(at, first);
            weights.pairs[UNCOVERED] * open - cost
        };
        let (first, last) = (0..own.len()).map(|at| (end(at, true), end(at, false))).unzip();
        Lattice { own, first, last, pairs }
    }

    fn sums(&self, plant_log_odds: f64) -> Sums {
        let count = self.own.len();
        let (mut ahead, mut behind, mut terms) = (vec![0.0; count], vec![0.0; count], Vec::new());
        for at in 0..count {
            terms.clear();
            terms.push(self.first[at]);
            let links = self.pairs[at].iter().enumerate().skip(2);
            terms.extend(links.map(|(gap, score)| ahead[at - gap] + score));
            ahead[at] = log_sum_exp(&mut terms) + self.own[at] + plant_log_odds;
        }
        let longest = self.pairs.iter().map(Vec::len).max().unwrap_or(0);
        for at in (0..count).rev() {
            terms.clear();
            terms.push(self.last[at]);
            for gap in 2..longest.min(count - at) {
                let next = at + gap;
                if let Some(score) = self.pairs[next].get(gap) {
                    terms.push(behind[next] + self.own[next] + plant_log_odds + score);
                }
            }
            behind[at] = log_sum_exp(&mut terms);
        }
        terms.clear();
        terms.extend((0..count).map(|at| ahead[at] + self.last[at]));
        Sums { all: log_sum_exp(&mut terms), ahead, behind }
    }

    /// The expected number of plants at each place if each were worth `plant_log_odds` more.
    fn marginals(&self, plant_log_odds: f64) -> Vec<f64> {
        let Sums { ahead, behind, all } = self.sums(plant_log_odds);
        ahead.iter().zip(&behind).map(|(a, b)| (a + b - all).exp()).collect()
    }

    /// The expected number of plants likewise.
    fn count(&self, plant_log_odds: f64) -> f64 {
        self.marginals(plant_log_odds).iter().sum()
    }

    /// The log likelihood of plants at some places of the row these are the scores of, at most [`RowFeatures::gap_limit`] apart, and
    /// its derivative by the weights.
    pub fn log_likelihood(&self, row: &RowFeatures<'_>, plants: &[usize]) -> (f64, Weights) {
        let Sums { ahead, behind, all } = self.sums(0.0);
        let (mut value, mut slope) = (-all, Weights::default());
        let Some((&first, &last)) = plants.first().zip(plants.last()) else {
            return (value, slope);
        };
        value += self.first[first] + self.last[last];
        slope.pairs[UNCOVERED] += row.end(first, true)[1] + row.end(last, false)[1];
        let mut is_plant = vec![false; self.own.len()];
        for (k, &at) in plants.iter().enumerate() {
            is_plant[at] = true;
            value += self.own[at];
            if k > 0 {
                value += self.pairs[at][at - plants[k - 1]];
            }
        }
        let add = |sum: &mut [f64], features: &[f64], by: f64| {
            sum.iter_mut().zip(features).for_each(|(sum, f)| *sum += by * f);
        };
        let mut before = None;
        for at in 0..self.own.len() {
            let after = behind[at] - all;
            add(
                &mut slope.places,
                &row.places[at],
                f64::from(u8::from(is_plant[at])) - (ahead[at] + after).exp(),
            );
            let [as_first, as_last] = [
                (self.first[at] + self.own[at] + after).exp() * row.end(at, true)[1],
                (ahead[at] + self.last[at] - all).exp() * row.end(at, false)[1],
            ];
            slope.pairs[UNCOVERED] -= as_first + as_last;
            let true_gap = before.filter(|_| is_plant[at]).map(|before| at - before);
            for (gap, features) in row.before(at) {
                let score = ahead[at - gap] + self.pairs[at][gap] + self.own[at] + after;
                let is_true = f64::from(u8::from(true_gap == Some(gap)));
                add(&mut slope.pairs, &features, is_true - score.exp());
            }
            if is_plant[at] {
                before = Some(at);
            }
        }
        (value, slope)
    }
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
    /// The variance of a count is its derivative by the log odds of a plant.
    const STEP_OF_ODDS: f64 = 0.05;
    let weights = fitted().map_err(SolveError::Misuse)?;
    let of_row = |profile: &&Profile| {
        let lattice = Lattice::new(&RowFeatures::new(profile, overall, spacing), weights);
        let [less, more] = [-STEP_OF_ODDS, STEP_OF_ODDS].map(|odds| lattice.count(odds));
        let marginals = lattice.marginals(plant_log_odds);
        let count = if plant_log_odds == 0.0 { marginals.iter().sum() } else { lattice.count(0.0) };
        let count_variance = ((more - less) / (2.0 * STEP_OF_ODDS)).max(0.0);
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
    const MAX_LOG_ODDS: f64 = 20.0;
    /// Halvings of the range: to 0.04.
    const HALVINGS: usize = 10;
    let weights = fitted().map_err(SolveError::Misuse)?;
    let scores =
        |profile: &&Profile| Lattice::new(&RowFeatures::new(profile, overall, spacing), weights);
    let lattices: Vec<Lattice> = profiles.par_iter().map(scores).collect();
    let expected = |odds: f64| -> f64 {
        let counts: Vec<f64> = lattices.par_iter().map(|lattice| lattice.count(odds)).collect();
        counts.iter().sum()
    };
    let (mut low, mut high) = (-MAX_LOG_ODDS, MAX_LOG_ODDS);
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if expected(middle) > count as f64 { high = middle } else { low = middle }
    }
    Ok(0.5 * (low + high))
}

#[cfg(test)]
mod tests {
    use super::{
        super::{double_plants::PlantScores, row_profile::STEP},
        *,
    };

    fn profile(count: usize) -> Profile {
        let votes: Vec<f64> = (0..count)
            .map(|k| {
                let x = k as f64 * STEP;
                0.1 + [2.0, 5.0, 6.5].iter().map(|p| (-0.5 * (x - p).powi(2)).exp()).sum::<f64>()
            })
            .collect();
        let mut mass = vec![[0.0; 2]];
        for k in 0..count {
            let [sum, moment] = mass[k];
            let here = 0.5 + 0.1 * (k % 5) as f64;
            mass.push([sum + here, moment + here * k as f64]);
        }
        Profile { start: 0.0, offsets: vec![0.0; votes.len()], votes, mass, surroundings: vec![] }
    }

    const OVERALL: Overall =
        Overall { mean: 0.5, mass: 0.7, contrast: 0.5, cover: 0.3, outside: 0.2 };
    const GAPS: Spacing = Spacing { spacing: 3.0, jitter: 0.2, missing: 0.1, doubles: 0.05 };

    #[test]
    fn expected_plants_agree_with_brute_force() {
        let profile = profile(15);
        let row = RowFeatures::new(&profile, &OVERALL, &GAPS);
        let weights = fitted().unwrap();
        let lattice = Lattice::new(&row, weights);
        for plant_log_odds in [0.0, 0.7] {
            let (mut all, mut number, mut marginals) = (0.0, 0.0, [0.0; 15]);
            for set in 1_u32..1 << 15 {
                let places: Vec<usize> = (0..15).filter(|k| set >> k & 1 == 1).collect();
                if !places.windows(2).all(|w| w[1] - w[0] >= 2 && w[1] - w[0] < row.gap_limit()) {
                    continue;
                }
                let own: f64 = places.iter().map(|&at| lattice.own[at] + plant_log_odds).sum();
                let links: f64 = places
                    .windows(2)
                    .map(|w| {
                        let mut before = row.before(w[1]);
                        let (_, features) = before.find(|(gap, _)| *gap == w[1] - w[0]).unwrap();
                        dot(&features, &weights.pairs)
                    })
                    .sum();
                let ends = lattice.first[places[0]] + lattice.last[places[places.len() - 1]];
                let weight = (own + links + ends).exp();
                all += weight;
                number += weight * places.len() as f64;
                places.iter().for_each(|&at| marginals[at] += weight);
            }
            approx::assert_relative_eq!(
                lattice.count(plant_log_odds),
                number / all,
                epsilon = 1e-9
            );
            for (fast, slow) in lattice.marginals(plant_log_odds).iter().zip(marginals) {
                approx::assert_relative_eq!(*fast, slow / all, epsilon = 1e-9);
            }
        }
    }

    #[test]
    fn the_slope_of_the_likelihood_is_that_of_its_values() {
        let mut profile = profile(40);
        let judged = |k: usize| PlantScores { thin: 0.0, second: 0.0, score: (k as f64).sin() };
        profile.surroundings = (0..20).map(judged).collect();
        let row = RowFeatures::new(&profile, &OVERALL, &GAPS);
        let plants = [4, 10, 13, 26];
        let weights = fitted().unwrap();
        let at = |weights: &Weights| Lattice::new(&row, weights).log_likelihood(&row, &plants);
        let (value, slope) = at(weights);
        assert!(value < 0.0, "{value}");
        let moved = |place: Option<usize>, pair: Option<usize>, by: f64| {
            let mut weights = weights.clone();
            place.into_iter().for_each(|k| weights.places[k] += by);
            pair.into_iter().for_each(|k| weights.pairs[k] += by);
            at(&weights).0
        };
        let same = |name: &str, slope: f64, [less, more]: [f64; 2]| {
            let numeric = (more - less) / 2e-5;
            assert!(
                (slope - numeric).abs() < 1e-5 * (1.0 + slope.abs()),
                "{name}: {slope} {numeric}"
            );
        };
        for (k, name) in PLACE_FEATURES.iter().enumerate() {
            same(name, slope.places[k], [-1e-5, 1e-5].map(|by| moved(Some(k), None, by)));
        }
        for (k, name) in PAIR_FEATURES.iter().enumerate() {
            same(name, slope.pairs[k], [-1e-5, 1e-5].map(|by| moved(None, Some(k), by)));
        }
    }
}
