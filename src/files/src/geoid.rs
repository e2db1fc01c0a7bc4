//! Heights of the geoid over the ellipsoid, on a grid of latitudes and longitudes.
//!
//! ```text
//! H = h - N(latitude, longitude)
//! ```
//!
//! with `h` over the ellipsoid, `H` over the geoid (about the sea), and `N` linear between the nodes of the grid, all in metres. Grids are
//! GTX of NOAA (big-endian: south, west, steps in degrees, rows, columns, then rows of `f32` from south to north) or GeoTIFF in degrees,
//! as the PROJ project hands them out.

use super::{FileError, geotiff::Reader, memory};
use rowgram_raster::{
    georeference::{CrsKind, Georeference},
    window::Window,
};
use std::path::Path;

/// A grid of geoid heights.
#[derive(Debug, Clone, PartialEq)]
pub struct Geoid {
    /// Of nodes: column and row from longitude and latitude.
    place: Georeference,
    size: [usize; 2],
    height_m: Vec<f32>,
}

/// Bytes before the heights of a GTX file.
const GTX_HEAD: usize = 40;
/// What stands for no height there.
const GTX_NONE: f32 = -88.8888;

impl Geoid {
    /// Reads a grid.
    ///
    /// # Errors
    /// A file that cannot be read, is neither of the two, or is not in degrees.
    pub fn read(path: &Path) -> Result<Geoid, FileError> {
        let is_gtx = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("gtx"));
        if is_gtx {
            let bytes = memory::read_file(path)?;
            return gtx(&bytes).ok_or_else(|| {
                let message = "it is no GTX grid: expected 40 bytes of head and 4 for each node";
                FileError::malformed(path, None, message)
            });
        }
        let reader = Reader::open(path)?;
        let place = reader.georeference().filter(|place| place.crs.kind == CrsKind::Geographic);
        let Some(place) = place else {
            let message =
                "expected geoid heights in longitude and latitude (GTX, or GeoTIFF in degrees)";
            return Err(FileError::malformed(path, None, message));
        };
        let size = [reader.width(), reader.height()];
        let bytes = 4 * size[0] as u64 * size[1] as u64;
        memory::require(path, "the grid of the geoid", bytes)?;
        let height_m = reader.read_f32(Window::whole(size[0], size[1]))?;
        Ok(Geoid { place, size, height_m })
    }

    /// Height of the geoid over the ellipsoid, metres; `None` beyond the grid.
    pub fn at_m(&self, [latitude_deg, longitude_deg]: [f64; 2]) -> Option<f64> {
        // Grids count from -180 or from 0 degrees.
        let turns = [0.0, 360.0, -360.0];
        turns.into_iter().find_map(|turn| self.between([longitude_deg + turn, latitude_deg]))
    }

    fn between(&self, at: [f64; 2]) -> Option<f64> {
        let at = self.place.pixel(at)?;
        let inside = |k: usize| at[k] >= 0.0 && at[k] <= self.size[k] as f64 - 1.0;
        if !(inside(0) && inside(1)) {
            return None;
        }
        let low = [0, 1].map(|k| at[k] as usize);
        let next = [0, 1].map(|k| (low[k] + 1).min(self.size[k] - 1));
        let [s, t] = [0, 1].map(|k| at[k] - low[k] as f64);
        let node = |u: usize, v: usize| f64::from(self.height_m[v * self.size[0] + u]);
        let line = |v: usize| node(low[0], v) * (1.0 - s) + node(next[0], v) * s;
        let height_m = line(low[1]) * (1.0 - t) + line(next[1]) * t;
        height_m.is_finite().then_some(height_m)
    }
}

fn gtx(bytes: &[u8]) -> Option<Geoid> {
    let (head, rest) = bytes.split_at_checked(GTX_HEAD)?;
    let number = |k: usize| Some(f64::from_be_bytes(head.get(8 * k..8 * k + 8)?.try_into().ok()?));
    let count = |k: usize| -> Option<usize> {
        let bytes = head.get(32 + 4 * k..36 + 4 * k)?.try_into().ok()?;
        usize::try_from(i32::from_be_bytes(bytes)).ok().filter(|n| *n > 0)
    };
    let [south, west, per_row, per_column] = [number(0)?, number(1)?, number(2)?, number(3)?];
    let [rows, columns] = [count(0)?, count(1)?];
    let (values, odd) = rest.as_chunks::<4>();
    let is_grid = [south, west].iter().all(|x| x.is_finite()) && per_row > 0.0 && per_column > 0.0;
    if !is_grid || !odd.is_empty() || Some(values.len()) != rows.checked_mul(columns) {
        return None;
    }
    let height = |bytes: &[u8; 4]| {
        let value = f32::from_be_bytes(*bytes);
        if (value - GTX_NONE).abs() < 1e-3 { f32::NAN } else { value }
    };
    let place = Georeference {
        origin: [west, south],
        per_column: [per_column, 0.0],
        per_row: [0.0, per_row],
        crs: rowgram_raster::georeference::Crs::geographic(4326),
    };
    Some(Geoid { place, size: [columns, rows], height_m: values.iter().map(height).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Nodes of a degree, 10 to 12 north and 350 to 353 east; the height is longitude + 10 latitude.
    fn example() -> Vec<u8> {
        let mut bytes: Vec<u8> =
            [10.0, 350.0, 1.0, 1.0].iter().flat_map(|x: &f64| x.to_be_bytes()).collect();
        bytes.extend([3i32, 4].iter().flat_map(|n| n.to_be_bytes()));
        for row in 0..3 {
            let of = |column: i32| (350 + column + 10 * (10 + row)) as f32;
            bytes.extend((0..4).flat_map(|column| of(column).to_be_bytes()));
        }
        bytes
    }

    #[test]
    fn heights_are_linear_between_nodes_whichever_way_longitudes_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("grid.gtx");
        std::fs::write(&path, example()).unwrap();
        let geoid = Geoid::read(&path).unwrap();
        for (at, expected) in [
            ([10.0, 350.0], Some(450.0)),
            ([11.25, 351.5], Some(464.0)),
            ([11.25, -8.5], Some(464.0)),
            ([12.0, 353.0], Some(473.0)),
            ([12.5, 351.0], None),
            ([11.0, 20.0], None),
        ] {
            assert_eq!(geoid.at_m(at), expected, "{at:?}");
        }
    }

    #[test]
    fn what_is_no_grid_is_refused() {
        let mut short = example();
        short.pop();
        let mut many = example();
        many[32..36].copy_from_slice(&i32::MAX.to_be_bytes());
        for bytes in [short, many, vec![0; 40], b"not a grid".to_vec()] {
            assert!(gtx(&bytes).is_none(), "{} bytes", bytes.len());
        }
    }
}
