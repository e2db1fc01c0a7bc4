//! Comparison with ground truth: plants one to one, plants and leaves of every plot.

use super::{Project, Stage, Task, layers, stage};
use rowgram_base::{error::Error, monitor::Monitor};
use rowgram_files::{
    csv_table::{CsvTable, CsvWriter},
    geotiff::Reader,
    points,
    polygons::Named,
    rasters::Source,
};
use rowgram_optim::output::{self, FileError, name_of};
use rowgram_plants::score::Score;
use rowgram_raster::{
    georeference::{Crs, CrsKind, Georeference},
    polygon::Positions,
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
/// As [`stage::perform`]; an orthomosaic without a scale in metres; a damaged table; true plants none of which it shows.
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
        files.extend([project.plots(), project.regions()].into_iter().flatten());
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
        let truth = truth_of(project)?;
        let all = true_plants(&truth, place.crs)?;
        let mut plants = Vec::new();
        for plant in &all {
            let at = place.pixel(plant.at).unwrap_or([f64::NAN; 2]);
            if shown.at(at)? {
                plants.push((at, plant.leaves));
            }
        }
        if plants.is_empty() && !all.is_empty() {
            let message = format!(
                "the orthomosaic shows none of its {} plants: expected places in the system of the orthomosaic; is it of another field?",
                all.len()
            );
            return Err(FileError::malformed(&truth, None, message).into());
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
                        .any(|region| layers::overlap(&region.polygon, &plot.polygon, size)),
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

/// A true plant in the mapping frame, in its unit.
#[derive(Debug)]
struct TruePlant {
    at: [f64; 2],
    leaves: Option<f64>,
}

/// The true plants of a table on a map of this system.
fn true_plants(path: &Path, crs: Crs) -> Result<Vec<TruePlant>, Error> {
    let table = CsvTable::read(path)?;
    let malformed = |message: &str| FileError::malformed(path, 1, message);
    let places = if let Some(at) = table.pairs("easting_m", "northing_m") {
        let unit_m = crs.kind.metres_per_unit();
        let unit_m = unit_m.ok_or_else(|| malformed("easting_m,northing_m are metres, and the orthomosaic is not in metres or feet: expected longitude_deg,latitude_deg or x,y"))?;
        at.into_iter().map(|at| at.map(|x| x / unit_m)).collect()
    } else if let Some(at) = table.pairs("easting_ft", "northing_ft") {
        if !matches!(crs.kind, CrsKind::Feet | CrsKind::SurveyFeet) {
            return Err(malformed("easting_ft,northing_ft are feet, and the orthomosaic is not in feet: expected easting_m,northing_m or longitude_deg,latitude_deg").into());
        }
        at
    } else if let Some(at) = table.pairs("longitude_deg", "latitude_deg") {
        match crs.kind {
            CrsKind::Geographic => at,
            _ => {
                let system = crs.system();
                let system = system.ok_or_else(|| malformed("longitude_deg,latitude_deg need the reference system of the orthomosaic, which does not state it: expected x,y"))?;
                let project = |(k, [longitude, latitude]): (usize, [f64; 2])| {
                    let at = system.from_wgs84(latitude, longitude);
                    at.map_err(|error| FileError::malformed(path, k + 2, error.to_string()))
                };
                at.into_iter().enumerate().map(project).collect::<Result<_, _>>()?
            }
        }
    } else {
        let pairs = format!(
            "expected easting_m,northing_m, easting_ft,northing_ft, longitude_deg,latitude_deg or x,y, found {}",
            table.header().join(",")
        );
        table.pairs("x", "y").ok_or_else(|| malformed(&pairs))?
    };
    let leaves = table.numbers("leaves");
    let check = |k: usize, number: f64, what: &str| {
        let refused = || FileError::malformed(path, k + 2, format!("{what} is not a number"));
        if number.is_finite() { Ok(number) } else { Err(refused()) }
    };
    let plant = |(k, at): (usize, &[f64; 2])| {
        let leaves = leaves.as_ref().map(|leaves| check(k, leaves[k], "leaves")).transpose()?;
        let at = [check(k, at[0], "the easting")?, check(k, at[1], "the northing")?];
        Ok(TruePlant { at, leaves })
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
    let (plants, true_plants) = (points::read(found)?, points::read(truth)?);
    let score = Score::new(&plants, &true_plants, radii_px)?;
    if score.radii.iter().all(|radius| radius.f1 == Some(0.0)) {
        check_same_picture(found, &plants, (truth, &true_plants))?;
    }
    Ok(score)
}

/// Refuses true plants that cannot be of the same picture, or in another unit: beside those that were found, or on another scale.
fn check_same_picture(
    found: &Path,
    plants: &[[f64; 2]],
    (truth, true_plants): (&Path, &[[f64; 2]]),
) -> Result<(), FileError> {
    let range = |of: &[[f64; 2]], k: usize| {
        let values = || of.iter().map(|at| at[k]);
        [values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max)]
    };
    let [own, other] = [plants, true_plants].map(|of| [range(of, 0), range(of, 1)]);
    let is_beside = (0..2).any(|k| own[k][1] < other[k][0] || other[k][1] < own[k][0]);
    let size = |of: [[f64; 2]; 2]| of.map(|[low, high]| high - low).into_iter().fold(0.0, f64::max);
    let scale = size(other) / size(own);
    if plants.len() < 3 || true_plants.len() < 3 || !is_beside && (0.1..10.0).contains(&scale) {
        return Ok(());
    }
    let text = |[[left, right], [top, bottom]]: [[f64; 2]; 2]| {
        format!("{left:.1} to {right:.1}, {top:.1} to {bottom:.1}")
    };
    let message = format!(
        "its plants lie at {}, those of {} at {}: expected pixels of the same picture, the second downwards from its top; places on the \
         map are compared in a project ([project] truth)",
        text(other),
        name_of(found),
        text(own)
    );
    Err(FileError::malformed(truth, None, message))
}

/// Whether the true plants can be read; the file, where there is one.
pub(super) fn doctor(project: &Project) -> Option<(PathBuf, Result<usize, Error>)> {
    let truth = truth_of(project).ok()?;
    let count = || match project.orthomosaic() {
        Ok(ortho) => Ok(true_plants(&truth, place_of(&ortho)?.0.crs)?.len()),
        Err(_) => Ok(CsvTable::read(&truth)?.len()),
    };
    let count = count();
    Some((truth, count))
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn a_damaged_truth_is_refused_with_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("truth.csv");
        std::fs::write(&path, "x,y,leaves\n1,2,3\n1,?,3\n").unwrap();
        let error = true_plants(&path, Crs::LOCAL).unwrap_err().to_string();
        assert!(error.contains("line 3") && error.contains("northing"), "{error}");
        std::fs::write(&path, "a,b\n1,2\n").unwrap();
        let error = true_plants(&path, Crs::LOCAL).unwrap_err().to_string();
        assert!(error.contains("expected easting_m,northing_m"), "{error}");
        assert!(error.contains("found a,b"), "{error}");
        // As QGIS writes it.
        std::fs::write(&path, "X,Y,fid\n1,2,0\n").unwrap();
        assert_eq!(true_plants(&path, Crs::LOCAL).unwrap()[0].at, [1.0, 2.0]);
    }

    #[test]
    fn truth_of_another_picture_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str, rows: &str| {
            let path = folder.path().join(name);
            std::fs::write(&path, format!("x,y\n{rows}")).unwrap();
            path
        };
        let found = at("plants.csv", "100,100\n900,500\n300,900\n");
        let score = |rows: &str| evaluate_positions(&found, &at("truth.csv", rows), &[5.0]);
        // The map; y upwards; metres.
        for rows in [
            "500110,5000100\n500119,5000105\n500103,5000109\n",
            "100,-100\n900,-500\n300,-900\n",
            "1,1\n9,5\n3,9\n",
        ] {
            let error = score(rows).unwrap_err().to_string();
            assert!(error.contains("expected pixels of the same picture"), "{error}");
        }
        assert_eq!(score("200,200\n800,600\n400,800\n").unwrap().radii[0].f1, Some(0.0));
    }

    #[test]
    fn columns_of_the_truth_have_units() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("truth.csv");
        let read = |header: &str, crs: Crs| {
            std::fs::write(&path, format!("{header}\n9.5,48\n")).unwrap();
            true_plants(&path, crs).map(|all| all[0].at).map_err(|error| error.to_string())
        };
        let feet = Crs { kind: CrsKind::Feet, ..Crs::LOCAL };
        let degrees = Crs::geographic(4326);
        let at = read("easting_m,northing_m", feet).unwrap();
        assert!((at[0] - 9.5 / 0.3048).abs() < 1e-9, "{at:?}");
        assert_eq!(read("easting_ft,northing_ft", feet), Ok([9.5, 48.0]));
        assert_eq!(read("longitude_deg,latitude_deg", degrees), Ok([9.5, 48.0]));
        let utm = read("longitude_deg,latitude_deg", Crs::projected(32632)).unwrap();
        assert!((530_000.0..540_000.0).contains(&utm[0]), "{utm:?}");
        for (header, crs) in
            [("easting_ft,northing_ft", Crs::LOCAL), ("easting_m,northing_m", degrees)]
        {
            assert!(read(header, crs).unwrap_err().contains("expected"), "{header}");
        }
    }
}
