//! The leaf mask of a photo, with the posterior probability of vegetation where it was estimated.

use super::{Project, Stage, segment::SegmentOptions};
use crate::{
    error::Error,
    io::{
        FileError, images,
        rasters::{self, BAND_ROWS, Source},
    },
    options::Auto,
    raster::{
        Mask,
        mask::Thresholds,
        vegetation::{self, Coherence, Model},
        white_balance::{Channels, Gains, WhiteBalance},
        window,
    },
};
use image::RgbImage;
use std::path::Path;

/// The file of the stage `segment` with the posterior.
pub(super) const POSTERIOR: &str = "posterior.tif";

/// Most sweeps of iterated conditional modes; hardly a pixel changes after the third.
pub(super) const SWEEPS: usize = 4;

/// A leaf mask and what is known of it.
#[derive(Debug, Clone, PartialEq)]
pub struct LeafMask {
    /// Leaf pixels.
    pub mask: Mask,
    /// Posterior probability of vegetation of each pixel, in 1/255, row by row; none for a given mask and for thresholds.
    pub posterior: Option<Vec<u8>>,
    /// Pixels that show something; none if all do, and for a given mask and for thresholds.
    pub valid: Option<Mask>,
    /// What was estimated of vegetation and background, where it was.
    pub vegetation: Option<Model>,
    /// The thresholds, where the mask was made by them.
    pub hsv: Option<Thresholds>,
}

impl From<Mask> for LeafMask {
    fn from(mask: Mask) -> LeafMask {
        LeafMask { mask, posterior: None, valid: None, vegetation: None, hsv: None }
    }
}

/// A photo, mask or orthomosaic with its leaf mask: a mask's own two values, else pixels within thresholds, or vegetation
/// as it is estimated from the photo.
///
/// # Errors
/// A file that cannot be read; a photo that shows nothing.
pub fn read_leaf_mask(image: &Path, hsv: Auto<Thresholds>) -> Result<(Source, LeafMask), Error> {
    let source = Source::open(image)?;
    let found = if source.is_photo() {
        of_photo(&source, image, &SegmentOptions { hsv, ..SegmentOptions::default() })?
    } else {
        source.mask(|photo| Thresholds::default().mask(photo))?.into()
    };
    Ok((source, found))
}

/// The leaf mask that the stage `segment` made, with its posterior.
///
/// # Errors
/// [`Error::NothingToDo`] where there is none; files that cannot be read.
pub fn of_project(project: &Project) -> Result<(Source, LeafMask), Error> {
    let (source, mut found) = read_leaf_mask(&project.mask()?, Auto::Auto)?;
    if let Some(path) = project.finished(Stage::Segment, POSTERIOR) {
        let size = (found.mask.width, found.mask.height);
        found.posterior = Some(rasters::read_posterior(&path, size)?);
    }
    Ok((source, found))
}

/// Opens what is to be segmented: anything but a mask.
pub(super) fn open_photo(path: &Path) -> Result<Source, FileError> {
    let source = Source::open(path)?;
    match &source {
        _ if source.is_photo() => Ok(source),
        Source::Picture { .. } => {
            let message = "it holds a mask (two values), expected a photo";
            Err(FileError::malformed(path, None, message))
        }
        // Whether a grey TIFF is a photo or a mask is known when all of it has been read.
        Source::File(_) => images::read_photo(path)
            .map(|photo| Source::Picture { picture: images::Picture::Photo(photo), gaps: None }),
    }
}

/// The leaf mask of a photo.
pub(super) fn of_photo(
    source: &Source,
    image: &Path,
    options: &SegmentOptions,
) -> Result<LeafMask, Error> {
    let gains = options.white_balance.map(|how| gains(source, how)).transpose()?;
    let balanced = |photo: RgbImage| match gains {
        None => photo,
        Some(gains) => gains.applied(&photo),
    };
    match options.hsv {
        Auto::Given(hsv) => {
            let mask = source.mask(|photo| match gains {
                None => hsv.mask(photo),
                Some(gains) => hsv.mask(&gains.applied(photo)),
            })?;
            Ok(LeafMask { hsv: Some(hsv), ..mask.into() })
        }
        Auto::Auto => {
            let (width, height) = source.size();
            let (photo, gaps) = source.rgb_and_gaps(0..height)?;
            let valid = gaps.map(|gaps| {
                let data = gaps.iter().map(|&gap| u8::from(!gap)).collect();
                Mask { width, height, data }
            });
            let coherence = match options.coherence {
                0.0 => Coherence::None,
                weight => Coherence::Icm { weight, sweeps: SWEEPS },
            };
            let how = vegetation::Options { coherence, ..vegetation::Options::default() };
            let found = vegetation::segment(&balanced(photo), valid.as_ref(), &how)
                .map_err(|why| FileError::malformed(image, None, why.to_string()))?;
            Ok(LeafMask {
                mask: found.mask,
                posterior: Some(found.posterior),
                valid: found.valid,
                vegetation: Some(found.model),
                hsv: None,
            })
        }
    }
}

/// The gains of the channels, from all of the photo.
fn gains(source: &Source, how: WhiteBalance) -> Result<Gains, FileError> {
    let (_, height) = source.size();
    let mut histogram = Channels::default();
    for band in window::bands(height, BAND_ROWS, 0) {
        histogram.add(&source.rgb(band.rows)?);
    }
    Ok(histogram.gains(how))
}
