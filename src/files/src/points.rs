//! Plant positions in CSV files.
//!
//! With a header, the columns are found by name, in any order and among others: `u_px,v_px`, or
//! else `x,y`. Without one there are just two columns, `u` and `v`. Positions are in pixels, the
//! centre of the top-left pixel being (0, 0). A byte order mark, CRLF line ends and blank lines
//! are accepted; a file with a header alone holds no plants, but one with nothing at all is
//! refused, because it is more often a failed copy.

use super::{FileError, output};
use csv::ByteRecord;
use std::path::Path;

/// The names by which a pair of columns is found, the first pair that is there being taken.
const NAMES: [[&str; 2]; 2] = [["u_px", "v_px"], ["x", "y"]];

/// Reads positions `[u, v]`, in pixels.
///
/// # Errors
/// Where the file cannot be read, lacks the columns, or has a row that is not two finite numbers;
/// the message names file and line.
pub fn read(path: &Path) -> Result<Vec<[f64; 2]>, FileError> {
    let bytes = crate::memory::read_file(path)?;
    parse(&bytes).map_err(|(line, message)| FileError::malformed(path, line, message))
}

/// What is wrong, and in which line.
type Fault = (Option<usize>, String);

fn parse(bytes: &[u8]) -> Result<Vec<[f64; 2]>, Fault> {
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .flexible(true)
        .trim(csv::Trim::All)
        .from_reader(bytes);
    let mut record = ByteRecord::new();
    let mut columns: Option<Columns> = None;
    let mut points = Vec::new();
    while reader.read_byte_record(&mut record).map_err(|e| (None, e.to_string()))? {
        let at = |message| (line_of(bytes, &record), message);
        if record.len() == 1 && record.get(0).is_some_and(<[u8]>::is_empty) {
            continue;
        }
        let columns = match &columns {
            Some(columns) => columns,
            None => {
                let found = Columns::of(&record).map_err(at)?;
                let header = found.header;
                let found = columns.insert(found);
                if header {
                    continue;
                }
                found
            }
        };
        points.push(columns.position(&record).map_err(at)?);
    }
    match columns {
        Some(_) => Ok(points),
        None => Err((
            None,
            "the file is empty, expected a header with u_px,v_px or x,y, or two columns".to_owned(),
        )),
    }
}

/// One-based line in which a record begins; the reader counts blank lines to the record after
/// them.
fn line_of(bytes: &[u8], record: &ByteRecord) -> Option<usize> {
    let position = record.position()?;
    let rest = bytes.get(usize::try_from(position.byte()).ok()?..)?;
    let blank = rest.iter().take_while(|byte| matches!(byte, b'\r' | b'\n'));
    Some(position.line() as usize + blank.filter(|&&byte| byte == b'\n').count())
}

/// Where the positions stand in a row.
struct Columns {
    header: bool,
    count: usize,
    places: [usize; 2],
    names: [&'static str; 2],
}

impl Columns {
    /// From the first row, header or not.
    fn of(record: &ByteRecord) -> Result<Columns, String> {
        for names in NAMES {
            let found = names.map(|name| {
                let mut places =
                    record.iter().enumerate().filter(|(_, field)| *field == name.as_bytes());
                (places.next().map(|(place, _)| place), places.next().is_some())
            });
            if let [(Some(u), twice_u), (Some(v), twice_v)] = found {
                if twice_u || twice_v {
                    return Err(format!("the header names {} or {} twice", names[0], names[1]));
                }
                return Ok(Columns { header: true, count: record.len(), places: [u, v], names });
            }
        }
        if !record.iter().take(2).all(|field| number(field).is_some()) {
            let fields: Vec<_> = record.iter().take(8).map(String::from_utf8_lossy).collect();
            let shown = shorten(&fields.join(","));
            return Err(format!(
                "expected a header with u_px,v_px or x,y, or two numbers, found {shown:?}"
            ));
        }
        if record.len() != 2 {
            return Err(format!(
                "expected two columns, found {}; more of them need a header with u_px,v_px or x,y",
                record.len()
            ));
        }
        Ok(Columns { header: false, count: 2, places: [0, 1], names: ["u", "v"] })
    }

    fn position(&self, record: &ByteRecord) -> Result<[f64; 2], String> {
        if record.len() != self.count {
            return Err(format!("expected {} columns, found {}", self.count, record.len()));
        }
        let coordinate = |axis: usize| {
            let field = record.get(self.places[axis]).unwrap_or_default();
            number(field).filter(|value| value.is_finite()).ok_or_else(|| {
                let shown = shorten(&String::from_utf8_lossy(field));
                format!("{} is {shown:?}, expected a finite number", self.names[axis])
            })
        };
        Ok([coordinate(0)?, coordinate(1)?])
    }
}

fn number(field: &[u8]) -> Option<f64> {
    std::str::from_utf8(field).ok()?.parse().ok()
}

/// A field as a message can show it.
fn shorten(text: &str) -> String {
    match text.char_indices().nth(40) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
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

    fn fault(text: &str) -> (usize, String) {
        let (line, message) = parse(text.as_bytes()).unwrap_err();
        (line.unwrap_or(0), message)
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
        assert_eq!(fault("1,2\n3\n"), (2, "expected 2 columns, found 1".to_owned()));
        assert_eq!(fault("x,y,row\n1,2,0\n3,4\n").0, 3);
        assert_eq!(fault("x,y\n1,1e999\n").0, 2);
        insta::assert_snapshot!(fault("a,b\n1,2\n").1, @r#"expected a header with u_px,v_px or x,y, or two numbers, found "a,b""#);
        insta::assert_snapshot!(fault("1,2,3\n").1, @"expected two columns, found 3; more of them need a header with u_px,v_px or x,y");
        insta::assert_snapshot!(fault("x,y,x\n").1, @"the header names x or y twice");
        for nothing in ["", "\n\r\n", "\u{feff}", "  \n"] {
            assert!(fault(nothing).1.contains("is empty"), "{nothing:?}");
        }
    }

    #[test]
    fn written_positions_read_back_exactly() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plants.csv");
        let positions = [[0.1 + 0.2, 1e-300], [f64::MAX, -1.0 / 3.0], [0.0, 17.0]];
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
