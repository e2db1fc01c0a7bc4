//! Plant traits from a mask.

pub mod locate;
pub mod rows;
