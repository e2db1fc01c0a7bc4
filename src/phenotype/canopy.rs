//! Plants in closed canopies, from votes along leaf axes and dynamic programming along curved rows.
//!
//! 1. Votes for stalks ([`evidence`]), rows as they run ([`ridges`]), and the votes along every row
//!    ([`chain::Profile`]): at each place along the row the best votes across it, under a normal
//!    weight of [`ACROSS`] about the row.
//! 2. The spacing of the plants ([`renewal`]): from several starts, on some of the rows, alternating
//!    between the best plants and the gaps between them; the start with the highest score stays.
//! 3. The best plants of every row ([`chain::Chain::best`]). The worth `beta` of one plant more is found
//!    by bisection where their number is given, and is [`BETA`] otherwise.
//! 4. Probabilities of all places ([`chain::Chain::posterior`]) give each plant its confidence and its
//!    standard deviations, the field its count with an interval, and every gap the probability that
//!    plants are missing in it.
//!
//! Positions and lengths in pixels of the mask where the name ends in `_px`, else of the reduced grid.
//!
//! [`evidence`]: super::evidence
//! [`ridges`]: super::ridges
//! [`renewal`]: super::renewal

use super::{
    chain::{Chain, Posterior, Profile, STEP, Weights},
    evidence::Evidence,
    locate::LocateError,
    renewal::Spacing,
    ridges::{self, Ridge},
    rows::{Detection, Row, Rows},
};
use crate::{problems::plants::lines::Axes, raster::Mask};
use rayon::prelude::*;
use serde::Serialize;

/// Standard deviation of plants across their row.
const ACROSS: f64 = 2.0;
/// Share of the best offset across the row that is believed.
const BELIEVED: f64 = 0.6;
/// Worth of the votes: the square root of their ratio to what is usual.
const VOTES: f64 = 10.0;
/// Half the width of the band whose leaf mass a row has to cover.
const BAND: i32 = 8;
/// Places looked at beyond the ends of a row.
const BEYOND: f64 = 6.0;
/// Rows on which the spacing is estimated.
const SAMPLE: usize = 12;
/// Scores per unit of log probability, from synthetic fields.
const HEAT: f64 = 0.3;
/// What one plant more is worth where nobody says how many there are, from synthetic fields.
const BETA: f64 = 0.0;
/// The 97.5 % point of the standard normal distribution.
const NORMAL_95: f64 = 1.959_963_984_540_054;

/// One plant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Stalk {
    /// Position in the image.
    pub position_px: [f64; 2],
    /// Number of its row, counted across the rows.
    pub row: usize,
    /// Place along the rows.
    pub along_px: f64,
    /// Probability that a plant stands within a quarter of the spacing.
    pub confidence: f64,
    /// Standard deviation along the row.
    pub sigma_along_px: f64,
    /// Standard deviation across the row.
    pub sigma_across_px: f64,
}

/// A place between two plants of a row where some seem to be missing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Missing {
    /// Its row.
    pub row: usize,
    /// The middle of the gap, in the image.
    pub position_px: [f64; 2],
    /// Length of the gap.
    pub length_px: f64,
    /// The most probable number of missing plants, at least 1.
    pub plants: usize,
    /// Probability that any is missing.
    pub probability: f64,
}

/// What was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Canopy {
    /// The plants, by row and along the row.
    pub plants: Vec<Stalk>,
    /// The rows, straight as detected.
    pub rows: Rows,
    /// The spacing of the plants within their rows; its length in pixels of the mask.
    pub spacing: Spacing,
    /// Standard error of the spacing.
    pub spacing_sigma_px: f64,
    /// 95 % interval of the number of plants that the leaves alone suggest.
    pub count_interval: [f64; 2],
    /// Expected number of plants in each row.
    pub row_counts: Vec<f64>,
    /// Standard deviation of the number of plants in each row.
    pub row_count_sigmas: Vec<f64>,
    /// Gaps in which plants seem to be missing, by row and along the row.
    pub missing: Vec<Missing>,
}

/// Everything that the chains are made of.
struct Scene {
    evidence: Evidence,
    axes: Axes,
    rows: Vec<Row>,
    ridges: Vec<Ridge>,
    profiles: Vec<Profile>,
    /// Offset across its ridge of the best votes at every place of every row.
    offsets: Vec<Vec<f64>>,
    mean: f64,
    mass: f64,
    length: f64,
}

