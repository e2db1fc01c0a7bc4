//! `rowgram camera convert`: a calibrated camera in the words of another program.

use crate::{
    camera::{Camera, Interior, Lens, Model},
    error::Error,
    io::{
        camera::{self, Program, to_program},
        output,
    },
    problems::lens_fit::{Fit, fit},
};
use clap::{Args as ClapArgs, Subcommand, ValueEnum};
use serde::Serialize;
use std::path::PathBuf;

/// Work with calibrated cameras.
#[derive(Debug, ClapArgs)]
pub(super) struct CameraVerbs {
    #[command(subcommand)]
    verb: CameraVerb,
}

#[derive(Debug, Subcommand)]
enum CameraVerb {
    Convert(Args),
}

impl CameraVerbs {
    /// Runs the verb.
    ///
    /// # Errors
    /// As the verb says.
    pub(super) fn run(&self) -> Result<(), Error> {
        match &self.verb {
            CameraVerb::Convert(args) => convert(args),
        }
    }
}

/// Convert a camera to another program or another lens model
///
/// Models differ in shape and direction (smac corrects what was measured, the others distort what
/// is ideal), so the new parameters are a least-squares fit over the whole sensor, and what the
/// fit leaves is said: root mean square and largest distance, in pixels. Pixel positions follow
/// each program's own convention.
///
/// Example: rowgram camera convert camera.toml --to colmap -o cameras.txt
#[derive(Debug, ClapArgs)]
#[command(verbatim_doc_comment)]
struct Args {
    /// The camera.
    camera: PathBuf,
    /// The program whose file is written, or the lens model of another camera.toml.
    #[arg(long, value_enum)]
    to: Target,
    /// The lens model of the program's file; brown with five terms if not given, and the fisheye
    /// where the camera is one.
    #[arg(long, value_enum)]
    model: Option<ModelName>,
    /// Where to write; stdout if not given.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// End with code 3 where a pixel is further off than this after the fit.
    #[arg(long, value_name = "PX", allow_negative_numbers = true)]
    max_residual: Option<f64>,
    /// Print the residual as one line of JSON; needs --output.
    #[arg(long, requires = "output")]
    json: bool,
    /// Replace an output that exists.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Target {
    /// OpenCV's YAML.
    Opencv,
    /// COLMAP's cameras.txt.
    Colmap,
    /// Metashape's calibration XML.
    Metashape,
    /// OpenSfM's camera_models.json.
    Opensfm,
    /// A camera.toml of the smac model.
    Smac,
    /// A camera.toml of Brown's model.
    Brown,
    /// A camera.toml of the fisheye model.
    Fisheye,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ModelName {
    /// k1, k2, p1, p2, k3.
    Brown,
    /// The same and k4, k5, k6.
    Rational,
    /// Equidistant, k1 to k4.
    Fisheye,
}

/// Brown's lens with three radial terms.
pub(super) const BROWN: &[&str] =
    &["f_px", "aspect", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"];
/// The same with three more in a denominator.
pub(super) const RATIONAL: &[&str] =
    &["f_px", "aspect", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"];
/// The equidistant lens.
pub(super) const FISHEYE: &[&str] = &["f_px", "aspect", "cx_px", "cy_px", "k1", "k2", "k3", "k4"];
const SMAC: &[&str] = &["c_px", "xp_px", "yp_px", "K1", "K2", "K3", "P1", "P2"];

#[derive(Serialize)]
struct Report<'a> {
    camera: String,
    from: &'a str,
    to: &'a str,
    exact: bool,
    #[serde(flatten)]
    fit: &'a Fit,
}

fn convert(args: &Args) -> Result<(), Error> {
    if let Some(most) = args.max_residual.filter(|most| !(*most >= 0.0 && most.is_finite())) {
        return Err(Error::Argument(format!("--max-residual {most}: expected pixels, 0 or more")));
    }
    if let Some(path) = &args.output {
        output::check(path, args.force)?;
        if super::segment::same_file(path, &args.camera) {
            return Err(Error::Argument(format!(
                "{} is the camera, expected another output",
                path.display()
            )));
        }
    }
    let source = camera::read(&args.camera)?;
    let (model, free) = wanted(args, source.interior.model())?;
    let exact = same_shape(&source.interior, model, free);
    let found = if exact {
        let points = 0;
        Fit {
            interior: source.interior,
            points,
            left_out: 0,
            rms_px: 0.0,
            largest_px: 0.0,
            largest_at_px: [0.0; 2],
        }
    } else {
        fit(&source.interior, model, free)
            .map_err(|error| Error::Argument(format!("{}: {error}", args.camera.display())))?
    };
    let bad = |message: String| Error::Argument(format!("{}: {message}", args.camera.display()));
    let text = match program(args.to) {
        Some(program) => to_program(&found.interior, &source.name, program).map_err(bad)?,
        None => Camera::new(&source.name, found.interior).to_toml(),
    };
    match &args.output {
        Some(path) => output::write(path, args.force, |out| out.write_all(text.as_bytes()))?,
        None => super::print(&text)?,
    }
    say(args, &source, &found, exact)?;
    match args.max_residual {
        Some(most) if found.largest_px > most => Err(Error::Incomplete(format!(
            "the fit leaves {:.3} px, --max-residual allows {most} px",
            found.largest_px
        ))),
        _ => Ok(()),
    }
}

fn program(target: Target) -> Option<Program> {
    match target {
        Target::Opencv => Some(Program::OpenCv),
        Target::Colmap => Some(Program::Colmap),
        Target::Metashape => Some(Program::Metashape),
        Target::Opensfm => Some(Program::OpenSfm),
        Target::Smac | Target::Brown | Target::Fisheye => None,
    }
}

/// The model and the parameters that the target has.
fn wanted(args: &Args, source: Model) -> Result<(Model, &'static [&'static str]), Error> {
    let own = match args.to {
        Target::Smac => Some((Model::Smac, SMAC)),
        Target::Brown => Some((Model::Brown, RATIONAL)),
        Target::Fisheye => Some((Model::Fisheye, FISHEYE)),
        _ => None,
    };
    if let Some(own) = own {
        return match (args.model, args.to) {
            (None, Target::Brown) => Ok((Model::Brown, BROWN)),
            (None, _) | (Some(ModelName::Rational), Target::Brown) => Ok(own),
            (Some(ModelName::Brown), Target::Brown) => Ok((Model::Brown, BROWN)),
            (Some(_), _) => Err(Error::Argument("--model is for the files of programs".into())),
        };
    }
    let model = args.model.unwrap_or(match source {
        Model::Fisheye => ModelName::Fisheye,
        _ => ModelName::Brown,
    });
    match (model, args.to) {
        (ModelName::Rational, Target::Metashape | Target::Opensfm) => Err(Error::Argument(
            "--model rational: Metashape and OpenSfM have no place for k4, k5, k6".into(),
        )),
        (ModelName::Brown, _) => Ok((Model::Brown, BROWN)),
        (ModelName::Rational, _) => Ok((Model::Brown, RATIONAL)),
        (ModelName::Fisheye, _) => Ok((Model::Fisheye, FISHEYE)),
    }
}

/// Whether the target has all that the source has, so that nothing needs a fit.
fn same_shape(source: &Interior, model: Model, free: &[&str]) -> bool {
    source.model() == model
        && source.parameters().iter().zip(source.values()).enumerate().all(|(k, (p, &value))| {
            free.contains(&p.name) || model.default_value(k, source.size_px()) == Some(value)
        })
}

fn say(args: &Args, source: &Camera, found: &Fit, exact: bool) -> Result<(), Error> {
    if args.json {
        return super::print_json(&Report {
            camera: args.camera.display().to_string(),
            from: source.interior.model().word(),
            to: found.interior.model().word(),
            exact,
            fit: found,
        });
    }
    if exact {
        tracing::info!("the same model: nothing is lost");
        return Ok(());
    }
    tracing::info!(
        "fitted over the sensor: rms {:.4} px, at most {:.4} px at ({:.0}, {:.0})",
        found.rms_px,
        found.largest_px,
        found.largest_at_px[0],
        found.largest_at_px[1]
    );
    if found.left_out > 0 {
        tracing::warn!(
            "{} of {} places of the sensor have no part in it: one of the models has no ray there",
            found.left_out,
            found.left_out + found.points
        );
    }
    Ok(())
}
