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
use std::path::{Path, PathBuf};

/// Where a run is, as it is written and read back.
#[derive(Serialize, Deserialize)]
#[serde(bound(serialize = "X: Serialize", deserialize = "X: DeserializeOwned"))]
pub(super) struct Progress<X> {
    pub(super) iteration: u64,
    pub(super) initial_cost: f64,
    pub(super) cost: f64,
    pub(super) best_cost: f64,
    pub(super) best_iteration: u64,
    pub(super) seconds: f64,
    /// Why the engine wants no further step.
    pub(super) stop: Option<Termination>,
    pub(super) log: Vec<LogEntry>,
    /// The trace, where one is kept.
    pub(super) rows: Option<Rows>,
    pub(super) iterate: X,
}

impl<X> Progress<X> {
    /// The start at `iterate`.
    pub(super) fn start(iterate: X, cost: f64) -> Progress<X> {
        Progress {
            iteration: 0,
            initial_cost: cost,
            cost,
            best_cost: cost,
            best_iteration: 0,
            seconds: 0.0,
            stop: None,
            log: Vec::new(),
            rows: None,
            iterate,
        }
    }
}

/// Where, when and under which mark checkpoints are written.
pub(super) struct Saver {
    pub(super) path: PathBuf,
    /// Iterations between two; 0 writes only the one at the end.
    pub(super) every: u64,
    pub(super) fingerprint: u64,
    /// Whether what lies there may be replaced: from the second time on it is our own.
    pub(super) force: bool,
}

impl Saver {
    /// Writes a checkpoint if it is time for one.
    pub(super) fn save_if_due<P: ?Sized, E: Engine<P>>(
        &mut self,
        engine: &E,
        run: &mut RunState<'_, E::Iterate>,
    ) {
        if self.every > 0 && run.at.iteration.is_multiple_of(self.every) {
            self.save_now(engine, run);
        }
    }

    /// Writes a checkpoint of this moment, unless it is written already or a step has failed.
    ///
    /// A checkpoint that cannot be written ends no run: the first failure is kept for its end.
    pub(super) fn save_now<P: ?Sized, E: Engine<P>>(
        &mut self,
        engine: &E,
        run: &mut RunState<'_, E::Iterate>,
    ) {
        if run.error.is_some() || run.saved_at == Some(run.at.iteration) {
            return;
        }
        match self.write(engine, &run.at) {
            Ok(()) => {
                self.force = true;
                run.saved_at = Some(run.at.iteration);
            }
            Err(error) => {
                run.file_error.get_or_insert(error);
            }
        }
    }

    fn write<P: ?Sized, E: Engine<P>>(
        &self,
        engine: &E,
        at: &Progress<E::Iterate>,
    ) -> Result<(), FileError> {
        let mut body = Vec::new();
        ciborium::into_writer(&(at, engine.state()), &mut body)
            .map_err(|error| FileError::write(&self.path, std::io::Error::other(error)))?;
        let header = Header {
            engine: E::NAME.to_owned(),
            fingerprint: self.fingerprint,
            iteration: at.iteration,
        };
        container::write(&self.path, self.force, &header, &body)
    }
}

/// Reads the checkpoint of a run of `engine` on the problem with this `fingerprint`, and what the
/// engine remembered.
pub(super) fn load<X: DeserializeOwned, M: DeserializeOwned>(
    path: &Path,
    engine: &str,
    fingerprint: u64,
) -> Result<(Progress<X>, M), FileError> {
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
    match ciborium::from_reader::<(Progress<X>, M), _>(body.as_slice()) {
        Ok(content) if content.0.iteration == header.iteration => Ok(content),
        Ok((saved, _)) => refuse(format!(
            "the checkpoint contradicts itself: iteration {} or {}",
            header.iteration, saved.iteration
        )),
        Err(error) => refuse(format!("the checkpoint's content cannot be understood: {error}")),
    }
}
