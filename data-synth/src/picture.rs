//! The picture that belongs to a mask: leaves over soil in the sun, in sRGB.
//!
//! The picture is made of the same pixels as the mask: leaf colours have hue, saturation and value
//! inside, and soil colours outside, the range that the four-threshold rule of published masks
//! (OpenCV's 8-bit HSV; hue 30 to 79, saturation at least 30 or value at least 163) calls leaf. So
//! segmenting the picture by that rule gives back the mask, exactly.
//!
//! Of the leaves that cover a pixel the highest is seen. Its brightness follows the slope of the
//! blade to the sun, `n . s`, the height in the canopy, and a fold along the midrib, which itself is
//! paler; hue and brightness differ from plant to plant and leaf to leaf. Leaves throw shadows on
//! the ground. Dying leaves are no part of the mask: they have colours of dry straw, and lie below
//! the green ones.

use crate::{
    corrupt::Weed,
    field::Field,
    leaf::{Leaf, NODES},
    render::{BAND_ROWS, Bands, Node, band_rows, project, ribbons, sweep},
    soil::Soil,
};
use image::RgbImage;
use rayon::prelude::*;

/// Unit vector towards the sun (X, Y, Z): south-east, 60 degrees high.
const SUN: [f64; 3] = [0.3536, -0.3536, 0.8660];
/// How far a shadow falls, metres per metre of height.
const SHADOW: [f64; 2] = [-SUN[0] / SUN[2], -SUN[1] / SUN[2]];

/// The picture of all leaves and weeds over soil; its leaf pixels are those of
/// [`mask`](crate::render::mask).
pub fn picture(field: &Field, weeds: &[Weed]) -> RgbImage {
    let frame = &field.frame;
    let ribbons = ribbons(field, weeds);
    let bands = Bands::new(frame, &ribbons, [0.0; 2]);
    let shadow_bands = Bands::new(frame, &ribbons, SHADOW);
    let soil = Soil::new(field.config.seed, frame.gsd_m, field.config.along_across(SUN[0], SUN[1]));
    let tallest_m =
        ribbons.iter().flat_map(|leaf| leaf.axis_m).fold(0.05, |most, node| node[2].max(most));
    // The field's axes at the top-left pixel, and how they change from column to column and row to row.
    let corner = field.config.along_across(frame.left_m, frame.top_m);
    let column = field.config.along_across(frame.gsd_m, 0.0);
    let row = field.config.along_across(0.0, -frame.gsd_m);
    let width = frame.width_px as usize;
    let mut image = RgbImage::new(frame.width_px, frame.height_px);
    image.par_chunks_mut(3 * width * BAND_ROWS).enumerate().for_each(|(band, colours)| {
        let count = colours.len() / (3 * width);
        let rows = band_rows(band, count);
        let mut shade = vec![false; count * width];
        for leaf in shadow_bands.leaves(band, &ribbons) {
            sweep(&project(frame, leaf, SHADOW), width, &rows, |hit| {
                shade[(hit.v - rows.start) * width + hit.u] = true;
            });
        }
        for (index, colour) in colours.chunks_exact_mut(3).enumerate() {
            let (u, v) = (index % width, rows.start + index / width);
            let [along_m, across_m] =
                [0, 1].map(|i| corner[i] + u as f64 * column[i] + v as f64 * row[i]);
            let light = if shade[index] { 0.58 } else { 1.0 };
            let soil = soil.colour(u as i32, v as i32, along_m as f32, across_m as f32);
            colour.copy_from_slice(&soil_pixel(soil.map(|channel| light * channel)));
        }
        // Dying leaves are the lowest of their plants: green ones are drawn over them.
        for leaf in bands.leaves(band, &ribbons).filter(|leaf| leaf.senescent) {
            let slopes = slopes(leaf);
            sweep(&project(frame, leaf, [0.0; 2]), width, &rows, |hit| {
                let light = 0.45 + 0.55 * slopes[hit.segment].along.clamp(0.0, 1.0);
                let red = (200.0 * leaf.brightness * light) as f32;
                let index = (hit.v - rows.start) * width + hit.u;
                let colour = soil_pixel([red, 0.85 * red, 0.5 * red]);
                colours[3 * index..3 * index + 3].copy_from_slice(&colour);
            });
        }
        let mut height_m = vec![f32::NEG_INFINITY; count * width];
        for leaf in bands.leaves(band, &ribbons).filter(|leaf| !leaf.senescent) {
            let nodes = project(frame, leaf, [0.0; 2]);
            let slopes = slopes(leaf);
            sweep(&nodes, width, &rows, |hit| {
                let index = (hit.v - rows.start) * width + hit.u;
                let (a, b): (&Node, &Node) = (&nodes[hit.segment], &nodes[hit.segment + 1]);
                // The round end of a segment shows only where its neighbour leaves a gap.
                let end = hit.along <= 0.0 || hit.along >= 1.0;
                let z_m = a.z_m + hit.along * (b.z_m - a.z_m) - if end { 0.01 } else { 0.0 };
                if z_m as f32 <= height_m[index] {
                    return;
                }
                height_m[index] = z_m as f32;
                let half_px = a.half_px + hit.along * (b.half_px - a.half_px);
                let slope = &slopes[hit.segment];
                // The two halves of a blade are folded up by about 25 degrees.
                let fold = 0.42 * hit.across.signum() * slope.across;
                let light = 0.45 + 0.55 * (slope.along + fold).clamp(0.0, 1.0);
                let depth = 0.72 + 0.28 * z_m / tallest_m;
                let grain = 1.0 + 0.05 * f64::from(soil.grain(hit.u as i32, !(hit.v as i32)));
                // A midrib is about a tenth of the blade's width and fades where pixels are wider.
                let rib = (0.25 * half_px).min(1.0) * (1.0 - hit.across.abs() / 0.16).max(0.0);
                let value = 178.0 * leaf.brightness * light * depth * grain + 34.0 * rib;
                let saturation = 150.0 - 45.0 * rib;
                let leaf_colour = leaf_pixel(leaf.hue_deg - 5.0 * rib, saturation, value);
                colours[3 * index..3 * index + 3].copy_from_slice(&leaf_colour);
            });
        }
    });
    image
}

