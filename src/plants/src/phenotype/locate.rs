//! From leaf pixels and rows to plants: a start, the descent.
//!
//! [`Setup::new`] poses the problem ([`crate::problems::plants`]) with the rows that were found and starts it;
//! whoever drives the engine moves `field`; [`Setup::finish`] reads the plants off. [`locate_best`] does
//! all three.
//!
//! Positions in pixels, centre of the top-left pixel at (0, 0).

use super::rows::{Detection, Row, Rows};
use crate::problems::plants::{Field, Model, Plants, Prior, index::PixelIndex, lines::Axes, start};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rowgram_optim::{
    descent::{self, BlockCost as _},
    engine::{RunOutcome, SolveError},
};
use serde::{Deserialize, Serialize};

/// Where the descent starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Init {
    /// k-means++: leaf pixels far from each other.
    #[serde(rename = "kmeans++")]
    KmeansPlusPlus,
    /// Detected rows, plants shared by length and spaced evenly.
    Rows,
    /// Leaf pixels, all equally likely.
    Random,
    /// Where the [row model](super::row_model) finds the plants.
    Votes,
}

rowgram_base::choices!(Init: KmeansPlusPlus, Rows, Random, Votes);

/// How to locate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PlantFitOptions {
    /// Number of plants.
    pub plants: usize,
    /// The model.
    pub model: Model,
    /// Where to start.
    pub init: Init,
    /// Decides k-means++ and random starts.
    pub seed: u64,
    /// How to descend.
    pub descent: descent::CoordinateDescentOptions,
    /// Most sweeps to make; 0 leaves the start as it is.
    pub max_sweeps: u64,
}

/// Why plants cannot be located as asked.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LocateError {
    /// The mask is empty.
    #[error("the mask has no leaf pixel; other thresholds, or another image?")]
    EmptyMask,
    /// No plant was asked for.
    #[error("the number of plants has to be at least 1")]
    NoPlants,
    /// There are fewer leaf pixels than plants.
    #[error("{plants} plants were asked for, and the mask has only {pixels} leaf pixels")]
    TooManyPlants {
        /// Plants asked for.
        plants: usize,
        /// Leaf pixels there are.
        pixels: usize,
    },
    /// The start or the prior needs rows, and the mask shows none.
    #[error(
        "no rows stand out in the mask (contrast {contrast:.3}, {prominence:.1} times the median); \
         use `--method descent --prior none`"
    )]
    NoRows {
        /// Highest correlation ratio of any heading.
        contrast: f64,
        /// That over the median.
        prominence: f64,
    },
    /// More plants were asked for than fit into the rows.
    #[error("{plants} plants were asked for, and the rows have places for {most}")]
    RowsTooShort {
        /// Plants asked for.
        plants: usize,
        /// Most plants there are places for.
        most: usize,
    },
    /// An option that cannot be: which, what it is, and what was expected.
    #[error("[locate] {0}")]
    Option(String),
    /// The problem could not be posed or solved.
    #[error(transparent)]
    Solve(#[from] SolveError),
}

impl From<LocateError> for rowgram_base::Error {
    fn from(error: LocateError) -> Self {
        let kind = match &error {
            LocateError::Solve(_) => rowgram_base::Kind::Failure,
            _ => rowgram_base::Kind::BadInput,
        };
        rowgram_base::Error::module(kind, error)
    }
}

/// A problem ready to be driven.
#[derive(Debug, Clone)]
pub struct Setup {
    /// The problem.
    pub problem: Plants,
    /// Where it starts, and what the engine moves.
    pub field: Field,
    /// The rows, where there are any.
    pub detection: Detection,
}

/// One plant that was found.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Plant {
    /// Position in the image.
    pub position_px: [f64; 2],
    /// Number of its row, counted across the rows; none where no rows were found.
    pub row: Option<usize>,
}

/// What was found.
#[derive(Debug, Clone)]
pub struct Located {
    /// The plants, by row and along the row (from top to bottom without rows).
    pub plants: Vec<Plant>,
    /// The rows, where there are any.
    pub detection: Detection,
    /// Scale of the distances at the end, in pixels.
    pub sigma_px: f64,
    /// Mean distance from a leaf pixel to its plant, in pixels.
    pub mean_distance_px: f64,
    /// Plants that no leaf pixel belongs to.
    pub empty_clusters: usize,
}

impl Setup {
    /// Poses the problem with the rows that were found.
    ///
    /// # Errors
    /// [`LocateError`], one for everything that cannot be.
    pub fn new(
        index: PixelIndex,
        options: &PlantFitOptions,
        detection: Detection,
    ) -> Result<Setup, LocateError> {
        Setup::from(index, options, detection, None)
    }

