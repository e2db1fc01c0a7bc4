//! `rowgram camera calibrate`: a camera from photos of a chessboard.

use super::{options::Given, project};
use rowgram_base::{error::Error, monitor::Monitor};
use rowgram_optim::output::{self, FileError};
use rowgram_project::{
    Stage,
    calibrate::{
        CalibrateOptions, CalibrateOutcome, FIGURES, TABLES, calibrate, calibrate_photos,
        write_figures, write_tables,
    },
};
use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
};

/// Calibrate a camera from photos of a chessboard
///
/// Finds the inner corners of the board in every photo to a fraction of a pixel, or reads them from a table, and
/// adjusts one interior orientation together with the pose of the board in every photo. No value has to be known
/// beforehand.
///
/// INPUT is a project with photos in calibration/, or the photos themselves. Of a project, camera.toml, tables
/// (parameters, correlation, photos, corners, residuals, residuals by radius, distortion curve, lens models) and
/// figures/ go to PROJECT/rowgram/calibrate.
///
/// Photos without the whole board, with a board of another size, twice the same, or that contradict the others are
/// named and left out.
///
/// Examples:
///   rowgram camera calibrate field --board 8x6 --square-m 0.025
///   rowgram camera calibrate photos/*.jpg --board 8x6 --square-m 0.025 -o camera.toml
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Folder of a project, or photos of the board (PNG, JPEG or TIFF), all by one camera at one focus and zoom.
    #[arg(value_name = "PROJECT|IMAGES", required_unless_present = "corners")]
    input: Vec<PathBuf>,
    /// Folder of results [default: PROJECT/rowgram]; for photos, the file of the camera.
    #[arg(short, long, value_name = "PATH")]
    output: Option<PathBuf>,
    #[command(flatten)]
    options: Given<CalibrateOptions>,
    /// For photos: folder for pictures.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// For photos: folder for tables.
    #[arg(long, value_name = "DIR")]
    tables: Option<PathBuf>,
    /// Do it again where nothing has changed; for photos, replace outputs that exist.
    #[arg(long)]
    force: bool,
    /// Print the outcome as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// As the stage says.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    if let [root] = args.input.as_slice()
        && root.is_dir()
    {
        if args.figures.is_some() || args.tables.is_some() {
            return Err(Error::Argument(
                "--figures and --tables: those of a project are in its results".into(),
            ));
        }
        let output = args.output.as_deref();
        let project = project::open_for(Stage::Calibrate, root, output, args.force)?;
        let options = args.options.over(&project.config().calibrate)?;
        return project::present(args.json, |monitor| calibrate(&project, &options, monitor), text);
    }
    let options = args.options.over_defaults()?;
    let camera = args.output.as_deref().ok_or_else(|| {
        Error::Argument("--output: expected the file of the camera, such as camera.toml".into())
    })?;
    check(args, &options, camera)?;
    project::present(args.json, |monitor| of_photos(args, &options, camera, monitor), text)
}

fn of_photos(
    args: &Args,
    options: &CalibrateOptions,
    camera: &Path,
    monitor: &mut dyn Monitor,
) -> Result<CalibrateOutcome, Error> {
    let found = calibrate_photos(&args.input, options, monitor)?;
    if let Some(folder) = &args.tables {
        write_tables(folder, args.force, &found)?;
    }
    if let Some(folder) = &args.figures {
        write_figures(folder, args.force, &found, monitor)?;
    }
    let text = found.camera.to_toml();
    output::write(camera, args.force, |out| out.write_all(text.as_bytes()))?;
    Ok(CalibrateOutcome::of(&found))
}

/// Refuses what would fail after the work is done.
fn check(args: &Args, options: &CalibrateOptions, camera: &Path) -> Result<(), Error> {
    output::check(camera, args.force)?;
    let mut outputs = vec![camera.to_owned()];
    for (folder, names) in [(&args.tables, TABLES.as_slice()), (&args.figures, FIGURES.as_slice())]
    {
        let Some(folder) = folder else { continue };
        if folder.exists() && !folder.is_dir() {
            let message = "it is no folder";
            return Err(FileError::Unusable { path: folder.clone(), message }.into());
        }
        outputs.extend(names.iter().map(|name| folder.join(name)));
    }
    let outputs: Vec<&Path> = outputs.iter().map(PathBuf::as_path).collect();
    let inputs: Vec<&Path> =
        args.input.iter().chain(&options.corners).map(PathBuf::as_path).collect();
    Ok(output::check_apart(&outputs, &inputs, args.force)?)
}

/// The outcome for a person.
fn text(found: &CalibrateOutcome) -> String {
    let mut out = String::new();
    let _ = writeln!(
        out,
        "{} of {} photos, {} corners; rms {:.4} px, sigma0 {:.4} px ({} observations, {} unknowns, {} iterations)",
        found.photos_used,
        found.photos.len(),
        found.observations / 2,
        found.rms_px,
        found.sigma0_px,
        found.observations,
        found.unknowns,
        found.iterations
    );
    let _ = writeln!(out, "lens model {}:", found.lens.word());
    for p in &found.parameters {
        let _ = match (p.free, p.probability) {
            (true, Some(probability)) => writeln!(
                out,
                "  {:<7} {:>16} +- {:<12} {:<6} {}",
                p.name,
                number(p.value),
                number(p.standard_deviation),
                p.unit,
                if probability < SIGNIFICANCE { "" } else { "not significant" }
            ),
            _ => writeln!(out, "  {:<7} {:>16} held", p.name, number(p.value)),
        };
    }
    let strong = strongest(found);
    if let Some((a, b, value)) = strong {
        let _ = writeln!(out, "largest correlation: {value:.3} between {a} and {b}");
    }
    if !found.board_heights_m.is_empty() {
        let most = found.board_heights_m.iter().map(|h| h[0].abs()).fold(0.0, f64::max);
        let _ = writeln!(out, "the board is up to {:.2} mm off its plane", 1e3 * most);
    }
    let _ = writeln!(out, "lens models on these corners, the best first (Bayes' criterion):");
    for row in &found.models {
        let _ = writeln!(
            out,
            "  {:<8} {:>2} parameters  rms {:.4} px  ({})",
            row.lens.word(),
            row.parameters,
            row.rms_px,
            row.terms
        );
    }
    for photo in &found.photos {
        if !photo.status.is_used() || photo.blurred {
            let blurred = if photo.blurred { ", blurred" } else { "" };
            let _ = writeln!(out, "{}: {}{blurred}", photo.image, photo.status);
        }
    }
    out
}

/// A probability below this makes a parameter significant.
const SIGNIFICANCE: f64 = 0.05;

/// Six digits, with an exponent where the number is large or small.
fn number(value: f64) -> String {
    if value == 0.0 || (1e-3..1e6).contains(&value.abs()) {
        format!("{value:.6}")
    } else {
        format!("{value:.5e}")
    }
}

fn strongest(found: &CalibrateOutcome) -> Option<(&str, &str, f64)> {
    let pairs = (0..found.free.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
    pairs
        .map(|(i, j)| (found.free[j].as_str(), found.free[i].as_str(), found.correlation[i][j]))
        .max_by(|a, b| a.2.abs().total_cmp(&b.2.abs()))
}
