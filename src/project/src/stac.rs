//! The map products of a run as an item of a SpatioTemporal Asset Catalog, by which catalogues and GIS find them.
//!
//! Written as `stac.json` into the folder of results where the orthomosaic lies in a system of the EPSG registry and at least
//! one photo says when it was taken: the standard wants a place and a time. Cameras write local time without its zone; it is
//! given as if it were UTC, and `rowgram:time` says so.
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

/// Writes the item into a folder; `false` where there is nothing to say.
///
/// # Errors
/// Files that cannot be read or written.
pub(super) fn write(project: &Project, outcome: &RunOutcome, folder: &Path) -> Result<bool, Error> {
    let Some(item) = item(project, outcome)? else { return Ok(false) };
    output::write(&folder.join(STAC_FILE), true, |out| {
        serde_json::to_writer_pretty(&mut *out, &item)?;
        writeln!(out)
    })?;
    Ok(true)
}

fn item(project: &Project, outcome: &RunOutcome) -> Result<Option<Value>, Error> {
    let Ok(ortho) = project.orthomosaic() else { return Ok(None) };
    let source = rasters::Source::open(&ortho)?;
    let Some(place) = source.georeference() else { return Ok(None) };
    let Some(epsg) = place.crs.epsg else { return Ok(None) };
    let Ok(crs) = Crs::from_epsg(epsg) else { return Ok(None) };
    let Some([begin, end]) = times(project)? else { return Ok(None) };
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
            "datetime": begin,
            "start_datetime": begin,
            "end_datetime": end,
            "rowgram:time": "clock of the camera, without its zone",
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

/// When the first and the last photo by name were taken, in order of time.
fn times(project: &Project) -> Result<Option<[String; 2]>, Error> {
    let photos = project.photos();
    let mut found = Vec::new();
    for path in photos.first().into_iter().chain(photos.last()) {
        found.extend(rfc3339(&photo::read(path)?.moment));
    }
    found.sort();
    Ok(found.first().cloned().zip(found.last().cloned()).map(|(begin, end)| [begin, end]))
}

/// `2015:06:24 10:31:07.50` as `2015-06-24T10:31:07Z`; `None` where it is no time.
fn rfc3339(moment: &str) -> Option<String> {
    let (date, time) = moment.trim().split_once([' ', 'T'])?;
    let numbers = |text: &str| -> Option<Vec<u32>> {
        let parts = text.split([':', '-']);
        parts.map(|part| part.split('.').next()?.parse().ok()).collect()
    };
    let ([year, month, day], [hour, minute, second]) =
        (<[u32; 3]>::try_from(numbers(date)?).ok()?, <[u32; 3]>::try_from(numbers(time)?).ok()?);
    let is_time = (1..=12).contains(&month)
        && (1..=31).contains(&day)
        && year >= 1
        && hour < 24
        && minute < 60
        && second < 61;
    is_time.then(|| format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::georeference;

    #[test]
    fn times_of_cameras_are_understood() {
        let of = |text: &str| rfc3339(text);
        assert_eq!(of("2015:06:24 10:31:07.50").as_deref(), Some("2015-06-24T10:31:07Z"));
        assert_eq!(of("2015-06-24 10:31:07").as_deref(), Some("2015-06-24T10:31:07Z"));
        for bad in ["", "0000:00:00 00:00:00", "2015:06:24", "2015:13:01 00:00:00", "a:b:c d:e:f"] {
            assert_eq!(of(bad), None, "{bad:?}");
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
