//! How many plants a row holds, by a conditional random field over their places.
//!
//! The best plants of a row ([`super::dynamic_programming`]) are good places and a poor count: where evidence is weak,
//! a plant's probability is spread over many places and the best set leaves it out. The count is
//! therefore the expected one. Sets of plants `x_1 < x_2 < ...` on a row have probabilities
//! proportional to
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
//! The spacing enters `g` and is re-estimated from the expected gaps, a few times, under weak priors.
//! Lengths in pixels of the reduced grid; the weights are those of `weights.csv`, which `experiments
//! fit-stand-count` makes.
//!
//! Reference: J. Lafferty, A. McCallum and F. Pereira, "Conditional random fields: probabilistic models
//! for segmenting and labeling sequence data", ICML 2001.

mod gap_lengths;
mod weights;

use super::{
    chain_links::log_sum_exp,
    dynamic_programming::{Profile, STEP},
};
pub use gap_lengths::Gaps;
use gap_lengths::MOST;
use rayon::prelude::*;
use rowgram_optim::engine::SolveError;
pub use weights::{PAIR_FEATURES, PLACE_FEATURES};
use weights::{Weights, fitted};

/// Number of features of a place.
pub const PLACE: usize = 27;
/// Number of features of two neighbours.
pub const PAIR: usize = 11;
/// Half the width of the surroundings that votes are compared with, in steps.
const AROUND: usize = 60;
/// Weight of the whole field in that comparison.
const WHOLE: f64 = 0.6;
/// Rounds in which the spacing is re-estimated.
const ROUNDS: usize = 4;
/// Width of the band across a row whose leaf mass was gathered.
const BAND: f64 = 17.0;

/// Between which values the fields lay to which the weights were fitted: beyond, these say nothing.
const CONTRASTS: [f64; 2] = [0.25, 0.55];
const COVERS: [f64; 2] = [0.22, 0.78];
const OUTSIDES: [f64; 2] = [0.04, 0.6];
const CROWNS: [f64; 2] = [-4.0, 3.0];

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

/// What is expected of some rows.
#[derive(Debug, Clone, PartialEq)]
pub struct RowCounts {
    /// Expected number of plants of each row.
    pub counts: Vec<f64>,
    /// Variance of each.
    pub variances: Vec<f64>,
}

