//! Levenberg-Marquardt and Dogleg, one trial per step.
//!
//! Levenberg-Marquardt solves `(J^T J + lambda D) d = -J^T r` with `D` the diagonal of `J^T J` and moves
//! `lambda` by the ratio `rho` of the actual to the predicted decrease (Nielsen, IMM-REP-1999-05):
//! `lambda max(1/10, 1 - (2 rho - 1)^3)` after a good step, `lambda nu` with doubling `nu` after a bad one.
//! Points of fused batches that a step leaves far off are started again before the step is judged.
//! Dogleg (Powell; Madsen, Nielsen and Tingleff 2004, section 3.3) goes from the minimum along the
//! gradient towards the Gauss-Newton step, as far as a radius in the norm `|D^1/2 d|` allows.

use super::{
    BatchPath, Curvature, LinearPath, Method, Options, normal::Normal, problem::Problem,
    trial_step::TrialStep,
};
use crate::engine::{Engine, SolveError, Step, Termination};
use serde::{Deserialize, Serialize};

/// What besides the iterate decides the next steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SolverState {
    lambda: f64,
    nu: f64,
    /// Dogleg's radius; none before the first step, which is then as long as Gauss-Newton's.
    radius: Option<f64>,
    /// Share of the losses' curvature in the Hessian.
    curvature_share: f64,
    /// Cost of the iterate as the step that led to it added it up; evaluated afresh it may differ in its last bits, because
    /// the sums are then cut otherwise.
    cost: f64,
    values: usize,
}

/// The engine: sparse nonlinear least squares.
#[derive(Debug)]
pub struct LeastSquares {
    options: Options,
    state: SolverState,
    work: Option<Workspace>,
}

#[derive(Debug)]
struct Workspace {
    normal: Normal,
    cost: f64,
    trial: Vec<f64>,
    step: Vec<f64>,
    gauss_newton: Vec<f64>,
    /// The linearisation belongs to the current iterate.
    linearized: bool,
    /// It is known to be finite.
    known_finite: bool,
    /// `gauss_newton` does.
    solved: bool,
}

/// A step gains this many times what the model promised: the loss's curvature is missing in it.
const MODEL_TOO_STIFF: f64 = 1.25;
/// A step gains less than this share of what was promised: there is too much of it.
const MODEL_TOO_SOFT: f64 = 0.5;
/// How fast the share of the curvature goes to 1 or to 0.
const CURVATURE_GAIN: f64 = 0.4;
/// A smaller share changes the model by less than a thousandth of the losses' curvature, which is not worth a linearisation.
const MIN_CURVATURE_SHARE: f64 = 1e-3;
/// Beyond this damping a step is shorter than rounding.
const MAX_LAMBDA: f64 = 1e30;
const MIN_LAMBDA: f64 = 1e-15;
/// The damping falls to no less than this share after the best of steps. Nielsen takes a third, which
/// costs bundle blocks one to three more iterations.
const MIN_DAMPING_FACTOR: f64 = 0.1;
/// Damping of Dogleg's Gauss-Newton step, raised where the system is singular.
const GAUSS_NEWTON_LAMBDA: f64 = 1e-10;

impl LeastSquares {
    /// An engine with these settings.
    pub fn new(options: Options) -> LeastSquares {
        let state = SolverState::new(&options);
        LeastSquares { options, state, work: None }
    }

    /// The settings.
    pub fn options(&self) -> &Options {
        &self.options
    }

    /// How each batch of the problem is evaluated, in their order; empty before the start.
    pub fn paths(&self) -> &[BatchPath] {
        self.work.as_ref().map_or(&[], |work| &work.normal.paths)
    }

    /// How the linear systems are solved; `None` before the start.
    pub fn linear_path(&self) -> Option<&LinearPath> {
        self.work.as_ref().map(|work| &work.normal.linear_path)
    }

    fn prepare(&mut self, problem: &Problem, x: &[f64]) -> Result<f64, SolveError> {
        self.options.check()?;
        if x.len() != problem.offsets.last().copied().unwrap_or(0) {
            return Err(SolveError::Misuse(format!(
                "{} values were given, the problem has {}",
                x.len(),
                problem.offsets.last().copied().unwrap_or(0)
            )));
        }
        let mut normal = Normal::new(
            problem,
            self.options.linear,
            self.options.linear_tolerance,
            self.options.method == Method::LevenbergMarquardt,
        )?;
        let cost = normal
            .cost(problem, x)
            .map_err(|(batch, factor)| problem.infeasible(&problem.batches[batch], factor))?;
        if !cost.is_finite() {
            return Err(SolveError::NotFinite("the cost of the starting values".into()));
        }
        (self.state.values, self.state.cost) = (x.len(), cost);
        let tangent = normal.gradient.len();
        self.work = Some(Workspace {
            normal,
            cost,
            trial: x.to_vec(),
            step: vec![0.0; tangent],
            gauss_newton: Vec::new(),
            linearized: false,
            known_finite: false,
            solved: false,
        });
        Ok(cost)
    }
}

