//! The plants of one row, by dynamic programming over their places along it.
//!
//! With the votes `u(x)` for a stalk at `x`, plants at `x_1 < x_2 < ...` score
//!
//! `sum_i [u(x_i) + plant_log_odds] + sum_i ln p(x_{i+1} - x_i) - sum_i o(x_i, x_{i+1}) - uncovered - ends`:
//!
//! - `u(x) = T (sqrt(E(x) / E_0(x)) - 1)`, `E` the votes on the row and `E_0` their mean around `x`
//!   blended with the whole field's: a canopy's density says little of where its stalks are;
//! - `p` is the density of gaps ([`Spacing`]), `plant_log_odds` what a plant more is worth;
//! - `o` takes back the votes that two plants close together both claim;
//! - *uncovered* is the paper's likelihood with truncated distances, for leaf mass farther than a
//!   plant's own reach from the nearest plant of the row;
//! - what the leaves around a place show ([`super::double_plants`]) is taken off the worth of a plant that has far fewer of them than
//!   others; where there are many, two plants stand in one place if the second is worth it, `ln d` (the share of
//!   doubles) and `plant_log_odds` included;
//! - *ends* charges places of the row before its first and after its last plant as missing plants.
//!
//! All of it is a sum over neighbours, so the best set of plants is found exactly ([`Chain::best`]), and
//! so are the probability of a plant at every place and the distribution of their number
//! ([`Chain::posterior`]). Lengths in pixels of the reduced grid.

use super::{
    chain_links::{Links, dot, highest, normalise},
    double_plants::PlantScores,
    plant_spacing::Spacing,
};

/// Distance between the places looked at.
pub const STEP: f64 = 0.5;
/// Half the width of the surroundings that votes are compared with.
const AROUND: f64 = 30.0;
/// Weight of the whole field in that comparison.
const WHOLE: f64 = 0.6;
/// Range over which two plants claim the same votes.
const OVERLAP: f64 = 2.0;
/// A plant covers this share of the spacing to each side, and distances are truncated one spacing on.
const COVERED: f64 = 0.6;
/// Two plants in one place are this share of the spacing from each other.
const PAIR_SEPARATION: f64 = 0.2;
/// This share of the spacing at the ends of a row needs no plant.
const FREE: f64 = 0.7;

/// What a row shows, place by place along it.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// The first place, along the row.
    pub start: f64,
    /// The best votes across the row.
    pub votes: Vec<f64>,
    /// How far off the middle of the row they are.
    pub offsets: Vec<f64>,
    /// Leaf mass up to each place, and its first moment in steps; one longer than `votes`.
    pub mass: Vec<[f64; 2]>,
    /// What leaves around every other place say of one plant there and of a second one, for the place before it too, for they change
    /// slowly along a row; empty where that is not known.
    pub surroundings: Vec<PlantScores>,
}

impl Profile {
    /// What leaves around a place say, where that is known.
    pub(super) fn around(&self, at: usize) -> Option<&PlantScores> {
        self.surroundings.get(at / 2)
    }

    /// Mass between two places times its distance, at most `truncated` steps, from the first (`ahead`) or the second.
    pub(super) fn spread(&self, truncated: usize, from: usize, to: usize, ahead: bool) -> f64 {
        if from >= to {
            return 0.0;
        }
        let mass = &self.mass;
        let between = |a: usize, b: usize| [mass[b][0] - mass[a][0], mass[b][1] - mass[a][1]];
        let far = truncated as f64;
        let steps = if ahead {
            let turn = to.min(from + truncated);
            let near = between(from, turn);
            near[1] - from as f64 * near[0] + far * between(turn, to)[0]
        } else {
            let turn = from.max(to.saturating_sub(truncated));
            let near = between(turn, to);
            to as f64 * near[0] - near[1] + far * between(from, turn)[0]
        };
        steps * STEP
    }
}

/// How the parts of the score weigh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weights {
    /// `T`: the worth of votes.
    pub votes: f64,
    /// The worth of uncovered mass, in terms per plant.
    pub cover: f64,
    /// Mean votes of the field.
    pub mean: f64,
    /// Leaf mass of a plant.
    pub mass: f64,
}

