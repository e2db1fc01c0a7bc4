//! All integration tests in one binary: one module per subject.

mod data;
mod evaluate;
mod program;
mod segment;
