//! Coordinate reference systems: from the latitude and longitude of a receiver to the plane of a map.
//!
//! A system is named by its EPSG code, a PROJ string or well-known text; its parameters come from `crs-definitions` and
//! `proj4wkt`, the projections from `proj4rs`. A datum shift is the one of the definition, three or seven parameters:
//! for EPSG:27700 (British national grid) that is good to about 5 m absolute, and within a flight
//! what is off is the same for all photos.
//!
//! **Heights pass through unchanged**: a receiver's are above the ellipsoid or, in most consumer
//! cameras, above some geoid; a grid's above its own vertical datum. What is between the two is found
//! from the block where there is control, and named.

mod datum;
mod well_known_text;

pub use datum::{is_global, knows_datum};

use proj4rs::{proj::Proj, transform::transform};
use std::{
    collections::BTreeSet,
    sync::{Mutex, PoisonError},
};

/// The international foot, metres.
pub const FOOT_M: f64 = 0.3048;
/// The foot of the US survey, metres.
pub const US_SURVEY_FOOT_M: f64 = 1200.0 / 3937.0;

/// Why a reference system cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct CrsError(pub String);

/// A coordinate reference system: a projected one, or longitude and latitude in degrees.
pub struct Crs {
    name: String,
    definition: String,
    grid: Proj,
    geographic: Proj,
    is_geographic: bool,
}

impl std::fmt::Debug for Crs {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Crs({}, {})", self.name, self.definition)
    }
}

/// The code of a UTM zone in words: `WGS84 UTM 16N`, `WGS 84 / UTM zone 16N`, `UTM 16T`, where the letter is that of the
/// hemisphere or of the band of latitude (C to M are south of the equator). `S` alone is the southern hemisphere, as in
/// the headers of control point lists.
fn utm_code(words: &str) -> Option<u32> {
    let upper = words.to_ascii_uppercase();
    let (datum, zone) = upper.split_once("UTM")?;
    let datum: String = datum.chars().filter(char::is_ascii_alphanumeric).collect();
    let zone = zone.trim().trim_start_matches("ZONE").trim();
    let digits = zone.len() - zone.trim_start_matches(|c: char| c.is_ascii_digit()).len();
    let (number, letter) = zone.split_at(digits);
    let number = number.parse::<u32>().ok().filter(|zone| (1..=60).contains(zone))?;
    let south = match letter.trim() {
        "" => false,
        "S" => true,
        letter if letter.len() == 1 => match letter.as_bytes()[0] {
            b'C'..=b'M' => true,
            b'N'..=b'X' => false,
            _ => return None,
        },
        _ => return None,
    };
    match (datum.as_str(), south) {
        ("" | "WGS84" | "WGS1984", false) => Some(32600 + number),
        ("" | "WGS84" | "WGS1984", true) => Some(32700 + number),
        ("ETRS89", false) if (28..=38).contains(&number) => Some(25800 + number),
        ("NAD83", false) if number <= 23 => Some(26900 + number),
        _ => None,
    }
}

const WGS84: &str = "+proj=longlat +datum=WGS84 +no_defs";

impl Crs {
    /// The system of an EPSG code, in metres.
    ///
    /// # Errors
    /// As [`Crs::of_code`], and a code that is geographic or not in metres.
    pub fn from_epsg(code: u32) -> Result<Crs, CrsError> {
        Crs::of_code(code)?.in_metres()
    }

    /// The system of an EPSG code, whatever its unit.
    ///
    /// # Errors
    /// A code that is unknown, or of a projection that is not there.
    pub fn of_code(code: u32) -> Result<Crs, CrsError> {
        let unknown =
            || CrsError(format!("EPSG:{code} is not a known coordinate reference system"));
        let short = u16::try_from(code).map_err(|_| unknown())?;
        let found = crs_definitions::from_code(short).ok_or_else(unknown)?;
        let mut definition = found.proj4.to_owned();
        if !knows_datum(&definition)
            && let Some((_, shift)) = datum::SHIFTS.iter().find(|(codes, _)| codes.contains(&code))
        {
            definition = definition.replace(" +units=", &format!(" +towgs84={shift} +units="));
        }
        Crs::new(&format!("EPSG:{code}"), &definition)
    }

