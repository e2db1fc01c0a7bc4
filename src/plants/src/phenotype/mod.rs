//! Plant traits from a leaf mask.
//!
//! | question | modules |
//! |---|---|
//! | where are the rows? | [`rows`] (heading, straight rows), [`row_curves`] (as they bend), [`perspective`] (tilted photos) |
//! | where are the plants? | [`locator`] (all methods), [`row_model`] (the default), [`locate`] (the paper's clustering and its variants) |
//! | what does the row model rest on? | [`evidence`] (votes along leaf axes), [`isolated_plants`], [`plant_spacing`], [`double_plants`], [`stand_count`], [`tilt`] |
//! | how many plants are there? | [`stand_count`] (of [`rows_to_count`]), [`stand`], [`plant_mass`] |
//! | how many leaves, and which? | [`leaf_count`] (from area), [`leaves`] (one by one), [`broad_leaves`] |
//! | what has each plot? | [`traits`] (what there is), [`plots`] (measured), [`plot_scatter`] (standard deviations), [`colour_indices`] |
//!
//! Lengths are in pixels of the mask unless a name says metres.

pub mod broad_leaves;
pub mod colour_indices;
pub mod double_plants;
pub mod evidence;
pub mod field_measurements;
pub mod isolated_plants;
pub mod layout;
pub mod leaf_count;
mod leaf_pixels;
pub mod leaves;
pub mod locate;
pub mod locator;
mod log_sum;
mod mass_stand;
mod periodicity;
pub mod perspective;
pub mod plant_mass;
pub mod plant_pixels;
pub mod plant_spacing;
pub mod plant_tracks;
pub mod plot_scatter;
pub mod plots;
mod principal_axis;
pub mod row_cover;
pub mod row_curves;
mod row_evidence;
mod row_lines;
mod row_membership;
pub mod row_model;
mod row_parts;
mod row_peaks;
pub mod row_plots;
pub mod row_profile;
pub mod rows;
mod rows_of_plants;
pub mod rows_to_count;
pub mod stand;
pub mod stand_count;
pub mod tilt;
pub mod traits;
