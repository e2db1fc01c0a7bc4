//! Camera positions as other programs and receivers deliver them, one table for all.
//!
//! | file | rows |
//! |---|---|
//! | tables with a header | a photo's name, latitude and longitude (or easting and northing), height, standard deviations, in any order and among others |
//! | tables without one | a photo's name, two coordinates, a height; as in Pix4D latitude comes first, as in OpenDroneMap's `geo.txt` (whose first line names the system) longitude |
//! | DJI's `.MRK` | number of the photo, latitude, longitude, height above the ellipsoid of the camera, standard deviations |
//! | RTKLIB's `.pos` | a row for each photo in the order in which they were taken |

use super::{
    FileError,
    columns::{self, Coordinates},
    photo::Geotag,
    table::{Row, Table, read_text},
};
use rowgram_raster::crs::Crs;
use std::{collections::HashMap, path::Path};

/// Which photo a row is of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PhotoReference {
    /// The one of this name.
    Name(String),
    /// The one with this number in its name.
    Number(u32),
    /// The one at this place in the order in which they were taken.
    Place(usize),
}

/// Where a camera was.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Place {
    /// Latitude and longitude, degrees.
    Degrees([f64; 2]),
    /// Easting and northing in the system of the table, metres.
    Metres([f64; 2]),
}

/// A row.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraPlace {
    /// Whose it is.
    pub photo: PhotoReference,
    /// In the plan.
    pub place: Place,
    /// Metres; `None` where it is not told.
    pub height_m: Option<f64>,
    /// Standard deviations along east, north, up, metres, where they are told.
    pub sigma_m: Option<[f64; 3]>,
}

/// What a file of positions says.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraPlaces {
    /// The words by which it names its reference system.
    pub system: Option<String>,
    /// Its rows.
    pub rows: Vec<CameraPlace>,
    /// How its columns were told, where they have no names.
    pub choice: Option<String>,
}

/// Reads a file of positions. `photos_deg` is about where photos were taken, latitude and longitude, where they tell.
///
/// # Errors
/// Missing columns, numbers that are none, degrees beyond the globe.
pub fn read(path: &Path, photos_deg: Option<[f64; 2]>) -> Result<CameraPlaces, FileError> {
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    match ending.as_str() {
        "mrk" => read_mrk(path),
        "pos" => read_pos(path),
        _ => read_table(path, photos_deg),
    }
}

/// Whether words name a reference system in degrees, which are taken as those of WGS84.
///
/// # Errors
/// Degrees of a datum that is up to hundreds of metres from WGS84.
pub(super) fn is_geographic(words: &str) -> Result<bool, String> {
    match Crs::of_words(words) {
        Ok(crs) if crs.is_geographic() && !crs.is_global() => Err(format!(
            "its degrees are of {words}, which is not the datum of receivers and may be hundreds of metres from it; transform them to WGS84 (EPSG:4326), or to metres of a projected system"
        )),
        Ok(crs) => Ok(crs.is_geographic()),
        // NAD27: its datum is known by a grid only.
        Err(error) if error.to_string().contains("grid not available") => Err(format!(
            "{error}; transform its coordinates to WGS84 (EPSG:4326), or to metres of another system"
        )),
        Err(_) => Ok(false),
    }
}

fn read_table(path: &Path, photos_deg: Option<[f64; 2]>) -> Result<CameraPlaces, FileError> {
    let table = Table::read(path)?;
    table.system().map(is_geographic).transpose().map_err(|why| table.whole_fault(why))?;
    let mut choice = None;
    let (image, found) = if table.is_named() {
        (table.required("image", columns::IMAGE)?, Coordinates::of(&table)?)
    } else {
        let is_odm = table.system().is_some();
        let found = columns::unnamed(&table, photos_deg, !is_odm)?;
        let [a, b, c, d, e] = found.rest;
        // Three angles may come before two accuracies.
        let (plan, up) = match (a, b, c, d, e) {
            (Some(h), Some(v), None, ..) => (Some(h), Some(v)),
            (.., Some(h), Some(v)) => (Some(h), Some(v)),
            _ => (None, None),
        };
        let more = [("accuracy in plan", plan), ("accuracy in height", up)];
        choice = Some(found.said(&table, &more));
        (found.name, Coordinates { sigma: [plan, plan, up], ..found.coordinates })
    };
    let mut rows: Vec<CameraPlace> = Vec::with_capacity(table.rows().len());
    let mut places = HashMap::new();
    for row in table.rows() {
        let name = table.text(row, image);
        if name.is_empty() {
            return Err(table.fault(row, "the row names no photo".into()));
        }
        let mut plan = [0.0; 2];
        let mut is_there = true;
        for (value, column) in plan.iter_mut().zip(found.plan) {
            match table.number_or_none(row, column)? {
                Some(number) => *value = number,
                None => is_there = false,
            }
        }
        if !is_there {
            continue;
        }
        let place = place(&table, row, plan, found.is_degrees)?;
        if places.insert(name, place).is_some_and(|before| before != place) {
            return Err(table.fault(row, format!("{name} is there twice, at two places")));
        }
        let height_m = found.height.map(|column| table.number_or_none(row, column)).transpose()?;
        rows.push(CameraPlace {
            photo: PhotoReference::Name(name.to_owned()),
            place,
            height_m: height_m.flatten(),
            sigma_m: columns::told_sigma(&table, row, found.sigma)?,
        });
    }
    Ok(CameraPlaces { system: table.system().map(str::to_owned), rows, choice })
}

