//! Vegetation estimated from the photo itself: a posterior per pixel and the leaf mask of least energy.
//!
//! ```text
//! E(y) = sum_i -ln P(y_i | z_i) + lambda sum_(i,j) w_ij [y_i != y_j],   y_i in {vegetation, background},
//! ```
//!
//! over 4-neighbours `(i, j)`. The posterior `P` comes from two classes along one axis of colour, both estimated
//! from the photo with weak priors ([`Model`]); `w_ij` is small across edges of the posterior, and `E` is decreased
//! by iterated conditional modes ([`coherence`]). Pixels that show nothing (nodata, borders of a mosaic, alpha:
//! [`nothing`]) take no part in the estimate and are never vegetation.
//!
//! Photos are read by bands of rows on all threads; the result does not depend on their number.

pub mod coherence;
mod colour;
mod model;
pub mod nothing;

pub use coherence::Coherence;
pub use model::Model;

use super::Mask;
use colour::Converter;
use image::RgbImage;
use model::{Sample, leaf_green};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Rows of one task.
const BAND: usize = 32;
/// Pixels that the classes are estimated from, about.
const SAMPLES: usize = 120_000;
/// Steps of the table of posteriors per unit of log odds, and the log odds at its ends.
const TABLE: (f32, f32) = (32.0, 12.0);

/// How vegetation is found.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Options {
    /// How neighbouring pixels are made to agree.
    pub coherence: Coherence,
    /// A flat black or white surround of the picture shows nothing.
    pub find_borders: bool,
}

impl Default for Options {
    fn default() -> Options {
        Options { coherence: Coherence::default(), find_borders: true }
    }
}

/// Why vegetation cannot be estimated.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum VegetationError {
    /// The mask of valid pixels has another size than the photo.
    #[error(
        "the mask of valid pixels has {mask_width} x {mask_height} pixels, the photo {width} x {height}; \
         both must have the same size"
    )]
    Size {
        /// Columns of the photo.
        width: usize,
        /// Rows of the photo.
        height: usize,
        /// Columns of the mask.
        mask_width: usize,
        /// Rows of the mask.
        mask_height: usize,
    },
    /// No pixel shows anything.
    #[error(
        "no pixel of {width} x {height} shows anything (all nodata, transparent or border); expected a photo"
    )]
    Nothing {
        /// Columns of the photo.
        width: usize,
        /// Rows of the photo.
        height: usize,
    },
    /// An option that means nothing.
    #[error("{name} is {value}, expected {expected}")]
    Option {
        /// Which.
        name: &'static str,
        /// What it is.
        value: f64,
        /// What it can be.
        expected: &'static str,
    },
}

/// What is vegetation in a photo.
#[derive(Debug, Clone, PartialEq)]
pub struct Vegetation {
    /// Number of columns, in pixels.
    pub width: usize,
    /// Number of rows, in pixels.
    pub height: usize,
    /// Posterior probability of vegetation of each pixel, in 1/255, row by row; 0 where nothing is shown.
    pub posterior: Vec<u8>,
    /// The mask of (locally) least energy.
    pub mask: Mask,
    /// Pixels that show something; `None` if all do.
    pub valid: Option<Mask>,
    /// What was estimated.
    pub model: Model,
}

impl Vegetation {
    /// Expected share of vegetation among the pixels that show something.
    pub fn cover(&self) -> f64 {
        let sum: u64 = self.posterior.iter().map(|&p| u64::from(p)).sum();
        let valid = self.valid.as_ref().map_or(self.posterior.len(), Mask::count);
        sum as f64 / 255.0 / valid.max(1) as f64
    }
}

