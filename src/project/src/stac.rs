//! The map products of a run as an item of a SpatioTemporal Asset Catalog, by which catalogues and GIS find them.
//!
//! Written as `stac.json` into the folder of results where the orthomosaic lies in a system of the EPSG registry and at least
//! one photo says when it was taken: the standard wants a place and a time. Times are UTC, by the receiver's clock or by the
//! camera's with its offset. Many cameras write local time without its zone: then the interval is the one within which the
//! photos were taken whatever the zone, `datetime` is null, and `rowgram:local_time` has the clock's own words.
//!
//! Reference: STAC item specification 1.0.0 and its extension `projection` 1.1.0.

use super::{Project, Stage, run::RunOutcome};
use rowgram_base::error::Error;
use rowgram_files::{photo, rasters};
use rowgram_optim::output;
use rowgram_raster::{crs::Crs, georeference::Georeference};
use serde_json::{Map, Value, json};
use std::path::Path;

/// Its file in the folder of results.
pub(super) const STAC_FILE: &str = "stac.json";

/// Products: stage, file, title, media type, roles.
const PRODUCTS: [(Stage, &str, &str, &str, &str); 11] = [
    (Stage::Ortho, "ortho.tif", "Orthomosaic", COG, "visual"),
    (Stage::Dem, "dem.tif", "Surface from tie points", COG, "data"),
    (Stage::Surface, "dsm.tif", "Dense surface", COG, "data"),
    (Stage::Surface, "dtm.tif", "Ground under the canopy", COG, "data"),
    (Stage::Surface, "chm.tif", "Height of the canopy", COG, "data"),
    (Stage::Segment, "mask.tif", "Leaf mask", COG, "data"),
    (Stage::LeafDensity, "density.tif", "Leaf density", COG, "data"),
    (Stage::Plots, "traits.gpkg", "Traits of plots", GEOPACKAGE, "data"),
    (Stage::Plots, "plants.gpkg", "Plants", GEOPACKAGE, "data"),
    (Stage::Plots, "gaps.gpkg", "Gaps in the rows", GEOPACKAGE, "data"),
    (Stage::Plots, "trait_dictionary.csv", "What each trait is", "text/csv", "metadata"),
];

const COG: &str = "image/tiff; application=geotiff; profile=cloud-optimized";
const GEOPACKAGE: &str = "application/geopackage+sqlite3";

/// The rasters among the products: stage and file.
#[cfg(feature = "report")]
pub(super) fn rasters() -> impl Iterator<Item = (Stage, &'static str)> {
    let rasters = PRODUCTS.into_iter().filter(|(.., kind, _)| *kind == COG);
    rasters.map(|(stage, name, ..)| (stage, name))
}

/// Writes the item into a folder; `false` where there is nothing to say.
///
/// # Errors
/// Files that cannot be read or written.
pub(super) fn write(project: &Project, outcome: &RunOutcome, folder: &Path) -> Result<bool, Error> {
    let Some(item) = item(project, outcome)? else { return Ok(false) };
    output::write_json(&folder.join(STAC_FILE), true, &item)?;
    Ok(true)
}

