//! The votes and the leaf mass along a row, as [`Profile`] has them.
//!
//! At each place along the row the best votes across it count, under a normal weight about its course. Lengths in pixels of the reduced
//! grid of [`Evidence`].

use super::{evidence::Evidence, row_curves::RowCurve};
use crate::problems::plants::lines::Axes;

/// Distance between the places looked at.
pub const STEP: f64 = 0.5;
/// Half the width of the surroundings that votes are compared with, in steps.
const AROUND: usize = 60;
/// Weight of the whole field in that comparison: the density of a canopy says little of where its stalks are.
const WHOLE: f64 = 0.6;
/// Half the width of the band whose leaf mass a row has to cover.
pub(super) const BAND: i32 = 8;
/// Places looked at beyond the ends of a row.
const BEYOND: f64 = 6.0;

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
    /// How much more leaf there is around every other place than around plants, in standard deviations of plants. For the place before it too, since that changes
    /// slowly along a row; empty where it is not known.
    pub surroundings: Vec<f64>,
}

impl Profile {
    /// How much more leaf there is around a place than around plants, in standard deviations of plants; 0 where it is not known.
    pub(super) fn around(&self, at: usize) -> f64 {
        self.surroundings.get(at / 2).copied().unwrap_or(0.0)
    }

    /// Square roots of the votes over what is usual around each place; `mean` are the mean votes of the field.
    pub(super) fn heights(&self, mean: f64) -> Vec<f64> {
        let sums = sums(self.votes.iter().copied());
        let usual = |at| (1.0 - WHOLE) * mean_around(&sums, at, AROUND) + WHOLE * mean;
        let votes = self.votes.iter().enumerate();
        votes
            .map(|(at, votes)| (votes.max(0.0) / usual(at).max(f64::MIN_POSITIVE)).sqrt())
            .collect()
    }

    /// The places before a first plant or behind a last one, and the mass times its distance that lies beyond what the plant covers.
    pub(super) fn beyond(
        &self,
        at: usize,
        first: bool,
        covered: usize,
        truncated: usize,
    ) -> (usize, f64) {
        let count = self.votes.len();
        if first {
            (at, self.spread(truncated, 0, at.saturating_sub(covered), false))
        } else {
            (count - 1 - at, self.spread(truncated, (at + covered).min(count), count, true))
        }
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

/// Running sums, one longer than the values.
pub(super) fn sums(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut sums = vec![0.0];
    for value in values {
        sums.push(sums.last().copied().unwrap_or(0.0) + value);
    }
    sums
}

/// The mean of the values within some steps of a place, from their running sums.
pub(super) fn mean_around(sums: &[f64], at: usize, reach: usize) -> f64 {
    let (from, to) = (at.saturating_sub(reach), (at + reach + 1).min(sums.len() - 1));
    (sums[to] - sums[from]) / (to - from) as f64
}

/// Looks for the best votes across rows, under a normal weight about them.
pub(super) struct Across {
    /// Sine and cosine of the rows' heading, and where they begin.
    heading: (f64, f64),
    origin_px: [f64; 2],
    /// Offsets with their weights.
    weights: [(f64, f64); 25],
}

impl Across {
    pub(super) fn new(axes: &Axes, scatter: f64) -> Across {
        let weights = std::array::from_fn(|k| {
            let offset = (k as f64 - 12.0) * 0.5;
            (offset, (-0.5 * (offset / scatter).powi(2)).exp())
        });
        Across { heading: axes.heading_rad.sin_cos(), origin_px: axes.origin_px, weights }
    }

    /// The best votes at a place along a row, and their offset from its middle.
    pub(super) fn best(&self, evidence: &Evidence<'_>, along: f64, middle: f64) -> (f64, f64) {
        let ((s, c), [x, y]) = (self.heading, self.origin_px);
        let mut best = (f64::NEG_INFINITY, 0.0);
        for (offset, weight) in self.weights {
            let across = middle + offset;
            let at = [x + c * along - s * across, y + s * along + c * across];
            let score = weight * evidence.at(at);
            if score > best.0 {
                best = (score, offset);
            }
        }
        best
    }
}

/// Reads the votes along a row.
pub(super) fn read(
    evidence: &Evidence<'_>,
    axes: &Axes,
    curve: &RowCurve,
    across: &Across,
) -> Profile {
    let start = curve.start - BEYOND;
    let count = ((curve.end + BEYOND - start) / STEP) as usize + 1;
    let mut votes = Vec::with_capacity(count);
    let mut offsets = Vec::with_capacity(count);
    let mut mass = Vec::with_capacity(count + 1);
    mass.push([0.0; 2]);
    let (mut sum, mut moment) = (0.0, 0.0);
    for k in 0..count {
        let along = start + k as f64 * STEP;
        let middle = curve.offset(along);
        let (best, offset) = across.best(evidence, along, middle);
        votes.push(best);
        offsets.push(offset);
        let leaf = |across: i32| evidence.leaf_at(axes.image([along, middle + f64::from(across)]));
        let here = STEP * (-BAND..=BAND).map(leaf).sum::<f64>();
        sum += here;
        moment += here * k as f64;
        mass.push([sum, moment]);
    }
    Profile { start, votes, offsets, mass, surroundings: Vec::new() }
}
