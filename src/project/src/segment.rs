//! The leaf mask.

use super::{
    Project, Stage, Task,
    figures::{self, View},
    leaf_mask::{self, LeafRows, Segmenter},
    orthomosaic, stage,
};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor, Progress},
    options::Auto,
};
use rowgram_files::{
    geotiff::Colour,
    rasters::{BAND_ROWS, GreyWriter, Source},
};
use rowgram_optim::output::{FileError, name_of};
use rowgram_raster::{
    Mask,
    components::{self, Changed},
    mask::Thresholds,
    overlay,
    vegetation::Model,
    window,
};
use serde::{Deserialize, Serialize};
use std::{
    ops::RangeInclusive,
    path::{Path, PathBuf},
};

rowgram_base::options! {
    /// The leaf mask: pixels of the orthomosaic that show leaves.
    pub struct SegmentOptions in "segment", main [hsv, min_pixels] {
        /// How leaf pixels are recognised: auto estimates vegetation from the picture itself, by NDVI where it has a near-infrared band; or thresholds in
        /// 8-bit HSV: hue from, hue to (0 to 180), minimum saturation, minimum value (0 to 255), as 30,79,30,163
        /// (the paper's, for June).
        pub hsv: Auto<Thresholds> = Auto::Auto, limits between(0.0, 255.0);
        /// Penalty for neighbouring pixels of different classes where vegetation is estimated; 0 classifies every
        /// pixel on its own.
        pub coherence: f64 = 0.5, limits between(0.0, 100.0);
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
    /// The thresholds that were used: hue from, hue to, least saturation, least value, in 8-bit HSV; none where vegetation
    /// was estimated.
    pub hsv: Option<Thresholds>,
    /// What was estimated of vegetation and background, where it was.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vegetation: Option<Model>,
    /// Leaf pixels.
    pub leaf_pixels: usize,
    /// Share of leaf pixels among those that show something.
    pub leaf_share: f64,
    /// Share of the picture that shows something: neither transparent nor without data nor the flat surround of a mosaic.
    #[serde(default = "whole")]
    pub valid_share: f64,
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

/// Makes the leaf mask of the orthomosaic: `segment/mask.tif`; `segment/posterior.tif` where vegetation is estimated; and
/// `segment/valid.tif` where parts of the picture show nothing.
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
pub struct Segment;

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
        let posterior = folder.join(super::leaf_mask::POSTERIOR);
        let valid = folder.join(super::leaf_mask::VALID);
        let files = SegmentFiles {
            mask: &folder.join("mask.tif"),
            valid: Some(&valid),
            posterior: matches!(options.hsv, Auto::Auto).then_some(posterior.as_path()),
            figures: Some(&folder.join("figures")),
            force: true,
        };
        let source = leaf_mask::photo(project.open_picture(&image)?, &image)?;
        if project.given_orthomosaic().is_some() {
            let said = orthomosaic::bands(&source, &image);
            said.iter().for_each(|found| monitor.diagnostic(found));
        }
        let outcome = segment_source(&source, &image, files, options, monitor)?;
        Ok(SegmentOutcome { image: super::record::relative(project.root(), &image), ..outcome })
    }
}

fn whole() -> f64 {
    1.0
}

/// What is written of a mask.
#[derive(Debug, Clone, Copy)]
pub struct SegmentFiles<'a> {
    /// The mask, 255 where leaves are and 0 elsewhere: PNG, or GeoTIFF for a name in `.tif`.
    pub mask: &'a Path,
    /// Posterior probability of vegetation in 1/255, in the same formats; only where vegetation is estimated.
    pub posterior: Option<&'a Path>,
    /// Pixels that show something, 255, and those that do not, 0, in the same formats; only where some do not.
    pub valid: Option<&'a Path>,
    /// Folder of pictures: `mask.png`, the mask drawn over the photo; where vegetation is estimated, also what is doubtful and
    /// what shows nothing.
    pub figures: Option<&'a Path>,
    /// Whether files that exist are replaced.
    pub force: bool,
}

/// Makes the leaf mask of one photo or orthomosaic.
///
/// # Errors
/// A picture that cannot be read, is a mask already or shows nothing; files that cannot be written.
pub fn segment_file(
    image: &Path,
    files: SegmentFiles<'_>,
    options: &SegmentOptions,
    monitor: &mut dyn Monitor,
) -> Result<SegmentOutcome, Error> {
    let source = leaf_mask::photo(Source::open(image)?, image)?;
    segment_source(&source, image, files, options, monitor)
}

