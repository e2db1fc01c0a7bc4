//! All integration tests in one binary: one module per subject.

#![allow(
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a test that cannot go on fails, its helpers too"
)]

mod adjust;
mod adjustment;
mod align;
mod architecture;
mod bands;
mod boards;
mod browser;
mod calibrate;
mod calibration;
mod camera;
mod crops;
mod crs;
mod data;
mod diagnostics;
mod drive;
mod engine;
mod evaluate;
mod examples;
#[cfg(target_os = "linux")]
mod faults;
mod features;
mod formats;
mod heights;
#[cfg(target_os = "linux")]
mod hostile;
mod leaves;
mod locate;
mod maps;
#[cfg(target_os = "linux")]
mod mutations;
mod nlls;
mod ortho;
mod parsers;
mod plan;
mod plot_layout;
mod program;
mod results;
mod row_model;
mod run;
mod season;
mod season_colours;
mod segment;
mod sfm;
mod spoiled;
mod surface;
mod synth;
mod synth_flight;
mod target;
mod targets;