/// The scores of one row: of every place, of it as the first and as the last plant, and of pairs.
struct Lattice {
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

impl Lattice {
    fn new(profile: &Profile, overall: &Overall, gaps: &Gaps, weights: &Weights) -> Lattice {
        let count = profile.votes.len();
        let heights = heights(profile, overall.mean);
        let own = places(profile, &heights, overall, gaps)
            .iter()
            .map(|features| features.iter().zip(&weights.places).map(|(f, w)| f * w).sum())
            .collect();
        let pairs = Pairs::new(profile, &heights, overall, gaps, weights);
        let (first, last) =
            (0..count).map(|at| (pairs.end(at, true), pairs.end(at, false))).unzip();
        let pairs = (0..count).map(|at| pairs.before(at)).collect();
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

    /// The expected number of plants if each were worth `plant_log_odds` more.
    fn count(&self, plant_log_odds: f64) -> f64 {
        let Sums { ahead, behind, all } = self.sums(plant_log_odds);
        ahead.iter().zip(&behind).map(|(a, b)| (a + b - all).exp()).sum()
    }

    /// The expected number of gaps of each length, in steps.
    fn gaps(&self) -> Vec<f64> {
        let Sums { ahead, behind, all } = self.sums(0.0);
        let longest = self.pairs.iter().map(Vec::len).max().unwrap_or(0);
        let mut expected = vec![0.0; longest];
        for (at, links) in self.pairs.iter().enumerate() {
            let after = self.own[at] + behind[at] - all;
            for (gap, score) in links.iter().enumerate().skip(2) {
                expected[gap] += (ahead[at - gap] + score + after).exp();
            }
        }
        expected
    }
}

/// Square roots of the votes over what is usual around each place.
fn heights(profile: &Profile, mean: f64) -> Vec<f64> {
    let votes = &profile.votes;
    let sums = sums(votes.iter().copied());
    (0..votes.len())
        .map(|at| {
            let near = mean_around(&sums, at, AROUND);
            let usual = (1.0 - WHOLE) * near + WHOLE * mean;
            (votes[at].max(0.0) / usual.max(f64::MIN_POSITIVE)).sqrt()
        })
        .collect()
}

/// Running sums, one longer than the values.
fn sums(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut sums = vec![0.0];
    for value in values {
        sums.push(sums.last().copied().unwrap_or(0.0) + value);
    }
    sums
}

fn mean_around(sums: &[f64], at: usize, reach: usize) -> f64 {
    let (from, to) = (at.saturating_sub(reach), (at + reach + 1).min(sums.len() - 1));
    (sums[to] - sums[from]) / (to - from) as f64
}

/// How many standard deviations of plants there is less leaf around a place than around plants, and more.
fn surroundings_scores(profile: &Profile, at: usize) -> [f64; 2] {
    let score = profile.around(at).map_or(0.0, |around| around.score);
    [score.clamp(CROWNS[0], 0.0), score.clamp(0.0, CROWNS[1])]
}

/// The features of every place.
fn places(profile: &Profile, heights: &[f64], overall: &Overall, gaps: &Gaps) -> Vec<[f64; PLACE]> {
    let sums = sums(heights.iter().copied());
    let steps = |share: f64| (share * gaps.spacing / STEP) as usize;
    let (wide, narrow) = (steps(0.5), steps(0.3).max(1));
    let last = heights.len() as i64 - 1;
    let size = (gaps.spacing / 13.0).ln();
    let within =
        |value: f64, [least, most]: [f64; 2], middle: f64| value.clamp(least, most) - middle;
    let contrast = within(overall.contrast, CONTRASTS, 0.4);
    let cover = within(overall.cover, COVERS, 0.5);
    let outside = within(overall.outside, OUTSIDES, 0.3);
    (0..heights.len())
        .map(|at| {
            let near = |away: i64| heights[(at as i64 + away).clamp(0, last) as usize];
            let mean = |every: i64, reach: i64| {
                let sum: f64 = (-reach..=reach).map(|k| near(k * every)).sum();
                sum / (2 * reach + 1) as f64 - 1.0
            };
            let height = heights[at] - 1.0;
            let local = heights[at] - mean_around(&sums, at, wide);
            let (from, to) = (at.saturating_sub(narrow), (at + narrow + 1).min(heights.len()));
            let mass = (profile.mass[to][0] - profile.mass[from][0]) / (to - from) as f64;
            let [less, more] = surroundings_scores(profile, at);
            [
                1.0,
                height,
                height * height,
                local,
                heights[at] - 0.5 * (near(-4) + near(4)),
                heights[at] - 0.5 * (near(-8) + near(8)),
                mean(1, 2),
                mean(2, 3),
                (mass / overall.mass.max(f64::MIN_POSITIVE)).max(0.0).sqrt() - 1.0,
                size,
                contrast,
                size * height,
                contrast * height,
                cover,
                cover * height,
                contrast * local,
                10.0 * (gaps.missing - 0.07),
                10.0 * (gaps.jitter - 0.15),
                10.0 * (gaps.missing - 0.07) * height,
                10.0 * (gaps.jitter - 0.15) * height,
                size * size,
                outside,
                outside * height,
                less,
                more,
                size * less,
                size * more,
            ]
        })
        .collect()
}

/// What the features of neighbours are made of.
struct Pairs<'p> {
    profile: &'p Profile,
    heights: &'p [f64],
    weights: &'p [f64; PAIR],
    /// By the gap in steps: log density, share of doubles, votes claimed near and far.
    of_gap: Vec<[f64; 4]>,
    /// Worth of uncovered mass, and of a missing place at an end per step.
    uncovered: f64,
    absent: f64,
    covered: usize,
    truncated: usize,
    free: usize,
}

impl<'p> Pairs<'p> {
    fn new(
        profile: &'p Profile,
        heights: &'p [f64],
        overall: &Overall,
        gaps: &Gaps,
        weights: &'p Weights,
    ) -> Pairs<'p> {
        let s = gaps.spacing;
        let steps = ((MOST as f64 - 0.5) * s / STEP) as usize + 1;
        let of_gap = (0..steps)
            .map(|steps| {
                let gap = steps as f64 * STEP;
                let density = gaps.density(gap);
                let claimed = |range: f64| (-0.5 * (gap / range).powi(2)).exp();
                [density.ln(), gaps.double(gap) / density, claimed(2.0), claimed(0.35 * s)]
            })
            .collect();
        // Leaf mass of a plant.
        let mass = (overall.cover * BAND * s).max(f64::MIN_POSITIVE);
        Pairs {
            profile,
            heights,
            weights: &weights.pairs,
            of_gap,
            uncovered: 1.0 / mass / (0.25 * s),
            absent: -gaps.missing.ln() * STEP / s,
            covered: (0.6 * s / STEP) as usize,
            truncated: ((s / STEP) as usize).max(1),
            free: (0.7 * s / STEP) as usize,
        }
    }

