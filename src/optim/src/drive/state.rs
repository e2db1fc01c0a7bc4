//! What a run is at any moment: the iterate, the numbers about it, and the rules that end it.
//!
//! The iterate is moved in at the start, changed in place by the engine and moved out at the end;
//! it is copied only where the best one was asked for and at checkpoints.

use super::{
    Limits, LogEntry,
    checkpoint::Saved,
    observe::{Event, Observe},
    trace::Rows,
};
use crate::{
    engine::{Engine, SolveError, Step, Termination},
    output::FileError,
};
use std::{
    cell::RefCell,
    sync::atomic::{AtomicBool, Ordering},
    time::Instant,
};

/// A run in progress.
pub(super) struct RunState<'a, X> {
    pub(super) engine: &'static str,
    /// `None` only in the moment before the run is configured.
    pub(super) x: Option<X>,
    /// The best iterate, where it was asked for.
    pub(super) best: Option<X>,
    pub(super) keep_best: bool,
    pub(super) initial_cost: f64,
    pub(super) cost: f64,
    pub(super) best_cost: f64,
    pub(super) best_iteration: u64,
    pub(super) iterations: u64,
    /// Iterations that had been made when this run was resumed, 0 if it was not.
    pub(super) resumed_at: u64,
    pub(super) last: Option<Step>,
    /// Why the engine wants no further step.
    pub(super) stop: Option<Termination>,
    /// Why the engine cannot make one.
    pub(super) error: Option<SolveError>,
    pub(super) log: Vec<LogEntry>,
    /// The trace, where one is kept.
    pub(super) rows: Option<Rows>,
    pub(super) seconds: f64,
    earlier_seconds: f64,
    began: Instant,
    pub(super) limits: Limits,
    pub(super) interrupt: Option<&'a AtomicBool>,
    pub(super) effects: RefCell<SideEffects<'a, X>>,
}

/// What changes while the run is only looked at.
pub(super) struct SideEffects<'a, X> {
    pub(super) observers: Vec<Box<dyn Observe<X> + 'a>>,
    /// The iteration of the last checkpoint.
    pub(super) saved_at: Option<u64>,
    /// The first file that could not be written.
    pub(super) file_error: Option<FileError>,
}

impl<X> RunState<'_, X> {
    /// A run of nothing, to be filled.
    pub(super) fn empty(began: Instant) -> Self {
        RunState {
            engine: "",
            x: None,
            best: None,
            keep_best: false,
            initial_cost: f64::NAN,
            cost: f64::NAN,
            best_cost: f64::INFINITY,
            best_iteration: 0,
            iterations: 0,
            resumed_at: 0,
            last: None,
            stop: None,
            error: None,
            log: Vec::new(),
            rows: None,
            seconds: 0.0,
            earlier_seconds: 0.0,
            began,
            limits: Limits::default(),
            interrupt: None,
            effects: RefCell::new(SideEffects {
                observers: Vec::new(),
                saved_at: None,
                file_error: None,
            }),
        }
    }

    /// Takes its place at the start.
    pub(super) fn start_at(&mut self, x: X, cost: f64)
    where
        X: Clone,
    {
        self.best = self.keep_best.then(|| x.clone());
        self.x = Some(x);
        (self.initial_cost, self.cost, self.best_cost) = (cost, cost, cost);
        self.seconds = self.clock();
        self.log = vec![LogEntry { iteration: 0, best_cost: cost, seconds: self.seconds }];
    }

    /// Takes its place where a checkpoint left off.
    pub(super) fn resume_at(&mut self, saved: Saved<X>)
    where
        X: Clone,
    {
        if self.keep_best {
            let at_best = saved.best_iteration == saved.iteration;
            self.best = saved.best.or_else(|| at_best.then(|| saved.iterate.clone()));
        }
        self.x = Some(saved.iterate);
        (self.initial_cost, self.cost) = (saved.initial_cost, saved.cost);
        (self.best_cost, self.best_iteration) = (saved.best_cost, saved.best_iteration);
        (self.iterations, self.resumed_at) = (saved.iteration, saved.iteration);
        (self.log, self.rows, self.stop) = (saved.log, saved.rows, saved.stop);
        self.earlier_seconds = saved.seconds;
        self.seconds = self.clock();
    }

    fn clock(&self) -> f64 {
        self.earlier_seconds + self.began.elapsed().as_secs_f64()
    }

    /// Lets the engine make one step, in place.
    pub(super) fn advance<P: ?Sized, E: Engine<P, Iterate = X>>(
        &mut self,
        engine: &mut E,
        problem: &P,
    ) where
        X: Clone,
    {
        let Some(x) = self.x.as_mut() else {
            self.error = Some(SolveError::Misuse("there is no iterate to move".to_owned()));
            return;
        };
        let step = match engine.step(problem, x) {
            Ok(step) => step,
            Err(error) => {
                self.error = Some(error);
                self.seconds = self.clock();
                return;
            }
        };
        self.seconds = self.clock();
        self.iterations += 1;
        self.cost = step.cost;
        self.stop = step.stop;
        if step.cost < self.best_cost {
            self.best_cost = step.cost;
            self.best_iteration = self.iterations;
            self.log.push(self.entry());
            if self.keep_best {
                self.best.clone_from(&self.x);
            }
        }
        if let Some(rows) = &mut self.rows {
            rows.push(self.iterations, &step, self.best_cost, self.seconds);
        }
        self.last = Some(step);
    }

    /// The log entry of this moment.
    pub(super) fn entry(&self) -> LogEntry {
        LogEntry { iteration: self.iterations, best_cost: self.best_cost, seconds: self.seconds }
    }

    /// Why no further step is to be made, if so: the engine's word first, then the limits.
    pub(super) fn over(&self) -> Option<Termination> {
        let limits = &self.limits;
        if self.error.is_some() {
            Some(Termination::Stalled)
        } else if self.stop.is_some() {
            self.stop
        } else if limits.target_cost.is_some_and(|target| self.cost <= target) {
            Some(Termination::TargetCost)
        } else if self.iterations >= limits.max_iterations {
            Some(Termination::MaxIterations)
        } else if limits.max_time.is_some_and(|limit| self.seconds >= limit.as_secs_f64()) {
            Some(Termination::MaxTime)
        } else if self.interrupt.is_some_and(|flag| flag.load(Ordering::Relaxed)) {
            Some(Termination::Interrupted)
        } else {
            None
        }
    }

    /// Shows this moment to all observers.
    pub(super) fn show(&self, mut to: impl FnMut(&mut dyn Observe<X>, &Event<'_, X>)) {
        let (Some(x), Ok(mut effects)) = (&self.x, self.effects.try_borrow_mut()) else { return };
        let SideEffects { observers, file_error, .. } = &mut *effects;
        let event = Event {
            engine: self.engine,
            iteration: self.iterations,
            x,
            step: self.last.as_ref(),
            cost: self.cost,
            best_cost: self.best_cost,
            seconds: self.seconds,
            iterations_here: self.iterations - self.resumed_at,
            seconds_here: self.seconds - self.earlier_seconds,
            limits: &self.limits,
            file_error: file_error.as_ref(),
        };
        for observer in observers {
            to(observer.as_mut(), &event);
        }
    }
}
