//! Runs any [`Engine`]: limits, observers, a trace, checkpoints and resumption.
//!
//! The engines compute and know nothing of clocks, files or terminals; this is where those are. A
//! run is driven by argmin's executor, but no type of argmin is part of the interface: all that is
//! known about it is in one private file.
//!
//! Invariants, each a test:
//! - The iterate is moved, never copied, and never lost: an engine that fails in the middle of a
//!   run, a full disk or an interruption still give an [`DriveOutcome`] with the iterate in it.
//! - A run that was stopped at any iteration and resumed from its checkpoint ends in the same bytes
//!   as one that was not: iterate, costs, iteration numbers, log and trace, but for the seconds.
//! - No step is made beyond a limit; the limits count from the very start, over all resumptions.
//!
//! ```
//! use rowgram_optim::drive::{Drive, Limits};
//! use rowgram_optim::engine::{Engine, SolveError, Step, Termination};
//!
//! /// Halves the way to the problem's number until it hardly moves.
//! struct Halving;
//! impl Engine<f64> for Halving {
//!     type Iterate = f64;
//!     type State = ();
//!     const NAME: &'static str = "halving";
//!     fn start(&mut self, goal: &f64, x: &mut f64) -> Result<f64, SolveError> {
//!         Ok((goal - *x).powi(2))
//!     }
//!     fn step(&mut self, goal: &f64, x: &mut f64) -> Result<Step, SolveError> {
//!         let step_norm = (goal - *x) / 2.0;
//!         *x += step_norm;
//!         let stop = (step_norm.abs() < 1e-6).then_some(Termination::StepConverged);
//!         let cost = (goal - *x).powi(2);
//!         Ok(Step { cost, step_norm: step_norm.abs(), accepted: true, stop, metrics: vec![] })
//!     }
//!     fn state(&self) {}
//!     fn resume(&mut self, goal: &f64, x: &mut f64, _: ()) -> Result<f64, SolveError> {
//!         self.start(goal, x)
//!     }
//! }
//!
//! let outcome = Drive::new(&3.0, Halving, 1.0).limits(Limits::iterations(100)).run()?;
//! assert_eq!((outcome.stop, outcome.iterations), (Termination::StepConverged, 21));
//! assert!((outcome.x - 3.0).abs() < 1e-6);
//! # Ok::<(), rowgram_optim::drive::DriveError>(())
//! ```

mod checkpoint;
mod container;
mod executor;
mod observe;
mod state;
mod trace;

pub use crate::drive::container::Fingerprint;
pub use observe::{Event, Observe};

use crate::{
    engine::{Engine, RunOutcome, SolveError, Termination},
    output::{self, FileError},
};
use serde::{Deserialize, Serialize};
use std::{
    path::{Path, PathBuf},
    sync::atomic::AtomicBool,
    time::{Duration, Instant},
};

/// Why a run could not be started, or what it failed with.
#[derive(Debug, thiserror::Error)]
pub enum DriveError {
    /// A checkpoint or trace could not be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The engine could not start, or could not go on.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// Settings of the run exclude one another.
    #[error("{0}")]
    Argument(String),
    /// The run broke off.
    #[error("{0}")]
    Incomplete(String),
}

/// What ends a run at the latest. The default sets no limit: the engine's own end is the only one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// The most iterations, those before a resumption among them; 0 makes no step at all.
    pub max_iterations: u64,
    /// The longest time, the engine's preparation and the time before a resumption in it; looked
    /// at between steps.
    pub max_time: Option<Duration>,
    /// The run ends as soon as the cost of the iterate is not above this.
    pub target_cost: Option<f64>,
}

impl Default for Limits {
    fn default() -> Self {
        Limits { max_iterations: u64::MAX, max_time: None, target_cost: None }
    }
}

impl Limits {
    /// A limit of iterations and no other.
    pub fn iterations(max_iterations: u64) -> Limits {
        Limits { max_iterations, ..Limits::default() }
    }
}

/// A moment at which the best cost became smaller; in JSON `[iteration, best cost, seconds]`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(from = "(u64, f64, f64)", into = "(u64, f64, f64)")]
pub struct LogEntry {
    /// Iterations made.
    pub iteration: u64,
    /// Smallest cost so far.
    pub best_cost: f64,
    /// Seconds since the start.
    pub seconds: f64,
}

impl From<(u64, f64, f64)> for LogEntry {
    fn from((iteration, best_cost, seconds): (u64, f64, f64)) -> Self {
        LogEntry { iteration, best_cost, seconds }
    }
}

impl From<LogEntry> for (u64, f64, f64) {
    fn from(entry: LogEntry) -> Self {
        (entry.iteration, entry.best_cost, entry.seconds)
    }
}

