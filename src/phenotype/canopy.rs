//! Plants in closed canopies, from votes along leaf axes and dynamic programming along curved rows.
//!
//! 1. Votes for stalks ([`evidence`]), rows as they run ([`ridges`]), and the votes along every row
//!    ([`chain::Profile`]): at each place along the row the best votes across it, under a normal
//!    weight about the row.
//! 2. The spacing of the plants ([`renewal`]), on some of the rows: where the number of plants is not
//!    given, the one with the largest marginal likelihood ([`chain::Chain::log_sum`]); then alternating
//!    between the best plants and the gaps between them.
//! 3. The best plants of every row ([`chain::Chain::best`]). The worth `beta` of one plant more is found
//!    by bisection where their number is given, and is set by [`Options`] otherwise.
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
    stand::{Canopy, Missing, NORMAL_95, Stalk},
};
use crate::{problems::plants::lines::Axes, raster::Mask};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Half the width of the band whose leaf mass a row has to cover.
const BAND: i32 = 8;
/// Places looked at beyond the ends of a row.
const BEYOND: f64 = 6.0;
/// Length of the rows on which the spacing is estimated, about.
const SAMPLE: f64 = 6000.0;
/// Rounds in which the spacing is estimated.
const ROUNDS: usize = 4;
/// The spacings that are tried where nobody says how many plants there are, from the finest on.
const SPACINGS: i32 = 33;
/// The finest of them.
const FINEST: f64 = 4.5;
/// Ratio of one to the next.
const FINER: f64 = 1.075;

/// How plants are found. Lengths in pixels of the reduced grid (about a third of a leaf's width).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Options {
    /// Votes along leaf axes; else the leaf mass around a place is the evidence.
    pub leaf_axes: bool,
    /// Rows are followed where they bend.
    pub curved_rows: bool,
    /// Standard deviation of plants across their row, to begin with.
    pub across: f64,
    /// That is re-estimated from the plants found.
    pub estimate_across: bool,
    /// Share of the best offset across the row that is believed.
    pub believed: f64,
    /// Worth of the votes: of the square root of their ratio to what is usual.
    pub votes: f64,
    /// Weight of the leaf mass that no plant covers, in terms per plant.
    pub cover: f64,
    /// Scores per unit of log probability.
    pub heat: f64,
    /// What one plant more is worth where nobody says how many there are.
    pub beta: f64,
    /// What one plant more is worth while spacings are compared.
    pub beta_compared: f64,
    /// Plants stand at their mean place under all the probable ones, else at the best one.
    pub mean_place: bool,
    /// The relative jitter of the spacing is estimated; else it is the prior's.
    pub estimate_spacing: bool,
}

impl Default for Options {
    fn default() -> Options {
        Options {
            leaf_axes: true,
            curved_rows: true,
            across: 3.0,
            estimate_across: false,
            believed: 0.7,
            votes: 12.0,
            cover: 1.0,
            heat: 0.5,
            beta: 1.1,
            beta_compared: 0.7,
            mean_place: true,
            estimate_spacing: true,
        }
    }
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
    options: Options,
}

/// Finds plants in a mask whose rows are known; `count` of them, or as many as there seem to be.
///
/// # Errors
/// [`LocateError`]: an empty mask, no rows, no plants asked for, or more than fit into the rows.
pub fn locate(
    mask: &Mask,
    detection: &Detection,
    count: Option<usize>,
    options: &Options,
) -> Result<Canopy, LocateError> {
    if mask.data.iter().all(|&pixel| pixel == 0) {
        return Err(LocateError::EmptyMask);
    }
    if count == Some(0) {
        return Err(LocateError::NoPlants);
    }
    let pixels = mask.data.iter().filter(|&&pixel| pixel != 0).count();
    if let Some(plants) = count.filter(|&count| count > pixels) {
        return Err(LocateError::TooManyPlants { plants, pixels });
    }
    let rows = match detection {
        Detection::Found(rows) => rows,
        &Detection::NoRows { contrast, prominence } => {
            return Err(LocateError::NoRows { contrast, prominence });
        }
    };
    let mut scene = Scene::new(mask, rows, options);
    let spacing = scene.spacing(count);
    if options.estimate_across {
        scene.widen(&spacing, count);
    }
    let chains = scene.chains(&spacing, 0..scene.profiles.len());
    let beta = match count {
        Some(count) => worth_of(&chains, count)?,
        None => options.beta,
    };
    let mut places = best(&chains, beta);
    let posteriors = posteriors(&chains, beta, options.heat);
    if let Some(count) = count {
        keep_likeliest(&mut places, &posteriors, count);
    }
    let spacing = spacing.refit(&gaps(&places));
    Ok(scene.present(rows, &places, &chains, &posteriors, &spacing, beta))
}