/// The score of one row, ready to be maximised.
#[derive(Debug, Clone)]
pub struct Chain<'p> {
    pub(super) profile: &'p Profile,
    pub(super) worth: Vec<f64>,
    /// What a second plant in the same place adds; empty where that is not known.
    second: Vec<f64>,
    /// Steps from one to the other.
    apart: usize,
    pub(super) gaps: Vec<f64>,
    pub(super) overlap: Vec<f64>,
    /// Worth of votes, of uncovered mass, of a missing place at an end per step.
    pub(super) weights: [f64; 3],
    pub(super) covered: usize,
    pub(super) truncated: usize,
    free: usize,
}

/// What is probable in a row.
#[derive(Debug, Clone, PartialEq)]
pub struct Posterior {
    /// Expected number of plants at each place.
    pub marginals: Vec<f64>,
    /// Expected number of plants.
    pub count: f64,
    /// Variance of that number.
    pub count_variance: f64,
    /// Logarithm of the sum of all exponentiated scores.
    pub log_sum: f64,
}

impl<'p> Chain<'p> {
    /// The score of a row whose plants have this spacing.
    pub fn new(profile: &'p Profile, spacing: &Spacing, weights: &Weights) -> Chain<'p> {
        let count = profile.votes.len();
        let mut sums = vec![0.0; count + 1];
        for (k, votes) in profile.votes.iter().enumerate() {
            sums[k + 1] = sums[k] + votes;
        }
        let around = (AROUND / STEP) as usize;
        let worth = (0..count)
            .map(|k| {
                let (from, to) = (k.saturating_sub(around), (k + around + 1).min(count));
                let near = (sums[to] - sums[from]) / (to - from) as f64;
                let usual = (1.0 - WHOLE) * near + WHOLE * weights.mean;
                let ratio = profile.votes[k].max(0.0) / usual.max(f64::MIN_POSITIVE);
                let thin = profile.around(k).map_or(0.0, |around| around.thin);
                weights.votes * (ratio.sqrt() - 1.0) - thin
            })
            .collect();
        let rare = spacing.doubles.ln();
        let second = (0..count).map_while(|k| Some(profile.around(k)?.second + rare)).collect();
        let s = spacing.spacing;
        let steps = ((spacing.farthest() / STEP) as usize + 1).max(3);
        let gaps = (0..steps).map(|g| spacing.density(g as f64 * STEP).ln()).collect();
        let overlap = (0..(5.0 * OVERLAP / STEP) as usize)
            .map(|g| (-0.5 * (g as f64 * STEP / OVERLAP).powi(2)).exp())
            .collect();
        let uncovered = weights.cover / weights.mass.max(f64::MIN_POSITIVE) / (0.25 * s);
        Chain {
            profile,
            worth,
            second,
            apart: ((PAIR_SEPARATION * s / STEP).round() as usize).max(2),
            gaps,
            overlap,
            weights: [weights.votes, uncovered, -spacing.missing.ln() * STEP / s],
            covered: (COVERED * s / STEP) as usize,
            truncated: ((s / STEP) as usize).max(1),
            free: (FREE * s / STEP) as usize,
        }
    }

    /// The votes that two neighbours, less than the reach of `overlap` apart, both claim.
    #[inline(always)]
    pub(super) fn claimed_twice(&self, a: usize, b: usize) -> f64 {
        let claimed = self.worth[a].min(self.worth[b]) + self.weights[0];
        self.overlap[b - a] * claimed.max(0.0)
    }

    /// The score of a first plant here, or of a last one.
    fn end(&self, at: usize, first: bool) -> f64 {
        let count = self.worth.len();
        let (places, open) = if first {
            (at, self.profile.spread(self.truncated, 0, at.saturating_sub(self.covered), false))
        } else {
            (
                count - 1 - at,
                self.profile.spread(self.truncated, (at + self.covered).min(count), count, true),
            )
        };
        -self.weights[2] * places.saturating_sub(self.free) as f64 - self.weights[1] * open
    }

    /// The score that a second plant in one place adds.
    fn second(&self, at: usize, plant_log_odds: f64) -> f64 {
        self.second.get(at).map_or(f64::NEG_INFINITY, |second| second + plant_log_odds)
    }

    /// The probability that there are two plants where there is one.
    fn two(&self, at: usize, plant_log_odds: f64, inverse_temperature: f64) -> f64 {
        1.0 / (1.0 + (-inverse_temperature * self.second(at, plant_log_odds)).exp())
    }

    /// The heated scores of the places themselves, one plant or two.
    fn own(&self, plant_log_odds: f64, inverse_temperature: f64) -> Vec<f64> {
        let two = |at: usize| {
            if self.second.is_empty() {
                0.0
            } else {
                (inverse_temperature * self.second(at, plant_log_odds)).exp().ln_1p()
            }
        };
        let worth = self.worth.iter().enumerate();
        worth.map(|(at, worth)| inverse_temperature * (worth + plant_log_odds) + two(at)).collect()
    }

    /// The places from which a plant at `at` can be the next one. Two plants are at least two
    /// steps apart.
    pub(super) fn before(&self, at: usize) -> std::ops::Range<usize> {
        (at + 1).saturating_sub(self.gaps.len())..(at + 1).saturating_sub(2)
    }

    /// The plants that score best, as places, and their score.
    pub fn best(&self, plant_log_odds: f64) -> (Vec<usize>, f64) {
        let count = self.worth.len();
        let (from, last, top) = pulp::Arch::new().dispatch(BestChain(self, plant_log_odds));
        let mut last = last;
        let mut places = Vec::new();
        while last != usize::MAX {
            if self.second(last, plant_log_odds) > 0.0 {
                let first = last.saturating_sub(self.apart / 2);
                places.push((first + self.apart).min(count - 1));
                places.push(first);
            } else {
                places.push(last);
            }
            last = from[last];
        }
        places.reverse();
        for k in 1..places.len() {
            places[k] = places[k].max(places[k - 1] + 1);
        }
        (places, if count == 0 { 0.0 } else { top })
    }

    /// The logarithm of the sum of `exp(inverse_temperature * score)` over all sets of plants.
    pub fn log_sum(&self, plant_log_odds: f64, inverse_temperature: f64) -> f64 {
        let own = self.own(plant_log_odds, inverse_temperature);
        let sums = Forward { chain: self, own: &own, inverse_temperature, two: &[] };
        pulp::Arch::new().dispatch(sums).log_sum
    }

    /// Probabilities proportional to `exp(inverse_temperature * score)`.
    pub fn posterior(&self, plant_log_odds: f64, inverse_temperature: f64) -> Posterior {
        let own = self.own(plant_log_odds, inverse_temperature);
        let two = (0..own.len()).map(|at| self.two(at, plant_log_odds, inverse_temperature));
        let two: Vec<f64> = two.collect();
        let forward = Forward { chain: self, own: &own, inverse_temperature, two: &two };
        let Sums { ahead, log_sum, count_variance } = pulp::Arch::new().dispatch(forward);
        let behind = Backward { chain: self, own: &own, inverse_temperature };
        let behind = pulp::Arch::new().dispatch(behind);
        // Of plants: a place with two counts twice.
        let both = ahead.iter().zip(&behind).zip(&two);
        let marginals: Vec<f64> = both
            .map(|((ahead, behind), two)| (1.0 + two) * (ahead + behind - log_sum).exp())
            .collect();
        Posterior { count: marginals.iter().sum(), count_variance, marginals, log_sum }
    }
}

/// The best chain of plants: of each place the one before it, the last place, the score.
struct BestChain<'c>(&'c Chain<'c>, f64);

impl pulp::WithSimd for BestChain<'_> {
    type Output = (Vec<usize>, usize, f64);

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Self::Output {
        let BestChain(chain, plant_log_odds) = self;
        let count = chain.worth.len();
        let (mut scores, mut from) = (vec![0.0; count], vec![usize::MAX; count]);
        let (mut last, mut top) = (usize::MAX, f64::NEG_INFINITY);
        let mut links = Links::new(chain);
        for at in 0..count {
            let mut score = chain.end(at, true);
            links.back(at);
            let before = chain.before(at);
            for (link, score) in links.scores.iter_mut().zip(&scores[before.clone()]) {
                *link += score;
            }
            let linked = highest(&links.scores);
            if linked > score {
                let first = links.scores.iter().position(|&score| score == linked);
                (score, from[at]) = (linked, before.start + first.unwrap_or(0));
            }
            let second = chain.second(at, plant_log_odds).max(0.0);
            scores[at] = score + chain.worth[at] + plant_log_odds + second;
            let whole = scores[at] + chain.end(at, false);
            if whole > top {
                (last, top) = (at, whole);
            }
        }
        (from, last, top)
    }
}

