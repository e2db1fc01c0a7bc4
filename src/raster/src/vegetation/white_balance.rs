//! White balance from the soil of a photo, so that the leaf mask depends less on the camera's white balance and on the colour of the light.
//!
//! The constants of the model hold in usual light. Where most of the background has one colour, and it is a colour that soils do not have, red and blue
//! are scaled so that it becomes the nearest colour of soil. A background of several colours (trays, bricks, cloth) says nothing of the light.
//!
//! Masks of wheat, potatoes and rosettes agree with the true ones as well as without. With red and blue multiplied by 1.2 and 0.8 wheat agrees to 0.58 of the
//! union instead of 0.41 and potatoes to 0.77 instead of 0.69; with 0.85 and 1.2 wheat to 0.58 instead of 0.54.

use super::model::{GREENEST_SOIL, MARGIN, Model, Sample};
use crate::srgb::linear_light;

/// Logarithms of linear red and of linear blue over green: the middle of the range of soils, and half its width. Fifty photos of fields of maize, wheat, rice and
/// potato have 0.02 to 0.35 and -0.58 to -0.01, four of carrots and the synthetic fields 0.26 to 0.49; red soil of orchards has up to 0.7.
const RED_OF_SOIL: (f64, f64) = (0.24, 0.23);
const BLUE_OF_SOIL: (f64, f64) = (-0.28, 0.3);
/// Greatest logarithm of a gain: a factor of two. Not compared with others.
const MAX_LOG_GAIN: f64 = 0.7;
/// On the axis of colour: half the width of the peak, the reddest peak that is soil, and the bins in which it is sought. The shares below were measured with
/// these; others were not compared.
const HALF_WIDTH: f64 = 5.0;
const REDDEST_SOIL: f64 = -14.0;
const STEP: f64 = 1.0;
/// The peak needs these shares of the photo (not compared with others) and of the background: soil of 75 photos of fields and trees has 39 to 100 % of the background in it (two of them less than 67 %), 16 trays 5
/// to 15 %.
const MIN_SHARE: f64 = 0.1;
const MIN_BACKGROUND_SHARE: f64 = 0.5;

/// What linear red, green and blue have to be multiplied by; `colour` gives the sRGB colour of a sample. All 1 where the background says nothing of the light.
pub(super) fn gains(
    model: &Model,
    samples: &[Sample],
    colour: impl Fn(usize) -> [u8; 3],
) -> [f64; 3] {
    let limit = model.threshold - MARGIN * (model.vegetation - model.background);
    let z = samples.iter().map(|sample| model.z(sample)).enumerate();
    let background: Vec<(usize, f64)> = z.filter(|(_, z)| *z < limit).collect();
    let mut counts = vec![0usize; ((GREENEST_SOIL - REDDEST_SOIL) / STEP).ceil() as usize];
    for (_, z) in &background {
        let bin = ((z - REDDEST_SOIL) / STEP).floor();
        if bin >= 0.0 && (bin as usize) < counts.len() {
            counts[bin as usize] += 1;
        }
    }
    let Some(bin) = (0..counts.len()).max_by_key(|&bin| counts[bin]) else { return [1.0; 3] };
    let peak = REDDEST_SOIL + STEP * (bin as f64 + 0.5);
    let (mut sum, mut count) = ([0.0; 3], 0.0);
    for (k, _) in background.iter().filter(|(_, z)| (z - peak).abs() < HALF_WIDTH) {
        let light = colour(*k).map(|byte| linear_light(f64::from(byte)));
        (0..3).for_each(|c| sum[c] += light[c]);
        count += 1.0;
    }
    let is_uniform = count >= MIN_BACKGROUND_SHARE * background.len() as f64;
    if count < MIN_SHARE * samples.len() as f64 || !is_uniform || sum.contains(&0.0) {
        return [1.0; 3];
    }
    let gain = |c: usize, (middle, tolerance): (f64, f64)| {
        let log_gain = middle - (sum[c] / sum[1]).ln();
        let beyond = (log_gain.abs() - tolerance).clamp(0.0, MAX_LOG_GAIN);
        (beyond * log_gain.signum()).exp()
    };
    [gain(0, RED_OF_SOIL), 1.0, gain(2, BLUE_OF_SOIL)]
}
