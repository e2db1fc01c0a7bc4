//! One error for everything above the engines, joined from the modules' own.

use rowgram_optim::{drive::DriveError, engine::SolveError, output::FileError};

/// What kind of failure an [`Error`] is; decides the exit code of the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Something went wrong that is not the input's fault (exit code 1).
    Failure,
    /// The input, an option or an output path cannot be used as given (exit code 2).
    BadInput,
    /// It ended before the work was complete, or a quality gate failed (exit code 3).
    Incomplete,
}

impl Kind {
    /// The exit code of the program.
    pub fn exit_code(self) -> u8 {
        match self {
            Kind::Failure => 1,
            Kind::BadInput => 2,
            Kind::Incomplete => 3,
        }
    }
}

/// Any error of the library.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file could not be read, parsed or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// An optimisation could not be started or had to be abandoned.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// An error of one of the modules above this one, which says what kind it is of.
    #[error("{source}")]
    Module {
        /// What kind of failure it is.
        kind: Kind,
        /// The error of the module; [`Error::is`] asks for its type.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// An option or argument has an unusable value: what it is, and what was expected.
    #[error("{0}")]
    Argument(String),
    /// A stage has no input in this project: why. A run leaves such stages out.
    #[error("{0}")]
    NothingToDo(String),
    /// The work could not be completed.
    #[error("{0}")]
    Incomplete(String),
}

impl Error {
    /// The error of a module above this one.
    pub fn module(kind: Kind, source: impl std::error::Error + Send + Sync + 'static) -> Error {
        Error::Module { kind, source: Box::new(source) }
    }

    /// Whether it is this error of a module above this one.
    pub fn is<E: std::error::Error + 'static>(&self) -> bool {
        matches!(self, Error::Module { source, .. } if source.is::<E>())
    }

    /// What kind of failure this is.
    pub fn kind(&self) -> Kind {
        match self {
            Error::File(FileError::Write { .. }) | Error::Solve(_) => Kind::Failure,
            Error::File(_) | Error::Argument(_) | Error::NothingToDo(_) => Kind::BadInput,
            Error::Module { kind, .. } => *kind,
            Error::Incomplete(_) => Kind::Incomplete,
        }
    }
}

impl From<DriveError> for Error {
    fn from(error: DriveError) -> Error {
        match error {
            DriveError::File(error) => Error::File(error),
            DriveError::Solve(error) => Error::Solve(error),
            DriveError::Argument(message) => Error::Argument(message),
        }
    }
}
