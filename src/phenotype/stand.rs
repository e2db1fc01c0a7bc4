//! What stands in a field: plants with their uncertainty, spacings, gaps, counts.
//!
//! Positions and lengths in pixels of the mask, centre of the top-left pixel at (0, 0).

use super::{renewal::Spacing, rows::Rows};
use serde::Serialize;

/// The 97.5 % point of the standard normal distribution.
pub const NORMAL_95: f64 = 1.959_963_984_540_054;

/// One plant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Stalk {
    /// Position in the image.
    pub position_px: [f64; 2],
    /// Number of its row, counted across the rows.
    pub row: usize,
    /// Place along the rows.
    pub along_px: f64,
    /// Probability that a plant stands within a quarter of the spacing.
    pub confidence: f64,
    /// Standard deviation along the row.
    pub sigma_along_px: f64,
    /// Standard deviation across the row.
    pub sigma_across_px: f64,
}

/// A place between two plants of a row where some seem to be missing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Missing {
    /// Its row.
    pub row: usize,
    /// The middle of the gap, in the image.
    pub position_px: [f64; 2],
    /// Length of the gap.
    pub length_px: f64,
    /// The most probable number of missing plants, at least 1.
    pub plants: usize,
    /// Probability that any is missing.
    pub probability: f64,
}

/// What was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Canopy {
    /// The plants, by row and along the row.
    pub plants: Vec<Stalk>,
    /// The rows, straight as detected.
    pub rows: Rows,
    /// The spacing of the plants within their rows; its length in pixels of the mask.
    pub spacing: Spacing,
    /// Standard error of the spacing.
    pub spacing_sigma_px: f64,
    /// 95 % interval of the number of plants that the leaves alone suggest.
    pub count_interval: [f64; 2],
    /// Expected number of plants in each row.
    pub row_counts: Vec<f64>,
    /// Standard deviation of the number of plants in each row.
    pub row_count_sigmas: Vec<f64>,
    /// Gaps in which plants seem to be missing, by row and along the row.
    pub missing: Vec<Missing>,
}

impl Canopy {
    /// Median distance between neighbours in a row, plants in one place left out; the fitted
    /// spacing where no two plants are in one row.
    pub fn median_gap_px(&self) -> f64 {
        let mut gaps: Vec<f64> = self
            .plants
            .windows(2)
            .filter(|pair| pair[0].row == pair[1].row)
            .map(|pair| pair[1].along_px - pair[0].along_px)
            .collect();
        gaps.sort_by(f64::total_cmp);
        gaps.get(gaps.len() / 2).copied().unwrap_or(self.spacing.spacing)
    }

    /// Distance between rows and its standard error, where there is more than one.
    pub fn row_spacing_px(&self) -> Option<(f64, f64)> {
        let spacing = self.rows.spacing_px?;
        let errors: Vec<f64> = self
            .rows
            .rows
            .windows(2)
            .map(|pair| {
                let gap = pair[1].across_px - pair[0].across_px;
                gap - spacing * (gap / spacing).round()
            })
            .collect();
        let count = errors.len() as f64;
        let variance = errors.iter().map(|e| e * e).sum::<f64>() / (count - 1.0).max(1.0);
        Some((spacing, (variance / count).sqrt()))
    }

    /// The ground that the rows stand on: their lengths times the distance between them.
    pub fn area_px2(&self) -> Option<f64> {
        let length: f64 = self.rows.rows.iter().map(|row| row.length_px()).sum();
        self.rows.spacing_px.map(|spacing| spacing * length)
    }
}
