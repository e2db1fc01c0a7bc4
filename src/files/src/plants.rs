//! What stands in a field, in CSV files: plants, gaps, and the stand count of every row.
//!
//! All have `u_px`, `v_px`, positions in pixels of the raster, the centre of the top-left pixel at (0, 0). Where the raster lies
//! on a map, `easting_m`, `northing_m` (or `longitude_deg`, `latitude_deg`) are the same places there; where only the ground
//! sampling distance is known, `x_m`, `y_m` are metres to the right of that pixel and upwards from it.
//!
//! Plants:
//!
//! | column | |
//! |---|---|
//! | `row` | number of the row, from 1, counted across the rows; empty where there are no rows |
//! | `confidence` | probability that a plant stands within a quarter of the spacing (row model) |
//! | `sigma_along_px`, `sigma_across_px` | standard deviations along and across the row (row model) |
//!
//! Gaps, where plants seem to be missing between two plants of a row: `row`; `length_px`, from plant to plant; `plants`, the
//! most probable number of missing plants; `probability` that any is missing.
//!
//! Rows: `row`; `plants` that were located; `expected` number of plants with the interval of 95 % from `low` to `high`;
//! `length_px`, and `length_m` where the ground sampling distance is known.

use super::{FileError, output, points};
use rowgram_plants::phenotype::{
    locate::{Located, Plant},
    stand::{NORMAL_95, Stalk, Stand, Weed},
};
use rowgram_raster::georeference::{CrsKind, Georeference};
use std::path::Path;

/// Columns of numbers by name.
type Columns = Vec<(&'static str, Vec<f64>)>;

/// What turns pixels into places.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Placement {
    /// Where the raster lies on the map, if it says so.
    pub georeference: Option<Georeference>,
    /// Ground sampling distance, metres, where it is known.
    pub gsd_m: Option<f64>,
}

impl Placement {
    /// The places as columns, as far as they are known.
    fn columns(&self, positions_px: &[[f64; 2]]) -> Columns {
        let kind = self.georeference.map_or(CrsKind::Unknown, |map| map.crs.kind);
        let named = |names: [&'static str; 2], place: &dyn Fn([f64; 2]) -> [f64; 2]| {
            let places: Vec<[f64; 2]> =
                positions_px.iter().map(|&at| kind.rounded(place(at))).collect();
            let axis = |axis: usize| places.iter().map(|at| at[axis]).collect();
            vec![(names[0], axis(0)), (names[1], axis(1))]
        };
        match (self.georeference, self.gsd_m) {
            (Some(map), _) if map.crs.kind == CrsKind::Geographic => {
                named(["longitude_deg", "latitude_deg"], &|at| map.map(at))
            }
            (Some(map), _) if matches!(map.crs.kind, CrsKind::Feet | CrsKind::SurveyFeet) => {
                named(["easting_ft", "northing_ft"], &|at| map.map(at))
            }
            (Some(map), _) if map.crs.kind == CrsKind::Projected => {
                named(["easting_m", "northing_m"], &|at| map.map(at))
            }
            (_, Some(gsd_m)) => named(["x_m", "y_m"], &|[u, v]| [gsd_m * u, -gsd_m * v]),
            _ => Vec::new(),
        }
    }
}

fn write(
    path: &Path,
    force: bool,
    positions_px: &[[f64; 2]],
    mut columns: Columns,
    place: Placement,
) -> Result<(), FileError> {
    let after_row = 1.min(columns.len());
    columns.splice(after_row..after_row, place.columns(positions_px));
    let columns: Vec<(&str, &[f64])> =
        columns.iter().map(|(name, values)| (*name, &values[..])).collect();
    points::write(path, force, positions_px, &columns)
}

/// Writes the plants of the row model; their rows if there are any.
///
/// # Errors
/// As [`points::write`].
pub fn write_plants(
    path: &Path,
    force: bool,
    plants: &[Stalk],
    has_rows: bool,
    place: Placement,
) -> Result<(), FileError> {
    let row = |plant: &Stalk| if has_rows { (plant.row + 1) as f64 } else { f64::NAN };
    let positions: Vec<[f64; 2]> = plants.iter().map(|plant| plant.position_px).collect();
    let columns = vec![
        ("row", plants.iter().map(row).collect()),
        ("confidence", plants.iter().map(|plant| plant.confidence).collect()),
        ("sigma_along_px", plants.iter().map(|plant| plant.sigma_along_px).collect()),
        ("sigma_across_px", plants.iter().map(|plant| plant.sigma_across_px).collect()),
    ];
    write(path, force, &positions, columns, place)
}

