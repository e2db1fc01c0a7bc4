//! What a run is at any moment: the iterate, the numbers about it, and the rules that end it.
//!
//! The iterate is moved in at the start, changed in place by the engine and moved out at the end.

use super::{Limits, LogEntry, checkpoint::Progress};
use crate::{
    engine::{Engine, SolveError, Step, Termination},
    output::FileError,
};
use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::Instant,
};

/// Where a run stands after a step.
///
/// Observers cannot change a run. To end it, they raise the flag that was given to
/// [`Drive::interrupt`](super::Drive::interrupt).
#[derive(Debug)]
#[non_exhaustive]
pub struct Event<'e, X> {
    /// How many iterations have been made, those before a resumption among them.
    pub iteration: u64,
    /// The iterate as it is now.
    pub x: &'e X,
    /// What the step did.
    pub step: &'e Step,
    /// Cost of the iterate.
    pub cost: f64,
    /// Smallest cost so far.
    pub best_cost: f64,
    /// Seconds since the start, those before a resumption among them.
    pub seconds: f64,
    /// The first checkpoint that could not be written.
    pub file_error: Option<&'e FileError>,
}

/// A closure that is called after every step.
pub(super) type Observer<'a, X> = Box<dyn FnMut(&Event<'_, X>) + 'a>;

/// A run in progress.
pub(super) struct RunState<'a, X> {
    pub(super) at: Progress<X>,
    /// Why the engine cannot make a step.
    pub(super) error: Option<SolveError>,
    earlier_seconds: f64,
    began: Instant,
    pub(super) limits: Limits,
    pub(super) interrupt: Option<&'a AtomicBool>,
    pub(super) observers: Vec<Observer<'a, X>>,
    /// The iteration of the last checkpoint.
    pub(super) saved_at: Option<u64>,
    /// The first file that could not be written.
    pub(super) file_error: Option<FileError>,
}

impl<X> RunState<'_, X> {
    /// A run that has come as far as `at`, without limits and unobserved.
    pub(super) fn new(began: Instant, at: Progress<X>) -> Self {
        let mut run = RunState {
            error: None,
            earlier_seconds: at.seconds,
            began,
            limits: Limits::default(),
            interrupt: None,
            observers: Vec::new(),
            saved_at: None,
            file_error: None,
            at,
        };
        run.at.seconds = run.clock();
        if run.at.log.is_empty() {
            run.at.log.push(run.entry());
        }
        run
    }

    fn clock(&self) -> f64 {
        self.earlier_seconds + self.began.elapsed().as_secs_f64()
    }

    /// Lets the engine make one step, in place, and shows it to all observers.
    pub(super) fn advance<P: ?Sized, E: Engine<P, Iterate = X>>(
        &mut self,
        engine: &mut E,
        problem: &P,
    ) {
        let outcome = engine.step(problem, &mut self.at.iterate);
        self.at.seconds = self.clock();
        let step = match outcome {
            Ok(step) => step,
            Err(error) => {
                self.error = Some(error);
                return;
            }
        };
        let at = &mut self.at;
        at.iteration += 1;
        at.cost = step.cost;
        at.stop = step.stop;
        if step.cost < at.best_cost {
            at.best_cost = step.cost;
            at.best_iteration = at.iteration;
            let entry = self.entry();
            self.at.log.push(entry);
        }
        let at = &mut self.at;
        if let Some(rows) = &mut at.rows {
            rows.push(at.iteration, &step, at.best_cost, at.seconds);
        }
        let event = Event {
            iteration: at.iteration,
            x: &at.iterate,
            step: &step,
            cost: at.cost,
            best_cost: at.best_cost,
            seconds: at.seconds,
            file_error: self.file_error.as_ref(),
        };
        for observer in &mut self.observers {
            observer(&event);
        }
    }

    /// The log entry of this moment.
    pub(super) fn entry(&self) -> LogEntry {
        let at = &self.at;
        LogEntry { iteration: at.iteration, best_cost: at.best_cost, seconds: at.seconds }
    }

    /// Why no further step is to be made, if so: the engine's word first, then the limits.
    pub(super) fn over(&self) -> Option<Termination> {
        let (at, limits) = (&self.at, &self.limits);
        if self.error.is_some() {
            Some(Termination::Stalled)
        } else if at.stop.is_some() {
            at.stop
        } else if limits.target_cost.is_some_and(|target| at.cost <= target) {
            Some(Termination::TargetCost)
        } else if at.iteration >= limits.max_iterations {
            Some(Termination::MaxIterations)
        } else if limits.max_time.is_some_and(|limit| at.seconds >= limit.as_secs_f64()) {
            Some(Termination::MaxTime)
        } else if self.interrupt.is_some_and(|flag| flag.load(Ordering::Relaxed)) {
            Some(Termination::Interrupted)
        } else {
            None
        }
    }
}
