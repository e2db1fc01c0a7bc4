//! A small project that has everything: photos of a flight and of a chessboard, ground control, plots, regions in which
//! leaves were counted, settings, and the truth.

use super::{FlightOptions, FlightOutcome, write_flight};
use crate::{Config, SETTINGS, record};
use data_synth::{
    board::BOARD,
    twin::{FlightPreset, TwinConfig},
};
use record::Content;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{
    csv_table::CsvTable,
    polygons::{self, Outline},
};
use rowgram_optim::output::{self, FileError};
use rowgram_raster::georeference::Crs;
use serde::{Deserialize, Serialize};
use std::{
    path::{Path, PathBuf},
    result::Result as StdResult,
};

/// Photos of a chessboard from which the camera of the project is calibrated.
pub const BOARD_PHOTOS: u16 = 16;

/// Says that a folder is such a project, from which seed, and what was written.
const MARKER: &str = "synthetic-field.json";

/// What a synthetic project holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SynthesisOutcome {
    /// The seed of everything random.
    pub seed: u64,
    /// The flight.
    #[serde(flatten)]
    pub flight: FlightOutcome,
    /// Number of plots.
    pub plots: usize,
    /// Number of plots whose true number of leaves is given to the program, as if counted by hand.
    pub counted_by_hand: usize,
}

/// The content of the marker.
#[derive(Debug, Serialize, Deserialize)]
struct Made {
    seed: u64,
    build: String,
    /// Missing while the project is being made.
    outcome: Option<SynthesisOutcome>,
    files: Vec<Content>,
}

/// Makes the project of a seed in the folder `root`, which is made if missing. One that is there whole is kept; one that
/// was interrupted is made again. `rowgram.toml` is written where there is none, because it is the person's. With `force`, files of the
/// same names in a folder that holds something else are replaced.
///
/// # Errors
/// Without `force`, a folder that holds something else, or the project of another seed; writing.
pub fn synthesize(
    root: &Path,
    seed: u64,
    force: bool,
    monitor: &mut dyn Monitor,
) -> Result<SynthesisOutcome, Error> {
    if let Some(outcome) = check(root, seed, force)? {
        let message = "the synthetic project is there and unchanged: kept";
        let name = root.display().to_string();
        monitor.diagnostic(&Diagnostic::info("synthesis-kept", name, message));
        return Ok(outcome);
    }
    std::fs::create_dir_all(root).map_err(|e| FileError::write(root, e))?;
    let build = crate::BUILD.to_owned();
    mark(root, &Made { seed, build: build.clone(), outcome: None, files: Vec::new() })?;
    let mut config = TwinConfig::preset(FlightPreset::Small);
    config.field.seed = seed;
    let options = FlightOptions { boards: BOARD_PHOTOS, ..FlightOptions::default() };
    let flight = write_flight(&config, &options, root, true, monitor)?;
    let plots = plots(&root.join("truth").join("plots.csv"))?;
    let epsg = config.site.epsg;
    // Every third plot has been counted by hand.
    let counted: Vec<&Plot> = plots.iter().step_by(3).collect();
    let outlines: Vec<Outline> = plots.iter().map(|plot| plot.outline(false)).collect();
    let regions: Vec<Outline> = counted.iter().map(|plot| plot.outline(true)).collect();
    for (name, of) in [("plots.geojson", &outlines), ("regions.geojson", &regions)] {
        polygons::write(&root.join(name), true, of, Some(Crs::projected(epsg)))?;
    }
    let path = root.join(SETTINGS);
    if !path.exists() {
        let settings = settings(seed, epsg);
        output::write(&path, false, |out| out.write_all(settings.as_bytes()))?;
    }
    let outcome =
        SynthesisOutcome { seed, flight, plots: plots.len(), counted_by_hand: counted.len() };
    let mut files = record::files(root)?;
    let is_result = |path: &Path| path.starts_with(root.join("rowgram"));
    files.retain(|path| !path.ends_with(SETTINGS) && !path.ends_with(MARKER) && !is_result(path));
    let files = record::contents(root, &files)?;
    mark(root, &Made { seed, build, outcome: Some(outcome.clone()), files })?;
    Ok(outcome)
}

/// What the project of this seed holds where it is there, whole and of this program; refuses a folder with something else.
fn check(root: &Path, seed: u64, force: bool) -> Result<Option<SynthesisOutcome>, Error> {
    let marker = root.join(MARKER);
    if let Ok(text) = std::fs::read(&marker) {
        let made: StdResult<Made, _> = serde_json::from_slice(&text);
        return match made {
            Ok(made) if made.seed == seed => whole(root, made),
            _ if force => Ok(None),
            Ok(made) => {
                let message = format!(
                    "it holds the synthetic field of seed {}, expected that of seed {seed}; give another --output, or --force",
                    made.seed
                );
                Err(FileError::malformed(root, None, message).into())
            }
            Err(error) => Err(FileError::malformed(&marker, None, error.to_string()).into()),
        };
    }
    let taken = std::fs::read_dir(root).is_ok_and(|mut entries| entries.next().is_some());
    if root.exists() && (taken || !root.is_dir()) && !force {
        return Err(FileError::Exists { path: root.to_owned() }.into());
    }
    Ok(None)
}