impl Engine<Problem> for LeastSquares {
    type Iterate = Vec<f64>;
    type State = SolverState;
    const NAME: &'static str = "least-squares";

    fn start(&mut self, problem: &Problem, x: &mut Vec<f64>) -> Result<f64, SolveError> {
        self.state = SolverState::new(&self.options);
        self.prepare(problem, x)
    }

    fn step(&mut self, problem: &Problem, x: &mut Vec<f64>) -> Result<Step, SolveError> {
        let Some(work) = &mut self.work else {
            return Err(SolveError::Misuse("the engine was not started".into()));
        };
        if !work.linearized {
            work.normal.curvature_share = self.state.curvature_share;
            work.normal
                .linearize(problem, x)
                .map_err(|(batch, factor)| problem.infeasible(&problem.batches[batch], factor))?;
            work.linearized = true;
            work.known_finite = false;
            work.solved = false;
        }
        let trial = match self.options.method {
            Method::LevenbergMarquardt => {
                let Workspace { normal, cost, step, trial, .. } = work;
                let restart_cost = self.options.restart_ratio.map(|ratio| ratio * *cost);
                normal.attempt(problem, x, (self.state.lambda, restart_cost), step, trial)
            }
            Method::Dogleg => dogleg_step(problem, x, work, &mut self.state),
        };
        if trial.is_none() && !work.known_finite {
            // No damping helps against a NaN: it would be raised in vain until the limit.
            work.normal.require_finite(problem, x)?;
            work.known_finite = true;
        }
        let residual_norm = (2.0 * work.cost).sqrt();
        let cosine = match (work.normal.gradient_is_known, residual_norm > 0.0) {
            (true, true) => work.normal.largest_slope() / residual_norm,
            (true, false) => 0.0,
            (false, _) => f64::NAN,
        };
        let mut step = Step {
            cost: work.cost,
            step_norm: 0.0,
            accepted: false,
            stop: None,
            metrics: vec![
                ("damping", self.state.lambda),
                ("gradient_cosine", cosine),
                ("predicted_decrease", 0.0),
                ("ratio", 0.0),
                ("curvature_share", self.state.curvature_share),
                ("linear_products", work.normal.solver.take_products() as f64),
            ],
        };
        if cosine <= self.options.gradient_tolerance {
            step.stop = Some(Termination::GradientConverged);
            return Ok(step);
        }
        let Some(trial) = trial else {
            // Not positive definite: more damping is the remedy.
            work.solved = false;
            step.stop = self.state.reject_step(&self.options, 0.0);
            return Ok(step);
        };
        let decrease = work.cost - trial.cost;
        let ratio = decrease / trial.predicted;
        step.metrics[2].1 = trial.predicted;
        step.metrics[3].1 = ratio.max(f64::MIN);
        if trial.predicted > 0.0 && ratio >= self.options.min_relative_decrease && decrease > 0.0 {
            std::mem::swap(x, &mut work.trial);
            step.accepted = true;
            step.step_norm = trial.step_norm;
            step.cost = trial.cost;
            if decrease <= self.options.cost_tolerance * work.cost {
                step.stop = Some(Termination::CostConverged);
            } else if trial.length <= self.options.step_tolerance * residual_norm {
                step.stop = Some(Termination::StepConverged);
            }
            (work.cost, self.state.cost) = (trial.cost, trial.cost);
            work.linearized = false;
            self.state.accept_step(&self.options, ratio, trial.length);
            self.state.adapt_curvature(&self.options, ratio);
        } else if trial.predicted <= 8.0 * f64::EPSILON * work.cost {
            // What is left to gain is below the rounding of the cost itself.
            step.stop = Some(Termination::CostConverged);
        } else {
            step.stop = self.state.reject_step(&self.options, trial.length);
            if self.state.adapt_curvature(&self.options, ratio) {
                work.linearized = false;
            }
        }
        Ok(step)
    }

    fn state(&self) -> SolverState {
        self.state.clone()
    }

    fn resume(
        &mut self,
        problem: &Problem,
        x: &mut Vec<f64>,
        state: SolverState,
    ) -> Result<f64, SolveError> {
        if state.values != x.len() {
            return Err(SolveError::Misuse(format!(
                "the checkpoint holds {} values, the problem has {}",
                state.values,
                x.len()
            )));
        }
        let saved_cost = state.cost;
        self.state = state;
        let found_cost = self.prepare(problem, x)?;
        self.state.cost = saved_cost;
        if let Some(work) = &mut self.work {
            work.cost = saved_cost;
        }
        Ok(found_cost)
    }
}

impl SolverState {
    fn new(options: &Options) -> SolverState {
        let curvature_share = if options.curvature == Curvature::Full { 1.0 } else { 0.0 };
        SolverState {
            lambda: match options.method {
                Method::LevenbergMarquardt => options.initial_damping,
                Method::Dogleg => GAUSS_NEWTON_LAMBDA,
            },
            nu: 2.0,
            radius: None,
            curvature_share,
            cost: f64::NAN,
            values: 0,
        }
    }

