//! Photogrammetry: cameras, features, structure from motion, adjustment of surveys, surfaces and orthomosaics.

pub mod camera;
pub mod features;
pub mod ground_targets;
pub mod mapping;
pub mod problems;
pub mod scene;
pub mod sfm;
pub mod target;
