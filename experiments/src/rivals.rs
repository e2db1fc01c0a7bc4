//! What leaf masks and counts of plants are compared with: methods of a few lines.

use image::RgbImage;
use rowgram::{
    phenotype::plant_mass,
    raster::{Mask, components, srgb::linear_light, tuning::otsu},
};

/// Excess green over the sum of the channels, above Otsu's threshold.
pub(crate) fn excess_green(photo: &RgbImage) -> Mask {
    let of = |pixel: &image::Rgb<u8>| {
        let [r, g, b] = pixel.0.map(f64::from);
        (2.0 * g - r - b) / (r + g + b).max(1.0)
    };
    above_otsu(photo, of)
}

/// What is below Otsu's threshold of a*, green to red, of L*a*b* (sRGB, D65).
pub(crate) fn green_of_lab(photo: &RgbImage) -> Mask {
    let linear: Vec<f64> = (0..256).map(|c| linear_light(f64::from(c))).collect();
    let f = |t: f64| if t > 0.008856 { t.cbrt() } else { 7.787 * t + 16.0 / 116.0 };
    above_otsu(photo, |pixel| {
        let [r, g, b] = pixel.0.map(|c| linear[usize::from(c)]);
        let x = (0.4124 * r + 0.3576 * g + 0.1805 * b) / 0.9505;
        f(0.2126 * r + 0.7152 * g + 0.0722 * b) - f(x)
    })
}

fn above_otsu(photo: &RgbImage, of: impl Fn(&image::Rgb<u8>) -> f64) -> Mask {
    let values: Vec<f64> = photo.pixels().map(of).collect();
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let bin = |value: f64| (255.0 * (value - low) / (high - low).max(1e-12)) as u8;
    let mut histogram = [0; 256];
    values.iter().for_each(|&value| histogram[usize::from(bin(value))] += 1);
    let threshold = otsu(&histogram);
    let data = values.iter().map(|&value| u8::from(bin(value) > threshold)).collect();
    Mask { width: photo.width() as usize, height: photo.height() as usize, data }
}

/// The rival: components of at least so many pixels, each with `round(area / median area)` plants, side by side.
pub(crate) fn by_area(mask: &Mask, least: usize) -> Vec<[f64; 2]> {
    let parts: Vec<_> =
        components::parts(mask).into_iter().filter(|part| part.pixels >= least).collect();
    let mut areas: Vec<usize> = parts.iter().map(|part| part.pixels).collect();
    areas.sort_unstable();
    let Some(&middle) = areas.get(areas.len() / 2) else { return Vec::new() };
    let places = parts.iter().flat_map(|part| {
        let plants = ((part.pixels as f64 / middle as f64).round() as usize).max(1);
        plant_mass::split(part, plants)
    });
    places.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rival_counts_discs_by_their_area() {
        let photo = RgbImage::from_fn(120, 40, |u, v| {
            let near = |at: f64| (f64::from(u) - at).hypot(f64::from(v) - 20.0) < 7.0;
            let leaf = [15.0, 45.0, 75.0, 86.0].iter().any(|&at| near(at));
            image::Rgb(if leaf { [60, 140, 50] } else { [130, 110, 90] })
        });
        for mask in [excess_green(&photo), green_of_lab(&photo)] {
            assert_eq!(by_area(&mask, 10).len(), 4);
        }
    }
}
