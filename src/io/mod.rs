//! Files, one format per module; the only part of the library that opens any.

pub mod bal;
pub mod bundler;
pub mod camera;
pub mod checkpoint;
pub mod cloud;
pub mod cloud_points;
pub mod colmap;
pub mod control;
pub mod corners;
pub mod csv_table;
pub mod features;
pub mod field_design;
pub mod gcp_list;
pub mod geoparquet;
pub mod geotiff;
pub mod gpkg;
pub mod images;
pub mod labels;
pub mod leaf_counts;
pub mod leaves;
pub mod model;
pub mod opensfm;
pub mod orientation;
pub mod orthority;
pub mod output;
pub mod photo;
pub mod plants;
pub mod points;
pub mod polygons;
pub mod poses;
pub mod qgis;
pub mod rasters;
pub mod reconstruction;
mod table;

use crate::error::Kind;
use std::path::{Path, PathBuf};

/// What is wrong with a file: which one, where in it, what was expected.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FileError {
    /// The file cannot be opened or read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file cannot be created or written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The output is already there and `--force` was not given.
    #[error("{} exists already; give --force to replace it, or another path", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The output path cannot be used as given.
    #[error("cannot write {}: {message}", path.display())]
    Unusable {
        /// The path.
        path: PathBuf,
        /// Why.
        message: &'static str,
    },
    /// The content is not what the format asks for.
    #[error("{}{}: {message}", path.display(), line.map(|n| format!(", line {n}")).unwrap_or_default())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// One-based line, for text formats.
        line: Option<usize>,
        /// What is wrong and what was expected.
        message: String,
    },
}

impl FileError {
    /// Shorthand for [`FileError::Read`].
    pub fn read(path: &Path, source: std::io::Error) -> FileError {
        FileError::Read { path: path.to_owned(), source }
    }

    /// Shorthand for [`FileError::Write`].
    pub fn write(path: &Path, source: std::io::Error) -> FileError {
        FileError::Write { path: path.to_owned(), source }
    }

    /// Shorthand for [`FileError::Malformed`]; `line` is one-based.
    pub fn malformed(
        path: &Path,
        line: impl Into<Option<usize>>,
        message: impl Into<String>,
    ) -> FileError {
        FileError::Malformed { path: path.to_owned(), line: line.into(), message: message.into() }
    }

    /// What kind of failure this is.
    pub fn kind(&self) -> Kind {
        match self {
            FileError::Write { .. } => Kind::Failure,
            FileError::Read { .. }
            | FileError::Exists { .. }
            | FileError::Unusable { .. }
            | FileError::Malformed { .. } => Kind::BadInput,
        }
    }
}
