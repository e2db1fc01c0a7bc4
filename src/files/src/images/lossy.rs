//! Masks that were saved with loss (JPEG): black and white with what compression leaves between them.

use image::DynamicImage;

/// Largest difference of the channels of a pixel that is grey, and the share of pixels that have to be.
const GREY: u8 = 24;
const GREY_SHARE: f64 = 0.995;
/// Black and white after compression: no darker or brighter than this, in the end.
const BLACK: u8 = 64;
const WHITE: u8 = 192;
/// Share of pixels that may lie between: the edges of thin leaves at quality 75 have a tenth.
const BETWEEN_SHARE: f64 = 0.15;

/// 1 where the picture is white, where it is one of black and white; `None` where it is a photo.
pub(super) fn black_and_white(image: &DynamicImage) -> Option<Vec<u8>> {
    let values: Vec<u8> = match image {
        DynamicImage::ImageLuma8(grey) => grey.as_raw().clone(),
        DynamicImage::ImageRgb8(rgb) => {
            let spread = |[r, g, b]: [u8; 3]| r.max(g).max(b) - r.min(g).min(b);
            let grey = rgb.pixels().filter(|pixel| spread(pixel.0) <= GREY).count();
            if (grey as f64) < GREY_SHARE * f64::from(rgb.width()) * f64::from(rgb.height()) {
                return None;
            }
            rgb.pixels().map(|pixel| pixel.0[1]).collect()
        }
        _ => return None,
    };
    let count = |is: &dyn Fn(u8) -> bool| values.iter().filter(|&&value| is(value)).count();
    let (black, white) = (count(&|value| value <= BLACK), count(&|value| value >= WHITE));
    let between = values.len() - black - white;
    let is_mask = black > 0 && white > 0 && between as f64 <= BETWEEN_SHARE * values.len() as f64;
    // A night photo with a lamp is no mask: of each there is some hundredth.
    let least = values.len() / 500;
    (is_mask && black.min(white) >= least)
        .then(|| values.iter().map(|&value| u8::from(value >= 128)).collect())
}
