//! Bundle adjustment with control, statistics and calibration.

mod bad_input;
mod calibration;
mod clustered;
mod files;
mod program;
mod snooping;
mod statistics;
mod toy;