    /// The system of a PROJ string, whatever its unit.
    ///
    /// # Errors
    /// A text that is no such string, or names a projection that is not there.
    pub fn of_definition(definition: &str) -> Result<Crs, CrsError> {
        Crs::new(definition, definition)
    }

    /// The system that well-known text (as in a `.prj` file) describes, whatever its unit.
    ///
    /// # Errors
    /// A text that cannot be read, or names a projection that is not there.
    pub fn of_well_known_text(text: &str) -> Result<Crs, CrsError> {
        let text = well_known_text::in_plan(text);
        if let Some(code) = well_known_text::code(text).or_else(|| code_of_zone(text))
            && let Ok(known) = Crs::of_code(code)
        {
            return Ok(known);
        }
        let name = text.split('"').nth(1).unwrap_or("the system").to_owned();
        let refuse = |what: String| CrsError(format!("{name} cannot be used: {what}"));
        // Esri names the spherical Mercator projection in a way of its own.
        let is_web_mercator = text.contains("Mercator_Auxiliary_Sphere");
        if is_web_mercator {
            return Crs::of_code(3857);
        }
        // Esri has one name for Lambert's conic, with one parallel of true scale or with two.
        let parallels = if text.contains("Standard_Parallel_2") { "_2SP" } else { "_1SP" };
        let text = text.replace(
            "\"Lambert_Conformal_Conic\"",
            &format!("\"Lambert_Conformal_Conic{parallels}\""),
        );
        let definition = proj4wkt::wkt_to_projstring(&text).map_err(|e| refuse(e.to_string()))?;
        Crs::new(&name, &definition)
    }

    /// The same, where its unit is the metre.
    fn in_metres(self) -> Result<Crs, CrsError> {
        let refuse = |what: &str| Err(CrsError(format!("{} cannot be used: {what}", self.name)));
        if self.is_geographic {
            return refuse("it is geographic (degrees); a projected one in metres is needed");
        }
        if (self.metres_per_unit() - 1.0).abs() > 1e-12 {
            return refuse("its unit is not the metre");
        }
        Ok(self)
    }

    /// Whether its coordinates are longitude and latitude, degrees.
    pub fn is_geographic(&self) -> bool {
        self.is_geographic
    }

    /// Metres in the unit of its coordinates; radians are not asked for.
    pub fn metres_per_unit(&self) -> f64 {
        self.grid.to_meter()
    }

    /// Metres on the ground, east and north, for one unit of each coordinate at a place: the columns of the Jacobian of
    /// the way from the map to the ground.
    ///
    /// # Errors
    /// A place that the projection cannot invert.
    pub fn ground_m_per_unit(&self, [x, y]: [f64; 2]) -> Result<[[f64; 2]; 2], CrsError> {
        let step = if self.is_geographic { STEP_DEG } else { STEP_M / self.metres_per_unit() };
        let column = |dx: f64, dy: f64| {
            let [after, before] =
                [1.0, -1.0].map(|sign| self.own_degrees(x + sign * dx, y + sign * dy));
            let (after, before) = (after?, before?);
            // Halves of the difference, so that nothing is lost where longitudes pass 180 degrees.
            let [mut lon, lat] = [0, 1].map(|axis| after[axis] - before[axis]);
            lon -= 360.0 * (lon / 360.0).round();
            let (per_lat_m, per_lon_m) = metres_per_degree(0.5 * (after[1] + before[1]));
            Ok([lon * per_lon_m / (2.0 * step), lat * per_lat_m / (2.0 * step)])
        };
        Ok([column(step, 0.0)?, column(0.0, step)?])
    }

