//! The leaf mask.

use super::{Project, Stage, Task, figures::View, stage};
use crate::{
    error::Error,
    io::{
        FileError, images,
        rasters::{self, BAND_ROWS, Source},
    },
    monitor::{Diagnostic, Monitor},
    options::Auto,
    raster::{
        Mask, components,
        mask::Thresholds,
        overlay, tuning,
        white_balance::{Channels, Gains, WhiteBalance},
        window,
    },
};
use image::RgbImage;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

crate::options! {
    /// The leaf mask: pixels of the orthomosaic that show leaves.
    pub struct SegmentOptions in "segment" {
        /// Thresholds of leaf pixels in 8-bit HSV: hue from, hue to (0 to 180), least saturation, least value (0 to 255), as
        /// 30,79,30,163 (the paper's, for June); auto proposes them from the picture.
        pub hsv: Auto<Thresholds> = Auto::Auto, limits between(0.0, 255.0);
        /// Scale the channels first, so that the mean colour is grey or the brightest colours are white.
        pub white_balance: Option<WhiteBalance> = None, example "\"grey-world\"";
        /// Connected leaf areas of fewer pixels are removed.
        pub min_pixels: usize = 0;
        /// Holes of at most this many pixels are filled, after the removal.
        pub fill_holes: usize = 0;
    }
}

/// A leaf mask in numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SegmentOutcome {
    /// The picture; in a project, relative to its folder.
    pub image: PathBuf,
    /// Columns of picture and mask.
    pub width_px: usize,
    /// Rows of picture and mask.
    pub height_px: usize,
    /// The thresholds that were used: hue from, hue to, least saturation, least value, in 8-bit HSV.
    pub hsv: Thresholds,
    /// Leaf pixels.
    pub leaf_pixels: usize,
    /// Share of leaf pixels in the picture.
    pub leaf_share: f64,
    /// Connected leaf areas.
    pub components: usize,
    /// Leaf areas that were removed because they are small.
    pub removed_components: usize,
    /// Their pixels.
    pub removed_pixels: usize,
    /// Holes that were filled.
    pub filled_holes: usize,
    /// Their pixels.
    pub filled_pixels: usize,
}

/// Makes the leaf mask of the orthomosaic: `segment/mask.tif`.
///
/// # Errors
/// [`Error::NothingToDo`] without an orthomosaic; as [`stage::perform`].
pub fn segment(
    project: &Project,
    options: &SegmentOptions,
    monitor: &mut dyn Monitor,
) -> Result<SegmentOutcome, Error> {
    stage::perform::<Segment>(project, options, monitor)
}

/// The stage.
pub(super) struct Segment;

impl Task for Segment {
    type Options = SegmentOptions;
    type Outcome = SegmentOutcome;
    const STAGE: Stage = Stage::Segment;

    fn inputs(project: &Project, _: &SegmentOptions) -> Result<Vec<PathBuf>, Error> {
        Ok(vec![project.orthomosaic()?])
    }

    fn work(
        project: &Project,
        options: &SegmentOptions,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<SegmentOutcome, Error> {
        let image = project.orthomosaic()?;
        let files = SegmentFiles {
            mask: &folder.join("mask.tif"),
            figures: Some(&folder.join("figures")),
            force: true,
        };
        let outcome = segment_file(&image, files, options, monitor)?;
        Ok(SegmentOutcome { image: super::record::relative(project.root(), &image), ..outcome })
    }
}

/// What is written of a mask.
#[derive(Debug, Clone, Copy)]
pub struct SegmentFiles<'a> {
    /// The mask, 255 where leaves are and 0 elsewhere: PNG, or GeoTIFF for a name in `.tif`.
    pub mask: &'a Path,
    /// Folder of pictures: `mask.png`, the mask drawn over the photo.
    pub figures: Option<&'a Path>,
    /// Whether files that exist are replaced.
    pub force: bool,
}