fn place(table: &Table, row: &Row, plan: [f64; 2], is_degrees: bool) -> Result<Place, FileError> {
    if !is_degrees {
        return Ok(Place::Metres(plan));
    }
    let [lon, lat] = plan;
    if lat.abs() > 90.0 || lon.abs() > 180.0 {
        let message = format!("latitude {lat}, longitude {lon} is no place on the globe");
        return Err(table.fault(row, message));
    }
    Ok(Place::Degrees([lat, lon]))
}

/// A number before its unit, as in `40.47186604,Lat`.
fn before<'a>(fields: &[&'a str], unit: &str) -> Option<&'a str> {
    let of = |field: &&'a str| field.strip_suffix(unit)?.strip_suffix(',').map(str::trim);
    fields.iter().find_map(of)
}

/// DJI's image log: one line a photo, fields by tabs, the unit after each number; standard deviations along north, east, up.
fn read_mrk(path: &Path) -> Result<CameraPlaces, FileError> {
    let text = read_text(path)?;
    let mut rows = Vec::new();
    for (k, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let fault = |what: &str| {
            let message = format!(
                "no {what}; expected a line of DJI's image log: number, time, ..., latitude,Lat, longitude,Lon, height,Ellh, ..."
            );
            FileError::malformed(path, k + 1, message)
        };
        let fields: Vec<&str> = line.split('\t').map(str::trim).collect();
        let number = fields[0].parse().map_err(|_| fault("number of a photo"))?;
        let value = |unit: &str, what: &str| -> Result<f64, FileError> {
            let found = before(&fields, unit).and_then(|text| text.parse::<f64>().ok());
            found.filter(|v| v.is_finite()).ok_or_else(|| fault(what))
        };
        let place = [value("Lat", "latitude")?, value("Lon", "longitude")?];
        if place == [0.0; 2] {
            continue;
        }
        let height_m = value("Ellh", "height")?;
        let fixed =
            before(&fields, "Q").and_then(|q| q.parse::<u32>().ok()).is_some_and(|q| q >= 50);
        let sigma: Option<Vec<f64>> = fields
            .iter()
            .map(|field| field.split(',').map(str::trim).collect::<Vec<_>>())
            .find(|parts| parts.len() == 3)
            .and_then(|parts| parts.iter().map(|part| part.parse().ok()).collect());
        let sigma_m = match sigma.as_deref() {
            Some(&[north, east, up]) if fixed && [north, east, up].iter().all(|s| *s > 0.0) => {
                Some([east, north, up])
            }
            _ => None,
        };
        rows.push(CameraPlace {
            photo: PhotoReference::Number(number),
            place: Place::Degrees(place),
            height_m: Some(height_m),
            sigma_m,
        });
    }
    Ok(CameraPlaces { system: None, rows, choice: None })
}

/// RTKLIB's solutions, one for each photo; a solution of one receiver alone has no accuracy that can be believed.
fn read_pos(path: &Path) -> Result<CameraPlaces, FileError> {
    let table = Table::read(path)?;
    let plan = [
        table.required("longitude", columns::LONGITUDE)?,
        table.required("latitude", columns::LATITUDE)?,
    ];
    let height = table.required("height", columns::HEIGHT)?;
    let sigma = columns::sigmas(&table);
    let quality = table.column(&["q"]);
    let mut rows = Vec::with_capacity(table.rows().len());
    for (k, row) in table.rows().iter().enumerate() {
        let at = [table.number(row, plan[0])?, table.number(row, plan[1])?];
        let fixed = quality.is_some_and(|column| table.text(row, column) == "1");
        let sigma_m = columns::told_sigma(&table, row, sigma)?.filter(|_| fixed);
        rows.push(CameraPlace {
            photo: PhotoReference::Place(k),
            place: place(&table, row, at, true)?,
            height_m: Some(table.number(row, height)?),
            sigma_m,
        });
    }
    Ok(CameraPlaces { system: None, rows, choice: None })
}

impl CameraPlace {
    /// As a receiver would have told it, with degrees from metres by `to_wgs84`.
    ///
    /// # Errors
    /// Where `to_wgs84` knows no such place.
    pub fn geotag<E>(
        &self,
        to_wgs84: impl Fn([f64; 2]) -> Result<[f64; 2], E>,
    ) -> Result<Geotag, E> {
        let [latitude_deg, longitude_deg] = match self.place {
            Place::Degrees(place) => place,
            Place::Metres(place) => to_wgs84(place)?,
        };
        Ok(Geotag { latitude_deg, longitude_deg, height_m: self.height_m, sigma_m: self.sigma_m })
    }
}

impl CameraPlaces {
    /// Whether any place is in metres of the table's system.
    pub fn needs_system(&self) -> bool {
        self.rows.iter().any(|row| matches!(row.place, Place::Metres(_)))
            && self.system.as_deref().is_none_or(|words| is_geographic(words) != Ok(true))
    }
}

#[cfg(test)]
mod tests;