/// How a run ended.
#[derive(Debug)]
pub struct DriveOutcome<X> {
    /// The iterate after the last step.
    pub x: X,
    /// The iterate of the smallest cost, where [`Drive::keep_best`] asked for it.
    pub best: Option<X>,
    /// Cost of the start.
    pub initial_cost: f64,
    /// Cost of [`DriveOutcome::x`].
    pub final_cost: f64,
    /// The smallest cost of all; below [`DriveOutcome::final_cost`] only if the engine is not monotone.
    pub best_cost: f64,
    /// The iteration that reached it.
    pub best_iteration: u64,
    /// Iterations made, those before a resumption among them.
    pub iterations: u64,
    /// Why it ended; [`Termination::Stalled`] where [`DriveOutcome::error`] says more.
    pub stop: Termination,
    /// Seconds from the engine's preparation to the last step, over all resumptions.
    pub seconds: f64,
    /// The start, every moment at which the best cost became smaller, and the end.
    pub log: Vec<LogEntry>,
    /// Why the engine could not go on, if it could not; the iterate is as the failed step left it.
    pub error: Option<SolveError>,
    /// The first checkpoint or trace that could not be written.
    pub file_error: Option<FileError>,
}

impl<X> DriveOutcome<X> {
    /// The outcome, or the error that it carries.
    ///
    /// # Errors
    /// [`DriveOutcome::error`] first, then [`DriveOutcome::file_error`].
    pub fn checked(mut self) -> Result<DriveOutcome<X>, DriveError> {
        if let Some(error) = self.error.take() {
            return Err(error.into());
        }
        match self.file_error.take() {
            Some(error) => Err(error.into()),
            None => Ok(self),
        }
    }

    /// The same without what only a driven run has.
    pub fn as_run(&self) -> RunOutcome {
        RunOutcome {
            initial_cost: self.initial_cost,
            final_cost: self.final_cost,
            iterations: self.iterations,
            stop: self.stop,
        }
    }

    /// One line for a person: iterations, time, costs, reason.
    pub fn brief(&self) -> String {
        let reason = match &self.error {
            Some(error) => error.to_string(),
            None => self.stop.explain().to_owned(),
        };
        let plural = if self.iterations == 1 { "" } else { "s" };
        format!(
            "{} iteration{plural} in {:.2} s, cost {:.6e} to {:.6e}: {reason}",
            self.iterations, self.seconds, self.initial_cost, self.final_cost
        )
    }
}

/// A run to be made: a problem, an engine, a start, and what is wanted around them.
///
/// The engine may be lent (`&mut engine`) to have it back, with its working memory, afterwards.
#[must_use = "nothing happens before `run`"]
pub struct Drive<'a, P: ?Sized, E: Engine<P>> {
    problem: &'a P,
    engine: E,
    x: E::Iterate,
    limits: Limits,
    keep_best: bool,
    fingerprint: u64,
    force: bool,
    trace: Option<PathBuf>,
    checkpoint: Option<(PathBuf, u64)>,
    resume_from: Option<PathBuf>,
    interrupt: Option<&'a AtomicBool>,
    observers: Vec<Box<dyn Observe<E::Iterate> + 'a>>,
}

impl<'a, P: ?Sized, E: Engine<P>> Drive<'a, P, E> {
    /// A run of `engine` on `problem` from `x`, without limits and unobserved.
    pub fn new(problem: &'a P, engine: E, x: E::Iterate) -> Self {
        Drive {
            problem,
            engine,
            x,
            limits: Limits::default(),
            keep_best: false,
            fingerprint: 0,
            force: false,
            trace: None,
            checkpoint: None,
            resume_from: None,
            interrupt: None,
            observers: Vec::new(),
        }
    }

    /// Ends it at these limits at the latest.
    pub fn limits(mut self, limits: Limits) -> Self {
        self.limits = limits;
        self
    }

    /// Ends it before the next step once the flag is raised, from wherever.
    pub fn interrupt(mut self, flag: &'a AtomicBool) -> Self {
        self.interrupt = Some(flag);
        self
    }

    /// Keeps a copy of the best iterate, for engines that are not monotone; costs a copy at every
    /// new best.
    pub fn keep_best(mut self) -> Self {
        self.keep_best = true;
        self
    }

    /// Lets somebody watch.
    pub fn observe(mut self, observer: impl Observe<E::Iterate> + 'a) -> Self {
        self.observers.push(Box::new(observer));
        self
    }

