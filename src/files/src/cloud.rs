//! Point clouds: PLY for viewers, LAZ with the keys of its coordinate reference system for GIS; LAS and LAZ of others are read point by
//! point.

use super::{FileError, geotiff::geo_keys, output};
use rowgram_raster::{
    crs,
    georeference::{Crs, CrsKind},
};
use rowgram_survey::scene::ReferenceFrame;
use std::{
    fs::File,
    io::BufWriter,
    path::{Path, PathBuf},
};

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

/// A point of somebody's cloud.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReadPoint {
    /// In the coordinates of its file.
    pub position: [f64; 3],
    /// Red, green, blue, where the cloud has colours.
    pub colour: Option<[u8; 3]>,
    /// Whether it was classified as ground (class 2).
    pub is_ground: bool,
}

/// A LAS or LAZ file that is read point by point.
pub struct CloudReader {
    path: PathBuf,
    reader: las::Reader,
}

impl CloudReader {
    /// Opens a cloud.
    ///
    /// # Errors
    /// A file that cannot be read, is no such cloud, or has no points.
    pub fn open(path: &Path) -> Result<CloudReader, FileError> {
        std::fs::File::open(path).map_err(|error| FileError::read(path, error))?;
        let failed = |error: las::Error| {
            FileError::malformed(path, None, format!("it is no LAS or LAZ file: {error}"))
        };
        let reader = las::Reader::from_path(path).map_err(failed)?;
        if reader.header().number_of_points() == 0 {
            return Err(FileError::malformed(path, None, "it holds no points"));
        }
        Ok(CloudReader { path: path.to_owned(), reader })
    }

    /// Number of points that it says it has.
    pub fn points(&self) -> u64 {
        self.reader.header().number_of_points()
    }

    /// Least and greatest x and y that it says it has.
    pub fn bounds(&self) -> [[f64; 2]; 2] {
        let las::Bounds { min, max } = self.reader.header().bounds();
        [[min.x, max.x], [min.y, max.y]]
    }

    /// The reference system of its coordinates; `None` where it does not say.
    pub fn crs(&self) -> Option<Crs> {
        let header = self.reader.header();
        let text = header.get_wkt_crs_bytes().map(String::from_utf8_lossy);
        if let Some(text) = text {
            let system = crs::Crs::of_well_known_text(text.trim_end_matches('\0')).ok()?;
            return Some(Crs::from(&system));
        }
        let code = u32::from(header.get_geotiff_crs().ok()??.get_projected_crs_geo_key_value()?);
        Some(Crs::from(&crs::Crs::of_code(code).ok()?))
    }

    /// Hands over all points but those that are noise (classes 7 and 18) or withheld.
    ///
    /// # Errors
    /// A file that is damaged.
    pub fn each(&mut self, mut take: impl FnMut(ReadPoint)) -> Result<(), FileError> {
        let mut chunk = Vec::new();
        // Many write eight bits into the sixteen of a colour.
        let mut are_eight_bits = true;
        loop {
            chunk.clear();
            let count = self.reader.read_points_into(CHUNK, &mut chunk).map_err(|error| {
                FileError::malformed(&self.path, None, format!("its points are damaged: {error}"))
            })?;
            if count == 0 {
                return Ok(());
            }
            let all = || chunk.iter().filter_map(|point| point.color);
            are_eight_bits &= all().all(|c| c.red.max(c.green).max(c.blue) < 256);
            for point in &chunk {
                let class = u8::from(point.classification);
                if point.is_withheld || NOISE.contains(&class) {
                    continue;
                }
                let byte = |value: u16| if are_eight_bits { value } else { value >> 8 } as u8;
                let colour = point.color.map(|c| [c.red, c.green, c.blue].map(byte));
                let position = [point.x, point.y, point.z];
                take(ReadPoint { position, colour, is_ground: class == GROUND });
            }
        }
    }
}

/// Classes of the ASPRS: ground; low and high noise.
const GROUND: u8 = 2;
const NOISE: [u8; 2] = [7, 18];
/// Points that are decoded together.
const CHUNK: u64 = 100_000;

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
