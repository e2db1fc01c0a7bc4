//! Whether a photo is enlarged before features are looked for.

use super::When;
use rowgram_survey::features;

/// Photos with as many pixels show enough without being enlarged: so do 12 synthetic photos of 12 megapixels (docs/decisions.md). Between
/// that and the half-size flights of 3 megapixels, which are enlarged, nothing was measured.
const FULL_SIZE_PX: u64 = 8_000_000;
/// This share of the most features is enough. Not measured: it keeps what photos with little texture had before.
const ENOUGH: f64 = 0.75;

/// The features of a photo, enlarged where that is asked for or needed.
pub(super) fn detect(
    grey: &image::GrayImage,
    options: &features::FeatureOptions,
    enlarge: When,
) -> features::Features {
    let own_size = features::FeatureOptions { upscale: features::Upscale::None, ..*options };
    let is_large = u64::from(grey.width()) * u64::from(grey.height()) >= FULL_SIZE_PX;
    match enlarge {
        When::Off => features::detect(grey, &own_size),
        When::Auto if is_large => {
            let found = features::detect(grey, &own_size);
            let enough = ENOUGH * options.max_features as f64;
            if (found.key_points.len() as f64) < enough {
                return features::detect(grey, options);
            }
            found
        }
        When::On | When::Auto => features::detect(grey, options),
    }
}
