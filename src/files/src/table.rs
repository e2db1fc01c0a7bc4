//! Tables of text, read by the names of their columns: the one reader of all tables that people and programs deliver.
//!
//! Comma, semicolon, tab or blanks separate; numbers have a decimal point or, where commas do not separate, a decimal comma;
//! the text is UTF-8, UTF-16 with a byte order mark, or else Latin-1. A first row in which no field is a number is the header;
//! without one, the last line of comments (`#`, `%`) before the rows is, where it has as many fields. Lines of comments, a title of
//! the whole in the first of several cells and a first line that names a reference system are kept apart.

mod separator;
mod units;

use super::{
    FileError,
    csv_table::of_cell,
    words::{LARGEST, is_none},
};
use encoding_rs::{Encoding, WINDOWS_1252};
use separator::Separator;
use std::path::{Path, PathBuf};
use units::{has_minutes, name_and_ending, unit};

/// A file with rows of fields. All of them are one text: tables of leaves have millions of cells.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Table {
    path: PathBuf,
    header: Vec<String>,
    /// The columns that say to which side numbers of others count, as EXIF tags do: `GPSLongitudeRef`.
    sides: Vec<Option<Column>>,
    /// What a number of each column stands for, in metres or degrees.
    units: Vec<Result<f64, &'static str>>,
    header_line: usize,
    named: bool,
    preamble: Vec<String>,
    text: String,
    /// Where each field ends.
    ends: Vec<usize>,
    rows: Vec<Row>,
    decimal_comma: bool,
}

/// One row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Row {
    pub(super) line: usize,
    first: usize,
}

/// A column that was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Column(usize);

/// The text of a file: by its byte order mark, else UTF-8, else Latin-1 as Windows writes it.
pub fn decode(bytes: Vec<u8>) -> String {
    match Encoding::for_bom(&bytes) {
        Some((encoding, mark)) => {
            encoding.decode_without_bom_handling(&bytes[mark..]).0.into_owned()
        }
        None => String::from_utf8(bytes).unwrap_or_else(|error| {
            WINDOWS_1252.decode_without_bom_handling(error.as_bytes()).0.into_owned()
        }),
    }
}

/// As [`decode`], of a file.
///
/// # Errors
/// A file that cannot be read.
pub fn read_text(path: &Path) -> Result<String, FileError> {
    Ok(decode(crate::memory::read_file(path)?))
}

/// A title as it is compared: without unit, in lower case, words joined by `_`.
fn normal(title: &str) -> String {
    let mut depth = 0;
    let mut out = String::new();
    for c in title.chars() {
        match c {
            '(' | '[' => depth += 1,
            ')' | ']' => depth -= 1,
            _ if depth > 0 => {}
            c if c.is_alphanumeric() => out.extend(c.to_lowercase()),
            _ if !out.is_empty() && !out.ends_with('_') => out.push('_'),
            _ => {}
        }
    }
    out.truncate(out.trim_end_matches('_').len());
    out
}

/// Whether a title has a name, letters' case and units aside.
pub(super) fn is_called(title: &str, name: &str) -> bool {
    normal(title) == normal(name)
}

/// The words of a line that names a reference system: the first of an OpenDroneMap list, of Metashape with a title.
fn system_words(line: &str) -> &str {
    let bare = line.trim_start_matches(['#', ' ']);
    let (title, rest) = bare.split_once(':').unwrap_or_default();
    if normal(title).replace('_', "") == "coordinatesystem" { rest.trim() } else { bare }
}

fn names_system(line: &str) -> bool {
    let upper = system_words(line).to_ascii_uppercase();
    ["EPSG:", "+PROJ", "WGS84", "WGS 84", "PROJCS[", "GEOGCS[", "COMPD_CS["]
        .iter()
        .any(|begin| upper.starts_with(begin))
}

impl Table {
    /// Reads a table, with a header or without one.
    pub(super) fn read(path: &Path) -> Result<Table, FileError> {
        Table::of(path, false)
    }

    /// Reads a table whose first row is its header, whatever is in it.
    pub(super) fn with_header(path: &Path) -> Result<Table, FileError> {
        Table::of(path, true)
    }

    fn of(path: &Path, has_header: bool) -> Result<Table, FileError> {
        let text = read_text(path)?;
        // Office files, of now and before 2007.
        if ["PK\u{3}\u{4}", "\u{d0}\u{cf}\u{11}\u{e0}"].iter().any(|of| text.starts_with(of)) {
            let message =
                "it is an Excel workbook or an archive, expected a table of text: save it as CSV";
            return Err(FileError::malformed(path, None, message));
        }
        if let Some(at) = text.find('\0') {
            let line = text[..at].matches('\n').count() + 1;
            return Err(FileError::malformed(path, line, "not text: it has a character NUL"));
        }
        let mut table = Table {
            path: path.to_owned(),
            header: Vec::new(),
            sides: Vec::new(),
            units: Vec::new(),
            header_line: 1,
            named: true,
            preamble: Vec::new(),
            text: String::new(),
            ends: Vec::new(),
            rows: Vec::new(),
            decimal_comma: false,
        };
        let mut begin = 0;
        for line in text.split_inclusive('\n').filter(|_| !has_header) {
            let bare = line.trim();
            let first_system =
                names_system(bare) && table.preamble.iter().all(|l| !names_system(l));
            if !(bare.is_empty() || bare.starts_with(['#', '%']) || first_system) {
                break;
            }
            begin += line.len();
            if !bare.is_empty() {
                table.preamble.push(bare.to_owned());
            }
        }
        let rest = &text[begin..];
        let separator = if has_header { Separator::of_header(rest) } else { Separator::of(rest) };
        table.fill(&text, begin, &separator, has_header)?;
        let side = |title: &String| table.column(&[&format!("{}ref", normal(title))]);
        table.sides = table.header.iter().map(side).collect();
        table.units = table.header.iter().map(|title| unit(title)).collect();
        Ok(table)
    }

