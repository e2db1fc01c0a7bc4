//! Synthetic crop fields and aerial blocks with the whole truth, for testing plant phenotyping and
//! photogrammetry.
//!
//! [`block`] makes the measurements of a nadir aerial block straight from geometry.
//!
//! # Frames, pixels, units
//! SI units; metres in the mapping frame (X east, Y north, Z up above flat ground, origin at the
//! middle of the field or block). Image positions are `u` right and `v` down in pixels, and **the
//! centre of the top-left pixel is (0, 0)**. Degrees appear only in configurations, which people
//! type and read (`_deg`).
//!
//! # Randomness
//! Every stage of every item (a planting site, a plant, a weed, a pixel row, a ground point) draws
//! from a ChaCha8 stream of its own, addressed by (seed, stage, item). Hence the same configuration
//! gives the same bytes for any number of threads, and switching a corruption on never moves what
//! is true.

pub mod block;

mod block_camera;
mod block_ground;
mod check;
mod streams;

pub use check::ConfigError;
