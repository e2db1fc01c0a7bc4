//! What the rows of a mask show, and the plants that are best for it: the working parts of
//! [`super::row_model`].
//!
//! All lengths in pixels of the reduced grid of [`Evidence`].

use super::{
    double_plants::{PlantBaseline, leaf_surroundings},
    evidence::{self, Evidence},
    isolated_plants,
    locate::LocateError,
    plant_spacing::Spacing,
    row_curves::{self, RowCurve},
    row_model::RowModelOptions,
    row_parts::{self, Part},
    row_profile::{Across, BAND, Profile, STEP, read},
    rows::{Row, Rows},
    stand_count::{
        Lattice, Overall, RowFeatures, RowPosterior, Weights, likeliest_places, log_odds_of,
        row_posteriors,
    },
};
use crate::problems::plants::lines::Axes;
use rayon::prelude::*;
use rowgram_raster::Mask;

/// A spacing this many times finer than another may be that of the leaves of a plant.
const LEAVES: f64 = 1.9;
/// A spacing below this many widths of leaves is improbable, and the number of plants then in doubt: the logarithm of spacing over width has half of a
/// normal distribution below it.
pub(super) const LEAVES_APART: f64 = 1.4;
/// Standard deviation of that. Both were chosen on masks that are drawn, drawn with wider leaves, and of maps (docs/decisions.md).
const LEAVES_APART_SD: f64 = 0.3;
/// Length of row whose likelihood tells the spacing, however long all rows are: votes of neighbouring places are much the same. Fitted
/// on the same masks.
const EVIDENCE_PX: f64 = 168.0;
/// Spacing of isolated plants as shares of the distance of their patches of leaf, some of which are two plants.
const PATCHES: [f64; 2] = [0.7, 1.3];
/// Distance of neighbouring plants on a grid that is coarser than the mask, at least: about the average of the 160 drawn masks to which the stand count
/// was fitted, 13.4 (`experiments fit-stand-count`). The nearest factor instead of the one below gives F1 .925 instead of .929 on maps of nine flights
/// with the weights for narrow leaves, and .901 instead of .896 on 48 drawn masks of 0.5 to 2 cm a pixel.
const MIN_SPACING_PX: f64 = 13.0;
/// Length of the rows on which the spacing is estimated, about.
const SAMPLE: f64 = 6000.0;
/// Length of the rows that show what is usual of plants, and what a plant is worth where their number is given, about.
const COUNTED: f64 = 24_000.0;
/// Rounds in which the spacing is estimated.
const ROUNDS: usize = 4;
/// The spacings that are tried where nobody says how many plants there are, from the finest on.
const SPACINGS: i32 = 33;
/// The finest of them.
const FINEST: f64 = 4.5;
/// Ratio of one to the next.
const FINER: f64 = 1.075;

/// Standard deviation of the normal weight under which the probability of a plant is summed, in spacings. F1 within 5 px on 128 synthetic masks that took no part in
/// fitting the weights (docs/decisions.md) is 0.958, 0.959, 0.959 with 0.15, 0.2, 0.25.
const TOGETHER: f64 = 0.2;
/// The spacing of plants whose number is given, over the length of the rows for each: some places are without a plant. A first choice, from which the
/// spacing is estimated; others were not compared.
const SPACING_SHARE: f64 = 0.9;

/// Votes hardly held to the row: standard deviation of the weight across it.
const WIDE: f64 = 6.0;
/// Offset (RMS) of such votes for plants in line: at least, and how much more per unit of spacing below a third number,
/// where neighbours take part in them. Chosen by F1 at 5 cm on ten synthetic masks of each of five scenarios
/// (mid20, and that with crooked, tilted, turned and rough rows).
const IN_LINE: [f64; 3] = [1.2, 0.2, 13.0];
/// Scatter of plants across their rows for one of an offset beyond that.
const SCATTER_OF_EXCESS: f64 = 5.0;

