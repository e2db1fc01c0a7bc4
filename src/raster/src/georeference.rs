//! Where a raster lies on the map.
//!
//! ```text
//! (x, y) = origin + u per_column + v per_row,
//! ```
//!
//! with `(u, v)` in pixels, the **centre** of the top-left pixel being (0, 0), so `origin` is the map
//! position of that centre. (GeoTIFF and GDAL count from the pixel's corner; the conversion is in
//! `geotiff` of `rowgram-files`.)

use crate::crs::{self, FOOT_M, US_SURVEY_FOOT_M};
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
    /// That of a system; unknown where its unit is another.
    pub fn of(system: &crs::Crs) -> CrsKind {
        if system.is_geographic() {
            return CrsKind::Geographic;
        }
        let all = [CrsKind::Projected, CrsKind::Feet, CrsKind::SurveyFeet];
        // The two feet differ by two millionths.
        let same = |kind: &CrsKind| {
            let unit = kind.metres_per_unit();
            unit.is_some_and(|of| (of / system.metres_per_unit() - 1.0).abs() < 1e-7)
        };
        all.into_iter().find(same).unwrap_or(CrsKind::Unknown)
    }

    /// Metres in the unit of its coordinates; `None` where they are no lengths.
    pub fn metres_per_unit(self) -> Option<f64> {
        match self {
            CrsKind::Projected => Some(1.0),
            CrsKind::Feet => Some(FOOT_M),
            CrsKind::SurveyFeet => Some(US_SURVEY_FOOT_M),
            CrsKind::Geographic | CrsKind::Unknown => None,
        }
    }

    /// A position as files have it: to a tenth of a millimetre, also in degrees.
    pub fn rounded(self, at: [f64; 2]) -> [f64; 2] {
        let unit = if self == CrsKind::Geographic { 1e9 } else { 1e4 };
        at.map(|x| (x * unit).round() / unit)
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
    /// The PROJ string of one that has no code.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub definition: Option<&'static str>,
}

impl Crs {
    /// A projected one of the registry.
    pub fn projected(epsg: u32) -> Crs {
        Crs { epsg: Some(epsg), kind: CrsKind::Projected, vertical_epsg: None, definition: None }
    }

    /// Longitude and latitude of the registry.
    pub fn geographic(epsg: u32) -> Crs {
        Crs { epsg: Some(epsg), kind: CrsKind::Geographic, vertical_epsg: None, definition: None }
    }

    /// The system itself, where it is known.
    pub fn system(&self) -> Option<crs::Crs> {
        match (self.definition, self.epsg) {
            (Some(definition), _) => crs::Crs::of_definition(definition).ok(),
            (None, code) => crs::Crs::of_code(code?).ok(),
        }
    }

    /// Metres in a frame of one's own.
    pub const LOCAL: Crs =
        Crs { epsg: None, kind: CrsKind::Projected, vertical_epsg: None, definition: None };
}

/// By its code where it has one, else by its PROJ string.
impl From<&crs::Crs> for Crs {
    fn from(system: &crs::Crs) -> Crs {
        let epsg = system.epsg();
        let definition = epsg.is_none().then(|| crs::lasting(system.definition()));
        Crs { epsg, kind: CrsKind::of(system), vertical_epsg: None, definition }
    }
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

    /// Metres on the ground, east and north, from the first pixel to the next one on the right and to the next one below;
    /// `None` where the coordinates of the map are no lengths or the place is not known.
    ///
    /// Through the Jacobian of the projection at that place, so that they are lengths in any reference system: in degrees,
    /// feet, and projections whose scale is not 1.
    pub fn ground_m_per_pixel(&self) -> Option<[[f64; 2]; 2]> {
        let unit = self.crs.kind.metres_per_unit();
        let level = unit.map(|unit| [[unit, 0.0], [0.0, unit]]);
        let system = self.crs.system();
        let true_scale = system.and_then(|system| system.ground_m_per_unit(self.origin).ok());
        let [east, north] = match (true_scale, level) {
            (Some(ground), Some(level)) if is_survey_grid(&ground, level[0][0]) => level,
            (Some(ground), _) => ground,
            (None, level) => level?,
        };
        let step = |[x, y]: [f64; 2]| [0, 1].map(|k| x * east[k] + y * north[k]);
        let ground = [step(self.per_column), step(self.per_row)];
        let area = ground[0][0] * ground[1][1] - ground[0][1] * ground[1][0];
        (area.is_finite() && area != 0.0).then_some(ground)
    }