    /// Poses the problem with rows that are known already, and starts it at given positions (those
    /// of [`Init::Votes`]) in place of a start of its own.
    ///
    /// # Errors
    /// As [`Setup::new`], and with [`Init::Votes`] but no positions.
    pub fn from(
        index: PixelIndex,
        options: &PlantFitOptions,
        detection: Detection,
        positions: Option<Vec<[f64; 2]>>,
    ) -> Result<Setup, LocateError> {
        let (plants, pixels) = (options.plants, index.len());
        if pixels == 0 {
            return Err(LocateError::EmptyMask);
        }
        if plants == 0 {
            return Err(LocateError::NoPlants);
        }
        if plants > pixels {
            return Err(LocateError::TooManyPlants { plants, pixels });
        }
        let rows = match &detection {
            Detection::Found(rows) => Some(rows),
            &Detection::NoRows { contrast, prominence } => {
                if options.init == Init::Rows || options.model.prior != Prior::None {
                    return Err(LocateError::NoRows { contrast, prominence });
                }
                None
            }
        };
        let axes = rows.map_or(Axes { origin_px: [0.0; 2], heading_rad: 0.0 }, |rows| rows.axes);
        let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
        let positions = match (options.init, rows) {
            _ if positions.is_some() => positions.unwrap_or_default(),
            (Init::Votes, _) => {
                let message = "a start from votes needs their positions".to_owned();
                return Err(SolveError::Misuse(message).into());
            }
            (Init::Rows, Some(rows)) => regular_rows(&rows.rows, &rows.axes, plants),
            (Init::Random, _) => start::random(&index, plants, &mut rng),
            _ => start::kmeans_plus_plus(&index, plants, &mut rng),
        };
        let across: Vec<f64> = rows
            .map(|rows| rows.rows.iter().map(|row| row.across_px).collect())
            .unwrap_or_default();
        let along = rows.map(|rows| columns(rows, plants)).unwrap_or_default();
        let problem = Plants::new(index, plants, options.model, axes)?;
        let field = problem.field(positions, &across, &along)?;
        Ok(Setup { problem, field, detection })
    }

    /// Reads the plants off.
    pub fn finish(self) -> Located {
        let Setup { problem, field, detection } = self;
        let rows = detection.rows().map_or(&[][..], |rows| &rows.rows);
        let mut plants: Vec<(Option<usize>, f64, Plant)> = field
            .positions_px
            .iter()
            .enumerate()
            .map(|(p, &position_px)| {
                let [along, across] = problem.axes().aligned(position_px);
                let held_to = &field.latent.rows;
                let fitted = held_to.of.get(p).filter(|_| !held_to.lines.is_empty());
                let apart = |row: usize| (rows[row].across_px - across).abs();
                let nearest = (0..rows.len()).min_by(|&a, &b| apart(a).total_cmp(&apart(b)));
                let row = fitted.map(|&row| row as usize).or(nearest);
                let key = if row.is_some() { along } else { position_px[1] };
                (row, key, Plant { position_px, row })
            })
            .collect();
        plants.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        Located {
            plants: plants.into_iter().map(|(_, _, plant)| plant).collect(),
            sigma_px: field.sigma_px,
            mean_distance_px: problem.mean_distance_px(&field),
            empty_clusters: problem.empty_clusters(&field),
            detection,
        }
    }
}

/// Locates plants from several starts, with consecutive seeds; keeps the best by the (tempered)
/// objective. The outcome is that of the start that was kept: its sweeps are those of all its descents.
///
/// # Errors
/// As [`Setup::new`]; [`SolveError::Misuse`] for no start at all, and for several starts of a model
/// without a joint objective.
pub fn locate_best(
    index: &PixelIndex,
    options: &PlantFitOptions,
    detection: &Detection,
    positions: Option<&[[f64; 2]]>,
    starts: u64,
) -> Result<(Setup, RunOutcome), LocateError> {
    let mut best: Option<(Setup, RunOutcome)> = None;
    for start in 0..starts {
        let options = PlantFitOptions { seed: options.seed.wrapping_add(start), ..*options };
        let positions = positions.map(<[[f64; 2]]>::to_vec);
        let mut setup = Setup::from(index.clone(), &options, detection.clone(), positions)?;
        if starts > 1 && !setup.problem.monotone() {
            let message = "several starts need a joint objective to choose by; the conditional form has \
                           none";
            return Err(SolveError::Misuse(message.to_owned()).into());
        }
        let Setup { problem, field, .. } = &mut setup;
        let run = descent::run(problem, field, options.descent, options.max_sweeps, |_, _| ());
        let outcome = run?;
        if best.as_ref().is_none_or(|(_, least)| outcome.final_cost < least.final_cost) {
            best = Some((setup, outcome));
        }
    }
    best.ok_or_else(|| SolveError::Misuse("at least one start is needed".to_owned()).into())
}

