//! Ground control targets found in the photos of an aligned project: `marks.csv` without a click.
//!
//! Not a stage: what it finds is an input of the next run, beside the photos, where a person may change it ([`MarkEditor`]).

mod contact_sheet;
mod editor;
mod marks;

pub use editor::{
    Mark, MarkChange, MarkChanges, MarkEditor, MarkPhoto, MarkSheet, MarkedPoint, PointSight, Saved,
};

use super::{Project, align, import};
use marks::marks_file;
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
    options::Auto,
};
use rowgram_files::{control::MarkTable, csv_table::CsvWriter, images};
use rowgram_optim::{
    output::{self, FileError},
    robust,
};
use rowgram_survey::{
    features,
    ground_targets::{
        FoundTargets, NotFound, TargetKind, TargetSearch, TargetSighting, find_targets, sheet,
    },
    scene::{GroundPoint, Reconstruction},
};
use serde::{Deserialize, Serialize};
use std::{
    fmt,
    path::{Path, PathBuf},
};

rowgram_base::options! {
    /// Ground control targets in the photos (`rowgram targets`).
    pub struct TargetsOptions in "targets" {
        /// What they look like: two black and two white quadrants, a white cross or disc on darker ground, AprilTag 36h11 or ArUco
        /// 4x4_50. Where not set, all are tried.
        pub kind: Option<TargetKind> = None, example "\"chequered\"";
        /// Their size: the side of a chequered plate, the length of the arms of a cross, the diameter of a disc, the side of the black
        /// square of a coded target. Where not set, sizes from 0.2 to 1 m are tried.
        pub size_m: Option<f64> = None, limits between(0.01, 10.0), example "0.5";
        /// How far from their predicted places they are looked for. auto: twice the standard deviation of the camera positions in
        /// plan, at least 2 m.
        pub search_m: Auto<f64> = Auto::Auto, limits POSITIVE;
        /// The least correlation of a photo and the target fitted to it.
        pub min_score: f64 = 0.7, limits SHARE;
        /// How far a measurement may be from where the other photos put the target.
        pub tolerance_px: f64 = 3.0, limits POSITIVE;
    }
}

/// Sizes that are tried where none is given, metres: of common targets, each about half again as large as the one before. Assumed.
const SIZES_M: [f64; 5] = [0.2, 0.3, 0.45, 0.65, 1.0];
/// Standard deviation in plan of camera positions without a stated accuracy, metres: that of a receiver without corrections. Assumed.
const POSITION_SIGMA_M: f64 = 5.0;
/// A block that receivers with corrections hold is not searched within less, metres.
const MIN_SEARCH_M: f64 = 2.0;

/// Folder of the table and the contact sheet, among the results.
pub const FOLDER: &str = "targets";
/// Every target in every photo.
pub const TABLE: &str = "targets.csv";
/// Its picture.
pub const CONTACT_SHEET: &str = "targets.png";

/// What was found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TargetsOutcome {
    /// The image measurements, as `run` reads them.
    pub marks: PathBuf,
    /// Every target in every photo that should show it.
    pub table: PathBuf,
    /// A crop of each of those.
    pub contact_sheet: PathBuf,
    /// What the targets look like.
    pub kind: TargetKind,
    /// Their size, metres.
    pub size_m: f64,
    /// Surveyed points.
    pub points: usize,
    /// Those that were found in a photo or more.
    pub points_found: usize,
    /// Targets in photos that should show them.
    pub sightings: usize,
    /// Those that were measured.
    pub found: usize,
    /// Marks made by hand, which stay as they are.
    pub by_hand: usize,
    /// Median standard deviation of a measurement, pixels.
    pub median_sigma_px: f64,
    /// Positions in the block less surveyed ones, metres.
    pub shift_m: [f64; 3],
    /// What is left of those differences, metres.
    pub shift_sigma_m: f64,
}

