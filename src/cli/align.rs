//! `rowgram align`: arguments in, results out; see [`rowgram_project::align`].

use super::{
    features,
    options::Given,
    project::{ProjectArgs, present},
};
use clap::Args as ClapArgs;
use rowgram_base::{error::Error, options::Choice};
use rowgram_project::{
    Config, Project, Stage,
    align::{self, AlignOptions, Step},
    environment,
};
use std::path::PathBuf;

/// Orient the photos of a flight: camera poses, a sparse cloud, self-calibration, check points.
///
/// PROJECT is a folder with photos (JPEG, PNG, TIFF), in images/ or directly. What lies beside them is used: gcps.csv and
/// marks.csv (ground points and where they are in the photos), or an OpenDroneMap gcp_list.txt (names that begin with CHK-
/// are check points), or OpenSfM's ground_control_points.json; geolocation.csv (camera positions, WGS84); camera.toml.
/// Positions, focal lengths and dates come from EXIF and XMP.
///
/// Coordinates are in the system of the control (--crs names it); without control in the system of --crs, or in a local
/// plane at the photos.
///
/// Steps: inspect, features, match, verify (orientation of pairs), orient (exterior orientation image by image), adjust
/// (mapping frame, bundle adjustment with self-calibration), report. Results of a step are reused until an input, an option or
/// the program changes.
///
/// Exit code 3 where fewer photos could be oriented together than [checks] oriented_red, or the adjustment did not converge.
#[derive(Debug, ClapArgs)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
#[command(after_help = "Examples:
  rowgram align field --json
  rowgram align field --crs EPSG:27700 --check T3,T7
  rowgram align field --solver two-point --lens smac --until verify")]
pub(super) struct Args {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    project: ProjectArgs,
    /// Coordinate reference system of control and results: EPSG:<code> or a PROJ string.
    #[arg(long, value_name = "CRS")]
    crs: Option<String>,
    /// Ground points: CSV, gcp_list.txt or ground_control_points.json.
    #[arg(long, value_name = "FILE")]
    control: Option<PathBuf>,
    /// Image measurements of the ground points of a CSV file (marks).
    #[arg(long, value_name = "FILE")]
    marks: Option<PathBuf>,
    /// Camera positions: image, latitude, longitude, height.
    #[arg(long, value_name = "FILE")]
    positions: Option<PathBuf>,
    /// A calibrated camera (camera.toml); what it does not name as free is held.
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
    #[command(flatten)]
    options: Given<AlignOptions>,
    /// Repeat this step and those after it.
    #[arg(long, value_name = "STEP", value_parser = step())]
    from: Option<String>,
    /// Stop after this step.
    #[arg(long, value_name = "STEP", value_parser = step())]
    until: Option<String>,
    /// Repeat all steps; results that were edited since are kept beside, as NAME.edited.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Features(features::Args),
    Match(features::MatchArgs),
}

fn step() -> clap::builder::PossibleValuesParser {
    Step::all().iter().map(Choice::word).collect::<Vec<String>>().into()
}

impl Args {
    fn project(&self) -> Result<(Project, AlignOptions), Error> {
        let mut config = Config::read(self.project.root(), environment()?.into_iter(), &[])?;
        let options = self.options.over(&config.align)?;
        let settings = &mut config.project;
        settings.crs = self.crs.clone().or(settings.crs.take());
        for (setting, given) in [
            (&mut settings.control, &self.control),
            (&mut settings.marks, &self.marks),
            (&mut settings.positions, &self.positions),
            (&mut settings.camera, &self.camera),
        ] {
            if let Some(path) = given {
                // Settings are relative to the project, arguments to where they were typed.
                let absolute = std::path::absolute(path);
                *setting =
                    Some(absolute.map_err(|e| rowgram_optim::output::FileError::read(path, e))?);
            }
        }
        config.align = options.clone();
        let project = self.project.with_config(config)?;
        let again = self.force || self.from.is_some();
        Ok((project.again(again.then_some(Stage::Align)).forced(self.force), options))
    }

    fn steps(&self) -> Result<(Option<Step>, Option<Step>), Error> {
        let read = |word: &Option<String>| word.as_deref().and_then(|word| Step::read(word).ok());
        let (from, until) = (read(&self.from), read(&self.until));
        if from.zip(until).is_some_and(|(from, until)| from > until) {
            return Err(Error::Argument("--from: it comes after the step of --until".into()));
        }
        Ok((if self.force { Some(Step::Inspect) } else { from }, until))
    }
}

/// Runs the command.
///
/// # Errors
/// Bad input, photos that cannot be oriented together, an adjustment that did not converge.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    match &args.command {
        Some(Command::Features(args)) => return features::run(args),
        Some(Command::Match(args)) => return features::run_match(args),
        None => {}
    }
    let (from, until) = args.steps()?;
    let (project, options) = args.project()?;
    if let Some(from) = from {
        align::forget(&project, from)?;
    }
    if let Some(until) = until.filter(|until| *until < Step::Report) {
        return present(
            args.project.json,
            |monitor| align::align_until(&project, &options, until, monitor),
            ToString::to_string,
        );
    }
    present(
        args.project.json,
        |monitor| align::align(&project, &options, monitor),
        |outcome| {
            let summary = std::fs::read_to_string(project.file(Stage::Align, "report/summary.txt"));
            format!("{outcome}{}", summary.unwrap_or_default())
        },
    )
}