fn best(chains: &[Chain<'_>], beta: f64) -> Vec<Vec<usize>> {
    chains.par_iter().map(|chain| chain.best(beta).0).collect()
}

fn posteriors(chains: &[Chain<'_>], beta: f64, heat: f64) -> Vec<Posterior> {
    chains.par_iter().map(|chain| chain.posterior(beta, heat)).collect()
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
            places.iter().map(|&at| (around(&posteriors[row].marginals, at, 2)[0], row, at)),
        );
    }
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    for &(_, row, at) in &ranked[..ranked.len().saturating_sub(count)] {
        places[row].retain(|&other| other != at);
    }
}

/// What is probable within some steps of a place: a plant at all, its mean offset, its variance.
fn around(marginals: &[f64], at: usize, steps: usize) -> [f64; 3] {
    let (from, to) = (at.saturating_sub(steps), (at + steps + 1).min(marginals.len()));
    let (mut sum, mut first, mut second) = (0.0, 0.0, 0.0);
    for (k, marginal) in (from..to).zip(&marginals[from..to]) {
        let away = k as f64 - at as f64;
        sum += marginal;
        first += marginal * away;
        second += marginal * away * away;
    }
    let mean = first / sum.max(f64::MIN_POSITIVE);
    [sum, mean, (second / sum.max(f64::MIN_POSITIVE) - mean * mean).max(0.0)]
}

impl Scene {
    fn new(mask: &Mask, rows: &Rows, options: &Options) -> Scene {
        let evidence = if options.leaf_axes {
            Evidence::new(mask, rows.axes.heading_rad)
        } else {
            Evidence::of_mass(mask)
        };
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
        let ridges = if options.curved_rows {
            ridges::trace(&evidence, &axes, &reduced, spacing)
        } else {
            reduced.iter().map(Ridge::straight).collect()
        };
        let length = reduced.iter().map(Row::length_px).sum();
        let mut scene = Scene {
            evidence,
            axes,
            rows: reduced,
            ridges,
            profiles: Vec::new(),
            offsets: Vec::new(),
            mean: 0.0,
            mass: 0.0,
            length,
            options: *options,
        };
        scene.read();
        scene
    }

    /// Reads what every row shows.
    fn read(&mut self) {
        let Scene { evidence, axes, ridges, options, .. } = self;
        let read: Vec<(Profile, Vec<f64>)> =
            ridges.par_iter().map(|ridge| read(evidence, axes, ridge, options.across)).collect();
        (self.profiles, self.offsets) = read.into_iter().unzip();
        let profiles = &self.profiles;
        let votes: f64 = profiles.iter().flat_map(|profile| &profile.votes).sum();
        let places: usize = profiles.iter().map(|profile| profile.votes.len()).sum();
        self.mass = profiles.iter().filter_map(|profile| profile.mass.last()).map(|m| m[0]).sum();
        self.mean = votes / places.max(1) as f64;
    }

    /// Estimates how far plants stand across their rows, and reads the rows again.
    fn widen(&mut self, spacing: &Spacing, count: Option<usize>) {
        for _ in 0..2 {
            let sample = self.sample();
            let chains = self.chains(spacing, sample.iter().copied());
            let beta = match count.map(|count| self.share(count, &sample)) {
                Some(wanted) => bisect(&chains, wanted).unwrap_or(0.0),
                None => self.options.beta,
            };
            let (mut sum, mut number) = (0.0, 0.0);
            for (&row, places) in sample.iter().zip(best(&chains, beta)) {
                sum += places.iter().map(|&at| self.offsets[row][at].powi(2)).sum::<f64>();
                number += places.len() as f64;
            }
            // The weight narrows what it sees: a precision is that of the offsets less its own.
            let seen = (sum + 20.0) / (number + 20.0);
            let across = (1.0 / (1.0 / seen - 0.5 / self.options.across.powi(2)).max(0.02)).sqrt();
            self.options.across = across.clamp(1.0, 5.0);
            self.read();
        }
    }

    /// Some of the rows, evenly.
    fn sample(&self) -> Vec<usize> {
        let rows = (SAMPLE * self.rows.len() as f64 / self.length).ceil().max(1.0) as usize;
        (0..self.rows.len()).step_by(self.rows.len().div_ceil(rows).max(1)).collect()
    }

    /// How many of `count` plants belong to some of the rows.
    fn share(&self, count: usize, rows: &[usize]) -> usize {
        let length: f64 = rows.iter().map(|&row| self.rows[row].length_px()).sum();
        (count as f64 * length / self.length).round() as usize
    }