    /// The score of a plant at `at` and the one before it, by the gap between them.
    fn before(&self, at: usize) -> Vec<f64> {
        let mut scores = vec![0.0; self.of_gap.len().min(at + 1)];
        let mut valley = f64::INFINITY;
        for gap in 1..scores.len() {
            let from = at - gap;
            if gap >= 2 {
                let features = self.features(from, at, valley);
                scores[gap] = features.iter().zip(self.weights).map(|(f, w)| f * w).sum();
            }
            valley = valley.min(self.heights[from]);
        }
        scores
    }

    fn features(&self, from: usize, to: usize, valley: f64) -> [f64; PAIR] {
        let gap = to - from;
        let [density, double, near, far] = self.of_gap[gap];
        let lower = self.heights[from].min(self.heights[to]);
        let (depth, close) = (valley - lower, gap < self.covered);
        let open = if gap > 2 * self.covered {
            let middle = from.midpoint(to);
            self.profile.spread(self.truncated, from + self.covered, middle, true)
                + self.profile.spread(self.truncated, middle, to - self.covered, false)
        } else {
            0.0
        };
        let middling = !close && gap < 2 * self.covered + self.covered / 2;
        let more = surroundings_scores(self.profile, from)[1]
            .min(surroundings_scores(self.profile, to)[1]);
        [
            density,
            near * lower,
            far * lower,
            self.uncovered * open,
            if close { depth } else { 0.0 },
            if middling { depth } else { 0.0 },
            double,
            double * (lower - 1.0),
            if close { 1.0 - gap as f64 / self.covered as f64 } else { 0.0 },
            near * more,
            double * more,
        ]
    }

    /// The score of a first plant here, or of a last one.
    fn end(&self, at: usize, first: bool) -> f64 {
        let count = self.heights.len();
        let (places, open) = if first {
            let to = at.saturating_sub(self.covered);
            (at, self.profile.spread(self.truncated, 0, to, false))
        } else {
            let from = (at + self.covered).min(count);
            (count - 1 - at, self.profile.spread(self.truncated, from, count, true))
        };
        self.weights[3] * self.uncovered * open
            - self.absent * places.saturating_sub(self.free) as f64
    }
}

/// The expected number of plants of rows whose plants are about `spacing` apart.
///
/// # Errors
/// [`SolveError::Misuse`] where the file of weights is damaged.
pub fn stand_count(
    profiles: &[&Profile],
    overall: &Overall,
    spacing: f64,
) -> Result<RowCounts, SolveError> {
    let weights = fitted().map_err(SolveError::Misuse)?;
    let mut gaps = Gaps::new(spacing);
    for _ in 0..ROUNDS {
        let parts: Vec<Vec<f64>> = profiles
            .par_iter()
            .map(|profile| Lattice::new(profile, overall, &gaps, &weights.of_spacing).gaps())
            .collect();
        let mut expected = vec![0.0; parts.iter().map(Vec::len).max().unwrap_or(0)];
        for part in parts {
            expected.iter_mut().zip(part).for_each(|(sum, number)| *sum += number);
        }
        gaps = gaps.refit(&expected);
    }
    /// The variance of a count is its derivative by the log odds of a plant.
    const STEP_OF_ODDS: f64 = 0.05;
    let (counts, variances) = profiles
        .par_iter()
        .map(|profile| {
            let lattice = Lattice::new(profile, overall, &gaps, &weights.of_count);
            let [less, more] = [-STEP_OF_ODDS, STEP_OF_ODDS].map(|odds| lattice.count(odds));
            (lattice.count(0.0), ((more - less) / (2.0 * STEP_OF_ODDS)).max(0.0))
        })
        .unzip();
    Ok(RowCounts { counts, variances })
}

