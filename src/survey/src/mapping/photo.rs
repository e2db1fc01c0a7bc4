//! A photo in memory, read between its pixels.
//!
//! Four bytes for a pixel: one load each, and four lanes in the sums. The fourth is 255, or 0 where the photo has no data;
//! a position has a colour where all pixels that take part in it have data. A position is taken up to half a pixel
//! outside the centres of the border pixels, which are repeated. References: R. G. Keys, *Cubic convolution
//! interpolation for digital image processing*, 1981; C. E. Duchon, *Lanczos filtering in one and two
//! dimensions*, 1979.

use super::colour_correction::{ColourCorrection, PreparedCorrection};
use crate::mapping::undistort::Interpolation;
use image::RgbImage;

/// From here on a byte may have been cut off; JPEG leaves a cut-off value a few below 255.
const SATURATED: u8 = 251;
/// The largest share of such pixels in a window whose mean is used: what they lack moves the mean by much less than its noise.
const MAX_SATURATED: f64 = 0.01;

/// A photo with four bytes for a pixel.
#[derive(Debug, Clone)]
pub struct DecodedPhoto {
    width: usize,
    height: usize,
    pixels: Vec<[u8; 4]>,
}

impl DecodedPhoto {
    /// Takes over a photo, and which of its pixels (row by row) have no data.
    pub fn new(photo: &RgbImage, gaps: Option<&[bool]>) -> DecodedPhoto {
        let pixels = photo.as_raw().as_chunks::<3>().0.iter().map(|&[r, g, b]| [r, g, b, 255]);
        let mut pixels: Vec<[u8; 4]> = pixels.collect();
        for (pixel, &gap) in pixels.iter_mut().zip(gaps.unwrap_or_default()) {
            if gap {
                *pixel = [0; 4];
            }
        }
        DecodedPhoto { width: photo.width() as usize, height: photo.height() as usize, pixels }
    }

    /// Whether a colour of [`DecodedPhoto::at`] is one: all pixels that took part have data.
    #[inline(always)]
    pub fn has_data(colour: [f32; 4]) -> bool {
        (colour[3] - 255.0).abs() < 0.5
    }

    /// The pixels, row by row: red, green, blue, and 0 where there are no data.
    pub fn pixels(&self) -> &[[u8; 4]] {
        &self.pixels
    }

