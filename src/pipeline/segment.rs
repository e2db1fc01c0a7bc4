//! The leaf mask.

use super::{
    Project, Stage, Task,
    figures::View,
    leaf_mask::{self, LeafMask},
    stage,
};
use crate::{
    error::Error,
    io::rasters,
    monitor::{Diagnostic, Monitor},
    options::Auto,
    raster::{
        Mask, components, mask::Thresholds, overlay, vegetation::Model, white_balance::WhiteBalance,
    },
};
use serde::{Deserialize, Serialize};
use std::{
    ops::RangeInclusive,
    path::{Path, PathBuf},
};

crate::options! {
    /// The leaf mask: pixels of the orthomosaic that show leaves.
    pub struct SegmentOptions in "segment" {
        /// How leaf pixels are told: auto estimates vegetation from the picture itself; or thresholds in 8-bit HSV: hue from, hue
        /// to (0 to 180), least saturation, least value (0 to 255), as 30,79,30,163 (the paper's, for June).
        pub hsv: Auto<Thresholds> = Auto::Auto, limits between(0.0, 255.0);
        /// Price of two neighbours of unlike class where vegetation is estimated; 0 judges every pixel alone.
        pub coherence: f64 = 0.5, limits between(0.0, 100.0);
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
    /// The thresholds that were used: hue from, hue to, least saturation, least value, in 8-bit HSV; none where vegetation
    /// was estimated.
    pub hsv: Option<Thresholds>,
    /// What was estimated of vegetation and background, where it was.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vegetation: Option<Model>,
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

/// Makes the leaf mask of the orthomosaic: `segment/mask.tif`; and `segment/posterior.tif` where vegetation is estimated.
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
        let posterior = folder.join(super::leaf_mask::POSTERIOR);
        let files = SegmentFiles {
            mask: &folder.join("mask.tif"),
            posterior: matches!(options.hsv, Auto::Auto).then_some(posterior.as_path()),
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
    /// Posterior probability of vegetation in 1/255, in the same formats; only where vegetation is estimated.
    pub posterior: Option<&'a Path>,
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
    if files.posterior.is_some() && options.hsv != Auto::Auto {
        let message = "thresholds (hsv) give no posterior: leave out one of them";
        return Err(Error::Argument(message.to_owned()));
    }
    let source = leaf_mask::open_photo(image)?;
    let subject = image.display().to_string();
    let mut found = leaf_mask::of_photo(&source, image, options)?;
    let removed = components::remove_small(&mut found.mask, options.min_pixels);
    let filled = components::fill_holes(&mut found.mask, options.fill_holes);
    let LeafMask { mask, posterior, vegetation, hsv, .. } = &found;
    let leaf_pixels = mask.count();
    if leaf_pixels == 0 {
        let (message, remedy) = match hsv {
            Some(_) => (
                "no pixel is within the thresholds; the leaf mask is empty",
                "choose other thresholds (rowgram thresholds, then --hsv)",
            ),
            None => (
                "no vegetation stands out from the ground; the leaf mask is empty",
                "where there are leaves, give thresholds of their colours (--hsv)",
            ),
        };
        monitor
            .diagnostic(&Diagnostic::warning("empty-mask", subject, message).with_remedy(remedy));
    }
    rasters::write_mask(files.mask, files.force, mask, source.georeference())?;
    if let (Some(path), Some(posterior)) = (files.posterior, posterior) {
        let size = (mask.width, mask.height);
        rasters::write_posterior(path, files.force, size, posterior, source.georeference())?;
    }
    if let Some(folder) = files.figures {
        let mut view = View::of(&source)?;
        draw(&mut view, &found)?;
        view.write(folder, "mask.png", files.force)?;
    }
    Ok(SegmentOutcome {
        image: image.to_owned(),
        width_px: mask.width,
        height_px: mask.height,
        hsv: *hsv,
        vegetation: *vegetation,
        leaf_pixels,
        leaf_share: leaf_pixels as f64 / mask.data.len().max(1) as f64,
        components: components::count(mask),
        removed_components: removed.components,
        removed_pixels: removed.pixels,
        filled_holes: filled.components,
        filled_pixels: filled.pixels,
    })
}

/// Posteriors, in 1/255, within which a pixel is doubtful.
const DOUBTFUL: RangeInclusive<u8> = 64..=191;

/// Leaf pixels, doubtful ones, and pixels that show nothing, each in a colour of its own.
fn draw(view: &mut View, found: &LeafMask) -> Result<(), Error> {
    let LeafMask { mask, posterior, valid, .. } = found;
    let (width, height) = (mask.width, mask.height);
    let reduced = view.mask(mask);
    overlay::draw_mask(&mut view.picture, &reduced, overlay::MASK_COLOUR)?;
    let step = view.step;
    let mut tint = |shown: &dyn Fn(usize) -> bool, colour| {
        let (columns, rows) = (width.div_ceil(step), height.div_ceil(step));
        let class = Mask::from_fn(columns, rows, |u, v| shown(v * step * width + u * step));
        overlay::draw_mask(&mut view.picture, &class, colour)
    };
    if let Some(posterior) = posterior {
        tint(&|pixel| DOUBTFUL.contains(&posterior[pixel]), overlay::DOUBTFUL_COLOUR)?;
    }
    if let Some(valid) = valid {
        tint(&|pixel| valid.data[pixel] == 0, overlay::NOTHING_COLOUR)?;
    }
    Ok(())
}
