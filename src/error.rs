//! One error for the whole library, joined from the modules' own.

use crate::{
    engine::SolveError, io, mapping::MapError, phenotype::locate::LocateError,
    problems::adjustment::AdjustError,
};

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
    File(#[from] io::FileError),
    /// An optimisation could not be started or had to be abandoned.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// Plants could not be located as asked.
    #[error(transparent)]
    Locate(#[from] LocateError),
    /// A block with control could not be adjusted.
    #[error(transparent)]
    Adjust(#[from] AdjustError),
    /// A map could not be made.
    #[error(transparent)]
    Map(#[from] MapError),
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
    /// What kind of failure this is.
    pub fn kind(&self) -> Kind {
        match self {
            Error::File(error) => error.kind(),
            Error::Solve(_) | Error::Locate(LocateError::Solve(_)) => Kind::Failure,
            // A block that its observations do not determine is as much an input's fault as a number
            // that is none.
            Error::Adjust(
                AdjustError::Invalid(_) | AdjustError::Solve(SolveError::RankDeficient(_)),
            )
            | Error::Locate(_) => Kind::BadInput,
            Error::Adjust(AdjustError::Solve(_)) => Kind::Failure,
            Error::Argument(_) | Error::NothingToDo(_) | Error::Map(_) => Kind::BadInput,
            Error::Incomplete(_) => Kind::Incomplete,
        }
    }
}
