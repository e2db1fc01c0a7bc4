//! What a person writes down of a field: its surveyed corners, and which plot has which entry.
//!
//! | file | columns |
//! |---|---|
//! | corners | `corner` (first, along, across, opposite), and `easting_m`, `northing_m` or `longitude_deg`, `latitude_deg` |
//! | field map | `plot` (its number or name); every other column is an attribute: `genotype`, `treatment`, `block` |
//!
//! Files of other programs are understood as in [`super::control`]: separators, a byte order mark, the order of columns.

use super::{
    FileError,
    polygons::NAMES,
    table::{Column, Row, Table, is_called},
};
use rowgram_base::options::Choice;
use rowgram_plants::phenotype::layout::design::FieldCorner;
use serde_json::Value;
use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
};

const CORNER: &[&str] = &["corner", "label", "name", "point", "id"];
const EASTING: &[&str] = &["easting_m", "easting", "x_m", "x", "east"];
const NORTHING: &[&str] = &["northing_m", "northing", "y_m", "y", "north"];
const LONGITUDE: &[&str] = &["longitude_deg", "longitude", "lon", "lng"];
const LATITUDE: &[&str] = &["latitude_deg", "latitude", "lat"];
const PLOT: &[&str] = &["plot", "plot_number", "plot_id", "plotid", "plot_no", "plot_name"];

/// Where a corner was surveyed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Surveyed {
    /// Easting and northing, metres.
    Metres([f64; 2]),
    /// Longitude and latitude on WGS84, degrees.
    Degrees([f64; 2]),
}

/// Reads the corners of a field, each once.
///
/// # Errors
/// A damaged table, a corner that does not exist or is there twice, fewer than two corners.
pub fn read_corners(path: &Path) -> Result<Vec<(FieldCorner, Surveyed)>, FileError> {
    let table = Table::read(path)?;
    let name = table.required("corners", CORNER)?;
    let in_degrees = table.column(LONGITUDE).zip(table.column(LATITUDE));
    let place = |row: &Row| match in_degrees {
        Some((longitude, latitude)) => {
            let [longitude, latitude] =
                [table.number(row, longitude)?, table.number(row, latitude)?];
            if longitude.abs() > 180.0 || latitude.abs() > 90.0 {
                let message = format!(
                    "longitude {longitude}, latitude {latitude} is no place on Earth: are the columns exchanged?"
                );
                return Err(table.fault(row, message));
            }
            Ok(Surveyed::Degrees([longitude, latitude]))
        }
        None => Ok(Surveyed::Metres([
            table.number(row, table.required("eastings", EASTING)?)?,
            table.number(row, table.required("northings", NORTHING)?)?,
        ])),
    };
    let mut corners: BTreeMap<FieldCorner, Surveyed> = BTreeMap::new();
    for row in table.rows() {
        let word = table.text(row, name);
        let all = FieldCorner::all();
        let corner = all.iter().find(|corner| corner.word().eq_ignore_ascii_case(word));
        let corner = *corner.ok_or_else(|| {
            let words: Vec<String> = all.iter().map(Choice::word).collect();
            table.fault(row, format!("corner {word:?}: expected one of {}", words.join(", ")))
        })?;
        if corners.insert(corner, place(row)?).is_some() {
            return Err(table.fault(row, format!("the corner {word} is there twice")));
        }
    }
    if corners.len() < 2 {
        let message = format!("it has {} corners, expected two to four", corners.len());
        return Err(table.whole_fault(message));
    }
    Ok(corners.into_iter().collect())
}

/// The words by which a table of corners names the reference system of its metres.
///
/// # Errors
/// A damaged table.
pub fn corner_system(path: &Path) -> Result<Option<String>, FileError> {
    Ok(Table::read(path)?.system().map(str::to_owned))
}

/// The entries of a field by plot.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FieldMap {
    /// Names of the attributes in the order of the file.
    pub columns: Vec<String>,
    /// The attributes of each plot, one for each column; null where a field is empty.
    pub plots: BTreeMap<String, Vec<Value>>,
}

/// Reads a field map.
///
/// # Errors
/// A damaged table, a table without plots or with a plot twice, an attribute that would be taken for the plot's name.
pub fn read_field_map(path: &Path) -> Result<FieldMap, FileError> {
    let table = Table::with_header(path)?;
    let plot = table.required("plots", PLOT)?;
    let plot_title =
        table.columns().find(|(title, _)| PLOT.iter().any(|p| p.eq_ignore_ascii_case(title)));
    let plot_title = plot_title.map_or("plot", |(title, _)| title);
    let others: Vec<_> = table.columns().filter(|(title, _)| *title != plot_title).collect();
    let taken = |title: &str| NAMES.iter().any(|name| name.eq_ignore_ascii_case(title));
    if let Some((title, _)) = others.iter().find(|(title, _)| taken(title)) {
        let message = format!(
            "the column {title} would be taken for the name of the plot, expected another name for it, as genotype"
        );
        return Err(table.whole_fault(message));
    }
    rows_of(&table, plot, &others, |text| Some(plot_name(text)))
}

