//! A photo in memory, read between its pixels.
//!
//! Four bytes for a pixel: one load each, and four lanes in the sums. A position is taken up to half a pixel
//! outside the centres of the border pixels, which are repeated. References: R. G. Keys, *Cubic convolution
//! interpolation for digital image processing*, 1981; C. E. Duchon, *Lanczos filtering in one and two
//! dimensions*, 1979.

use crate::raster::undistort::Interpolation;
use image::RgbImage;

/// A photo with four bytes for a pixel, the last one without a meaning.
#[derive(Debug, Clone)]
pub struct Photo {
    width: usize,
    height: usize,
    pixels: Vec<[u8; 4]>,
}

impl Photo {
    /// Takes over a photo.
    pub fn new(photo: &RgbImage) -> Photo {
        let pixels = photo.as_raw().as_chunks::<3>().0.iter().map(|&[r, g, b]| [r, g, b, 0]);
        Photo {
            width: photo.width() as usize,
            height: photo.height() as usize,
            pixels: pixels.collect(),
        }
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
    /// the fourth number has no meaning.
    #[inline]
    pub fn at(&self, at_px: [f32; 2], interpolation: Interpolation) -> [f32; 4] {
        match interpolation {
            Interpolation::Bilinear => self.sum::<2>(at_px, |t| [1.0 - t, t]),
            Interpolation::Bicubic => self.sum::<4>(at_px, |t| {
                [
                    ((-0.5 * t + 1.0) * t - 0.5) * t,
                    (1.5 * t - 2.5) * t * t + 1.0,
                    ((-1.5 * t + 2.0) * t + 0.5) * t,
                    (0.5 * t - 0.5) * t * t,
                ]
            }),
            Interpolation::Lanczos => self.sum::<6>(at_px, lanczos),
        }
    }

    #[inline(always)]
    fn sum<const N: usize>(&self, [u, v]: [f32; 2], weights: impl Fn(f32) -> [f32; N]) -> [f32; 4] {
        let (column, row) = (u.floor(), v.floor());
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
        let photo = Photo::new(&ramp);
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
}
