//! Bundle adjustment with control, statistics and calibration.

mod bad_input;
mod calibration;
mod snooping;
mod statistics;
mod toy;
