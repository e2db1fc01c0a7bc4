//! Watching a run: what an observer is shown.
//!
//! An observer sees and never steers. To end a run from one, raise the flag that was given to
//! [`Drive::interrupt`](super::Drive::interrupt).

use super::Limits;
use crate::{
    engine::{Step, Termination},
    output::FileError,
};

/// Where a run stands.
#[derive(Debug)]
#[non_exhaustive]
pub struct Event<'e, X> {
    /// Name of the engine.
    pub engine: &'static str,
    /// How many iterations have been made, those before a resumption among them.
    pub iteration: u64,
    /// The iterate as it is now.
    pub x: &'e X,
    /// What the last step did; `None` before the first one.
    pub step: Option<&'e Step>,
    /// Cost of the iterate.
    pub cost: f64,
    /// Smallest cost so far.
    pub best_cost: f64,
    /// Seconds since the start, those before a resumption among them.
    pub seconds: f64,
    /// Iterations made since the start or the last resumption.
    pub iterations_here: u64,
    /// Seconds since the start or the last resumption.
    pub seconds_here: f64,
    /// What ends the run at the latest.
    pub limits: &'e Limits,
    /// The first checkpoint that could not be written.
    pub file_error: Option<&'e FileError>,
}

/// Somebody who watches a run over iterates of type `X`.
pub trait Observe<X> {
    /// The run begins or goes on from a checkpoint.
    fn start(&mut self, _event: &Event<'_, X>) {}
    /// A step was made.
    fn step(&mut self, _event: &Event<'_, X>) {}
    /// The run is over.
    fn end(&mut self, _event: &Event<'_, X>, _stop: Termination) {}
}

/// A closure that is called after every step.
pub(super) struct EachStep<F>(pub(super) F);

impl<X, F: FnMut(&Event<'_, X>)> Observe<X> for EachStep<F> {
    fn step(&mut self, event: &Event<'_, X>) {
        (self.0)(event);
    }
}
