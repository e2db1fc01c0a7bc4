//! Leaves by area, one row per plot, in a CSV file.
//!
//! | column | |
//! |---|---|
//! | `plot` | name of the plot; `whole` for all of the raster |
//! | `pixels` | leaf pixels |
//! | `leaves` | leaves, leaf pixels over leaf pixels per leaf |
//! | `low`, `high` | interval of 95 % of the leaves; empty where there are no leaf pixels |
//! | `interval` | what the interval accounts for: `regions`, how well the regions counted by hand agree, or `plot`, how unevenly the plot is covered |

use super::{FileError, csv_table::CsvWriter, output};
use rowgram_plants::phenotype::leaf_count::{Interval, LeafCount};
use std::path::Path;

/// The columns.
pub const COLUMNS: [&str; 6] = ["plot", "pixels", "leaves", "low", "high", "interval"];

/// Writes the leaves of plots.
///
/// # Errors
/// As [`output::write`].
pub fn write(path: &Path, force: bool, plots: &[(&str, &LeafCount)]) -> Result<(), FileError> {
    output::write(path, force, |writer| {
        let mut csv = CsvWriter::new(writer);
        csv.write_record(COLUMNS)?;
        for (plot, count) in plots {
            let end = |value: fn(&Interval) -> f64| {
                count.interval.as_ref().map(|i| format!("{:.3}", value(i))).unwrap_or_default()
            };
            csv.write_record([
                (*plot).to_owned(),
                count.pixels.to_string(),
                format!("{:.3}", count.leaves),
                end(|i| i.low),
                end(|i| i.high),
                count.interval.map(|interval| interval.of.to_string()).unwrap_or_default(),
            ])?;
        }
        csv.flush()
    })
}
