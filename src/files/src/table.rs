//! CSV files with a header, read by the names of their columns.
//!
//! A byte order mark, CRLF line ends, blank lines, and comma, semicolon or tab as separator are
//! accepted.

use super::FileError;
use std::path::{Path, PathBuf};

/// A file with a header and rows of as many fields.
#[derive(Debug)]
pub(super) struct Table {
    path: PathBuf,
    header: Vec<String>,
    rows: Vec<Row>,
}

/// One row.
#[derive(Debug)]
pub(super) struct Row {
    pub(super) line: usize,
    fields: Vec<String>,
}

/// A column that was found.
#[derive(Debug, Clone, Copy)]
pub(super) struct Column(usize);

impl Table {
    pub(super) fn read(path: &Path) -> Result<Table, FileError> {
        let bytes = std::fs::read(path).map_err(|e| FileError::read(path, e))?;
        let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(&bytes);
        let text =
            std::str::from_utf8(bytes).map_err(|_| FileError::malformed(path, None, "not text"))?;
        let first = text.lines().find(|line| !line.trim().is_empty()).unwrap_or_default();
        let most = |a: &char, b: &char| first.matches(*a).count().cmp(&first.matches(*b).count());
        // The earlier of equals: a single column has none of them.
        let separator = ['\t', ';', ','].into_iter().max_by(most).unwrap_or(',');
        let mut reader = csv::ReaderBuilder::new()
            .has_headers(false)
            .flexible(true)
            .delimiter(separator as u8)
            .trim(csv::Trim::All)
            .from_reader(text.as_bytes());
        let mut table = Table { path: path.to_owned(), header: Vec::new(), rows: Vec::new() };
        let (mut counted, mut newlines) = (0, 0);
        for record in reader.records() {
            let record = record.map_err(|e| FileError::malformed(path, None, e.to_string()))?;
            let at = record.position().map_or(counted, |position| position.byte() as usize);
            let skipped = text[at..].chars().take_while(|c| c.is_whitespace());
            let blank = skipped.filter(|&c| c == '\n').count();
            newlines += text[counted..at].matches('\n').count();
            counted = at;
            let line = newlines + blank + 1;
            let fields: Vec<String> = record.iter().map(str::to_owned).collect();
            if fields.iter().all(String::is_empty) {
                continue;
            }
            if table.header.is_empty() {
                table.header = fields;
            } else if fields.len() == table.header.len() {
                table.rows.push(Row { line, fields });
            } else {
                let message = format!(
                    "expected {} columns as in the header, found {}",
                    table.header.len(),
                    fields.len()
                );
                return Err(FileError::malformed(path, line, message));
            }
        }
        if table.header.is_empty() {
            return Err(FileError::malformed(path, None, "the file is empty, expected a header"));
        }
        Ok(table)
    }

    pub(super) fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// All columns with their names, in their order.
    pub(super) fn columns(&self) -> impl Iterator<Item = (&str, Column)> {
        self.header.iter().enumerate().map(|(k, title)| (title.as_str(), Column(k)))
    }

    /// The column of one of these names, letters' case aside.
    pub(super) fn column(&self, names: &[&str]) -> Option<Column> {
        names.iter().find_map(|name| {
            self.header.iter().position(|title| title.eq_ignore_ascii_case(name)).map(Column)
        })
    }

    /// As [`Table::column`], where there must be one.
    pub(super) fn required(&self, what: &str, names: &[&str]) -> Result<Column, FileError> {
        self.column(names).ok_or_else(|| {
            let message = format!(
                "no column for the {what}: expected one called {}, found {}",
                names.join(" or "),
                self.header.join(", ")
            );
            FileError::malformed(&self.path, 1, message)
        })
    }

    pub(super) fn text<'a>(&self, row: &'a Row, column: Column) -> &'a str {
        &row.fields[column.0]
    }

    pub(super) fn number(&self, row: &Row, column: Column) -> Result<f64, FileError> {
        let field = self.text(row, column);
        match field.parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(value),
            _ => Err(self.fault(
                row,
                format!("{} is {field:?}, expected a finite number", self.header[column.0]),
            )),
        }
    }

    /// A whole number from 0 within the range of its type.
    pub(super) fn whole<T: std::str::FromStr>(
        &self,
        row: &Row,
        column: Column,
    ) -> Result<T, FileError> {
        let field = self.text(row, column);
        field.parse::<T>().map_err(|_| {
            let title = &self.header[column.0];
            self.fault(row, format!("{title} is {field:?}, expected a whole number from 0"))
        })
    }

    /// A positive number, or `otherwise` where there is no such column or the field is empty.
    pub(super) fn positive_or(
        &self,
        row: &Row,
        column: Option<Column>,
        otherwise: f64,
    ) -> Result<f64, FileError> {
        let Some(column) = column else { return Ok(otherwise) };
        if self.text(row, column).is_empty() {
            return Ok(otherwise);
        }
        let value = self.number(row, column)?;
        if value > 0.0 {
            Ok(value)
        } else {
            let title = &self.header[column.0];
            Err(self.fault(row, format!("{title} is {value}, expected a positive number")))
        }
    }

    pub(super) fn fault(&self, row: &Row, message: String) -> FileError {
        FileError::malformed(&self.path, row.line, message)
    }

    pub(super) fn whole_fault(&self, message: String) -> FileError {
        FileError::malformed(&self.path, None, message)
    }
}
