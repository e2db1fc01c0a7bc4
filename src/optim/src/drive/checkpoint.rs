//! What a checkpoint holds: everything that decides the future of a run, and what the past told.
//!
//! The content is CBOR inside the container of [`crate::drive::container`]; the iterate and the
//! engine's memory are written by reference.

use super::{LogEntry, state::RunState, trace::Rows};
use crate::{
    drive::container::{self, Header},
    engine::{Engine, Termination},
    output::FileError,
};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::{
    cell::Cell,
    path::{Path, PathBuf},
};

/// A run as read back.
#[derive(Deserialize)]
#[serde(bound(deserialize = "X: DeserializeOwned"))]
pub(super) struct Saved<X> {
    pub(super) iteration: u64,
    pub(super) initial_cost: f64,
    pub(super) cost: f64,
    pub(super) best_cost: f64,
    pub(super) best_iteration: u64,
    pub(super) seconds: f64,
    pub(super) stop: Option<Termination>,
    pub(super) log: Vec<LogEntry>,
    pub(super) rows: Option<Rows>,
    pub(super) iterate: X,
    pub(super) best: Option<X>,
}

/// The same as written; the fields are those of [`Saved`].
#[derive(Serialize)]
struct Saving<'s, X> {
    iteration: u64,
    initial_cost: f64,
    cost: f64,
    best_cost: f64,
    best_iteration: u64,
    seconds: f64,
    stop: Option<Termination>,
    log: &'s [LogEntry],
    rows: Option<&'s Rows>,
    iterate: &'s X,
    best: Option<&'s X>,
}

/// Where, when and under which mark checkpoints are written.
pub(super) struct Saver {
    pub(super) path: PathBuf,
    /// Iterations between two; 0 writes only the one at the end.
    pub(super) every: u64,
    pub(super) fingerprint: u64,
    /// Whether what lies there may be replaced: from the second time on it is our own.
    pub(super) force: Cell<bool>,
}

impl Saver {
    /// Writes a checkpoint if it is time for one.
    pub(super) fn save_if_due<P: ?Sized, E: Engine<P>>(
        &self,
        engine: &E,
        run: &RunState<'_, E::Iterate>,
    ) {
        if self.every > 0 && run.iterations.is_multiple_of(self.every) {
            self.save_now(engine, run);
        }
    }

    /// Writes a checkpoint of this moment, unless it is written already or a step has failed.
    ///
    /// A checkpoint that cannot be written ends no run: the first failure is kept for its end.
    pub(super) fn save_now<P: ?Sized, E: Engine<P>>(
        &self,
        engine: &E,
        run: &RunState<'_, E::Iterate>,
    ) {
        let (Some(x), Ok(mut effects)) = (&run.x, run.effects.try_borrow_mut()) else { return };
        if run.error.is_some() || effects.saved_at == Some(run.iterations) {
            return;
        }
        match self.write(engine, run, x) {
            Ok(()) => {
                self.force.set(true);
                effects.saved_at = Some(run.iterations);
            }
            Err(error) => {
                effects.file_error.get_or_insert(error);
            }
        }
    }

    fn write<P: ?Sized, E: Engine<P>>(
        &self,
        engine: &E,
        run: &RunState<'_, E::Iterate>,
        x: &E::Iterate,
    ) -> Result<(), FileError> {
        let content = Saving {
            iteration: run.iterations,
            initial_cost: run.initial_cost,
            cost: run.cost,
            best_cost: run.best_cost,
            best_iteration: run.best_iteration,
            seconds: run.seconds,
            stop: run.stop,
            log: &run.log,
            rows: run.rows.as_ref(),
            iterate: x,
            best: run.best.as_ref(),
        };
        let mut body = Vec::new();
        ciborium::into_writer(&(content, engine.state()), &mut body)
            .map_err(|error| FileError::write(&self.path, std::io::Error::other(error)))?;
        let header = Header {
            engine: E::NAME.to_owned(),
            fingerprint: self.fingerprint,
            iteration: run.iterations,
        };
        container::write(&self.path, self.force.get(), &header, &body)
    }
}

/// Reads the checkpoint of a run of `engine` on the problem with this `fingerprint`, and what the
/// engine remembered.
pub(super) fn load<X: DeserializeOwned, M: DeserializeOwned>(
    path: &Path,
    engine: &str,
    fingerprint: u64,
) -> Result<(Saved<X>, M), FileError> {
    let refuse = |message: String| Err(FileError::malformed(path, None, message));
    let (header, body) = container::read(path)?;
    if header.engine != engine {
        return refuse(format!(
            "this checkpoint is of the engine {}, it cannot be resumed by {engine}",
            header.engine
        ));
    }
    if header.fingerprint != fingerprint {
        return refuse("this checkpoint belongs to another problem or other settings".to_owned());
    }
    match ciborium::from_reader::<(Saved<X>, M), _>(body.as_slice()) {
        Ok(content) if content.0.iteration == header.iteration => Ok(content),
        Ok((saved, _)) => refuse(format!(
            "the checkpoint contradicts itself: iteration {} or {}",
            header.iteration, saved.iteration
        )),
        Err(error) => refuse(format!("the checkpoint's content cannot be understood: {error}")),
    }
}
