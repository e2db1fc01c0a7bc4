//! Estimation problems: the equations of each, posed for the engines.

pub mod adjustment;
pub mod bundle;
pub mod plants;
