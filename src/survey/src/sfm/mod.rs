//! From matched image positions to an oriented block: relative orientation of pairs, tracks,
//! exterior orientation image by image, joining of fragments, the frame of the map.
//!
//! ```text
//! lenses      r_ideal = r (1 + a r^2)          intrinsics      what explains most matches
//! pairs       r2^T E r1 = 0                    verify          two or five points, refinement
//! tracks      one point, many images           tracks
//! images      x = u(R_i X_j + t_i)             incremental     start, resection, adjustment
//! frame       s R x + t = y                    georeference    by control points or camera positions
//! block       min sum |v|^2                    adjust_block    rounds, shutter, guided matching, outliers
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
mod single_pair_registration;

pub mod adjust_block;
pub mod block;
pub mod bundle;
pub mod control;
pub mod depth_outliers;
pub mod epipolar_rematching;
pub mod flight;
pub mod georeference;
pub mod guided_matching;
pub mod incremental;
pub mod intrinsics;
pub mod level;
pub mod longer_tracks;
mod mark_reading;
pub mod orientation_review;
pub mod positions;
pub mod refinement;
pub mod resection;
pub mod rolling_shutter;
pub mod start;
pub mod tied;
mod track_thinning;
pub mod tracks;
pub mod triangulate;
pub mod verify;
mod weak_control;

pub use block::{Block, Features, Pair};
