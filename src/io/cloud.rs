//! Coloured point clouds: PLY for viewers, LAZ with a coordinate reference system's extent for GIS.

use super::{FileError, output};
use crate::scene::ReferenceFrame;
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

/// Writes LAZ (version 1.4, point format 7) with coordinates to a tenth of a millimetre and a record of their reference
/// system, OGC well-known text as the EPSG registry gives it (of either edition; what is built on PROJ reads both).
///
/// # Errors
/// As [`output::write`], and points so far apart that the format cannot hold them.
pub fn write_laz(
    path: &Path,
    points: &[CloudPoint],
    reference: &ReferenceFrame,
    force: bool,
) -> Result<(), FileError> {
    let bytes = laz(points, &reference.well_known_text())
        .map_err(|e| FileError::write(path, std::io::Error::other(e)))?;
    output::write(path, force, |out| out.write_all(&bytes))
}

/// Metres per unit of the stored integers.
const STEP_M: f64 = 1e-4;

fn laz(points: &[CloudPoint], well_known_text: &str) -> Result<Vec<u8>, las::Error> {
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
    let mut header = builder.into_header()?;
    // The record is a string of C.
    header.set_wkt_crs(format!("{well_known_text}\0").into_bytes())?;
    let mut writer = las::Writer::new(Cursor::new(Vec::new()), header)?;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{HorizontalFrame, LengthUnit};

    #[test]
    fn a_cloud_says_its_reference_system_in_every_case() {
        let points = [CloudPoint { position_m: [5e5, 4e6, 100.0], colour: [1, 2, 3] }];
        let record = |reference: &ReferenceFrame| {
            let bytes = laz(&points, &reference.well_known_text()).unwrap();
            let reader = las::Reader::new(Cursor::new(bytes)).unwrap();
            let header = reader.header();
            assert!(header.has_wkt_crs());
            String::from_utf8(header.get_wkt_crs_bytes().unwrap().to_vec()).unwrap()
        };
        let zone = ReferenceFrame {
            horizontal: (&crate::crs::Crs::from_epsg(32616).unwrap()).into(),
            unit: LengthUnit::Metre,
            ..ReferenceFrame::default()
        };
        let text = record(&zone);
        assert!(
            text.starts_with("PROJ")
                && text.contains("[\"WGS 84 / UTM zone 16N\"")
                && text.contains("32616")
                && text.ends_with("]\0"),
            "{text}"
        );
        let unnamed = ReferenceFrame { horizontal: HorizontalFrame::Unnamed, ..zone };
        assert!(record(&unnamed).contains("UNIT[\"metre\",1]"));
        assert!(record(&ReferenceFrame::default()).contains("UNIT[\"unknown\",1]"));
    }
}
