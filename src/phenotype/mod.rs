//! Plant traits from a mask.

pub mod leaf_count;
pub mod leaves;
pub mod locate;
pub mod rows;