/// Finds plants in a mask whose rows are known; `count` of them, or as many as there seem to be.
///
/// # Errors
/// [`LocateError`]: an empty mask, no rows, no plants asked for, or more than fit into the rows.
pub fn locate(
    mask: &Mask,
    detection: &Detection,
    count: Option<usize>,
) -> Result<Canopy, LocateError> {
    if mask.data.iter().all(|&pixel| pixel == 0) {
        return Err(LocateError::EmptyMask);
    }
    if count == Some(0) {
        return Err(LocateError::NoPlants);
    }
    let rows = match detection {
        Detection::Found(rows) => rows,
        &Detection::NoRows { contrast, prominence } => {
            return Err(LocateError::NoRows { contrast, prominence });
        }
    };
    let scene = Scene::new(mask, rows);
    let spacing = scene.spacing(count);
    let chains = scene.chains(&spacing, 0..scene.profiles.len());
    let beta = match count {
        Some(count) => scene.worth_of(&chains, count)?,
        None => BETA,
    };
    let mut places = best(&chains, beta);
    let posteriors = posteriors(&chains, beta);
    if let Some(count) = count {
        keep_likeliest(&mut places, &posteriors, count);
    }
    let spacing = spacing.refit(&gaps(&places));
    Ok(scene.present(rows, &places, &chains, &posteriors, &spacing, beta))
}