/// The sums of exponentiated scores of all sets that end with a plant at each place, and over all sets; and, where the probabilities of
/// two plants are given, the variance of the number of plants.
struct Forward<'c> {
    chain: &'c Chain<'c>,
    own: &'c [f64],
    inverse_temperature: f64,
    two: &'c [f64],
}

/// What [`Forward`] finds: logarithms, and a variance.
struct Sums {
    ahead: Vec<f64>,
    log_sum: f64,
    count_variance: f64,
}

impl pulp::WithSimd for Forward<'_> {
    type Output = Sums;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Sums {
        let Forward { chain, own, inverse_temperature, two } = self;
        let count = own.len();
        let (mut ahead, mut terms) = (vec![0.0; count], Vec::new());
        // Mean and mean square of the number of plants up to each place.
        let mut numbers = [vec![0.0; two.len()], vec![0.0; two.len()]];
        let mut links = Links::new(chain);
        for at in 0..count {
            links.back(at);
            let before = chain.before(at);
            terms.clear();
            let linked = links.scores.iter().zip(&ahead[before.clone()]);
            terms.extend(linked.map(|(link, ahead)| ahead + inverse_temperature * link));
            terms.push(inverse_temperature * chain.end(at, true));
            ahead[at] = own[at] + normalise(&mut terms);
            if let Some(two) = two.get(at) {
                let shares = &terms[..before.len()];
                let [mean, square] =
                    [0, 1].map(|k| dot(shares, &numbers[k][before.start..before.end]));
                numbers[0][at] = mean + 1.0 + two;
                numbers[1][at] = square + 2.0 * mean * (1.0 + two) + 1.0 + 3.0 * two;
            }
        }
        terms.clear();
        terms.extend((0..count).map(|at| ahead[at] + inverse_temperature * chain.end(at, false)));
        let log_sum = normalise(&mut terms);
        let [mean, square] = numbers.map(|of| dot(&terms[..of.len()], &of));
        Sums { ahead, log_sum, count_variance: (square - mean * mean).max(0.0) }
    }
}

