//! Comparison with ground truth: plants one to one, plants and leaves of every plot.

use super::{Project, Stage, Task, layers, stage};
use rowgram_base::{error::Error, monitor::Monitor};
use rowgram_files::{
    csv_table::{CsvTable, CsvWriter},
    geotiff::Reader,
    points,
    polygons::{self, Named},
    rasters::Source,
};
use rowgram_optim::output::{self, FileError};
use rowgram_plants::score::Score;
use rowgram_raster::{
    georeference::Georeference,
    polygon::{Polygon, Positions},
    window::Window,
};
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

rowgram_base::options! {
    /// Comparison with ground truth.
    pub struct EvaluateOptions in "evaluate", main [radii_m] {
        /// Distances within which a located plant matches a true one.
        pub radii_m: Vec<f64> = vec![0.05, 0.1], limits POSITIVE;
    }
}

/// Plants and leaves of a plot, found and true.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlotComparison {
    /// Name of the plot.
    pub plot: String,
    /// True plants in it that the orthomosaic shows.
    pub true_plants: usize,
    /// Plants that were located in it.
    pub found_plants: usize,
    /// True leaves of these plants, where the truth has them.
    pub true_leaves: Option<f64>,
    /// Leaves from the area that they cover, where they were counted.
    pub leaves_by_area: Option<f64>,
    /// Whether leaves were counted by hand here, so that the plot says nothing of the error of `leaves_by_area`.
    pub is_counted_by_hand: bool,
}

/// Leaves by area and true leaves, over the plots whose leaves nobody counted by hand.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LeafValidation {
    /// How many plots these are.
    pub plots: usize,
    /// Leaves from the area that they cover.
    pub leaves_by_area: f64,
    /// True leaves.
    pub true_leaves: f64,
    /// By how much more leaves there are by area than in truth, as a share of the true ones.
    pub relative_error: f64,
}

/// How well plants and leaves of a project were found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvaluateOutcome {
    /// Distances up to which a found plant is a true one, metres.
    pub radii_m: Vec<f64>,
    /// Ground sampling distance of the orthomosaic, metres.
    pub gsd_m: f64,
    /// True plants that the orthomosaic does not show.
    pub true_plants_not_shown: usize,
    /// Median distance of the pairs at the largest radius, metres.
    pub median_error_m: Option<f64>,
    /// Root of the mean squared distance of these pairs, metres.
    pub rms_error_m: Option<f64>,
    /// Plants one to one, in pixels of the orthomosaic.
    pub score: Score,
    /// The plots of the project.
    pub plots: Vec<PlotComparison>,
    /// Leaves by area; `None` where no plot has both numbers and was not counted by hand.
    pub leaf_validation: Option<LeafValidation>,
}

/// Compares what was found with ground truth, and writes `score.json` and `plots.csv`.
///
/// # Errors
/// As [`stage::perform`]; an orthomosaic without a scale in metres; a damaged table.
pub fn evaluate(
    project: &Project,
    options: &EvaluateOptions,
    monitor: &mut dyn Monitor,
) -> Result<EvaluateOutcome, Error> {
    stage::perform::<Evaluate>(project, options, monitor)
}

/// The stage.
pub struct Evaluate;

fn truth_of(project: &Project) -> Result<PathBuf, Error> {
    let named = project.config().project.truth.as_ref();
    named.map(|path| project.root().join(path)).ok_or_else(|| {
        Error::NothingToDo(
            "there is no ground truth to compare with: set [project] truth".to_owned(),
        )
    })
}

fn plants_of(project: &Project) -> Result<PathBuf, Error> {
    project
        .finished(Stage::Locate, "plants.csv")
        .ok_or_else(|| Error::NothingToDo("no plants were located".to_owned()))
}

impl Task for Evaluate {
    type Options = EvaluateOptions;
    type Outcome = EvaluateOutcome;
    const STAGE: Stage = Stage::Evaluate;

    fn inputs(project: &Project, _: &EvaluateOptions) -> Result<Vec<PathBuf>, Error> {
        let mut files = vec![truth_of(project)?, plants_of(project)?, project.orthomosaic()?];
        for path in [project.plots(), project.regions()].into_iter().flatten() {
            files.extend(polygons::files(&path));
        }
        files.extend(project.finished(Stage::LeafCount, "counts.csv"));
        Ok(files)
    }