/// A field book: what a table says of plots, by the column that has their names.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldBook {
    /// The title of that column.
    pub key: String,
    /// The other columns.
    pub map: FieldMap,
}

/// Reads a field book with any titles: the column in which most of the names are found is that of the plots, of several the one that is called so;
/// 101.0 is 101, and where no plot is called just so, 001 is 1 and p101 is P101. Rows of other plots are left out.
///
/// # Errors
/// A damaged table, a table without any of the names or with one of them twice, or with two columns of them that differ and are not called plots.
pub fn read_field_book(path: &Path, names: &[&str]) -> Result<FieldBook, FileError> {
    let table = Table::read(path)?;
    let known: BTreeSet<&str> = names.iter().copied().collect();
    // By what they are called without zeros in front and in small letters; nothing where two are called so.
    let mut alike: BTreeMap<String, Option<&str>> = BTreeMap::new();
    for name in &known {
        alike.entry(loosely(name)).and_modify(|of| *of = None).or_insert(Some(name));
    }
    let own = |text: &str| {
        let name = plot_name(text);
        known.get(name).copied().or_else(|| alike.get(&loosely(name)).copied().flatten())
    };
    let found = |column: Column| {
        let names = table.rows().iter().filter_map(|row| own(table.text(row, column)));
        names.collect::<BTreeSet<_>>().len()
    };
    let columns: Vec<_> =
        table.columns().map(|(title, column)| (found(column), title, column)).collect();
    let most = columns.iter().map(|(found, ..)| *found).max().unwrap_or(0);
    let best: Vec<_> = columns.iter().filter(|(found, ..)| *found == most && most > 0).collect();
    let names_plots = |title: &str| PLOT.iter().any(|plot| is_called(title, plot));
    // Entries are numbered from 1 as plots are: the title decides.
    let chosen = best.iter().find(|(_, title, _)| names_plots(title)).or(best.first());
    let Some(&&(_, key, plot)) = chosen else {
        let titles: Vec<&str> = table.columns().map(|(title, _)| title).collect();
        let example = names.first().copied().unwrap_or("any");
        return Err(table.whole_fault(format!(
            "no column has names of the plots (such as {example:?}); its columns: {}",
            titles.join(", ")
        )));
    };
    let differs = |column: Column| {
        let name = |row: &Row, column| plot_name(table.text(row, column));
        table.rows().iter().any(|row| name(row, column) != name(row, plot))
    };
    let other = best.iter().find(|(.., column)| differs(*column));
    if let Some((_, title, _)) = other.filter(|_| !names_plots(key)) {
        return Err(table.whole_fault(format!(
            "{key} and {title} both have the names of all plots, and differ; call the column with those of the plots {}",
            PLOT[0]
        )));
    }
    let others: Vec<_> = table.columns().filter(|(title, _)| *title != key).collect();
    let map = rows_of(&table, plot, &others, own)?;
    Ok(FieldBook { key: key.to_owned(), map })
}

/// A name as polygons have it: a number without fraction has none.
fn plot_name(text: &str) -> &str {
    match text.split_once('.') {
        Some((whole, zeros))
            if !whole.is_empty()
                && whole.bytes().all(|b| b.is_ascii_digit())
                && zeros.bytes().all(|b| b == b'0') =>
        {
            whole
        }
        _ => text,
    }
}

/// A name without zeros in front, where it is a number, and in small letters.
fn loosely(name: &str) -> String {
    let is_number = !name.is_empty() && name.bytes().all(|b| b.is_ascii_digit());
    let name = if is_number { name.trim_start_matches('0') } else { name };
    name.to_lowercase()
}

