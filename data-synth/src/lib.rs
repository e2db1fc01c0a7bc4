//! Synthetic crop fields and aerial blocks with the whole truth, for testing plant phenotyping and
//! photogrammetry.
//!
//! What exists ([`field`], [`leaf`]) is kept apart from what corrupts it ([`corrupt`]) and from how
//! it looks from above ([`render`], [`picture`]); [`scenario`] joins the three under one seed.
//! [`spectrum`] gives the same field in five bands of reflectance.
//! [`block`] makes the measurements of a nadir aerial block straight from geometry, [`collection`] those of a
//! collection of photos of places.
//! [`twin`] sets the field on [`terrain`] at a [`site`] on Earth, flies over it with a true [`camera`]
//! ([`flight`]), sets out [`targets`], takes photos ([`photo`]) or measures tie points without them
//! ([`tie_points`]), and [`files`] writes it all down. [`board`] photographs a chessboard with the same camera.
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
//!
//! ```
//! use data_synth::scenario::{Preset, Scenario};
//!
//! let mut scenario = Scenario::preset(Preset::Early20);
//! scenario.field.rows = 2;
//! scenario.field.row_length_m = 1.0;
//! let scene = scenario.build()?;
//! let mask = scene.mask();
//! for plant in &scene.field.plants {
//!     assert_eq!(mask.get_pixel(plant.u_px.round() as u32, plant.v_px.round() as u32).0, [255]);
//! }
//! # Ok::<(), data_synth::ConfigError>(())
//! ```

pub mod block;
pub mod board;
pub mod camera;
pub mod clutter;
pub mod collection;
pub mod corrupt;
pub mod exif;
pub mod field;
pub mod files;
pub mod flight;
mod flight_config;
pub mod gimbal;
pub mod habit;
pub mod labels;
pub mod leaf;
pub mod panels;
pub mod patterns;
pub mod photo;
pub mod picture;
pub mod render;
pub mod scenario;
pub mod season;
pub mod season_plan;
pub mod site;
pub mod spectrum;
pub mod start_model;
pub mod targets;
pub mod terrain;
pub mod tie_points;
pub mod twin;
pub mod visible;

mod block_camera;
mod block_ground;
mod check;
mod collection_scene;
mod collection_start;
mod mesh;
mod soil;
mod streams;

pub use check::ConfigError;
