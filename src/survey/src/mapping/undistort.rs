//! Photos without distortion: every pixel of an ideal camera takes its colour from where its ray
//! meets the photo.
//!
//! ```text
//! out(p) = photo(u(r(p)))      r: ray of pixel p in the ideal camera, u: lens of the photo
//! ```
//!
//! Pixels whose rays the photo does not show are black. Between pixels the photo is interpolated:
//! linearly, by Keys' cubic kernel (`a = -1/2`) or by Lanczos' kernel of three lobes. References:
//! R. G. Keys, *Cubic convolution interpolation for digital image processing*, 1981; C. E. Duchon,
//! *Lanczos filtering in one and two dimensions*, 1979.

use crate::camera::{CameraError, Interior, Lens, Model};
use crate::mapping::photo::DecodedPhoto;
use image::RgbImage;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// How a photo is read between its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Interpolation {
    /// From 2 x 2 pixels.
    Bilinear,
    /// From 4 x 4 pixels.
    #[default]
    Bicubic,
    /// From 6 x 6 pixels.
    Lanczos,
}

rowgram_base::choices!(Interpolation: Bilinear, Bicubic, Lanczos);

/// Which part of the undistorted plane the picture shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Crop {
    /// As many pixels as the photo, the principal point where it was.
    #[default]
    Same,
    /// The largest picture around the principal point without black.
    Inside,
    /// Everything that the photo shows.
    All,
}

rowgram_base::choices!(Crop: Same, Inside, All);

/// More than so many times the sides of the photo is refused.
const MAX_GROWTH: f64 = 4.0;
/// Points along each side of the photo by which its outline is followed.
const OUTLINE: u32 = 200;

/// The ideal camera of the undistorted photos: no distortion, square pixels, the principal distance
/// of `from` times `scale`.
///
/// # Errors
/// Where the photo has rays at its border for which a flat picture has no place, or would become
/// too large.
pub fn ideal_camera(from: &Interior, crop: Crop, scale: f64) -> Result<Interior, CameraError> {
    if !(scale.is_finite() && scale > 0.0) {
        return Err(CameraError(format!("scale {scale}: expected a positive number")));
    }
    let principal_px = from
        .project([0.0, 0.0, -1.0])
        .ok_or_else(|| CameraError("the lens has no image of its own axis".into()))?;
    let f = from.principal_distance_px() * scale;
    let [width, height] = from.size_px();
    let pinhole = |size: [u32; 2], centre: [f64; 2]| {
        let mut values = [0.0; 12];
        values[..4].copy_from_slice(&[f, 1.0, centre[0], centre[1]]);
        Interior::new(Model::Brown, size, &values)
    };
    if crop == Crop::Same {
        return pinhole([width, height], principal_px);
    }
    // Left, right, top, bottom: how far each side of the photo reaches, relative to the axis.
    let (right, bottom) = (f64::from(width) - 1.0, f64::from(height) - 1.0);
    let ideal = |u: f64, v: f64| {
        from.unproject([u, v])
            .filter(|ray| ray[2] < -1e-3)
            .map(|ray| [-f * ray[0] / ray[2], f * ray[1] / ray[2]])
    };
    let mut sides: [Vec<f64>; 4] = Default::default();
    for k in 0..=OUTLINE {
        let share = f64::from(k) / f64::from(OUTLINE);
        let (u, v) = (share * right, share * bottom);
        for (side, axis, at) in
            [(0, 0, (0.0, v)), (1, 0, (right, v)), (2, 1, (u, 0.0)), (3, 1, (u, bottom))]
        {
            let Some(point) = ideal(at.0, at.1) else {
                if crop == Crop::Inside {
                    continue;
                }
                return Err(CameraError(format!(
                    "pixel ({:.0}, {:.0}) of the photo looks too far aside for a flat picture; crop to the inside",
                    at.0, at.1
                )));
            };
            sides[side].push(point[axis]);
        }
    }
    let least = |values: &[f64]| values.iter().copied().fold(f64::INFINITY, f64::min);
    let most = |values: &[f64]| values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let [l, r, t, b] = match crop {
        Crop::Inside => [most(&sides[0]), least(&sides[1]), most(&sides[2]), least(&sides[3])],
        _ => [least(&sides[0]), most(&sides[1]), least(&sides[2]), most(&sides[3])],
    };
    if !(l < 0.0 && r > 0.0 && t < 0.0 && b > 0.0 && (r - l + b - t).is_finite()) {
        return Err(CameraError("the photo does not surround its own principal point".into()));
    }
    let (columns, rows) = match crop {
        Crop::Inside => ((l.ceil(), r.floor()), (t.ceil(), b.floor())),
        _ => ((l.floor(), r.ceil()), (t.floor(), b.ceil())),
    };
    let size = [columns.1 - columns.0 + 1.0, rows.1 - rows.0 + 1.0];
    if size[0] > MAX_GROWTH * f64::from(width) || size[1] > MAX_GROWTH * f64::from(height) {
        return Err(CameraError(format!(
            "the whole photo would become {:.0} x {:.0} pixels; crop it or give a smaller scale",
            size[0], size[1]
        )));
    }
    pinhole(size.map(|n| n as u32), [-columns.0, -rows.0])
}