fn best(chains: &[Chain<'_>], beta: f64) -> Vec<Vec<usize>> {
    chains.par_iter().map(|chain| chain.best(beta).0).collect()
}

fn posteriors(chains: &[Chain<'_>], beta: f64) -> Vec<Posterior> {
    chains.par_iter().map(|chain| chain.posterior(beta, HEAT)).collect()
}

fn total(places: &[Vec<usize>]) -> usize {
    places.iter().map(Vec::len).sum()
}

/// Gaps between the plants of the same row.
fn gaps(places: &[Vec<usize>]) -> Vec<f64> {
    let pairs = places.iter().flat_map(|row| row.windows(2));
    pairs.map(|pair| (pair[1] - pair[0]) as f64 * STEP).collect()
}

/// Drops the least likely plants beyond `count`.
fn keep_likeliest(places: &mut [Vec<usize>], posteriors: &[Posterior], count: usize) {
    let mut ranked: Vec<(f64, usize, usize)> = Vec::new();
    for (row, places) in places.iter().enumerate() {
        ranked.extend(
            places.iter().map(|&at| (around(&posteriors[row].marginals, at, 2).0, row, at)),
        );
    }
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    for &(_, row, at) in &ranked[..ranked.len().saturating_sub(count)] {
        places[row].retain(|&other| other != at);
    }
}

/// Probability within some steps of a place, and the mean square distance from it, in steps.
fn around(marginals: &[f64], at: usize, steps: usize) -> (f64, f64) {
    let (from, to) = (at.saturating_sub(steps), (at + steps + 1).min(marginals.len()));
    let (mut sum, mut square) = (0.0, 0.0);
    for (k, marginal) in (from..to).zip(&marginals[from..to]) {
        sum += marginal;
        square += marginal * (k as f64 - at as f64).powi(2);
    }
    (sum, square / sum.max(f64::MIN_POSITIVE))
}

impl Scene {
    fn new(mask: &Mask, rows: &Rows) -> Scene {
        let evidence = Evidence::new(mask, rows.axes.heading_rad);
        let factor = evidence.factor as f64;
        let axes = Axes { origin_px: evidence.reduced(rows.axes.origin_px), ..rows.axes };
        let shrink = |row: &Row| Row {
            across_px: row.across_px / factor,
            start_px: row.start_px / factor,
            end_px: row.end_px / factor,
            pixels: row.pixels,
        };
        let reduced: Vec<Row> = rows.rows.iter().map(shrink).collect();
        let spacing = rows.spacing_px.map(|spacing| spacing / factor);
        let ridges = ridges::trace(&evidence, &axes, &reduced, spacing);
        let read: Vec<(Profile, Vec<f64>)> =
            ridges.par_iter().map(|ridge| read(&evidence, &axes, ridge)).collect();
        let (profiles, offsets): (Vec<_>, Vec<_>) = read.into_iter().unzip();
        let votes: f64 = profiles.iter().flat_map(|profile| &profile.votes).sum();
        let places: usize = profiles.iter().map(|profile| profile.votes.len()).sum();
        let mass = profiles.iter().filter_map(|profile| profile.mass.last()).map(|m| m[0]).sum();
        let length = reduced.iter().map(Row::length_px).sum();
        let mean = votes / places.max(1) as f64;
        Scene { evidence, axes, rows: reduced, ridges, profiles, offsets, mean, mass, length }
    }

    fn chains(&self, spacing: &Spacing, rows: impl IntoIterator<Item = usize>) -> Vec<Chain<'_>> {
        let mass = self.mass * spacing.spacing / self.length.max(f64::MIN_POSITIVE);
        let weights = Weights { votes: VOTES, mean: self.mean, mass };
        rows.into_iter().map(|row| Chain::new(&self.profiles[row], spacing, &weights)).collect()
    }

    /// The spacing, from several starts on some of the rows.
    fn spacing(&self, count: Option<usize>) -> Spacing {
        let rows = self.rows.len();
        let every = rows.div_ceil(SAMPLE);
        let sample: Vec<usize> = (0..rows).step_by(every).collect();
        let length: f64 = sample.iter().map(|&row| self.rows[row].length_px()).sum();
        let starts: Vec<f64> = match count {
            Some(count) => [0.8, 1.0].map(|share| share * self.length / count as f64).to_vec(),
            None => (0..9).map(|k| 4.5 * 1.28_f64.powi(k)).collect(),
        };
        let wanted = count.map(|count| (count as f64 * length / self.length).round() as usize);
        let tried: Vec<(f64, Spacing)> = starts
            .par_iter()
            .map(|&start| {
                let mut spacing = Spacing::new(start);
                let mut score = f64::NEG_INFINITY;
                for _ in 0..4 {
                    let chains = self.chains(&spacing, sample.iter().copied());
                    let beta = wanted.map_or(BETA, |wanted| bisect(&chains, wanted).unwrap_or(0.0));
                    let found: Vec<_> = chains.iter().map(|chain| chain.best(beta)).collect();
                    let places: Vec<Vec<usize>> = found.iter().map(|f| f.0.clone()).collect();
                    let own = wanted.map_or(0.0, |_| beta * total(&places) as f64);
                    score = found.iter().map(|f| f.1).sum::<f64>() - own;
                    spacing = spacing.refit(&gaps(&places));
                }
                (score, spacing)
            })
            .collect();
        let first = (f64::NEG_INFINITY, Spacing::new(13.0));
        tried.into_iter().fold(first, |best, next| if next.0 > best.0 { next } else { best }).1
    }

    fn worth_of(&self, chains: &[Chain<'_>], count: usize) -> Result<f64, LocateError> {
        bisect(chains, count).ok_or_else(|| {
            let most = total(&best(chains, MOST_WORTH));
            LocateError::RowsTooShort { plants: count, most }
        })
    }

    fn image(&self, row: usize, at: usize, offset: f64) -> [f64; 2] {
        let along = self.profiles[row].start + at as f64 * STEP;
        let across = self.ridges[row].offset(along) + offset;
        self.evidence.full(self.axes.image([along, across]))
    }

    fn present(
        &self,
        rows: &Rows,
        places: &[Vec<usize>],
        chains: &[Chain<'_>],
        posteriors: &[Posterior],
        spacing: &Spacing,
        beta: f64,
    ) -> Canopy {
        let factor = self.evidence.factor as f64;
        let radius = ((0.25 * spacing.spacing / STEP) as usize).max(1);
        let (mut plants, mut missing) = (Vec::new(), Vec::new());
        for (row, places) in places.iter().enumerate() {
            for &at in places {
                let (confidence, square) = around(&posteriors[row].marginals, at, radius);
                let offset = BELIEVED * self.offsets[row][at];
                plants.push(Stalk {
                    position_px: self.image(row, at, offset),
                    row,
                    along_px: (self.profiles[row].start + at as f64 * STEP) * factor,
                    confidence: confidence.min(1.0),
                    // A place stands for a step around it.
                    sigma_along_px: (square + 1.0 / 12.0).sqrt() * STEP * factor,
                    sigma_across_px: (1.0 - BELIEVED).sqrt() * ACROSS * factor,
                });
            }
            for pair in places.windows(2) {
                let length = (pair[1] - pair[0]) as f64 * STEP;
                let shares = spacing.missing_in(length);
                let likely =
                    (1..shares.len()).fold(1, |a, b| if shares[b] > shares[a] { b } else { a });
                let probability = 1.0 - shares[0];
                if probability > 0.05 {
                    let middle = pair[0].midpoint(pair[1]);
                    let position_px = self.image(row, middle, 0.0);
                    let length_px = length * factor;
                    missing.push(Missing {
                        row,
                        position_px,
                        length_px,
                        plants: likely,
                        probability,
                    });
                }
            }
        }
        // The variance of a count is its derivative by the (heated) worth of a plant.
        let apart = 0.1 / HEAT;
        let (less, more) = rayon::join(
            || posteriors_counts(chains, beta - apart),
            || posteriors_counts(chains, beta + apart),
        );
        let variances: Vec<f64> =
            less.iter().zip(&more).map(|(a, b)| ((b - a) / 0.2).max(0.0)).collect();
        let found = total(places) as f64;
        let half = NORMAL_95 * variances.iter().sum::<f64>().sqrt();
        let singles = found.max(2.0) - 1.0;
        Canopy {
            plants,
            rows: rows.clone(),
            spacing: Spacing { spacing: spacing.spacing * factor, ..*spacing },
            spacing_sigma_px: spacing.jitter * spacing.spacing * factor / singles.sqrt(),
            count_interval: [(found - half).max(0.0), found + half],
            row_counts: posteriors.iter().map(|posterior| posterior.count).collect(),
            row_count_sigmas: variances.into_iter().map(f64::sqrt).collect(),
            missing,
        }
    }
}

fn posteriors_counts(chains: &[Chain<'_>], beta: f64) -> Vec<f64> {
    chains.par_iter().map(|chain| chain.posterior(beta, HEAT).count).collect()
}

/// The most that a plant can be worth.
const MOST_WORTH: f64 = 40.0;

/// The least worth of a plant at which the chains have `count` of them, nearly.
fn bisect(chains: &[Chain<'_>], count: usize) -> Option<f64> {
    let number = |beta: f64| total(&best(chains, beta));
    let (mut low, mut high) = (-MOST_WORTH, MOST_WORTH);
    // Usually it is near nothing.
    for near in [-6.0, 6.0] {
        match number(near) {
            n if n == count => return Some(near),
            n if n > count => high = high.min(near),
            _ => low = low.max(near),
        }
    }
    if high == MOST_WORTH && number(high) < count {
        return None;
    }
    for _ in 0..14 {
        let middle = 0.5 * (low + high);
        match number(middle) {
            n if n == count => return Some(middle),
            n if n > count => high = middle,
            _ => low = middle,
        }
    }
    Some(high)
}

/// Reads the votes along a row.
fn read(evidence: &Evidence, axes: &Axes, ridge: &Ridge) -> (Profile, Vec<f64>) {
    let start = ridge.start - BEYOND;
    let count = ((ridge.end + BEYOND - start) / STEP) as usize + 1;
    let (mut votes, mut offsets) = (Vec::with_capacity(count), Vec::with_capacity(count));
    let mut mass = vec![[0.0; 2]];
    let (mut sum, mut moment) = (0.0, 0.0);
    for k in 0..count {
        let along = start + k as f64 * STEP;
        let middle = ridge.offset(along);
        let mut best = (f64::NEG_INFINITY, 0.0);
        for half in -12..=12 {
            let offset = f64::from(half) * 0.5;
            let weight = (-0.5 * (offset / ACROSS).powi(2)).exp();
            let score = weight * evidence.at(axes.image([along, middle + offset]));
            if score > best.0 {
                best = (score, offset);
            }
        }
        votes.push(best.0);
        offsets.push(best.1);
        let leaf = |across: i32| evidence.leaf_at(axes.image([along, middle + f64::from(across)]));
        let here = STEP * (-BAND..=BAND).map(leaf).sum::<f64>();
        sum += here;
        moment += here * k as f64;
        mass.push([sum, moment]);
    }
    (Profile { start, votes, mass }, offsets)
}
