//! Coloured point clouds: PLY for viewers, LAZ with the keys of its coordinate reference system for GIS.

use super::{FileError, geotiff::geo_keys, output};
use crate::{
    raster::georeference::{Crs, CrsKind},
    scene::ReferenceFrame,
};
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

/// Writes LAZ (version 1.2, point format 2) with coordinates to a tenth of a millimetre and the keys of their reference
/// system, as GeoTIFF has them.
///
/// # Errors
/// As [`output::write`], and points so far apart that the format cannot hold them.
pub fn write_laz(
    path: &Path,
    points: &[CloudPoint],
    reference: &ReferenceFrame,
    force: bool,
) -> Result<(), FileError> {
    let bytes =
        laz(points, reference).map_err(|e| FileError::write(path, std::io::Error::other(e)))?;
    output::write(path, force, |out| out.write_all(&bytes))
}

/// Metres per unit of the stored integers.
const STEP_M: f64 = 1e-4;

fn laz(points: &[CloudPoint], reference: &ReferenceFrame) -> Result<Vec<u8>, las::Error> {
    let mut builder = las::Builder::from((1, 2));
    builder.point_format = las::point::Format::new(2)?;
    builder.point_format.is_compressed = true;
    builder.generating_software = "rowgram".into();
    builder.date = None;
    let least = |axis: usize| {
        let least = points.iter().map(|p| p.position_m[axis]).fold(f64::INFINITY, f64::min);
        if least.is_finite() { least.floor() } else { 0.0 }
    };
    let axis = |k: usize| las::Transform { scale: STEP_M, offset: least(k) };
    builder.transforms = las::Vector { x: axis(0), y: axis(1), z: axis(2) };
    let kind = if reference.has_scale() { CrsKind::Projected } else { CrsKind::Unknown };
    let crs = Crs { kind, ..Crs::of(reference) };
    builder.vlrs.push(las::Vlr {
        user_id: "LASF_Projection".into(),
        record_id: 34735,
        description: "GeoTIFF keys".into(),
        data: geo_keys(&crs, None).into_iter().flat_map(u16::to_le_bytes).collect(),
    });
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
            ..las::Point::default()
        })?;
    }
    writer.close()?;
    Ok(writer.into_inner()?.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{HorizontalFrame, LengthUnit, VerticalFrame};

    #[test]
    fn a_cloud_says_its_reference_system_in_every_case() {
        let points = [CloudPoint { position_m: [5e5, 4e6, 100.0], colour: [1, 2, 3] }];
        let keys = |reference: &ReferenceFrame| {
            let bytes = laz(&points, reference).unwrap();
            let reader = las::Reader::new(Cursor::new(bytes)).unwrap();
            let keys = reader.header().get_geotiff_crs().unwrap().unwrap();
            keys.entries
                .iter()
                .map(|entry| (entry.id, format!("{:?}", entry.data)))
                .collect::<Vec<_>>()
        };
        let zone = ReferenceFrame {
            horizontal: (&crate::crs::Crs::from_epsg(32616).unwrap()).into(),
            vertical: VerticalFrame::Known { epsg: 5703 },
            unit: LengthUnit::Metre,
        };
        let said = keys(&zone);
        for (key, value) in [(1024, "1"), (3072, "32616"), (4096, "5703"), (4099, "9001")] {
            let found = said.iter().find(|(id, _)| *id == key);
            assert!(found.is_some_and(|(_, data)| data.contains(value)), "{key}: {said:?}");
        }
        let unnamed = ReferenceFrame { horizontal: HorizontalFrame::Unnamed, ..zone };
        let said = keys(&unnamed);
        assert!(said.iter().any(|(id, data)| *id == 3076 && data.contains("9001")), "{said:?}");
        let no_scale = keys(&ReferenceFrame::default());
        assert!(no_scale.iter().all(|(id, _)| ![3072, 3076].contains(id)), "{no_scale:?}");
    }
}