    /// Width and height of a pixel on the ground, metres.
    pub fn pixel_m(&self) -> Option<[f64; 2]> {
        Some(self.ground_m_per_pixel()?.map(|[x, y]| x.hypot(y)))
    }

    /// By how much the corner of a pixel on the ground is off a right angle, radians.
    pub fn shear_rad(&self) -> Option<f64> {
        let [a, b] = self.ground_m_per_pixel()?;
        let cos = (a[0] * b[0] + a[1] * b[1]) / (a[0].hypot(a[1]) * b[0].hypot(b[1]));
        Some(cos.clamp(-1.0, 1.0).asin().abs())
    }

    /// Metres on the ground for a metre of the map, about 1 in grids made for surveys; `None` where the coordinates are no
    /// lengths.
    pub fn map_scale(&self) -> Option<f64> {
        let ([a, c], [b, d]) = (self.per_column, self.per_row);
        let on_map_m = (a * d - b * c).abs().sqrt() * self.crs.kind.metres_per_unit()?;
        Some(self.gsd_m()? / on_map_m)
    }

    /// Ground sampling distance: the side of a square as large as a pixel on the ground, metres. `None` where the
    /// coordinates of the map are no lengths.
    pub fn gsd_m(&self) -> Option<f64> {
        let [[a, c], [b, d]] = self.ground_m_per_pixel()?;
        Some((a * d - b * c).abs().sqrt())
    }

    /// The georeference of the same raster with `(u, v)` as its top-left pixel.
    pub fn from_pixel(&self, u: usize, v: usize) -> Georeference {
        Georeference { origin: self.map([u as f64, v as f64]), ..*self }
    }
}

/// From positions on one map to those on another.
pub struct Transfer(Option<[crs::Crs; 2]>);

impl Transfer {
    /// Through longitude and latitude where the two systems differ and both are known; else positions are the same.
    pub fn between(from: &Crs, to: &Crs) -> Transfer {
        let is_same = (from.epsg, from.definition) == (to.epsg, to.definition);
        let both = || from.system().zip(to.system()).map(|(from, to)| [from, to]);
        Transfer(if is_same { None } else { both() })
    }

    /// A position; `None` where the other map does not reach.
    pub fn at(&self, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
        let Some([from, to]) = &self.0 else { return Some([x, y]) };
        let [latitude, longitude] = from.to_wgs84(x, y).ok()?;
        to.from_wgs84(latitude, longitude).ok()
    }
}

/// Largest difference of the scale of a grid from 1 that surveys live with: UTM stays within it in its zone, state planes and
/// national grids too. Lengths there are those of the grid, as surveyors quote them.
const SURVEY_SCALE: f64 = 1e-3;