    /// Longitude and latitude on its own datum, degrees.
    fn own_degrees(&self, x: f64, y: f64) -> Result<[f64; 2], CrsError> {
        if self.is_geographic {
            return Ok([x, y]);
        }
        // A datum moves places by metres and keeps lengths.
        let own: Vec<&str> = (self.definition.split_whitespace())
            .filter(|word| {
                ["+ellps=", "+a=", "+b=", "+rf=", "+R="].iter().any(|key| word.starts_with(key))
            })
            .collect();
        let plain =
            |text: String| Proj::from_proj_string(&text).map_err(|e| CrsError(e.to_string()));
        let words = self.definition.split_whitespace().filter(|word| {
            !["+datum=", "+towgs84=", "+nadgrids="].iter().any(|key| word.starts_with(key))
        });
        let ellipsoid = match own[..] {
            [] => "+ellps=WGS84".to_owned(),
            _ => own.join(" "),
        };
        let extra = if own.is_empty() { " +ellps=WGS84" } else { "" };
        let grid = plain(words.collect::<Vec<_>>().join(" ") + extra)?;
        let degrees = plain(format!("+proj=longlat {ellipsoid} +no_defs"))?;
        let mut place = (x, y, 0.0);
        transform(&grid, &degrees, &mut place)
            .map_err(|e| CrsError(format!("{x}, {y} is not a place in {}: {e}", self.name)))?;
        let [lon, lat] = [place.0, place.1].map(f64::to_degrees);
        if !(lon.is_finite() && lat.is_finite()) {
            return Err(CrsError(format!("{x}, {y} is not a place in {}", self.name)));
        }
        Ok([lon, lat])
    }

    /// Whether its datum is that of receivers ([`is_global`]).
    pub fn is_global(&self) -> bool {
        is_global(&self.definition)
    }

    /// Whether its definition says how its datum lies to WGS84; where it does not, places come out up to
    /// some hundred metres off, all by nearly the same.
    pub fn knows_datum(&self) -> bool {
        knows_datum(&self.definition)
    }

    /// The system in metres that words name, as in [`Crs::of_words`].
    ///
    /// # Errors
    /// As [`Crs::of_words`], and a system that is geographic or not in metres.
    pub fn from_words(words: &str) -> Result<Crs, CrsError> {
        Crs::of_words(words)?.in_metres()
    }

    /// The system that words name, whatever its unit: `EPSG:32611`, `32611`, a PROJ string, well-known text, or `WGS84 UTM 11N` or `11T`
    /// and `WGS84` as in the headers of control point lists.
    ///
    /// # Errors
    /// As [`Crs::of_code`], and words that are none of these.
    pub fn of_words(words: &str) -> Result<Crs, CrsError> {
        let words = words.trim();
        let code = match words.split_at_checked(5) {
            Some((begin, rest)) if begin.eq_ignore_ascii_case("EPSG:") => {
                rest.trim_start_matches(':')
            }
            _ => words,
        };
        // Of a compound one (`EPSG:32616+5703`) the first is in plan.
        let code = match code.split_once('+') {
            Some((plan, height)) if height.trim().parse::<u32>().is_ok() => plan,
            _ => code,
        };
        if let Ok(code) = code.trim().parse::<u32>() {
            return Crs::of_code(code);
        }
        let lower = words.to_ascii_lowercase();
        if lower.starts_with("+proj") {
            return Crs::of_definition(words);
        }
        if words.contains('[') {
            return Crs::of_well_known_text(words);
        }
        if let Some(code) = utm_code(words) {
            return Crs::of_code(code);
        }
        if ["wgs84", "wgs 84", "wgs84 latlon", "wgs84 lat/lon"].contains(&lower.as_str()) {
            return Crs::of_code(4326);
        }
        Err(CrsError(format!(
            "{words:?} names no coordinate reference system; expected EPSG:<code>, a PROJ string or WGS84 UTM <zone>N"
        )))
    }

    fn new(name: &str, definition: &str) -> Result<Crs, CrsError> {
        let refuse = |what: String| CrsError(format!("{name} cannot be used: {what}"));
        let of = |text: &str| Proj::from_proj_string(text).map_err(|e| refuse(e.to_string()));
        let grid = of(definition)?;
        Ok(Crs {
            name: name.to_owned(),
            definition: definition.to_owned(),
            is_geographic: grid.is_latlong(),
            grid,
            geographic: of(WGS84)?,
        })
    }

