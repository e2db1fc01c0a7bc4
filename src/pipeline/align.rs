//! From photos to a reconstruction in the mapping frame.

use serde::{Deserialize, Serialize};

/// The lens model of cameras that are not given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LensChoice {
    /// Brown, or SMAC where that explains clearly more matches: lenses with strong distortion.
    Auto,
    /// Ideal to measured, radial and decentring distortion, as in OpenCV and COLMAP.
    Brown,
    /// Measured to ideal, as in the paper.
    Smac,
}

/// The minimal solver of relative orientation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SolverChoice {
    /// Whichever explains more matches of a pair.
    Auto,
    /// The paper's, for nadir photos from nearly the same height.
    TwoPoint,
    /// Any photos.
    FivePoint,
}

crate::choices!(LensChoice: Auto, Brown, Smac);
crate::choices!(SolverChoice: Auto, TwoPoint, FivePoint);

crate::options! {
    /// From photos to camera poses, calibrated cameras and a sparse cloud in the mapping frame.
    pub struct AlignOptions in "align" {
        /// Lens model of cameras that are not given.
        pub lens: LensChoice = LensChoice::Auto;
        /// Minimal solver of relative orientation.
        pub solver: SolverChoice = SolverChoice::Auto;
        /// The most features of a photo.
        pub max_features: usize = 6000, limits at_least(100.0);
        /// Distance from the projection of its point up to which an image position is used.
        pub tolerance_px: f64 = 4.0, limits POSITIVE;
        /// Whether camera positions take part in the adjustment; else they only tell which photos are neighbours.
        pub use_positions: bool = true;
        /// Ground points that take no part and are compared afterwards.
        pub check: Vec<String> = Vec::new();
        /// Seed of all random sampling.
        pub seed: u64 = 1;
    }
}