impl fmt::Display for TargetsOutcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [east, north, up] = self.shift_m;
        writeln!(
            f,
            "{}: {} marks of {} of {} targets ({} of {:.2} m), {:.0} % of those that photos should show; standard deviation {:.2} px",
            self.marks.display(),
            self.found,
            self.points_found,
            self.points,
            self.kind,
            self.size_m,
            100.0 * self.found as f64 / self.sightings.max(1) as f64,
            self.median_sigma_px,
        )?;
        writeln!(
            f,
            "the block is {east:+.2} m east, {north:+.2} m north, {up:+.2} m up of the survey; targets differ by {:.2} m",
            self.shift_sigma_m
        )?;
        if self.by_hand > 0 {
            writeln!(f, "{} marks made by hand stay as they are", self.by_hand)?;
        }
        write!(f, "look at {}, then rowgram run uses the marks", self.contact_sheet.display())
    }
}

/// Finds the targets of the surveyed ground points in the photos of an aligned project and writes `marks.csv`, a table and a contact
/// sheet. Marks made by hand stay as they are, unless `force`.
///
/// # Errors
/// A project that is not aligned or has no ground points, marks that cannot be read or contradict the photos, photos that cannot be
/// read; [`Error::Incomplete`] where the photos agree about no target.
pub fn targets(
    project: &Project,
    options: &TargetsOptions,
    force: bool,
    monitor: &mut dyn Monitor,
) -> Result<TargetsOutcome, Error> {
    rowgram_base::options::Options::validate(options)
        .map_err(|why| Error::Argument(format!("[targets] {why}")))?;
    let marks = marks_file(project);
    let reconstruction = project.reconstruction()?;
    let points = align::surveyed_points(project, &reconstruction, monitor)?;
    let before = || match force {
        true => Ok(MarkTable::default()),
        false => marks::read(&marks, &reconstruction.images, &points),
    };
    before()?;
    let files = import::photo_files(&reconstruction, &project.photo_folder())?;
    let search = TargetSearch {
        kind: options.kind,
        sizes_m: options.size_m.map_or(SIZES_M.to_vec(), |size_m| vec![size_m]),
        search_m: match options.search_m {
            Auto::Given(metres) => metres,
            Auto::Auto => search_m(&reconstruction),
        },
        min_score: options.min_score,
        tolerance_px: options.tolerance_px,
    };
    let counter = Counter::new(monitor, "finding targets", None::<usize>, "photos read");
    let read = |image: usize| {
        let photo = images::read_photo(&files[image])?;
        counter.tick();
        Ok(features::grey(&photo))
    };
    let found = find_targets(&reconstruction, &points, &search, &read)?;
    let Some(found) = found.filter(|found| found.measurements().next().is_some()) else {
        return Err(Error::Incomplete(format!(
            "no targets were found that photos and survey agree about, within {:.1} m of {} surveyed points; give kind, size_m and search_m in [targets], and see that the control points are in the system of the project; where the block is bent, mark three targets by hand, align again and then look for the others",
            search.search_m,
            points.len()
        )));
    };
    // They may have changed meanwhile.
    let block = (&reconstruction.images[..], &points[..]);
    let (table, by_hand) = marks::join(&marks, before()?, &found, block)?;
    table.write(&marks, true)?;
    let folder = project.results().join(FOLDER);
    output::make_folder(&folder)?;
    let order = contact_sheet::order(&found);
    let named = |sighting: &TargetSighting| {
        let image = reconstruction.images[sighting.image].name.as_str();
        [image, points[sighting.ground].name.as_str()]
    };
    let table = folder.join(TABLE);
    write_table(&table, &found, named, &order)?;
    let contact_sheet = folder.join(CONTACT_SHEET);
    let picture =
        contact_sheet::draw(&found, &order, |image| Ok(images::read_photo(&files[image])?))?;
    images::write_photo(&contact_sheet, true, &picture)?;
    missing(&found, &points, monitor);
    let is_found = |k: &usize| found.measurements().any(|(sighting, _)| sighting.ground == *k);
    Ok(TargetsOutcome {
        marks,
        table,
        contact_sheet,
        kind: found.kind,
        size_m: found.size_m,
        points: points.len(),
        points_found: (0..points.len()).filter(is_found).count(),
        sightings: found.sightings.len(),
        found: found.measurements().count(),
        by_hand,
        median_sigma_px: robust::median(found.measurements().map(|(_, m)| m.sigma_px))
            .unwrap_or(f64::NAN),
        shift_m: found.shift_m,
        shift_sigma_m: found.shift_sigma_m,
    })
}

