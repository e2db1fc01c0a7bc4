//! Coloured point clouds: PLY for viewers, LAZ with a coordinate reference system's extent for GIS.

use super::{FileError, output};
use std::{io::Cursor, path::Path};

/// A point with its colour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CloudPoint {
    /// Metres.
    pub position_m: [f64; 3],
    /// Red, green, blue.
    pub colour: [u8; 3],
}

/// Writes binary PLY with double coordinates.
///
/// # Errors
/// As [`output::write`].
pub fn write_ply(path: &Path, points: &[CloudPoint], force: bool) -> Result<(), FileError> {
    output::write(path, force, |out| {
        write!(
            out,
            "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
            points.len()
        )?;
        for point in points {
            for v in point.position_m {
                out.write_all(&v.to_le_bytes())?;
            }
            out.write_all(&point.colour)?;
        }
        Ok(())
    })
}

/// Writes LAZ (version 1.4, point format 7) with coordinates to a tenth of a millimetre.
///
/// # Errors
/// As [`output::write`], and points so far apart that the format cannot hold them.
pub fn write_laz(path: &Path, points: &[CloudPoint], force: bool) -> Result<(), FileError> {
    let bytes = laz(points).map_err(|e| FileError::write(path, std::io::Error::other(e)))?;
    output::write(path, force, |out| out.write_all(&bytes))
}

/// Metres per unit of the stored integers.
const STEP_M: f64 = 1e-4;

fn laz(points: &[CloudPoint]) -> Result<Vec<u8>, las::Error> {
    let mut builder = las::Builder::from((1, 4));
    builder.point_format = las::point::Format::new(7)?;
    builder.point_format.is_compressed = true;
    builder.generating_software = "rowgram".into();
    builder.date = None;
    let least = |axis: usize| {
        let least = points.iter().map(|p| p.position_m[axis]).fold(f64::INFINITY, f64::min);
        if least.is_finite() { least.floor() } else { 0.0 }
    };
    let axis = |k: usize| las::Transform { scale: STEP_M, offset: least(k) };
    builder.transforms = las::Vector { x: axis(0), y: axis(1), z: axis(2) };
    let mut writer = las::Writer::new(Cursor::new(Vec::new()), builder.into_header()?)?;
    for point in points {
        let [x, y, z] = point.position_m;
        // Eight bits become sixteen as the format recommends.
        let [red, green, blue] = point.colour.map(|c| u16::from(c) * 257);
        writer.write_point(las::Point {
            x,
            y,
            z,
            color: Some(las::Color { red, green, blue }),
            gps_time: Some(0.0),
            ..las::Point::default()
        })?;
    }
    writer.close()?;
    Ok(writer.into_inner()?.into_inner())
}
