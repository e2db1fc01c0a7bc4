//! Leaf or soil: the thresholds on hue, saturation and brightness against the true mask of a photo.

use crate::stage::{Measured, Metric, Stage, metric};
use data_synth::twin::{FlightPreset, TwinConfig};
use image::{GrayImage, RgbImage};
use rowgram::raster::mask::Thresholds;
use serde::{Deserialize, Serialize};
use std::sync::{Arc, Mutex};

/// What can be varied.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    /// The field, the flight and the light; the photo in the middle of the flight is taken.
    twin: TwinConfig,
    /// Least hue, half degrees.
    tau1: i64,
    /// Largest hue, half degrees.
    tau2: i64,
    /// Least saturation.
    tau3: i64,
    /// Least value.
    tau4: i64,
}

impl Default for Parameters {
    fn default() -> Parameters {
        let mut twin = TwinConfig::preset(FlightPreset::Small);
        (twin.camera.width_px, twin.camera.height_px, twin.camera.c_px) = (500, 375, 400.0);
        (twin.field.rows, twin.field.row_length_m) = (8, 8.0);
        (twin.targets.control, twin.targets.check) = (0, 0);
        twin.flight.margin_m = 0.0;
        twin.tie_points.per_photo = 0;
        Parameters { twin, tau1: 30, tau2: 79, tau3: 30, tau4: 163 }
    }
}

/// The stage.
pub(crate) struct Segment;

impl Stage for Segment {
    type Parameters = Parameters;
    const NAME: &'static str = "segment";
    const ABOUT: &'static str = "leaf thresholds against the true mask of a rendered photo";
    const METRICS: &'static [Metric] = &[
        metric("f1", "F1 of leaf pixels"),
        metric("iou", "intersection over union of leaf pixels"),
        metric("precision", "share of the found pixels that are leaf"),
        metric("recall", "share of the leaf pixels found"),
        metric("area_ratio", "found over true leaf area"),
        metric("leaf_share", "share of the photo that is leaf"),
    ];
    const SEEDED: &'static [&'static str] = &["twin.field.seed"];

    fn check(p: &Parameters) -> Result<(), String> {
        p.twin.check().map_err(|e| e.to_string())?;
        Thresholds::new(p.tau1, p.tau2, p.tau3, p.tau4).map(drop).map_err(|e| e.to_string())
    }

    fn run(p: &Parameters, seed: u64) -> Result<Measured, String> {
        let mut twin = p.twin.clone();
        twin.field.seed = seed;
        let photo = photo(&twin)?;
        let (picture, truth) = photo.as_ref();
        let thresholds =
            Thresholds::new(p.tau1, p.tau2, p.tau3, p.tau4).map_err(|e| e.to_string())?;
        let found = thresholds.mask(picture);
        let mut counts = [0.0; 4];
        for (&found, &leaf) in found.data.iter().zip(truth.as_raw()) {
            counts[2 * usize::from(found != 0) + usize::from(leaf != 0)] += 1.0;
        }
        let [_, missed, wrong, right] = counts;
        let mut measured = Measured::default();
        measured.put("f1", 2.0 * right / (2.0 * right + missed + wrong));
        measured.put("iou", right / (right + missed + wrong));
        measured.put("precision", right / (right + wrong));
        measured.put("recall", right / (right + missed));
        measured.put("area_ratio", (right + wrong) / (right + missed));
        measured.put("leaf_share", (right + missed) / counts.iter().sum::<f64>());
        Ok(measured)
    }
}

type Rendered = Arc<(RgbImage, GrayImage)>;

/// Photos of the last few configurations: a sweep over thresholds takes the same photo again and
/// again, and rendering it is all the work.
static TAKEN: Mutex<Vec<(String, Rendered)>> = Mutex::new(Vec::new());
const KEPT: usize = 16;

fn photo(config: &TwinConfig) -> Result<Rendered, String> {
    let key = toml::to_string(config).map_err(|e| e.to_string())?;
    let poisoned = |_| "another thread failed while it took photos".to_owned();
    if let Some((_, photo)) = TAKEN.lock().map_err(poisoned)?.iter().find(|(of, _)| *of == key) {
        return Ok(photo.clone());
    }
    let twin = config.build().map_err(|e| e.to_string())?;
    let middle = twin.shots.len() / 2;
    let shot = twin.shots.get(middle).ok_or("the flight has no photo")?;
    let photo = twin.studio().photo(shot, middle);
    let photo = Arc::new((photo.image, photo.mask));
    let mut taken = TAKEN.lock().map_err(poisoned)?;
    if taken.len() >= KEPT {
        taken.remove(0);
    }
    taken.push((key, photo.clone()));
    Ok(photo)
}