    /// The UTM zone on WGS84 of a place.
    ///
    /// # Errors
    /// Where there is none.
    pub fn utm_of(latitude_deg: f64, longitude_deg: f64) -> Result<Crs, CrsError> {
        let zone = ((longitude_deg + 180.0) / 6.0).floor().clamp(0.0, 59.0) as u32 + 1;
        Crs::from_epsg(if latitude_deg < 0.0 { 32700 } else { 32600 } + zone)
    }

    /// Its name as it was given, `EPSG:27700`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its code in the EPSG registry, where it has one.
    pub fn epsg(&self) -> Option<u32> {
        self.name.strip_prefix("EPSG:").and_then(|code| code.parse().ok())
    }

    /// Its PROJ string.
    pub fn definition(&self) -> &str {
        &self.definition
    }

    /// Easting and northing (or longitude and latitude, degrees), in its unit, of a place on WGS84, degrees.
    ///
    /// # Errors
    /// A place that the projection does not reach.
    pub fn from_wgs84(&self, latitude_deg: f64, longitude_deg: f64) -> Result<[f64; 2], CrsError> {
        let mut place = (longitude_deg.to_radians(), latitude_deg.to_radians(), 0.0);
        transform(&self.geographic, &self.grid, &mut place)
            .map_err(|e| self.out_of_reach(latitude_deg, longitude_deg, &e.to_string()))?;
        if !(place.0.is_finite() && place.1.is_finite()) {
            return Err(self.out_of_reach(latitude_deg, longitude_deg, "not finite"));
        }
        Ok(if self.is_geographic {
            [place.0.to_degrees(), place.1.to_degrees()]
        } else {
            [place.0, place.1]
        })
    }

    fn out_of_reach(&self, latitude_deg: f64, longitude_deg: f64, why: &str) -> CrsError {
        CrsError(format!(
            "latitude {latitude_deg}, longitude {longitude_deg} is not a place in {}: {why}",
            self.name
        ))
    }

    /// Latitude and longitude on WGS84, degrees, of a place in its unit.
    ///
    /// # Errors
    /// A place that the projection cannot invert.
    pub fn to_wgs84(&self, easting: f64, northing: f64) -> Result<[f64; 2], CrsError> {
        let degrees = |x: f64| if self.is_geographic { x.to_radians() } else { x };
        let mut place = (degrees(easting), degrees(northing), 0.0);
        transform(&self.grid, &self.geographic, &mut place).map_err(|e| {
            CrsError(format!("{easting}, {northing} is not a place in {}: {e}", self.name))
        })?;
        Ok([place.1.to_degrees(), place.0.to_degrees()])
    }
}

/// The EPSG code of a text named after a UTM zone and its datum: `PROJCS["WGS_1984_UTM_Zone_16N",...` (Esri), `PROJCS["WGS 84 / UTM zone 16N",...`.
fn code_of_zone(text: &str) -> Option<u32> {
    let name = text.split('"').nth(1)?.replace('_', " ");
    // Without a datum in its name it may be any.
    if name.starts_with("UTM") { None } else { utm_code(&name) }
}

/// Steps over which the scale of a projection is taken: far less than it changes over, far more than rounding.
const STEP_M: f64 = 10.0;
const STEP_DEG: f64 = 1e-4;

/// Metres of a degree of latitude and of a degree of longitude on WGS84.
fn metres_per_degree(latitude_deg: f64) -> (f64, f64) {
    let (sin, cos) = latitude_deg.to_radians().sin_cos();
    let e2 = FLATTENING * (2.0 - FLATTENING);
    let w2 = 1.0 - e2 * sin * sin;
    let normal = SEMI_MAJOR_M / w2.sqrt();
    let meridian = normal * (1.0 - e2) / w2;
    (meridian.to_radians(), (normal * cos).to_radians())
}

/// A text that lives as long as the program: there are as many as systems that have no code.
pub(crate) fn lasting(text: &str) -> &'static str {
    static TEXTS: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());
    let mut texts = TEXTS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(known) = texts.get(text) {
        return known;
    }
    let text: &'static str = Box::leak(text.to_owned().into_boxed_str());
    texts.insert(text);
    text
}

/// A plane that touches the ellipsoid WGS84 at a place: east, north, up in metres from there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalPlane {
    origin: [f64; 3],
    origin_ecef_m: [f64; 3],
}

