//! The scores of a row, and sums over all sets of plants on it.

use super::{
    features::{RowFeatures, UNCOVERED},
    weights::Weights,
};
use crate::phenotype::log_sum::{dot, normalise};
use std::ops::Range;

/// The scores of one row: of every place, of it as the first and as the last plant, and of pairs.
pub struct Lattice {
    own: Vec<f64>,
    first: Vec<f64>,
    last: Vec<f64>,
    /// Of a plant at a place and one before it: place by place, of each from the farthest place before it to the nearest, two steps away.
    pairs: Vec<f64>,
    /// Where the pairs of each place end; the first number is where those of the first place begin.
    ends: Vec<usize>,
    gap_limit: usize,
}

/// What sums over everything before each place say.
struct Forward {
    /// Logarithms of these sums, the place's own score among them.
    ahead: Vec<f64>,
    /// Logarithm of the sum over everything.
    all: f64,
    /// Expected number of plants, and its variance.
    count: (f64, f64),
}

fn weighted(features: &[f64], weights: &[f64]) -> f64 {
    features.iter().zip(weights).map(|(f, w)| f * w).sum()
}

impl Lattice {
    /// The scores of features under some weights.
    pub fn new(row: &RowFeatures<'_>, weights: &Weights) -> Lattice {
        let own: Vec<f64> =
            row.places.iter().map(|place| weighted(place, &weights.places)).collect();
        let by_gap = row.weigh_gaps(weights);
        let (mut pairs, mut ends) = (Vec::new(), vec![0]);
        for at in 0..own.len() {
            let from = pairs.len();
            pairs.resize(from + row.before(at).len(), 0.0);
            row.score_pairs(at, &by_gap, &mut pairs[from..]);
            ends.push(pairs.len());
        }
        let end = |at, first| {
            let [cost, open] = row.end(at, first);
            weights.pairs[UNCOVERED] * open - cost
        };
        let (first, last) = (0..own.len()).map(|at| (end(at, true), end(at, false))).unzip();
        Lattice { own, first, last, pairs, ends, gap_limit: row.gap_limit() }
    }

    /// The places before one, with the scores of pairs.
    #[inline(always)]
    fn before(&self, at: usize) -> (Range<usize>, &[f64]) {
        let pairs = &self.pairs[self.ends[at]..self.ends[at + 1]];
        let end = at.saturating_sub(1);
        (end - pairs.len()..end, pairs)
    }

    /// The score of a pair, at least two steps apart.
    #[inline(always)]
    fn pair(&self, at: usize, gap: usize) -> f64 {
        self.pairs[self.ends[at + 1] + 1 - gap]
    }

    fn forward(&self, plant_log_odds: f64) -> Forward {
        pulp::Arch::new().dispatch(SumForward(self, plant_log_odds))
    }

    /// Logarithms of the sums over everything after each place.
    fn behind(&self, plant_log_odds: f64) -> Vec<f64> {
        pulp::Arch::new().dispatch(SumBackward(self, plant_log_odds))
    }

    /// The logarithm of the sum of the exponentials of the scores of all sets of plants.
    pub fn log_sum(&self) -> f64 {
        self.forward(0.0).all
    }

    /// The set of plants that scores best.
    pub fn best(&self) -> Vec<usize> {
        let count = self.own.len();
        let (mut scores, mut from) = (vec![0.0; count], vec![usize::MAX; count]);
        let (mut last, mut top) = (usize::MAX, f64::NEG_INFINITY);
        for at in 0..count {
            let mut score = self.first[at];
            let (before, pairs) = self.before(at);
            for (before, pair) in before.zip(pairs) {
                let linked = scores[before] + pair;
                if linked > score {
                    (score, from[at]) = (linked, before);
                }
            }
            scores[at] = score + self.own[at];
            let whole = scores[at] + self.last[at];
            if whole > top {
                (last, top) = (at, whole);
            }
        }
        let mut places = Vec::new();
        while last != usize::MAX {
            places.push(last);
            last = from[last];
        }
        places.reverse();
        places
    }

    /// The expected number of plants at each place if each were worth `plant_log_odds` more.
    pub(super) fn marginals(&self, plant_log_odds: f64) -> Vec<f64> {
        let Forward { ahead, all, .. } = self.forward(plant_log_odds);
        let behind = self.behind(plant_log_odds);
        ahead.iter().zip(&behind).map(|(a, b)| (a + b - all).exp()).collect()
    }

    /// The expected number of plants likewise, and its variance.
    pub(super) fn count(&self, plant_log_odds: f64) -> (f64, f64) {
        self.forward(plant_log_odds).count
    }

