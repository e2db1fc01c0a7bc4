//! The estimation problems, one module each, equations first.

pub mod plants;
