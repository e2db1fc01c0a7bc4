//! What the two optimisation engines are to whoever drives them.
//!
//! An engine owns its working memory and moves an iterate that somebody else owns, one step at a
//! time. A *step* is the smallest unit that can be observed, stopped and resumed: one trial of
//! Levenberg-Marquardt or Dogleg ([`crate::nlls`]), or one sweep of coordinate descent
//! ([`crate::descent`]).
//!
//! Invariants, each a test:
//! - `resume(x, state())` after `k` steps, followed by `n` steps, gives the same bytes as `k + n`
//!   steps without a break.
//! - A step never makes the cost of an engine that calls itself monotone larger.

use serde::{Deserialize, Serialize, de::DeserializeOwned};

/// Why an optimisation ended. Every variant is an outcome, none an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Termination {
    /// The relative decrease of the cost fell below its tolerance.
    CostConverged,
    /// The largest entry of the gradient fell below its tolerance.
    GradientConverged,
    /// The largest movement of any block fell below its tolerance.
    StepConverged,
    /// The cost reached the target that was asked for.
    TargetCost,
    /// The limit of iterations was reached.
    MaxIterations,
    /// The limit of time was reached.
    MaxTime,
    /// No step that decreases the cost could be found any more, however short.
    Stalled,
    /// Somebody asked for it to stop.
    Interrupted,
}

impl Termination {
    /// Whether the iterate is a (numerical) optimum, not merely the last one reached.
    pub fn converged(self) -> bool {
        matches!(
            self,
            Termination::CostConverged
                | Termination::GradientConverged
                | Termination::StepConverged
                | Termination::TargetCost
        )
    }

    /// One clause for a person, e.g. "the cost changed by less than its tolerance".
    pub fn explain(self) -> &'static str {
        match self {
            Termination::CostConverged => "the cost changed by less than its tolerance",
            Termination::GradientConverged => "the gradient fell below its tolerance",
            Termination::StepConverged => "nothing moved by more than the tolerance",
            Termination::TargetCost => "the target cost was reached",
            Termination::MaxIterations => "the limit of iterations was reached",
            Termination::MaxTime => "the time limit was reached",
            Termination::Stalled => "no step decreased the cost any further",
            Termination::Interrupted => "it was interrupted",
        }
    }

    /// The word used in TOML, CSV and JSON.
    pub fn word(self) -> &'static str {
        match self {
            Termination::CostConverged => "cost-converged",
            Termination::GradientConverged => "gradient-converged",
            Termination::StepConverged => "step-converged",
            Termination::TargetCost => "target-cost",
            Termination::MaxIterations => "max-iterations",
            Termination::MaxTime => "max-time",
            Termination::Stalled => "stalled",
            Termination::Interrupted => "interrupted",
        }
    }
}

/// What one step did.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// Cost of the iterate after the step.
    pub cost: f64,
    /// Largest movement of any block, in the block's own unit.
    pub step_norm: f64,
    /// Whether the iterate changed.
    pub accepted: bool,
    /// Why to stop here, if the engine itself wants to.
    pub stop: Option<Termination>,
    /// Named numbers for the trace (damping, gradient, active blocks, ...), the same names in the
    /// same order at every step of one engine.
    pub metrics: Vec<(&'static str, f64)>,
}

/// How a run of an engine ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RunOutcome {
    /// Cost of the start.
    pub initial_cost: f64,
    /// Cost at the end.
    pub final_cost: f64,
    /// Steps made: trials of least squares, refused ones included, or sweeps of coordinate descent.
    pub iterations: u64,
    /// Why it ended.
    pub stop: Termination,
}

