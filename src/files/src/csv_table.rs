//! CSV tables with a header, read by the names of their columns.
//!
//! Names of plots and photos are data. One that a spreadsheet would take for a formula, because it begins with `=`, `+`, `-`, `@`,
//! a tab or a carriage return and is no number, is written with an apostrophe in front, as spreadsheets mark text; readers take it
//! away again ([`as_cell`], [`of_cell`]).

use super::{
    FileError,
    table::{Row, Table},
};
use std::{borrow::Cow, io::Write, path::Path};

/// Writes rows of a table, each cell by [`as_cell`].
pub struct CsvWriter<W: Write>(csv::Writer<W>);

impl<W: Write> CsvWriter<W> {
    /// Writes to `out`.
    pub fn new(out: W) -> CsvWriter<W> {
        CsvWriter(csv::Writer::from_writer(out))
    }

    /// Writes a row.
    ///
    /// # Errors
    /// Where it cannot be written; rows of different lengths.
    pub fn write_record<T: AsRef<str>>(
        &mut self,
        cells: impl IntoIterator<Item = T>,
    ) -> std::io::Result<()> {
        for cell in cells {
            self.0.write_field(&*as_cell(cell.as_ref()))?;
        }
        Ok(self.0.write_record(None::<&[u8]>)?)
    }

    /// Writes what is still in memory.
    ///
    /// # Errors
    /// Where it cannot be written.
    pub fn flush(&mut self) -> std::io::Result<()> {
        self.0.flush()
    }
}

/// Whether a text begins like a formula, apostrophes aside.
fn is_like_formula(text: &str) -> bool {
    let text = text.trim_start_matches('\'');
    text.starts_with(['=', '+', '-', '@', '\t', '\r']) && text.parse::<f64>().is_err()
}

/// A text as it is written into a cell.
pub fn as_cell(text: &str) -> Cow<'_, str> {
    if is_like_formula(text) { Cow::Owned(format!("'{text}")) } else { Cow::Borrowed(text) }
}

/// As [`as_cell`], in quotes where it needs them: for rows that are written without [`CsvWriter`].
pub(super) fn quoted(text: &str) -> Cow<'_, str> {
    let cell = as_cell(text);
    if cell.contains([',', '"', '\n', '\r', ';', '\t']) || cell.trim() != cell {
        Cow::Owned(format!("\"{}\"", cell.replace('"', "\"\"")))
    } else {
        cell
    }
}

/// The text of a cell.
pub fn of_cell(cell: &str) -> &str {
    cell.strip_prefix('\'').filter(|text| is_like_formula(text)).unwrap_or(cell)
}

/// A table of texts.
#[derive(Debug, Clone, PartialEq)]
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
        let exact = self.0.columns().find(|(title, _)| *title == name);
        let like = || self.0.columns().find(|(title, _)| title.eq_ignore_ascii_case(name));
        let (_, column) = exact.or_else(like)?;
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
    fn what_looks_like_a_formula_is_text_and_comes_back() {
        let names = [
            "=HYPERLINK(\"http://x\")",
            "+1 north",
            "-a",
            "@b",
            "\tc",
            "\rd",
            "'=e",
            "''=f",
            "'g",
            "'",
            "",
            "-1",
            "+2.5e3",
            "a,b",
            "a\"b",
            "a\nb",
            "--",
            "-inf",
            "Köln",
        ];
        for name in names {
            let cell = as_cell(name);
            assert_eq!(of_cell(&cell), name);
            let is_number = cell.parse::<f64>().is_ok();
            assert!(is_number || !cell.starts_with(['=', '+', '-', '@', '\t', '\r']), "{cell:?}");
        }
        assert_eq!(as_cell("=1+1"), "'=1+1");
        assert_eq!([as_cell("-1"), as_cell("'g")], ["-1", "'g"]);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plots.csv");
        let mut out = Vec::new();
        let mut csv = CsvWriter::new(&mut out);
        csv.write_record(["plot", "=genotype"]).unwrap();
        names.iter().for_each(|name| csv.write_record([*name, "x"]).unwrap());
        csv.flush().unwrap();
        drop(csv);
        std::fs::write(&path, out).unwrap();
        let table = CsvTable::read(&path).unwrap();
        assert_eq!(table.header(), ["plot", "=genotype"]);
        assert_eq!(table.texts("plot").unwrap(), names);
    }

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
