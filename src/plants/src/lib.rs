//! Plants, rows, leaves and plots from leaf masks, and how well found plants match true ones.

pub mod phenotype;
pub mod problems;
pub mod score;
