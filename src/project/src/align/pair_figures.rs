//! Two pictures of one pair: its key points and right matches, and the photos in their epipolar
//! geometry, where right points have the same row.

use super::inputs::Photo;
use image::{
    Rgb, RgbImage,
    imageops::{self, FilterType},
};
use nalgebra::{Matrix3, Vector3};
use rowgram_base::error::Error;
use rowgram_files::images;
use rowgram_raster::overlay::draw_line;
use rowgram_survey::{
    camera::{Camera, Lens},
    sfm::{Features, Pair, relative::coplanarity::rectification},
};
use std::path::Path;

/// Rows of the pictures.
const HEIGHT_PX: u32 = 700;

/// Draws both for the pair with the most matches among those with a fair base.
///
/// # Errors
/// Where a photo cannot be read or a picture not be written.
pub(super) fn write(
    folder: &Path,
    (photos, features): (&[Photo], &[Features]),
    cameras: &[Camera],
    pairs: &[Pair],
) -> Result<(), Error> {
    let worth = |pair: &&Pair| (pair.matches.len() as f64 * pair.angle_rad.min(0.3)) as u64;
    let Some(pair) = pairs.iter().max_by_key(worth) else { return Ok(()) };
    let [a, b] = pair.images.map(|k| k as usize);
    let (first, second) =
        (images::read_photo(&photos[a].path)?, images::read_photo(&photos[b].path)?);
    let picture = beside(&first, &second, [&features[a], &features[b]], pair);
    images::write_photo(&folder.join("pair.png"), true, &picture)?;
    let lenses = [&cameras[features[a].camera], &cameras[features[b].camera]];
    if let Some(turns) = rectification(&pair.pose) {
        let picture =
            rectified([&first, &second], lenses, &turns, pair, [&features[a], &features[b]]);
        images::write_photo(&folder.join("pair-rectified.png"), true, &picture)?;
    }
    Ok(())
}

fn beside(first: &RgbImage, second: &RgbImage, features: [&Features; 2], pair: &Pair) -> RgbImage {
    let scales = [first, second].map(|photo| f64::from(HEIGHT_PX) / f64::from(photo.height()));
    let width = |photo: &RgbImage, scale: f64| (f64::from(photo.width()) * scale) as u32;
    let (left, right) = (width(first, scales[0]), width(second, scales[1]));
    let mut picture = RgbImage::new(left + right, HEIGHT_PX);
    for (photo, offset, columns) in [(first, 0, left), (second, i64::from(left), right)] {
        let small = imageops::resize(photo, columns, HEIGHT_PX, FilterType::Nearest);
        imageops::replace(&mut picture, &small, offset, 0);
    }
    let place = |side: usize, at: [f64; 2]| {
        let offset = if side == 0 { 0.0 } else { f64::from(left) };
        [offset + at[0] * scales[side], at[1] * scales[side]]
    };
    for side in 0..2 {
        for &at in features[side].positions_px.iter().step_by(4) {
            draw_line(&mut picture, &[place(side, at); 2], Rgb([255, 210, 0]), 1);
        }
    }
    let every = (pair.matches.len() / 150).max(1);
    for [a, b] in pair.matches.iter().step_by(every) {
        let from = place(0, features[0].positions_px[*a as usize]);
        let to = place(1, features[1].positions_px[*b as usize]);
        draw_line(&mut picture, &[from, to], Rgb([0, 200, 120]), 1);
        for end in [from, to] {
            draw_line(&mut picture, &[end; 2], Rgb([255, 60, 0]), 3);
        }
    }
    picture
}

/// Both photos, resampled into the normalised geometry of the pair, one beside the other, with the
/// rows of some matches.
fn rectified(
    photos: [&RgbImage; 2],
    cameras: [&Camera; 2],
    turns: &[Matrix3<f64>; 2],
    pair: &Pair,
    features: [&Features; 2],
) -> RgbImage {
    // Both windows have the same rows: those that either photo reaches.
    let mut windows = [[f64::INFINITY, f64::NEG_INFINITY, f64::INFINITY, f64::NEG_INFINITY]; 2];
    for side in 0..2 {
        let [w, h] = cameras[side].interior.size_px().map(|n| f64::from(n) - 1.0);
        for corner in [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h], [w / 2.0, 0.0], [w / 2.0, h]] {
            let Some(ray) = cameras[side].interior.unproject(corner) else { continue };
            let r = turns[side] * Vector3::from(ray);
            if r.z < -0.1 {
                let (x, y) = (r.x / -r.z, r.y / -r.z);
                let window = &mut windows[side];
                (window[0], window[1]) = (window[0].min(x), window[1].max(x));
                (window[2], window[3]) = (window[2].min(y), window[3].max(y));
            }
        }
    }
    let top = windows[0][3].max(windows[1][3]);
    let bottom = windows[0][2].min(windows[1][2]);
    let scale = f64::from(HEIGHT_PX) / (top - bottom).max(1e-6);
    let columns = windows.map(|w| (((w[1] - w[0]) * scale) as u32).clamp(1, 4 * HEIGHT_PX));
    let mut picture = RgbImage::new(columns[0] + columns[1], HEIGHT_PX);
    for side in 0..2 {
        let offset = if side == 0 { 0 } else { columns[0] };
        let back = turns[side].transpose();
        for v in 0..HEIGHT_PX {
            for u in 0..columns[side] {
                let x = windows[side][0] + f64::from(u) / scale;
                let y = top - f64::from(v) / scale;
                let r = back * Vector3::new(x, y, -1.0);
                let Some(at) = cameras[side].interior.project(r.into()) else { continue };
                let (column, row) = (at[0].round(), at[1].round());
                let [w, h] = [photos[side].width(), photos[side].height()].map(f64::from);
                if column >= 0.0 && row >= 0.0 && column < w && row < h {
                    let pixel = photos[side].get_pixel(column as u32, row as u32);
                    picture.put_pixel(offset + u, v, *pixel);
                }
            }
        }
    }
    let every = (pair.matches.len() / 40).max(1);
    for found in pair.matches.iter().step_by(every) {
        let mut ends = Vec::new();
        for side in 0..2 {
            let position = features[side].positions_px[found[side] as usize];
            let Some(ray) = cameras[side].interior.unproject(position) else { continue };
            let r = turns[side] * Vector3::from(ray);
            let offset = if side == 0 { 0.0 } else { f64::from(columns[0]) };
            ends.push([
                offset + (r.x / -r.z - windows[side][0]) * scale,
                (top - r.y / -r.z) * scale,
            ]);
        }
        if let [from, to] = ends[..] {
            draw_line(&mut picture, &[from, to], Rgb([0, 200, 120]), 1);
        }
    }
    picture
}
