//! What came of an adjustment, for a person ([`std::fmt::Display`]) and for a machine (serde).

use super::problem::Problem;
use crate::engine::{RunOutcome, SolveError, Termination};
use serde::Serialize;

/// How the factors of a batch enter the normal equations.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum BatchPath {
    /// Linearised several at a time and eliminated point by point; no Jacobian is stored.
    Fused,
    /// Jacobians are stored; says why the batch is not fused.
    Stored(String),
    /// Jacobians are stored and the whole system is dense, as was asked for.
    Dense,
}

impl std::fmt::Display for BatchPath {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            BatchPath::Fused => f.write_str("fused"),
            BatchPath::Stored(why) => write!(f, "stored: {why}"),
            BatchPath::Dense => f.write_str("dense"),
        }
    }
}

/// What solves the reduced system.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum LinearKind {
    /// One dense Cholesky factor.
    DenseCholesky,
    /// A sparse Cholesky factor.
    SparseCholesky,
    /// Conjugate gradients on the matrix.
    ConjugateGradients,
    /// Conjugate gradients, the matrix never formed.
    ImplicitConjugateGradients,
}

/// How the (reduced) normal equations are solved, and why so.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct LinearPath {
    /// What solves them.
    pub kind: LinearKind,
    /// Why.
    pub why: String,
}

impl std::fmt::Display for LinearPath {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let kind = match self.kind {
            LinearKind::DenseCholesky => "dense Cholesky",
            LinearKind::SparseCholesky => "sparse Cholesky",
            LinearKind::ConjugateGradients => "conjugate gradients",
            LinearKind::ImplicitConjugateGradients => {
                "conjugate gradients without forming the reduced system"
            }
        };
        write!(f, "{kind}: {}", self.why)
    }
}

/// One batch at the solution.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BatchSummary {
    /// Its name.
    pub name: String,
    /// How many factors it has.
    pub factors: usize,
    /// Its part of the cost, `1/2 sum rho(|r|^2)`.
    pub cost: f64,
    /// Root of the mean of `|r|^2` over the factors, without the loss, in the unit of `r`.
    pub rmse: f64,
    /// How the engine evaluated it and why; `None` where no engine was asked.
    pub path: Option<BatchPath>,
}

/// The outcome of an adjustment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// `1/2 sum rho(|r|^2)` at the start.
    pub initial_cost: f64,
    /// `1/2 sum rho(|r|^2)` at the end.
    pub final_cost: f64,
    /// Trials made, refused ones included.
    pub iterations: u64,
    /// Why it stopped.
    pub stop: Termination,
    /// Sum of the lengths of all residuals.
    pub residuals: usize,
    /// Degrees of freedom that could move.
    pub parameters: usize,
    /// Batch by batch.
    pub batches: Vec<BatchSummary>,
    /// How the linear systems were solved; `None` where no engine was asked.
    pub linear: Option<LinearPath>,
}

impl Summary {
    /// Evaluates every batch at `x`.
    ///
    /// # Errors
    /// Where a factor cannot be evaluated there.
    pub fn new(problem: &Problem, x: &[f64], outcome: RunOutcome) -> Result<Summary, SolveError> {
        let RunOutcome { initial_cost, final_cost, iterations, stop } = outcome;
        let costs = problem.costs(x)?;
        let batches = problem
            .batches
            .iter()
            .zip(costs)
            .map(|(named, cost)| {
                let squares: f64 = problem.residuals(x, &named.name)?.iter().map(|r| r * r).sum();
                Ok(BatchSummary {
                    name: named.name.clone(),
                    factors: named.batch.len(),
                    cost,
                    rmse: (squares / named.batch.len() as f64).sqrt(),
                    path: None,
                })
            })
            .collect::<Result<_, SolveError>>()?;
        Ok(Summary {
            initial_cost,
            final_cost,
            iterations,
            stop,
            residuals: problem.residual_count(),
            parameters: problem.parameter_count(),
            batches,
            linear: None,
        })
    }
}

impl Summary {
    /// With the paths of the batches, from [`super::LeastSquares::paths`], and that of the linear systems, from
    /// [`super::LeastSquares::linear_path`].
    #[must_use]
    pub fn with_paths(mut self, paths: &[BatchPath], linear: Option<&LinearPath>) -> Summary {
        self.linear = linear.cloned();
        for (batch, path) in self.batches.iter_mut().zip(paths) {
            batch.path = Some(path.clone());
        }
        self
    }
}

impl std::fmt::Display for Summary {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(
            f,
            "cost {:.6e} -> {:.6e} in {} iterations; stopped because {}",
            self.initial_cost,
            self.final_cost,
            self.iterations,
            self.stop.explain()
        )?;
        writeln!(f, "{} residuals, {} free parameters", self.residuals, self.parameters)?;
        if let Some(linear) = &self.linear {
            writeln!(f, "linear systems by {linear}")?;
        }
        let width = self.batches.iter().map(|b| b.name.len()).max().unwrap_or(0);
        for batch in &self.batches {
            write!(
                f,
                "  {:width$}  {:>9} factors  rmse {:.6}  cost {:.6e}",
                batch.name, batch.factors, batch.rmse, batch.cost
            )?;
            match &batch.path {
                Some(path) => writeln!(f, "  ({path})")?,
                None => writeln!(f)?,
            }
        }
        Ok(())
    }
}
