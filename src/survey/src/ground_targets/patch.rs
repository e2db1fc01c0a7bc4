//! Pieces of photos in grey, and levels of them with fewer pixels.

use image::GrayImage;

/// A piece of a photo. Its pixel `(i, j)` has its centre at `origin_px + factor (i, j)` in the photo.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Patch {
    pub(super) origin_px: [f64; 2],
    pub(super) factor: f64,
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) data: Vec<f32>,
}

impl Patch {
    /// What a photo shows within `half_px` of a place; `None` where that is not a pixel of it.
    pub(super) fn cut(photo: &GrayImage, centre_px: [f64; 2], half_px: f64) -> Option<Patch> {
        let range = |axis: usize, size: u32| {
            let low = (centre_px[axis] - half_px).floor().max(0.0) as usize;
            let high = (centre_px[axis] + half_px).ceil().min(f64::from(size) - 1.0);
            (high >= low as f64).then(|| low..high as usize + 1)
        };
        let (columns, rows) = (range(0, photo.width())?, range(1, photo.height())?);
        let stride = photo.width() as usize;
        let pixels = photo.as_raw();
        let data = rows.clone().flat_map(|row| {
            let line = &pixels[row * stride + columns.start..row * stride + columns.end];
            line.iter().map(|&value| f32::from(value))
        });
        Some(Patch {
            origin_px: [columns.start as f64, rows.start as f64],
            factor: 1.0,
            width: columns.len(),
            height: rows.len(),
            data: data.collect(),
        })
    }

    /// The same with every `factor` x `factor` pixels as their mean.
    pub(super) fn reduced(&self, factor: usize) -> Patch {
        if factor <= 1 {
            return self.clone();
        }
        let (width, height) = (self.width / factor, self.height / factor);
        let share = 1.0 / (factor * factor) as f32;
        let data = (0..width * height).map(|k| {
            let (i, j) = (k % width.max(1) * factor, k / width.max(1) * factor);
            let rows = (j..j + factor).map(|row| {
                self.data[row * self.width + i..row * self.width + i + factor].iter().sum::<f32>()
            });
            share * rows.sum::<f32>()
        });
        let shift = 0.5 * (factor as f64 - 1.0) * self.factor;
        Patch {
            origin_px: self.origin_px.map(|at| at + shift),
            factor: self.factor * factor as f64,
            width,
            height,
            data: data.collect(),
        }
    }

    /// A place of the photo in pixels of this.
    pub(super) fn in_patch(&self, at_px: [f64; 2]) -> [f64; 2] {
        std::array::from_fn(|k| (at_px[k] - self.origin_px[k]) / self.factor)
    }

    /// A place of this in the photo.
    pub(super) fn to_photo(&self, at: [f64; 2]) -> [f64; 2] {
        std::array::from_fn(|k| self.origin_px[k] + self.factor * at[k])
    }

    /// The grey value at a place of the photo, bilinear; `None` outside.
    pub(super) fn sample(&self, at_px: [f64; 2]) -> Option<f64> {
        let [u, v] = self.in_patch(at_px);
        if !(u >= 0.0 && v >= 0.0) {
            return None;
        }
        let (column, row) = (u as usize, v as usize);
        if column + 1 >= self.width || row + 1 >= self.height {
            return None;
        }
        let (du, dv) = (u - column as f64, v - row as f64);
        let at = |k: usize| f64::from(self.data[row * self.width + column + k]);
        let mix = |a: f64, b: f64, share: f64| a + share * (b - a);
        Some(mix(mix(at(0), at(1), du), mix(at(self.width), at(self.width + 1), du), dv))
    }

    /// The pixels within `half` of a place that it has, as columns and rows.
    pub(super) fn window(
        &self,
        at: [f64; 2],
        half: f64,
    ) -> (std::ops::Range<usize>, std::ops::Range<usize>) {
        let range = |axis: usize, size: usize| {
            let low = (at[axis] - half).ceil().max(0.0) as usize;
            let end = ((at[axis] + half).floor() + 1.0).clamp(0.0, size as f64) as usize;
            low.min(end)..end
        };
        (range(0, self.width), range(1, self.height))
    }
}
