//! Settings of the least-squares engine.

use super::{Curvature, LinearSolver};
use crate::engine::SolveError;
use serde::{Deserialize, Serialize};

/// A step that is right to a percent gains nearly what the exact one does.
pub(super) const LINEAR_TOLERANCE: f64 = 1e-2;

/// Which trial step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Damped Gauss-Newton.
    #[default]
    LevenbergMarquardt,
    /// Gauss-Newton and steepest descent blended within a radius.
    Dogleg,
}

/// Settings of the engine. The defaults suit bundle adjustment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Options {
    /// Which trial step.
    pub method: Method,
    /// How the linear systems are solved.
    pub linear: LinearSolver,
    /// Conjugate gradients stop where the residual, in the norm of the preconditioner, is below this
    /// share of the first.
    pub linear_tolerance: f64,
    /// How a robust loss enters the Hessian.
    pub curvature: Curvature,
    /// Stop where an accepted step decreases the cost by less than this share of it.
    pub cost_tolerance: f64,
    /// Stop where the cosine between the residual and every column of the Jacobian,
    /// `|g_k| / (sqrt(D_k) |r|)`, is below this.
    pub gradient_tolerance: f64,
    /// Stop where `|D^1/2 d|` of a step falls below this share of `|r|`.
    pub step_tolerance: f64,
    /// `lambda` of the first Levenberg-Marquardt step; Dogleg has its own.
    pub initial_damping: f64,
    /// A step is taken where the actual decrease is at least this share of the predicted one.
    pub min_relative_decrease: f64,
    /// Levenberg-Marquardt starts eliminated points again that a step leaves with so many times the mean cost of an observation;
    /// `None`: never. Of normal noise no point is one of them with 30.
    pub restart_ratio: Option<f64>,
}

impl Default for Options {
    fn default() -> Options {
        Options {
            method: Method::LevenbergMarquardt,
            linear: LinearSolver::Auto,
            linear_tolerance: LINEAR_TOLERANCE,
            curvature: Curvature::Adaptive,
            cost_tolerance: 1e-9,
            gradient_tolerance: 1e-10,
            step_tolerance: 1e-12,
            initial_damping: 3e-5,
            min_relative_decrease: 1e-3,
            restart_ratio: Some(30.0),
        }
    }
}

impl Options {
    /// Refuses values beyond their limits.
    ///
    /// # Errors
    /// [`SolveError::Misuse`]: which, and what was expected.
    pub(super) fn check(&self) -> Result<(), SolveError> {
        for (name, value) in [
            ("linear-tolerance", self.linear_tolerance),
            ("cost-tolerance", self.cost_tolerance),
            ("gradient-tolerance", self.gradient_tolerance),
            ("step-tolerance", self.step_tolerance),
            ("min-relative-decrease", self.min_relative_decrease),
        ] {
            if !(0.0..1.0).contains(&value) {
                return Err(SolveError::Misuse(format!("{name} is {value}, expected 0 to 1")));
            }
        }
        let positive = [
            ("initial-damping", self.initial_damping),
            ("restart-ratio", self.restart_ratio.unwrap_or(1.0)),
        ];
        match positive.iter().find(|(_, value)| !(*value > 0.0 && value.is_finite())) {
            Some((name, value)) => {
                Err(SolveError::Misuse(format!("{name} is {value}, expected a positive number")))
            }
            None => Ok(()),
        }
    }
}
