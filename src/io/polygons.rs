//! Polygons in GeoJSON files: plots, calibration regions.
//!
//! A `FeatureCollection` (or one `Feature`) of `Polygon`s and `MultiPolygon`s. Coordinates are in the raster's own CRS, or in
//! pixels (the centre of the top-left pixel at 0, 0) where the raster has no place on the map. A file that names
//! another CRS than the raster's is refused. A feature's name is its property `name`, `plot` or `id`, else its number.

use super::FileError;
use crate::raster::{georeference::Georeference, polygon::Polygon};
use serde::Deserialize;
use serde_json::Value;
use std::path::Path;

/// A named polygon, in pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Named {
    /// Its name.
    pub name: String,
    /// Its rings, pixels.
    pub polygon: Polygon,
    /// Its number of leaves, where the property `leaves` says it.
    pub leaves: Option<f64>,
}

#[derive(Deserialize)]
#[serde(tag = "type")]
enum Document {
    FeatureCollection { features: Vec<Feature>, crs: Option<Value> },
    Feature(Feature),
}

#[derive(Deserialize)]
struct Feature {
    geometry: Geometry,
    #[serde(default)]
    properties: Option<serde_json::Map<String, Value>>,
    id: Option<Value>,
}

type Rings = Vec<Vec<Vec<f64>>>;

#[derive(Deserialize)]
#[serde(tag = "type", content = "coordinates")]
enum Geometry {
    Polygon(Rings),
    MultiPolygon(Vec<Rings>),
}

/// Reads the polygons of a file.
///
/// # Errors
/// Where the file cannot be read, is no such GeoJSON, has another CRS than the raster, or has a ring of fewer than three
/// points.
pub fn read(path: &Path, georeference: Option<&Georeference>) -> Result<Vec<Named>, FileError> {
    let text = std::fs::read_to_string(path).map_err(|error| FileError::read(path, error))?;
    let document: Document = serde_json::from_str(&text).map_err(|error| {
        let message = format!("{error}; expected GeoJSON with Polygon or MultiPolygon features");
        FileError::malformed(path, Some(error.line()), message)
    })?;
    let (features, crs) = match document {
        Document::FeatureCollection { features, crs } => (features, crs),
        Document::Feature(feature) => (vec![feature], None),
    };
    let stated = crs.as_ref().and_then(epsg);
    let raster = georeference.and_then(|place| place.crs.epsg);
    if let (Some(stated), Some(raster)) = (stated, raster)
        && stated != raster
    {
        let message = format!("its CRS is EPSG:{stated}, expected the raster's, EPSG:{raster}");
        return Err(FileError::malformed(path, None, message));
    }
    features
        .into_iter()
        .enumerate()
        .map(|(index, feature)| {
            named(index, feature, georeference)
                .map_err(|message| FileError::malformed(path, None, message))
        })
        .collect()
}

/// The code at the end of a name such as `urn:ogc:def:crs:EPSG::32616`.
fn epsg(crs: &Value) -> Option<u32> {
    let name = crs.get("properties")?.get("name")?.as_str()?;
    name.contains("EPSG").then(|| name.rsplit(':').next()?.parse().ok()).flatten()
}

fn named(index: usize, feature: Feature, place: Option<&Georeference>) -> Result<Named, String> {
    let property = |key: &str| feature.properties.as_ref().and_then(|map| map.get(key));
    let name = ["name", "plot", "id"].into_iter().find_map(property).or(feature.id.as_ref());
    let name = match name {
        Some(Value::String(text)) => text.clone(),
        Some(Value::Null) | None => (index + 1).to_string(),
        Some(other) => other.to_string(),
    };
    let leaves = match property("leaves") {
        None | Some(Value::Null) => None,
        Some(value) => Some(value.as_f64().ok_or_else(|| {
            format!("feature {name}: its property leaves is {value}, expected a number")
        })?),
    };
    let parts = match feature.geometry {
        Geometry::Polygon(rings) => vec![rings],
        Geometry::MultiPolygon(parts) => parts,
    };
    let mut polygon = Polygon::default();
    for ring in parts.into_iter().flatten() {
        let mut points = Vec::with_capacity(ring.len());
        for position in ring {
            let (Some(&x), Some(&y)) = (position.first(), position.get(1)) else {
                return Err(format!("feature {name}: a position has fewer than two numbers"));
            };
            let point = match place {
                None => Some([x, y]),
                Some(place) => place.pixel([x, y]),
            };
            points.push(point.ok_or("the raster has no area on the map")?);
        }
        if points.first() == points.last() {
            points.pop();
        }
        if points.len() < 3 {
            return Err(format!("feature {name}: a ring has fewer than three points"));
        }
        polygon.rings.push(points);
    }
    Ok(Named { name, polygon, leaves })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::georeference::Crs;

    fn parse(text: &str, place: Option<&Georeference>) -> Result<Vec<Named>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plots.geojson");
        std::fs::write(&path, text).unwrap();
        read(&path, place).map_err(|error| error.to_string())
    }

    const PLOTS: &str = r#"{"type":"FeatureCollection",
        "crs":{"type":"name","properties":{"name":"urn:ogc:def:crs:EPSG::32616"}},"features":[
        {"type":"Feature","properties":{"name":"A","leaves":12},
         "geometry":{"type":"Polygon","coordinates":[[[100,200],[110,200],[110,190],[100,200]]]}},
        {"type":"Feature","id":7,"properties":null,
         "geometry":{"type":"MultiPolygon","coordinates":[[[[0,0,5],[1,0,5],[1,1,5]]]]}}]}"#;

    #[test]
    fn plots_are_named_and_in_pixels() {
        let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32616));
        let plots = parse(PLOTS, Some(&place)).unwrap();
        assert_eq!((plots[0].name.as_str(), plots[0].leaves), ("A", Some(12.0)));
        assert_eq!(plots[0].polygon.rings, [[[0.0, 0.0], [20.0, 0.0], [20.0, 20.0]]]);
        assert_eq!((plots[1].name.as_str(), plots[1].leaves), ("7", None));
        assert_eq!(parse(PLOTS, None).unwrap()[0].polygon.rings[0][0], [100.0, 200.0]);
    }

    #[test]
    fn what_cannot_be_used_is_told() {
        let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32617));
        let error = parse(PLOTS, Some(&place)).unwrap_err();
        assert!(error.contains("EPSG:32616, expected the raster's, EPSG:32617"), "{error}");
        for (text, expected) in [
            ("", "expected GeoJSON"),
            ("{\"type\":\"Topology\"}", "expected GeoJSON"),
            (&PLOTS.replace("12", "\"many\""), "expected a number"),
            (&PLOTS.replace("[110,200],[110,190],", ""), "fewer than three points"),
            (&PLOTS.replace("[110,200]", "[110]"), "fewer than two numbers"),
            (&PLOTS.replace("MultiPolygon", "Point"), "expected GeoJSON"),
        ] {
            let error = parse(text, None).unwrap_err();
            assert!(error.contains(expected) && error.contains("plots.geojson"), "{error}");
        }
    }
}
