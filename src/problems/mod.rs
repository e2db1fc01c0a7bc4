//! Estimation problems over the two engines: one module each, equations first.

pub mod bundle;
pub mod calibration;
pub mod lens_fit;
pub mod plants;
