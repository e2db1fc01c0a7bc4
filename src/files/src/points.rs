//! Plant positions in CSV files.
//!
//! With a header, the columns are found by name, in any order and among others: `u_px,v_px`, or
//! else `x,y`. Without one there are just two columns, `u` and `v`. Positions are in pixels, the
//! centre of the top-left pixel being (0, 0). A file with a header alone holds no plants, but one with nothing at all is
//! refused, because it is more often a failed copy.

use super::{
    FileError, output,
    table::{Column, Table},
};
use std::path::Path;

/// The names by which a pair of columns is found, the first pair that is there being taken.
const NAMES: [[&str; 2]; 2] = [["u_px", "v_px"], ["x", "y"]];

/// Reads positions `[u, v]`, in pixels.
///
/// # Errors
/// Where the file cannot be read, lacks the columns, or has a row that is not two finite numbers;
/// the message names file and line.
pub fn read(path: &Path) -> Result<Vec<[f64; 2]>, FileError> {
    let table = Table::read(path)?;
    let columns = if table.is_named() {
        let pair = |[u, v]: &[&str; 2]| table.column(&[u]).zip(table.column(&[v]));
        let (names, (u, v)) =
            NAMES.iter().find_map(|names| Some((names, pair(names)?))).ok_or_else(|| {
                let found = table.header().join(",");
                let message = format!(
                    "expected a header with u_px,v_px or x,y, or two numbers, found {found:?}"
                );
                table.header_fault(message)
            })?;
        table.refuse_twice(names)?;
        [u, v]
    } else {
        let all: Vec<Column> = table.columns().map(|(_, column)| column).collect();
        all.try_into().map_err(|all: Vec<Column>| {
            table.whole_fault(format!(
                "expected two columns, found {}; more of them need a header with u_px,v_px or x,y",
                all.len()
            ))
        })?
    };
    let of = |row| Ok([table.number(row, columns[0])?, table.number(row, columns[1])?]);
    table.rows().iter().map(of).collect()
}

