//! What the stand count reads of a mask, written here once more: a test compares it with the library's.

use rowgram::{
    io::{images, points},
    phenotype::{
        double_plants::{PlantBaseline, leaf_surroundings},
        evidence::{Evidence, factor},
        row_curves,
        row_model::{self, RowModelOptions},
        rows,
        stand::Stalk,
    },
};
use std::{error::Error, f64::consts::TAU, path::Path};

pub(super) const STEP: f64 = 0.5;
pub(super) const PLACE: usize = 27;
pub(super) const PAIR: usize = 11;
pub(super) const ALL: usize = PLACE + PAIR;
const MAX_PLANTS: usize = 6;
const BAND: i32 = 8;
/// Priors of jitter, missing and doubles: mean, and how many gaps it weighs.
const WEAK: [(f64, f64); 3] = [(0.15, 20.0), (0.07, 20.0), (0.03, 30.0)];
pub(super) const USED: [(f64, f64); 3] = [(0.15, 40.0), (0.05, 100.0), (0.03, 2000.0)];

#[derive(Clone, Copy)]
pub(super) struct Gaps {
    pub(super) s: f64,
    pub(super) j: f64,
    pub(super) m: f64,
    pub(super) d: f64,
}

fn normal(x: f64, mean: f64, variance: f64) -> f64 {
    (-0.5 * (x - mean).powi(2) / variance).exp() / (TAU * variance).sqrt()
}

impl Gaps {
    fn skipping(&self, gap: f64, k: usize) -> f64 {
        let (steps, sd) = (k as f64, self.j * self.s);
        (1.0 - self.d)
            * (1.0 - self.m)
            * self.m.powi(k as i32 - 1)
            * normal(gap, steps * self.s, steps * sd * sd)
    }
    fn double(&self, gap: f64) -> f64 {
        self.d * normal(gap, (0.24 * self.s).max(1.5), (0.07 * self.s).powi(2).max(0.3))
    }
    fn density(&self, gap: f64) -> f64 {
        (1..=MAX_PLANTS).map(|k| self.skipping(gap, k)).sum::<f64>()
            + self.double(gap)
            + 1e-5 / self.s
    }
    pub(super) fn refit(&self, gaps: &[(f64, f64)], prior: &[(f64, f64); 3]) -> Gaps {
        let (mut length, mut places, mut kinds, mut doubles, mut all) = (0.0, 0.0, 0.0, 0.0, 0.0);
        let mut shares = Vec::new();
        for &(gap, number) in gaps {
            let density = self.density(gap);
            all += number;
            doubles += number * self.double(gap) / density;
            for k in 1..=MAX_PLANTS {
                let share = number * self.skipping(gap, k) / density;
                length += share * gap;
                places += share * k as f64;
                kinds += share;
                shares.push((gap, k as f64, share));
            }
        }
        let s = length / places;
        let scatter: f64 = shares.iter().map(|(g, k, w)| w * (g / s - k).powi(2) / k).sum();
        let pooled =
            |sum: f64, n: f64, (mean, weight): (f64, f64)| (sum + mean * weight) / (n + weight);
        Gaps {
            s,
            j: pooled(scatter, kinds, (prior[0].0.powi(2), prior[0].1)).sqrt().clamp(0.04, 0.4),
            m: pooled(places - kinds, places, prior[1]).clamp(0.003, 0.6),
            d: pooled(doubles, all, prior[2]).clamp(0.002, 0.2),
        }
    }
}

/// One row: votes and running leaf mass by place, and the places of the true plants.
pub(super) struct Row {
    pub(super) votes: Vec<f64>,
    /// More leaf than around plants, in their standard deviations.
    pub(super) crown: Vec<f64>,
    pub(super) mass: Vec<[f64; 2]>,
    pub(super) truth: Vec<usize>,
}

pub(super) struct Field {
    pub(super) rows: Vec<Row>,
    /// Mean votes, leaf mass of a place, contrast, cover, share of leaf outside the rows.
    pub(super) overall: [f64; 5],
    pub(super) truth: Gaps,
    /// The spacing at which the locator starts to count.
    pub(super) start: f64,
}

