//! Photos as they are matched: one number for a pixel, in which leaves stand out from soil of the same brightness,
//!
//! ```text
//! m = 1/2 grey + w max(0, G - R)
//! ```
//!
//! between 1 and 255, and 0 where the photo has no data. Between pixels it is read by Keys' cubic convolution.

use crate::mapping::{
    View,
    photo::{DecodedPhoto, cubic, first},
    undistort::Interpolation,
};

/// Weight `w` of the green part of the channel that is matched, 1.5, in 512ths; chosen with the other constants of [`super`].
const GREEN_WEIGHT: u32 = 768;

/// A photo in memory: its colours, and the channel that is matched.
#[derive(Debug, Clone)]
pub struct MatchedPhoto {
    colours: DecodedPhoto,
    /// `m` in 64ths, at least 64, row by row; 0 where there are no data.
    channel: Vec<u16>,
}

/// A photo in memory with its lens and pose.
#[derive(Debug, Clone, Copy)]
pub struct PosedPhoto<'a> {
    /// Lens and pose, in the frame of the ground grid.
    pub view: &'a View,
    /// Its pixels.
    pub photo: &'a MatchedPhoto,
}

impl MatchedPhoto {
    /// Takes over a photo.
    pub fn new(colours: DecodedPhoto) -> MatchedPhoto {
        // In 512ths: half of 0.299, 0.587 and 0.114 for grey.
        let mixed = |&[r, g, b, data]: &[u8; 4]| {
            let [r, g, b] = [r, g, b].map(u32::from);
            let grey = 77 * r + 150 * g + 29 * b;
            let mixed = (grey + GREEN_WEIGHT * g.saturating_sub(r) + 4) >> 3;
            if data == 0 { 0 } else { mixed.clamp(64, 64 * 255) as u16 }
        };
        let channel = colours.pixels().iter().map(mixed).collect();
        MatchedPhoto { colours, channel }
    }

    /// Whether it shows a position: half a pixel beyond the middles of those at the border.
    #[inline(always)]
    fn shows(&self, [u, v]: [f32; 2]) -> bool {
        let [columns, rows] = self.colours.size_px().map(|n| n as f32 - 0.5);
        u >= -0.5 && v >= -0.5 && u <= columns && v <= rows
    }

    /// The channel at positions; 0 where the photo shows nothing.
    pub(super) fn values(&self, at_px: &[[f32; 2]], out: &mut [u8]) {
        pulp::Arch::new().dispatch(Values { photo: self, at_px, out });
    }

    /// The colours at positions; black where the photo shows nothing.
    pub(super) fn colours(&self, at_px: &[[f32; 2]], out: &mut [[u8; 4]]) {
        self.colours.colours(at_px, Interpolation::Bilinear, None, out);
        for (out, &at) in out.iter_mut().zip(at_px) {
            if !self.shows(at) {
                *out = [0; 4];
            }
        }
    }

    /// The channel at a position that the photo shows; 0 where a pixel that takes part has no data.
    #[inline(always)]
    fn value(&self, [u, v]: [f32; 2]) -> u8 {
        let [width, height] = self.colours.size_px();
        let (column, row) = (first(u), first(v));
        let (across, down) = (cubic(u - column), cubic(v - row));
        let (left, top) = (column as isize - 1, row as isize - 1);
        let mut lines = [[0u16; 4]; 4];
        let inside =
            left >= 0 && top >= 0 && left + 4 <= width as isize && top + 4 <= height as isize;
        if inside {
            let from = &self.channel[top as usize * width + left as usize..][..3 * width + 4];
            for (j, line) in lines.iter_mut().enumerate() {
                line.copy_from_slice(&from[j * width..j * width + 4]);
            }
        } else {
            for (j, line) in lines.iter_mut().enumerate() {
                let row = (top + j as isize).clamp(0, height as isize - 1) as usize;
                for (i, value) in line.iter_mut().enumerate() {
                    let column = (left + i as isize).clamp(0, width as isize - 1) as usize;
                    *value = self.channel[row * width + column];
                }
            }
        }
        let (mut sums, mut least) = ([0.0f32; 4], [u16::MAX; 4]);
        for (line, weight) in lines.iter().zip(down) {
            for i in 0..4 {
                sums[i] += weight * f32::from(line[i]);
                least[i] = least[i].min(line[i]);
            }
        }
        let value: f32 = sums.iter().zip(across).map(|(sum, weight)| sum * weight).sum();
        // Beside 2^23 a number has no fractions, and its last byte is the rounded value.
        let byte = ((value / 64.0).clamp(1.0, 255.0) + 8_388_608.0).to_bits() as u8;
        if least.contains(&0) { 0 } else { byte }
    }
}

/// Values at many positions, with the machine's SIMD.
struct Values<'a> {
    photo: &'a MatchedPhoto,
    at_px: &'a [[f32; 2]],
    out: &'a mut [u8],
}

impl pulp::WithSimd for Values<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Values { photo, at_px, out } = self;
        for (out, &at) in out.iter_mut().zip(at_px) {
            *out = if photo.shows(at) { photo.value(at) } else { 0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{Rgb, RgbImage};

    /// Green over red rises along columns; pixels of column 20 have no data.
    fn photo() -> DecodedPhoto {
        let image = RgbImage::from_fn(41, 30, |u, v| Rgb([10, (10 + 2 * u + v) as u8, 20]));
        let gaps: Vec<bool> = (0..41 * 30).map(|at| at % 41 == 20).collect();
        DecodedPhoto::new(&image, Some(&gaps))
    }

    #[test]
    fn values_between_pixels_are_on_the_ramp_and_none_touches_a_gap() {
        let photo = MatchedPhoto::new(photo());
        let exact = |u: f32, v: f32| {
            let above = 2.0 * u + v;
            0.5 * (10.0 + 0.587 * above + 0.114 * 10.0) + 1.5 * above
        };
        let at = [[5.25, 6.5], [33.0, 20.75], [-0.5, 3.0], [40.5, 3.0]];
        let mut out = [0; 4];
        photo.values(&at, &mut out);
        for (at, found) in at.into_iter().zip(out).take(2) {
            assert!((f32::from(found) - exact(at[0], at[1])).abs() <= 1.1, "{at:?} {found}");
        }
        assert!(out[2] > 0 && out[3] > 0);
        let mut out = [9; 6];
        let near =
            [[19.5, 8.0], [20.0, 8.0], [22.1, 8.0], [17.9, 8.0], [-0.6, 8.0], [f32::NAN, 8.0]];
        photo.values(&near, &mut out);
        assert_eq!(out.map(|value| value > 0), [false, false, true, true, false, false]);
        let mut colours = [[9; 4]; 6];
        photo.colours(&near, &mut colours);
        assert_eq!(colours.map(|of| of[3] > 0), [false, false, true, true, false, false]);
    }
}
