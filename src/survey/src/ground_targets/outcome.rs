//! What is looked for, and what became of it.

use super::codes;
use image::GrayImage;
use rowgram_base::Error;
use serde::{Deserialize, Serialize};

/// A photo in grey, by the index of its image.
pub type ReadPhoto<'a> = &'a (dyn Fn(usize) -> Result<GrayImage, Error> + Sync);

/// What a target looks like.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TargetKind {
    /// Two black and two white quadrants.
    Chequered,
    /// A white cross on darker ground.
    Cross,
    /// A white disc on darker ground.
    Disc,
    /// AprilTag 36h11.
    Apriltag,
    /// ArUco `DICT_4X4_50`.
    Aruco,
}

rowgram_base::choices!(TargetKind: Chequered, Cross, Disc, Apriltag, Aruco);

impl TargetKind {
    /// All kinds.
    pub const ALL: [TargetKind; 5] = [
        TargetKind::Apriltag,
        TargetKind::Aruco,
        TargetKind::Chequered,
        TargetKind::Cross,
        TargetKind::Disc,
    ];

    /// Number of codes of a coded kind.
    pub fn codes(self) -> Option<usize> {
        match self {
            TargetKind::Apriltag => Some(codes::APRILTAG.len()),
            TargetKind::Aruco => Some(codes::ARUCO.len()),
            TargetKind::Chequered | TargetKind::Cross | TargetKind::Disc => None,
        }
    }
}

/// How targets are looked for.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetSearch {
    /// What they look like; all kinds are tried where `None`.
    pub kind: Option<TargetKind>,
    /// Sizes that are tried, metres: the side of a chequered plate, the length of the arms of a cross, the diameter of a disc, the
    /// side of the black square of a coded target.
    pub sizes_m: Vec<f64>,
    /// How far from their predicted places they are looked for, metres on the ground.
    pub search_m: f64,
    /// The least correlation of photo and fitted shape, 0 to 1.
    pub min_score: f64,
    /// How far the measurement of one photo may be from where the other photos put the target, pixels.
    pub tolerance_px: f64,
}

/// A target that was measured in a photo.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TargetMeasurement {
    /// Its centre, pixels.
    pub image_px: [f64; 2],
    /// Standard deviation of each coordinate, pixels.
    pub sigma_px: f64,
    /// Correlation of photo and fitted shape, 0 to 1.
    pub score: f64,
    /// Its code.
    pub code: Option<usize>,
    /// Distance from where the photos together put it, pixels; `None` where no other photo has it.
    pub residual_px: Option<f64>,
}

/// Why a target was not found in a photo.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, thiserror::Error)]
#[serde(rename_all = "kebab-case", tag = "reason")]
pub enum NotFound {
    /// It has too few pixels to be measured.
    #[error("it has {size_px:.1} pixels, too few to be measured")]
    TooSmall {
        /// Its size, pixels.
        size_px: f64,
    },
    /// Nothing looks like it where it should be.
    #[error("nothing looks like it (best score {score:.2})")]
    NothingAlike {
        /// The best score.
        score: f64,
    },
    /// Its border is there, but not a code.
    #[error("its code cannot be read")]
    Unreadable,
    /// What looks like it is elsewhere than the other photos say.
    #[error("what looks like it is {off_px:.1} pixels from where the other photos have it")]
    Inconsistent {
        /// Distance, pixels.
        off_px: f64,
    },
    /// No other photo or target confirms what looks like it.
    #[error("no other photo confirms what looks like it")]
    Unconfirmed,
}

/// A target that a photo should show.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetSighting {
    /// Index of the ground point.
    pub ground: usize,
    /// Index of the image.
    pub image: usize,
    /// Where it should be, with the shift of the block, pixels.
    pub predicted_px: [f64; 2],
    /// Its size in the photo, pixels.
    pub size_px: f64,
    /// What was found.
    pub outcome: Result<TargetMeasurement, NotFound>,
}

/// Targets in photos.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundTargets {
    /// What they look like.
    pub kind: TargetKind,
    /// Their size, metres.
    pub size_m: f64,
    /// Positions in the block less surveyed ones, in the middle of the targets, metres.
    pub shift_m: [f64; 3],
    /// What is left of those differences, metres.
    pub shift_sigma_m: f64,
    /// Every target in every photo that should show it, in the order of targets, then images.
    pub sightings: Vec<TargetSighting>,
}

impl FoundTargets {
    /// The measurements.
    pub fn measurements(&self) -> impl Iterator<Item = (&TargetSighting, &TargetMeasurement)> {
        self.sightings.iter().filter_map(|s| s.outcome.as_ref().ok().map(|found| (s, found)))
    }
}