/// What the locator reads of a mask (as `phenotype::row_evidence` does), with the true plants on it.
pub(super) fn read(path: &Path) -> Result<Field, Box<dyn Error + Send + Sync>> {
    let mask = images::read_mask(path)?;
    let plants = points::read(&path.with_extension("csv"))?;
    let detection = rows::detect(&mask);
    let uncounted =
        RowModelOptions { stand_count: false, double_plants: false, ..RowModelOptions::default() };
    let uncounted = row_model::locate(&mask, &detection, None, &uncounted)?;
    let start = uncounted.spacing.spacing;
    let found = detection.rows().ok_or("no rows")?;
    let evidence = Evidence::new(&mask, found.axes.heading_rad, factor(&mask));
    let at = |plant: &Stalk| evidence.reduced(plant.position_px);
    let stalks: Vec<[f64; 2]> = uncounted.plants.iter().map(at).collect();
    let usual = PlantBaseline::new(&leaf_surroundings(&evidence, &stalks));
    let factor = evidence.factor as f64;
    let mut axes = found.axes;
    axes.origin_px = evidence.reduced(axes.origin_px);
    let reduced: Vec<rows::Row> = found
        .rows
        .iter()
        .map(|row| rows::Row {
            across_px: row.across_px / factor,
            start_px: row.start_px / factor,
            end_px: row.end_px / factor,
            pixels: row.pixels,
        })
        .collect();
    let apart = found.spacing_px.map(|px| px / factor);
    let curves = row_curves::trace(&evidence, &axes, &reduced, apart);
    let mut places = vec![];
    let mut rows: Vec<(f64, Row)> = curves
        .iter()
        .map(|ridge| {
            let start = ridge.start - 6.0;
            let count = ((ridge.end + 6.0 - start) / STEP) as usize + 1;
            let mut row = Row { votes: vec![], crown: vec![], mass: vec![[0.0; 2]], truth: vec![] };
            for k in 0..count {
                let along = start + k as f64 * STEP;
                let middle = ridge.offset(along);
                let mut best = (f64::NEG_INFINITY, 0.0);
                for half in -12..=12 {
                    let offset = f64::from(half) * 0.5;
                    let weight = (-0.5 * (offset / 3.0_f64).powi(2)).exp();
                    let votes = weight * evidence.at(axes.image([along, middle + offset]));
                    if votes > best.0 {
                        best = (votes, offset);
                    }
                }
                row.votes.push(best.0);
                places.push(axes.image([along, middle + best.1]));
                let leaf = |v: i32| evidence.leaf_at(axes.image([along, middle + f64::from(v)]));
                let here = STEP * (-BAND..=BAND).map(leaf).sum::<f64>();
                let [sum, moment] = row.mass[k];
                row.mass.push([sum + here, moment + here * k as f64]);
            }
            (start, row)
        })
        .collect();
    let around = leaf_surroundings(&evidence, &places);
    let mut scores = around.iter().map(|numbers| usual.score(numbers));
    for (_, row) in &mut rows {
        row.crown = scores.by_ref().take(row.votes.len()).collect();
    }
    for plant in &plants {
        let [along, across] = axes.aligned(evidence.reduced(*plant));
        let nearest = (0..rows.len())
            .map(|k| ((across - curves[k].offset(along)).abs(), k))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((_, k)) = nearest.filter(|n| n.0 < 0.45 * apart.unwrap_or(40.0)) {
            let place = ((along - rows[k].0) / STEP).round();
            if place >= 0.0 && place < rows[k].1.votes.len() as f64 {
                rows[k].1.truth.push(place as usize);
            }
        }
    }
    let mut gaps = Vec::new();
    for (_, row) in &mut rows {
        row.truth.sort_unstable();
        for k in 1..row.truth.len() {
            row.truth[k] = row.truth[k].max(row.truth[k - 1] + 2);
        }
        let count = row.votes.len();
        row.truth.retain(|&place| place < count);
        gaps.extend(row.truth.windows(2).map(|w| ((w[1] - w[0]) as f64 * STEP, 1.0)));
    }
    let mut lengths: Vec<f64> = gaps.iter().map(|gap| gap.0).collect();
    lengths.sort_by(f64::total_cmp);
    let mut truth = Gaps { s: lengths[lengths.len() / 2], j: 0.16, m: 0.05, d: 0.03 };
    for _ in 0..10 {
        truth = truth.refit(&gaps, &WEAK);
    }
    let rows: Vec<Row> = rows.into_iter().map(|(_, row)| row).collect();
    let votes = || rows.iter().flat_map(|row| &row.votes);
    let places = votes().count() as f64;
    let mean = votes().sum::<f64>() / places;
    let middle = votes().map(|v| (v / mean).sqrt()).sum::<f64>() / places;
    let contrast = votes().map(|v| ((v / mean).sqrt() - middle).powi(2)).sum::<f64>() / places;
    let mass: f64 = rows.iter().filter_map(|row| row.mass.last()).map(|m| m[0]).sum();
    let length: f64 = reduced.iter().map(rows::Row::length_px).sum();
    let cover = mass / (length * f64::from(2 * BAND + 1));
    let leaf = evidence.leaf_area();
    let overall = [mean, mass / places, contrast.sqrt(), cover, (1.0 - mass / leaf).max(0.0)];
    Ok(Field { rows, overall, truth, start: start / factor })
}

