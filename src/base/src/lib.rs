//! What the crates of rowgram share: options defined once, progress and diagnostics, one error.

pub mod disjoint_sets;
pub mod error;
pub mod monitor;
pub mod options;

pub use error::{Error, Kind};