fn item(project: &Project, outcome: &RunOutcome) -> Result<Option<Value>, Error> {
    let Ok(ortho) = project.orthomosaic() else { return Ok(None) };
    let source = rasters::Source::open(&ortho)?;
    let Some(place) = source.georeference() else { return Ok(None) };
    let Some(epsg) = place.crs.epsg else { return Ok(None) };
    let Ok(crs) = Crs::from_epsg(epsg) else { return Ok(None) };
    let Some(times) = times(project)? else { return Ok(None) };
    let [begin, end] = times.utc_s.map(rfc3339);
    let datetime = if times.is_exact { Some(begin.as_str()) } else { None };
    let corners = corners(&place, source.size());
    let geographic: Result<Vec<[f64; 2]>, _> =
        corners.iter().map(|[x, y]| crs.to_wgs84(*x, *y).map(|[lat, lon]| [lon, lat])).collect();
    let Ok(ring) = geographic else { return Ok(None) };
    let ring: Vec<[f64; 2]> = ring.iter().map(|at| at.map(|x| (x * 1e8).round() / 1e8)).collect();
    let bound = |axis: usize, pick: fn(f64, f64) -> f64, start: f64| {
        ring.iter().map(|at| at[axis]).fold(start, pick)
    };
    let bounds = [
        bound(0, f64::min, f64::INFINITY),
        bound(1, f64::min, f64::INFINITY),
        bound(0, f64::max, f64::NEG_INFINITY),
        bound(1, f64::max, f64::NEG_INFINITY),
    ];
    let [width, height] = [source.size().0, source.size().1];
    let mut assets = Map::new();
    for (stage, file, title, kind, role) in PRODUCTS {
        let Some(path) = project.finished(stage, file) else { continue };
        let Some(href) = below(project.results(), &path) else { continue };
        let key = file.replace('.', "_");
        assets.insert(key, json!({"href": href, "title": title, "type": kind, "roles": [role]}));
    }
    let closed: Vec<[f64; 2]> = ring.iter().chain(ring.first()).copied().collect();
    Ok(Some(json!({
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": ["https://stac-extensions.github.io/projection/v1.1.0/schema.json"],
        "id": project.name(),
        "bbox": bounds,
        "geometry": {"type": "Polygon", "coordinates": [closed]},
        "properties": {
            "datetime": datetime,
            "start_datetime": begin,
            "end_datetime": end,
            "rowgram:local_time": times.local,
            "gsd": outcome.gsd_m,
            "proj:epsg": epsg,
            "proj:shape": [height, width],
            "proj:transform": transform(&place),
            "rowgram:version": env!("CARGO_PKG_VERSION"),
        },
        "links": [],
        "assets": assets,
    })))
}

/// A path from the folder of the item, with slashes.
fn below(folder: &Path, path: &Path) -> Option<String> {
    let relative = path.strip_prefix(folder).ok()?;
    let parts: Vec<_> = relative.iter().map(|part| part.to_string_lossy()).collect();
    Some(format!("./{}", parts.join("/")))
}

/// The outer corners of a raster on the map.
fn corners(place: &Georeference, (width, height): (usize, usize)) -> [[f64; 2]; 4] {
    let [u, v] = [width as f64 - 0.5, height as f64 - 0.5];
    [[-0.5, v], [u, v], [u, -0.5], [-0.5, -0.5]].map(|at| place.map(at))
}

/// The affine transform of the projection extension: from column and row, counted from the corner of the first pixel.
fn transform(place: &Georeference) -> [f64; 6] {
    let [x, y] = place.map([-0.5, -0.5]);
    [place.per_column[0], place.per_row[0], x, place.per_column[1], place.per_row[1], y]
}

/// When photos were taken.
struct Times {
    /// From when to when, seconds of UTC since 1970.
    utc_s: [i64; 2],
    /// Whether the zone is known.
    is_exact: bool,
    /// The camera's clock at the beginning.
    local: String,
}

/// Offsets of local time from UTC lie between these, hours.
const ZONES_H: [i64; 2] = [-12, 14];

/// When the first and the last photo by name were taken, in order of time.
fn times(project: &Project) -> Result<Option<Times>, Error> {
    let photos = project.photos();
    let mut found: Option<Times> = None;
    for path in photos.first().into_iter().chain(photos.last()) {
        let Some(next) = times_of(&photo::read(path)?) else { continue };
        found = Some(match found {
            None => next,
            Some(before) => Times {
                utc_s: [before.utc_s[0].min(next.utc_s[0]), before.utc_s[1].max(next.utc_s[1])],
                is_exact: before.is_exact && next.is_exact,
                local: before.local.min(next.local),
            },
        });
    }
    Ok(found)
}

fn times_of(photo: &photo::Metadata) -> Option<Times> {
    let local = photo.moment.clone();
    if let Some(utc_s) = seconds(&photo.utc) {
        return Some(Times { utc_s: [utc_s; 2], is_exact: true, local });
    }
    let clock_s = seconds(&photo.moment)?;
    let offset = || -> Option<i64> {
        let (hours, minutes) = photo.utc_offset.trim().split_once(':')?;
        let (hours, minutes) = (hours.parse::<i64>().ok()?, minutes.parse::<i64>().ok()?);
        let sign = if photo.utc_offset.trim().starts_with('-') { -1 } else { 1 };
        Some(hours * 3600 + sign * minutes * 60)
    };
    Some(match offset() {
        Some(offset_s) => Times { utc_s: [clock_s - offset_s; 2], is_exact: true, local },
        None => {
            let [least_h, most_h] = ZONES_H;
            let utc_s = [clock_s - 3600 * most_h, clock_s - 3600 * least_h];
            Times { utc_s, is_exact: false, local }
        }
    })
}