    fn work(
        project: &Project,
        options: &EvaluateOptions,
        folder: &Path,
        _: &mut dyn Monitor,
    ) -> Result<EvaluateOutcome, Error> {
        let ortho = project.orthomosaic()?;
        let (place, size) = place_of(&ortho)?;
        let gsd_m = place
            .gsd_m()
            .ok_or_else(|| FileError::malformed(&ortho, None, "its coordinates are not metres"))?;
        let shown =
            Shown { reader: Reader::open_with(&ortho, &project.reading(&ortho)).ok(), size };
        let all = true_plants(&truth_of(project)?)?;
        let mut plants = Vec::new();
        for plant in &all {
            let at = place.pixel(plant.at_m).unwrap_or([f64::NAN; 2]);
            if shown.at(at)? {
                plants.push((at, plant.leaves));
            }
        }
        let positions: Vec<[f64; 2]> = plants.iter().map(|(at, _)| *at).collect();
        let found = points::read(&plants_of(project)?)?;
        let radii_px: Vec<f64> = options.radii_m.iter().map(|radius| radius / gsd_m).collect();
        let score = Score::new(&found, &positions, &radii_px)
            .map_err(|e| Error::Argument(format!("[evaluate] radii_m: {e}")))?;
        let counts = project.finished(Stage::LeafCount, "counts.csv");
        let counts = counts.as_deref().map(leaf_counts).transpose()?.unwrap_or_default();
        let read = |path: Option<PathBuf>| -> Result<Vec<Named>, Error> {
            Ok(path
                .map(|path| layers::layer(project, &path, Some(&place), None))
                .transpose()?
                .map(|layer| layer.polygons)
                .unwrap_or_default())
        };
        let by_hand = read(project.regions())?;
        let of_truth = Positions::new(positions.iter().copied());
        let of_found = Positions::new(found.iter().copied());
        let plots: Vec<PlotComparison> = read(project.plots())?
            .into_iter()
            .map(|plot| {
                let of: Vec<_> = of_truth.inside(&plot.polygon);
                PlotComparison {
                    true_plants: of.len(),
                    found_plants: of_found.inside(&plot.polygon).len(),
                    true_leaves: of.iter().map(|&k| plants[k].1).sum(),
                    leaves_by_area: counts.get(&plot.name).copied(),
                    is_counted_by_hand: by_hand
                        .iter()
                        .any(|region| overlap(&region.polygon, &plot.polygon, size)),
                    plot: plot.name,
                }
            })
            .collect();
        let metres = |px: Option<f64>| px.map(|px| px * gsd_m);
        let outcome = EvaluateOutcome {
            radii_m: options.radii_m.clone(),
            gsd_m,
            true_plants_not_shown: all.len() - plants.len(),
            median_error_m: metres(score.median_error_px),
            rms_error_m: metres(score.rms_error_px),
            score,
            leaf_validation: validation(&plots),
            plots,
        };
        write(&outcome, folder)?;
        Ok(outcome)
    }
}

fn validation(plots: &[PlotComparison]) -> Option<LeafValidation> {
    let independent: Vec<(f64, f64)> = plots
        .iter()
        .filter(|plot| !plot.is_counted_by_hand)
        .filter_map(|plot| plot.leaves_by_area.zip(plot.true_leaves))
        .collect();
    let leaves_by_area: f64 = independent.iter().map(|(counted, _)| counted).sum();
    let true_leaves: f64 = independent.iter().map(|(_, leaves)| leaves).sum();
    (true_leaves > 0.0).then(|| LeafValidation {
        plots: independent.len(),
        leaves_by_area,
        true_leaves,
        relative_error: leaves_by_area / true_leaves - 1.0,
    })
}

/// Whether two polygons are of the same plants: they share more pixels than neighbours along a common side do.
fn overlap(a: &Polygon, b: &Polygon, (width, height): (usize, usize)) -> bool {
    const SHARE: f64 = 0.05;
    let (a, b) = (a.runs(width, height), b.runs(width, height));
    let pixels = |runs: &[(usize, std::ops::Range<usize>)]| -> usize {
        runs.iter().map(|(_, run)| run.len()).sum()
    };
    let smaller = pixels(&a).min(pixels(&b));
    let mut by_row: BTreeMap<usize, Vec<&std::ops::Range<usize>>> = BTreeMap::new();
    b.iter().for_each(|(v, run)| by_row.entry(*v).or_default().push(run));
    let shared: usize = a
        .iter()
        .flat_map(|(v, run)| by_row.get(v).into_iter().flatten().map(move |other| (run, other)))
        .map(|(run, other)| run.end.min(other.end).saturating_sub(run.start.max(other.start)))
        .sum();
    shared as f64 > SHARE * smaller as f64
}

/// A true plant in the mapping frame.
struct TruePlant {
    at_m: [f64; 2],
    leaves: Option<f64>,
}

fn true_plants(path: &Path) -> Result<Vec<TruePlant>, Error> {
    let table = CsvTable::read(path)?;
    let places = table
        .pairs("easting_m", "northing_m")
        .or_else(|| table.pairs("x", "y"))
        .ok_or_else(|| FileError::malformed(path, 1, "expected easting_m,northing_m or x,y"))?;
    let leaves = table.numbers("leaves");
    let check = |k: usize, number: f64, what: &str| {
        let refused = || FileError::malformed(path, k + 2, format!("{what} is not a number"));
        if number.is_finite() { Ok(number) } else { Err(refused()) }
    };
    let plant = |(k, at): (usize, &[f64; 2])| {
        let leaves = leaves.as_ref().map(|leaves| check(k, leaves[k], "leaves")).transpose()?;
        let at_m = [check(k, at[0], "the easting")?, check(k, at[1], "the northing")?];
        Ok(TruePlant { at_m, leaves })
    };
    places.iter().enumerate().map(plant).collect()
}