    fn fill(
        &mut self,
        text: &str,
        begin: usize,
        separator: &Separator,
        has_header: bool,
    ) -> Result<(), FileError> {
        self.decimal_comma = separator.decimal_comma;
        let (mut counted, mut newlines) = (0, 0);
        let mut fault = None;
        separator
            .split(&text[begin..], |at, fields| {
                let at = begin + at;
                newlines += text[counted..at].matches('\n').count();
                counted = at;
                let skipped = text[at..].chars().take_while(|c| c.is_whitespace());
                let line = newlines + skipped.filter(|&c| c == '\n').count() + 1;
                if fields.iter().all(|field| field.is_empty()) {
                    return true;
                }
                if self.header.is_empty() && self.rows.is_empty() {
                    // The title of a sheet stands in its first cell, above the header.
                    let is_title = separator.number(fields[0]).is_none()
                        && fields[1..].iter().all(|field| field.is_empty());
                    if fields.len() > 1 && is_title {
                        return true;
                    }
                    self.named =
                        has_header || fields.iter().all(|field| separator.number(field).is_none());
                    if self.named {
                        self.header_line = line;
                        self.header =
                            fields.iter().map(|field| of_cell(field).to_owned()).collect();
                        return true;
                    }
                    self.header = self.commented_header(fields.len(), separator);
                }
                let width = self.header.len();
                // A name may begin with such a sign; a footer is text, and has no second field.
                let after = fields[0].strip_prefix(['#', '%']).filter(|_| !has_header);
                let is_footer = |after: &str| {
                    after.starts_with(char::is_whitespace)
                        || fields.get(1).is_some_and(|second| second.is_empty())
                };
                if after.is_some_and(|after| fields.len() != width || is_footer(after)) {
                    return true;
                }
                // Trailing separators, and trailing fields that a table without a header may leave out.
                let surplus = fields.get(width..).unwrap_or_default();
                let ragged = !self.named && separator.is_blank();
                if !ragged
                    && (fields.len() < width || surplus.iter().any(|field| !field.is_empty()))
                {
                    let count = fields.len();
                    let message = match width {
                        1 => format!(
                            "the header is one column ({}), this row is {count} ({}): separate the columns of both by the same sign",
                            self.header[0],
                            fields.join(" | ")
                        ),
                        _ => format!("expected {width} columns as in the header, found {count}"),
                    };
                    fault = Some(FileError::malformed(&self.path, line, message));
                    return false;
                }
                self.rows.push(Row { line, first: self.ends.len() });
                for k in 0..width {
                    self.text += of_cell(fields.get(k).copied().unwrap_or_default());
                    self.ends.push(self.text.len());
                }
                true
            })
            .map_err(|message| FileError::malformed(&self.path, None, message))?;
        match fault {
            Some(fault) => Err(fault),
            None if self.header.is_empty() => {
                let message = "the file is empty, expected a header or rows";
                Err(FileError::malformed(&self.path, None, message))
            }
            None => Ok(()),
        }
    }

    /// The header that comments give to so many columns, else their numbers.
    fn commented_header(&mut self, width: usize, separator: &Separator) -> Vec<String> {
        let last = self.preamble.iter().rfind(|line| line.starts_with(['#', '%']));
        let mut titles: Vec<String> = Vec::new();
        if let Some(line) = last {
            let bare = line.trim_start_matches(['#', '%', ' ']);
            titles = separator.titles_of(bare, width).into_iter().map(str::to_owned).collect();
        }
        // A moment of time is two fields.
        if titles.len() + 1 == width
            && titles.first().is_some_and(|t| ["GPST", "UTC"].contains(&t.as_str()))
        {
            titles.insert(0, "date".to_owned());
        }
        self.named = titles.len() == width && titles.iter().all(|t| separator.number(t).is_none());
        if self.named { titles } else { (1..=width).map(|k| format!("column {k}")).collect() }
    }

    pub(super) fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// Whether its columns have names.
    pub(super) fn is_named(&self) -> bool {
        self.named
    }

    /// The titles of its columns.
    pub(super) fn header(&self) -> &[String] {
        &self.header
    }

