//! How likely a distance of plants is, from what a row shows, over all sets of plants that may stand there.
//!
//! With the votes `u(x)` for a stalk at `x`, plants at `x_1 < x_2 < ...` that are about `s` apart score
//!
//! `sum_i [u(x_i) + w] + sum_i ln p_s(x_{i+1} - x_i) - sum_i o(x_i, x_{i+1}) - uncovered - ends`:
//!
//! - `u(x) = T (sqrt(E(x) / E_0(x)) - 1)`, `E` the votes on the row and `E_0` their mean around `x`
//!   blended with the whole field's: a canopy's density says little of where its stalks are; `T` = [`VOTES`];
//! - `p_s` is the density of gaps ([`Spacing`]), `w` = [`PLANT`] what one plant more is worth;
//! - `o` takes back the votes that two plants close together both claim;
//! - *uncovered* is the paper's likelihood with truncated distances, for leaf mass farther than a
//!   plant's own reach from the nearest plant of the row;
//! - *ends* charges places of the row before its first and after its last plant as missing plants.
//!
//! All of it is a sum over neighbours, so the sum of the exponentials over all sets is found exactly. The plants themselves have a score of their own
//! ([`super::stand_count`]), whose weights are fitted to a spacing that is known and say nothing of which spacing it is. Lengths in pixels of the reduced grid.
//!
//! Leaf mass that two plants at `a` and `b` leave open is a sum over the mass between them. With `m_0(x)` and `m_1(x)` the mass up to `x`
//! and its first moment, and `k(x) = x m_0(x) - m_1(x)`, it is
//!
//! `k(a + c) + k(b - c) + 2 m_1(m) - (a + b) m_0(m)`, `m` the middle of `a` and `b`,
//!
//! and, where the middle is farther than `t` from what either covers,
//!
//! `k(a + c) - k(a + c + t) + k(b - c) - k(b - c - t)`.
//!
//! So every term is one of an array in order.

use super::{
    log_sum::normalise,
    plant_spacing::Spacing,
    row_profile::{Profile, STEP},
};

/// Worth of the square root of votes over mean votes.
const VOTES: f64 = 12.0;
/// Worth of a plant.
pub(super) const PLANT: f64 = 0.5;
/// Range over which two plants claim the same votes.
const OVERLAP: f64 = 2.0;
/// A plant covers this share of the spacing to each side, and distances are truncated one spacing on.
const COVERED: f64 = 0.6;
/// This share of the spacing at the ends of a row needs no plant.
const FREE: f64 = 0.7;

/// The score of one row.
#[derive(Debug, Clone)]
pub(super) struct SpacingScore<'p> {
    profile: &'p Profile,
    worth: Vec<f64>,
    gaps: Vec<f64>,
    overlap: Vec<f64>,
    /// Worth of uncovered mass.
    uncovered: f64,
    /// Worth of a missing place at an end, per step.
    absent: f64,
    covered: usize,
    truncated: usize,
    free: usize,
}

impl<'p> SpacingScore<'p> {
    /// The score of a row whose plants have this spacing; `votes` are the mean ones of the field, `mass` is the leaf mass of a plant.
    pub(super) fn new(
        profile: &'p Profile,
        spacing: &Spacing,
        votes: f64,
        mass: f64,
    ) -> SpacingScore<'p> {
        let worth = profile.heights(votes).iter().map(|height| VOTES * (height - 1.0)).collect();
        let s = spacing.spacing;
        let steps = ((spacing.farthest() / STEP) as usize + 1).max(3);
        let gaps = (0..steps).map(|g| spacing.density(g as f64 * STEP).ln()).collect();
        let overlap = (0..(5.0 * OVERLAP / STEP) as usize)
            .map(|g| (-0.5 * (g as f64 * STEP / OVERLAP).powi(2)).exp())
            .collect();
        SpacingScore {
            profile,
            worth,
            gaps,
            overlap,
            uncovered: 1.0 / mass.max(f64::MIN_POSITIVE) / (0.25 * s),
            absent: -spacing.missing.ln() * STEP / s,
            covered: (COVERED * s / STEP) as usize,
            truncated: ((s / STEP) as usize).max(1),
            free: (FREE * s / STEP) as usize,
        }
    }

    /// The votes that two neighbours, less than the reach of `overlap` apart, both claim.
    #[inline(always)]
    fn claimed_twice(&self, a: usize, b: usize) -> f64 {
        let claimed = self.worth[a].min(self.worth[b]) + VOTES;
        self.overlap[b - a] * claimed.max(0.0)
    }

    /// The score of a first plant here, or of a last one.
    fn end(&self, at: usize, first: bool) -> f64 {
        let (places, open) = self.profile.beyond(at, first, self.covered, self.truncated);
        -self.absent * places.saturating_sub(self.free) as f64 - self.uncovered * open
    }

    /// The places from which a plant at `at` can be the next one. Two plants are at least two
    /// steps apart.
    fn before(&self, at: usize) -> std::ops::Range<usize> {
        (at + 1).saturating_sub(self.gaps.len())..(at + 1).saturating_sub(2)
    }

    /// The places of the plants that score best.
    pub(super) fn best(&self) -> Vec<usize> {
        pulp::Arch::new().dispatch(Best(self))
    }

    /// The logarithm of the sum of the exponentials of the scores of all sets of plants.
    pub(super) fn log_sum(&self) -> f64 {
        pulp::Arch::new().dispatch(Sum(self))
    }
}

