//! Cameras: from a point in the camera's frame to a position in the image, with derivatives.
//!
//! One file per lens model, each with its own conventions at the top.

pub mod bal;
