//! The rows of a mask as they are when their plants are counted ([`super::stand_count`]).

use super::{
    plant_spacing::Spacing, row_evidence::RowEvidence, row_model::RowModelOptions,
    row_profile::Profile, rows::Rows, stand_count::Overall,
};
use rowgram_raster::Mask;

/// Plants farther from their row than this share of the distance of rows belong to none: at half of it they could be of the next one.
const NEAR_ROW: f64 = 0.45;

/// Everything that is known of the rows when their plants are counted, and the spacing of the plants.
pub(super) fn read_rows<'m>(
    mask: &'m Mask,
    rows: &Rows,
    count: Option<usize>,
    options: &RowModelOptions,
) -> (RowEvidence<'m>, Spacing) {
    let (mut evidence, spacing) = RowEvidence::with_spacing(mask, rows, count, options);
    evidence.cut(&spacing);
    evidence.compare_with_plants(&spacing);
    (evidence, spacing)
}

/// What the weights of the stand count are fitted to.
#[derive(Debug, Clone, PartialEq)]
pub struct RowsToCount {
    /// What each row shows, or each part of a row that has plants.
    pub profiles: Vec<Profile>,
    /// What they show together.
    pub overall: Overall,
    /// The spacing of the plants, its length in pixels of the reduced grid.
    pub spacing: Spacing,
    /// The places of some plants on each, in steps, ascending; those of no row are left out.
    pub plants: Vec<Vec<usize>>,
}

/// Reads the rows of a mask, and puts plants on them.
pub fn rows_to_count(
    mask: &Mask,
    rows: &Rows,
    plants_px: &[[f64; 2]],
    options: &RowModelOptions,
) -> RowsToCount {
    let (evidence, spacing) = read_rows(mask, rows, None, options);
    let reach =
        NEAR_ROW * rows.spacing_px.map_or(f64::INFINITY, |px| px / evidence.evidence.factor as f64);
    let mut plants = vec![Vec::new(); evidence.profiles.len()];
    for (row, step) in plants_px.iter().filter_map(|&at| evidence.nearest(at, reach)) {
        plants[row].push(step);
    }
    for (row, profile) in plants.iter_mut().zip(&evidence.profiles) {
        row.sort_unstable();
        // Neighbours are two steps from each other at least.
        for k in 1..row.len() {
            row[k] = row[k].max(row[k - 1] + 2);
        }
        row.retain(|&step| step < profile.votes.len());
    }
    RowsToCount { overall: evidence.overall(), spacing, profiles: evidence.profiles, plants }
}
