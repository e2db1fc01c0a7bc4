//! Points of a cloud as a table: `x_m, y_m, z_m` and, where known, `sigma_z_m`.

use super::{FileError, table::Table};
use rowgram_survey::mapping::dem::SurfacePoint;
use std::path::Path;

/// Reads the points.
///
/// # Errors
/// Names the file, the line and the column.
pub fn read(path: &Path) -> Result<Vec<SurfacePoint>, FileError> {
    let table = Table::with_header(path)?;
    let axes = [
        table.required("the east coordinate", &["x_m", "x", "easting_m"])?,
        table.required("the north coordinate", &["y_m", "y", "northing_m"])?,
        table.required("the height", &["z_m", "z", "height_m"])?,
    ];
    let sigma = table.column(&["sigma_z_m"]);
    let mut points = Vec::with_capacity(table.rows().len());
    for row in table.rows() {
        let mut position_m = [0.0; 3];
        for (value, &axis) in position_m.iter_mut().zip(&axes) {
            *value = table.number(row, axis)?;
        }
        let known = sigma.filter(|&column| !table.text(row, column).is_empty());
        let sigma_z_m = known.map_or(Ok(f64::NAN), |column| table.number(row, column))?;
        points.push(SurfacePoint { position_m, sigma_z_m });
    }
    Ok(points)
}
