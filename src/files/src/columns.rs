//! Words by which other programs call the columns of their tables; the first of each list is our own.

use super::{
    FileError,
    control::Defaults,
    table::{Column, Row, Table},
};
use rowgram_optim::robust::median;

/// A photo.
pub(super) const IMAGE: &[&str] = &[
    "image",
    "image_name",
    "imagename",
    "filename",
    "file_name",
    "file",
    "photo",
    "photo_name",
    "label",
    "name",
    "photoid",
    "photo_id",
    "source_file",
    "sourcefile",
    "camera",
];
/// A ground point.
pub(super) const LABEL: &[&str] = &[
    "label",
    "name",
    "point",
    "gcp",
    "id",
    "point_name",
    "pointname",
    "point_id",
    "point_number",
    "marker",
    "gcp_name",
    "gcp_id",
    "gcp_label",
    "number",
    "no",
    "nr",
    "pt",
    "punkt",
    "punktnummer",
];
/// Degrees north.
pub(super) const LATITUDE: &[&str] = &[
    "latitude_deg",
    "latitude",
    "lat",
    "lat_deg",
    "y_latitude",
    "gps_latitude",
    "gpslatitude",
    "latitude_wgs84",
    "lat_wgs84",
    "wgs84_latitude",
];
/// Degrees east.
pub(super) const LONGITUDE: &[&str] = &[
    "longitude_deg",
    "longitude",
    "lon",
    "long",
    "lng",
    "lon_deg",
    "x_longitude",
    "gps_longitude",
    "gpslongitude",
    "longitude_wgs84",
    "lon_wgs84",
    "wgs84_longitude",
];
/// Metres east.
pub(super) const EASTING: &[&str] = &[
    "easting_m",
    "easting",
    "x_m",
    "x",
    "east",
    "e",
    "x_east",
    "x_easting",
    "east_m",
    "map_x",
    "rechtswert",
    "este",
    "x_local_x",
    "point_x",
];
/// Metres north.
pub(super) const NORTHING: &[&str] = &[
    "northing_m",
    "northing",
    "y_m",
    "y",
    "north",
    "n",
    "y_north",
    "y_northing",
    "north_m",
    "map_y",
    "hochwert",
    "norte",
    "y_local_y",
    "point_y",
];
/// Metres up.
pub(super) const HEIGHT: &[&str] = &[
    "height_m",
    "height",
    "z_m",
    "z",
    "elevation",
    "elevation_m",
    "elev",
    "altitude",
    "altitude_m",
    "alt",
    "up",
    "z_altitude",
    "z_height",
    "gps_height",
    "gps_altitude",
    "gpsaltitude",
    "orthometric_height",
    "ellipsoidal_height_m",
    "ellipsoidal_height",
    "ellipsoid_height",
    "ellh",
    "h",
    "hoehe",
    "höhe",
    "map_z",
    "point_z",
];
/// Standard deviations along east, north, up, metres: own columns, then common ones.
const SIGMA_EAST: &[&str] = &[
    "sigma_x_m",
    "sde",
    "easting_rms",
    "accuracy_x",
    "std_east",
    "east_rms",
    "accuracy_x_m",
    "x_accuracy_m",
];
const SIGMA_NORTH: &[&str] = &[
    "sigma_y_m",
    "sdn",
    "northing_rms",
    "accuracy_y",
    "std_north",
    "north_rms",
    "accuracy_y_m",
    "y_accuracy_m",
];
const SIGMA_UP: &[&str] = &[
    "sigma_z_m",
    "sdu",
    "elevation_rms",
    "accuracy_z",
    "std_up",
    "accuracy_vertical",
    "vertical_accuracy",
    "accuracy_vertical_m",
    "vertical_m",
    "v_accuracy",
    "vaccuracy",
    "ellipsoidal_height_rms",
    "accuracy_z_m",
    "z_accuracy_m",
];
const SIGMA_PLAN: &[&str] = &[
    "sigma_xy_m",
    "accuracy_horizontal",
    "horizontal_accuracy",
    "accuracy_horizontal_m",
    "horizontal_m",
    "h_accuracy",
    "haccuracy",
    "accuracy_xy",
    "accuracy_x_y",
    "lateral_rms",
    "accuracy_xy_m",
];
const SIGMA_ALL: &[&str] = &["sigma_m", "accuracy_x_y_z", "accuracy", "accuracy_m", "rms"];

/// The columns of standard deviations along east, north, up.
pub(super) fn sigmas(table: &Table) -> [Option<Column>; 3] {
    let of = |own: &[&str], common: &[&str]| {
        table.column(own).or_else(|| table.column(common)).or_else(|| table.column(SIGMA_ALL))
    };
    [of(SIGMA_EAST, SIGMA_PLAN), of(SIGMA_NORTH, SIGMA_PLAN), of(SIGMA_UP, &[])]
}

