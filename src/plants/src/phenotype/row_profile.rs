//! The votes and the leaf mass along a row, as [`Profile`] has them.
//!
//! At each place along the row the best votes across it count, under a normal weight about its course. Lengths in pixels of the reduced
//! grid of [`Evidence`].

use super::{
    dynamic_programming::{Profile, STEP},
    evidence::Evidence,
    row_curves::RowCurve,
};
use crate::problems::plants::lines::Axes;

/// Half the width of the band whose leaf mass a row has to cover.
pub(super) const BAND: i32 = 8;
/// Places looked at beyond the ends of a row.
const BEYOND: f64 = 6.0;

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
