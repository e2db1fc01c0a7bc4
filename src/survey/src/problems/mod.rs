//! Estimation problems: the equations of each, posed for the engines.

pub mod adjustment;
pub mod bundle;
pub mod calibration;
pub mod lens_fit;
pub mod map_transform;
pub mod network_start;
mod pose_chain;
pub mod radiometry;