/// The standard deviations of a row that has any; an axis without one has that of a receiver alone.
///
/// # Errors
/// A field that is no positive number.
pub(super) fn told_sigma(
    table: &Table,
    row: &Row,
    columns: [Option<Column>; 3],
) -> Result<Option<[f64; 3]>, FileError> {
    let mut sigma = [0.0; 3];
    for (sigma, column) in sigma.iter_mut().zip(columns) {
        *sigma = table.positive_or(row, column, f64::NAN)?;
    }
    if sigma.iter().all(|s| s.is_nan()) {
        return Ok(None);
    }
    let default = Defaults::default().position_m;
    Ok(Some(sigma.map(|s| if s.is_nan() { default } else { s })))
}

/// The columns of coordinates and their standard deviations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Coordinates {
    /// East and north, or longitude and latitude.
    pub(super) plan: [Column; 2],
    pub(super) height: Option<Column>,
    pub(super) sigma: [Option<Column>; 3],
    pub(super) is_degrees: bool,
}

impl Coordinates {
    /// By their names. Metashape calls degrees X and Y too.
    pub(super) fn of(table: &Table) -> Result<Coordinates, FileError> {
        let metres = table.column(EASTING).zip(table.column(NORTHING));
        let degrees = table.column(LONGITUDE).zip(table.column(LATITUDE));
        // Where both are there, degrees say what they are.
        let is_degrees = degrees.is_some();
        let plan = match degrees.or(metres) {
            Some((east, north)) => [east, north],
            None => {
                let found = table.header().join(", ");
                return Err(table.header_fault(format!(
                    "no columns for the coordinates: expected easting_m and northing_m, or latitude_deg and longitude_deg, found {found}"
                )));
            }
        };
        let height = table.column(HEIGHT);
        let sigma = sigmas(table);
        let mut found = Coordinates { plan, height, sigma, is_degrees };
        found.is_degrees |= look_like_degrees(&found.places(table));
        Ok(found)
    }

    fn places(&self, table: &Table) -> Vec<[f64; 2]> {
        let [x, y] = self.plan;
        let of = |row: &Row| Some([table.parse(row, x)?, table.parse(row, y)?]);
        table.rows().iter().filter_map(of).collect()
    }

    /// In metres.
    pub(super) fn in_metres(table: &Table) -> Result<Coordinates, FileError> {
        let found = Coordinates::of(table)?;
        if !found.is_degrees {
            return Ok(found);
        }
        let Some((east, north)) = table.column(EASTING).zip(table.column(NORTHING)) else {
            return Err(table.whole_fault(DEGREES.into()));
        };
        let found = Coordinates { plan: [east, north], is_degrees: false, ..found };
        match look_like_degrees(&found.places(table)) {
            true => Err(table.whole_fault(DEGREES_AS_METRES.into())),
            false => Ok(found),
        }
    }

    /// A position; the height is `None` where it is not told.
    pub(super) fn position(
        &self,
        table: &Table,
        row: &Row,
    ) -> Result<([f64; 2], Option<f64>), FileError> {
        let [x, y] = self.plan.map(|column| table.number(row, column));
        let height = self.height.map(|column| table.number_or_none(row, column)).transpose()?;
        Ok(([x?, y?], height.flatten()))
    }

    /// Standard deviations of a row.
    pub(super) fn sigma(
        &self,
        table: &Table,
        row: &Row,
        default: f64,
    ) -> Result<[f64; 3], FileError> {
        let [x, y, z] = self.sigma.map(|column| table.positive_or(row, column, default));
        Ok([x?, y?, z?])
    }
}

const DEGREES: &str = "the coordinates are latitude and longitude in degrees; expected easting_m, northing_m, height_m in metres: transform them into the mapping frame first";
const DEGREES_AS_METRES: &str = "the coordinates look like degrees: all are within one unit of each other; expected metres in the mapping frame";

/// Which columns of a table without a header hold coordinates, and what they are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Unnamed {
    pub(super) name: Column,
    pub(super) coordinates: Coordinates,
    /// The numbers after the height.
    pub(super) rest: [Option<Column>; 5],
}

impl Unnamed {
    /// How columns were told, for a person: these, and more of them.
    pub(super) fn said(&self, table: &Table, more: &[(&str, Option<Column>)]) -> String {
        let Coordinates { plan, height, is_degrees, .. } = self.coordinates;
        let [east, north] =
            if is_degrees { ["longitude", "latitude"] } else { ["easting", "northing"] };
        let own = [
            ("names", Some(self.name)),
            (east, Some(plan[0])),
            (north, Some(plan[1])),
            ("height", height),
        ];
        let of = |(what, column): &(&str, Option<Column>)| {
            column.map(|column| format!("{what} in {:?}", table.title(column)))
        };
        let said: Vec<String> = own.iter().chain(more).filter_map(of).collect();
        format!("it has no header; read with {}", said.join(", "))
    }
}

