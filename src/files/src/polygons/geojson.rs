//! GeoJSON: a `FeatureCollection` (or one `Feature`) of `Polygon`s and `MultiPolygon`s.

use super::{Feature, Stated};
use rowgram_optim::output::FileError;
use serde::Deserialize;
use serde_json::{Map, Value};
use std::path::Path;

#[derive(Deserialize)]
#[serde(tag = "type")]
enum Document {
    FeatureCollection { features: Vec<Item>, crs: Option<Value> },
    Feature(Item),
}

#[derive(Deserialize)]
struct Item {
    geometry: Geometry,
    #[serde(default)]
    properties: Option<Map<String, Value>>,
    id: Option<Value>,
}

type Rings = Vec<Vec<Vec<f64>>>;

#[derive(Deserialize)]
#[serde(tag = "type", content = "coordinates")]
enum Geometry {
    Polygon(Rings),
    MultiPolygon(Vec<Rings>),
}

/// The polygons of a file, and what its coordinates are.
pub(super) fn read(path: &Path) -> Result<(Vec<Feature>, Stated), FileError> {
    let text = std::fs::read_to_string(path).map_err(|error| FileError::read(path, error))?;
    let document: Document = serde_json::from_str(&text).map_err(|error| {
        let message = format!("{error}; expected GeoJSON with Polygon or MultiPolygon features");
        FileError::malformed(path, Some(error.line()), message)
    })?;
    let (items, crs) = match document {
        Document::FeatureCollection { features, crs } => (features, crs),
        Document::Feature(feature) => (vec![feature], None),
    };
    let stated = stated(crs.as_ref()).map_err(|name| {
        let message =
            format!("its crs is {name}, expected a code such as urn:ogc:def:crs:EPSG::32616");
        FileError::malformed(path, None, message)
    })?;
    let features = items.into_iter().enumerate().map(|(index, item)| {
        feature(item).map_err(|message| {
            FileError::malformed(path, None, format!("feature {}: {message}", index + 1))
        })
    });
    Ok((features.collect::<Result<_, _>>()?, stated))
}

/// The code at the end of a name such as `urn:ogc:def:crs:EPSG::32616`; `CRS84` is longitude and latitude.
fn stated(crs: Option<&Value>) -> Result<Stated, String> {
    let name = crs.and_then(|crs| crs.get("properties")?.get("name"));
    let Some(name) = name else { return Ok(Stated::Nothing) };
    let text = name.as_str().unwrap_or_default();
    let last = text.rsplit(':').next().unwrap_or_default();
    match last.parse() {
        _ if last == "CRS84" => Ok(Stated::Degrees),
        Ok(code) if text.to_uppercase().contains("EPSG") => Ok(Stated::code(code)),
        _ => Err(name.to_string()),
    }
}

fn feature(item: Item) -> Result<Feature, String> {
    let parts = match item.geometry {
        Geometry::Polygon(rings) => vec![rings],
        Geometry::MultiPolygon(parts) => parts,
    };
    let position = |position: Vec<f64>| match position[..] {
        [x, y, ..] => Ok([x, y]),
        _ => Err("a position has fewer than two numbers".to_owned()),
    };
    let rings = parts.into_iter().flatten().map(|ring| ring.into_iter().map(position).collect());
    Ok(Feature {
        rings: rings.collect::<Result<_, String>>()?,
        properties: item.properties.unwrap_or_default(),
        id: item.id,
    })
}