    /// The words by which it names a reference system.
    pub(super) fn system(&self) -> Option<&str> {
        self.preamble.iter().find(|line| names_system(line)).map(|line| system_words(line))
    }

    /// The lines before its rows that are none: comments, and a reference system.
    pub(super) fn comments(&self) -> &[String] {
        &self.preamble
    }

    /// All columns with their names, in their order.
    pub(super) fn columns(&self) -> impl Iterator<Item = (&str, Column)> {
        self.header.iter().enumerate().map(|(k, title)| (title.as_str(), Column(k)))
    }

    /// The title of a column.
    pub(super) fn title(&self, column: Column) -> &str {
        &self.header[column.0]
    }

    /// The column of one of these names, letters' case and units aside. Where the first is in metres, a name may also end in
    /// another unit of length.
    pub(super) fn column(&self, names: &[&str]) -> Option<Column> {
        let titles: Vec<String> = self.header.iter().map(|title| normal(title)).collect();
        let place = |name: &&str| titles.iter().position(|title| *title == normal(name));
        let is_length = names.first().is_some_and(|name| name.ends_with("_m"));
        let in_other_unit = |name: &&str| {
            let name = normal(name);
            let begin = name.strip_suffix("_m").unwrap_or(&name);
            titles
                .iter()
                .position(|title| name_and_ending(title).is_some_and(|(of, _)| of == begin))
        };
        let other = || names.iter().filter(|_| is_length).find_map(in_other_unit);
        names.iter().find_map(place).or_else(other).map(Column)
    }

    /// As [`Table::column`], where there must be one.
    pub(super) fn required(&self, what: &str, names: &[&str]) -> Result<Column, FileError> {
        self.column(names).ok_or_else(|| {
            let message = format!(
                "no column for the {what}: expected one called {}, found {}",
                names.join(" or "),
                self.header.join(", ")
            );
            self.header_fault(message)
        })
    }

    /// An error of the header.
    pub(super) fn header_fault(&self, message: String) -> FileError {
        FileError::malformed(&self.path, self.header_line, message)
    }

    /// Refuses a header with two columns of one of these names.
    pub(super) fn refuse_twice(&self, names: &[&str]) -> Result<(), FileError> {
        let titles: Vec<String> = self.header.iter().map(|title| normal(title)).collect();
        let is_twice =
            |name: &&&str| titles.iter().filter(|title| title.as_str() == **name).count() > 1;
        match names.iter().find(is_twice) {
            Some(name) => {
                let message = format!("the header names {name} twice");
                Err(self.header_fault(message))
            }
            None => Ok(()),
        }
    }

    fn cell(&self, at: usize) -> &str {
        let start = at.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.text[start..self.ends[at]]
    }

    pub(super) fn text(&self, row: &Row, column: Column) -> &str {
        self.cell(row.first + column.0)
    }

    /// The field as a number, in metres or degrees where the title has another unit; `None` where it is none.
    pub(super) fn parse(&self, row: &Row, column: Column) -> Option<f64> {
        let number = separator::number(self.text(row, column), self.decimal_comma)?;
        let side = self.sides[column.0].map_or("", |side| self.text(row, side));
        let sign = if number > 0.0 && side.starts_with(['W', 'w', 'S', 's']) { -1.0 } else { 1.0 };
        Some(sign * self.units[column.0].map_or(number, |unit| unit * number))
    }

    pub(super) fn number(&self, row: &Row, column: Column) -> Result<f64, FileError> {
        let (title, field) = (&self.header[column.0], self.text(row, column));
        if let Err(why) = self.units[column.0] {
            return Err(self.header_fault(format!("{title} has {why}")));
        }
        match self.parse(row, column).filter(|value| value.is_finite()) {
            Some(value) if value.abs() <= LARGEST => Ok(value),
            Some(_) => Err(self
                .fault(row, format!("{title} is {field}, expected at most {LARGEST:e} in size"))),
            None if has_minutes(field) => Err(self.fault(
                row,
                format!(
                    "{title} is {field:?}, expected decimal degrees such as 40.4719, negative to the south and west"
                ),
            )),
            None => Err(self.fault(row, format!("{title} is {field:?}, expected a finite number"))),
        }
    }

    /// A number, or `None` where the field is empty or says that there is none.
    pub(super) fn number_or_none(
        &self,
        row: &Row,
        column: Column,
    ) -> Result<Option<f64>, FileError> {
        match is_none(self.text(row, column)) {
            true => Ok(None),
            false => self.number(row, column).map(Some),
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
        match self.number_or_none(row, column)? {
            None => Ok(otherwise),
            Some(value) if value > 0.0 => Ok(value),
            Some(value) => {
                let title = &self.header[column.0];
                Err(self.fault(row, format!("{title} is {value}, expected a positive number")))
            }
        }
    }

    pub(super) fn fault(&self, row: &Row, message: String) -> FileError {
        FileError::malformed(&self.path, row.line, message)
    }

    pub(super) fn whole_fault(&self, message: String) -> FileError {
        FileError::malformed(&self.path, None, message)
    }
}

#[cfg(test)]
mod tests;