/// The logarithms of the sums over all that may come after a plant at each place.
struct Backward<'c> {
    chain: &'c Chain<'c>,
    own: &'c [f64],
    inverse_temperature: f64,
}

impl pulp::WithSimd for Backward<'_> {
    type Output = Vec<f64>;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Vec<f64> {
        let Backward { chain, own, inverse_temperature } = self;
        let count = own.len();
        let (mut behind, mut terms) = (vec![0.0; count], Vec::new());
        // With the place's own score, which what comes before it adds.
        let mut beyond = vec![0.0; count];
        let mut links = Links::new(chain);
        for at in (0..count).rev() {
            links.ahead(at);
            terms.clear();
            let linked = links.scores.iter().zip(&beyond[(at + 2).min(count)..]);
            terms.extend(linked.map(|(link, beyond)| beyond + inverse_temperature * link));
            terms.push(inverse_temperature * chain.end(at, false));
            behind[at] = normalise(&mut terms);
            beyond[at] = behind[at] + own[at];
        }
        behind
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn profile(peaks: &[f64], length: f64) -> Profile {
        let count = (length / STEP) as usize;
        let votes: Vec<f64> = (0..count)
            .map(|k| {
                let x = k as f64 * STEP;
                0.1 + peaks.iter().map(|p| (-0.5 * (x - p).powi(2)).exp()).sum::<f64>()
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

    const WEIGHTS: Weights = Weights { votes: 6.0, cover: 1.0, mean: 0.5, mass: 14.0 };

    /// The score of two neighbours by its definition, without their own worth.
    fn link(chain: &Chain<'_>, a: usize, b: usize) -> f64 {
        let gap = b - a;
        let mut score = chain.gaps[gap];
        if gap < chain.overlap.len() {
            score -= chain.claimed_twice(a, b);
        }
        if gap > 2 * chain.covered {
            let middle = a.midpoint(b);
            let open = chain.profile.spread(chain.truncated, a + chain.covered, middle, true)
                + chain.profile.spread(chain.truncated, middle, b - chain.covered, false);
            score -= chain.weights[1] * open;
        }
        score
    }

    #[test]
    fn links_made_together_are_those_made_one_by_one() {
        let profile = profile(&[6.0, 19.0, 32.0, 58.0, 71.0], 80.0);
        for s in [2.0, 4.0, 13.0] {
            let chain = Chain::new(&profile, &Spacing::new(s), &WEIGHTS);
            let (mut links, count) = (Links::new(&chain), chain.worth.len());
            for at in 0..count {
                links.back(at);
                assert_eq!(links.scores.len(), chain.before(at).len());
                for (a, score) in chain.before(at).zip(&links.scores) {
                    approx::assert_relative_eq!(*score, link(&chain, a, at), epsilon = 1e-9);
                }
                links.ahead(at);
                let after = at + 2..(at + chain.gaps.len()).min(count);
                assert_eq!(links.scores.len(), after.len());
                for (b, score) in after.zip(&links.scores) {
                    approx::assert_relative_eq!(*score, link(&chain, at, b), epsilon = 1e-9);
                }
            }
        }
    }

    /// The score by its definition.
    fn score(chain: &Chain<'_>, places: &[usize], plant_log_odds: f64) -> f64 {
        let own: f64 = places.iter().map(|&at| chain.worth[at] + plant_log_odds).sum();
        let links: f64 = places.windows(2).map(|pair| link(chain, pair[0], pair[1])).sum();
        own + links + chain.end(places[0], true) + chain.end(places[places.len() - 1], false)
    }

    /// Two plants may stand in one place, and there are fewer leaves than usual at the end.
    fn with_surroundings(mut profile: Profile) -> Profile {
        let judge = |k: usize| PlantScores {
            thin: if k > 12 { 0.8 } else { 0.0 },
            second: if (3..6).contains(&k) { 3.5 } else { -2.0 },
            score: 0.0,
        };
        profile.surroundings = (0..profile.votes.len()).step_by(2).map(judge).collect();
        profile
    }

    #[test]
    fn the_best_chain_and_all_probabilities_agree_with_brute_force() {
        let bare = profile(&[2.0, 5.0, 5.5], 8.0);
        for profile in [bare.clone(), with_surroundings(bare)] {
            let spacing = Spacing { spacing: 3.0, jitter: 0.2, missing: 0.1, doubles: 0.05 };
            let chain = Chain::new(&profile, &spacing, &WEIGHTS);
            let (plant_log_odds, inverse_temperature, count) = (0.3, 0.7, profile.votes.len());
            let mut best = (vec![], f64::NEG_INFINITY);
            let (mut sum, mut marginals, mut number, mut square) =
                (0.0, vec![0.0; count], 0.0, 0.0);
            for set in 1_u32..1 << count {
                let places: Vec<usize> = (0..count).filter(|k| set >> k & 1 == 1).collect();
                let allowed =
                    |pair: &[usize]| pair[1] - pair[0] >= 2 && pair[1] - pair[0] < chain.gaps.len();
                if !places.windows(2).all(allowed) {
                    continue;
                }
                let score = score(&chain, &places, plant_log_odds);
                let seconds: Vec<f64> =
                    places.iter().map(|&at| chain.second(at, plant_log_odds)).collect();
                let most = score + seconds.iter().map(|second| second.max(0.0)).sum::<f64>();
                // Every way of one or two plants at each place.
                let ways: f64 = seconds
                    .iter()
                    .map(|second| 1.0 + (inverse_temperature * second).exp())
                    .product();
                let weight = (inverse_temperature * score).exp() * ways;
                sum += weight;
                let (mut plants, mut spread) = (0.0, 0.0);
                for (&at, second) in places.iter().zip(&seconds) {
                    let two = (inverse_temperature * second).exp()
                        / (1.0 + (inverse_temperature * second).exp());
                    marginals[at] += weight * (1.0 + two);
                    plants += 1.0 + two;
                    spread += two * (1.0 - two);
                }
                number += weight * plants;
                square += weight * (plants * plants + spread);
                if most > best.1 {
                    best = (places, most);
                }
            }
            let (found, top) = chain.best(plant_log_odds);
            let mut expected = Vec::new();
            for &at in &best.0 {
                if chain.second(at, plant_log_odds) > 0.0 {
                    expected.push(at - chain.apart / 2);
                    expected.push(at - chain.apart / 2 + chain.apart);
                } else {
                    expected.push(at);
                }
            }
            assert_eq!(found, expected);
            assert_eq!(profile.surroundings.is_empty(), found.len() == best.0.len(), "{found:?}");
            approx::assert_relative_eq!(top, best.1, epsilon = 1e-9);
            let posterior = chain.posterior(plant_log_odds, inverse_temperature);
            approx::assert_relative_eq!(posterior.log_sum, sum.ln(), epsilon = 1e-9);
            approx::assert_relative_eq!(posterior.count, number / sum, epsilon = 1e-9);
            let variance = square / sum - (number / sum).powi(2);
            approx::assert_relative_eq!(posterior.count_variance, variance, epsilon = 1e-9);
            for (fast, slow) in posterior.marginals.iter().zip(&marginals) {
                approx::assert_relative_eq!(*fast, slow / sum, epsilon = 1e-9);
            }
        }
    }

    #[test]
    fn uncovered_mass_is_that_of_the_truncated_distances() {
        let profile = profile(&[], 40.0);
        let spacing = Spacing::new(6.0);
        let chain = Chain::new(&profile, &spacing, &WEIGHTS);
        let here = |k: usize| profile.mass[k + 1][0] - profile.mass[k][0];
        for (from, to) in [(0, 7), (3, 60), (20, 79)] {
            let sum = |distance: &dyn Fn(usize) -> usize| -> f64 {
                (from..to).map(|k| here(k) * distance(k).min(chain.truncated) as f64).sum()
            };
            let ahead = sum(&|k| k - from) * STEP;
            let back = sum(&|k| to - k) * STEP;
            approx::assert_relative_eq!(
                profile.spread(chain.truncated, from, to, true),
                ahead,
                epsilon = 1e-9
            );
            approx::assert_relative_eq!(
                profile.spread(chain.truncated, from, to, false),
                back,
                epsilon = 1e-9
            );
        }
    }

    #[test]
    fn peaks_are_found_where_one_plant_is_missing_and_one_has_a_double() {
        let truth = [6.0, 19.0, 32.0, 58.0, 71.0, 84.0, 87.5, 97.0];
        let profile = profile(&truth, 104.0);
        // The weights that the locator has unless told otherwise, and the votes' own mean.
        let weights = Weights { votes: 12.0, mean: 0.3, ..WEIGHTS };
        let (places, _) = Chain::new(&profile, &Spacing::new(13.0), &weights).best(1.1);
        let found: Vec<f64> = places.iter().map(|&k| k as f64 * STEP).collect();
        assert_eq!(found.len(), truth.len(), "{found:?}");
        assert!(found.iter().zip(truth).all(|(a, b)| (a - b).abs() <= 1.0), "{found:?}");
    }
}
