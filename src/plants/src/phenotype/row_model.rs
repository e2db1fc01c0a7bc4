//! Plants in closed canopies, from votes along leaf axes and a random field along curved rows.
//!
//! 1. Votes for stalks ([`evidence`]), rows as they run ([`row_curves`]), and the votes along every row
//!    ([`row_profile::Profile`]): at each place along the row the best votes across it, under a normal
//!    weight about the row.
//! 2. The spacing of the plants ([`plant_spacing`]), on some of the rows: where their number is not given, the likeliest of some, all sets of
//!    plants taken together; then alternating between the best plants and the gaps between them.
//!    Rows are cut where they have no leaf for some spacings (`row_parts`): at alleys, and where many plants are missing.
//! 3. How many leaves there are around every place ([`double_plants`]), compared with the likeliest plants so far: what the random
//!    field knows of two plants in one place, and of none.
//! 4. The probability of a plant at every place ([`stand_count`]). Where the number of plants is not given it is the sum of these
//!    probabilities, which has an interval. Plants stand where the greatest probability lies close together; the probability around each is its confidence,
//!    and its spread gives standard deviations. The spacing gives every gap the probability that
//!    plants are missing in it. Stalks may be tilted, and their bases not below their leaves ([`tilt`]).
//!
//! All that is for rows along which leaves have closed. Where there is soil between plants, or there are no rows, plants are
//! counted and located by their leaf mass (`mass_stand`).
//!
//! Positions and lengths in pixels of the mask where the name ends in `_px`, else of the reduced grid.
//!
//! [`evidence`]: super::evidence
//! [`row_profile::Profile`]: super::row_profile::Profile
//! [`double_plants`]: super::double_plants
//! [`row_curves`]: super::row_curves
//! [`plant_spacing`]: super::plant_spacing
//! [`stand_count`]: super::stand_count
//! [`tilt`]: super::tilt

use super::{
    locate::LocateError,
    mass_stand::{self, ByMass},
    plant_spacing::Spacing,
    row_evidence::{RowEvidence, gaps, total},
    row_parts::Part,
    row_profile::STEP,
    rows::{Detection, Rows},
    rows_to_count::read_rows,
    stand::{Gap, LEAST_MISSING, NORMAL_95, Stalk, Stand},
    stand_count::RowPosterior,
    tilt,
};
use rowgram_base::options::Options as _;
use rowgram_optim::engine::SolveError;
use rowgram_raster::Mask;
use std::borrow::Cow;

rowgram_base::options! {
    /// The row model. Lengths without a unit are pixels of the reduced grid, about a third of a leaf's width.
    pub struct RowModelOptions in "locate" {
        /// Initial standard deviation of plants across their row.
        pub across_sigma: f64 = 3.0, limits between(0.000001, 1e6);
        /// Shrinkage of the offset across the row: the share of the best offset that is applied.
        pub shrinkage: f64 = 0.7, limits between(0.0, 1.0);
        /// Standard deviation, in each direction, of the base of a stalk about the middle of its leaves.
        pub tilt_sigma: f64 = 1.5, limits between(0.0, 1e6);
        /// Count and locate plants by their leaf area where soil separates them, or where there are no rows;
        /// otherwise only along rows.
        pub isolated_plants: bool = true;
    }
}

impl Copy for RowModelOptions {}

/// Finds plants in a mask whose rows are known; `count` of them, or as many as there seem to be.
///
/// # Errors
/// [`LocateError`]: an empty mask, no rows, no plants asked for, or more than fit into the rows; an option that
/// means nothing.
pub fn locate(
    mask: &Mask,
    detection: &Detection,
    count: Option<usize>,
    options: &RowModelOptions,
) -> Result<Stand, LocateError> {
    let mut stand = locate_in_detail(mask, None, detection, count, options)?;
    stand.doubt(None, Some(mask), 0);
    stand.set_told_number(count);
    Ok(stand)
}

