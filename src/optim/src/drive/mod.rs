//! Runs any [`Engine`]: limits, observers, a trace, checkpoints and resumption.
//!
//! The engines compute and know nothing of clocks, files or terminals; this is where those are.
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
mod state;
mod trace;

pub use crate::drive::container::Fingerprint;
pub use state::Event;

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
    fingerprint: u64,
    force: bool,
    trace: Option<PathBuf>,
    checkpoint: Option<(PathBuf, u64)>,
    resume_from: Option<PathBuf>,
    interrupt: Option<&'a AtomicBool>,
    observers: Vec<state::Observer<'a, E::Iterate>>,
}

impl<'a, P: ?Sized, E: Engine<P>> Drive<'a, P, E> {
    /// A run of `engine` on `problem` from `x`, without limits and unobserved.
    pub fn new(problem: &'a P, engine: E, x: E::Iterate) -> Self {
        Drive {
            problem,
            engine,
            x,
            limits: Limits::default(),
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

    /// Calls a closure after every step.
    pub fn on_step(mut self, call: impl FnMut(&Event<'_, E::Iterate>) + 'a) -> Self {
        self.observers.push(Box::new(call));
        self
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
        let mut saver = self.check_outputs()?;
        let at = if let Some(path) = &self.resume_from {
            let (mut saved, memory) =
                checkpoint::load::<E::Iterate, E::State>(path, E::NAME, self.fingerprint)?;
            let cost = self.engine.resume(self.problem, &mut saved.iterate, memory)?;
            refuse_other_cost(path, saved.cost, cost)?;
            saved
        } else {
            let cost = self.engine.start(self.problem, &mut self.x)?;
            checkpoint::Progress::start(self.x, cost)
        };
        let mut run = state::RunState::new(began, at);
        run.limits = self.limits;
        run.interrupt = self.interrupt;
        run.observers = self.observers;
        if self.checkpoint.as_ref().is_some_and(|(to, _)| self.resume_from.as_ref() == Some(to)) {
            run.saved_at = Some(run.at.iteration);
        }
        if self.trace.is_some() {
            let at = &mut run.at;
            at.rows.get_or_insert_with(|| {
                trace::Rows::start(at.iteration, at.cost, at.best_cost, at.seconds)
            });
        }

        let stop = loop {
            if let Some(stop) = run.over() {
                break stop;
            }
            run.advance(&mut self.engine, self.problem);
            if let Some(saver) = &mut saver {
                saver.save_if_due(&self.engine, &mut run);
            }
        };
        if let Some(saver) = &mut saver {
            saver.save_now(&self.engine, &mut run);
        }

        let end = run.entry();
        let (mut at, mut file_error) = (run.at, run.file_error);
        if let (Some(path), Some(rows)) = (&self.trace, &at.rows)
            && let Err(error) = rows.write(path, self.force)
        {
            file_error.get_or_insert(error);
        }
        if at.log.last().is_none_or(|last| last.iteration != end.iteration) {
            at.log.push(end);
        }
        Ok(DriveOutcome {
            x: at.iterate,
            initial_cost: at.initial_cost,
            final_cost: at.cost,
            best_cost: at.best_cost,
            best_iteration: at.best_iteration,
            iterations: at.iteration,
            stop,
            seconds: at.seconds,
            log: at.log,
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
        Ok(Some(checkpoint::Saver { path, every, fingerprint: self.fingerprint, force }))
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