const SEMI_MAJOR_M: f64 = 6_378_137.0;
const FLATTENING: f64 = 1.0 / 298.257_223_563;

/// Earth-centred coordinates, metres, of `[latitude, longitude, height]` on WGS84, degrees and metres.
pub fn ecef_m([latitude_deg, longitude_deg, height_m]: [f64; 3]) -> [f64; 3] {
    let (sin_lat, cos_lat) = latitude_deg.to_radians().sin_cos();
    let (sin_lon, cos_lon) = longitude_deg.to_radians().sin_cos();
    let e2 = FLATTENING * (2.0 - FLATTENING);
    let n = SEMI_MAJOR_M / (1.0 - e2 * sin_lat * sin_lat).sqrt();
    let across = (n + height_m) * cos_lat;
    [across * cos_lon, across * sin_lon, (n * (1.0 - e2) + height_m) * sin_lat]
}

impl LocalPlane {
    /// The plane at `[latitude, longitude, height]`, degrees and metres.
    pub fn at(origin: [f64; 3]) -> LocalPlane {
        LocalPlane { origin, origin_ecef_m: ecef_m(origin) }
    }

    /// Where it touches: latitude, longitude, height.
    pub fn origin(&self) -> [f64; 3] {
        self.origin
    }

    /// East, north, up, metres, of `[latitude, longitude, height]`.
    pub fn from_wgs84(&self, place: [f64; 3]) -> [f64; 3] {
        let at = ecef_m(place);
        let d: [f64; 3] = std::array::from_fn(|k| at[k] - self.origin_ecef_m[k]);
        let (sin_lat, cos_lat) = self.origin[0].to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.origin[1].to_radians().sin_cos();
        [
            -sin_lon * d[0] + cos_lon * d[1],
            -sin_lat * cos_lon * d[0] - sin_lat * sin_lon * d[1] + cos_lat * d[2],
            cos_lat * cos_lon * d[0] + cos_lat * sin_lon * d[1] + sin_lat * d[2],
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zones_are_named_in_many_ways() {
        for (words, code) in [
            ("WGS84 UTM 16N", Some(32616)),
            ("WGS84 UTM 16T", Some(32616)),
            ("wgs84 utm 23K", Some(32723)),
            ("WGS 84 / UTM zone 33S", Some(32733)),
            ("UTM 5", Some(32605)),
            ("WGS 1984 UTM Zone 16N", Some(32616)),
            ("ETRS89 / UTM zone 32N", Some(25832)),
            ("NAD83 / UTM zone 16N", Some(26916)),
            ("WGS84 UTM 61N", None),
            ("WGS84 UTM 16NN", None),
            ("ED50 UTM 32N", None),
            ("UTM", None),
        ] {
            assert_eq!(utm_code(words), code, "{words}");
        }
        assert_eq!(Crs::from_words("WGS84 UTM 16T").unwrap().name(), "EPSG:32616");
    }

    #[test]
    fn degrees_of_receivers_are_told_from_those_of_old_datums() {
        let tell = |words: &str| {
            let crs = Crs::of_words(words).unwrap();
            (crs.is_geographic(), crs.is_global())
        };
        for words in ["EPSG:4326", "epsg::4258", "EPSG:4674", "4979", "WGS84", "EPSG:4612"] {
            assert_eq!(tell(words), (true, true), "{words}");
        }
        let tokyo = "+proj=longlat +ellps=GRS80 +towgs84=-146.414,507.337,680.507 +no_defs";
        let compound = r#"COMPD_CS["x",PROJCS["y",AUTHORITY["EPSG","32616"]],VERT_CS["z",AUTHORITY["EPSG","5773"]]]"#;
        for words in ["EPSG:32616+5703", compound] {
            assert_eq!(Crs::of_words(words).unwrap().epsg(), Some(32616));
        }
        for words in ["EPSG:4314", tokyo] {
            assert_eq!(tell(words), (true, false), "{words}");
        }
        assert!(Crs::from_words("EPSG:4326").is_err());
        let no_grid = Crs::of_words("EPSG:4267").unwrap_err().to_string();
        assert!(no_grid.contains("grid not available"), "{no_grid}");
    }
}
