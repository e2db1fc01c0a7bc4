//! The parts of one Levenberg-Marquardt step, one by one: for benchmarks and for looking inside.

use super::{LinearSolver, normal::Normal, options::LINEAR_TOLERANCE, problem::Problem};
use crate::engine::SolveError;

/// A problem whose steps are made part by part. The parts are called in the order in which they
/// are written here; calling them in another order gives numbers without meaning.
#[derive(Debug)]
pub struct StepProfiler<'a> {
    problem: &'a Problem,
    normal: Normal,
    x: Vec<f64>,
    step: Vec<f64>,
}

impl<'a> StepProfiler<'a> {
    /// Analyses the problem at its starting values. Without `fuse`, Jacobians are stored even
    /// where they need not be.
    ///
    /// # Errors
    /// Where the problem cannot be solved as posed.
    pub fn new(problem: &'a Problem, linear: LinearSolver, fuse: bool) -> Result<Self, SolveError> {
        let normal = Normal::new(problem, linear, LINEAR_TOLERANCE, fuse)?;
        let step = vec![0.0; normal.gradient.len()];
        Ok(StepProfiler { problem, normal, x: problem.start(), step })
    }

    /// The cost at the starting values.
    ///
    /// # Errors
    /// Where a factor cannot be evaluated.
    pub fn cost(&mut self) -> Result<f64, SolveError> {
        self.normal.cost(self.problem, &self.x).map_err(|(batch, factor)| {
            self.problem.infeasible(&self.problem.batches[batch], factor)
        })
    }

    /// Residuals and Jacobians of whatever is stored.
    ///
    /// # Errors
    /// Where a factor cannot be evaluated.
    pub fn linearize(&mut self) -> Result<(), SolveError> {
        match self.normal.linearize(self.problem, &self.x) {
            Ok(_) => Ok(()),
            Err((batch, factor)) => {
                Err(self.problem.infeasible(&self.problem.batches[batch], factor))
            }
        }
    }

    /// The reduced system with damping `lambda`; says whether every eliminated block is positive
    /// definite.
    pub fn eliminate(&mut self, lambda: f64) -> bool {
        self.normal.eliminate(self.problem, &self.x, lambda).is_ok()
    }

    /// Cholesky of the reduced system, or of its diagonal blocks; says whether it is positive definite.
    pub fn factorize(&mut self) -> bool {
        let normal = &mut self.normal;
        normal.solver.factorize(&normal.matrix).is_ok()
    }

    /// The step of the retained blocks, and of all blocks where Jacobians are stored; `None` where an iteration cannot begin.
    pub fn solve(&mut self) -> Option<&[f64]> {
        self.normal.solve(self.problem, &mut self.step).ok()?;
        Some(&self.step)
    }
}
