//! The only file that knows argmin: any engine as an argmin `Solver` over our own `State`.
//!
//! One argmin iteration is one [`Engine::step`]. argmin counts the steps since the start or the
//! last resumption; the numbers people see are [`RunState`]'s own. Nothing here ever answers argmin
//! with an `Err`, because argmin would drop the iterate with it: an engine's error is put into the
//! state and ends the run as a termination reason.

use super::{DriveError, checkpoint::Saver, state::RunState};
use crate::engine::{Engine, Termination};
use argmin::core::{
    Executor, KV, Problem, Solver, State, TerminationReason, TerminationStatus,
    checkpointing::{Checkpoint, CheckpointingFrequency},
    observers::{Observe, ObserverMode},
};
use std::{
    collections::HashMap,
    marker::PhantomData,
    rc::Rc,
    time::{Duration, Instant},
};

type Answer<T> = Result<T, argmin::core::Error>;

/// Runs the engine until it or a limit ends the run; gives everything back, and why it ended.
pub(super) fn execute<'a, P: ?Sized, E: Engine<P>>(
    problem: &'a P,
    engine: E,
    run: RunState<'a, E::Iterate>,
    saver: Option<Saver>,
) -> Result<(RunState<'a, E::Iterate>, Termination), DriveError> {
    let watched = run.effects.try_borrow().is_ok_and(|effects| !effects.observers.is_empty());
    let driver = Driver { engine, problem: PhantomData::<fn(&P)> };
    let mut executor = Executor::new(problem, driver)
        .configure(|_: Owned<'a, E::Iterate>| Owned::of(run))
        .ctrlc(false);
    if watched {
        executor = executor.add_observer(Relay, ObserverMode::Always);
    }
    let saver = saver.map(Rc::new);
    if let Some(saver) = &saver {
        executor = executor.checkpointing(Rc::clone(saver));
    }
    let end = executor
        .run()
        .map_err(|error| DriveError::Incomplete(format!("the run broke off: {error}")))?;
    if let Some(saver) = saver {
        saver.save_now(&end.solver.engine, &end.state.0.run);
    }
    let stop = end.state.stopped();
    Ok((end.state.0.run, stop))
}

/// The state argmin hands about: one pointer, so that handing it about costs nothing.
struct Owned<'a, X>(Box<Inside<'a, X>>);

struct Inside<'a, X> {
    run: RunState<'a, X>,
    status: TerminationStatus,
    /// argmin asks for a table of evaluations; engines tell theirs in their metrics.
    counts: HashMap<String, u64>,
}

impl<'a, X> Owned<'a, X> {
    fn of(run: RunState<'a, X>) -> Self {
        Owned(Box::new(Inside {
            run,
            status: TerminationStatus::NotTerminated,
            counts: HashMap::new(),
        }))
    }

    /// Why the run is over, in our words.
    fn stopped(&self) -> Termination {
        match self.get_termination_reason() {
            Some(TerminationReason::MaxItersReached) => Termination::MaxIterations,
            Some(TerminationReason::TargetCostReached) => Termination::TargetCost,
            Some(TerminationReason::Timeout) => Termination::MaxTime,
            Some(TerminationReason::Interrupt) => Termination::Interrupted,
            _ => self.0.run.stop.unwrap_or(Termination::Stalled),
        }
    }
}

/// The same in argmin's words.
fn reason(stop: Termination) -> TerminationReason {
    match stop {
        Termination::MaxIterations => TerminationReason::MaxItersReached,
        Termination::TargetCost => TerminationReason::TargetCostReached,
        Termination::MaxTime => TerminationReason::Timeout,
        Termination::Interrupted => TerminationReason::Interrupt,
        Termination::CostConverged
        | Termination::GradientConverged
        | Termination::StepConverged => TerminationReason::SolverConverged,
        Termination::Stalled => TerminationReason::SolverExit(stop.explain().to_owned()),
    }
}

