//! The scale space: layers of growing blur, in octaves of halving size.
//!
//! Layer `s` of octave `o` has the blur `1.6 * 2^(s/3)` in its own pixels, `s = 0..=5`; the base of the
//! next octave is every second pixel of layer 3, whose blur is twice that of the base. The photo is
//! taken to have a blur of 0.5 px already.
//!
//! With doubling, octave 0 has twice the photo's size, and its pixel `(x, y)` stands at `(x, y) / 2` in the
//! photo: even pixels are the photo's, odd ones the mean of their neighbours. So positions found there
//! carry no shift. [`Upscale::HalfPixel`] interpolates at `(x - 0.5) / 2` instead but keeps `x / 2` as
//! the position, as OpenCV does by default: everything is found a quarter of a pixel too far right
//! and down.

use super::{
    Upscale,
    blur::{Kernel, Rows, blur, mirror},
};
use image::GrayImage;
use rayon::prelude::*;

/// Scales per octave at which extrema are looked for.
pub(super) const SCALES: usize = 3;
/// Layers of an octave.
pub(super) const LAYERS: usize = SCALES + 3;
/// Blur of the base of an octave, in its pixels.
pub(super) const BASE_SIGMA_PX: f64 = 1.6;
/// Blur that a photo has to begin with.
const PHOTO_SIGMA_PX: f64 = 0.5;
/// Pixels at the border of each layer where nothing is looked for.
pub(super) const BORDER: usize = 5;
/// Rows begin at multiples of this, so that they are whole numbers of registers.
pub(super) const LANE_MULTIPLE: usize = 16;

/// A single-precision picture, grey values 0 to 255; what stands between `width` and `stride` in a
/// row is no part of it.
#[derive(Debug, Clone)]
pub(super) struct Layer {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) stride: usize,
    pub(super) data: Vec<f32>,
}

impl Layer {
    pub(super) fn new(width: usize, height: usize) -> Layer {
        let stride = width.next_multiple_of(LANE_MULTIPLE);
        Layer { width, height, stride, data: vec![0.0; stride * height] }
    }

    #[cfg(test)]
    pub(super) fn at(&self, column: usize, row: usize) -> f32 {
        self.data[row * self.stride + column]
    }

    /// Every second pixel of every second row.
    fn halved(&self) -> Layer {
        let mut half = Layer::new(self.width / 2, self.height / 2);
        let (stride, width) = (half.stride, half.width);
        if width > 0 {
            half.data.par_chunks_mut(64 * stride).enumerate().for_each(|(band, rows)| {
                for (line, out) in rows.chunks_exact_mut(stride).enumerate() {
                    let row = &self.data[2 * (64 * band + line) * self.stride..][..self.width];
                    for (out, pair) in out.iter_mut().zip(row.chunks_exact(2)) {
                        *out = pair[0];
                    }
                }
            });
        }
        half
    }
}

/// The photo at its own size.
struct Plain<'a>(&'a GrayImage);

impl Rows for Plain<'_> {
    fn size(&self) -> (usize, usize) {
        (self.0.width() as usize, self.0.height() as usize)
    }

    fn read(&self, row: usize, from: isize, out: &mut [f32]) {
        let (width, _) = self.size();
        let line = &self.0.as_raw()[row * width..][..width];
        for (k, value) in out.iter_mut().enumerate() {
            *value = f32::from(line[mirror(from + k as isize, width)]);
        }
    }
}

/// The photo at twice its size.
struct Doubled<'a> {
    photo: &'a GrayImage,
    half_pixel: bool,
}

impl Doubled<'_> {
    /// Photo pixels before and after position `x` of the doubled picture, and the second one's weight.
    #[inline(always)]
    fn between(&self, x: usize, length: usize) -> (usize, usize, f32) {
        let last = length - 1;
        let (before, weight) = match (self.half_pixel, x % 2) {
            (false, 0) => (x / 2, 0.0),
            (false, _) => (x / 2, 0.5),
            (true, 0) => ((x / 2).wrapping_sub(1), 0.75),
            (true, _) => (x / 2, 0.25),
        };
        if before > last { (0, 0, 0.0) } else { (before, (before + 1).min(last), weight) }
    }
}