/// Days from 1 January 1970 to a date, by years that begin in March.
pub(super) fn days(year: i64, month: i64, day: i64) -> i64 {
    let year = if month < 3 { year - 1 } else { year };
    let of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    365 * year + year.div_euclid(4) - year.div_euclid(100) + year.div_euclid(400) + of_year
        - 719_468
}

/// `2015:06:24 10:31:07.50` as seconds since 1970 by that clock; `None` where it is no time.
fn seconds(moment: &str) -> Option<i64> {
    let (date, time) = moment.trim().split_once([' ', 'T'])?;
    let numbers = |text: &str| -> Option<Vec<i64>> {
        let parts = text.split([':', '-']);
        parts.map(|part| part.split('.').next()?.parse().ok()).collect()
    };
    let ([year, month, day], [hour, minute, second]) =
        (<[i64; 3]>::try_from(numbers(date)?).ok()?, <[i64; 3]>::try_from(numbers(time)?).ok()?);
    let is_time = (1..=12).contains(&month)
        && (1..=31).contains(&day)
        && (1..=9999).contains(&year)
        && (0..24).contains(&hour)
        && (0..60).contains(&minute)
        && (0..61).contains(&second);
    is_time.then(|| days(year, month, day) * 86_400 + hour * 3600 + minute * 60 + second)
}

/// Seconds since 1970 as `2015-06-24T10:31:07Z`.
fn rfc3339(seconds: i64) -> String {
    let (day, rest) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
    let mut year = 1970 + day.div_euclid(366);
    while days(year + 1, 1, 1) <= day {
        year += 1;
    }
    let month = (2..=12).rev().find(|&month| days(year, month, 1) <= day).unwrap_or(1);
    let date = day - days(year, month, 1) + 1;
    let (hour, minute, second) = (rest / 3600, rest / 60 % 60, rest % 60);
    format!("{year:04}-{month:02}-{date:02}T{hour:02}:{minute:02}:{second:02}Z")
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::georeference;

    #[test]
    fn times_are_utc_or_an_interval_of_it() {
        let of = |moment: &str, offset: &str, utc: &str| {
            let photo = photo::Metadata {
                moment: moment.to_owned(),
                utc_offset: offset.to_owned(),
                utc: utc.to_owned(),
                ..photo::Metadata::default()
            };
            times_of(&photo).map(|times| (times.utc_s.map(rfc3339), times.is_exact))
        };
        let at = |text: &str| [text.to_owned(), text.to_owned()];
        let local = "2015:06:24 22:31:07.50";
        assert_eq!(of(local, "-05:30", ""), Some((at("2015-06-25T04:01:07Z"), true)));
        assert_eq!(of(local, "", "2015:06:25 02:31:05"), Some((at("2015-06-25T02:31:05Z"), true)));
        let any = ["2015-06-24T08:31:07Z", "2015-06-25T10:31:07Z"].map(str::to_owned);
        assert_eq!(of(local, "", ""), Some((any, false)));
        for bad in ["", "0000:00:00 00:00:00", "2015:06:24", "2015:13:01 00:00:00", "a:b:c d:e:f"] {
            assert_eq!(of(bad, "", ""), None, "{bad:?}");
        }
        for text in [
            "1970-01-01T00:00:00Z",
            "2000-02-29T12:00:00Z",
            "2023-12-31T23:59:59Z",
            "2024-03-01T00:00:00Z",
        ] {
            assert_eq!(rfc3339(seconds(text.trim_end_matches('Z')).unwrap()), text);
        }
    }

    #[test]
    fn the_transform_counts_from_the_corner() {
        let crs = georeference::Crs::projected(32616);
        let place = Georeference::north_up([500_000.5, 4_475_000.5], 1.0, crs);
        assert_eq!(transform(&place), [1.0, 0.0, 500_000.0, 0.0, -1.0, 4_475_001.0]);
        assert_eq!(corners(&place, (10, 20))[1], [500_010.0, 4_474_981.0]);
    }
}