/// Whether the orthomosaic shows a place: one that the photos do not show cannot be found.
struct Shown {
    reader: Option<Reader>,
    size: (usize, usize),
}

impl Shown {
    fn at(&self, [u, v]: [f64; 2]) -> Result<bool, Error> {
        let (u, v) = (u.round(), v.round());
        let inside = u >= 0.0 && v >= 0.0 && u < self.size.0 as f64 && v < self.size.1 as f64;
        if !inside {
            return Ok(false);
        }
        let Some(reader) = self.reader.as_ref().filter(|r| r.bands() == 4 && r.holds::<u8>())
        else {
            return Ok(true);
        };
        let window = Window { u: u as usize, v: v as usize, width: 1, height: 1 };
        Ok(reader.read_rgb_and_gaps(window)?.1.is_none())
    }
}

fn place_of(path: &Path) -> Result<(Georeference, (usize, usize)), Error> {
    let source = Source::open(path)?;
    let place = source.georeference().ok_or_else(|| {
        FileError::malformed(path, None, "it has no georeference, expected a GeoTIFF with one")
    })?;
    Ok((place, source.size()))
}

/// Leaves by plot as the stage wrote them.
fn leaf_counts(path: &Path) -> Result<BTreeMap<String, f64>, Error> {
    let table = CsvTable::read(path)?;
    let columns = table.texts("plot").zip(table.numbers("leaves"));
    let (plots, leaves) = columns
        .ok_or_else(|| FileError::malformed(path, 1, "expected the columns plot and leaves"))?;
    Ok(plots.into_iter().map(str::to_owned).zip(leaves).collect())
}

fn write(outcome: &EvaluateOutcome, folder: &Path) -> Result<(), Error> {
    output::write(&folder.join("plots.csv"), true, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record(["plot", "true_plants", "found_plants", "true_leaves", "leaves_by_area"])?;
        let number = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:?}"));
        for plot in &outcome.plots {
            csv.write_record([
                plot.plot.clone(),
                plot.true_plants.to_string(),
                plot.found_plants.to_string(),
                number(plot.true_leaves),
                number(plot.leaves_by_area),
            ])?;
        }
        csv.flush()
    })?;
    Ok(output::write_json(&folder.join("score.json"), true, outcome)?)
}

/// Compares the positions of two CSV files, one to one, at radii in pixels. Columns are found by their names: `u_px,v_px`,
/// or `x,y`; a file without a header has two columns.
///
/// # Errors
/// Radii that are not positive; files that cannot be read.
pub fn evaluate_positions(found: &Path, truth: &Path, radii_px: &[f64]) -> Result<Score, Error> {
    // A radius that cannot be is refused before files are read.
    Score::new(&[], &[], radii_px)?;
    Score::new(&points::read(found)?, &points::read(truth)?, radii_px)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(left: f64, side: f64) -> Polygon {
        let right = left + side;
        Polygon { rings: vec![vec![[left, 0.0], [right, 0.0], [right, side], [left, side]]] }
    }

    #[test]
    fn plots_counted_by_hand_do_not_validate_themselves() {
        let plot = |name: &str, counted: f64, leaves: f64, is_counted_by_hand| PlotComparison {
            plot: name.to_owned(),
            true_plants: 1,
            found_plants: 1,
            true_leaves: Some(leaves),
            leaves_by_area: Some(counted),
            is_counted_by_hand,
        };
        let found = validation(&[
            plot("A", 100.0, 100.0, true),
            plot("B", 120.0, 100.0, false),
            plot("C", 90.0, 100.0, false),
        ]);
        let found = found.unwrap();
        assert_eq!((found.plots, found.leaves_by_area, found.true_leaves), (2, 210.0, 200.0));
        assert!((found.relative_error - 0.05).abs() < 1e-12);
        assert_eq!(validation(&[plot("A", 100.0, 100.0, true)]), None);
    }

    #[test]
    fn a_common_side_is_no_overlap() {
        let size = (100, 100);
        assert!(overlap(&square(0.0, 20.0), &square(0.0, 20.0), size));
        assert!(overlap(&square(5.0, 4.0), &square(0.0, 20.0), size), "a part of the plot");
        assert!(!overlap(&square(0.0, 20.0), &square(20.0, 20.0), size));
        assert!(!overlap(&square(0.0, 20.0), &square(19.5, 20.0), size), "drawn a little off");
    }

    #[test]
    fn a_damaged_truth_is_refused_with_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("truth.csv");
        std::fs::write(&path, "x,y,leaves\n1,2,3\n1,?,3\n").unwrap();
        let error = true_plants(&path).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("line 3") && error.contains("northing"), "{error}");
        std::fs::write(&path, "a,b\n1,2\n").unwrap();
        let error = true_plants(&path).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("expected easting_m,northing_m"), "{error}");
    }
}
