//! Vegetation of a photo that is seen band by band: first the classes, from all of it, then the mask of each band.

use super::{
    Coherence, Model, Options, VegetationError,
    colour::{Converter, of_ndvi},
    hide,
    model::{Sample, leaf_green, usual_smoothing},
    nothing::{Surround, SurroundFinder},
    posterior::{from_middle, posteriors},
    smoothing, white_balance,
};
use crate::window::Band;
use image::RgbImage;
use rayon::prelude::*;

/// Pixels that the classes are estimated from, about: by arithmetic, the share of a class that is one hundredth of the photo is then known to 3 %.
const SAMPLES: usize = 120_000;

/// The rows of a photo that are seen for a band of it.
#[derive(Debug, Clone, Copy)]
pub struct Seen<'a> {
    /// Its colours.
    pub photo: &'a RgbImage,
    /// NDVI of each of its pixels, row by row, where the near infrared is known of the photo.
    pub ndvi: Option<&'a [f32]>,
    /// 0 for those of its pixels that show nothing and 1 for the others; `None` where all show something.
    pub shown: Option<&'a [u8]>,
}

/// What is gathered of a photo before its classes are estimated.
pub struct Estimator {
    width: usize,
    height: usize,
    coherence: Coherence,
    surround: Option<SurroundFinder>,
    /// Of the regular grid of pixels that are looked at.
    step: usize,
    has_ndvi: bool,
    pixels: Vec<GridPixel>,
}

/// A pixel of the grid and what is around it.
struct GridPixel {
    /// Its column and row.
    at: [usize; 2],
    /// The colours of the 3 x 3 pixels around it, row by row.
    near: [[u8; 3]; 9],
    /// Of the pixel itself, where the near infrared is known.
    ndvi: Option<f32>,
}

impl Estimator {
    /// Rows above and below a band that are looked at.
    pub const HALO: usize = 1;
    /// Bands begin at multiples of so many rows.
    pub const ROWS: usize = SurroundFinder::ROWS;

    /// For a photo of so many columns and rows.
    ///
    /// # Errors
    /// [`VegetationError::Option`]: an option that means nothing.
    pub fn new(
        (width, height): (usize, usize),
        options: &Options,
    ) -> Result<Estimator, VegetationError> {
        options.coherence.check()?;
        Ok(Estimator {
            width,
            height,
            coherence: options.coherence,
            surround: options.find_borders.then(|| SurroundFinder::new((width, height))),
            step: ((width * height / SAMPLES) as f64).sqrt().max(1.0) as usize,
            has_ndvi: false,
            pixels: Vec::new(),
        })
    }

    /// Looks at the next band, from the top.
    pub fn add(&mut self, band: &Band, seen: Seen<'_>) {
        let Seen { photo, ndvi, shown } = seen;
        if let Some(surround) = &mut self.surround {
            surround.add(band, photo);
        }
        self.has_ndvi |= ndvi.is_some();
        let (width, height, first) = (self.width, self.height, band.seen.start);
        let rows = (self.step / 2..height).step_by(self.step);
        let rows: Vec<usize> = rows.filter(|v| band.rows.contains(v)).collect();
        let near = |u: usize, v: usize| {
            std::array::from_fn(|k| {
                let row = (v + k / 3).saturating_sub(1).min(height - 1) - first;
                let column = (u + k % 3).saturating_sub(1).min(width - 1);
                photo.get_pixel(column as u32, row as u32).0
            })
        };
        let of_row = |&v: &usize| -> Vec<GridPixel> {
            let shows = |u: &usize| shown.is_none_or(|shown| shown[(v - first) * width + u] != 0);
            let columns = (self.step / 2..width).step_by(self.step).filter(shows);
            let pixel = |u| {
                let ndvi = ndvi.map(|ndvi| ndvi[(v - first) * width + u]);
                GridPixel { at: [u, v], near: near(u, v), ndvi }
            };
            columns.map(pixel).collect()
        };
        self.pixels.par_extend(rows.par_iter().flat_map_iter(of_row));
    }