    /// Columns and rows.
    pub fn size_px(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// Bytes of memory.
    pub fn bytes(&self) -> usize {
        4 * self.pixels.len()
    }

    /// The colour at a position, red, green, blue from 0 to 255 (a little beyond where a kernel overshoots);
    /// the fourth number is for [`DecodedPhoto::has_data`].
    #[inline(always)]
    pub fn at(&self, at_px: [f32; 2], interpolation: Interpolation) -> [f32; 4] {
        match interpolation {
            Interpolation::Bilinear => self.bilinear(at_px),
            Interpolation::Bicubic => self.sum::<4>(at_px, cubic),
            Interpolation::Lanczos => self.sum::<6>(at_px, lanczos),
        }
    }

    /// The colours at positions, in bytes, opaque, corrected; all 0 where there are no data.
    pub fn colours(
        &self,
        at_px: &[[f32; 2]],
        interpolation: Interpolation,
        correction: Option<&ColourCorrection>,
        out: &mut [[u8; 4]],
    ) {
        let photo = self;
        let correction = correction.map(ColourCorrection::prepared);
        pulp::Arch::new().dispatch(Colours { photo, at_px, interpolation, correction, out });
    }

    /// The mean of the linear light of a square window, red, green, blue; `light` holds that of each byte. `None` where the window is
    /// not all in the photo, has pixels without data, or more than [`MAX_SATURATED`] of its pixels may be cut off.
    pub(super) fn mean_light(
        &self,
        [u, v]: [f64; 2],
        side_px: usize,
        light: &[f32; 256],
    ) -> Option<[f64; 3]> {
        let half = 0.5 * (side_px as f64 - 1.0);
        let (left, top) = ((u - half).round(), (v - half).round());
        let inside = left >= 0.0
            && top >= 0.0
            && left + side_px as f64 <= self.width as f64
            && top + side_px as f64 <= self.height as f64;
        if !inside {
            return None;
        }
        let (left, top) = (left as usize, top as usize);
        let (mut sums, mut saturated) = ([0.0f32; 3], 0);
        for row in top..top + side_px {
            for pixel in &self.pixels[row * self.width + left..][..side_px] {
                if pixel[3] == 0 {
                    return None;
                }
                saturated += usize::from(pixel[0].max(pixel[1]).max(pixel[2]) >= SATURATED);
                for c in 0..3 {
                    sums[c] += light[usize::from(pixel[c])];
                }
            }
        }
        let count = (side_px * side_px) as f64;
        let usable = saturated as f64 <= MAX_SATURATED * count;
        usable.then(|| sums.map(|sum| f64::from(sum) / count))
    }

    /// As [`Photo::sum`] of two, in loops that need no inlining to be fast.
    #[inline(always)]
    fn bilinear(&self, [u, v]: [f32; 2]) -> [f32; 4] {
        let (column, row) = (first(u), first(v));
        let (s, t) = (u - column, v - row);
        let (i, j) = (column as isize, row as isize);
        let (width, height) = (self.width as isize, self.height as isize);
        let (a, b, c, d);
        if i >= 0 && j >= 0 && i + 1 < width && j + 1 < height {
            let at = j as usize * self.width + i as usize;
            let (top, bottom) = (&self.pixels[at..at + 2], &self.pixels[at + self.width..][..2]);
            (a, b, c, d) = (top[0], top[1], bottom[0], bottom[1]);
        } else {
            let (left, right) = (i.clamp(0, width - 1), (i + 1).clamp(0, width - 1));
            let (top, bottom) = (j.clamp(0, height - 1), (j + 1).clamp(0, height - 1));
            let (above, below) = (top as usize * self.width, bottom as usize * self.width);
            (a, b) = (self.pixels[above + left as usize], self.pixels[above + right as usize]);
            (c, d) = (self.pixels[below + left as usize], self.pixels[below + right as usize]);
        }
        let mut colour = [0.0f32; 4];
        for k in 0..4 {
            let top = (1.0 - s) * f32::from(a[k]) + s * f32::from(b[k]);
            let bottom = (1.0 - s) * f32::from(c[k]) + s * f32::from(d[k]);
            colour[k] = (1.0 - t) * top + t * bottom;
        }
        colour
    }

    #[inline(always)]
    fn sum<const N: usize>(&self, [u, v]: [f32; 2], weights: impl Fn(f32) -> [f32; N]) -> [f32; 4] {
        let (column, row) = (first(u), first(v));
        let (across, down) = (weights(u - column), weights(v - row));
        let reach = N as isize / 2 - 1;
        let (left, top) = (column as isize - reach, row as isize - reach);
        let mut colour = [0.0f32; 4];
        let inside = left >= 0
            && top >= 0
            && left + N as isize <= self.width as isize
            && top + N as isize <= self.height as isize;
        for j in 0..N {
            let mut line = [0.0f32; 4];
            if inside {
                let at = (top as usize + j) * self.width + left as usize;
                for (pixel, weight) in self.pixels[at..at + N].iter().zip(&across) {
                    for c in 0..4 {
                        line[c] += weight * f32::from(pixel[c]);
                    }
                }
            } else {
                let row = (top + j as isize).clamp(0, self.height as isize - 1) as usize;
                for (i, weight) in across.iter().enumerate() {
                    let column = (left + i as isize).clamp(0, self.width as isize - 1) as usize;
                    let pixel = self.pixels[row * self.width + column];
                    for c in 0..4 {
                        line[c] += weight * f32::from(pixel[c]);
                    }
                }
            }
            for c in 0..4 {
                colour[c] += down[j] * line[c];
            }
        }
        colour
    }
}

/// The whole pixels before a position; positions that a lens sends to where no photo is stay within what integers hold.
#[inline(always)]
pub(super) fn first(position_px: f32) -> f32 {
    const FAR_PX: f32 = 1e9;
    position_px.floor().clamp(-FAR_PX, FAR_PX)
}

/// Colours at many positions, with the machine's SIMD.
struct Colours<'a> {
    photo: &'a DecodedPhoto,
    at_px: &'a [[f32; 2]],
    interpolation: Interpolation,
    correction: Option<PreparedCorrection>,
    out: &'a mut [[u8; 4]],
}

