//! Vegetation estimated from the photo itself: a posterior per pixel and the leaf mask of least energy.
//!
//! ```text
//! E(y) = sum_i -ln P(y_i | z_i) + lambda sum_(i,j) w_ij [y_i != y_j],   y_i in {vegetation, background},
//! ```
//!
//! over 4-neighbours `(i, j)`. The posterior `P` comes from two classes along one axis of colour, both estimated
//! from the photo with weak priors ([`Model`]), after its soil has been given a colour that soils have (`white_balance`), and colours are smoothed
//! as far as the noise asks for (`smoothing`); `w_ij`
//! is small across edges of the posterior, and `E` is decreased by iterated conditional modes ([`coherence`]). Pixels that show nothing (nodata, borders of a mosaic, alpha:
//! [`nothing`]) take no part in the estimate and are never vegetation.
//!
//! A photo that is larger than the memory is seen band by band ([`Estimator`]); the result depends neither on the bands nor on
//! the number of threads.

pub mod coherence;
mod colour;
mod estimate;
mod model;
pub mod nothing;
mod posterior;
mod smoothing;
mod white_balance;

pub use coherence::Coherence;
pub use estimate::{Classified, Estimate, Estimator, Seen};
pub use model::{Model, USUAL_SMOOTHING_PX};

use super::{Mask, window::Band};
use image::RgbImage;
use posterior::posteriors;
use serde::{Deserialize, Serialize};

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
    let (width, height) = (photo.width() as usize, photo.height() as usize);
    let shown = shown(valid, (width, height))?.filter(|shown| shown.contains(&0));
    let all = Band { rows: 0..height, seen: 0..height };
    let mut estimator = Estimator::new((width, height), options)?;
    let seen = Seen { photo, ndvi: None, shown };
    estimator.add(&all, seen);
    let estimate = estimator.finish()?;
    let Classified { mask, posterior, shown } = estimate.classify(&all, seen);
    let mask = Mask { width, height, data: mask };
    let valid = shown.map(|data| Mask { width, height, data });
    Ok(Vegetation { width, height, posterior, mask, valid, model: estimate.model })
}

/// The pixels of a mask of those that show something, which has to be as large as the photo.
fn shown(
    valid: Option<&Mask>,
    (width, height): (usize, usize),
) -> Result<Option<&[u8]>, VegetationError> {
    match valid {
        Some(mask) if (mask.width, mask.height) != (width, height) => {
            let (mask_width, mask_height) = (mask.width, mask.height);
            Err(VegetationError::Size { width, height, mask_width, mask_height })
        }
        _ => Ok(valid.map(|mask| &mask.data[..])),
    }
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
    let shown = shown(valid, (width, height))?;
    let mut posterior = posteriors(photo, None, model, 0, height);
    hide(&mut posterior, shown);
    Ok(coherence.mask(width, height, &posterior))
}

/// Pixels that show nothing are no vegetation.
fn hide(posterior: &mut [u8], shown: Option<&[u8]>) {
    for (p, shown) in posterior.iter_mut().zip(shown.into_iter().flatten()) {
        *p *= shown;
    }
}

#[cfg(test)]
mod tests;