/// [`SpacingScore::best`], with the machine's SIMD.
struct Best<'c>(&'c SpacingScore<'c>);

impl pulp::WithSimd for Best<'_> {
    type Output = Vec<usize>;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Vec<usize> {
        let Best(row) = self;
        let count = row.worth.len();
        let (mut scores, mut from) = (vec![0.0; count], vec![usize::MAX; count]);
        let (mut last, mut top) = (usize::MAX, f64::NEG_INFINITY);
        let mut links = Links::new(row);
        for at in 0..count {
            let mut score = row.end(at, true);
            links.back(at);
            for (before, link) in row.before(at).zip(&links.scores) {
                let linked = link + scores[before];
                if linked > score {
                    (score, from[at]) = (linked, before);
                }
            }
            scores[at] = score + row.worth[at] + PLANT;
            let whole = scores[at] + row.end(at, false);
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
}

/// [`SpacingScore::log_sum`], with the machine's SIMD.
struct Sum<'c>(&'c SpacingScore<'c>);

impl pulp::WithSimd for Sum<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> f64 {
        let Sum(row) = self;
        let count = row.worth.len();
        let (mut ahead, mut terms) = (vec![0.0; count], Vec::new());
        let mut links = Links::new(row);
        for at in 0..count {
            links.back(at);
            terms.clear();
            let linked = links.scores.iter().zip(&ahead[row.before(at)]);
            terms.extend(linked.map(|(link, ahead)| ahead + link));
            terms.push(row.end(at, true));
            ahead[at] = row.worth[at] + PLANT + normalise(&mut terms);
        }
        terms.clear();
        terms.extend((0..count).map(|at| ahead[at] + row.end(at, false)));
        normalise(&mut terms)
    }
}

/// Makes the scores of links of a row, in memory that is used again.
struct Links<'c> {
    row: &'c SpacingScore<'c>,
    /// Logarithms of the densities of gaps, from the longest to none.
    gaps_back: Vec<f64>,
    /// `k(x)`.
    moments: Vec<f64>,
    /// `2 m_1(s / 2) - s m_0(s / 2)` for `s = a + b`.
    middles: Vec<f64>,
    /// The scores that were made last.
    scores: Vec<f64>,
}

