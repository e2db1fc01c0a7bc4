//! `--tau`: thresholds of leaf pixels, given or proposed by the photo itself.

use crate::{
    error::Error,
    io::rasters::{self, Source},
    raster::{mask::Thresholds, tuning, window},
};
use image::RgbImage;
use std::{fmt, str::FromStr};

/// Pixels by which a photo proposes thresholds, about.
const SAMPLE: usize = 1_000_000;

/// Thresholds, or the photo's own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Tau {
    /// These.
    Given(Thresholds),
    /// What the photo proposes.
    Auto,
}

impl Default for Tau {
    fn default() -> Tau {
        Tau::Given(Thresholds::default())
    }
}

impl FromStr for Tau {
    type Err = Error;
    fn from_str(text: &str) -> Result<Tau, Error> {
        match text {
            "auto" => Ok(Tau::Auto),
            _ => match text.parse() {
                Ok(thresholds) => Ok(Tau::Given(thresholds)),
                // Something else than numbers was meant to be a word.
                Err(error) if !text.contains(',') => {
                    Err(Error::Argument(format!("{error}, or auto")))
                }
                Err(error) => Err(error),
            },
        }
    }
}

impl fmt::Display for Tau {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Tau::Given(thresholds) => thresholds.fmt(f),
            Tau::Auto => f.write_str("auto"),
        }
    }
}

/// The option.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(super) struct TauArgs {
    /// Thresholds of leaf pixels, for a photo: hue from, hue to, least saturation, least value; auto: those that the photo
    /// itself proposes (rowgram thresholds).
    #[arg(
        long,
        value_name = "TAU1,TAU2,TAU3,TAU4|auto",
        default_value_t = Tau::default(),
        allow_hyphen_values = true
    )]
    tau: Tau,
}

impl TauArgs {
    /// The thresholds for a raster; those of a mask decide nothing.
    ///
    /// # Errors
    /// Where the raster cannot be read.
    pub(super) fn of(self, source: &Source) -> Result<Thresholds, Error> {
        self.with(source, |_| {})
    }

    /// As [`TauArgs::of`], after what is done to all of its pixels first.
    ///
    /// # Errors
    /// Where the raster cannot be read.
    pub(super) fn with(
        self,
        source: &Source,
        before: impl Fn(&mut RgbImage),
    ) -> Result<Thresholds, Error> {
        match self.tau {
            Tau::Given(thresholds) => Ok(thresholds),
            Tau::Auto if !source.is_photo() => Ok(Thresholds::default()),
            Tau::Auto => {
                let (width, height) = source.size();
                let every = (width * height).div_ceil(SAMPLE).max(1);
                let mut pixels: Vec<u8> = Vec::new();
                for band in window::bands(height, rasters::BAND_ROWS, 0) {
                    let first = band.rows.start * width;
                    let mut photo = source.rgb(band.rows)?;
                    before(&mut photo);
                    let skip = (every - first % every) % every;
                    for pixel in photo.pixels().skip(skip).step_by(every) {
                        // What has no data is black.
                        if pixel.0 != [0; 3] {
                            pixels.extend(pixel.0);
                        }
                    }
                }
                Ok(propose(pixels))
            }
        }
    }

    /// The thresholds for a photo.
    pub(super) fn of_photo(self, photo: &RgbImage) -> Thresholds {
        match self.tau {
            Tau::Given(thresholds) => thresholds,
            Tau::Auto => {
                let every = photo.pixels().len().div_ceil(SAMPLE).max(1);
                let sample = photo.pixels().step_by(every).filter(|pixel| pixel.0 != [0; 3]);
                propose(sample.flat_map(|pixel| pixel.0).collect())
            }
        }
    }
}

fn propose(pixels: Vec<u8>) -> Thresholds {
    let usual = Thresholds::default();
    let count = (pixels.len() / 3) as u32;
    match RgbImage::from_raw(count, 1, pixels).map(|sample| tuning::propose(&sample, usual)) {
        Some(Ok(thresholds)) => {
            tracing::info!("thresholds that the photo proposes: {thresholds}");
            thresholds
        }
        Some(Err(why)) => {
            tracing::warn!("the photo proposes no thresholds: {why}; {usual} are used");
            usual
        }
        // Three bytes a pixel fill the picture exactly.
        None => usual,
    }
}