/// Starts `engine` and steps it until it wants to stop or `max_iterations` are made; `observe` sees the number of every
/// step and what it did. [`crate::drive`] does the same with clocks, files and interruption around it.
///
/// # Errors
/// As [`Engine::start`] and [`Engine::step`].
pub fn run<P: ?Sized, E: Engine<P>>(
    problem: &P,
    engine: &mut E,
    x: &mut E::Iterate,
    max_iterations: u64,
    mut observe: impl FnMut(u64, &Step),
) -> Result<RunOutcome, SolveError> {
    let initial_cost = engine.start(problem, x)?;
    let mut outcome = RunOutcome {
        initial_cost,
        final_cost: initial_cost,
        iterations: 0,
        stop: Termination::MaxIterations,
    };
    while outcome.iterations < max_iterations {
        let step = engine.step(problem, x)?;
        outcome.iterations += 1;
        outcome.final_cost = step.cost;
        observe(outcome.iterations, &step);
        if let Some(stop) = step.stop {
            outcome.stop = stop;
            break;
        }
    }
    Ok(outcome)
}

/// Why an engine cannot go on at all (a numerical end is a [`Termination`], not one of these).
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SolveError {
    /// The starting values cannot be evaluated.
    #[error("the starting values cannot be evaluated: {0}")]
    InfeasibleStart(String),
    /// A residual, Jacobian or cost is NaN or infinite where it must be finite.
    #[error("not a finite number in {0}")]
    NotFinite(String),
    /// An interior-point method ended without a solution; says of what, and how it ended.
    #[error("no solution of {0}")]
    NotSolved(String),
    /// The problem as posed has no unique solution; says which parameters.
    #[error("{0}")]
    RankDeficient(String),
    /// The problem is posed in a way that the engine cannot take.
    #[error("{0}")]
    Misuse(String),
}

/// An optimisation engine over problems of type `P`.
pub trait Engine<P: ?Sized> {
    /// What is moved.
    type Iterate: Clone + Send + Serialize + DeserializeOwned;
    /// What besides the iterate decides all future steps (damping, active set, sweep number).
    type State: Clone + Send + Serialize + DeserializeOwned;
    /// Name of the method, for traces and checkpoints.
    const NAME: &'static str;

    /// Prepares for `problem` and returns the cost of the starting iterate.
    ///
    /// # Errors
    /// Where the start cannot be evaluated or the problem cannot be solved as posed.
    fn start(&mut self, problem: &P, x: &mut Self::Iterate) -> Result<f64, SolveError>;

    /// Makes one step.
    ///
    /// # Errors
    /// Only where going on has no meaning; every numerical end is a [`Step::stop`].
    fn step(&mut self, problem: &P, x: &mut Self::Iterate) -> Result<Step, SolveError>;

    /// What a checkpoint must hold besides the iterate.
    fn state(&self) -> Self::State;

    /// Like [`Engine::start`], but goes on from a checkpoint. The cost that is returned is the one that the problem gives at
    /// `x`, by which a checkpoint of another problem is told; steps go on from the one in `state`.
    ///
    /// # Errors
    /// As [`Engine::start`], and where `state` does not belong to this problem.
    fn resume(
        &mut self,
        problem: &P,
        x: &mut Self::Iterate,
        state: Self::State,
    ) -> Result<f64, SolveError>;
}

/// Lends an engine: whoever drives it gives it back with its working memory.
impl<P: ?Sized, E: Engine<P>> Engine<P> for &mut E {
    type Iterate = E::Iterate;
    type State = E::State;
    const NAME: &'static str = E::NAME;

    fn start(&mut self, problem: &P, x: &mut Self::Iterate) -> Result<f64, SolveError> {
        (**self).start(problem, x)
    }

    fn step(&mut self, problem: &P, x: &mut Self::Iterate) -> Result<Step, SolveError> {
        (**self).step(problem, x)
    }

    fn state(&self) -> Self::State {
        (**self).state()
    }

    fn resume(
        &mut self,
        problem: &P,
        x: &mut Self::Iterate,
        state: Self::State,
    ) -> Result<f64, SolveError> {
        (**self).resume(problem, x, state)
    }
}
