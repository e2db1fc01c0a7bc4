//! Leaf segmentation in rendered photos, in perspective and with the lens's distortion, of which every leaf is known.
//!
//! Scores as in [`crate::leaves`]. Two masks: the true one, and that of the default thresholds on the photo as it came from the
//! sensor, of which components below [`SPECK_PX`] are dropped. A true leaf is one of which the mask shows at
//! least a pixel; its length and width are those of its axis and its blade projected into the photo.

use crate::{
    leaves::{judge, methods, pairs, segment, write},
    locate::make,
};
use data_synth::{
    camera::CameraConfig,
    field::GrowthStage,
    flight::Shot,
    photo::Photo,
    twin::{FlightPreset, Twin, TwinConfig},
};
use rowgram::{
    Error,
    raster::{Mask, components, mask::Thresholds},
};
use std::path::Path;

/// Smaller components of a photo's mask are not leaves, pixels.
const SPECK_PX: usize = 6;

/// Runs everything and writes `leaves_twin.csv` and `leaves_twin.md`.
pub(crate) fn run(out: &Path, photos: usize) -> Result<(), Error> {
    make(out)?;
    let mut runs = Vec::new();
    for stage in [GrowthStage::Early, GrowthStage::Mid, GrowthStage::Late] {
        for gsd_cm in [0.3, 0.6, 1.0, 1.5] {
            let mut config = TwinConfig::preset(FlightPreset::Small);
            config.field.stage = stage;
            let c_px = 100.0 * config.flight.height_m / gsd_cm;
            config.camera = CameraConfig::compact(1000, 750, c_px);
            let twin = config.build().map_err(|error| Error::Argument(error.to_string()))?;
            let studio = twin.studio();
            for k in 0..photos {
                // Evenly spread over the flight.
                let at = (2 * k + 1) * twin.shots.len() / (2 * photos);
                let photo = studio.photo(&twin.shots[at], at);
                let mut found = Thresholds::default().mask(&photo.image);
                components::remove_small(&mut found, SPECK_PX);
                for (name, mask) in [("true mask", true_mask(&photo)), ("photo's mask", found)] {
                    let truth: Vec<u32> = photo
                        .leaves
                        .iter()
                        .zip(&mask.data)
                        .map(|(&leaf, &plant)| if plant != 0 { leaf } else { 0 })
                        .collect();
                    let scenario = format!("{stage}, {gsd_cm} cm/px, {name}");
                    for (method, how) in methods() {
                        let (labels, leaves) = segment(&mask, &how);
                        let mut run = judge(&scenario, method, &labels, &truth);
                        if let Some(leaves) = leaves {
                            let errors: Vec<[f64; 2]> = pairs(&labels, &truth)
                                .into_iter()
                                .filter_map(|(place, number)| {
                                    let [length, width] = size_px(&twin, &twin.shots[at], number)?;
                                    let leaf = &leaves.leaves[place];
                                    Some([
                                        leaf.length_px / length - 1.0,
                                        leaf.max_width_px() / width - 1.0,
                                    ])
                                })
                                .collect();
                            let mean = |k: usize| {
                                let sum: f64 = errors.iter().map(|error| error[k]).sum();
                                (!errors.is_empty()).then(|| sum / errors.len() as f64)
                            };
                            (run.length, run.width) = (mean(0), mean(1));
                        }
                        runs.push(run);
                    }
                }
            }
        }
        write(out, "leaves_twin", &runs)?;
    }
    Ok(())
}

fn true_mask(photo: &Photo) -> Mask {
    let (width, height) = (photo.mask.width() as usize, photo.mask.height() as usize);
    Mask { width, height, data: photo.mask.iter().map(|&x| u8::from(x > 0)).collect() }
}

/// Length and width of a plant's leaf (from 0) as a photo shows them; `None` for weeds, and for leaves that reach out of
/// the photo.
fn size_px(twin: &Twin, shot: &Shot, number: usize) -> Option<[f64; 2]> {
    let field = twin.field();
    let mut all = field.plants.iter().flat_map(|p| p.leaves.iter().map(move |leaf| (p, leaf)));
    let (plant, leaf) = all.nth(number)?;
    let axis_m = field.leaf_axis_m(plant.z_m, leaf);
    let mut length = 0.0;
    let mut last: Option<[f64; 2]> = None;
    for node in axis_m {
        let [u, v] = shot.project(&twin.camera, node)?;
        if !twin.camera.inside([u, v], 0.0) {
            return None;
        }
        length += last.map_or(0.0, |[a, b]| (u - a).hypot(v - b));
        last = Some([u, v]);
    }
    let away_m = shot.centre_m[2] - axis_m[axis_m.len() / 2][2];
    (length > 0.0).then(|| [length, leaf.width_m * twin.camera.config().c_px / away_m])
}