/// How a segment of a blade lies to the sun.
struct Slope {
    /// Cosine of the angle between the flat blade's upper side and the sun.
    along: f64,
    /// Component of the sun's direction to the right of the axis in the picture, horizontal.
    across: f64,
}

fn slopes(leaf: &Leaf) -> [Slope; NODES - 1] {
    std::array::from_fn(|i| {
        let (a, b) = (leaf.axis_m[i], leaf.axis_m[i + 1]);
        let d = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
        let flat = f64::hypot(d[0], d[1]).max(1e-9);
        let length = f64::hypot(flat, d[2]);
        let (cos, sin) = (flat / length, d[2] / length);
        let toward = [d[0] / flat, d[1] / flat];
        let forward = toward[0] * SUN[0] + toward[1] * SUN[1];
        Slope {
            along: cos * SUN[2] - sin * forward,
            across: toward[0] * SUN[1] - toward[1] * SUN[0],
        }
    })
}

/// A leaf colour, held inside the range that the thresholds call leaf with room for rounding.
fn leaf_pixel(hue_deg: f64, saturation: f64, value: f64) -> [u8; 3] {
    let value = value.clamp(64.0, 235.0);
    let chroma = value * saturation.clamp(75.0, 200.0) / 255.0;
    let sector = hue_deg.clamp(68.0, 140.0) / 60.0;
    let low = value - chroma;
    let middle = low + chroma * (1.0 - (sector % 2.0 - 1.0).abs());
    let [red, blue] = if sector < 2.0 { [middle, low] } else { [low, middle] };
    [red.round() as u8, value.round() as u8, blue.round() as u8]
}