/// [`locate`] without looking for doubts ([`Stand::doubt`]), where the probability of vegetation of each pixel is known, too, in 1/255. Closed rows are told apart by gaps between
/// leaves as narrow as a pixel, which a mask of neighbours that agree has lost; weeds are less green than the crop.
///
/// # Errors
/// As [`locate`].
pub(super) fn locate_in_detail(
    mask: &Mask,
    posterior: Option<Vec<u8>>,
    detection: &Detection,
    count: Option<usize>,
    options: &RowModelOptions,
) -> Result<Stand, LocateError> {
    options.validate().map_err(LocateError::Option)?;
    if mask.data.iter().all(|&pixel| pixel == 0) {
        return Err(LocateError::EmptyMask);
    }
    let expected = mask.data.len();
    if let Some(found) = posterior.as_ref().map(Vec::len).filter(|&found| found != expected) {
        let message = format!("a posterior of {found} pixels, expected {expected} as in the mask");
        return Err(SolveError::Misuse(message).into());
    }
    if count == Some(0) {
        return Err(LocateError::NoPlants);
    }
    let pixels = mask.data.iter().filter(|&&pixel| pixel != 0).count();
    if let Some(plants) = count.filter(|&count| count > pixels) {
        return Err(LocateError::TooManyPlants { plants, pixels });
    }
    let fits = count.is_none_or(|count| count <= pixels / PLANT);
    let by_mass = if options.isolated_plants && fits {
        mass_stand::locate(mask, posterior.as_deref(), detection, count)
    } else {
        ByMass::Nothing
    };
    by_mass_or_votes(mask, posterior, detection, count, options, by_mass)
}

/// The plants that mass tells, or votes along leaf axes where it tells nothing or less than those.
fn by_mass_or_votes(
    mask: &Mask,
    posterior: Option<Vec<u8>>,
    detection: &Detection,
    count: Option<usize>,
    options: &RowModelOptions,
    by_mass: ByMass,
) -> Result<Stand, LocateError> {
    match by_mass {
        ByMass::Found(stand) => Ok(*stand),
        ByMass::Nothing => {
            by_votes(&likely(Cow::Borrowed(mask), posterior), detection, count, options)
        }
        ByMass::Doubtful(mut doubtful) => {
            let crop = doubtful.crop.take();
            let has_weeds = crop.is_some();
            let stand = match crop {
                None => {
                    by_votes(&likely(Cow::Borrowed(mask), posterior), detection, count, options)?
                }
                Some((crop, detection)) => {
                    let mut posterior = posterior;
                    for (p, crop) in posterior.iter_mut().flatten().zip(&crop.data) {
                        *p *= u8::from(*crop != 0);
                    }
                    by_votes(&likely(Cow::Owned(crop), posterior), &detection, count, options)?
                }
            };
            let (votes, mass) = (stand.plants.len(), doubtful.by_mass.plants.len());
            let is_preferred = doubtful.prefers(votes);
            tracing::debug!("{mass} plants by leaf mass, {votes} by votes along leaf axes");
            if !is_preferred {
                return Ok(doubtful.by_mass);
            }
            let between_rows = if has_weeds { doubtful.by_mass.between_rows } else { None };
            Ok(Stand { between_rows, ..stand })
        }
    }
}