/// Finds the vegetation of a photo. `valid` are the pixels that show something (1), if that is known.
///
/// # Errors
/// [`VegetationError`]: sizes that differ, no pixel that shows something, an option that means nothing.
pub fn segment(
    photo: &RgbImage,
    valid: Option<&Mask>,
    options: &Options,
) -> Result<Vegetation, VegetationError> {
    options.coherence.check()?;
    let (width, height) = (photo.width() as usize, photo.height() as usize);
    if let Some(mask) = valid.filter(|mask| (mask.width, mask.height) != (width, height)) {
        let (mask_width, mask_height) = (mask.width, mask.height);
        return Err(VegetationError::Size { width, height, mask_width, mask_height });
    }
    let mut shown = valid.filter(|mask| mask.data.contains(&0)).cloned();
    if let Some(border) = options.find_borders.then(|| nothing::border(photo)).flatten() {
        let shown = shown.get_or_insert_with(|| Mask::from_fn(width, height, |_, _| true));
        for (shown, border) in shown.data.iter_mut().zip(&border.data) {
            *shown &= 1 - border;
        }
    }
    let samples = samples(photo, shown.as_ref());
    if samples.is_empty() {
        return Err(VegetationError::Nothing { width, height });
    }
    let model = Model::fit(&samples);
    let mut posterior = posteriors(photo, &model);
    if let Some(shown) = &shown {
        for (p, &shown) in posterior.iter_mut().zip(&shown.data) {
            *p *= shown;
        }
    }
    let mask = options.coherence.mask(width, height, &posterior);
    Ok(Vegetation { width, height, posterior, mask, valid: shown, model })
}

/// The vegetation of a photo by a model that was estimated elsewhere: of a larger picture of the same ground in the same light
/// ([`Model::at`]). `valid` are the pixels that show something (1), if that is known.
///
/// # Errors
/// [`VegetationError`]: sizes that differ, an option that means nothing.
pub fn classify(
    photo: &RgbImage,
    valid: Option<&Mask>,
    model: &Model,
    coherence: Coherence,
) -> Result<Mask, VegetationError> {
    coherence.check()?;
    let (width, height) = (photo.width() as usize, photo.height() as usize);
    let mut posterior = posteriors(photo, model);
    if let Some(shown) = valid {
        if (shown.width, shown.height) != (width, height) {
            let (mask_width, mask_height) = (shown.width, shown.height);
            return Err(VegetationError::Size { width, height, mask_width, mask_height });
        }
        for (p, &shown) in posterior.iter_mut().zip(&shown.data) {
            *p *= shown;
        }
    }
    Ok(coherence.mask(width, height, &posterior))
}

/// Smoothed pixels on a regular grid, without those that show nothing.
fn samples(photo: &RgbImage, shown: Option<&Mask>) -> Vec<Sample> {
    let (width, height) = (photo.width() as usize, photo.height() as usize);
    let step = ((width * height / SAMPLES) as f64).sqrt().max(1.0) as usize;
    let rows: Vec<usize> = (step / 2..height).step_by(step).collect();
    let converter = Converter::new();
    let smooth = |u: usize, v: usize| {
        let mut sum = [0.0; 2];
        for (dv, row_weight) in [(0, 0.25), (1, 0.5), (2, 0.25)] {
            let row = (v + dv).saturating_sub(1).min(height - 1);
            for (du, weight) in [(0, 0.25), (1, 0.5), (2, 0.25)] {
                let column = (u + du).saturating_sub(1).min(width - 1);
                let pixel = photo.get_pixel(column as u32, row as u32).0;
                let colour = converter.green_yellow(pixel);
                sum[0] += row_weight * weight * colour[0];
                sum[1] += row_weight * weight * colour[1];
            }
        }
        sum
    };
    let of_row = |&v: &usize| -> Vec<Sample> {
        let columns = (step / 2..width).step_by(step);
        let columns = columns.filter(|&u| shown.is_none_or(|shown| shown.get(u, v)));
        let sample = |u| {
            let [green, yellow] = smooth(u, v);
            Sample {
                x: from_middle(u, width) as f32,
                y: from_middle(v, height) as f32,
                green,
                yellow,
            }
        };
        columns.map(sample).collect()
    };
    rows.par_iter().map(of_row).collect::<Vec<_>>().concat()
}