    /// Moves the share of the losses' curvature by the ratio of actual to predicted decrease;
    /// says whether it changed.
    fn adapt_curvature(&mut self, options: &Options, ratio: f64) -> bool {
        if options.curvature != Curvature::Adaptive {
            return false;
        }
        let before = self.curvature_share;
        if ratio > MODEL_TOO_STIFF {
            self.curvature_share = 1.0 - (1.0 - before) * CURVATURE_GAIN;
        } else if ratio < MODEL_TOO_SOFT {
            let smaller = before * CURVATURE_GAIN;
            self.curvature_share = if smaller < MIN_CURVATURE_SHARE { 0.0 } else { smaller };
        }
        self.curvature_share != before
    }

    /// After a step that was taken.
    fn accept_step(&mut self, options: &Options, ratio: f64, length: f64) {
        match options.method {
            Method::LevenbergMarquardt => {
                let factor = (1.0 - (2.0 * ratio - 1.0).powi(3)).max(MIN_DAMPING_FACTOR);
                self.lambda = (self.lambda * factor).max(MIN_LAMBDA);
            }
            Method::Dogleg => {
                let radius = self.radius.unwrap_or(length);
                self.radius = Some(if ratio > 0.75 {
                    radius.max(3.0 * length)
                } else if ratio < 0.25 {
                    0.5 * radius
                } else {
                    radius
                });
                self.lambda = (self.lambda / 5.0).max(GAUSS_NEWTON_LAMBDA);
            }
        }
        self.nu = 2.0;
    }

    /// After a trial that was refused (or impossible: `length` 0).
    fn reject_step(&mut self, options: &Options, length: f64) -> Option<Termination> {
        match options.method {
            Method::Dogleg if length > 0.0 => {
                let radius = 0.25 * length.min(self.radius.unwrap_or(length));
                self.radius = Some(radius);
                (radius < f64::MIN_POSITIVE.sqrt()).then_some(Termination::Stalled)
            }
            _ => {
                self.lambda *= self.nu;
                self.nu *= 2.0;
                (self.lambda > MAX_LAMBDA).then_some(Termination::Stalled)
            }
        }
    }
}

fn scaled_length(step: &[f64], diagonal: &[f64]) -> f64 {
    step.iter().zip(diagonal).map(|(d, w)| d * d * w).sum::<f64>().sqrt()
}

fn dogleg_step(
    problem: &Problem,
    x: &[f64],
    work: &mut Workspace,
    state: &mut SolverState,
) -> Option<TrialStep> {
    if !work.solved {
        work.normal.reduce(problem, x, state.lambda).ok()?;
        work.gauss_newton.resize(work.step.len(), 0.0);
        work.normal.solve(problem, &mut work.gauss_newton).ok()?;
        work.solved = true;
    }
    let normal = &work.normal;
    let newton_length = scaled_length(&work.gauss_newton, &normal.diagonal);
    let radius = state.radius.unwrap_or(newton_length);
    if newton_length <= radius {
        work.step.copy_from_slice(&work.gauss_newton);
    } else {
        // The minimum of the model along -D^-1 g.
        let (mut slope, steepest) = (0.0, &mut work.step);
        for ((d, g), w) in steepest.iter_mut().zip(&normal.gradient).zip(&normal.diagonal) {
            *d = if *w > 0.0 { -g / w } else { 0.0 };
            slope += -g * *d;
        }
        let curvature = normal.squared_product(problem, steepest);
        let cauchy = slope / curvature;
        let steepest_length = scaled_length(steepest, &normal.diagonal);
        if cauchy * steepest_length >= radius {
            steepest.iter_mut().for_each(|d| *d *= radius / steepest_length);
        } else {
            // |a + t (b - a)| = radius with a Cauchy's, b Gauss-Newton's step.
            let (mut aa, mut ac, mut cc) = (0.0, 0.0, 0.0);
            for ((a, b), w) in steepest.iter_mut().zip(&work.gauss_newton).zip(&normal.diagonal) {
                *a *= cauchy;
                let c = b - *a;
                aa += w * *a * *a;
                ac += w * *a * c;
                cc += w * c * c;
            }
            let gap = radius * radius - aa;
            let t = gap / (ac + (ac * ac + cc * gap).sqrt());
            for (a, b) in steepest.iter_mut().zip(&work.gauss_newton) {
                *a += t * (b - *a);
            }
        }
    }
    let slope: f64 = work.step.iter().zip(&normal.gradient).map(|(d, g)| d * g).sum();
    let predicted = -slope - 0.5 * normal.squared_product(problem, &work.step);
    let length = scaled_length(&work.step, &normal.diagonal);
    problem.plus(x, &work.step, &mut work.trial);
    let cost = match work.normal.cost(problem, &work.trial) {
        Ok(cost) if cost.is_finite() => cost,
        _ => f64::INFINITY,
    };
    let step_norm = work.step.iter().fold(0.0, |most: f64, v| v.abs().max(most));
    let attempt = TrialStep { predicted, length, step_norm, cost };
    (predicted.is_finite() && length.is_finite()).then_some(attempt)
}
