//! Pictures as numbers: leaf masks made from photos, cleaned, and drawn.
//!
//! A picture is stored row by row from the top; pixel `(u, v)` is column `u` of row `v`, and its
//! **centre** has the coordinates `(u, v)`, so the top-left pixel reaches from -0.5 to 0.5. Photos
//! are [`image::RgbImage`]s, leaf masks are [`Mask`]s.
//!
//! - [`hsv`]: colour to hue, saturation, value, in OpenCV's 8-bit convention;
//! - [`mask`]: four thresholds on those, giving the leaf mask;
//! - [`vegetation`]: vegetation estimated from the photo itself, a posterior per pixel;
//! - [`components`]: small components and holes of a mask;
//! - [`overlay`]: masks and points drawn over photos;
//! - [`srgb`]: the bytes of a picture as linear light and back;
//! - [`spectral`]: bands by name, and indices of them;
//! - [`georeference`]: where a raster lies on the map;
//! - [`height_counts`]: percentiles of heights in little memory;
//! - [`window`]: rasters by bands of rows.

pub mod clip;
pub mod components;
pub mod crs;
pub mod density;
pub mod georeference;
pub mod height_counts;
pub mod hsv;
pub mod mask;
pub mod overlay;
mod pixels;
pub mod polygon;
mod simplex;
pub mod spectral;
pub mod srgb;
pub mod tuning;
pub mod vegetation;
pub mod window;

use image::RgbImage;

/// Which pixels of a picture are plant: 1 where they are, 0 elsewhere.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    /// Number of columns, in pixels.
    pub width: usize,
    /// Number of rows, in pixels.
    pub height: usize,
    /// One byte, 0 or 1, for each pixel, row by row; `width * height` of them.
    pub data: Vec<u8>,
}

impl Mask {
    /// A mask without a plant pixel.
    pub fn empty(width: usize, height: usize) -> Mask {
        Mask { width, height, data: vec![0; width * height] }
    }

    /// The mask whose pixel `(u, v)` is plant where `plant(u, v)` says so.
    pub fn from_fn(
        width: usize,
        height: usize,
        mut plant: impl FnMut(usize, usize) -> bool,
    ) -> Mask {
        let mut data = Vec::with_capacity(width * height);
        for v in 0..height {
            data.extend((0..width).map(|u| u8::from(plant(u, v))));
        }
        Mask { width, height, data }
    }

    /// Whether pixel `(u, v)` is plant; pixels outside the mask are not.
    pub fn get(&self, u: usize, v: usize) -> bool {
        u < self.width && self.data.get(v * self.width + u).is_some_and(|&pixel| pixel != 0)
    }

    /// Number of plant pixels, the `alpha` of the paper.
    pub fn count(&self) -> usize {
        self.data.iter().filter(|&&pixel| pixel != 0).count()
    }

    /// Row `v`, or an empty slice below the last one.
    pub fn row(&self, v: usize) -> &[u8] {
        let start = v.saturating_mul(self.width);
        self.data.get(start..start.saturating_add(self.width)).unwrap_or(&[])
    }

    /// The plant pixels `(u, v)`, row by row.
    pub fn plant_pixels(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let width = self.width.max(1);
        let plant = self.data.iter().enumerate().filter(|&(_, &pixel)| pixel != 0);
        plant.map(move |(index, _)| (index % width, index / width))
    }

    /// The mask as a picture: plants white on black.
    pub fn to_rgb(&self) -> RgbImage {
        RgbImage::from_fn(self.width as u32, self.height as u32, |u, v| {
            let value = if self.get(u as usize, v as usize) { 255 } else { 0 };
            image::Rgb([value; 3])
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_knows_its_pixels() {
        let mask = Mask::from_fn(3, 2, |u, v| u == 2 && v == 0 || u == 0 && v == 1);
        assert_eq!(mask.data, [0, 0, 1, 1, 0, 0]);
        assert_eq!(mask.count(), 2);
        assert_eq!(mask.plant_pixels().collect::<Vec<_>>(), [(2, 0), (0, 1)]);
        assert!(mask.get(2, 0) && !mask.get(3, 0) && !mask.get(0, 2));
        assert_eq!((mask.row(1), mask.row(2)), (&[1, 0, 0][..], &[][..]));
        assert_eq!(mask.to_rgb().get_pixel(0, 1).0, [255; 3]);
        assert_eq!(Mask::empty(0, 5).plant_pixels().count(), 0);
    }
}