impl<X> State for Owned<'_, X> {
    type Param = X;
    type Float = f64;

    fn new() -> Self {
        Owned::of(RunState::empty(Instant::now()))
    }

    fn update(&mut self) {}

    fn get_param(&self) -> Option<&X> {
        self.0.run.x.as_ref()
    }

    fn get_best_param(&self) -> Option<&X> {
        self.0.run.best.as_ref()
    }

    fn get_max_iters(&self) -> u64 {
        self.0.run.limits.max_iterations.saturating_sub(self.0.run.resumed_at)
    }

    /// The step itself has counted.
    fn increment_iter(&mut self) {}

    fn get_iter(&self) -> u64 {
        self.0.run.iterations - self.0.run.resumed_at
    }

    fn get_cost(&self) -> f64 {
        self.0.run.cost
    }

    fn get_best_cost(&self) -> f64 {
        self.0.run.best_cost
    }

    /// The target is ours to judge, by the cost of the iterate that is returned, not by the best.
    fn get_target_cost(&self) -> f64 {
        f64::NEG_INFINITY
    }

    fn func_counts<O>(&mut self, _problem: &Problem<O>) {}

    fn get_func_counts(&self) -> &HashMap<String, u64> {
        &self.0.counts
    }

    fn time(&mut self, _time: Option<Duration>) -> &mut Self {
        self
    }

    fn get_time(&self) -> Option<Duration> {
        Duration::try_from_secs_f64(self.0.run.seconds).ok()
    }

    fn get_last_best_iter(&self) -> u64 {
        self.0.run.best_iteration.saturating_sub(self.0.run.resumed_at)
    }

    fn is_best(&self) -> bool {
        self.0.run.best_iteration == self.0.run.iterations
    }

    fn terminate_with(mut self, reason: TerminationReason) -> Self {
        self.0.status = TerminationStatus::Terminated(reason);
        self
    }

    fn get_termination_status(&self) -> &TerminationStatus {
        &self.0.status
    }

    fn get_termination_reason(&self) -> Option<&TerminationReason> {
        match &self.0.status {
            TerminationStatus::Terminated(reason) => Some(reason),
            TerminationStatus::NotTerminated => None,
        }
    }
}

struct Driver<P: ?Sized, E> {
    engine: E,
    problem: PhantomData<fn(&P)>,
}

impl<'a, P: ?Sized, E: Engine<P>> Solver<&'a P, Owned<'a, E::Iterate>> for Driver<P, E> {
    fn name(&self) -> &str {
        E::NAME
    }

    fn next_iter(
        &mut self,
        problem: &mut Problem<&'a P>,
        mut state: Owned<'a, E::Iterate>,
    ) -> Answer<(Owned<'a, E::Iterate>, Option<KV>)> {
        if let Some(problem) = problem.problem {
            state.0.run.advance(&mut self.engine, problem);
        }
        Ok((state, None))
    }

    fn terminate(&mut self, state: &Owned<'a, E::Iterate>) -> TerminationStatus {
        match state.0.run.over() {
            Some(stop) => TerminationStatus::Terminated(reason(stop)),
            None => TerminationStatus::NotTerminated,
        }
    }
}

/// Passes argmin's calls on to the observers that the state carries. argmin wants observers that
/// borrow nothing; those in the state may.
struct Relay;

impl<X> Observe<Owned<'_, X>> for Relay {
    fn observe_init(&mut self, _name: &str, state: &Owned<'_, X>, _kv: &KV) -> Answer<()> {
        state.0.run.show(|observer, event| observer.start(event));
        Ok(())
    }

    fn observe_iter(&mut self, state: &Owned<'_, X>, _kv: &KV) -> Answer<()> {
        if state.0.run.error.is_none() {
            state.0.run.show(|observer, event| observer.step(event));
        }
        Ok(())
    }

    fn observe_final(&mut self, state: &Owned<'_, X>) -> Answer<()> {
        let stop = state.stopped();
        state.0.run.show(|observer, event| observer.end(event, stop));
        Ok(())
    }
}

impl<'a, P: ?Sized, E: Engine<P>> Checkpoint<Driver<P, E>, Owned<'a, E::Iterate>> for Rc<Saver> {
    fn save(&self, driver: &Driver<P, E>, state: &Owned<'a, E::Iterate>) -> Answer<()> {
        self.save_now(&driver.engine, &state.0.run);
        Ok(())
    }

    /// Counts iterations from the very start, so that a resumed run writes at the same ones.
    fn save_cond(
        &self,
        driver: &Driver<P, E>,
        state: &Owned<'a, E::Iterate>,
        _iterations_here: u64,
    ) -> Answer<()> {
        self.save_if_due(&driver.engine, &state.0.run);
        Ok(())
    }

    /// Resuming happens before argmin is asked, where a refusal keeps its type.
    fn load(&self) -> Answer<Option<(Driver<P, E>, Owned<'a, E::Iterate>)>> {
        Ok(None)
    }

    fn frequency(&self) -> CheckpointingFrequency {
        match self.every {
            0 => CheckpointingFrequency::Never,
            every => CheckpointingFrequency::Every(every),
        }
    }
}