/// Place of a pixel centre in -1..1.
fn from_middle(at: usize, size: usize) -> f64 {
    (2 * at + 1) as f64 / size as f64 - 1.0
}

/// Posterior of every pixel in 1/255.
fn posteriors(photo: &RgbImage, model: &Model) -> Vec<u8> {
    let (width, height) = (photo.width() as usize, photo.height() as usize);
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
    let mut posterior = vec![0; width * height];
    let bands = posterior.par_chunks_mut((BAND * width).max(1)).enumerate();
    bands.for_each(|(band, out)| {
        let mut rows = SmoothRows::new(photo);
        let mut line: Vec<[f32; 2]> = vec![[0.0; 2]; width];
        for (index, out) in out.chunks_mut(width).enumerate() {
            let v = band * BAND + index;
            rows.smooth(v, &mut line);
            let [s0, s1, s2] = model.surface_of_row(from_middle(v, height)).map(|s| s as f32);
            let pixel = 2.0 / width as f32;
            let first = 0.5 * pixel - 1.0;
            for (u, (out, &[green, yellow])) in out.iter_mut().zip(&line).enumerate() {
                let x = first + pixel * u as f32;
                let surface = s0 + x * (s1 + x * s2);
                let z = leaf_green(green, yellow) + yellow_weight * yellow - surface + offset;
                let at = (z * scale + end * per_unit).clamp(0.0, last);
                *out = table[at as usize];
            }
        }
    });
    posterior
}

/// Rows of colour smoothed with weights 1/4, 1/2, 1/4 both ways, from the top down.
struct SmoothRows<'a> {
    photo: &'a RgbImage,
    converter: Converter,
    /// The last rows, smoothed along themselves, and which they are.
    kept: [(usize, Vec<[f32; 2]>); 3],
    raw: Vec<[f32; 2]>,
}

impl<'a> SmoothRows<'a> {
    fn new(photo: &'a RgbImage) -> SmoothRows<'a> {
        let empty = || (usize::MAX, vec![[0.0; 2]; photo.width() as usize]);
        let kept = [empty(), empty(), empty()];
        let raw = vec![[0.0; 2]; photo.width() as usize];
        SmoothRows { photo, converter: Converter::new(), kept, raw }
    }

    fn smooth(&mut self, v: usize, out: &mut [[f32; 2]]) {
        let last = self.photo.height() as usize - 1;
        let rows = [v.saturating_sub(1), v, (v + 1).min(last)];
        for row in rows {
            if self.kept[row % 3].0 != row {
                self.load(row);
            }
        }
        let [above, here, below] = rows.map(|row| &self.kept[row % 3].1);
        for (out, ((a, h), b)) in out.iter_mut().zip(above.iter().zip(here).zip(below)) {
            *out = [0.25 * (a[0] + b[0]) + 0.5 * h[0], 0.25 * (a[1] + b[1]) + 0.5 * h[1]];
        }
    }

    fn load(&mut self, v: usize) {
        let width = self.photo.width() as usize;
        let bytes = &self.photo.as_raw()[3 * v * width..3 * (v + 1) * width];
        for (raw, pixel) in self.raw.iter_mut().zip(bytes.as_chunks::<3>().0) {
            *raw = self.converter.green_yellow(*pixel);
        }
        let (row, line) = &mut self.kept[v % 3];
        *row = v;
        let raw = &self.raw;
        let mix = |a: [f32; 2], h: [f32; 2], b: [f32; 2]| {
            [0.25 * (a[0] + b[0]) + 0.5 * h[0], 0.25 * (a[1] + b[1]) + 0.5 * h[1]]
        };
        for (line, near) in line[1..].iter_mut().zip(raw.windows(3)) {
            *line = mix(near[0], near[1], near[2]);
        }
        line[0] = mix(raw[0], raw[0], raw[1.min(width - 1)]);
        line[width - 1] = mix(raw[width.saturating_sub(2)], raw[width - 1], raw[width - 1]);
    }
}

#[cfg(test)]
mod tests;
