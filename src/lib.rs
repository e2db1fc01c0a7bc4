//! From overlapping drone photos of a crop field to plant traits, over two optimisation engines.
//!
//! # Frames, pixels, units
//! SI units; metres in the mapping frame (X east, Y north, Z up); radians inside. Image positions
//! are `u` right and `v` down in pixels, and **the centre of the top-left pixel is (0, 0)**; every
//! format with another convention is converted at its border.

pub mod camera;
pub mod cli;
pub mod convex;
pub mod descent;
pub mod drive;
pub mod engine;
pub mod error;
pub mod geometry;
pub mod io;
pub mod lanes;
pub mod nlls;
pub mod phenotype;
pub mod problems;
pub mod raster;
pub mod score;

pub use error::{Error, Kind};
