//! The block for other programs: COLMAP's files and OpenSfM's.
//!
//! Neither has the paper's lens, so it is written as the nearest one they have, and what that leaves is said in pixels.
//! Neither has a shutter that rolls: positions are those in the middle of the exposure.

use crate::camera::{BROWN, FISHEYE, RATIONAL};
use rowgram_base::{error::Error, monitor::Diagnostic};
use rowgram_files::{colmap, model::Model, opensfm};
use rowgram_optim::output::FileError;
use rowgram_survey::{
    camera::Model as LensModel, problems::lens_fit::fit, scene::Reconstruction,
    sfm::adjust_block::gsd_m,
};
use std::path::Path;

/// What each program is given.
pub(super) struct Exports {
    colmap: Option<Model>,
    opensfm: Option<Model>,
    /// What is lost on the way.
    pub(super) diagnostics: Vec<Diagnostic>,
}

impl Exports {
    /// The block as each program can hold it.
    pub(super) fn of(block: &Reconstruction) -> Exports {
        let mut diagnostics = Vec::new();
        let mut held = |program: &str, brown: &'static [&'static str]| {
            let lenses = [(LensModel::Brown, brown), (LensModel::Fisheye, FISHEYE)];
            let (survey, notes) = lenses_held(block, &lenses, program);
            diagnostics.extend(notes);
            survey.map(|survey| Model { survey, ..Model::default() })
        };
        // The one with six radial terms, the other with three.
        let (colmap, opensfm) = (held("COLMAP", RATIONAL), held("OpenSfM", BROWN));
        let written = colmap.is_some() || opensfm.is_some();
        if let Some(shift_px) = rolled_px(block).filter(|_| written) {
            let message = format!(
                "the files for COLMAP and OpenSfM cannot hold it: their poses are those in the middle of the exposure, \
                 and measurements in the first and the last row are up to {shift_px:.1} px off"
            );
            diagnostics.push(Diagnostic::info(
                "export-without-shutter",
                "rolling shutter",
                message,
            ));
        }
        Exports { colmap, opensfm, diagnostics }
    }

    /// Writes both.
    ///
    /// # Errors
    /// Where a file cannot be written.
    pub(super) fn write(&self, root: &Path) -> Result<(), Error> {
        if let Some(model) = &self.colmap {
            let at = folder(root, "colmap")?;
            colmap::write(&at, model, colmap::Form::Text, true)?;
        }
        if let Some(model) = &self.opensfm {
            let at = folder(root, "opensfm")?;
            opensfm::write(&at.join("reconstruction.json"), &at.join("tracks.csv"), model, true)?;
        }
        Ok(())
    }
}

fn folder(root: &Path, name: &str) -> Result<std::path::PathBuf, FileError> {
    let path = root.join(name);
    std::fs::create_dir_all(&path).map_err(|e| FileError::write(&path, e))?;
    Ok(path)
}

/// The block with the nearest of the lenses that a program has in place of the paper's; `None` where one is near none.
fn lenses_held(
    block: &Reconstruction,
    lenses: &[(LensModel, &[&str])],
    program: &str,
) -> (Option<Reconstruction>, Vec<Diagnostic>) {
    let mut survey = block.clone();
    let mut notes = Vec::new();
    for camera in &mut survey.cameras {
        if camera.interior.model() != LensModel::Smac {
            continue;
        }
        let nearest = lenses
            .iter()
            .filter_map(|(model, free)| fit(&camera.interior, *model, free).ok())
            // A lens without a place for the corners is none.
            .filter(|fit| fit.left_out == 0)
            .min_by(|a, b| a.rms_px.total_cmp(&b.rms_px));
        let Some(fit) = nearest else {
            let message = format!(
                "{program} has no lens model that comes near this one: files for {program} are not written"
            );
            notes.push(Diagnostic::warning("export-not-possible", subject(camera), message));
            return (None, notes);
        };
        let message = format!(
            "{program} has no smac lens: its files have the nearest {} lens, {:.3} px off (root mean square, at most {:.2}); \
             reconstruction.json and camera-*.toml have the lens itself",
            fit.interior.model().word(),
            fit.rms_px,
            fit.largest_px
        );
        notes.push(Diagnostic::info("export-approximated", subject(camera), message));
        camera.interior = fit.interior;
        camera.expected = None;
    }
    (Some(survey), notes)
}

/// What a camera is called, also where it has no name.
fn subject(camera: &rowgram_survey::camera::Camera) -> &str {
    if camera.name.is_empty() { "the camera" } else { &camera.name }
}

/// How far measurements in the first and the last row are from where a shutter that does not roll would have
/// them, in the image where it is most, pixels; `None` where no image moves.
fn rolled_px(block: &Reconstruction) -> Option<f64> {
    let gsd_m = gsd_m(block);
    let most = block
        .images
        .iter()
        .map(|image| {
            let length = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
            let interior = &block.cameras[image.camera].interior;
            let turned_px = length(&image.motion[..3]) * interior.principal_distance_px();
            0.5 * (turned_px + length(&image.motion[3..]) / gsd_m)
        })
        .fold(0.0, f64::max);
    (most > 0.05 && most.is_finite()).then_some(most)
}