/// The rows of a table by the names of their plots, which are `named` so; rows of none are left out.
fn rows_of<'a>(
    table: &'a Table,
    plot: Column,
    others: &[(&str, Column)],
    named: impl Fn(&'a str) -> Option<&'a str>,
) -> Result<FieldMap, FileError> {
    let titles: Vec<&str> = table.columns().map(|(title, _)| title).collect();
    let is_twice = |(k, title): &(usize, &&str)| {
        !title.is_empty() && titles[..*k].iter().any(|other| other.eq_ignore_ascii_case(title))
    };
    if let Some((_, title)) = titles.iter().enumerate().find(is_twice) {
        return Err(table.whole_fault(format!("the header names {title} twice")));
    }
    let mut map = FieldMap {
        columns: others.iter().map(|(title, _)| (*title).to_owned()).collect(),
        plots: BTreeMap::new(),
    };
    for row in table.rows() {
        let Some(name) = named(table.text(row, plot)).map(str::to_owned) else { continue };
        if name.is_empty() {
            return Err(table.fault(row, "the plot has no number".to_owned()));
        }
        let values = others.iter().map(|(_, column)| match table.text(row, *column) {
            "" => Value::Null,
            // A number that a text would not give back, such as 007, is a text.
            text => match text.parse::<serde_json::Number>() {
                Ok(number) if number.to_string() == text => Value::Number(number),
                _ => Value::String(text.to_owned()),
            },
        });
        let values = values.collect();
        if map.plots.insert(name.clone(), values).is_some() {
            return Err(table.fault(row, format!("plot {name} is there twice")));
        }
    }
    if map.plots.is_empty() {
        return Err(table.whole_fault("it has no plots".to_owned()));
    }
    Ok(map)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(text: &str) -> (tempfile::TempDir, std::path::PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("table.csv");
        std::fs::write(&path, text).unwrap();
        (folder, path)
    }

    #[test]
    fn corners_are_read_in_metres_or_degrees() {
        let (_folder, path) =
            file("corner;Easting;Northing\nAlong;500010;4480000\nfirst;500000;4480000\n");
        let corners = read_corners(&path).unwrap();
        assert_eq!(corners[0], (FieldCorner::First, Surveyed::Metres([500_000.0, 4_480_000.0])));
        let (_folder, path) = file("corner,lat,lon\nfirst,40.1,-87.2\nopposite,40.2,-87.1\n");
        let corners = read_corners(&path).unwrap();
        assert_eq!(corners[1], (FieldCorner::Opposite, Surveyed::Degrees([-87.1, 40.2])));
        let (_folder, path) = file("EPSG:32617\ncorner,x,y\nfirst,1,2\nalong,3,2\n");
        assert_eq!(corner_system(&path).unwrap().as_deref(), Some("EPSG:32617"));
        assert_eq!(read_corners(&path).unwrap().len(), 2);
        for (text, expected) in [
            ("corner,x,y\nfirst,1,2\n", "expected two to four"),
            ("corner,x,y\nfirst,1,2\nfirst,1,3\n", "twice"),
            ("corner,x,y\nnorth-west,1,2\n", "expected one of first, along, across, opposite"),
            ("corner,x\nfirst,1\n", "northings"),
            ("corner,lat,lon\nfirst,140,-87\n", "no place on Earth"),
        ] {
            let (_folder, path) = file(text);
            let error = read_corners(&path).unwrap_err().to_string();
            assert!(error.contains(expected) && error.contains("table.csv"), "{error}");
        }
    }

    #[test]
    fn a_field_book_is_joined_by_the_column_that_is_called_so() {
        let text = "entry,plot,genotype\n3,1,B73\n1,2,Mo17\n2,3,W22\n";
        let (_folder, path) = file(text);
        let book = read_field_book(&path, &["1", "2", "3"]).unwrap();
        assert_eq!((book.key.as_str(), &book.map.plots["1"][1]), ("plot", &Value::from("B73")));
        let (_folder, path) = file(&text.replace("plot", "parcel"));
        let error = read_field_book(&path, &["1", "2", "3"]).unwrap_err().to_string();
        assert!(error.contains("entry and parcel both have the names"), "{error}");
        let (_folder, path) = file("nr,id,genotype\n1,1,B73\n2,2,Mo17\n");
        assert_eq!(read_field_book(&path, &["1", "2"]).unwrap().key, "nr");
        // Plots of another trial may be there twice. What two plots are called but for zeros and letters is none of them.
        let (_folder, path) = file("plot,genotype\n001,B73\nP2,Mo17\np2,W22\n0x,A\n9,B\n9,C\n");
        let book = read_field_book(&path, &["1", "P2", "p2", "0X"]).unwrap();
        assert!(book.map.plots.keys().eq(["0X", "1", "P2", "p2"]), "{book:?}");
        assert_eq!(book.map.plots["1"], [Value::from("B73")]);
        let book = read_field_book(&path, &["1", "01", "9x"]);
        assert!(book.unwrap_err().to_string().contains("no column has names"));
    }

    #[test]
    fn a_field_map_keeps_its_columns_and_kinds() {
        let (_folder, path) = file("Plot,genotype,block,rate\n101,B73,007,1.5\n102,,1,2\n");
        let map = read_field_map(&path).unwrap();
        assert_eq!(map.columns, ["genotype", "block", "rate"]);
        assert_eq!(map.plots["101"], [Value::from("B73"), Value::from("007"), Value::from(1.5)]);
        assert_eq!(map.plots["102"], [Value::Null, Value::from(1), Value::from(2)]);
        for (text, expected) in [
            ("plot,genotype\n1,a\n1,b\n", "plot 1 is there twice"),
            ("plot,genotype,Genotype\n1,a,b\n", "names Genotype twice"),
            ("plot,name\n1,a\n", "taken for the name"),
            ("entry,genotype\n1,a\n", "no column for the plots"),
            ("plot,genotype\n", "no plots"),
            ("plot,genotype\n,a\n", "no number"),
        ] {
            let (_folder, path) = file(text);
            let error = read_field_map(&path).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
