//! What earlier steps measured of a field: plants, gaps, weeds, leaves, each with its place in pixels.

use super::{row_cover::RowCover, stand::Weed};

/// A leaf that was told apart; NaN where a number is not known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredLeaf {
    /// Its middle, pixels.
    pub at_px: [f64; 2],
    /// Its length, metres.
    pub length_m: f64,
    /// Its mean width, metres.
    pub width_m: f64,
    /// Its mean hue, degrees.
    pub hue_deg: f64,
}

/// A gap in a row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowGap {
    /// Its middle, pixels.
    pub at_px: [f64; 2],
    /// How many plants it lacks.
    pub plants: f64,
    /// Probability that it lacks any.
    pub probability: f64,
}

/// Leaves of a plot from the area that they cover, with the ends of the 95 % interval.
#[derive(Debug, Clone, PartialEq)]
pub struct LeavesByArea {
    /// Name of the plot.
    pub plot: String,
    /// Number, its lower and its upper end; NaN where an end is not known.
    pub leaves: [f64; 3],
}

/// What is known of a field; `None` for what was not measured.
#[derive(Debug, Clone, Default)]
pub struct FieldMeasurements {
    /// Ground sampling distance, metres; `None` where the raster has no scale.
    pub gsd_m: Option<f64>,
    /// Places of the plants, pixels.
    pub plants: Option<Vec<[f64; 2]>>,
    /// The row of each plant, NaN where it stands in none; empty where there are no rows.
    pub row_of: Vec<f64>,
    /// What each plant adds to the variance of a number of plants; empty where that is not known.
    pub count_variance: Vec<f64>,
    /// Standard deviation of the place of each plant along its row, pixels; empty where that is not known.
    pub along_sigma_px: Vec<f64>,
    /// Gaps in the rows.
    pub gaps: Option<Vec<RowGap>>,
    /// Weeds between the rows.
    pub weeds: Option<Vec<Weed>>,
    /// Leaf along the rows.
    pub rows: Option<RowCover>,
    /// Leaves that were told apart.
    pub leaves: Option<Vec<MeasuredLeaf>>,
    /// Leaves by area, by plot.
    pub by_area: Option<Vec<LeavesByArea>>,
}
