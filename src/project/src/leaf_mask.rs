//! The leaf mask of a photo, with the posterior probability of vegetation where it was estimated; as a whole, or band by band.

use super::{Project, Stage, segment::SegmentOptions};
use image::{Rgb, RgbImage};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
    options::Auto,
};
use rowgram_files::{
    images, memory,
    rasters::{self, BAND_ROWS, Source},
};
use rowgram_optim::output::FileError;
use rowgram_raster::{
    Mask,
    mask::Thresholds,
    spectral::{Formula, Index},
    vegetation::{
        self, Classified, Coherence, Estimate, Estimator, Model, Seen, USUAL_SMOOTHING_PX,
        VegetationError,
        nothing::{Surround, SurroundFinder},
    },
    window::{self, Band, Window},
};
use std::{ops::Range, path::Path};

/// The file of the stage `segment` with the posterior.
pub(super) const POSTERIOR: &str = "posterior.tif";
/// The file of the stage `segment` with the pixels that show something, where some do not.
pub(super) const VALID: &str = "valid.tif";

// Bands begin where those do that are looked at first.
const _: () = assert!(BAND_ROWS.is_multiple_of(Estimator::ROWS));

/// Most sweeps of iterated conditional modes; hardly a pixel changes after the third.
pub(super) const SWEEPS: usize = 4;

/// A given ground sampling distance that differs from that of the raster by more than this share is told: rounding and the scale of projections make less. Assumed.
const GSD_TOLERANCE: f64 = 0.05;

/// The ground sampling distance of a picture, metres: the given one, else its own. Says so where the two contradict each other.
pub(super) fn gsd_m(
    source: &Source,
    given: Option<f64>,
    subject: &str,
    monitor: &mut dyn Monitor,
) -> Option<f64> {
    let own = source.georeference().and_then(|place| place.gsd_m());
    if let (Some(given), Some(own)) = (given, own)
        && (given / own - 1.0).abs() > GSD_TOLERANCE
    {
        let message = format!(
            "the ground sampling distance that is given, {given} m, is used; the raster has {own:.5} m"
        );
        monitor.diagnostic(
            &Diagnostic::warning("scale-contradicts", subject, message)
                .with_remedy("take the given one away (--gsd-m, or gsd_m of the stage)"),
        );
    }
    given.or(own)
}

