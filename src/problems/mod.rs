//! Estimation problems over the two engines: one file each, equations first.

pub mod bundle;
