//! The last look at the photos: matches by the adjusted block, and the block by these.

use super::{Finding, extract::bar, finish::typical_px, judge::demands, project::Photo, stages};
use crate::{
    error::Error,
    features::{Descriptors, grey},
    io::images,
    scene::Role,
    sfm::{
        Features,
        again::{Again, look_again},
        block::Block,
        georeference::{Known, adjust, renew_points},
        remeasure::{FEW, Remeasuring, remeasure},
        shutter::{self, Drift},
        tracks::Tracks,
        verify::Matched,
    },
};
use clap::ValueEnum;

/// Whether photos are looked at again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum When {
    /// Where there is control, which says that coordinates matter.
    Auto,
    /// In any case.
    On,
    /// Never.
    Off,
}

impl When {
    /// Whether a block with this control is.
    pub(super) fn wanted(self, known: &Known) -> bool {
        match self {
            When::Auto => known.ground.iter().any(|point| point.role == Role::Control),
            When::On => true,
            When::Off => false,
        }
    }
}

/// The most iterations between two looks at what fits.
const ITERATIONS: u64 = 12;

/// What is looked at.
pub(super) struct Photos<'a> {
    pub(super) descriptors: &'a [&'a Descriptors],
    /// Matches by looks alone.
    pub(super) matched: &'a [Matched],
}

/// The tracks of all that the block now tells.
pub(super) fn tracks(block: &Block<'_>, photos: &Photos<'_>) -> Tracks {
    let progress = bar(0, "looking again");
    let tell = |total: usize| {
        progress.set_length(total as u64);
        progress.inc(1);
    };
    let matched = look_again(block, photos.descriptors, photos.matched, &Again::default(), &tell);
    progress.finish_and_clear();
    let found: usize = matched.iter().map(|pair| pair.matches.len()).sum();
    tracing::info!("{} pairs overlap, {found} matches where the block has them", matched.len());
    let pairs = matched.iter().map(|pair| (pair.images, pair.matches.as_slice()));
    stages::tracks(block.features, pairs)
}

/// Its points, measured again in the photos: features and tracks.
///
/// # Errors
/// A photo that cannot be read any more.
pub(super) fn remeasured(
    block: &Block<'_>,
    photos: &[Photo],
    findings: &mut Vec<Finding>,
) -> Result<(Vec<Features>, Tracks), Error> {
    let progress = bar(2 * photos.len(), "measuring");
    let read = |image: usize| images::read_photo(&photos[image].path).map(|p| grey(&p));
    let found = remeasure(block, &read, &Remeasuring::default(), &|| progress.inc(1))?;
    progress.finish_and_clear();
    tracing::info!("{} of {} image positions measured again", found.found, found.asked);
    findings.extend(found.kept.iter().map(|(image, count)| {
        let what = format!(
            "fewer than {FEW} of its points were found again by least-squares matching; {count} stay where their key points are, which is less exact"
        );
        Finding::new(&photos[*image as usize].name, &what)
    }));
    let pairs = found.matches.iter().map(|pair| (pair.images, pair.matches.as_slice()));
    let tracks = stages::tracks(&found.features, pairs);
    Ok((found.features, tracks))
}

/// The block by these tracks, adjusted; and its drift, where its shutter rolls.
///
/// Some matches are wrong, and lie anywhere within the tolerance: cut off close to the block, they hold it where it was.
/// So the band is a wide one until the block has come to rest.
///
/// # Errors
/// Where it cannot be evaluated.
pub(super) fn settle(
    block: &mut Block<'_>,
    known: &Known,
    flight: &[usize],
    tolerance_px: f64,
    sigma_px: &mut f64,
) -> Result<Option<Drift>, Error> {
    let mut settle = |block: &mut Block<'_>, band_px: f64| -> Result<f64, Error> {
        adjust(block, known, *sigma_px, &demands(band_px), ITERATIONS)?;
        *sigma_px = typical_px(block).max(0.05);
        Ok(*sigma_px)
    };
    renew_points(block, &demands(tolerance_px));
    let sigma = settle(block, tolerance_px)?;
    let drift = shutter::renew(block, known, flight, sigma)?;
    if let Some(drift) = &drift {
        shutter::adopt(block, drift);
    }
    let sigma = settle(block, tolerance_px)?;
    settle(block, (6.0 * sigma).clamp(0.1 * tolerance_px, tolerance_px))?;
    Ok(drift)
}