/// Everything that plants are found by.
pub(super) struct RowEvidence<'m> {
    pub(super) evidence: Evidence<'m>,
    axes: Axes,
    /// The rows, or the parts of rows that have plants.
    pub(super) parts: Vec<Part>,
    pub(super) profiles: Vec<Profile>,
    mean: f64,
    mass: f64,
    length: f64,
    /// Width of leaves, in pixels of the reduced grid.
    leaf_width: f64,
    /// Distance of isolated plants, in pixels of the reduced grid.
    isolated_spacing: Option<f64>,
    pub(super) options: RowModelOptions,
}

impl<'m> RowEvidence<'m> {
    /// The evidence of rows and the spacing of their plants, on a grid as coarse as votes work best with for leaves of this width, or finer where plants
    /// would be less than [`MIN_SPACING_PX`] apart: on a map made from photos leaves are wide even where plants are close together.
    pub(super) fn with_spacing(
        mask: &'m Mask,
        rows: &Rows,
        count: Option<usize>,
        options: &RowModelOptions,
    ) -> (RowEvidence<'m>, Spacing) {
        let isolated_px = isolated_plants::spacing_px(mask, rows);
        let stroke_px = evidence::stroke_px(mask);
        let mut factor = evidence::factor(stroke_px).max(isolated_px.map_or(1, grid_factor));
        loop {
            let evidence = RowEvidence::new(mask, rows, factor, (stroke_px, isolated_px), options);
            let spacing = evidence.spacing(count);
            let wanted = grid_factor(spacing.spacing * factor as f64);
            if wanted >= factor {
                return (evidence, spacing);
            }
            factor = wanted;
        }
    }