/// A photo as the ideal camera `to` would have taken it, and how many of its pixels are black
/// because the photo does not show them.
///
/// # Errors
/// Where the photo's size is not that of its camera.
pub fn undistort(
    photo: &RgbImage,
    from: &Interior,
    to: &Interior,
    interpolation: Interpolation,
) -> Result<(RgbImage, usize), CameraError> {
    let size = [photo.width(), photo.height()];
    if size != from.size_px() {
        return Err(CameraError(format!(
            "the photo has {} x {} pixels, the camera {} x {}",
            size[0],
            size[1],
            from.size_px()[0],
            from.size_px()[1]
        )));
    }
    let photo = DecodedPhoto::new(photo, None);
    // More than half a pixel outside there is no colour.
    let inside =
        |at_px: &[f64; 2]| (0..2).all(|k| at_px[k] >= -0.5 && at_px[k] <= f64::from(size[k]) - 0.5);
    let [width, height] = to.size_px();
    let row_bytes = 3 * width as usize;
    let mut bytes = vec![0; row_bytes * height as usize];
    let black: usize = bytes
        .par_chunks_mut(row_bytes)
        .enumerate()
        .map(|(v, row)| {
            let mut black = 0;
            for (u, pixel) in row.chunks_exact_mut(3).enumerate() {
                let ray = to.unproject([u as f64, v as f64]);
                let Some(at_px) = ray.and_then(|ray| from.project(ray)).filter(inside) else {
                    black += 1;
                    continue;
                };
                let colour = photo.at(at_px.map(|v| v as f32), interpolation);
                for (byte, value) in pixel.iter_mut().zip(colour) {
                    *byte = value.round().clamp(0.0, 255.0) as u8;
                }
            }
            black
        })
        .sum();
    let image = RgbImage::from_raw(width, height, bytes)
        .ok_or_else(|| CameraError("the undistorted photo has no pixel".into()))?;
    Ok((image, black))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    fn brown(values: [f64; 6]) -> Interior {
        let mut all = [0.0; 12];
        all[..6].copy_from_slice(&values);
        Interior::new(Model::Brown, [120, 90], &all).unwrap()
    }

    #[test]
    fn a_camera_without_distortion_changes_nothing() {
        let camera = brown([100.0, 1.0, 57.3, 46.1, 0.0, 0.0]);
        let photo =
            RgbImage::from_fn(120, 90, |u, v| Rgb([(u * v) as u8, (2 * u + v) as u8, u as u8]));
        let ideal = ideal_camera(&camera, Crop::Same, 1.0).unwrap();
        for kind in [Interpolation::Bilinear, Interpolation::Bicubic, Interpolation::Lanczos] {
            let (same, black) = undistort(&photo, &camera, &ideal, kind).unwrap();
            assert_eq!((&same, black), (&photo, 0), "{kind:?}");
        }
    }

    #[test]
    fn crops_show_everything_or_no_black() {
        // A barrel: its corners reach further out when undistorted.
        let camera = brown([80.0, 1.0, 60.0, 44.0, -0.15, 0.0]);
        let photo = RgbImage::from_pixel(120, 90, Rgb([200; 3]));
        let sizes: Vec<[u32; 2]> = [Crop::Inside, Crop::Same, Crop::All]
            .into_iter()
            .map(|crop| {
                let ideal = ideal_camera(&camera, crop, 1.0).unwrap();
                let (_, black) =
                    undistort(&photo, &camera, &ideal, Interpolation::Bilinear).unwrap();
                assert_eq!(black == 0, crop != Crop::All, "{crop:?}: {black}");
                ideal.size_px()
            })
            .collect();
        assert!(sizes[0][0] > 120 && sizes[2][0] > sizes[0][0], "{sizes:?}");
        assert!(ideal_camera(&camera, Crop::All, 0.0).is_err());
        let wrong = undistort(&RgbImage::new(3, 3), &camera, &camera, Interpolation::Bilinear);
        assert!(wrong.unwrap_err().to_string().contains("3 x 3 pixels"));
    }
}