impl<'c> Links<'c> {
    fn new(row: &'c SpacingScore<'c>) -> Links<'c> {
        let mass = &row.profile.mass;
        let moment = |(x, [sum, first]): (usize, &[f64; 2])| x as f64 * sum - first;
        let middle = |s: usize| 2.0 * mass[s / 2][1] - s as f64 * mass[s / 2][0];
        Links {
            row,
            gaps_back: row.gaps.iter().rev().copied().collect(),
            moments: mass.iter().enumerate().map(moment).collect(),
            middles: (0..2 * mass.len()).map(middle).collect(),
            scores: Vec::with_capacity(row.gaps.len()),
        }
    }

    /// The gaps from which on mass lies open, and from which on distances are truncated.
    fn turns(&self) -> [usize; 2] {
        let SpacingScore { covered, truncated, .. } = *self.row;
        [2 * covered + 1, 2 * (covered + truncated) + 1]
    }

    /// The scores of links from all places before `at`, [`SpacingScore::before`].
    #[inline(always)]
    fn back(&mut self, at: usize) {
        let row = self.row;
        let (covered, truncated, cost) = (row.covered, row.truncated, row.uncovered * STEP);
        let before = row.before(at);
        let first = before.start;
        let turn = |gap: usize| (at + 1).saturating_sub(gap).clamp(first, before.end.max(first));
        let [open, far] = self.turns().map(turn);
        self.scores.clear();
        let skipped = row.gaps.len() - 1 - (at - first);
        self.scores.extend_from_slice(&self.gaps_back[skipped..][..before.len()]);
        if open > first {
            let (of, to) = (&self.moments, at - covered);
            if far > first {
                let there = of[to] - of[to - truncated];
                let from = &of[first + covered..][..far - first];
                let truncated = &of[first + covered + truncated..][..far - first];
                for ((score, near), far) in self.scores.iter_mut().zip(from).zip(truncated) {
                    *score -= cost * (near - far + there);
                }
            }
            let there = of[to];
            let from = &of[far + covered..open + covered];
            let middle = &self.middles[far + at..open + at];
            let scores = &mut self.scores[far - first..open - first];
            for ((score, near), middle) in scores.iter_mut().zip(from).zip(middle) {
                *score -= cost * (near + there + middle);
            }
        }
        let overlapping = (at + 1).saturating_sub(row.overlap.len()).max(first);
        for a in overlapping..before.end {
            self.scores[a - first] -= row.claimed_twice(a, at);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const VOTES_OF_FIELD: f64 = 0.5;
    const MASS: f64 = 14.0;

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

    /// The score of two neighbours by its definition, without their own worth.
    fn link(row: &SpacingScore<'_>, a: usize, b: usize) -> f64 {
        let gap = b - a;
        let mut score = row.gaps[gap];
        if gap < row.overlap.len() {
            score -= row.claimed_twice(a, b);
        }
        if gap > 2 * row.covered {
            let middle = a.midpoint(b);
            let open = row.profile.spread(row.truncated, a + row.covered, middle, true)
                + row.profile.spread(row.truncated, middle, b - row.covered, false);
            score -= row.uncovered * open;
        }
        score
    }

    #[test]
    fn links_made_together_are_those_made_one_by_one() {
        let profile = profile(&[6.0, 19.0, 32.0, 58.0, 71.0], 80.0);
        for s in [2.0, 4.0, 13.0] {
            let row = SpacingScore::new(&profile, &Spacing::new(s), VOTES_OF_FIELD, MASS);
            let (mut links, count) = (Links::new(&row), row.worth.len());
            for at in 0..count {
                links.back(at);
                assert_eq!(links.scores.len(), row.before(at).len());
                for (a, score) in row.before(at).zip(&links.scores) {
                    approx::assert_relative_eq!(*score, link(&row, a, at), epsilon = 1e-9);
                }
            }
        }
    }

    #[test]
    fn the_sum_over_all_sets_agrees_with_brute_force() {
        let profile = profile(&[2.0, 5.0, 5.5], 8.0);
        let spacing = Spacing { spacing: 3.0, jitter: 0.2, missing: 0.1, doubles: 0.05 };
        let row = SpacingScore::new(&profile, &spacing, VOTES_OF_FIELD, MASS);
        let count = profile.votes.len();
        let mut sum = 0.0;
        for set in 1_u32..1 << count {
            let places: Vec<usize> = (0..count).filter(|k| set >> k & 1 == 1).collect();
            let allowed =
                |pair: &[usize]| pair[1] - pair[0] >= 2 && pair[1] - pair[0] < row.gaps.len();
            if !places.windows(2).all(allowed) {
                continue;
            }
            let own: f64 = places.iter().map(|&at| row.worth[at] + PLANT).sum();
            let links: f64 = places.windows(2).map(|pair| link(&row, pair[0], pair[1])).sum();
            let ends = row.end(places[0], true) + row.end(places[places.len() - 1], false);
            sum += (own + links + ends).exp();
        }
        approx::assert_relative_eq!(row.log_sum(), sum.ln(), epsilon = 1e-9);
    }

    #[test]
    fn uncovered_mass_is_that_of_the_truncated_distances() {
        let profile = profile(&[], 40.0);
        let spacing = Spacing::new(6.0);
        let row = SpacingScore::new(&profile, &spacing, VOTES_OF_FIELD, MASS);
        let here = |k: usize| profile.mass[k + 1][0] - profile.mass[k][0];
        for (from, to) in [(0, 7), (3, 60), (20, 79)] {
            let sum = |distance: &dyn Fn(usize) -> usize| -> f64 {
                (from..to).map(|k| here(k) * distance(k).min(row.truncated) as f64).sum()
            };
            let ahead = sum(&|k| k - from) * STEP;
            let back = sum(&|k| to - k) * STEP;
            approx::assert_relative_eq!(
                profile.spread(row.truncated, from, to, true),
                ahead,
                epsilon = 1e-9
            );
            approx::assert_relative_eq!(
                profile.spread(row.truncated, from, to, false),
                back,
                epsilon = 1e-9
            );
        }
    }
}
