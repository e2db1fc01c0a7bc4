//! What the score of a row of the [stand count](super) is a linear function of.

use super::{Overall, PAIR, PLACE, weights::Weights};
use crate::phenotype::{
    plant_spacing::Spacing,
    row_profile::{Profile, STEP, mean_around, sums},
};

/// Which feature of two neighbours is their uncovered leaf mass.
pub(super) const UNCOVERED: usize = 3;
/// Width of the band across a row whose leaf mass was gathered.
const BAND: f64 = 17.0;

/// Between which values the fields lay to which the weights were fitted: beyond, these say nothing.
const CONTRASTS: [f64; 2] = [0.25, 0.55];
const COVERS: [f64; 2] = [0.22, 0.78];
const OUTSIDES: [f64; 2] = [0.04, 0.6];
const CROWNS: [f64; 2] = [-4.0, 3.0];

/// How many standard deviations of plants there is less leaf around a place than around plants, and more.
fn surroundings_scores(profile: &Profile, at: usize) -> [f64; 2] {
    let score = profile.around(at);
    [score.clamp(CROWNS[0], 0.0), score.clamp(0.0, CROWNS[1])]
}

/// The features of every place.
fn places(
    profile: &Profile,
    heights: &[f64],
    overall: &Overall,
    gaps: &Spacing,
) -> Vec<[f64; PLACE]> {
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

/// What the features of two neighbours weigh at one gap.
pub(super) struct WeighedGap {
    /// Whatever stands there.
    alone: f64,
    /// Per height of the lower of both.
    height: f64,
    /// Per leaf around the one with less.
    more: f64,
    /// Per depth of the valley between them.
    depth: f64,
    /// Per leaf mass that neither covers.
    open: f64,
}

/// The features of a row, for some gaps.
pub struct RowFeatures<'p> {
    profile: &'p Profile,
    heights: Vec<f64>,
    /// How many standard deviations of plants there is more leaf around each place than around plants.
    more: Vec<f64>,
    /// Of every place, named by [`PLACE_FEATURES`](super::PLACE_FEATURES).
    pub places: Vec<[f64; PLACE]>,
    /// By the gap in steps: log density, share of doubles, votes claimed near and far.
    of_gap: Vec<[f64; 4]>,
    /// Worth of uncovered mass, and of a missing place at an end per step.
    uncovered: f64,
    absent: f64,
    covered: usize,
    truncated: usize,
    free: usize,
}

impl<'p> RowFeatures<'p> {
    /// Lengths in pixels of the reduced grid.
    pub fn new(profile: &'p Profile, overall: &Overall, gaps: &Spacing) -> RowFeatures<'p> {
        let s = gaps.spacing;
        let steps = (gaps.farthest() / STEP) as usize + 1;
        let of_gap = (0..steps)
            .map(|steps| {
                let gap = steps as f64 * STEP;
                let density = gaps.density(gap);
                let claimed = |range: f64| (-0.5 * (gap / range).powi(2)).exp();
                [density.ln(), gaps.double(gap) / density, claimed(2.0), claimed(0.35 * s)]
            })
            .collect();
        let heights = profile.heights(overall.mean);
        // Leaf mass of a plant.
        let mass = (overall.cover * BAND * s).max(f64::MIN_POSITIVE);
        RowFeatures {
            profile,
            places: places(profile, &heights, overall, gaps),
            more: (0..heights.len()).map(|at| surroundings_scores(profile, at)[1]).collect(),
            heights,
            of_gap,
            uncovered: 1.0 / mass / (0.25 * s),
            absent: -gaps.missing.ln() * STEP / s,
            covered: (0.6 * s / STEP) as usize,
            truncated: ((s / STEP) as usize).max(1),
            free: (0.7 * s / STEP) as usize,
        }
    }

    /// Neighbours are less than this many steps apart.
    pub fn gap_limit(&self) -> usize {
        self.of_gap.len()
    }

    /// The features of a plant at `at` and one before it, named by [`PAIR_FEATURES`](super::PAIR_FEATURES), with the gap between the
    /// two in steps: two at least.
    pub fn before(&self, at: usize) -> impl ExactSizeIterator<Item = (usize, [f64; PAIR])> + '_ {
        let mut valley = at.checked_sub(1).map_or(f64::INFINITY, |next| self.heights[next]);
        (2..self.gap_limit().min(at + 1)).map(move |gap| {
            let from = at - gap;
            let features = (gap, self.pair(from, at, valley));
            valley = valley.min(self.heights[from]);
            features
        })
    }

