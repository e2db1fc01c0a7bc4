//! Coloured point clouds: PLY for viewers, LAZ with the keys of its coordinate reference system for GIS.

use super::{FileError, geotiff::geo_keys, output};
use rowgram_raster::georeference::{Crs, CrsKind};
use rowgram_survey::scene::ReferenceFrame;
use std::{fs::File, io::BufWriter, path::Path};

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
    let least = |axis: usize| {
        let least = points.iter().map(|p| p.position_m[axis]).fold(f64::INFINITY, f64::min);
        if least.is_finite() { least } else { 0.0 }
    };
    let corner_m = [least(0), least(1), least(2)];
    let crs = crs_of(reference);
    output::write_seekable(path, force, |file| {
        let mut writer = LazWriter::begin(file, path, &crs, corner_m)?;
        points.iter().try_for_each(|point| writer.put(point, 0))?;
        writer.finish()
    })
}

/// What a cloud says of its frame: without scale nothing.
fn crs_of(reference: &ReferenceFrame) -> Crs {
    let kind = if reference.has_scale() { CrsKind::Projected } else { CrsKind::Unknown };
    Crs { kind, ..Crs::from(reference) }
}

/// Metres per unit of the stored integers.
const STEP_M: f64 = 1e-4;

/// LAZ that is written point by point, in the order in which they come.
pub struct LazWriter<'a> {
    path: &'a Path,
    writer: las::Writer<BufWriter<File>>,
}

impl LazWriter<'_> {
    /// Begins a cloud whose points lie within 200 km of `corner_m`, metres; `path` is for messages.
    ///
    /// # Errors
    /// Where the file cannot be written.
    pub fn begin<'a>(
        file: &File,
        path: &'a Path,
        crs: &Crs,
        corner_m: [f64; 3],
    ) -> Result<LazWriter<'a>, FileError> {
        let own = file.try_clone().map_err(|e| FileError::write(path, e))?;
        let writer = header(crs, corner_m)
            .and_then(|header| las::Writer::new(BufWriter::new(own), header))
            .map_err(|e| FileError::write(path, std::io::Error::other(e)))?;
        Ok(LazWriter { path, writer })
    }

    /// Adds a point. The intensity, 0 to 255, says how sure it is.
    ///
    /// # Errors
    /// A point too far away, and where the file cannot be written.
    pub fn put(&mut self, point: &CloudPoint, intensity: u8) -> Result<(), FileError> {
        let [x, y, z] = point.position_m;
        // Eight bits become sixteen as the format recommends.
        let wide = |byte: u8| u16::from(byte) * 257;
        let [red, green, blue] = point.colour.map(wide);
        let point = las::Point {
            x,
            y,
            z,
            intensity: wide(intensity),
            color: Some(las::Color { red, green, blue }),
            ..las::Point::default()
        };
        let path = self.path;
        self.writer.write_point(point).map_err(|e| FileError::write(path, std::io::Error::other(e)))
    }

    /// Completes the file.
    ///
    /// # Errors
    /// Where it cannot be written.
    pub fn finish(mut self) -> Result<(), FileError> {
        let path = self.path;
        self.writer.close().map_err(|e| FileError::write(path, std::io::Error::other(e)))
    }
}

fn header(crs: &Crs, corner_m: [f64; 3]) -> Result<las::Header, las::Error> {
    let mut builder = las::Builder::from((1, 2));
    builder.point_format = las::point::Format::new(2)?;
    builder.point_format.is_compressed = true;
    builder.generating_software = "rowgram".into();
    builder.date = None;
    let axis = |k: usize| las::Transform { scale: STEP_M, offset: corner_m[k].floor() };
    builder.transforms = las::Vector { x: axis(0), y: axis(1), z: axis(2) };
    builder.vlrs.push(las::Vlr {
        user_id: "LASF_Projection".into(),
        record_id: 34735,
        description: "GeoTIFF keys".into(),
        data: geo_keys(crs, None).into_iter().flat_map(u16::to_le_bytes).collect(),
    });
    builder.into_header()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_survey::scene::{HorizontalFrame, LengthUnit, VerticalFrame};

    #[test]
    fn a_cloud_says_its_reference_system_in_every_case() {
        let points = [CloudPoint { position_m: [5e5, 4e6, 100.0], colour: [1, 2, 3] }];
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cloud.laz");
        let keys = |reference: &ReferenceFrame| {
            write_laz(&path, &points, reference, true).unwrap();
            let reader = las::Reader::from_path(&path).unwrap();
            let keys = reader.header().get_geotiff_crs().unwrap().unwrap();
            keys.entries
                .iter()
                .map(|entry| (entry.id, format!("{:?}", entry.data)))
                .collect::<Vec<_>>()
        };
        let zone = ReferenceFrame {
            horizontal: (&rowgram_raster::crs::Crs::from_epsg(32616).unwrap()).into(),
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