/// A soil colour: red leads green and green leads blue by enough that no rounding makes it green.
fn soil_pixel(colour: [f32; 3]) -> [u8; 3] {
    let red = colour[0].clamp(48.0, 250.0);
    let green = colour[1].clamp(0.6 * red, 0.86 * red);
    let blue = colour[2].clamp(0.4 * red, 0.9 * green);
    [red.round() as u8, green.round() as u8, blue.round() as u8]
}

/// What a pixel looks like that is mistaken for leaf (`gained`) or is not recognised as leaf: algae
/// and seedlings on the one hand, dry and torn tissue on the other, as bright as before.
pub(crate) fn mistaken(colour: [u8; 3], gained: bool) -> [u8; 3] {
    let brightest = f64::from(colour.into_iter().max().unwrap_or(0));
    if gained {
        leaf_pixel(85.0, 120.0, brightest)
    } else {
        let light = 1.1 * brightest as f32;
        soil_pixel([light, 0.82 * light, 0.6 * light])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        field::GrowthStage,
        scenario::{Preset, Scenario},
    };

    /// The published rule on OpenCV's 8-bit HSV, by its defining formula.
    pub(crate) fn is_leaf([r, g, b]: [u8; 3]) -> bool {
        let (r, g, b) = (f64::from(r), f64::from(g), f64::from(b));
        let value = r.max(g).max(b);
        let delta = value - r.min(g).min(b);
        if delta == 0.0 {
            return false;
        }
        let saturation = (255.0 * delta / value).round();
        let hue = if value == r {
            30.0 * (g - b) / delta
        } else if value == g {
            60.0 + 30.0 * (b - r) / delta
        } else {
            120.0 + 30.0 * (r - g) / delta
        };
        let hue = hue.rem_euclid(180.0).round();
        (30.0..=79.0).contains(&hue) && (saturation >= 30.0 || value >= 163.0)
    }

    #[test]
    fn segmenting_the_picture_gives_back_the_mask() {
        for (preset, gsd_m) in [
            (Preset::Early20, 0.015),
            (Preset::Mid20Weedy, 0.004),
            (Preset::Mid20Dirty, 0.01),
            (Preset::Late15, 0.02),
        ] {
            let mut scenario = Scenario::preset(preset);
            scenario.field.row_length_m = 1.5;
            scenario.field.rows = 3;
            scenario.field.gsd_m = gsd_m;
            let scene = scenario.build().unwrap();
            let (mask, picture) = scene.mask_and_picture();
            assert_eq!(mask, scene.mask());
            let wrong = mask.pixels().zip(picture.pixels());
            let wrong = wrong.filter(|(m, p)| (m.0[0] == 255) != is_leaf(p.0)).count();
            assert_eq!(wrong, 0, "{preset:?}");
        }
    }

    #[test]
    fn every_colour_is_on_its_side_of_the_thresholds() {
        for hue in (0..360).step_by(3) {
            for value in (0..400).step_by(3) {
                for saturation in [0.0, 80.0, 150.0, 400.0] {
                    let colour = leaf_pixel(f64::from(hue), saturation, f64::from(value));
                    assert!(is_leaf(colour), "{colour:?}");
                }
            }
        }
        for red in (0..300).step_by(2) {
            for green in (0..300).step_by(7) {
                for blue in (0..300).step_by(11) {
                    let colour = soil_pixel([red as f32, green as f32, blue as f32]);
                    assert!(!is_leaf(colour), "{colour:?}");
                }
            }
        }
    }

    #[test]
    fn neighbouring_leaves_differ_in_colour() {
        let mut scenario = Scenario::preset(Preset::Late30);
        scenario.field.stage = GrowthStage::Late;
        let field = crate::field::Field::plant(&scenario.field).unwrap();
        let hues: Vec<f64> = field.leaves().map(|leaf| leaf.hue_deg).collect();
        let mean = hues.iter().sum::<f64>() / hues.len() as f64;
        let deviation =
            (hues.iter().map(|h| (h - mean).powi(2)).sum::<f64>() / hues.len() as f64).sqrt();
        assert!((3.0..8.0).contains(&deviation), "{deviation}");
    }
}