/// The features of every place of a row, named by [`PLACE_FEATURES`].
pub fn place_features(profile: &Profile, overall: &Overall, gaps: &Gaps) -> Vec<[f64; PLACE]> {
    places(profile, &heights(profile, overall.mean), overall, gaps)
}

/// The features of plants at two places of a row, named by [`PAIR_FEATURES`]; `None` for places that are too far apart or
/// less than two steps.
///
/// # Errors
/// [`SolveError::Misuse`] where the file of weights is damaged.
pub fn pair_features(
    profile: &Profile,
    overall: &Overall,
    gaps: &Gaps,
    [from, to]: [usize; 2],
) -> Result<Option<[f64; PAIR]>, SolveError> {
    let weights = fitted().map_err(SolveError::Misuse)?;
    let heights = heights(profile, overall.mean);
    let pairs = Pairs::new(profile, &heights, overall, gaps, &weights.of_count);
    let near = to >= from + 2 && to < heights.len() && to - from < pairs.of_gap.len();
    Ok(near.then(|| {
        let valley = heights[from + 1..to].iter().copied().fold(f64::INFINITY, f64::min);
        pairs.features(from, to, valley)
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

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
    const GAPS: Gaps = Gaps { spacing: 3.0, jitter: 0.2, missing: 0.1, doubles: 0.05 };

    #[test]
    fn expected_counts_and_gaps_agree_with_brute_force() {
        let profile = profile(15);
        let lattice = Lattice::new(&profile, &OVERALL, &GAPS, &fitted().unwrap().of_count);
        let heights = heights(&profile, OVERALL.mean);
        let pairs = Pairs::new(&profile, &heights, &OVERALL, &GAPS, &fitted().unwrap().of_count);
        for plant_log_odds in [0.0, 0.7] {
            let (mut all, mut number, mut gaps) = (0.0, 0.0, [0.0; 15]);
            for set in 1_u32..1 << 15 {
                let places: Vec<usize> = (0..15).filter(|k| set >> k & 1 == 1).collect();
                if !places.windows(2).all(|w| w[1] - w[0] >= 2 && w[1] - w[0] < pairs.of_gap.len())
                {
                    continue;
                }
                let own: f64 = places.iter().map(|&at| lattice.own[at] + plant_log_odds).sum();
                let links: f64 = places
                    .windows(2)
                    .map(|w| {
                        let valley = heights[w[0] + 1..w[1]].iter().copied();
                        let valley = valley.fold(f64::INFINITY, f64::min);
                        let features = pairs.features(w[0], w[1], valley);
                        features
                            .iter()
                            .zip(fitted().unwrap().of_count.pairs)
                            .map(|(f, w)| f * w)
                            .sum::<f64>()
                    })
                    .sum();
                let ends = pairs.end(places[0], true) + pairs.end(places[places.len() - 1], false);
                let weight = (own + links + ends).exp();
                all += weight;
                number += weight * places.len() as f64;
                places.windows(2).for_each(|w| gaps[w[1] - w[0]] += weight);
            }
            approx::assert_relative_eq!(
                lattice.count(plant_log_odds),
                number / all,
                epsilon = 1e-9
            );
            if plant_log_odds == 0.0 {
                for (fast, slow) in lattice.gaps().iter().zip(gaps) {
                    approx::assert_relative_eq!(*fast, slow / all, epsilon = 1e-9);
                }
            }
        }
    }
}
