//! The files of the stage.

use super::{AlignOutcome, export::Exports, inputs::Inputs};
use rowgram_base::error::Error;
use rowgram_files::{
    camera,
    cloud::{self, CloudPoint},
    orientation, reconstruction,
};
use rowgram_optim::output;
use rowgram_survey::{
    problems::adjustment::Removed,
    scene::{Excluded, ExcludedKind, Reconstruction},
    sfm::adjust_block::AdjustedBlock,
};
use std::path::Path;

/// Folder of the adjustment's report.
pub(super) const REPORT: &str = "report";
/// Folder of the pictures.
pub(super) const FIGURES: &str = "figures";

/// The block with its frame, its accuracies and what was excluded.
pub(super) fn reconstruction(inputs: &Inputs, found: &AdjustedBlock) -> Reconstruction {
    let adjusted = &found.adjusted;
    let excluded = adjusted.validated.excluded.iter().cloned();
    let removed = found.removed.iter().map(Removed::excluded);
    let left_out = inputs.left_out.iter().chain(&inputs.copies).map(|(name, reason)| Excluded {
        kind: ExcludedKind::Image,
        image: Some(name.clone()),
        point: None,
        reason: reason.clone(),
    });
    Reconstruction {
        reference: inputs.reference(found),
        accuracy: Some(adjusted.accuracy()),
        excluded: excluded.chain(removed).chain(left_out).collect(),
        ..adjusted.reconstruction.clone()
    }
}

/// Writes everything but the report and the pictures.
///
/// # Errors
/// Where a file cannot be written.
pub(super) fn write(
    folder: &Path,
    scene: &Reconstruction,
    outcome: &AlignOutcome,
    exports: &Exports,
) -> Result<(), Error> {
    for (k, camera) in scene.calibrated_cameras().iter().enumerate() {
        camera::write(&folder.join(format!("camera-{}.toml", k + 1)), true, camera)?;
    }
    orientation::write(&folder.join("exterior_orientation.csv"), scene, true)?;
    let points: Vec<CloudPoint> = scene
        .points
        .iter()
        .map(|point| CloudPoint { position_m: point.position_m, colour: point.colour })
        .collect();
    cloud::write_ply(&folder.join("cloud.ply"), &points, true)?;
    cloud::write_laz(&folder.join("cloud.laz"), &points, &scene.reference, true)?;
    reconstruction::write(folder, scene, true)?;
    exports.write(folder)?;
    let reference = &scene.reference;
    let definition = reference.definition().map_or_else(String::new, |text| format!("{text}\n"));
    let frame = format!("{}\n{definition}heights: {}\n", reference.name(), reference.heights());
    output::write(&folder.join("crs.txt"), true, |out| out.write_all(frame.as_bytes()))?;
    Ok(output::write_json(&folder.join("align.json"), true, outcome)?)
}
