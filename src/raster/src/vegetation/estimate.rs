//! Vegetation of a photo that is seen band by band: first the classes, from all of it, then the mask of each band.

use super::{
    Coherence, Model, Options, VegetationError,
    colour::Converter,
    hide,
    model::Sample,
    nothing::{Surround, SurroundFinder},
    posterior::{from_middle, posteriors},
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
    /// Smoothed pixels, and their columns and rows.
    samples: Vec<([usize; 2], Sample)>,
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
            samples: Vec::new(),
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
        let converter = Converter::new(ndvi);
        let [beside, here] = converter.weights();
        let smooth = |u: usize, v: usize| {
            let mut sum = [0.0; 2];
            for (dv, row_weight) in [(0, beside), (1, here), (2, beside)] {
                let row = (v + dv).saturating_sub(1).min(height - 1) - first;
                for (du, weight) in [(0, beside), (1, here), (2, beside)] {
                    let column = (u + du).saturating_sub(1).min(width - 1);
                    let pixel = photo.get_pixel(column as u32, row as u32).0;
                    let colour = converter.of_pixel(row * width + column, pixel);
                    sum[0] += row_weight * weight * colour[0];
                    sum[1] += row_weight * weight * colour[1];
                }
            }
            sum
        };
        let of_row = |&v: &usize| -> Vec<([usize; 2], Sample)> {
            let shows = |u: &usize| shown.is_none_or(|shown| shown[(v - first) * width + u] != 0);
            let columns = (self.step / 2..width).step_by(self.step).filter(shows);
            let sample = |u| {
                let [green, yellow] = smooth(u, v);
                let (x, y) = (from_middle(u, width) as f32, from_middle(v, height) as f32);
                ([u, v], Sample { x, y, green, yellow })
            };
            columns.map(sample).collect()
        };
        self.samples.extend(rows.par_iter().map(of_row).collect::<Vec<_>>().concat());
    }

    /// The classes, when all bands have been seen.
    ///
    /// # Errors
    /// [`VegetationError::Nothing`]: no pixel shows anything.
    pub fn finish(self) -> Result<Estimate, VegetationError> {
        let Estimator { width, height, coherence, has_ndvi, .. } = self;
        let surround = self.surround.and_then(SurroundFinder::finish);
        let is_shown = |[u, v]: [usize; 2]| surround.as_ref().is_none_or(|s| !s.contains(u, v));
        let samples = self.samples.into_iter().filter(|(at, _)| is_shown(*at));
        let samples: Vec<Sample> = samples.map(|(_, sample)| sample).collect();
        if samples.is_empty() {
            return Err(VegetationError::Nothing { width, height });
        }
        let model = Model { has_ndvi, ..Model::fit(&samples) };
        Ok(Estimate { width, height, coherence, surround, model })
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
        self.coherence.reach() + 1
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
