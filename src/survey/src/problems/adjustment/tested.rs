//! Observations at the solution, one by one and kind by kind.

use super::settings::Group;
use serde::Serialize;

/// Directions of a residual that are checked by less than this are not checked.
pub(super) const LEAST_REDUNDANCY: f64 = 1e-6;

/// Which test.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OutlierTest {
    /// The standard deviations given are right: Baarda's test.
    Baarda,
    /// They are right but for a common factor of each kind: Pope's test.
    #[default]
    Pope,
}

/// What an observation is; indices into the reconstruction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ObservationRef {
    /// A measurement of a tie point.
    TieObservation(usize),
    /// A mark of a ground point.
    Mark(usize),
    /// The coordinates of a ground point.
    Control(usize),
    /// A camera position.
    Position(usize),
    /// A scale bar.
    ScaleBar(usize),
}

/// An observation at the solution; its first `rows` entries count.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TestedObservation {
    /// Its kind.
    pub group: Group,
    /// Which one it is.
    pub subject: ObservationRef,
    /// How many numbers it is.
    pub rows: u8,
    /// Degrees of freedom of `T`; 0 where nothing checks it.
    pub freedom: u8,
    /// Residuals (adjusted minus measured) in standard deviations.
    pub residual: [f64; 3],
    /// Redundancy numbers, 0 (nothing checks it) to 1.
    pub redundancy: [f64; 3],
    /// `T`.
    pub statistic: f64,
    /// The error of the observation that would explain its residual, `-R_i^-1 v_i`, in standard deviations:
    /// how far what was measured is from what all the others say. 0 where nothing checks it.
    pub error: [f64; 3],
}

impl TestedObservation {
    /// Residuals over their own standard deviations for a variance factor of 1; 0 where nothing
    /// checks them.
    pub fn standardised(&self) -> [f64; 3] {
        std::array::from_fn(|k| match self.redundancy[k] {
            redundancy if redundancy > LEAST_REDUNDANCY => self.residual[k] / redundancy.sqrt(),
            _ => 0.0,
        })
    }
}

/// A kind of observations at the solution.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GroupStatistics {
    /// The kind.
    pub group: Group,
    /// Numbers observed.
    pub observations: usize,
    /// Sum of their redundancy numbers.
    pub redundancy: f64,
    /// Sum of the squares of their residuals, in standard deviations.
    pub squares: f64,
}

impl GroupStatistics {
    /// The estimate of the group's own variance factor; `None` where nothing checks it.
    pub fn variance_factor(&self) -> Option<f64> {
        (self.redundancy > 0.1).then(|| self.squares / self.redundancy)
    }
}