/// A leaf mask and what is known of it.
#[derive(Debug, Clone, PartialEq)]
pub struct LeafMask {
    /// Leaf pixels.
    pub mask: Mask,
    /// Posterior probability of vegetation of each pixel, in 1/255, row by row; none for a given mask and for thresholds.
    pub posterior: Option<Vec<u8>>,
    /// Pixels that show something; none if all do, and for a given mask.
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

impl LeafMask {
    /// Some rows of it.
    pub(super) fn rows(&self, rows: Range<usize>) -> LeafRows {
        let pixels = rows.start * self.mask.width..rows.end * self.mask.width;
        let of = |all: &Vec<u8>| all[pixels.clone()].to_vec();
        LeafRows {
            rows,
            mask: of(&self.mask.data),
            posterior: self.posterior.as_ref().map(of),
            shown: self.valid.as_ref().map(|valid| of(&valid.data)),
        }
    }
}

/// A photo, mask or orthomosaic with its leaf mask: a mask's own two values, else pixels within thresholds, or vegetation
/// as it is estimated from the photo.
///
/// # Errors
/// A file that cannot be read; a photo that shows nothing; a mask nearly all of which is plant.
pub fn read_leaf_mask(
    image: &Path,
    hsv: Auto<Thresholds>,
    monitor: &mut dyn Monitor,
) -> Result<(Source, LeafMask), Error> {
    let (source, found) = read_any_leaf_mask(image, hsv, monitor)?;
    let share = found.mask.count() as f64 / found.mask.data.len().max(1) as f64;
    if !source.is_photo() && share > NEARLY_ALL {
        let message = format!(
            "{:.1} % of the mask is plant (its brighter value): are plants and ground exchanged? Invert it; in a canopy that has \
             closed so far no plants can be told apart",
            100.0 * share
        );
        return Err(FileError::malformed(image, None, message).into());
    }
    Ok((source, found))
}

/// Share of leaf pixels above which a mask is taken for an inverted one.
const NEARLY_ALL: f64 = 0.95;

/// The same without doubting a mask: that of a project was made from its picture.
pub(super) fn read_any_leaf_mask(
    image: &Path,
    hsv: Auto<Thresholds>,
    monitor: &mut dyn Monitor,
) -> Result<(Source, LeafMask), Error> {
    let source = Source::open(image)?.or_mask()?;
    let found = if source.is_photo() {
        let options = SegmentOptions { hsv, ..SegmentOptions::default() };
        Segmenter::new(&source, image, &options, monitor)?.whole()?
    } else {
        source.mask(|photo| Thresholds::default().mask(photo))?.into()
    };
    Ok((source, found))
}

/// The leaf mask that the stage `segment` made, with its posterior, but not with the pixels that show something.
///
/// # Errors
/// [`Error::NothingToDo`] where there is none; files that cannot be read.
pub fn of_project(
    project: &Project,
    monitor: &mut dyn Monitor,
) -> Result<(Source, LeafMask), Error> {
    let (source, mut found) = read_any_leaf_mask(&project.mask()?, Auto::Auto, monitor)?;
    if let Some(path) = project.finished(Stage::Segment, POSTERIOR) {
        let size = (found.mask.width, found.mask.height);
        found.posterior = Some(rasters::read_posterior(&path, size)?);
    }
    Ok((source, found))
}

/// The pixels of the orthomosaic that show something, as the stage `segment` found them; `None` where all do.
///
/// # Errors
/// A file that cannot be read.
pub(super) fn valid_of_project(project: &Project) -> Result<Option<Mask>, Error> {
    let path = project.finished(Stage::Segment, VALID);
    let read = |path| rasters::read_mask(path, &Thresholds::default()).map(|(mask, _)| mask);
    path.as_deref().map(read).transpose()
}

/// What is to be segmented, once it is open: anything but a mask.
pub(super) fn photo(source: Source, path: &Path) -> Result<Source, FileError> {
    let source = source.or_mask()?;
    match &source {
        _ if source.is_photo() => Ok(source),
        Source::Picture { .. } => {
            let message = "it holds a mask (two values), expected a photo";
            Err(FileError::malformed(path, None, message))
        }
        Source::File(reader) if !reader.holds::<u8>() && !reader.holds::<u16>() => {
            let message = "its pixels are single values (a vegetation index, heights), expected an orthomosaic in colours";
            Err(FileError::malformed(path, None, message))
        }
        // Whether a grey TIFF is a photo or a mask is known when all of it has been read.
        Source::File(reader) => {
            let place = reader.georeference();
            drop(images::read_photo(path)?);
            let whole = Window::whole(reader.width(), reader.height());
            let picture = images::Picture::Photo(reader.read_rgb(whole)?);
            Ok(Source::Picture { picture, gaps: None, place })
        }
    }
}

/// Says where the colours of a photo are so noisy that they are smoothed farther than those of usual photos.
fn tell_of_noise(model: &Model, image: &Path, monitor: &mut dyn Monitor) {
    if model.smoothing_px > USUAL_SMOOTHING_PX {
        let [width, usual] = [model.smoothing_px, USUAL_SMOOTHING_PX].map(|px| 2 * px + 1);
        let message = format!(
            "colours are noisy: they are smoothed over {width} x {width} pixels before leaves are told from ground, instead of \
             {usual} x {usual}. Small leaves may be lost and specks of noise may be taken for leaves"
        );
        let found = Diagnostic::warning("photo-noisy", image.display().to_string(), message);
        monitor.diagnostic(&found.with_remedy(
            "look at the mask (rowgram segment); take photos in more light, or at a lower sensitivity (ISO)",
        ));
    }
}

/// What says where leaves are in a photo, which is then segmented band by band.
pub(super) struct Segmenter<'a> {
    source: &'a Source,
    image: &'a Path,
    /// NDVI, where the photo has near infrared and red, and vegetation is estimated.
    ndvi: Option<Formula>,
    rule: Rule,
}