/// Writes positions, in pixels, under the header `u_px,v_px` and further named columns.
///
/// Numbers are written with the fewest digits that read back as the same number; a number that is
/// not finite leaves its field empty in the further columns, and is refused in a position.
///
/// # Errors
/// As [`output::write`], and where a position is not finite or a column has another length.
pub fn write(
    path: &Path,
    force: bool,
    positions_px: &[[f64; 2]],
    columns: &[(&str, &[f64])],
) -> Result<(), FileError> {
    let invalid = |message: String| {
        FileError::write(path, std::io::Error::new(std::io::ErrorKind::InvalidInput, message))
    };
    for (name, values) in columns {
        if values.len() != positions_px.len() {
            let (values, rows) = (values.len(), positions_px.len());
            return Err(invalid(format!("column {name} has {values} values for {rows} plants")));
        }
    }
    if let Some(plant) = positions_px.iter().position(|p| !p.iter().all(|x| x.is_finite())) {
        return Err(invalid(format!("the position of plant {plant} is not finite")));
    }
    output::write(path, force, |writer| {
        let mut writer = csv::Writer::from_writer(writer);
        let names = columns.iter().map(|(name, _)| *name);
        writer.write_record(NAMES[0].into_iter().chain(names))?;
        for (plant, position) in positions_px.iter().enumerate() {
            let further = columns.iter().map(|(_, values)| values[plant]);
            let row = position.iter().copied().chain(further);
            writer.write_record(
                row.map(|value| if value.is_finite() { format!("{value}") } else { String::new() }),
            )?;
        }
        writer.flush()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn parse(bytes: &[u8]) -> Result<Vec<[f64; 2]>, FileError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plants.csv");
        std::fs::write(&path, bytes).unwrap();
        read(&path)
    }

    fn fault(text: &str) -> (usize, String) {
        match parse(text.as_bytes()).unwrap_err() {
            FileError::Malformed { line, message, .. } => (line.unwrap_or(0), message),
            other => panic!("{other}"),
        }
    }

    #[test]
    fn headers_and_their_absence() {
        let expected = vec![[1.5, -2.0], [3e2, 4.0]];
        for text in [
            "u_px,v_px\n1.5,-2\n300,4\n",
            "1.5,-2\n300,4",
            "x,y\r\n1.5,-2\r\n3e2,4\r\n\r\n\r\n",
            "\u{feff}x,y\n1.5,-2\n300,4\n",
            "\u{feff}1.5,-2\n300,4\n",
            "row,v_px,name,u_px\n0,-2,a,1.5\n\n1,4,\"b, c\",300\n",
            "x,y,u_px,v_px\n9,9,1.5,-2\n9,9,300,4\n",
            "\"x\",\"y\"\n\"1.5\", -2 \n300,4\n   \n",
            "\n\n x , y \n1.5,-2\n300,4\n",
        ] {
            assert_eq!(parse(text.as_bytes()).unwrap(), expected, "{text:?}");
        }
        assert_eq!(parse(b"u_px,v_px\n").unwrap(), Vec::<[f64; 2]>::new());
    }

    #[test]
    fn faults_name_their_line() {
        insta::assert_snapshot!(fault("u_px,v_px\n1,2\n3,x\n").1, @r#"v_px is "x", expected a finite number"#);
        assert_eq!(fault("u_px,v_px\n1,2\n3,x\n").0, 3);
        assert_eq!(fault("\n\nx,y\r\n1,2\r\n\r\n\r\nNaN,2\r\n").0, 7);
        assert_eq!(fault("\u{feff}1,2\n\n3,inf\n").0, 3);
        assert_eq!(
            fault("1,2\n3\n"),
            (2, "expected 2 columns as in the header, found 1".to_owned())
        );
        assert_eq!(fault("x,y,row\n1,2,0\n3,4\n").0, 3);
        assert_eq!(fault("x,y\n1,1e999\n").0, 2);
        insta::assert_snapshot!(fault("a,b\n1,2\n").1, @r#"expected a header with u_px,v_px or x,y, or two numbers, found "a,b""#);
        insta::assert_snapshot!(fault("1,2,3\n").1, @"expected two columns, found 3; more of them need a header with u_px,v_px or x,y");
        insta::assert_snapshot!(fault("x,y,x\n").1, @"the header names x twice");
        assert_eq!(fault("\n\nx,y,x\n").0, 3);
        for nothing in ["", "\n\r\n", "\u{feff}", "  \n"] {
            assert!(fault(nothing).1.contains("is empty"), "{nothing:?}");
        }
    }

    #[test]
    fn written_positions_read_back_exactly() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plants.csv");
        let positions = [[0.1 + 0.2, 1e-300], [1e15, -1.0 / 3.0], [0.0, 17.0]];
        let rows = [0.0, f64::NAN, 2.5];
        write(&path, false, &positions, &[("row", &rows)]).unwrap();
        assert_eq!(read(&path).unwrap(), positions);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.starts_with("u_px,v_px,row\n0.30000000000000004,"), "{text}");
        assert!(text.ends_with("\n0,17,2.5\n"), "{text}");
        let taken = write(&path, false, &positions, &[]).unwrap_err();
        assert!(matches!(taken, FileError::Exists { .. }));
        let short = write(&path, true, &positions, &[("row", &rows[1..])]).unwrap_err();
        assert!(short.to_string().contains("column row has 2 values for 3 plants"), "{short}");
        let infinite = write(&path, true, &[[0.0, f64::INFINITY]], &[]).unwrap_err();
        assert!(infinite.to_string().contains("plant 0 is not finite"), "{infinite}");
        assert_eq!(read(&path).unwrap(), positions, "a refusal leaves the file");
    }

    proptest! {
        #[test]
        fn damaged_files_never_panic(
            damage in proptest::collection::vec((0usize..80, any::<u8>()), 0..6), end in 0usize..80
        ) {
            let mut bytes = b"\xEF\xBB\xBFu_px,v_px,row\r\n59.555,55.536,0\r\n\"76.2\",55.3,1\r\n\n1,2,3\n".to_vec();
            bytes.truncate(end);
            for (place, value) in damage {
                if let Some(byte) = bytes.get_mut(place) {
                    *byte = value;
                }
            }
            if let Ok(points) = parse(&bytes) {
                prop_assert!(points.iter().flatten().all(|x| x.is_finite()));
            }
        }

        #[test]
        fn any_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = parse(&bytes);
        }
    }
}
