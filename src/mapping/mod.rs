//! Maps from photos: surfaces, orthophotos, and which photo each of their pixels came from.
//!
//! ```text
//! colour(X, Y) = photo_k(u_k(X, Y, Z(X, Y))),   k = argmin |C_k - (X, Y, Z)| among the photos that show it
//! ```
//!
//! `Z` is the surface, `C_k` the projection centre and `u_k` collinearity with the lens of photo `k`. All
//! positions are in the mapping frame, metres.
//!
//! - [`surface`]: heights on a grid; what a ray meets, what hides what;
//! - [`view`]: a posed photo, which cells it can reach;
//! - [`select`]: the photo of every cell, its pixel there, the way to the seam (`seams`);
//! - [`photo`] and [`paint`]: colours between pixels, one photo at a time, feathered or not;
//! - [`leaf_height`]: how high above the surface the leaves are that a map is to show;
//! - [`balance`]: gains that make overlapping photos agree;
//! - [`dem`] and [`ground`]: surfaces from scattered points, and the ground below plants.

pub mod balance;
mod cells;
pub mod dem;
pub mod ground;
pub mod leaf_height;
pub mod paint;
pub mod photo;
mod seams;
pub mod select;
pub mod surface;
pub mod view;

pub use surface::Surface;
pub use view::View;

/// What cannot be mapped: what is wrong and what was expected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct MapError(pub String);
