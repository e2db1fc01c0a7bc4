//! Plants from leaf pixels.

pub mod assignment;
mod buckets;
pub mod index;
