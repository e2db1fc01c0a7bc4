//! Plants from leaf pixels.

pub mod assignment;
mod buckets;
pub mod index;
mod inner;
pub use inner::{Quadratic, median as inner_median};