/// Everything the score of a row is a linear function of.
pub(super) struct Features<'f> {
    pub(super) row: &'f Row,
    pub(super) heights: Vec<f64>,
    pub(super) places: Vec<[f64; PLACE]>,
    pub(super) of_gap: Vec<[f64; 4]>,
    pub(super) uncovered: f64,
    pub(super) absent: f64,
    pub(super) covered: usize,
    pub(super) truncated: usize,
    pub(super) free: usize,
}

impl<'f> Features<'f> {
    pub(super) fn new(field: &Field, row: &'f Row, gaps: &Gaps) -> Features<'f> {
        let [mean, mass, contrast, cover, outside] = field.overall;
        let (count, s) = (row.votes.len(), gaps.s);
        let running = |values: &[f64]| {
            let mut sums = vec![0.0];
            values.iter().for_each(|v| sums.push(sums[sums.len() - 1] + v));
            sums
        };
        let around = |sums: &[f64], at: usize, reach: usize| {
            let (from, to) = (at.saturating_sub(reach), (at + reach + 1).min(count));
            (sums[to] - sums[from]) / (to - from) as f64
        };
        let sums = running(&row.votes);
        let heights: Vec<f64> = (0..count)
            .map(|k| (row.votes[k].max(0.0) / (0.4 * around(&sums, k, 60) + 0.6 * mean)).sqrt())
            .collect();
        let sums = running(&heights);
        let (wide, narrow) = ((0.5 * s / STEP) as usize, ((0.3 * s / STEP) as usize).max(1));
        let size = (s / 13.0).ln();
        let (contrast, cover_) = (contrast - 0.4, cover - 0.5);
        let less = |k: usize| row.crown[k].clamp(-4.0, 0.0);
        let more = |k: usize| row.crown[k].clamp(0.0, 3.0);
        let places = (0..count)
            .map(|k| {
                let near = |d: i64| heights[(k as i64 + d).clamp(0, count as i64 - 1) as usize];
                let mean = |every: i64, reach: i64| {
                    let sum: f64 = (-reach..=reach).map(|n| near(n * every)).sum();
                    sum / (2 * reach + 1) as f64 - 1.0
                };
                let (x, local) = (heights[k] - 1.0, heights[k] - around(&sums, k, wide));
                let (from, to) = (k.saturating_sub(narrow), (k + narrow + 1).min(count));
                let here = (row.mass[to][0] - row.mass[from][0]) / (to - from) as f64 / mass;
                [
                    1.0,
                    x,
                    x * x,
                    local,
                    heights[k] - 0.5 * (near(-4) + near(4)),
                    heights[k] - 0.5 * (near(-8) + near(8)),
                    mean(1, 2),
                    mean(2, 3),
                    here.max(0.0).sqrt() - 1.0,
                    size,
                    contrast,
                    size * x,
                    contrast * x,
                    cover_,
                    cover_ * x,
                    contrast * local,
                    10.0 * (gaps.m - 0.07),
                    10.0 * (gaps.j - 0.15),
                    10.0 * (gaps.m - 0.07) * x,
                    10.0 * (gaps.j - 0.15) * x,
                    size * size,
                    outside - 0.3,
                    (outside - 0.3) * x,
                    less(k),
                    more(k),
                    size * less(k),
                    size * more(k),
                ]
            })
            .collect();
        let of_gap = (0..((MAX_PLANTS as f64 - 0.5) * s / STEP) as usize + 1)
            .map(|k| {
                let gap = k as f64 * STEP;
                let density = gaps.density(gap);
                let claimed = |range: f64| (-0.5 * (gap / range).powi(2)).exp();
                [density.ln(), gaps.double(gap) / density, claimed(2.0), claimed(0.35 * s)]
            })
            .collect();
        Features {
            row,
            heights,
            places,
            of_gap,
            uncovered: 1.0 / (cover * f64::from(2 * BAND + 1) * s) / (0.25 * s),
            absent: -gaps.m.ln() * STEP / s,
            covered: (0.6 * s / STEP) as usize,
            truncated: ((s / STEP) as usize).max(1),
            free: (0.7 * s / STEP) as usize,
        }
    }

    /// Whether no true gap is longer than those thought possible.
    pub(super) fn reach_the_truth(&self) -> bool {
        self.row.truth.windows(2).all(|w| w[1] - w[0] < self.of_gap.len())
    }

    /// Leaf mass between two places times its truncated distance from one of them.
    fn spread(&self, from: usize, to: usize, ahead: bool) -> f64 {
        if from >= to {
            return 0.0;
        }
        let between = |a: usize, b: usize| {
            let [first, last] = [self.row.mass[a], self.row.mass[b]];
            [last[0] - first[0], last[1] - first[1]]
        };
        let far = self.truncated as f64;
        let steps = if ahead {
            let turn = to.min(from + self.truncated);
            let near = between(from, turn);
            near[1] - from as f64 * near[0] + far * between(turn, to)[0]
        } else {
            let turn = from.max(to.saturating_sub(self.truncated));
            let near = between(turn, to);
            to as f64 * near[0] - near[1] + far * between(from, turn)[0]
        };
        steps * STEP
    }

    pub(super) fn pair(&self, a: usize, b: usize, valley: f64) -> [f64; PAIR] {
        let gap = b - a;
        let [density, double, near, far] = self.of_gap[gap];
        let lower = self.heights[a].min(self.heights[b]);
        let (depth, close) = (valley - lower, gap < self.covered);
        let open = if gap > 2 * self.covered {
            let middle = (a + b) / 2;
            self.spread(a + self.covered, middle, true)
                + self.spread(middle, b - self.covered, false)
        } else {
            0.0
        };
        let middling = !close && gap < 2 * self.covered + self.covered / 2;
        let more = self.row.crown[a].clamp(0.0, 3.0).min(self.row.crown[b].clamp(0.0, 3.0));
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

    /// What an end costs whatever the weights, and its uncovered mass.
    pub(super) fn end(&self, at: usize, first: bool) -> [f64; 2] {
        let count = self.heights.len();
        let (places, open) = if first {
            (at, self.spread(0, at.saturating_sub(self.covered), false))
        } else {
            (count - 1 - at, self.spread((at + self.covered).min(count), count, true))
        };
        [-self.absent * places.saturating_sub(self.free) as f64, self.uncovered * open]
    }
}