    /// The log likelihood of plants at some places of the row these are the scores of, at most [`RowFeatures::gap_limit`] apart, and
    /// its derivative by the weights.
    pub fn log_likelihood(&self, row: &RowFeatures<'_>, plants: &[usize]) -> (f64, Weights) {
        let Forward { ahead, all, .. } = self.forward(0.0);
        let behind = self.behind(0.0);
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
                value += self.pair(at, at - plants[k - 1]);
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
                let score = ahead[at - gap] + self.pair(at, gap) + self.own[at] + after;
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

/// [`Lattice::forward`], with the machine's SIMD.
struct SumForward<'l>(&'l Lattice, f64);

impl pulp::WithSimd for SumForward<'_> {
    type Output = Forward;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Forward {
        let SumForward(row, plant_log_odds) = self;
        let count = row.own.len();
        let (mut ahead, mut terms) = (vec![0.0; count], Vec::new());
        // Mean and mean square of the number of plants up to each place.
        let (mut means, mut squares) = (vec![0.0; count], vec![0.0; count]);
        for at in 0..count {
            let (before, pairs) = row.before(at);
            terms.clear();
            terms.extend(pairs.iter().zip(&ahead[before.clone()]).map(|(pair, a)| pair + a));
            terms.push(row.first[at]);
            ahead[at] = normalise(&mut terms) + row.own[at] + plant_log_odds;
            let shares = &terms[..before.len()];
            let mean = dot(shares, &means[before.clone()]);
            means[at] = mean + 1.0;
            squares[at] = dot(shares, &squares[before]) + 2.0 * mean + 1.0;
        }
        terms.clear();
        terms.extend(ahead.iter().zip(&row.last).map(|(ahead, last)| ahead + last));
        let all = normalise(&mut terms);
        let [mean, square] = [means, squares].map(|of| dot(&terms, &of));
        Forward { ahead, all, count: (mean, (square - mean * mean).max(0.0)) }
    }
}

/// [`Lattice::behind`], with the machine's SIMD.
struct SumBackward<'l>(&'l Lattice, f64);

impl pulp::WithSimd for SumBackward<'_> {
    type Output = Vec<f64>;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Vec<f64> {
        let SumBackward(row, plant_log_odds) = self;
        let count = row.own.len();
        let (mut behind, mut terms) = (vec![0.0; count], Vec::new());
        // With the place's own score, which what comes before it adds.
        let mut beyond = vec![0.0; count];
        for at in (0..count).rev() {
            terms.clear();
            let after = at + 2..(at + row.gap_limit).min(count).max(at + 2);
            let last = row.ends.iter().skip(at + 3);
            let pairs = last.enumerate().map(|(k, end)| row.pairs[end - 1 - k]);
            terms.extend(
                beyond
                    .iter()
                    .skip(after.start)
                    .take(after.len())
                    .zip(pairs)
                    .map(|(b, pair)| b + pair),
            );
            terms.push(row.last[at]);
            behind[at] = normalise(&mut terms);
            beyond[at] = behind[at] + row.own[at] + plant_log_odds;
        }
        behind
    }
}

#[cfg(test)]
mod tests {
    use super::{
        super::weights::{PAIR_FEATURES, PLACE_FEATURES, fitted},
        *,
    };
    use crate::phenotype::{
        plant_spacing::Spacing,
        row_profile::{Profile, STEP},
        stand_count::Overall,
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
        Overall { mean: 0.5, mass: 0.7, contrast: 0.5, cover: 0.3, outside: 0.2, leaf_width: 5.0 };
    const GAPS: Spacing = Spacing { spacing: 3.0, jitter: 0.2, missing: 0.1, doubles: 0.05 };

    #[test]
    fn expected_plants_agree_with_brute_force() {
        let profile = profile(15);
        let row = RowFeatures::new(&profile, &OVERALL, &GAPS);
        let weights = &fitted().unwrap().at(5.0);
        let lattice = Lattice::new(&row, weights);
        for plant_log_odds in [0.0, 0.7] {
            let (mut all, mut number, mut square, mut marginals) = (0.0, 0.0, 0.0, [0.0; 15]);
            let mut best = (f64::NEG_INFINITY, vec![]);
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
                        weighted(&features, &weights.pairs)
                    })
                    .sum();
                let ends = lattice.first[places[0]] + lattice.last[places[places.len() - 1]];
                let weight = (own + links + ends).exp();
                if weight > best.0 {
                    best = (weight, places.clone());
                }
                all += weight;
                number += weight * places.len() as f64;
                square += weight * (places.len() as f64).powi(2);
                places.iter().for_each(|&at| marginals[at] += weight);
            }
            if plant_log_odds == 0.0 {
                assert_eq!(lattice.best(), best.1);
                approx::assert_relative_eq!(lattice.log_sum(), all.ln(), epsilon = 1e-9);
            }
            let (count, variance) = lattice.count(plant_log_odds);
            approx::assert_relative_eq!(count, number / all, epsilon = 1e-9);
            let scatter = square / all - (number / all).powi(2);
            approx::assert_relative_eq!(variance, scatter, epsilon = 1e-9);
            for (fast, slow) in lattice.marginals(plant_log_odds).iter().zip(marginals) {
                approx::assert_relative_eq!(*fast, slow / all, epsilon = 1e-9);
            }
        }
    }

    #[test]
    fn the_slope_of_the_likelihood_is_that_of_its_values() {
        let mut profile = profile(40);
        profile.surroundings = (0..20).map(|k| f64::from(k).sin()).collect();
        let row = RowFeatures::new(&profile, &OVERALL, &GAPS);
        let plants = [4, 10, 13, 26];
        let weights = &fitted().unwrap().at(5.0);
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