/// The pixels that are leaf when judged alone, where `posterior` has their probabilities; else the mask. It takes over the memory of
/// the posterior: a large map has room for few copies.
fn likely(mask: Cow<'_, Mask>, posterior: Option<Vec<u8>>) -> Cow<'_, Mask> {
    let Some(mut data) = posterior else { return mask };
    data.iter_mut().for_each(|p| *p = u8::from(*p >= LIKELY));
    Cow::Owned(Mask { width: mask.width, height: mask.height, data })
}

/// [`locate_in_detail`] by votes along leaf axes alone.
fn by_votes(
    mask: &Mask,
    detection: &Detection,
    count: Option<usize>,
    options: &RowModelOptions,
) -> Result<Stand, LocateError> {
    let rows = match detection {
        Detection::Found(rows) => rows,
        &Detection::NoRows { contrast, prominence } => {
            return Err(LocateError::NoRows { contrast, prominence });
        }
    };
    let (evidence, spacing) = read_rows(mask, rows, count, options);
    let posteriors = evidence.posteriors(&spacing, count)?;
    let expected: f64 = posteriors.iter().map(|row| row.count).sum();
    let wanted = count.unwrap_or((expected.round() as usize).max(1));
    let places = RowEvidence::places(&posteriors, &spacing, wanted);
    if let Some(plants) = count.filter(|&plants| plants > total(&places)) {
        return Err(LocateError::RowsTooShort { plants, most: total(&places) });
    }
    let spacing = spacing.refit(&gaps(&places));
    let mut stand = evidence.present(rows, &places, &posteriors, &spacing);
    stand.refit_rows();
    Ok(stand)
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

/// As [`around`] the middle of all the plants found within some steps of this one, and of each the same share.
fn together(marginals: &[f64], places: &[usize], at: usize, steps: usize) -> [f64; 3] {
    let near = places.iter().filter(|other| other.abs_diff(at) <= steps);
    let (sum, count) = near.fold((0, 0), |(sum, count), other| (sum + other, count + 1));
    let [plants, mean, variance] = around(marginals, sum / count.max(1), steps);
    [plants / count.max(1) as f64, mean, variance]
}

/// Pixels with this probability, in 1/255, are leaf by themselves.
const LIKELY: u8 = 128;
/// Leaf pixels of a plant told by its mass, at least.
const PLANT: usize = 8;
/// Standard deviation of the relative error of expected counts, on synthetic fields that took no part in fitting the weights: what all plants
/// of a field share (the mean error of a kind of field is 0.04 at most), and what is left over the square root of their number (a field
/// of 150 to 200 plants is off by 0.06, as it was where both were one).
const COUNT_SIGMA: (f64, f64) = (0.03, 0.7);

impl RowEvidence<'_> {
    fn present(
        &self,
        rows: &Rows,
        places: &[Vec<usize>],
        posteriors: &[RowPosterior],
        spacing: &Spacing,
    ) -> Stand {
        let factor = self.evidence.factor as f64;
        let tilt = self.options.tilt_sigma;
        let across = self.scatter(places, spacing.spacing);
        let shrinkage =
            self.options.shrinkage * tilt::shrinkage(tilt, across / self.options.across_sigma);
        let offsets = self.offsets(places, across);
        let radius = ((0.25 * spacing.spacing / STEP) as usize).max(1);
        let (mut plants, mut missing) = (Vec::new(), Vec::new());
        // The last plant before this one, and its row.
        let mut last: Option<(usize, f64)> = None;
        for (part, places) in places.iter().enumerate() {
            let Part { row, before, .. } = self.parts[part];
            let mut is_behind_alley = before.is_some_and(|bare| bare.is_alley);
            let marginals = &posteriors[part].marginals;
            let found: Vec<[f64; 3]> =
                places.iter().map(|&at| together(marginals, places, at, radius)).collect();
            let whorls: Vec<f64> = places
                .iter()
                .zip(&found)
                .map(|(&at, [_, mean, _])| STEP * (at as f64 + mean))
                .collect();
            let bases = tilt::bases(&whorls, spacing, tilt);
            for (k, ([confidence, _, variance], [base, tilted])) in
                found.into_iter().zip(bases).enumerate()
            {
                plants.push(Stalk {
                    position_px: self.image(part, base / STEP, shrinkage * offsets[part][k]),
                    row,
                    along_px: (self.profiles[part].start + base) * factor,
                    confidence: confidence.min(1.0),
                    // A place stands for a step around it.
                    sigma_along_px: ((variance + 1.0 / 12.0) * STEP * STEP + tilted).sqrt()
                        * factor,
                    sigma_across_px: (1.0 - shrinkage).sqrt() * across * factor,
                });
            }
            let start = self.profiles[part].start;
            for place in places.iter().map(|&at| start + at as f64 * STEP) {
                let before = last.filter(|(of, _)| *of == row).map(|(_, before)| before);
                last = Some((row, place));
                let Some(before) = before.filter(|_| !is_behind_alley) else {
                    is_behind_alley = false;
                    continue;
                };
                let (likely, probability) = spacing.missing_plants(place - before);
                if probability > LEAST_MISSING {
                    let middle = (0.5 * (before + place) - start) / STEP;
                    missing.push(Gap {
                        row,
                        position_px: self.image(part, middle, 0.0),
                        length_px: (place - before) * factor,
                        plants: likely,
                        probability,
                    });
                }
            }
        }
        let expected: f64 = posteriors.iter().map(|of| of.count).sum();
        // What leaves leave open, and what the weights may be off for this field.
        let (shared, own) = COUNT_SIGMA;
        let variance = posteriors.iter().map(|of| of.count_variance).sum::<f64>()
            + (shared * expected).powi(2)
            + own * own * expected;
        let half = NORMAL_95 * variance.sqrt();
        let singles = (total(places) as f64).max(2.0) - 1.0;
        let mut row_counts = vec![0.0; rows.rows.len()];
        let mut row_variances = row_counts.clone();
        for (part, posterior) in self.parts.iter().zip(posteriors) {
            row_counts[part.row] += posterior.count;
            row_variances[part.row] += posterior.count_variance;
        }
        let relative = variance.sqrt() / expected.max(1.0);
        for (count, variance) in row_counts.iter().zip(&mut row_variances) {
            *variance += (relative * count).powi(2);
        }
        Stand {
            plants,
            rows: rows.clone(),
            spacing: Spacing { spacing: spacing.spacing * factor, ..*spacing },
            spacing_sigma_px: spacing.jitter * spacing.spacing * factor / singles.sqrt(),
            count_interval: [(expected - half).max(0.0), expected + half],
            row_counts,
            row_count_sigmas: row_variances.into_iter().map(f64::sqrt).collect(),
            missing,
            leaf_mass: None,
            between_rows: None,
            doubts: Vec::new(),
            perspective: None,
        }
    }
}