/// Writes the plants of a descent: positions and rows.
///
/// # Errors
/// As [`points::write`].
pub fn write_located(
    path: &Path,
    force: bool,
    located: &Located,
    place: Placement,
) -> Result<(), FileError> {
    let positions: Vec<[f64; 2]> = located.plants.iter().map(|p| p.position_px).collect();
    let row = |plant: &Plant| plant.row.map_or(f64::NAN, |row| (row + 1) as f64);
    let columns = vec![("row", located.plants.iter().map(row).collect())];
    write(path, force, &positions, columns, place)
}

/// Writes the gaps: the middle of each, its row, length, missing plants and their probability.
///
/// # Errors
/// As [`points::write`].
pub fn write_gaps(
    path: &Path,
    force: bool,
    stand: &Stand,
    place: Placement,
) -> Result<(), FileError> {
    let gaps = &stand.missing;
    let positions: Vec<[f64; 2]> = gaps.iter().map(|gap| gap.position_px).collect();
    let columns = vec![
        ("row", gaps.iter().map(|gap| (gap.row + 1) as f64).collect()),
        ("length_px", gaps.iter().map(|gap| gap.length_px).collect()),
        ("plants", gaps.iter().map(|gap| gap.plants as f64).collect()),
        ("probability", gaps.iter().map(|gap| gap.probability).collect()),
    ];
    write(path, force, &positions, columns, place)
}

/// Writes the weeds that were left out: the middle of each and its leaf pixels.
///
/// # Errors
/// As [`points::write`].
pub fn write_weeds(
    path: &Path,
    force: bool,
    weeds: &[Weed],
    place: Placement,
) -> Result<(), FileError> {
    let positions: Vec<[f64; 2]> = weeds.iter().map(|weed| weed.position_px).collect();
    let columns = vec![("leaf_px", weeds.iter().map(|weed| weed.leaf_px).collect())];
    write(path, force, &positions, columns, place)
}

/// Columns of the ends of a straight row.
pub const ROW_ENDS: [&str; 4] = ["start_u_px", "start_v_px", "end_u_px", "end_v_px"];

/// Writes the stand count of every row.
///
/// # Errors
/// As [`output::write`].
pub fn write_rows(
    path: &Path,
    force: bool,
    stand: &Stand,
    gsd_m: Option<f64>,
) -> Result<(), FileError> {
    let mut found = vec![0_usize; stand.rows.rows.len()];
    for plant in &stand.plants {
        found.get_mut(plant.row).into_iter().for_each(|count| *count += 1);
    }
    output::write(path, force, |writer| {
        let mut csv = csv::Writer::from_writer(writer);
        let mut header = vec!["row", "plants", "expected", "low", "high", "length_px"];
        header.extend(gsd_m.map(|_| "length_m"));
        header.extend(ROW_ENDS);
        csv.write_record(header)?;
        for (row, line) in stand.rows.rows.iter().enumerate() {
            let (expected, sigma) = (stand.row_counts[row], stand.row_count_sigmas[row]);
            let length_px = line.length_px();
            let numbers = [
                expected,
                (expected - NORMAL_95 * sigma).max(0.0),
                expected + NORMAL_95 * sigma,
                length_px,
            ];
            let mut record = vec![(row + 1).to_string(), found[row].to_string()];
            record.extend(numbers.map(|x| format!("{x:.2}")));
            record.extend(gsd_m.map(|gsd| format!("{:.3}", length_px * gsd)));
            let ends = [line.start_px, line.end_px];
            let ends = ends.map(|along| stand.image([along, line.across_px]));
            record.extend(ends.concat().iter().map(|x| format!("{x:.2}")));
            csv.write_record(record)?;
        }
        csv.flush()
    })
}