/// Writes a PDF of targets to print, as [`sheet::pdf`] makes it.
///
/// # Errors
/// A kind or size that is not given or cannot be printed, a file that exists unless `force`.
pub fn print_targets(
    options: &TargetsOptions,
    (first, count): (usize, usize),
    path: &Path,
    force: bool,
) -> Result<(), Error> {
    output::expect_ending(path, &["pdf"])?;
    let (Some(kind), Some(size_m)) = (options.kind, options.size_m) else {
        return Err(Error::Argument(
            "targets to print need a kind and a size, such as --kind apriltag --size-m 0.5".into(),
        ));
    };
    let file = sheet::pdf(kind, size_m, first, count)?;
    Ok(output::write(path, force, |out| out.write_all(&file))?)
}

/// Twice the standard deviation of camera positions in plan.
fn search_m(reconstruction: &Reconstruction) -> f64 {
    let sigmas = reconstruction.positions.iter().map(|at| at.sigma_m[0].hypot(at.sigma_m[1]));
    let sigma_m = robust::median(sigmas)
        .map_or(POSITION_SIGMA_M, |sigma| sigma * std::f64::consts::FRAC_1_SQRT_2);
    (2.0 * sigma_m).max(MIN_SEARCH_M)
}

const COLUMNS: [&str; 14] = [
    "label",
    "image",
    "predicted_u_px",
    "predicted_v_px",
    "size_px",
    "u_px",
    "v_px",
    "sigma_px",
    "residual_px",
    "score",
    "code",
    "sheet_row",
    "sheet_column",
    "outcome",
];

fn write_table<'a>(
    path: &Path,
    found: &'a FoundTargets,
    named: impl Fn(&'a TargetSighting) -> [&'a str; 2],
    order: &[Vec<usize>],
) -> Result<(), FileError> {
    output::write(path, true, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record(COLUMNS)?;
        for (row, sightings) in order.iter().enumerate() {
            for (column, &k) in sightings.iter().enumerate() {
                let sighting = &found.sightings[k];
                let [image, label] = named(sighting).map(str::to_owned);
                let [u, v] = sighting.predicted_px.map(|px| format!("{px:.1}"));
                let size = format!("{:.1}", sighting.size_px);
                let measured = sighting.outcome.as_ref().ok();
                let number = |of: Option<f64>| of.map_or(String::new(), |of| format!("{of:.3}"));
                let numbers = [
                    number(measured.map(|m| m.image_px[0])),
                    number(measured.map(|m| m.image_px[1])),
                    number(measured.map(|m| m.sigma_px)),
                    number(measured.and_then(|m| m.residual_px)),
                    number(measured.map(|m| m.score)),
                    measured.and_then(|m| m.code).map_or(String::new(), |code| code.to_string()),
                ];
                let place = [row + 1, column + 1].map(|at| at.to_string());
                let outcome = match &sighting.outcome {
                    Ok(_) => "found".to_owned(),
                    Err(why) => why.to_string(),
                };
                let mut cells = vec![label, image, u, v, size];
                cells.extend(numbers.into_iter().chain(place).chain([outcome]));
                csv.write_record(cells)?;
            }
        }
        csv.flush()
    })
}

/// Names the points that no two photos show.
fn missing(found: &FoundTargets, points: &[GroundPoint], monitor: &mut dyn Monitor) {
    let is_missing = |k: &usize| {
        let own = || found.sightings.iter().filter(|sighting| sighting.ground == *k);
        let is_shown = |s: &&TargetSighting| !matches!(s.outcome, Err(NotFound::TooSmall { .. }));
        own().filter(is_shown).count() >= 2 && own().filter(|s| s.outcome.is_ok()).count() < 2
    };
    let names: Vec<&str> =
        (0..points.len()).filter(is_missing).map(|k| points[k].name.as_str()).collect();
    if !names.is_empty() {
        let message = format!(
            "found in fewer than two photos that should show them: {}; the contact sheet shows where they were expected",
            names.join(", ")
        );
        let found = Diagnostic::warning("targets-not-found", "targets", message);
        monitor.diagnostic(
            &found.with_remedy("mark them by hand (rowgram view), or lower [targets] min_score"),
        );
    }
}