enum Rule {
    /// Thresholds, and the flat surround.
    Thresholds(Thresholds, Option<Surround>),
    Vegetation(Box<Estimate>),
}

/// The leaf mask of some rows, pixel by pixel.
pub(super) struct LeafRows {
    /// The rows.
    pub(super) rows: Range<usize>,
    /// 1 where there are leaves, 0 elsewhere.
    pub(super) mask: Vec<u8>,
    /// Posterior probability of vegetation in 1/255; none for thresholds.
    pub(super) posterior: Option<Vec<u8>>,
    /// 1 where something is shown, 0 elsewhere; none where all of the band is.
    pub(super) shown: Option<Vec<u8>>,
}

impl<'a> Segmenter<'a> {
    /// Sees all of the photo, where vegetation is estimated, and says where its colours are noisy.
    pub(super) fn new(
        source: &'a Source,
        image: &'a Path,
        options: &SegmentOptions,
        monitor: &mut dyn Monitor,
    ) -> Result<Segmenter<'a>, Error> {
        let ndvi = match options.hsv {
            Auto::Given(_) => None,
            Auto::Auto => {
                let roles = source.roles()?;
                let usual = Index::usual(&roles).into_iter().find(|index| index.name == "ndvi");
                usual.and_then(|index| index.bind(&roles).ok())
            }
        };
        let rule = match options.hsv {
            Auto::Given(hsv) => {
                let size = source.size();
                let mut finder = SurroundFinder::new(size);
                for band in window::bands(size.1, BAND_ROWS, 0) {
                    finder.add(&band, &source.rgb(band.rows.clone())?);
                }
                Rule::Thresholds(hsv, finder.finish())
            }
            Auto::Auto => {
                let coherence = match options.coherence {
                    0.0 => Coherence::None,
                    weight => Coherence::Icm { weight, sweeps: SWEEPS },
                };
                let how = vegetation::Options { coherence, ..vegetation::Options::default() };
                let malformed =
                    |why: VegetationError| FileError::malformed(image, None, why.to_string());
                let size = source.size();
                let mut estimator = Estimator::new(size, &how).map_err(malformed)?;
                let (mut is_grey, mut is_black) = (ndvi.is_none(), true);
                for band in window::bands(size.1, BAND_ROWS, Estimator::HALO) {
                    let rows = SeenRows::read(source, ndvi.as_ref(), &band)?;
                    let grey = |pixel: &Rgb<u8>| pixel.0 == [pixel.0[0]; 3];
                    is_grey = is_grey && rows.photo.pixels().all(grey);
                    is_black = is_black && rows.photo.pixels().all(|pixel| pixel.0 == [0; 3]);
                    estimator.add(&band, rows.seen());
                }
                if is_grey && !is_black {
                    let message = "it has more than two values and no colours, expected a mask of two values or a photo in colours";
                    return Err(FileError::malformed(image, None, message).into());
                }
                let estimate = estimator.finish().map_err(malformed)?;
                tell_of_noise(&estimate.model, image, monitor);
                Rule::Vegetation(Box::new(estimate))
            }
        };
        Ok(Segmenter { source, image, ndvi, rule })
    }

    /// What was estimated of vegetation and background, where it was.
    pub(super) fn vegetation(&self) -> Option<Model> {
        match &self.rule {
            Rule::Thresholds(..) => None,
            Rule::Vegetation(estimate) => Some(estimate.model),
        }
    }

    /// Whether a flat black or white surround was found.
    pub(super) fn has_surround(&self) -> bool {
        match &self.rule {
            Rule::Thresholds(_, surround) => surround.is_some(),
            Rule::Vegetation(estimate) => estimate.has_surround(),
        }
    }

    /// The thresholds, where the mask is made by them.
    pub(super) fn hsv(&self) -> Option<Thresholds> {
        match &self.rule {
            &Rule::Thresholds(hsv, _) => Some(hsv),
            Rule::Vegetation(_) => None,
        }
    }

    /// The leaf mask of the whole photo.
    pub(super) fn whole(&self) -> Result<LeafMask, FileError> {
        let (width, height) = self.source.size();
        // The mask, its posterior, and which of its pixels show something.
        let bytes = 3 * (width as u64).saturating_mul(height as u64);
        memory::require(self.image, "its leaf mask", bytes)?;
        let (mut mask, mut posterior) = (Vec::with_capacity(width * height), None);
        // Until a band has pixels that show nothing, all show something.
        let mut valid: Option<Vec<u8>> = None;
        for band in self.bands() {
            let LeafRows { mask: leaf, posterior: probable, shown, .. } = band?;
            if valid.is_some() || shown.is_some() {
                let valid = valid.get_or_insert_with(|| vec![1; mask.len()]);
                valid.extend(shown.unwrap_or_else(|| vec![1; leaf.len()]));
            }
            if let Some(probable) = probable {
                let all = posterior.get_or_insert_with(|| Vec::with_capacity(width * height));
                all.extend(probable);
            }
            mask.extend(leaf);
        }
        Ok(LeafMask {
            mask: Mask { width, height, data: mask },
            posterior,
            valid: valid.map(|data| Mask { width, height, data }),
            vegetation: self.vegetation(),
            hsv: self.hsv(),
        })
    }

    /// The leaf mask, from the top.
    pub(super) fn bands(&self) -> impl Iterator<Item = Result<LeafRows, FileError>> + '_ {
        let halo = match &self.rule {
            Rule::Thresholds(..) => 0,
            Rule::Vegetation(estimate) => estimate.halo(),
        };
        window::bands(self.source.size().1, BAND_ROWS, halo).map(|band| {
            let rows = SeenRows::read(self.source, self.ndvi.as_ref(), &band)?;
            Ok(match &self.rule {
                Rule::Thresholds(hsv, surround) => {
                    let SeenRows { photo, shown, .. } = rows;
                    let mut mask = hsv.mask(&photo).data;
                    let width = photo.width() as usize;
                    let outside = surround.as_ref().map(|of| of.outside(band.rows.clone(), width));
                    let shown = match (shown, outside) {
                        (Some(shown), Some(outside)) => {
                            Some(shown.iter().zip(&outside).map(|(a, b)| a & b).collect())
                        }
                        (one, other) => one.or(other),
                    };
                    for (pixel, shown) in mask.iter_mut().zip(shown.iter().flatten()) {
                        *pixel &= shown;
                    }
                    LeafRows { rows: band.rows, mask, posterior: None, shown }
                }
                Rule::Vegetation(estimate) => {
                    let found = estimate.classify(&band, rows.seen());
                    let Classified { mask, posterior, shown } = found;
                    LeafRows { rows: band.rows, mask, posterior: Some(posterior), shown }
                }
            })
        })
    }
}

/// The rows of a photo around a band.
struct SeenRows {
    photo: RgbImage,
    ndvi: Option<Vec<f32>>,
    shown: Option<Vec<u8>>,
}

impl SeenRows {
    fn read(source: &Source, ndvi: Option<&Formula>, band: &Band) -> Result<SeenRows, FileError> {
        let (photo, gaps) = source.rgb_and_gaps(band.seen.clone())?;
        let of = |ndvi: &Formula| Ok(ndvi.evaluate(&source.spectra(band.seen.clone())?.0));
        let ndvi = ndvi.map(of).transpose()?;
        let shown = gaps.map(|gaps| gaps.into_iter().map(|gap| u8::from(!gap)).collect());
        Ok(SeenRows { photo, ndvi, shown })
    }

    fn seen(&self) -> Seen<'_> {
        Seen { photo: &self.photo, ndvi: self.ndvi.as_deref(), shown: self.shown.as_deref() }
    }
}