    fn chains(&self, spacing: &Spacing, rows: impl IntoIterator<Item = usize>) -> Vec<Chain<'_>> {
        let mass = self.mass * spacing.spacing / self.length.max(f64::MIN_POSITIVE);
        let Options { votes, cover, .. } = self.options;
        let weights = Weights { votes, cover, mean: self.mean, mass };
        rows.into_iter().map(|row| Chain::new(&self.profiles[row], spacing, &weights)).collect()
    }

    /// The spacing, from several starts on some of the rows.
    fn spacing(&self, count: Option<usize>) -> Spacing {
        let sample = self.sample();
        let wanted = count.map(|count| self.share(count, &sample));
        let starts = match count {
            Some(count) => [0.8, 1.0].map(|share| share * self.length / count as f64).to_vec(),
            None => vec![self.likeliest_spacing(&sample)],
        };
        let tried: Vec<(f64, Spacing)> = starts
            .par_iter()
            .map(|&start| {
                let mut spacing = Spacing::new(start);
                let mut score = f64::NEG_INFINITY;
                for _ in 0..ROUNDS {
                    let chains = self.chains(&spacing, sample.iter().copied());
                    let beta = match wanted {
                        Some(wanted) => bisect(&chains, wanted).unwrap_or(0.0),
                        None => self.options.beta,
                    };
                    let found: Vec<_> = chains.iter().map(|chain| chain.best(beta)).collect();
                    let places: Vec<Vec<usize>> = found.iter().map(|f| f.0.clone()).collect();
                    let own = beta * total(&places) as f64;
                    score = found.iter().map(|f| f.1).sum::<f64>() - own;
                    let refit = spacing.refit(&gaps(&places));
                    spacing = if self.options.estimate_spacing {
                        refit
                    } else {
                        Spacing { spacing: refit.spacing, ..Spacing::new(start) }
                    };
                }
                (score, spacing)
            })
            .collect();
        let first = (f64::NEG_INFINITY, Spacing::new(13.0));
        tried.into_iter().fold(first, |best, next| if next.0 > best.0 { next } else { best }).1
    }

    /// The spacing under which the rows are likeliest, all sets of plants taken together.
    fn likeliest_spacing(&self, sample: &[usize]) -> f64 {
        let tried: Vec<(f64, f64)> = (0..SPACINGS)
            .into_par_iter()
            .map(|k| {
                let spacing = FINEST * FINER.powi(k);
                let chains = self.chains(&Spacing::new(spacing), sample.iter().copied());
                let sum: f64 =
                    chains.iter().map(|chain| chain.log_sum(self.options.beta_compared, 1.0)).sum();
                (sum, spacing)
            })
            .collect();
        let first = (f64::NEG_INFINITY, FINEST);
        tried.into_iter().fold(first, |best, next| if next.0 > best.0 { next } else { best }).1
    }

    fn image(&self, row: usize, at: f64, offset: f64) -> [f64; 2] {
        let along = self.profiles[row].start + at * STEP;
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
        let Options { believed, across, heat, .. } = self.options;
        let radius = ((0.25 * spacing.spacing / STEP) as usize).max(1);
        let (mut plants, mut missing) = (Vec::new(), Vec::new());
        for (row, places) in places.iter().enumerate() {
            for &at in places {
                let [confidence, mean, variance] = around(&posteriors[row].marginals, at, radius);
                let place = at as f64 + if self.options.mean_place { mean } else { 0.0 };
                let offset = believed * self.offsets[row][at];
                plants.push(Stalk {
                    position_px: self.image(row, place, offset),
                    row,
                    along_px: (self.profiles[row].start + place * STEP) * factor,
                    confidence: confidence.min(1.0),
                    // A place stands for a step around it.
                    sigma_along_px: (variance + 1.0 / 12.0).sqrt() * STEP * factor,
                    sigma_across_px: (1.0 - believed).sqrt() * across * factor,
                });
            }
            for pair in places.windows(2) {
                let length = (pair[1] - pair[0]) as f64 * STEP;
                let shares = spacing.missing_in(length);
                let likely =
                    (1..shares.len()).fold(1, |a, b| if shares[b] > shares[a] { b } else { a });
                let probability = 1.0 - shares[0];
                if probability > 0.05 {
                    let middle = 0.5 * (pair[0] + pair[1]) as f64;
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
        let apart = 0.1 / heat;
        let (less, more) = rayon::join(
            || posterior_counts(chains, beta - apart, heat),
            || posterior_counts(chains, beta + apart, heat),
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

fn posterior_counts(chains: &[Chain<'_>], beta: f64, heat: f64) -> Vec<f64> {
    chains.par_iter().map(|chain| chain.posterior(beta, heat).count).collect()
}

/// What a plant has to be worth for there to be `count` of them.
fn worth_of(chains: &[Chain<'_>], count: usize) -> Result<f64, LocateError> {
    bisect(chains, count).ok_or_else(|| {
        let most = total(&best(chains, MOST_WORTH));
        LocateError::RowsTooShort { plants: count, most }
    })
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
fn read(evidence: &Evidence, axes: &Axes, ridge: &Ridge, scatter: f64) -> (Profile, Vec<f64>) {
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
            let weight = (-0.5 * (offset / scatter).powi(2)).exp();
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
