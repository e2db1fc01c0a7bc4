//! The posterior probability of vegetation of every pixel, by tables.

use super::{
    colour::Converter,
    model::{Model, leaf_green},
};
use image::RgbImage;
use rayon::prelude::*;

/// Rows of one task. Any number gives the same.
const BAND: usize = 32;
/// Steps of the table of posteriors per unit of log odds, and the log odds at its ends.
const TABLE: (f32, f32) = (32.0, 12.0);

/// Place of a pixel centre in -1..1.
pub(super) fn from_middle(at: usize, size: usize) -> f64 {
    (2 * at + 1) as f64 / size as f64 - 1.0
}

/// Posterior of every pixel in 1/255, of rows from `first` on of a photo that has `height` in all.
pub(super) fn posteriors(
    photo: &RgbImage,
    ndvi: Option<&[f32]>,
    model: &Model,
    first: usize,
    height: usize,
) -> Vec<u8> {
    let (width, rows) = (photo.width() as usize, photo.height() as usize);
    let (per_unit, end) = TABLE;
    let entry = |i: usize| {
        let log_odds = i as f32 / per_unit - end;
        (255.0 / (1.0 + (-log_odds).exp())).round() as u8
    };
    let table: Vec<u8> = (0..=(2.0 * end * per_unit) as usize).map(entry).collect();
    let last = (table.len() - 1) as f32;
    let scale = model.log_odds_per_unit() as f32 * per_unit;
    let yellow_weight = model.yellow_weight as f32;
    let offset = -(model.threshold + model.yellow_weight * model.yellow_mean) as f32;
    let mut posterior = vec![0; width * rows];
    let bands = posterior.par_chunks_mut((BAND * width).max(1)).enumerate();
    bands.for_each(|(band, out)| {
        let mut smooth = SmoothRows::new(photo, Converter::new(ndvi, model.white_balance));
        let mut line: Vec<[f32; 2]> = vec![[0.0; 2]; width];
        for (index, out) in out.chunks_mut(width).enumerate() {
            let v = band * BAND + index;
            smooth.smooth(v, &mut line);
            let [s0, s1, s2] =
                model.surface_of_row(from_middle(first + v, height)).map(|s| s as f32);
            let pixel = 2.0 / width as f32;
            let left = 0.5 * pixel - 1.0;
            for (u, (out, &[green, yellow])) in out.iter_mut().zip(&line).enumerate() {
                let x = left + pixel * u as f32;
                let surface = s0 + x * (s1 + x * s2);
                let z = leaf_green(green, yellow) + yellow_weight * yellow - surface + offset;
                let at = (z * scale + end * per_unit).clamp(0.0, last);
                *out = table[at as usize];
            }
        }
    });
    posterior
}

/// Rows of colour smoothed both ways ([`Converter::weights`]), from the top down.
struct SmoothRows<'a> {
    photo: &'a RgbImage,
    converter: Converter<'a>,
    /// The last rows, smoothed along themselves, and which they are.
    kept: [(usize, Vec<[f32; 2]>); 3],
    raw: Vec<[f32; 2]>,
}

impl<'a> SmoothRows<'a> {
    fn new(photo: &'a RgbImage, converter: Converter<'a>) -> SmoothRows<'a> {
        let empty = || (usize::MAX, vec![[0.0; 2]; photo.width() as usize]);
        let kept = [empty(), empty(), empty()];
        let raw = vec![[0.0; 2]; photo.width() as usize];
        SmoothRows { photo, converter, kept, raw }
    }

    fn smooth(&mut self, v: usize, out: &mut [[f32; 2]]) {
        let last = self.photo.height() as usize - 1;
        let rows = [v.saturating_sub(1), v, (v + 1).min(last)];
        for row in rows {
            if self.kept[row % 3].0 != row {
                self.load(row);
            }
        }
        let [beside, middle] = self.converter.weights();
        let [above, here, below] = rows.map(|row| &self.kept[row % 3].1);
        for (out, ((a, h), b)) in out.iter_mut().zip(above.iter().zip(here).zip(below)) {
            *out = [0, 1].map(|k| beside * (a[k] + b[k]) + middle * h[k]);
        }
    }

    fn load(&mut self, v: usize) {
        let width = self.photo.width() as usize;
        let bytes = &self.photo.as_raw()[3 * v * width..3 * (v + 1) * width];
        for (u, (raw, pixel)) in self.raw.iter_mut().zip(bytes.as_chunks::<3>().0).enumerate() {
            *raw = self.converter.of_pixel(v * width + u, *pixel);
        }
        let (row, line) = &mut self.kept[v % 3];
        *row = v;
        let raw = &self.raw;
        let [beside, middle] = self.converter.weights();
        let mix = |a: [f32; 2], h: [f32; 2], b: [f32; 2]| {
            [0, 1].map(|k| beside * (a[k] + b[k]) + middle * h[k])
        };
        for (line, near) in line[1..].iter_mut().zip(raw.windows(3)) {
            *line = mix(near[0], near[1], near[2]);
        }
        line[0] = mix(raw[0], raw[0], raw[1.min(width - 1)]);
        line[width - 1] = mix(raw[width.saturating_sub(2)], raw[width - 1], raw[width - 1]);
    }
}
