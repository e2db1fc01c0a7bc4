//! What stages hand to each other: cameras, images, tie points, ground points and what was measured of them.
//!
//! Lengths are metres in the mapping frame (X east, Y north, Z up), image positions pixels with the centre of the
//! top-left pixel at (0, 0).

mod accuracy;
mod excluded;
mod orientation;
mod pose;
mod reconstruction;
mod reference;

pub use accuracy::{Accuracy, CameraSigma, PoseSigma};
pub use excluded::{Excluded, ExcludedKind};
pub use orientation::{CameraOrientation, gimbal_rotation};
pub use pose::Pose;
pub use reconstruction::{
    Axes, CameraPosition, GroundObservation, GroundPoint, Image, Observation, Reconstruction, Role,
    RollingShutter, ScaleBar, TiePoint,
};
pub use reference::{HorizontalFrame, LengthUnit, ReferenceFrame, VerticalFrame};
