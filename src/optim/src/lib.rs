//! Two optimisation engines and what runs them: sparse nonlinear least squares, and coordinate descent.
//!
//! - [`nlls`]: sums of squares over manifolds, with sparse and Schur solvers, losses and covariances.
//! - [`descent`]: cyclic exact minimisation of blocks, for objectives that are not smooth.
//! - [`convex`]: exact reference solutions by an interior-point method.
//! - [`drive`]: limits, observers, traces and checkpoints of any [`engine`].

pub mod convex;
pub mod descent;
pub mod drive;
pub mod engine;
pub mod geometry;
pub mod lanes;
pub mod nlls;
pub mod output;
pub mod simplex;
