//! Where a raster lies on the map.
//!
//! ```text
//! (x, y) = origin + u per_column + v per_row,
//! ```
//!
//! with `(u, v)` in pixels, the **centre** of the top-left pixel being (0, 0), so `origin` is the map
//! position of that centre. (GeoTIFF and GDAL count from the pixel's corner; the conversion is in
//! [`rowgram_files::geotiff`].)

use crate::crs::{FOOT_M, US_SURVEY_FOOT_M};
use serde::Serialize;

/// What kind of coordinates a map has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CrsKind {
    /// Easting and northing in metres.
    Projected,
    /// The same in international feet.
    #[serde(rename = "projected in feet")]
    Feet,
    /// The same in feet of the US survey.
    #[serde(rename = "projected in US survey feet")]
    SurveyFeet,
    /// Longitude and latitude in degrees.
    Geographic,
    /// Not stated.
    Unknown,
}

impl CrsKind {
    /// Metres in the unit of its coordinates; `None` where they are no lengths.
    pub fn metres_per_unit(self) -> Option<f64> {
        match self {
            CrsKind::Projected => Some(1.0),
            CrsKind::Feet => Some(FOOT_M),
            CrsKind::SurveyFeet => Some(US_SURVEY_FOOT_M),
            CrsKind::Geographic | CrsKind::Unknown => None,
        }
    }
}

/// A coordinate reference system, as far as it is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Crs {
    /// Its code in the EPSG registry, where it has one.
    pub epsg: Option<u32>,
    /// The kind of its coordinates.
    pub kind: CrsKind,
    /// The code in the EPSG registry of what heights are measured from, where that is known.
    pub vertical_epsg: Option<u32>,
}

impl Crs {
    /// A projected one of the registry.
    pub fn projected(epsg: u32) -> Crs {
        Crs { epsg: Some(epsg), kind: CrsKind::Projected, vertical_epsg: None }
    }

    /// Longitude and latitude of the registry.
    pub fn geographic(epsg: u32) -> Crs {
        Crs { epsg: Some(epsg), kind: CrsKind::Geographic, vertical_epsg: None }
    }

    /// Metres in a frame of one's own.
    pub const LOCAL: Crs = Crs { epsg: None, kind: CrsKind::Projected, vertical_epsg: None };
}

/// Where a raster lies on the map.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Georeference {
    /// Map position (x, y) of the centre of the top-left pixel.
    pub origin: [f64; 2],
    /// From a pixel to the next one on the right.
    pub per_column: [f64; 2],
    /// From a pixel to the next one below.
    pub per_row: [f64; 2],
    /// The coordinate reference system of the map.
    pub crs: Crs,
}

impl Georeference {
    /// A raster with north up: the map position of the centre of its top-left pixel, and the size of
    /// its pixels in map units.
    pub fn north_up(origin: [f64; 2], pixel: f64, crs: Crs) -> Georeference {
        Georeference { origin, per_column: [pixel, 0.0], per_row: [0.0, -pixel], crs }
    }

    /// The map position of a pixel position.
    pub fn map(&self, [u, v]: [f64; 2]) -> [f64; 2] {
        std::array::from_fn(|i| self.origin[i] + u * self.per_column[i] + v * self.per_row[i])
    }

    /// The pixel position of a map position; `None` where the raster has no area on the map.
    pub fn pixel(&self, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
        let (dx, dy) = (x - self.origin[0], y - self.origin[1]);
        let ([a, c], [b, d]) = (self.per_column, self.per_row);
        let determinant = a * d - b * c;
        let usable = determinant.is_finite() && determinant != 0.0;
        usable.then(|| [(d * dx - b * dy) / determinant, (a * dy - c * dx) / determinant])
    }

    /// Ground sampling distance: the side of a square as large as a pixel, metres. `None` where the
    /// coordinates of the map are no lengths.
    pub fn gsd_m(&self) -> Option<f64> {
        let ([a, c], [b, d]) = (self.per_column, self.per_row);
        let gsd_m = (a * d - b * c).abs().sqrt() * self.crs.kind.metres_per_unit()?;
        (gsd_m.is_finite() && gsd_m > 0.0).then_some(gsd_m)
    }

    /// The georeference of the same raster with `(u, v)` as its top-left pixel.
    pub fn from_pixel(&self, u: usize, v: usize) -> Georeference {
        Georeference { origin: self.map([u as f64, v as f64]), ..*self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_and_map_positions_are_inverse() {
        let place = Georeference {
            origin: [500_000.0, 4_475_000.0],
            per_column: [0.013, 0.002],
            per_row: [0.002, -0.014],
            crs: Crs::projected(32616),
        };
        for pixel in [[0.0, 0.0], [10.5, -3.25], [4000.0, 3000.0]] {
            let back = place.pixel(place.map(pixel)).unwrap();
            for i in 0..2 {
                // Map coordinates of 4e6 m leave 1e-9 m, and so 1e-7 pixels.
                approx::assert_abs_diff_eq!(back[i], pixel[i], epsilon = 1e-6);
            }
        }
        let gsd_m = (0.013f64 * 0.014 + 0.002 * 0.002).sqrt();
        approx::assert_relative_eq!(place.gsd_m().unwrap(), gsd_m, epsilon = 1e-12);
        for (a, b) in place.from_pixel(3, 4).map([1.0, 1.0]).iter().zip(place.map([4.0, 5.0])) {
            approx::assert_abs_diff_eq!(*a, b, epsilon = 1e-8);
        }
    }

    #[test]
    fn feet_are_feet() {
        // A tenth of a US survey foot.
        let crs = Crs { kind: CrsKind::SurveyFeet, ..Crs::projected(2263) };
        let gsd_m = Georeference::north_up([980_000.0, 190_000.0], 0.1, crs).gsd_m().unwrap();
        approx::assert_relative_eq!(gsd_m, 0.030_480_061, epsilon = 1e-9);
    }

    #[test]
    fn degrees_are_no_ground_sampling_distance() {
        let crs = Crs::geographic(4326);
        assert_eq!(Georeference::north_up([9.0, 48.0], 1e-7, crs).gsd_m(), None);
        let flat = Georeference {
            per_row: [1.0, 0.0],
            ..Georeference::north_up([0.0; 2], 1.0, Crs::LOCAL)
        };
        assert_eq!((flat.gsd_m(), flat.pixel([1.0, 1.0])), (None, None));
    }
}
