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

use super::{FileError, csv_table::CsvWriter, output, table::Table};
use rowgram_survey::target::{Board, BoardCorner};
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

/// Reads the corners of `board` in photos.
///
/// # Errors
/// Names file and line: where a column is missing, a number is none or not finite, a corner is not
/// on the board or there twice.
pub fn read(path: &Path, board: Board) -> Result<Vec<ImageCorners>, FileError> {
    let table = Table::with_header(path)?;
    table.refuse_twice(&COLUMNS)?;
    let mut columns = Vec::with_capacity(COLUMNS.len());
    for name in COLUMNS {
        columns.push(table.required(name, &[name])?);
    }
    let mut images: Vec<ImageCorners> = Vec::new();
    for row in table.rows() {
        let name = table.text(row, columns[0]);
        let (column, of_board) = (table.whole(row, columns[1])?, table.whole(row, columns[2])?);
        let image_px = [table.number(row, columns[3])?, table.number(row, columns[4])?];
        let corner = BoardCorner { column, row: of_board, image_px };
        let place = format!("column {column} of row {of_board}");
        if column >= board.columns || of_board >= board.rows {
            let message =
                format!("{place} is not on a board of {board} inner corners (they count from 0)");
            return Err(table.fault(row, message));
        }
        let known = images.iter().position(|image| image.image == name);
        let known = known.unwrap_or_else(|| {
            images.push(ImageCorners { image: name.to_owned(), corners: Vec::new() });
            images.len() - 1
        });
        let corners = &mut images[known].corners;
        if corners.iter().any(|c| (c.column, c.row) == (corner.column, corner.row)) {
            return Err(table.fault(row, format!("{place} of {name} is there twice")));
        }
        corners.push(corner);
    }
    if images.is_empty() {
        return Err(table.whole_fault("it has no corners, only a header".to_owned()));
    }
    Ok(images)
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

    fn parse(bytes: &[u8]) -> Result<Vec<ImageCorners>, FileError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("corners.csv");
        std::fs::write(&path, bytes).unwrap();
        read(&path, BOARD)
    }

    fn fault(text: &str) -> (usize, String) {
        match parse(text.as_bytes()).unwrap_err() {
            FileError::Malformed { line, message, .. } => (line.unwrap_or(0), message),
            other => panic!("{other}"),
        }
    }

    #[test]
    fn faults_name_line_and_field() {
        let head = "image,column,row,u_px,v_px\n";
        for (text, line, part) in [
            (
                "u,v\n1,2\n".to_owned(),
                1,
                "no column for the image: expected one called image, found u, v",
            ),
            (format!("{head}a,0,0,1,2\na,1,0,NaN,2\n"), 3, "u_px is \"NaN\""),
            (
                format!("{head}a,0,0,1,2\na,1,0,3\n"),
                3,
                "expected 5 columns as in the header, found 4",
            ),
            (format!("{head}a,0,0,1,x\n"), 2, "v_px is \"x\", expected a finite number"),
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
            let _ = parse(&bytes);
            let mut text = b"image,column,row,u_px,v_px\n".to_vec();
            text.extend(bytes);
            let _ = parse(&text);
        }
    }
}
