//! The posterior probability of vegetation of every pixel, by tables.

use super::{
    colour::Converter,
    model::{Model, leaf_green},
    smoothing,
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
        let mut smooth =
            SmoothRows::new(photo, Converter::new(ndvi, model.white_balance), model.smoothing_px);
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

/// Rows of colour smoothed both ways, from the top down.
struct SmoothRows<'a> {
    photo: &'a RgbImage,
    converter: Converter<'a>,
    /// Of a pixel itself, and of those beside it on either side.
    weights: Vec<f32>,
    /// The last rows, smoothed along themselves, and which they are.
    kept: Vec<(usize, Vec<[f32; 2]>)>,
    /// A row with its ends repeated on either side.
    raw: Vec<[f32; 2]>,
}

impl<'a> SmoothRows<'a> {
    fn new(photo: &'a RgbImage, converter: Converter<'a>, reach: usize) -> SmoothRows<'a> {
        let width = photo.width() as usize;
        let kept = vec![(usize::MAX, vec![[0.0; 2]; width]); 2 * reach + 1];
        let raw = vec![[0.0; 2]; width + 2 * reach];
        SmoothRows { photo, converter, weights: smoothing::weights(reach), kept, raw }
    }

    fn smooth(&mut self, v: usize, out: &mut [[f32; 2]]) {
        let (reach, last) = (self.weights.len() - 1, self.photo.height() as usize - 1);
        for row in v.saturating_sub(reach)..=(v + reach).min(last) {
            if self.kept[row % self.kept.len()].0 != row {
                self.load(row);
            }
        }
        let row = |row: usize| &self.kept[row.min(last) % self.kept.len()].1[..];
        out.iter_mut()
            .zip(row(v))
            .for_each(|(out, &here)| *out = here.map(|x| self.weights[0] * x));
        for (away, &weight) in self.weights.iter().enumerate().skip(1) {
            add_pair(row(v.saturating_sub(away)), row(v + away), weight, out);
        }
    }

    fn load(&mut self, v: usize) {
        let (width, reach) = (self.photo.width() as usize, self.weights.len() - 1);
        let bytes = &self.photo.as_raw()[3 * v * width..3 * (v + 1) * width];
        let inner = &mut self.raw[reach..reach + width];
        for (u, (raw, pixel)) in inner.iter_mut().zip(bytes.as_chunks::<3>().0).enumerate() {
            *raw = self.converter.of_pixel(v * width + u, *pixel);
        }
        let (first, end) = (inner[0], inner[width - 1]);
        self.raw[..reach].fill(first);
        self.raw[reach + width..].fill(end);
        let places = self.kept.len();
        let (row, line) = &mut self.kept[v % places];
        *row = v;
        let raw = &self.raw;
        line.iter_mut()
            .zip(&raw[reach..])
            .for_each(|(line, &here)| *line = here.map(|x| self.weights[0] * x));
        for (away, &weight) in self.weights.iter().enumerate().skip(1) {
            add_pair(&raw[reach - away..], &raw[reach + away..], weight, line);
        }
    }
}

/// Adds the values on either side with their weight.
#[inline(always)]
fn add_pair(before: &[[f32; 2]], after: &[[f32; 2]], weight: f32, out: &mut [[f32; 2]]) {
    for (out, (a, b)) in out.iter_mut().zip(before.iter().zip(after)) {
        *out = [0, 1].map(|k| out[k] + weight * (a[k] + b[k]));
    }
}