fn whole(root: &Path, made: Made) -> Result<Option<SynthesisOutcome>, Error> {
    let paths: Vec<PathBuf> = made.files.iter().map(|file| root.join(&file.path)).collect();
    if made.build != crate::BUILD || !paths.iter().all(|path| path.is_file()) {
        return Ok(None);
    }
    Ok(made.outcome.filter(|_| record::contents(root, &paths).is_ok_and(|now| now == made.files)))
}

fn mark(root: &Path, made: &Made) -> Result<(), Error> {
    Ok(output::write_json(&root.join(MARKER), true, made)?)
}

/// The template of settings with what is known of the project.
fn settings(seed: u64, epsg: u32) -> String {
    Config::template(true)
        .replace("# name = \"My field\"", &format!("name = \"Synthetic field {seed}\""))
        .replace("# crs = \"EPSG:32616\"", &format!("crs = \"EPSG:{epsg}\""))
        .replace("# board = \"8x6\"", &format!("board = \"{}x{}\"", BOARD.columns, BOARD.rows))
        .replace("# square_m = 0.025", &format!("square_m = {}", BOARD.side_m))
        .replace("# truth = \"truth/plants.csv\"", "truth = \"truth/plants.csv\"")
}

/// A plot of the truth.
pub(super) struct Plot {
    name: String,
    leaves: f64,
    corners_m: [[f64; 2]; 4],
}

/// The plots of `truth/plots.csv`.
pub(super) fn plots(path: &Path) -> Result<Vec<Plot>, Error> {
    let table = CsvTable::read(path)?;
    let numbers = |name: &str| {
        let column = table.numbers(name).filter(|column| column.iter().all(|v| v.is_finite()));
        column.ok_or_else(|| {
            FileError::malformed(path, None, format!("expected numbers in the column {name}"))
        })
    };
    let (number, leaves) = (numbers("plot")?, numbers("leaves")?);
    let mut corners_m = vec![[[0.0; 2]; 4]; table.len()];
    for k in 0..4 {
        for (axis, name) in [format!("easting_{k}_m"), format!("northing_{k}_m")].iter().enumerate()
        {
            for (corners, value) in corners_m.iter_mut().zip(numbers(name)?) {
                corners[k][axis] = value;
            }
        }
    }
    let rows = number.into_iter().zip(leaves).zip(corners_m);
    Ok(rows
        .map(|((number, leaves), corners_m)| Plot {
            name: format!("P{:02.0}", number + 1.0),
            leaves,
            corners_m,
        })
        .collect())
}

impl Plot {
    /// Its polygon, with the number of its leaves where asked.
    pub(super) fn outline(&self, with_leaves: bool) -> Outline {
        let leaves = with_leaves.then(|| ("leaves".to_owned(), self.leaves.into()));
        Outline {
            name: self.name.clone(),
            rings: vec![self.corners_m.to_vec()],
            attributes: leaves.into_iter().collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_settings_say_what_is_known_and_can_be_read() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(SETTINGS), settings(7, 32616)).unwrap();
        std::fs::create_dir(folder.path().join("truth")).unwrap();
        std::fs::write(folder.path().join("truth/plants.csv"), "x,y\n").unwrap();
        let config = Config::of_folder(folder.path()).unwrap();
        assert_eq!(config.project.name.as_deref(), Some("Synthetic field 7"));
        assert_eq!(config.project.crs.as_deref(), Some("EPSG:32616"));
        assert_eq!(config.project.truth, Some("truth/plants.csv".into()));
        assert_eq!(
            config.calibrate.board,
            Some(rowgram_survey::target::Board { columns: 9, rows: 6 })
        );
        assert_eq!(config.calibrate.square_m, Some(0.04));
    }

    #[test]
    fn a_folder_with_something_else_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        assert_eq!(check(root, 1, false).unwrap(), None);
        std::fs::write(root.join("thesis.txt"), "years of work").unwrap();
        assert!(check(root, 1, false).unwrap_err().to_string().contains("exists already"));
        assert_eq!(check(root, 1, true).unwrap(), None);
        let flight = FlightOutcome { plants: 1, photos: 0, targets: 0, marks: 0 };
        let outcome = SynthesisOutcome { seed: 1, flight, plots: 0, counted_by_hand: 0 };
        let files = record::contents(root, &[root.join("thesis.txt")]).unwrap();
        let made = |outcome| Made {
            seed: 1,
            build: crate::BUILD.to_owned(),
            outcome,
            files: files.clone(),
        };
        mark(root, &made(Some(outcome.clone()))).unwrap();
        assert_eq!(check(root, 1, false).unwrap(), Some(outcome));
        let other = check(root, 2, false).unwrap_err().to_string();
        assert!(other.contains("of seed 1, expected that of seed 2"), "{other}");
        // What was interrupted is made again, and so is what somebody has changed.
        mark(root, &made(None)).unwrap();
        assert_eq!(check(root, 1, false).unwrap(), None);
    }
}
