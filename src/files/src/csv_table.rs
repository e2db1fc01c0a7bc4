//! CSV tables with a header, read by the names of their columns.

use super::{
    FileError,
    table::{Row, Table},
};
use std::path::Path;

/// A table of texts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CsvTable(Table);

impl CsvTable {
    /// Reads a CSV file with a header.
    ///
    /// # Errors
    /// A file that cannot be read or is no table.
    pub fn read(path: &Path) -> Result<CsvTable, FileError> {
        Table::with_header(path).map(CsvTable)
    }

    /// Number of rows, without the header.
    pub fn len(&self) -> usize {
        self.0.rows().len()
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The names of the columns.
    pub fn header(&self) -> &[String] {
        self.0.header()
    }

    /// The cells of a row.
    pub fn row(&self, row: usize) -> impl Iterator<Item = &str> {
        let row = &self.0.rows()[row];
        self.0.columns().map(|(_, column)| self.0.text(row, column))
    }

    fn column<T>(
        &self,
        name: &str,
        of: impl Fn(&Row, super::table::Column) -> T,
    ) -> Option<Vec<T>> {
        let (_, column) = self.0.columns().find(|(title, _)| *title == name)?;
        Some(self.0.rows().iter().map(|row| of(row, column)).collect())
    }

    /// The column of this name; `None` where there is no such column.
    pub fn texts(&self, name: &str) -> Option<Vec<&str>> {
        self.column(name, |row, column| self.0.text(row, column))
    }

    /// The numbers of a column, NaN where a cell has none; `None` where there is no such column.
    pub fn numbers(&self, name: &str) -> Option<Vec<f64>> {
        self.column(name, |row, column| self.0.parse(row, column).unwrap_or(f64::NAN))
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
        assert!(CsvTable::read(&path).unwrap_err().to_string().contains("expected 2 columns"));
    }
}
