//! One connected part of a mask, in a picture of its own.
//!
//! Leaves never reach across background, so every part is worked on alone: nothing depends on how a
//! mask was cut or in which order or by how many threads its parts are done.

use rowgram_raster::components::Part;

/// Background around the part, so that no neighbourhood ends at a border.
pub(super) const PAD: usize = 6;

/// A part's pixels in a padded picture; an index counts its pixels row by row.
pub(super) struct Local {
    pub(super) width: usize,
    pub(super) height: usize,
    /// 1 where the part is.
    pub(super) mask: Vec<u8>,
    /// The part's pixels, ascending.
    pub(super) pixels: Vec<u32>,
    /// Column and row of the picture's first pixel, negative where the padding leaves the mask.
    pub(super) origin: [i64; 2],
}

impl Local {
    pub(super) fn of(part: &Part) -> Local {
        let window = part.window;
        let (width, height) = (window.width + 2 * PAD, window.height + 2 * PAD);
        let mut mask = vec![0; width * height];
        let mut pixels = Vec::with_capacity(part.pixels);
        for run in &part.runs {
            let row = (run.v as usize - window.v + PAD) * width;
            let start = row + run.start as usize - window.u + PAD;
            let end = start + run.len();
            mask[start..end].fill(1);
            pixels.extend(start as u32..end as u32);
        }
        let origin = [window.u as i64 - PAD as i64, window.v as i64 - PAD as i64];
        Local { width, height, mask, pixels, origin }
    }

    /// Column and row of a pixel, in the local picture.
    pub(super) fn at(&self, pixel: u32) -> [f64; 2] {
        let (pixel, width) = (pixel as usize, self.width);
        [(pixel % width) as f64, (pixel / width) as f64]
    }

    /// The pixel of the part in which a position lies.
    pub(super) fn pixel(&self, [u, v]: [f64; 2]) -> Option<u32> {
        let (u, v) = (u.round(), v.round());
        let within = u >= 0.0 && v >= 0.0 && u < self.width as f64 && v < self.height as f64;
        let pixel = v.max(0.0) as usize * self.width + u.max(0.0) as usize;
        (within && self.mask[pixel] != 0).then_some(pixel as u32)
    }

    /// The eight neighbours of a pixel that is not in the padding.
    pub(super) fn neighbours(&self, pixel: u32) -> [u32; 8] {
        let width = self.width as u32;
        [
            pixel - width - 1,
            pixel - width,
            pixel - width + 1,
            pixel - 1,
            pixel + 1,
            pixel + width - 1,
            pixel + width,
            pixel + width + 1,
        ]
    }
}