/// Offsets of evenly spaced columns: as many as a row of the longest extent would have plants.
fn columns(rows: &Rows, plants: usize) -> Vec<f64> {
    let total: f64 = rows.rows.iter().map(Row::length_px).sum();
    let first = rows.rows.iter().map(|row| row.start_px).fold(f64::INFINITY, f64::min);
    let last = rows.rows.iter().map(|row| row.end_px).fold(f64::NEG_INFINITY, f64::max);
    let count = (plants as f64 * (last - first) / total).round().clamp(1.0, plants as f64);
    let spacing = (last - first) / count;
    (0..count as usize).map(|k| first + (k as f64 + 0.5) * spacing).collect()
}

/// `count` plants shared over the rows by length (largest remainders) and spaced evenly in each.
pub fn regular_rows(rows: &[Row], axes: &Axes, count: usize) -> Vec<[f64; 2]> {
    let total: f64 = rows.iter().map(Row::length_px).sum();
    if rows.is_empty() || total <= 0.0 {
        return Vec::new();
    }
    let ideal: Vec<f64> = rows.iter().map(|row| count as f64 * row.length_px() / total).collect();
    let mut shares: Vec<usize> = ideal.iter().map(|share| share.floor() as usize).collect();
    let mut by_remainder: Vec<usize> = (0..rows.len()).collect();
    by_remainder.sort_by(|&a, &b| ideal[b].fract().total_cmp(&ideal[a].fract()).then(a.cmp(&b)));
    let given: usize = shares.iter().sum();
    for &row in by_remainder.iter().cycle().take(count.saturating_sub(given)) {
        shares[row] += 1;
    }
    let placed = rows.iter().zip(&shares).flat_map(|(row, &share)| {
        (0..share).map(move |k| {
            let along = row.start_px + row.length_px() * (k as f64 + 0.5) / share as f64;
            axes.image([along, row.across_px])
        })
    });
    placed.take(count).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regular_rows_share_by_length_and_space_evenly() {
        let row = |across_px, end_px| Row { across_px, start_px: 0.0, end_px, pixels: 1 };
        let axes = Axes { origin_px: [0.0; 2], heading_rad: 0.0 };
        let plants = regular_rows(&[row(5.0, 100.0), row(50.0, 50.0)], &axes, 8);
        assert_eq!(plants.len(), 8);
        assert_eq!(plants.iter().filter(|p| p[1] == 5.0).count(), 5);
        assert_eq!((plants[0], plants[1]), ([10.0, 5.0], [30.0, 5.0]));
        assert_eq!(regular_rows(&[row(5.0, 100.0)], &axes, 1), [[50.0, 5.0]]);
        assert!(regular_rows(&[], &axes, 4).is_empty());
    }

    #[test]
    fn what_cannot_be_located_is_named() {
        let options = |plants, prior, init| PlantFitOptions {
            plants,
            model: Model { prior, ..Model::default() },
            init,
            seed: 0,
            descent: descent::CoordinateDescentOptions::default(),
            max_sweeps: 10,
        };
        let square = PixelIndex::new(&(0..2500).map(|k| [k % 50, k / 50]).collect::<Vec<_>>());
        let none = Detection::NoRows { contrast: 0.0, prominence: 0.0 };
        let fail = |index: &PixelIndex, o| locate_best(index, &o, &none, None, 1).unwrap_err();
        let free = |plants| options(plants, Prior::None, Init::KmeansPlusPlus);
        assert_eq!(fail(&PixelIndex::new(&[]), free(1)), LocateError::EmptyMask);
        assert_eq!(fail(&square, free(0)), LocateError::NoPlants);
        let error = fail(&square, free(2501));
        assert_eq!(error, LocateError::TooManyPlants { plants: 2501, pixels: 2500 });
        for (prior, init) in [(Prior::Rows, Init::Random), (Prior::None, Init::Rows)] {
            let error = fail(&square, options(5, prior, init));
            assert!(matches!(error, LocateError::NoRows { .. }), "{error}");
        }
        let (setup, outcome) = locate_best(&square, &free(5), &none, None, 1).unwrap();
        let located = setup.finish();
        assert_eq!((located.plants.len(), located.empty_clusters), (5, 0));
        assert!(located.plants.iter().all(|plant| plant.row.is_none()));
        assert!(outcome.final_cost < outcome.initial_cost);
    }
}
