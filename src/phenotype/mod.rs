//! Plant traits from a mask.

pub mod broad_leaves;
pub mod double_plants;
pub mod dynamic_programming;
pub mod evidence;
pub mod isolated_plants;
pub mod leaf_count;
pub mod leaves;
pub mod locate;
pub mod locator;
mod mass_stand;
mod periodicity;
pub mod plant_mass;
pub mod plant_spacing;
pub mod plots;
pub mod row_curves;
mod row_evidence;
pub mod row_model;
pub mod rows;
pub mod stand;
pub mod stand_count;
pub mod tiles;
pub mod tilt;