impl pulp::WithSimd for Colours<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Colours { photo, at_px, interpolation, correction, out } = self;
        let n = out.len().min(at_px.len());
        let (at_px, out) = (&at_px[..n], &mut out[..n]);
        for i in 0..n {
            let mut colour = match interpolation {
                Interpolation::Bilinear => photo.bilinear(at_px[i]),
                other => photo.at(at_px[i], other),
            };
            let data = (colour[3] - 255.0).abs() < 0.5;
            if let Some(correction) = &correction {
                correction.apply(at_px[i], &mut colour);
            }
            colour[3] = 255.0;
            let mut bytes = [0u8; 4];
            for c in 0..4 {
                // Beside 2^23 a number has no fractions, and its last byte is the rounded colour.
                bytes[c] = (colour[c].clamp(0.0, 255.0) + 8_388_608.0).to_bits() as u8;
            }
            out[i] = if data { bytes } else { [0; 4] };
        }
    }
}

/// Weights of Keys' cubic kernel; they add up to 1.
#[inline(always)]
pub(super) fn cubic(t: f32) -> [f32; 4] {
    [
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    ]
}

/// Weights of Lanczos' kernel with three lobes; they add up to 1.
fn lanczos(t: f32) -> [f32; 6] {
    let mut weights = [0.0; 6];
    for (k, weight) in weights.iter_mut().enumerate() {
        let x = std::f32::consts::PI * (t + 2.0 - k as f32);
        *weight = if x.abs() < 1e-4 { 1.0 } else { 3.0 * x.sin() * (x / 3.0).sin() / (x * x) };
    }
    let sum: f32 = weights.iter().sum();
    weights.map(|weight| weight / sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn straight_ramps_are_kept_and_borders_repeated() {
        let ramp =
            RgbImage::from_fn(30, 20, |u, v| Rgb([(5 * u + 3 * v) as u8, (2 * u) as u8, 40]));
        let photo = DecodedPhoto::new(&ramp, None);
        for kind in [Interpolation::Bilinear, Interpolation::Bicubic] {
            let [r, g, b, _] = photo.at([8.25, 9.5], kind);
            for (found, expected) in [(r, 69.75), (g, 16.5), (b, 40.0)] {
                approx::assert_abs_diff_eq!(found, expected, epsilon = 1e-3);
            }
        }
        let at = photo.at([-0.5, -0.5], Interpolation::Bilinear);
        assert_eq!((at[0], at[1]), (0.0, 0.0));
        for t in [0.0, 0.3, 0.8] {
            assert!((lanczos(t).iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn positions_far_outside_are_read_without_harm() {
        // The polynomials of a lens are far off beyond the photo.
        let photo = DecodedPhoto::new(&RgbImage::from_pixel(8, 6, Rgb([9, 9, 9])), None);
        let far = [1e6, 1e20, f32::MAX, f32::INFINITY, f32::NAN];
        let at_px: Vec<[f32; 2]> =
            far.iter().flat_map(|&x| [[x, 2.0], [2.0, x], [-x, -x], [x, -x]]).collect();
        let mut out = vec![[0; 4]; at_px.len()];
        for kind in [Interpolation::Bilinear, Interpolation::Bicubic, Interpolation::Lanczos] {
            photo.colours(&at_px, kind, None, &mut out);
            assert_eq!(out.len(), at_px.len());
        }
    }
}
