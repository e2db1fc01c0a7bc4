//! Engine one: sparse nonlinear least squares.
//!
//! ```text
//! min_x  1/2 sum_i rho_i( |r_i(x)|^2 )
//! ```
//!
//! over parameter blocks that live in [`Manifold`]s, with residuals given by [`Factor`]s in named
//! [`Batch`]es, each with a [`Loss`]. [`LeastSquares`] is the engine (Levenberg-Marquardt or
//! Dogleg); [`solve`] runs it to the end, [`crate::drive`] with observers, limits and checkpoints.
//! [`covariance`] gives standard deviations, [`check`] tests Jacobians.
//!
//! Results are bit-identical for any number of threads: work is cut into ranges that depend on the
//! problem only, and their sums are added in order.

mod block_table;
pub mod check;
mod cholesky;
mod conjugate;
pub mod covariance;
pub mod dual;
mod elimination;
mod factor;
mod linearized;
mod loss;
pub mod manifold;
mod normal;
mod options;
mod prior;
mod problem;
mod projection;
pub mod residual;
mod schur;
mod schur_solver;
mod sight;
mod strategy;
mod structure;
mod summary;
mod trial_step;
mod trust_region;

pub use dual::{Dual, Scalar};
pub use factor::{
    Batch, Curvature, Factor, Factors, Infeasible, InfeasibleFactor, Jacobian, Values,
};
pub use linearized::LinearizedFactor;
pub use loss::{Loss, LossFunction, Rho};
pub use manifold::{Euclidean, Manifold};
pub use options::{Method, Options};
pub use prior::GaussianPrior;
pub use problem::{BlockId, Problem};
pub use projection::{
    Dim, Linearized, LinearizedProjection, Measurement, Of, ProjectionBatch, ProjectionFactor, Size,
};
pub use residual::{Residual, Residuals, Vector};
pub use schur::{FusedElimination, FusionRequest};
pub use summary::{BatchPath, BatchSummary, LinearKind, LinearPath, Summary};
pub use trust_region::{LeastSquares, SolverState};

use crate::engine::{self, SolveError};
use serde::{Deserialize, Serialize};

/// How the linear system of a step is solved.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LinearSolver {
    /// As [`LinearSolver::Schur`] or as [`LinearSolver::IterativeSchur`], whichever a step is estimated to cost less
    /// with.
    #[default]
    Auto,
    /// Dense Cholesky of the whole system: for small problems.
    Dense,
    /// Sparse Cholesky of the whole system.
    Sparse,
    /// Blocks marked with [`Problem::eliminate`] first, one by one; then Cholesky of the reduced
    /// system, sparse or dense by its fill.
    Schur,
    /// Blocks marked with [`Problem::eliminate`] first; then conjugate gradients on the reduced system,
    /// preconditioned by its diagonal blocks, to [`Options::linear_tolerance`]. Where the points are fused and no
    /// block is shared, the reduced system is never formed. For networks so large and so dense that its factor is the
    /// trouble.
    IterativeSchur,
}

impl LinearSolver {
    /// The same elimination with a factorisation: what covariances need.
    fn direct(self) -> LinearSolver {
        if self.eliminates() { LinearSolver::Schur } else { self }
    }

    /// Whether blocks are eliminated first.
    fn eliminates(self) -> bool {
        matches!(self, LinearSolver::Auto | LinearSolver::Schur | LinearSolver::IterativeSchur)
    }
}

/// Runs [`LeastSquares`] on `problem` from `x` until it stops by itself or after
/// `max_iterations`; `x` holds the result.
///
/// # Errors
/// As [`engine::run`].
pub fn solve(
    problem: &Problem,
    x: &mut Vec<f64>,
    options: &Options,
    max_iterations: u64,
) -> Result<Summary, SolveError> {
    let mut engine = LeastSquares::new(options.clone());
    let outcome = engine::run(problem, &mut engine, x, max_iterations, |_, _| ())?;
    let summary = Summary::new(problem, x, outcome)?;
    Ok(summary.with_paths(engine.paths(), engine.linear_path()))
}