    fn new(
        mask: &'m Mask,
        rows: &Rows,
        factor: usize,
        (stroke_px, isolated_px): (f64, Option<f64>),
        options: &RowModelOptions,
    ) -> RowEvidence<'m> {
        let evidence = Evidence::new(mask, rows.axes.heading_rad, factor);
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
        let whole = row_curves::trace(&evidence, &axes, &reduced, spacing).into_iter().enumerate();
        let parts: Vec<Part> =
            whole.map(|(row, curve)| Part { row, curve, before: None }).collect();
        let length = parts.iter().map(|part| part.curve.length()).sum();
        let mut scene = RowEvidence {
            evidence,
            axes,
            parts,
            profiles: Vec::new(),
            mean: 0.0,
            mass: 0.0,
            length,
            leaf_width: stroke_px / factor,
            isolated_spacing: isolated_px.map(|spacing| spacing / factor),
            options: *options,
        };
        scene.read();
        scene
    }

    /// Reads what every row shows.
    pub(super) fn read(&mut self) {
        let RowEvidence { evidence, axes, parts, options, .. } = self;
        let across = Across::new(axes, options.across_sigma);
        // Profiles of a large map take much memory: the old ones are freed before there are new ones.
        self.profiles.clear();
        self.profiles =
            parts.par_iter().map(|part| read(evidence, axes, &part.curve, &across)).collect();
        let profiles = &self.profiles;
        let votes: f64 = profiles.iter().flat_map(|profile| &profile.votes).sum();
        let places: usize = profiles.iter().map(|profile| profile.votes.len()).sum();
        self.mass = profiles.iter().filter_map(|profile| profile.mass.last()).map(|m| m[0]).sum();
        self.mean = votes / places.max(1) as f64;
    }

    /// Cuts rows where they have no leaf for some spacings, and reads what is left.
    pub(super) fn cut(&mut self, spacing: &Spacing) {
        let mass = self.mass_of_plant(spacing);
        let curves: Vec<RowCurve> = self.parts.iter().map(|part| part.curve.clone()).collect();
        let parts = row_parts::cut(&self.profiles, &curves, spacing.spacing, mass);
        if parts.iter().all(|part| part.before.is_none() && curves[part.row] == part.curve) {
            return;
        }
        self.length = parts.iter().map(|part| part.curve.length()).sum();
        self.parts = parts;
        self.read();
    }

    /// Leaf mass of a plant.
    fn mass_of_plant(&self, spacing: &Spacing) -> f64 {
        self.mass * spacing.spacing / self.length.max(f64::MIN_POSITIVE)
    }

    /// Some of the rows, evenly.
    pub(super) fn sample(&self, length: f64) -> Vec<usize> {
        let rows = (length * self.parts.len() as f64 / self.length).ceil().max(1.0) as usize;
        (0..self.parts.len()).step_by(self.parts.len().div_ceil(rows).max(1)).collect()
    }

    /// The spacing of plants whose number is given, or the likeliest one.
    fn spacing(&self, count: Option<usize>) -> Spacing {
        let (sample, overall) = (self.sample(SAMPLE), self.overall());
        let first = match count {
            Some(count) => SPACING_SHARE * self.length / count as f64,
            None => self.likeliest_spacing(&sample),
        };
        (0..ROUNDS).fold(Spacing::new(first), |spacing, _| {
            let best = |&row: &usize| self.by_hand(row, &overall, &spacing).best();
            let places: Vec<Vec<usize>> = sample.par_iter().map(best).collect();
            spacing.refit(&gaps(&places))
        })
    }

    /// The scores of a row by weights by hand.
    fn by_hand(&self, row: usize, overall: &Overall, spacing: &Spacing) -> Lattice {
        let features = RowFeatures::new(&self.profiles[row], overall, spacing);
        Lattice::new(&features, &Weights::by_hand())
    }

    /// Some of the rows, and what they show.
    fn counted(&self) -> (Vec<usize>, Vec<&Profile>) {
        let rows = self.sample(COUNTED);
        let profiles = rows.iter().map(|&row| &self.profiles[row]).collect();
        (rows, profiles)
    }

    /// The probabilities of the plants of all rows; of `count` plants, or of as many as there seem to be.
    pub(super) fn posteriors(
        &self,
        spacing: &Spacing,
        count: Option<usize>,
    ) -> Result<Vec<RowPosterior>, LocateError> {
        let overall = self.overall();
        let plant_log_odds = match count {
            None => 0.0,
            Some(count) => {
                let (rows, profiles) = self.counted();
                let length: f64 = rows.iter().map(|&row| self.parts[row].curve.length()).sum();
                let of_these = (count as f64 * length / self.length).round() as usize;
                log_odds_of(of_these, &profiles, &overall, spacing)?
            }
        };
        let profiles: Vec<&Profile> = self.profiles.iter().collect();
        Ok(row_posteriors(&profiles, &overall, spacing, plant_log_odds)?)
    }

    /// The places of so many plants; of fewer where the rows have no more.
    pub(super) fn places(
        posteriors: &[RowPosterior],
        spacing: &Spacing,
        count: usize,
    ) -> Vec<Vec<usize>> {
        likeliest_places(posteriors, TOGETHER * spacing.spacing / STEP, count)
    }

    /// What all rows show together.
    pub(super) fn overall(&self) -> Overall {
        let places: usize = self.profiles.iter().map(|profile| profile.votes.len()).sum();
        let heights = || {
            let votes = self.profiles.iter().flat_map(|profile| &profile.votes);
            votes.map(|votes| (votes.max(0.0) / self.mean.max(f64::MIN_POSITIVE)).sqrt())
        };
        let middle = heights().sum::<f64>() / places.max(1) as f64;
        let variance = heights().map(|h| (h - middle).powi(2)).sum::<f64>() / places.max(1) as f64;
        let leaf = self.evidence.leaf_area();
        Overall {
            mean: self.mean,
            outside: (1.0 - self.mass / leaf.max(f64::MIN_POSITIVE)).max(0.0),
            mass: self.mass / places.max(1) as f64,
            contrast: variance.sqrt(),
            leaf_width: self.leaf_width,
            cover: self.mass / (self.length * f64::from(2 * BAND + 1)).max(f64::MIN_POSITIVE),
        }
    }

    /// The row that a place of the image is on, within `reach` of its middle, and the step along it.
    pub(super) fn nearest(&self, position_px: [f64; 2], reach: f64) -> Option<(usize, usize)> {
        let [along, across] = self.axes.aligned(self.evidence.reduced(position_px));
        let steps = |row: usize| ((along - self.profiles[row].start) / STEP).round();
        (0..self.parts.len())
            .filter(|&row| (0.0..self.profiles[row].votes.len() as f64).contains(&steps(row)))
            .map(|row| ((across - self.parts[row].curve.offset(along)).abs(), row))
            .filter(|(off, _)| *off < reach)
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .map(|(_, row)| (row, steps(row) as usize))
    }

    /// The most probable spacing: rows are likely under it, all sets of plants taken together, and leaves are not too wide for it.
    ///
    /// Where leaves of a plant can pass for plants there are two such spacings, and a worth of every plant,
    /// which makes up for what evidence lacks in a closed canopy, favours the finer one by how many more plants
    /// it has: against a peak that is [`LEAVES`] times as coarse it does not count.
    fn likeliest_spacing(&self, sample: &[usize]) -> f64 {
        let overall = self.overall();
        let length: f64 = sample.iter().map(|&row| self.parts[row].curve.length()).sum();
        // One spacing after the other: the scores of a long row at the coarsest take 170 MB (43,000 places).
        let mut tried: Vec<(f64, f64)> = (0..SPACINGS)
            .map(|k| {
                let spacing = FINEST * FINER.powi(k);
                let plants = Spacing::new(spacing);
                let log_sum = |&row: &usize| self.by_hand(row, &overall, &plants).log_sum();
                let sums: Vec<f64> = sample.par_iter().map(log_sum).collect();
                (sums.iter().sum(), spacing)
            })
            .collect();
        if let Some(apart) = self.isolated_spacing {
            let within = PATCHES[0] * apart..=PATCHES[1] * apart;
            tried.retain(|(_, spacing)| within.contains(spacing));
        }
        let crowded = |spacing: f64| {
            let over = (spacing / (LEAVES_APART * self.leaf_width)).ln().min(0.0);
            0.5 * (over / LEAVES_APART_SD).powi(2)
        };
        let score = |k: usize| {
            let (likelihood, spacing) = tried[k];
            (EVIDENCE_PX / length).min(1.0) * likelihood - crowded(spacing)
        };
        let likeliest = (0..tried.len()).max_by(|&a, &b| score(a).total_cmp(&score(b)));
        let Some(likeliest) = likeliest else { return FINEST };
        let peak = |k: &usize| {
            let over = |other: Option<&(f64, f64)>| other.is_none_or(|o| o.0 <= tried[*k].0);
            over(k.checked_sub(1).and_then(|k| tried.get(k))) && over(tried.get(k + 1))
        };
        let bare = |k: usize| tried[k].0 - Weights::PLANT * length / tried[k].1;
        let coarser = |k: &usize| tried[*k].1 > LEAVES * tried[likeliest].1;
        let rivals = (0..tried.len()).filter(peak).filter(coarser);
        tried[rivals.fold(likeliest, |best, k| if bare(k) > bare(best) { k } else { best })].1
    }

    /// Compares the leaves around all places with those around the best plants of some rows, which are found without that.
    pub(super) fn compare_with_plants(&mut self, spacing: &Spacing) {
        let overall = self.overall();
        let best: Vec<(usize, Vec<usize>)> = self
            .sample(COUNTED)
            .into_par_iter()
            .map(|row| (row, self.by_hand(row, &overall, spacing).best()))
            .collect();
        let mut plants = vec![vec![]; self.profiles.len()];
        for (row, places) in best {
            plants[row] = places;
        }
        self.compare_surroundings(&plants);
    }

    /// Looks at the leaves around every other place, which are compared with those of these plants.
    fn compare_surroundings(&mut self, places: &[Vec<usize>]) {
        let place = |row: usize, at: usize| {
            let profile = &self.profiles[row];
            let along = profile.start + at as f64 * STEP;
            let across = self.parts[row].curve.offset(along) + profile.offsets[at];
            self.axes.image([along, across])
        };
        let looked_at: Vec<[f64; 2]> = (0..self.profiles.len())
            .flat_map(|row| {
                let last = self.profiles[row].votes.len() - 1;
                (0..=last / 2).map(move |k| place(row, (2 * k + 1).min(last)))
            })
            .collect();
        let all = leaf_surroundings(&self.evidence, &looked_at);
        let mut rows: Vec<&[_]> = vec![];
        let mut rest = &all[..];
        for profile in &self.profiles {
            let (row, after) = rest.split_at(profile.votes.len().div_ceil(2));
            rows.push(row);
            rest = after;
        }
        let plants: Vec<_> = places
            .iter()
            .zip(&rows)
            .flat_map(|(places, row)| places.iter().map(|&at| row[at / 2]))
            .collect();
        let usual = PlantBaseline::new(&plants);
        for (profile, row) in self.profiles.iter_mut().zip(rows) {
            profile.surroundings = row.iter().map(|place| usual.score(place)).collect();
        }
    }

    /// The offset across its row of the best votes at a place.
    fn offset(&self, row: usize, at: f64, across: &Across) -> f64 {
        let along = self.profiles[row].start + at * STEP;
        across.best(&self.evidence, along, self.parts[row].curve.offset(along)).1
    }

    /// The offsets of the plants of every row, under a normal weight of this scatter.
    pub(super) fn offsets(&self, places: &[Vec<usize>], scatter: f64) -> Vec<Vec<f64>> {
        let across = Across::new(&self.axes, scatter);
        let of_row = |(row, places): (usize, &Vec<usize>)| {
            places.iter().map(|&at| self.offset(row, at as f64, &across)).collect()
        };
        places.iter().enumerate().map(of_row).collect()
    }

    /// How far plants scatter across their rows, once their places along them are known: more than is usual where the
    /// best votes, hardly held to the row, are further off it than those of plants in line are at that spacing.
    pub(super) fn scatter(&self, places: &[Vec<usize>], spacing: f64) -> f64 {
        let usual = self.options.across_sigma;
        let (mut sum, mut count) = (0.0, 0.0);
        for offset in self.offsets(places, WIDE).iter().flatten() {
            sum += offset * offset;
            count += 1.0;
        }
        let in_line = IN_LINE[0] + IN_LINE[1] * (IN_LINE[2] - spacing).max(0.0);
        let excess = (sum / f64::max(count, 1.0)).sqrt() - in_line;
        (usual + SCATTER_OF_EXCESS * excess.max(0.0)).min(usual.max(WIDE))
    }

    pub(super) fn image(&self, row: usize, at: f64, offset: f64) -> [f64; 2] {
        let along = self.profiles[row].start + at * STEP;
        let across = self.parts[row].curve.offset(along) + offset;
        self.evidence.full(self.axes.image([along, across]))
    }
}

pub(super) fn total(places: &[Vec<usize>]) -> usize {
    places.iter().map(Vec::len).sum()
}

/// The greatest whole factor by which a grid can be coarser than the mask with neighbouring plants still [`MIN_SPACING_PX`] apart.
fn grid_factor(spacing_px: f64) -> usize {
    (spacing_px / MIN_SPACING_PX).max(1.0) as usize
}

/// Gaps between the plants of the same row.
pub(super) fn gaps(places: &[Vec<usize>]) -> Vec<f64> {
    let pairs = places.iter().flat_map(|row| row.windows(2));
    pairs.map(|pair| (pair[1] - pair[0]) as f64 * STEP).collect()
}
