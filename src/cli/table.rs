//! Tables that the verbs wrote, by the names of their columns.

use crate::{error::Error, io::FileError};
use std::path::Path;

/// A table of texts.
pub(super) struct Table {
    header: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// Reads a CSV file with a header.
    ///
    /// # Errors
    /// A file that cannot be read or is no table.
    pub(super) fn read(path: &Path) -> Result<Table, Error> {
        let malformed = |e: csv::Error| match e.into_kind() {
            csv::ErrorKind::Io(source) => FileError::read(path, source),
            other => FileError::malformed(path, None, format!("damaged table: {other:?}")),
        };
        let mut reader = csv::Reader::from_path(path).map_err(malformed)?;
        let words = |record: &csv::StringRecord| record.iter().map(str::to_owned).collect();
        let header = words(reader.headers().map_err(malformed)?);
        let rows = reader
            .records()
            .map(|record| record.map(|record| words(&record)))
            .collect::<Result<_, _>>()
            .map_err(malformed)?;
        Ok(Table { header, rows })
    }

    /// Number of rows.
    pub(super) fn len(&self) -> usize {
        self.rows.len()
    }

    /// The column of this name.
    pub(super) fn texts(&self, name: &str) -> Option<Vec<&str>> {
        let place = self.header.iter().position(|other| other == name)?;
        Some(self.rows.iter().map(|row| row[place].as_str()).collect())
    }

    /// The numbers of a column; NaN where there is none.
    pub(super) fn numbers(&self, name: &str) -> Option<Vec<f64>> {
        let texts = self.texts(name)?;
        Some(texts.into_iter().map(|text| text.trim().parse().unwrap_or(f64::NAN)).collect())
    }

    /// Pairs of numbers of two columns.
    pub(super) fn pairs(&self, first: &str, second: &str) -> Option<Vec<[f64; 2]>> {
        let (first, second) = (self.numbers(first)?, self.numbers(second)?);
        Some(first.into_iter().zip(second).map(|(a, b)| [a, b]).collect())
    }

    /// Header and rows as they are.
    pub(super) fn all(&self) -> (&[String], &[Vec<String>]) {
        (&self.header, &self.rows)
    }
}
