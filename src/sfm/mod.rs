//! From matched image positions to an oriented block: relative orientation of pairs, tracks,
//! exterior orientation image by image, joining of fragments, the frame of the map.
//!
//! ```text
//! pairs       r2^T E r1 = 0                    relative        two or five points, refinement
//! tracks      one point, many images           tracks
//! images      x = u(R_i X_j + t_i)             block, growth   start, augmentation, adjustment
//! the map     s R x + t = y                    absolute
//! ```
//!
//! Nothing here opens a file or reads a clock; results do not depend on the number of threads.
//! Camera frames are those of [`crate::camera::lens`], poses `camera_from_world`.
//!
//! References: F. He and A. Habib, *Linear approach for initial recovery of the exterior orientation
//! parameters of randomly captured images by low-cost mobile mapping systems*, ISPRS Annals II-1,
//! 2014; the same, as in [`relative::two_point`]; J. L. Schoenberger and J.-M. Frahm,
//! *Structure-from-motion revisited*, CVPR 2016.

mod polynomial;
pub mod relative;
mod vouched;

pub mod again;
pub mod averaging;
pub mod block;
pub mod control;
pub mod georeference;
pub mod global;
pub mod growth;
pub mod guided;
pub mod remeasure;
pub mod resection;
pub mod shutter;
pub mod solitary;
pub mod start;
pub mod tracks;
pub mod triangulate;
pub mod verify;

pub use block::{Block, Features, Pair};
