//! Two optimisation engines, their driver, and what they need; what follows is the README of the crate.
#![doc = include_str!("../README.md")]

pub mod convex;
pub mod descent;
pub mod drive;
pub mod engine;
pub mod geometry;
pub mod lanes;
pub mod nlls;
pub mod output;
pub mod robust;
