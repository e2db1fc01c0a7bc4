//! Leaves over the picture they were found in.

use crate::phenotype::leaves::Leaf;
use image::{Rgb, RgbImage};

/// Colours of neighbouring leaves: hues a golden section of the circle apart.
fn colour(leaf: usize) -> [f64; 3] {
    let hue = (leaf as f64 * 0.618_034).fract() * 6.0;
    let part = |shift: f64| {
        let x = (hue + shift) % 6.0;
        (255.0 * (2.0 - (x - 3.0).abs()).clamp(0.0, 1.0)).round()
    };
    [part(3.0), part(1.0), part(5.0)]
}

/// Tints the pixels of each leaf in a colour of its own and draws its axis.
pub(super) fn leaves(picture: &mut RgbImage, leaves: &[Leaf]) {
    for (index, leaf) in leaves.iter().enumerate() {
        let colour = colour(index);
        for run in &leaf.runs {
            for u in run.start..run.end {
                let pixel = picture.get_pixel_mut(u as u32, run.v as u32);
                for k in 0..3 {
                    let mixed = 0.3 * f64::from(pixel.0[k]) + 0.7 * colour[k];
                    pixel.0[k] = mixed.round() as u8;
                }
            }
        }
    }
    for leaf in leaves {
        for pair in leaf.axis_px.windows(2) {
            let steps = (pair[0][0] - pair[1][0]).hypot(pair[0][1] - pair[1][1]).ceil().max(1.0);
            for step in 0..=steps as usize {
                let t = step as f64 / steps;
                let at = |k: usize| (pair[0][k] + t * (pair[1][k] - pair[0][k])).round();
                let (u, v) = (at(0), at(1));
                if u >= 0.0
                    && v >= 0.0
                    && u < f64::from(picture.width())
                    && v < f64::from(picture.height())
                {
                    picture.put_pixel(u as u32, v as u32, Rgb([255; 3]));
                }
            }
        }
    }
}
