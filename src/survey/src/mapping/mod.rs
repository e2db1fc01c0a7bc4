//! Surfaces and orthophotos, and which photo each of their pixels came from.
//!
//! ```text
//! colour(X, Y) = photo_k(u_k(X, Y, Z(X, Y))),   k = argmin |C_k - (X, Y, Z)| among the photos that show it
//! ```
//!
//! `Z` is the surface, `C_k` the projection centre and `u_k` collinearity with the lens of photo `k`. All
//! positions are in the mapping frame, metres.
//!
//! - [`surface`]: heights on a grid; where a ray meets it, what it hides;
//! - [`view`]: a photo with its lens and pose, and which cells it can show;
//! - [`select`]: the photo of every cell, its pixel there, the distance to the seam (`seams`);
//! - [`photo`], [`photo_cache`] and [`paint`]: decoded photos, their colours between pixels;
//! - [`canopy_height`]: the height of the canopy above the surface;
//! - [`colour_balance`] and [`colour_correction`]: what brings the colours of overlapping photos together;
//! - [`grid`]: the area that photos cover, and the grid of a product;
//! - [`mosaic`]: the orthomosaic, tile by tile, and where its cells come from ([`provenance`]);
//! - [`elevation`]: elevation models of a cloud ([`dem`]);
//! - [`dense`]: the first surface, cell by cell, and the ground below it.

pub mod assignment;
pub mod canopy_height;
mod cells;
pub mod colour_balance;
pub mod colour_correction;
pub mod continuation;
pub mod dem;
pub mod dense;
pub mod elevation;
pub mod grid;
pub mod map_ties;
pub mod mosaic;
pub mod orientation_sigma;
pub mod paint;
pub mod photo;
pub mod photo_cache;
pub mod plant_ties;
pub mod plot_frame;
pub mod provenance;
mod seams;
pub mod select;
pub mod surface;
pub mod undistort;
pub mod view;

pub use surface::Surface;
pub use view::{View, views};

/// What cannot be mapped: what is wrong and what was expected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct MapError(pub String);

impl From<MapError> for rowgram_base::Error {
    fn from(error: MapError) -> Self {
        rowgram_base::Error::module(rowgram_base::Kind::BadInput, error)
    }
}