/// Whether a unit along each coordinate is so many metres on the ground, to [`SURVEY_SCALE`], and coordinates are at right angles.
fn is_survey_grid(ground: &[[f64; 2]; 2], unit_m: f64) -> bool {
    let [[a, c], [b, d]] = ground.map(|of| of.map(|x| x / unit_m));
    // Grids are turned against north; what counts is the metric.
    let metric = [a * a + c * c, b * b + d * d];
    metric.iter().all(|square| (square.sqrt() - 1.0).abs() < SURVEY_SCALE)
        && (a * b + c * d).abs() < 2.0 * SURVEY_SCALE
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
    fn positions_keep_a_tenth_of_a_millimetre_also_in_degrees() {
        let at = [9.123_456_789_4, 48.2];
        assert_eq!(CrsKind::Geographic.rounded(at), [9.123_456_789, 48.2]);
        assert_eq!(CrsKind::Projected.rounded(at), [9.123_5, 48.2]);
    }

    #[test]
    fn feet_are_feet() {
        // A tenth of a US survey foot.
        let crs = Crs { kind: CrsKind::SurveyFeet, ..Crs::projected(2263) };
        let gsd_m = Georeference::north_up([980_000.0, 190_000.0], 0.1, crs).gsd_m().unwrap();
        approx::assert_relative_eq!(gsd_m, 0.030_480_061, epsilon = 1e-9);
    }

    #[test]
    fn lengths_are_those_on_the_ground() {
        // Web Mercator at 45 degrees: a metre of the map is 0.708 m; both axes the same.
        let web = crs::Crs::of_code(3857).unwrap();
        let at = web.from_wgs84(45.0, 9.0).unwrap();
        let place = Georeference::north_up(at, 0.0141421, Crs::projected(3857));
        let [width, height] = place.pixel_m().unwrap();
        approx::assert_relative_eq!(width, 0.0141421 * 0.708_291, max_relative = 1e-3);
        approx::assert_relative_eq!(width, height, max_relative = 5e-3);
        // Degrees at 60 degrees: pixels half as wide as high (WGS84: 55,800.0 m and 111,412.2 m a degree).
        let place = Georeference::north_up([9.0, 60.0], 1e-7, Crs::geographic(4326));
        let [width, height] = place.pixel_m().unwrap();
        approx::assert_relative_eq!(width, 0.005_580_00, max_relative = 1e-5);
        approx::assert_relative_eq!(height, 0.011_141_22, max_relative = 1e-5);
        // A zone of UTM is a grid of metres, its neighbour's numbers are not.
        let utm = crs::Crs::of_code(32632).unwrap();
        let place =
            Georeference::north_up(utm.from_wgs84(48.0, 9.0).unwrap(), 0.01, Crs::projected(32632));
        assert_eq!(place.gsd_m(), Some(0.01));
        let far = Georeference::north_up(
            utm.from_wgs84(48.0, 21.0).unwrap(),
            0.01,
            Crs::projected(32632),
        );
        assert!(far.map_scale().unwrap() < 0.995, "{far:?}");
        // Turned pixels have the same size.
        let (sin, cos) = 0.3f64.sin_cos();
        let turned = Georeference {
            per_column: [0.02 * cos, 0.02 * sin],
            per_row: [0.04 * sin, -0.04 * cos],
            ..place
        };
        let [width, height] = turned.pixel_m().unwrap();
        approx::assert_relative_eq!(width, 0.02, max_relative = 1e-9);
        approx::assert_relative_eq!(height, 0.04, max_relative = 1e-9);
        assert!(turned.shear_rad().unwrap() < 1e-9);
    }

    #[test]
    fn positions_go_to_another_map_and_back() {
        let [zone, next] = [32632, 32633].map(Crs::projected);
        let there = Transfer::between(&zone, &next).at([700_000.0, 5_300_000.0]).unwrap();
        assert!(there[0] < 300_000.0, "{there:?}");
        let back = Transfer::between(&next, &zone).at(there).unwrap();
        assert!((back[0] - 700_000.0).abs() < 1e-3 && (back[1] - 5_300_000.0).abs() < 1e-3);
        let same = Transfer::between(&zone, &Crs::LOCAL).at([1.5, 2.5]);
        assert_eq!(
            same,
            Some([1.5, 2.5]),
            "a map that does not say its system is taken for the same"
        );
    }

    #[test]
    fn what_has_no_lengths_has_no_ground_sampling_distance() {
        let nowhere = Crs { kind: CrsKind::Unknown, ..Crs::LOCAL };
        assert_eq!(Georeference::north_up([9.0, 48.0], 1e-7, nowhere).gsd_m(), None);
        let flat = Georeference {
            per_row: [1.0, 0.0],
            ..Georeference::north_up([0.0; 2], 1.0, Crs::LOCAL)
        };
        assert_eq!((flat.gsd_m(), flat.pixel([1.0, 1.0])), (None, None));
    }
}
