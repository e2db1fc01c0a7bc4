//! Estimation problems: the equations of each, posed for the engines.

pub mod growth_curve;
pub mod plants;
pub mod plot_layout;