impl Rows for Doubled<'_> {
    fn size(&self) -> (usize, usize) {
        (2 * self.photo.width() as usize, 2 * self.photo.height() as usize)
    }

    fn read(&self, row: usize, from: isize, out: &mut [f32]) {
        let (width, height) = self.size();
        let photo_width = width / 2;
        let (above, below, weight) = self.between(row, height / 2);
        let bytes = self.photo.as_raw();
        let above = &bytes[above * photo_width..][..photo_width];
        let below = &bytes[below * photo_width..][..photo_width];
        // Photo columns `first..` cover the pixels asked for that lie inside.
        let inside = from.clamp(0, width as isize) as usize;
        let end = (from + out.len() as isize).clamp(0, width as isize) as usize;
        let mut line = [0.0f32; 512];
        if out.len() <= 512 && from >= 2 && (from + out.len() as isize) < width as isize - 2 {
            let first = inside / 2 - 1;
            let count = end / 2 + 2 - first;
            for ((value, &a), &b) in
                line[..count].iter_mut().zip(&above[first..]).zip(&below[first..])
            {
                *value = f32::from(a) * (1.0 - weight) + f32::from(b) * weight;
            }
            let (even, odd) =
                if self.half_pixel { ((0.25, 0.75), 0.25) } else { ((0.0, 1.0), 0.5) };
            let start = inside % 2;
            for (k, value) in out.iter_mut().enumerate() {
                let at = (start + k) / 2 + 1;
                *value = if (start + k).is_multiple_of(2) {
                    line[at - 1] * even.0 + line[at] * even.1
                } else {
                    line[at] * (1.0 - odd) + line[at + 1] * odd
                };
            }
            return;
        }
        for (k, value) in out.iter_mut().enumerate() {
            let column = mirror(from + k as isize, width);
            let (before, after, along) = self.between(column, photo_width);
            let at = |u: usize| f32::from(above[u]) * (1.0 - weight) + f32::from(below[u]) * weight;
            *value = at(before) * (1.0 - along) + at(after) * along;
        }
    }
}

/// One octave: its six layers.
pub(super) type Octave = [Layer; LAYERS];

/// Makes the octaves one after the other.
pub(super) struct Pyramid {
    kernels: Vec<Kernel>,
    base: Option<Layer>,
}

impl Pyramid {
    pub(super) fn new(photo: &GrayImage, upscale: Upscale) -> Pyramid {
        let factor = upscale.factor();
        let (width, height) = (photo.width() as usize, photo.height() as usize);
        let have = PHOTO_SIGMA_PX * f64::from(factor);
        let kernel = Kernel::gaussian((BASE_SIGMA_PX.powi(2) - have.powi(2)).max(0.01).sqrt());
        let mut base = Layer::new(width * factor as usize, height * factor as usize);
        if width > 0 && height > 0 {
            match upscale {
                Upscale::None => blur(&Plain(photo), &kernel, &mut base),
                Upscale::Precise => {
                    blur(&Doubled { photo, half_pixel: false }, &kernel, &mut base);
                }
                Upscale::HalfPixel => {
                    blur(&Doubled { photo, half_pixel: true }, &kernel, &mut base);
                }
            }
        }
        let step = 2.0f64.powf(1.0 / SCALES as f64);
        let kernels = (1..LAYERS).map(|layer| {
            let before = BASE_SIGMA_PX * step.powi(layer as i32 - 1);
            Kernel::gaussian(before * (step * step - 1.0).sqrt())
        });
        Pyramid { kernels: kernels.collect(), base: Some(base) }
    }

    /// The next octave, or `None` where it would be too small for anything to be found.
    pub(super) fn next_octave(&mut self) -> Option<Octave> {
        let base = self.base.take()?;
        if base.width.min(base.height) <= 2 * BORDER {
            return None;
        }
        let (width, height) = (base.width, base.height);
        let mut layers: Octave = std::array::from_fn(|_| Layer::new(0, 0));
        layers[0] = base;
        for (layer, kernel) in self.kernels.iter().enumerate() {
            let mut next = Layer::new(width, height);
            blur(&layers[layer], kernel, &mut next);
            layers[layer + 1] = next;
        }
        self.base = Some(layers[SCALES].halved());
        Some(layers)
    }
}
