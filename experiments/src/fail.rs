//! Why a command ends badly, and with which exit code.

use rowgram::io::{FileError, output};
use serde::Serialize;
use std::path::Path;

/// What went wrong.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Fail {
    /// What was asked for cannot be done as it was asked.
    #[error("{0}")]
    Input(String),
    /// It was begun and did not work.
    #[error("{0}")]
    Failed(String),
    /// Something is missing or does not hold.
    #[error("{0}")]
    Incomplete(String),
    /// Reported by the library.
    #[error(transparent)]
    Library(#[from] rowgram::Error),
}

impl Fail {
    /// 1 failure, 2 bad input, 3 incomplete or a check that failed.
    pub(crate) fn exit_code(&self) -> u8 {
        match self {
            Fail::Failed(_) => 1,
            Fail::Input(_) => 2,
            Fail::Incomplete(_) => 3,
            Fail::Library(error) => error.kind().exit_code(),
        }
    }

    /// A file that cannot be read or written.
    pub(crate) fn io(path: &Path, error: &std::io::Error) -> Fail {
        Fail::Failed(format!("{}: {error}", path.display()))
    }
}

impl From<FileError> for Fail {
    fn from(error: FileError) -> Fail {
        Fail::Library(error.into())
    }
}

/// Makes a folder for results.
pub(crate) fn make(folder: &Path) -> Result<(), FileError> {
    std::fs::create_dir_all(folder).map_err(|error| FileError::write(folder, error))
}

/// Writes the rows of a table; those of a struct under the names of its fields.
pub(crate) fn write_csv<T: Serialize>(path: &Path, rows: &[T]) -> Result<(), FileError> {
    output::write(path, true, |out| {
        let mut writer = csv::Writer::from_writer(out);
        rows.iter().try_for_each(|row| writer.serialize(row))?;
        writer.flush()
    })
}
