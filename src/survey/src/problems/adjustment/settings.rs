//! The kinds of observations, and the settings of an adjustment.

use rowgram_optim::nlls::{Loss, Options};
use serde::{Deserialize, Serialize};

/// The kinds of observations; each has its own variance component.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Group {
    /// Measurements of tie points.
    TiePoints,
    /// Marks of ground points.
    Marks,
    /// Coordinates of control points.
    Control,
    /// Measured camera positions.
    Positions,
    /// Measured distances.
    ScaleBars,
    /// What is known of interior orientations beforehand.
    Interior,
    /// What is known of motions beforehand.
    Motion,
    /// Measured orientations of cameras.
    Orientations,
}

impl Group {
    /// All groups.
    pub const ALL: [Group; 8] = [
        Group::TiePoints,
        Group::Marks,
        Group::Control,
        Group::Positions,
        Group::ScaleBars,
        Group::Interior,
        Group::Motion,
        Group::Orientations,
    ];

    /// What a person calls it.
    pub fn name(self) -> &'static str {
        match self {
            Group::TiePoints => "tie points",
            Group::Marks => "marks",
            Group::Control => "control coordinates",
            Group::Positions => "camera positions",
            Group::ScaleBars => "scale bars",
            Group::Interior => "interior orientation",
            Group::Motion => "motion",
            Group::Orientations => "camera orientations",
        }
    }
}

/// How a reconstruction is adjusted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Settings {
    /// Robust loss of tie points, in standard deviations; statistics need least squares.
    pub tie_loss: Loss,
    /// Take SMAC's residuals in the domain of the corrected coordinates, for comparison.
    pub corrected_domain: bool,
    /// Without control: hold the first image, and one coordinate of the farthest one.
    pub minimal_datum: bool,
    /// With control: camera positions are all off by the same unknown vector, as those of a receiver without a base are.
    pub position_offset: bool,
    /// Factors on the standard deviations of each group, in the order of [`Group::ALL`].
    pub sigma_factors: [f64; 8],
    /// The most iterations.
    pub max_iterations: u64,
}

impl Default for Settings {
    fn default() -> Settings {
        Settings {
            tie_loss: Loss::Trivial,
            corrected_domain: false,
            minimal_datum: false,
            position_offset: false,
            sigma_factors: [1.0; 8],
            max_iterations: 100,
        }
    }
}

impl Settings {
    pub(super) fn factor(&self, group: Group) -> f64 {
        self.sigma_factors[group as usize]
    }

    /// The engine's settings.
    pub fn engine(&self) -> Options {
        // The start is a block that was oriented: its points are near their places.
        Options { cost_tolerance: 1e-12, restart_ratio: None, ..Options::default() }
    }
}