    /// Calls a closure after every step.
    pub fn on_step(self, call: impl FnMut(&Event<'_, E::Iterate>) + 'a) -> Self {
        self.observe(observe::EachStep(call))
    }

    /// Writes one row per iteration to a CSV file: `iteration, cost, best_cost, step_norm, accepted,
    /// seconds`, then the engine's metrics.
    ///
    /// The file appears whole when the run is over, however it ends. Until then the rows are in
    /// memory and in every checkpoint, so that a run that was killed and resumed traces all of it.
    pub fn trace(mut self, path: impl Into<PathBuf>) -> Self {
        self.trace = Some(path.into());
        self
    }

    /// Writes a checkpoint every so many iterations and one at the end; 0 for only that at the end.
    ///
    /// Each replaces the one before and appears whole or not at all.
    pub fn checkpoint(mut self, path: impl Into<PathBuf>, every: u64) -> Self {
        self.checkpoint = Some((path.into(), every));
        self
    }

    /// Goes on from a checkpoint; the iterate given to [`Drive::new`] is then not used.
    ///
    /// A run that had been ended by a limit or an interruption goes on; one that the engine itself
    /// had ended is over, and gives the same outcome again.
    pub fn resume_from(mut self, path: impl Into<PathBuf>) -> Self {
        self.resume_from = Some(path.into());
        self
    }

    /// Marks the problem and whatever settings decide the run, so that a checkpoint is not resumed
    /// on another one; see [`Fingerprint`].
    pub fn fingerprint(mut self, mark: u64) -> Self {
        self.fingerprint = mark;
        self
    }

    /// Replaces a trace or checkpoint that exists already. The checkpoint that the run is resumed
    /// from may be replaced without.
    pub fn force(mut self, force: bool) -> Self {
        self.force = force;
        self
    }

    /// Makes the run.
    ///
    /// # Errors
    /// Only before the first step, while there is nothing to lose: where an output path cannot be
    /// used, where the checkpoint to resume from cannot be read or belongs to another engine or
    /// problem, and where the engine cannot start. What goes wrong later is in the [`DriveOutcome`].
    pub fn run(mut self) -> Result<DriveOutcome<E::Iterate>, DriveError> {
        let began = Instant::now();
        let saver = self.check_outputs()?;
        let mut run = state::RunState::empty(began);
        run.engine = E::NAME;
        run.limits = self.limits;
        run.interrupt = self.interrupt;
        run.keep_best = self.keep_best;
        run.effects.get_mut().observers = self.observers;

        if let Some(path) = &self.resume_from {
            let (mut saved, memory) =
                checkpoint::load::<E::Iterate, E::State>(path, E::NAME, self.fingerprint)?;
            let cost = self.engine.resume(self.problem, &mut saved.iterate, memory)?;
            refuse_other_cost(path, saved.cost, cost)?;
            run.resume_at(saved);
            if self.checkpoint.as_ref().is_some_and(|(to, _)| to == path) {
                run.effects.get_mut().saved_at = Some(run.iterations);
            }
        } else {
            let cost = self.engine.start(self.problem, &mut self.x)?;
            run.start_at(self.x, cost);
        }
        if self.trace.is_some() && run.rows.is_none() {
            run.rows =
                Some(trace::Rows::start(run.iterations, run.cost, run.best_cost, run.seconds));
        }

        let (mut run, stop) = executor::execute(self.problem, self.engine, run, saver)?;

        let mut file_error = run.effects.get_mut().file_error.take();
        if let (Some(path), Some(rows)) = (&self.trace, &run.rows)
            && let Err(error) = rows.write(path, self.force)
        {
            file_error.get_or_insert(error);
        }
        let end = run.entry();
        if run.log.last().is_none_or(|last| last.iteration != end.iteration) {
            run.log.push(end);
        }
        let Some(x) = run.x else {
            return Err(DriveError::Incomplete("the run ended without an iterate".to_owned()));
        };
        Ok(DriveOutcome {
            x,
            best: run.best,
            initial_cost: run.initial_cost,
            final_cost: run.cost,
            best_cost: run.best_cost,
            best_iteration: run.best_iteration,
            iterations: run.iterations,
            stop,
            seconds: run.seconds,
            log: run.log,
            error: run.error,
            file_error,
        })
    }

    /// Refuses output paths that are taken before any work is done.
    fn check_outputs(&self) -> Result<Option<checkpoint::Saver>, DriveError> {
        if let Some(path) = &self.trace {
            output::check(path, self.force)?;
        }
        let Some((path, every)) = self.checkpoint.clone() else { return Ok(None) };
        if self.trace.as_ref() == Some(&path) {
            let path = path.display();
            return Err(DriveError::Argument(format!("trace and checkpoint are one path: {path}")));
        }
        let force = self.force || self.resume_from.as_ref() == Some(&path);
        output::check(&path, force)?;
        let (fingerprint, force) = (self.fingerprint, force.into());
        Ok(Some(checkpoint::Saver { path, every, fingerprint, force }))
    }
}

/// A second guard beside the fingerprint, which the caller may have left out: the problem must give
/// the cost that the checkpoint remembers, to what another machine's arithmetic may change.
fn refuse_other_cost(path: &Path, saved: f64, found: f64) -> Result<(), FileError> {
    let close = (saved - found).abs() <= 1e-6 * saved.abs().max(found.abs());
    if close || (saved.is_nan() && found.is_nan()) || saved == found {
        return Ok(());
    }
    let message = format!(
        "this checkpoint belongs to another problem: its cost is {saved:e}, here it would be {found:e}"
    );
    Err(FileError::malformed(path, None, message))
}