    /// Whether two plants are nearer than what one covers, and whether they are about as near as what both cover.
    fn nearness(&self, gap: usize) -> [bool; 2] {
        let close = gap < self.covered;
        [close, !close && gap < 2 * self.covered + self.covered / 2]
    }

    fn closeness(&self, gap: usize) -> f64 {
        (1.0 - gap as f64 / self.covered.max(1) as f64).max(0.0)
    }

    /// Leaf mass between two plants that neither covers, times its distance.
    #[inline(always)]
    fn open(&self, from: usize, to: usize) -> f64 {
        if to - from <= 2 * self.covered {
            return 0.0;
        }
        let middle = from.midpoint(to);
        self.profile.spread(self.truncated, from + self.covered, middle, true)
            + self.profile.spread(self.truncated, middle, to - self.covered, false)
    }

    #[inline(always)]
    fn pair(&self, from: usize, to: usize, valley: f64) -> [f64; PAIR] {
        let gap = to - from;
        let [density, double, near, far] = self.of_gap[gap];
        let lower = self.heights[from].min(self.heights[to]);
        let depth = valley - lower;
        let [close, middling] = self.nearness(gap);
        let more = self.more[from].min(self.more[to]);
        [
            density,
            near * lower,
            far * lower,
            self.uncovered * self.open(from, to),
            if close { depth } else { 0.0 },
            if middling { depth } else { 0.0 },
            double,
            double * (lower - 1.0),
            self.closeness(gap),
            near * more,
            double * more,
        ]
    }

    /// What the features of two neighbours weigh together, by the gap in steps.
    pub(super) fn weigh_gaps(&self, weights: &Weights) -> Vec<WeighedGap> {
        let w = &weights.pairs;
        let of = |(gap, [density, double, near, far]): (usize, &[f64; 4])| {
            let [close, middling] = self.nearness(gap);
            WeighedGap {
                alone: w[0] * density + (w[6] - w[7]) * double + w[8] * self.closeness(gap),
                height: w[1] * near + w[2] * far + w[7] * double,
                more: w[9] * near + w[10] * double,
                depth: if close {
                    w[4]
                } else if middling {
                    w[5]
                } else {
                    0.0
                },
                open: w[UNCOVERED] * self.uncovered,
            }
        };
        self.of_gap.iter().enumerate().map(of).collect()
    }

    /// The scores of a plant at `at` and each one before it, from the farthest on: what their features ([`RowFeatures::before`]) weigh together.
    #[inline(always)]
    pub(super) fn score_pairs(&self, at: usize, by_gap: &[WeighedGap], scores: &mut [f64]) {
        let mut valley = at.checked_sub(1).map_or(f64::INFINITY, |next| self.heights[next]);
        for (score, gap) in scores.iter_mut().rev().zip(2..) {
            let (from, of) = (at - gap, &by_gap[gap]);
            let lower = self.heights[from].min(self.heights[at]);
            let more = self.more[from].min(self.more[at]);
            *score = of.alone + of.height * lower + of.more * more;
            if of.depth != 0.0 {
                *score += of.depth * (valley - lower);
            }
            if of.open != 0.0 {
                *score += of.open * self.open(from, at);
            }
            valley = valley.min(self.heights[from]);
        }
    }

    /// What a first plant here (or a last one) costs whatever the weights, and the feature "leaf mass uncovered" of the leaf beyond it.
    pub fn end(&self, at: usize, first: bool) -> [f64; 2] {
        let (places, open) = self.profile.beyond(at, first, self.covered, self.truncated);
        [self.absent * places.saturating_sub(self.free) as f64, self.uncovered * open]
    }
}