/// The same of a photo that is open.
fn segment_source(
    source: &Source,
    image: &Path,
    files: SegmentFiles<'_>,
    options: &SegmentOptions,
    monitor: &mut dyn Monitor,
) -> Result<SegmentOutcome, Error> {
    if files.posterior.is_some() && options.hsv != Auto::Auto {
        let message = "thresholds (hsv) give no posterior: leave out one of them";
        return Err(Error::Argument(message.to_owned()));
    }
    let segmenter = Segmenter::new(source, image, options, monitor)?;
    let (width, height) = source.size();
    let place = source.georeference();
    let grey = |path, colour| GreyWriter::begin(path, files.force, (width, height), colour, place);
    let mut mask = grey(files.mask, Colour::Classes)?;
    let mut posterior = files.posterior.map(|path| grey(path, Colour::Values)).transpose()?;
    let mut valid = files.valid.map(|path| grey(path, Colour::Classes)).transpose()?;
    let mut view = files.figures.map(|_| MaskView::new(width, height));
    let mut counter = components::Counter::default();
    let (mut leaf_pixels, mut nothing_pixels) = (0, 0);
    let mut put = |band: LeafRows| -> Result<(), FileError> {
        counter.add(&band.mask, width);
        leaf_pixels += band.mask.iter().filter(|&&pixel| pixel != 0).count();
        if let Some(view) = &mut view {
            view.add(&band);
        }
        let shown = band.shown.as_ref();
        nothing_pixels += shown.map_or(0, |shown| shown.iter().filter(|&&is| is == 0).count());
        if let Some(writer) = &mut valid {
            let seen = shown.map(|shown| shown.iter().map(|is| 255 * is).collect::<Vec<u8>>());
            writer.put(band.rows.clone(), &seen.unwrap_or_else(|| vec![255; band.mask.len()]))?;
        }
        if let (Some(writer), Some(values)) = (&mut posterior, &band.posterior) {
            writer.put(band.rows.clone(), values)?;
        }
        let white: Vec<u8> = band.mask.iter().map(|&pixel| 255 * pixel).collect();
        mask.put(band.rows, &white)
    };
    let (mut removed, mut filled) = (Changed::default(), Changed::default());
    let mut tell = |done: usize| {
        let (done, total) = (done as u64, Some(height as u64));
        monitor.progress(&Progress { activity: "finding leaves", done, total, unit: "rows" });
    };
    if options.min_pixels > 1 || options.fill_holes > 0 {
        // Leaf areas and holes may reach over all bands.
        let mut found = segmenter.whole()?;
        removed = components::remove_small(&mut found.mask, options.min_pixels);
        filled = components::fill_holes(&mut found.mask, options.fill_holes);
        for band in window::bands(height, BAND_ROWS, 0) {
            put(found.rows(band.rows))?;
        }
    } else {
        for band in segmenter.bands() {
            let band = band?;
            let done = band.rows.end;
            put(band)?;
            tell(done);
        }
    }
    let components = counter.count();
    mask.finish()?;
    posterior.map(GreyWriter::finish).transpose()?;
    let pixels = (width * height).max(1);
    let valid_share = 1.0 - nothing_pixels as f64 / pixels as f64;
    if nothing_pixels > 0 {
        valid.map(GreyWriter::finish).transpose()?;
        let kinds = match segmenter.has_surround() {
            true => {
                "the flat black or white surround of the mosaic, and what is transparent or without data"
            }
            false => "transparent or without data",
        };
        let message = format!(
            "{:.1} % of the picture show nothing ({kinds}) and count in no area, density or mean",
            100.0 * (1.0 - valid_share)
        );
        let subject = name_of(image);
        monitor.diagnostic(&Diagnostic::info("pixels-without-data", subject, message));
    }
    let hsv = segmenter.hsv();
    if leaf_pixels == 0 {
        let subject = image.display().to_string();
        let (message, remedy) = match hsv {
            Some(_) => (
                "no pixel is within the thresholds; the leaf mask is empty",
                "choose other thresholds (rowgram segment thresholds, then --hsv)",
            ),
            None => (
                "no vegetation stands out from the ground; the leaf mask is empty",
                "where there are leaves, give thresholds of their colours (--hsv)",
            ),
        };
        monitor
            .diagnostic(&Diagnostic::warning("empty-mask", subject, message).with_remedy(remedy));
    }
    if let (Some(folder), Some(shown)) = (files.figures, view) {
        let mut view = View::of(source)?;
        shown.draw(&mut view)?;
        view.write(folder, "mask.png", files.force)?;
    }
    Ok(SegmentOutcome {
        image: image.to_owned(),
        width_px: width,
        height_px: height,
        hsv,
        vegetation: segmenter.vegetation(),
        leaf_pixels,
        leaf_share: leaf_pixels as f64 / (pixels - nothing_pixels).max(1) as f64,
        valid_share,
        components,
        removed_components: removed.components,
        removed_pixels: removed.pixels,
        filled_holes: filled.components,
        filled_pixels: filled.pixels,
    })
}

/// Posteriors, in 1/255, within which a pixel is doubtful.
const DOUBTFUL: RangeInclusive<u8> = 64..=191;

/// Leaf pixels, doubtful ones, and pixels that show nothing, as many as a picture shows.
struct MaskView {
    width: usize,
    step: usize,
    leaf: Mask,
    doubtful: Mask,
    nothing: Mask,
}

impl MaskView {
    fn new(width: usize, height: usize) -> MaskView {
        let step = figures::step(width, height);
        let none = Mask { width: width.div_ceil(step), height: 0, data: Vec::new() };
        MaskView { width, step, leaf: none.clone(), doubtful: none.clone(), nothing: none }
    }

    /// Adds the next rows.
    fn add(&mut self, band: &LeafRows) {
        let MaskView { width, step, .. } = *self;
        let add = |to: &mut Mask, is_of: &dyn Fn(usize) -> bool| {
            for v in band.rows.clone().filter(|v| v.is_multiple_of(step)) {
                let first = (v - band.rows.start) * width;
                to.data.extend((first..first + width).step_by(step).map(|k| u8::from(is_of(k))));
                to.height += 1;
            }
        };
        add(&mut self.leaf, &|k| band.mask[k] != 0);
        add(&mut self.doubtful, &|k| {
            band.posterior.as_ref().is_some_and(|posterior| DOUBTFUL.contains(&posterior[k]))
        });
        add(&mut self.nothing, &|k| band.shown.as_ref().is_some_and(|shown| shown[k] == 0));
    }

    /// Each in a colour of its own.
    fn draw(&self, view: &mut View) -> Result<(), Error> {
        let MaskView { leaf, doubtful, nothing, .. } = self;
        for (class, colour) in [
            (leaf, overlay::MASK_COLOUR),
            (doubtful, overlay::DOUBTFUL_COLOUR),
            (nothing, overlay::NOTHING_COLOUR),
        ] {
            overlay::draw_mask(&mut view.picture, class, colour)?;
        }
        Ok(())
    }
}
