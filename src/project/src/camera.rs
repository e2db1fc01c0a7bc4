//! A calibrated camera in the format of another program, or with another lens model.

use rowgram_base::error::Error;
use rowgram_files::camera::{Program, to_program};
use rowgram_survey::{
    camera::{Camera, Interior, Lens, Model},
    problems::lens_fit::{Fit, fit},
};
use serde::{Deserialize, Serialize};

/// What a camera is converted to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CameraFormat {
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

/// The lens model of a converted camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ConvertedLens {
    /// k1, k2, p1, p2, k3.
    Brown,
    /// The same and k4, k5, k6.
    Rational,
    /// Equidistant, k1 to k4.
    Fisheye,
}

rowgram_base::choices!(CameraFormat: Opencv, Colmap, Metashape, Opensfm, Smac, Brown, Fisheye);
rowgram_base::choices!(ConvertedLens: Brown, Rational, Fisheye);

/// Brown's lens with three radial terms.
pub const BROWN: &[&str] = &["f_px", "aspect", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"];
/// The same with three more in a denominator.
pub const RATIONAL: &[&str] =
    &["f_px", "aspect", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"];
/// The equidistant lens.
pub const FISHEYE: &[&str] = &["f_px", "aspect", "cx_px", "cy_px", "k1", "k2", "k3", "k4"];
const SMAC: &[&str] = &["c_px", "xp_px", "yp_px", "K1", "K2", "K3", "P1", "P2"];

/// A converted camera.
#[derive(Debug, Clone, PartialEq)]
pub struct ConvertedCamera {
    /// The content of its file.
    pub text: String,
    /// Whether the formats have the same lens model, so that nothing was fitted.
    pub is_exact: bool,
    /// The lens, and what the fit leaves.
    pub fit: Fit,
}

/// Converts a camera to another program's format or another lens model.
///
/// Models differ in shape and direction (smac corrects what was measured, the others distort what is ideal), so the new
/// parameters are a least-squares fit over the whole sensor.
///
/// # Errors
/// A lens that the format does not have, and a fit that cannot be made.
pub fn convert_camera(
    source: &Camera,
    format: CameraFormat,
    lens: Option<ConvertedLens>,
) -> Result<ConvertedCamera, Error> {
    let (model, free) = wanted(format, lens, source.interior.model())?;
    let is_exact = has_same_lens(&source.interior, model, free);
    let found = if is_exact {
        Fit {
            interior: source.interior,
            points: 0,
            left_out: 0,
            rms_px: 0.0,
            largest_px: 0.0,
            largest_at_px: [0.0; 2],
        }
    } else {
        fit(&source.interior, model, free).map_err(|error| Error::Argument(error.to_string()))?
    };
    let text = match program(format) {
        Some(program) => {
            to_program(&found.interior, &source.name, program).map_err(Error::Argument)?
        }
        None => Camera::new(&source.name, found.interior).to_toml(),
    };
    Ok(ConvertedCamera { text, is_exact, fit: found })
}

fn program(format: CameraFormat) -> Option<Program> {
    match format {
        CameraFormat::Opencv => Some(Program::OpenCv),
        CameraFormat::Colmap => Some(Program::Colmap),
        CameraFormat::Metashape => Some(Program::Metashape),
        CameraFormat::Opensfm => Some(Program::OpenSfm),
        CameraFormat::Smac | CameraFormat::Brown | CameraFormat::Fisheye => None,
    }
}

/// The model and the parameters that the format has.
fn wanted(
    format: CameraFormat,
    lens: Option<ConvertedLens>,
    source: Model,
) -> Result<(Model, &'static [&'static str]), Error> {
    let own = match format {
        CameraFormat::Smac => Some((Model::Smac, SMAC)),
        CameraFormat::Brown => Some((Model::Brown, RATIONAL)),
        CameraFormat::Fisheye => Some((Model::Fisheye, FISHEYE)),
        _ => None,
    };
    if let Some(own) = own {
        return match (lens, format) {
            (None | Some(ConvertedLens::Brown), CameraFormat::Brown) => Ok((Model::Brown, BROWN)),
            (None, _) | (Some(ConvertedLens::Rational), CameraFormat::Brown) => Ok(own),
            (Some(_), _) => Err(Error::Argument("--model is for the files of programs".into())),
        };
    }
    let lens = lens.unwrap_or(match source {
        Model::Fisheye => ConvertedLens::Fisheye,
        _ => ConvertedLens::Brown,
    });
    match (lens, format) {
        (ConvertedLens::Rational, CameraFormat::Metashape | CameraFormat::Opensfm) => {
            Err(Error::Argument(
                "--model rational: Metashape and OpenSfM have no place for k4, k5, k6".into(),
            ))
        }
        (ConvertedLens::Brown, _) => Ok((Model::Brown, BROWN)),
        (ConvertedLens::Rational, _) => Ok((Model::Brown, RATIONAL)),
        (ConvertedLens::Fisheye, _) => Ok((Model::Fisheye, FISHEYE)),
    }
}

/// Whether the format has all that the source has, so that nothing needs a fit.
fn has_same_lens(source: &Interior, model: Model, free: &[&str]) -> bool {
    source.model() == model
        && source.parameters().iter().zip(source.values()).enumerate().all(|(k, (p, &value))| {
            free.contains(&p.name) || model.default_value(k, source.size_px()) == Some(value)
        })
}
