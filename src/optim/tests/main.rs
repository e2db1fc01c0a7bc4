//! The engines from outside, as a user of the crate meets them: one module per subject.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::print_stdout,
    reason = "a test that cannot go on fails, its helpers too"
)]

mod convergence;
mod examples;
mod resume;