    /// The classes, when all bands have been seen.
    ///
    /// # Errors
    /// [`VegetationError::Nothing`]: no pixel shows anything.
    pub fn finish(self) -> Result<Estimate, VegetationError> {
        let Estimator { width, height, coherence, has_ndvi, .. } = self;
        let surround = self.surround.and_then(SurroundFinder::finish);
        let is_shown = |[u, v]: [usize; 2]| surround.as_ref().is_none_or(|s| !s.contains(u, v));
        let mut pixels = self.pixels;
        pixels.retain(|pixel| is_shown(pixel.at));
        if pixels.is_empty() {
            return Err(VegetationError::Nothing { width, height });
        }
        let samples = |gains| -> Vec<Sample> {
            let converter = Converter::new(None, gains);
            pixels.par_iter().map(|pixel| pixel.sample([width, height], &converter)).collect()
        };
        let neutral = samples([1.0; 3]);
        let mut model = Model { has_ndvi, ..Model::fit(&neutral) };
        if !has_ndvi {
            let gains = white_balance::gains(&model, &neutral, |k| pixels[k].near[4]);
            if gains != [1.0; 3] {
                model = Model { white_balance: gains, ..Model::fit(&samples(gains)) };
            }
        }
        let converter = Converter::new(None, model.white_balance);
        let second_difference = |pixel: &GridPixel| pixel.second_difference(&converter, &model);
        model.smoothing_px = match has_ndvi {
            true => 0,
            false => smoothing::reach(
                pixels.par_iter().map(second_difference).collect(),
                model.vegetation - model.background,
            ),
        };
        Ok(Estimate { width, height, coherence, surround, model })
    }
}

impl GridPixel {
    /// Smoothed over the pixels around it, of a photo of so many columns and rows; NDVI is not smoothed.
    fn sample(&self, [width, height]: [usize; 2], converter: &Converter<'_>) -> Sample {
        let [u, v] = self.at;
        let (x, y) = (from_middle(u, width) as f32, from_middle(v, height) as f32);
        let weights = smoothing::weights(usual_smoothing());
        let weights = [weights[1], weights[0], weights[1]];
        let mut sum = self.ndvi.map_or([0.0; 2], of_ndvi);
        let near = if self.ndvi.is_some() { &[][..] } else { &self.near };
        for (k, &rgb) in near.iter().enumerate() {
            let colour = converter.green_yellow(rgb);
            for (sum, colour) in sum.iter_mut().zip(colour) {
                *sum += weights[k / 3] * weights[k % 3] * colour;
            }
        }
        let [green, yellow] = sum;
        Sample { x, y, green, yellow }
    }

    /// Of the pixels around it on the axis of the model, as they are.
    fn second_difference(&self, converter: &Converter<'_>, model: &Model) -> f64 {
        smoothing::second_difference(&self.near.map(|rgb| {
            let [green, yellow] = converter.green_yellow(rgb);
            f64::from(leaf_green(green, yellow)) + model.yellow_weight * f64::from(yellow)
        }))
    }
}

/// What was estimated of a photo, with which its bands are classified.
pub struct Estimate {
    width: usize,
    height: usize,
    coherence: Coherence,
    surround: Option<Surround>,
    /// The classes.
    pub model: Model,
}

/// What is vegetation in a band of a photo, row by row.
pub struct Classified {
    /// 1 where there is vegetation, 0 elsewhere.
    pub mask: Vec<u8>,
    /// Posterior probability of vegetation in 1/255; 0 where nothing is shown.
    pub posterior: Vec<u8>,
    /// 1 where something is shown, 0 elsewhere; `None` if all of the band is.
    pub shown: Option<Vec<u8>>,
}

impl Estimate {
    /// Whether a flat surround was found.
    pub fn has_surround(&self) -> bool {
        self.surround.is_some()
    }

    /// Rows above and below a band that its mask depends on.
    pub fn halo(&self) -> usize {
        self.coherence.reach() + self.model.smoothing_px
    }

    /// The vegetation of the rows of a band, in any order of bands; [`Estimate::halo`] more rows are seen on either side where
    /// there are any.
    pub fn classify(&self, band: &Band, seen: Seen<'_>) -> Classified {
        let Seen { photo, ndvi, shown } = seen;
        let (width, first) = (self.width, band.seen.start);
        debug_assert_eq!(
            (photo.width() as usize, photo.height() as usize),
            (width, band.seen.len())
        );
        let shown = match &self.surround {
            None => shown.map(<[u8]>::to_vec),
            Some(surround) => {
                let mut seen = surround.outside(band.seen.clone(), width);
                for (seen, shown) in seen.iter_mut().zip(shown.into_iter().flatten()) {
                    *seen &= shown;
                }
                Some(seen)
            }
        };
        let mut posterior = posteriors(photo, ndvi, &self.model, first, self.height);
        hide(&mut posterior, shown.as_deref());
        let mask = self.coherence.mask_of_rows(width, first, &posterior);
        let kept = (band.rows.start - first) * width..(band.rows.end - first) * width;
        let cut = |mut all: Vec<u8>| {
            all.truncate(kept.end);
            all.drain(..kept.start);
            all
        };
        Classified { mask: cut(mask), posterior: cut(posterior), shown: shown.map(cut) }
    }
}
