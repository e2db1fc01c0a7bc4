//! Corners of calibration boards in CSV files.
//!
//! A header, then one row for each corner of each photo, columns in any order and among others:
//!
//! ```text
//! image,column,row,u_px,v_px
//! left01.jpg,0,0,244.427,94.165
//! ```
//!
//! `column` and `row` count the board's inner corners from 0. The centre of the top-left pixel is (0, 0).
//! The rows of one photo may stand anywhere in the file; photos keep the order of their first row.

use super::{
    FileError,
    csv_table::{CsvWriter, of_cell},
    output,
};
use rowgram_survey::target::{Board, BoardCorner};
use serde::Deserialize;
use std::path::Path;

/// The corners of one photo.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageCorners {
    /// The photo's name as it stands in the file.
    pub image: String,
    /// Its corners.
    pub corners: Vec<BoardCorner>,
}

/// The columns that have to be there.
const COLUMNS: [&str; 5] = ["image", "column", "row", "u_px", "v_px"];

#[derive(Deserialize)]
struct Row {
    image: String,
    column: usize,
    row: usize,
    u_px: f64,
    v_px: f64,
}

/// Reads the corners of `board` in photos.
///
/// # Errors
/// Names file and line: where a column is missing, a number is none or not finite, a corner is not
/// on the board or there twice.
pub fn read(path: &Path, board: Board) -> Result<Vec<ImageCorners>, FileError> {
    let bytes = crate::memory::read_file(path)?;
    parse(&bytes, board).map_err(|(line, message)| FileError::malformed(path, line, message))
}

type Fault = (Option<usize>, String);

fn parse(bytes: &[u8], board: Board) -> Result<Vec<ImageCorners>, Fault> {
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(bytes);
    let headers = reader.headers().map_err(|e| (Some(1), e.to_string()))?.clone();
    for name in COLUMNS {
        match headers.iter().filter(|header| *header == name).count() {
            1 => {}
            0 => {
                let found: String = headers.iter().collect::<Vec<_>>().join(",");
                return Err((
                    Some(1),
                    format!("expected a header with {}, found {found:?}", COLUMNS.join(",")),
                ));
            }
            _ => return Err((Some(1), format!("the header names {name} twice"))),
        }
    }
    let mut images: Vec<ImageCorners> = Vec::new();
    for record in reader.records() {
        let record = record.map_err(|error| {
            let line = error.position().map(|position| position.line() as usize);
            let message = match error.kind() {
                csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
                    format!("expected {expected_len} columns, found {len}")
                }
                _ => error.to_string(),
            };
            (line, message)
        })?;
        let line = record.position().map(|position| position.line() as usize);
        let mut row: Row = record
            .deserialize(Some(&headers))
            .map_err(|error| (line, field_message(&error, &headers, &record)))?;
        row.image = of_cell(&row.image).to_owned();
        for (name, value) in [("u_px", row.u_px), ("v_px", row.v_px)] {
            if !value.is_finite() {
                return Err((line, format!("{name} is {value}, expected a finite number")));
            }
        }
        if row.column >= board.columns || row.row >= board.rows {
            return Err((
                line,
                format!(
                    "column {} of row {} is not on a board of {board} inner corners (they count from 0)",
                    row.column, row.row
                ),
            ));
        }
        let corner =
            BoardCorner { column: row.column, row: row.row, image_px: [row.u_px, row.v_px] };
        let known = images.iter().position(|image| image.image == row.image);
        let image = match known {
            Some(k) => &mut images[k],
            None => {
                images.push(ImageCorners { image: row.image, corners: Vec::new() });
                let last = images.len() - 1;
                &mut images[last]
            }
        };
        if image.corners.iter().any(|c| (c.column, c.row) == (corner.column, corner.row)) {
            return Err((
                line,
                format!(
                    "column {} of row {} of {} is there twice",
                    corner.column, corner.row, image.image
                ),
            ));
        }
        image.corners.push(corner);
    }
    if images.is_empty() {
        return Err((None, "it has no corners, only a header".to_owned()));
    }
    Ok(images)
}

/// What is wrong with a field, without the words of the parser.
fn field_message(
    error: &csv::Error,
    headers: &csv::StringRecord,
    record: &csv::StringRecord,
) -> String {
    if let csv::ErrorKind::Deserialize { err, .. } = error.kind()
        && let Some(field) = err.field()
        && let Some(name) = headers.get(field as usize)
    {
        let value = record.get(field as usize).unwrap_or_default();
        let expected = match name {
            "column" | "row" => "a whole number from 0",
            _ => "a number",
        };
        return format!("{name} is {value:?}, expected {expected}");
    }
    error.to_string()
}

/// Writes corners, photo by photo.
///
/// # Errors
/// As [`output::write`].
pub fn write(path: &Path, force: bool, images: &[ImageCorners]) -> Result<(), FileError> {
    output::write(path, force, |writer| {
        let mut writer = CsvWriter::new(writer);
        writer.write_record(COLUMNS)?;
        for image in images {
            for corner in &image.corners {
                writer.write_record([
                    image.image.clone(),
                    corner.column.to_string(),
                    corner.row.to_string(),
                    corner.image_px[0].to_string(),
                    corner.image_px[1].to_string(),
                ])?;
            }
        }
        writer.flush()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const BOARD: Board = Board { columns: 4, rows: 3 };

    fn fault(text: &str) -> (usize, String) {
        let (line, message) = parse(text.as_bytes(), BOARD).unwrap_err();
        (line.unwrap_or(0), message)
    }

    #[test]
    fn faults_name_line_and_field() {
        let head = "image,column,row,u_px,v_px\n";
        for (text, line, part) in [
            ("u,v\n1,2\n".to_owned(), 1, "expected a header with image,column"),
            (format!("{head}a,0,0,1,2\na,1,0,NaN,2\n"), 3, "u_px is NaN"),
            (format!("{head}a,0,0,1,2\na,1,0,3\n"), 3, "expected 5 columns, found 4"),
            (format!("{head}a,0,0,1,x\n"), 2, "v_px is \"x\", expected a number"),
            (format!("{head}a,-1,0,1,2\n"), 2, "column is \"-1\", expected a whole number"),
            (format!("{head}a,4,0,1,2\n"), 2, "not on a board of 4x3"),
            (format!("{head}a,1,0,1,2\nb,1,0,1,2\na,1,0,5,2\n"), 4, "of a is there twice"),
            (head.to_owned(), 0, "no corners"),
        ] {
            let (found, message) = fault(&text);
            assert_eq!(found, line, "{text}: {message}");
            assert!(message.contains(part), "{text}: {message}");
        }
    }

    #[test]
    fn what_is_written_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("corners.csv");
        let corner = |column, row, u| BoardCorner { column, row, image_px: [u, 1.0 / 3.0] };
        let images = vec![
            ImageCorners { image: "b, c.jpg".into(), corners: vec![corner(0, 0, 0.1)] },
            ImageCorners {
                image: "a.jpg".into(),
                corners: vec![corner(3, 2, 1e3), corner(1, 0, -7.25)],
            },
        ];
        write(&path, false, &images).unwrap();
        assert_eq!(read(&path, BOARD).unwrap(), images);
    }

    proptest! {
        #[test]
        fn any_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = parse(&bytes, BOARD);
            let mut text = b"image,column,row,u_px,v_px\n".to_vec();
            text.extend(bytes);
            let _ = parse(&text, BOARD);
        }
    }
}
