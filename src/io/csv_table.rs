//! CSV tables with a header, read by the names of their columns.

use super::FileError;
use std::path::Path;

/// A table of texts, one list per row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CsvTable {
    header: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl CsvTable {
    /// Reads a CSV file with a header.
    ///
    /// # Errors
    /// A file that cannot be read or is no table.
    pub fn read(path: &Path) -> Result<CsvTable, FileError> {
        let malformed = |e: csv::Error| match e.into_kind() {
            csv::ErrorKind::Io(source) => FileError::read(path, source),
            other => FileError::malformed(path, None, format!("damaged table: {other:?}")),
        };
        let mut reader = csv::Reader::from_path(path).map_err(malformed)?;
        let words = |record: &csv::StringRecord| record.iter().map(str::to_owned).collect();
        let header = reader.headers().map_err(malformed)?;
        let header = header.iter().map(|name| name.trim().to_owned()).collect();
        let rows = reader
            .records()
            .map(|record| record.map(|record| words(&record)))
            .collect::<Result<_, _>>()
            .map_err(malformed)?;
        Ok(CsvTable { header, rows })
    }

    /// Number of rows, without the header.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The column of this name; `None` where there is no such column.
    pub fn texts(&self, name: &str) -> Option<Vec<&str>> {
        let place = self.header.iter().position(|other| other == name)?;
        Some(self.rows.iter().map(|row| row[place].as_str()).collect())
    }

    /// The numbers of a column, NaN where a cell has none; `None` where there is no such column.
    pub fn numbers(&self, name: &str) -> Option<Vec<f64>> {
        let texts = self.texts(name)?;
        Some(texts.into_iter().map(|text| text.trim().parse().unwrap_or(f64::NAN)).collect())
    }

    /// Pairs of numbers of two columns; `None` where one of them is not there.
    pub fn pairs(&self, first: &str, second: &str) -> Option<Vec<[f64; 2]>> {
        let (first, second) = (self.numbers(first)?, self.numbers(second)?);
        Some(first.into_iter().zip(second).map(|(a, b)| [a, b]).collect())
    }

    /// Header and rows as they are.
    pub fn all(&self) -> (&[String], &[Vec<String>]) {
        (&self.header, &self.rows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_found_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plants.csv");
        std::fs::write(&path, "u_px,v_px,row\n1.5,2,\n3,4,1\n").unwrap();
        let table = CsvTable::read(&path).unwrap();
        assert_eq!(table.len(), 2);
        assert_eq!(table.pairs("u_px", "v_px").unwrap(), [[1.5, 2.0], [3.0, 4.0]]);
        let rows = table.numbers("row").unwrap();
        assert!(rows[0].is_nan() && rows[1] == 1.0);
        assert_eq!(table.texts("nothing"), None);
        std::fs::write(&path, "u_px,v_px\n1,2,3\n").unwrap();
        assert!(CsvTable::read(&path).unwrap_err().to_string().contains("damaged table"));
    }
}
