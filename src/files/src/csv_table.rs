//! CSV tables with a header, read by the names of their columns.

use super::FileError;
use std::path::Path;

/// A table of texts. All of them are one: tables of leaves have millions of cells.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CsvTable {
    header: Vec<String>,
    /// The texts of all cells, row by row.
    text: String,
    /// Where each ends.
    ends: Vec<usize>,
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
        let header = reader.headers().map_err(malformed)?;
        let header = header.iter().map(|name| name.trim().to_owned()).collect();
        let (mut text, mut ends) = (String::new(), Vec::new());
        let mut record = csv::StringRecord::new();
        while reader.read_record(&mut record).map_err(malformed)? {
            for cell in &record {
                text += cell;
                ends.push(text.len());
            }
        }
        Ok(CsvTable { header, text, ends })
    }

    /// Number of rows, without the header.
    pub fn len(&self) -> usize {
        self.ends.len() / self.header.len().max(1)
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    fn cell(&self, at: usize) -> &str {
        let start = at.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.text[start..self.ends[at]]
    }

    /// The names of the columns.
    pub fn header(&self) -> &[String] {
        &self.header
    }

    /// The cells of a row.
    pub fn row(&self, row: usize) -> impl Iterator<Item = &str> {
        let first = row * self.header.len();
        (first..first + self.header.len()).map(|at| self.cell(at))
    }

    fn column(&self, name: &str) -> Option<impl Iterator<Item = &str>> {
        let place = self.header.iter().position(|other| other == name)?;
        Some((place..self.ends.len()).step_by(self.header.len()).map(|at| self.cell(at)))
    }

    /// The column of this name; `None` where there is no such column.
    pub fn texts(&self, name: &str) -> Option<Vec<&str>> {
        Some(self.column(name)?.collect())
    }

    /// The numbers of a column, NaN where a cell has none; `None` where there is no such column.
    pub fn numbers(&self, name: &str) -> Option<Vec<f64>> {
        Some(self.column(name)?.map(|text| text.trim().parse().unwrap_or(f64::NAN)).collect())
    }

    /// Pairs of numbers of two columns; `None` where one of them is not there.
    pub fn pairs(&self, first: &str, second: &str) -> Option<Vec<[f64; 2]>> {
        let (first, second) = (self.numbers(first)?, self.numbers(second)?);
        Some(first.into_iter().zip(second).map(|(a, b)| [a, b]).collect())
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
        assert_eq!(table.texts("row").unwrap(), ["", "1"]);
        assert_eq!(table.row(1).collect::<Vec<_>>(), ["3", "4", "1"]);
        assert_eq!(table.header(), ["u_px", "v_px", "row"]);
        std::fs::write(&path, "u_px,v_px\n").unwrap();
        let empty = CsvTable::read(&path).unwrap();
        assert!(empty.is_empty() && empty.numbers("v_px").unwrap().is_empty());
        std::fs::write(&path, "u_px,v_px\n1,2,3\n").unwrap();
        assert!(CsvTable::read(&path).unwrap_err().to_string().contains("damaged table"));
    }
}