/// Makes the leaf mask of one photo or orthomosaic. TIFF files are read by bands: only the mask is held in memory.
///
/// # Errors
/// A picture that cannot be read or is a mask already; files that cannot be written.
pub fn segment_file(
    image: &Path,
    files: SegmentFiles<'_>,
    options: &SegmentOptions,
    monitor: &mut dyn Monitor,
) -> Result<SegmentOutcome, Error> {
    let source = open_photo(image)?;
    let subject = image.display().to_string();
    let gains = options.white_balance.map(|how| gains(&source, how)).transpose()?;
    let hsv = thresholds(&source, options.hsv, gains, &subject, monitor)?;
    let mut mask = source.mask(|photo| match gains {
        None => hsv.mask(photo),
        Some(gains) => hsv.mask(&gains.applied(photo)),
    })?;
    let removed = components::remove_small(&mut mask, options.min_pixels);
    let filled = components::fill_holes(&mut mask, options.fill_holes);
    let leaf_pixels = mask.count();
    if leaf_pixels == 0 {
        let message = "no pixel is within the thresholds; the leaf mask is empty";
        monitor.diagnostic(
            &Diagnostic::warning("empty-mask", subject, message)
                .with_remedy("choose other thresholds (rowgram thresholds, then --hsv)"),
        );
    }
    rasters::write_mask(files.mask, files.force, &mask, source.georeference())?;
    if let Some(folder) = files.figures {
        let mut view = View::of(&source)?;
        let reduced = view.mask(&mask);
        overlay::draw_mask(&mut view.picture, &reduced, overlay::MASK_COLOUR)?;
        view.write(folder, "mask.png", files.force)?;
    }
    Ok(SegmentOutcome {
        image: image.to_owned(),
        width_px: mask.width,
        height_px: mask.height,
        hsv,
        leaf_pixels,
        leaf_share: leaf_pixels as f64 / mask.data.len().max(1) as f64,
        components: components::count(&mask),
        removed_components: removed.components,
        removed_pixels: removed.pixels,
        filled_holes: filled.components,
        filled_pixels: filled.pixels,
    })
}

/// A photo, mask or orthomosaic with its leaf mask: a mask's own two values, else pixels within the thresholds.
///
/// # Errors
/// A file that cannot be read.
pub fn read_leaf_mask(
    image: &Path,
    hsv: Auto<Thresholds>,
    monitor: &mut dyn Monitor,
) -> Result<(Source, Mask), Error> {
    let source = Source::open(image)?;
    let hsv = if source.is_photo() {
        thresholds(&source, hsv, None, &image.display().to_string(), monitor)?
    } else {
        Thresholds::default()
    };
    let mask = source.mask(|photo| hsv.mask(photo))?;
    Ok((source, mask))
}

/// Opens what is to be segmented: anything but a mask.
fn open_photo(path: &Path) -> Result<Source, FileError> {
    let source = Source::open(path)?;
    match &source {
        Source::Picture(_) if source.is_photo() => Ok(source),
        Source::File(_) if source.is_photo() => Ok(source),
        Source::Picture(_) => {
            let message = "it holds a mask (two values), expected a photo";
            Err(FileError::malformed(path, None, message))
        }
        // Whether a grey TIFF is a photo or a mask is known when all of it has been read.
        Source::File(_) => {
            images::read_photo(path).map(|photo| Source::Picture(images::Picture::Photo(photo)))
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

/// Pixels by which a photo proposes thresholds, about.
const SAMPLE: usize = 1_000_000;

/// Thresholds as given, or those that the photo itself proposes; the default ones where it proposes none.
fn thresholds(
    source: &Source,
    hsv: Auto<Thresholds>,
    gains: Option<Gains>,
    subject: &str,
    monitor: &mut dyn Monitor,
) -> Result<Thresholds, Error> {
    if let Auto::Given(given) = hsv {
        return Ok(given);
    }
    let (width, height) = source.size();
    let every = (width * height).div_ceil(SAMPLE).max(1);
    let mut pixels: Vec<u8> = Vec::new();
    for band in window::bands(height, BAND_ROWS, 0) {
        let first = band.rows.start * width;
        let mut photo = source.rgb(band.rows)?;
        if let Some(gains) = gains {
            photo = gains.applied(&photo);
        }
        let skip = (every - first % every) % every;
        // What has no data is black.
        let sample = photo.pixels().skip(skip).step_by(every).filter(|pixel| pixel.0 != [0; 3]);
        pixels.extend(sample.flat_map(|pixel| pixel.0));
    }
    let usual = Thresholds::default();
    let count = (pixels.len() / 3) as u32;
    let sample = RgbImage::from_raw(count, 1, pixels).unwrap_or_default();
    match tuning::propose(&sample, usual) {
        Ok(found) => {
            let message = format!("leaf thresholds that its colours propose: {found}");
            monitor.diagnostic(&Diagnostic::info("thresholds-proposed", subject, message));
            Ok(found)
        }
        Err(why) => {
            let message =
                format!("its colours propose no leaf thresholds: {why}; {usual} are used");
            monitor.diagnostic(
                &Diagnostic::warning("thresholds-not-proposed", subject, message)
                    .with_remedy("give thresholds (--hsv, or [segment] hsv)"),
            );
            Ok(usual)
        }
    }
}
