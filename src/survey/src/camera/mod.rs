//! Cameras: from a point in the camera's frame to a position in the image, with derivatives.
//!
//! [`Lens`] is what every lens model is (an open set: yours is one more type); [`Interior`] is one of
//! the built-in models with its values and the size of its images; [`Camera`] is what a calibration
//! says of a physical camera: an interior orientation, what of it may be adjusted, how well it is
//! known. One file per lens model, each with its own conventions at the top.

pub mod bal;
pub mod brown;
mod description;
pub mod fisheye;
mod interior;
pub mod lens;
mod polynomial;
pub mod smac;

pub use description::{Camera, Correlation};
pub use interior::{CameraError, Interior, Model, centre_px as image_centre_px};
pub use lens::{Lens, MAX_PARAMETERS, Parameter, Projection};