/// Whether places are degrees: all within a degree of each other and within a globe's range, which a survey in metres
/// is not unless it is smaller than a metre.
pub(super) fn look_like_degrees(places: &[[f64; 2]]) -> bool {
    let spread = |k: usize| {
        let values = places.iter().map(|p| p[k]);
        values.clone().fold(f64::MIN, f64::max) - values.fold(f64::MAX, f64::min)
    };
    let range = |k: usize, most: f64| places.iter().all(|p| p[k].abs() <= most);
    places.len() >= 2
        && (range(0, 180.0) && range(1, 90.0) || range(0, 90.0) && range(1, 180.0))
        && spread(0) < 1.0
        && spread(1) < 1.0
}

/// Degrees nearer than this to those of the photos are of the same place.
const SAME_PLACE_DEG: f64 = 1.0;

/// Whether latitude comes first in pairs of degrees: by the globe's range, else by where photos were taken (latitude and
/// longitude), else `usually`.
pub(super) fn latitude_first(
    pairs: &[[f64; 2]],
    photos_deg: Option<[f64; 2]>,
    usually: bool,
) -> bool {
    let middle = [0, 1].map(|k| median(pairs.iter().map(|pair| pair[k])).unwrap_or(0.0));
    if middle[0].abs() > 90.0 || middle[1].abs() > 90.0 {
        return middle[1].abs() > 90.0;
    }
    if let Some([latitude, longitude]) = photos_deg {
        let near = |lat: f64, lon: f64| {
            (lat - latitude).abs() < SAME_PLACE_DEG && (lon - longitude).abs() < SAME_PLACE_DEG
        };
        match (near(middle[0], middle[1]), near(middle[1], middle[0])) {
            (true, false) => return true,
            (false, true) => return false,
            _ => {}
        }
    }
    usually
}

/// Eastings of UTM and Gauss-Krueger zones are below a million, northings above it but near the equator.
const MILLION: f64 = 1e6;

/// Finds names and coordinates in a table without a header: the first column, two of numbers, and a third.
///
/// `usually_latitude_first` decides where neither numbers nor photos do.
pub(super) fn unnamed(
    table: &Table,
    photos_deg: Option<[f64; 2]>,
    usually_latitude_first: bool,
) -> Result<Unnamed, FileError> {
    let all: Vec<Column> = table.columns().map(|(_, column)| column).collect();
    let is_number = |column: &Column| {
        let there = table.rows().iter().filter(|row| !table.text(row, *column).is_empty());
        let (mut any, mut all) = (false, true);
        for row in there {
            any = true;
            all &= table.parse(row, *column).is_some();
        }
        any && all
    };
    let numbers_after = |name: usize| -> Vec<Column> {
        all[name + 1..].iter().take_while(|column| is_number(column)).copied().collect()
    };
    // The first column is the name even where names are numbers: also where the only text is a code behind the height.
    let mut name = all.iter().position(|column| !is_number(column)).unwrap_or(0);
    let mut numbers = numbers_after(name);
    let is_whole = |row: &Row| table.parse(row, all[0]).is_some_and(|v| v.fract() == 0.0);
    if numbers.len() < 2 && numbers_after(0).len() >= 3 && table.rows().iter().all(is_whole) {
        (name, numbers) = (0, numbers_after(0));
    }
    let [a, b, more @ ..] = numbers.as_slice() else {
        return Err(table.whole_fault(
            "it has no header, and no name followed by coordinates: expected a header, such as label, easting_m, northing_m, height_m".into(),
        ));
    };
    let pairs: Vec<[f64; 2]> = table
        .rows()
        .iter()
        .filter_map(|row| Some([table.parse(row, *a)?, table.parse(row, *b)?]))
        .filter(|pair| pair.iter().all(|v| v.is_finite()))
        .collect();
    let is_degrees = look_like_degrees(&pairs)
        || pairs.len() == 1 && pairs[0].iter().all(|v| v.abs() <= 180.0) && photos_deg.is_some();
    let north_first = if is_degrees {
        latitude_first(&pairs, photos_deg, usually_latitude_first)
    } else {
        let middle = [0, 1].map(|k| median(pairs.iter().map(|pair| pair[k])).unwrap_or(0.0));
        middle[0] >= MILLION && middle[1] < MILLION
    };
    let mut rest = [None; 5];
    for (slot, column) in rest.iter_mut().zip(more.get(1..).unwrap_or_default()) {
        *slot = Some(*column);
    }
    Ok(Unnamed {
        name: all[name],
        coordinates: Coordinates {
            plan: if north_first { [*b, *a] } else { [*a, *b] },
            height: more.first().copied(),
            sigma: [None; 3],
            is_degrees,
        },
        rest,
    })
}
