//! Plant traits from a mask.

pub mod canopy;
pub mod chain;
pub mod crops;
pub mod crown;
pub mod evidence;
pub mod islands;
pub mod leaf_count;
pub mod leaves;
pub mod locate;
pub mod locator;
pub mod plots;
pub mod renewal;
mod repeats;
pub mod ridges;
pub mod rows;
mod scene;
pub mod stand;
pub mod tally;
pub mod tilt;
