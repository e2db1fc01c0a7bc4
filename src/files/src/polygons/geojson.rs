//! GeoJSON: a `FeatureCollection`, or one `Feature`, with `Polygon`s and `MultiPolygon`s.

use super::{Feature, Rings, Shape, systems::Stated};
use crate::table::read_text;
use rowgram_optim::output::FileError;
use serde_json::{Map, Value};
use std::path::Path;

/// The polygons of a file, and what its coordinates are.
pub(super) fn read(path: &Path) -> Result<(Vec<Feature>, Stated), FileError> {
    let text = read_text(path)?;
    let document = serde_json::from_str(&text);
    // Some programs write NaN, which is no JSON, for a value that is missing.
    let document =
        document.or_else(|error| serde_json::from_str(&without_nan(&text)).or(Err(error)));
    let document: Value = document.map_err(|error| {
        let message = format!(
            "it is no JSON (column {}); expected GeoJSON with Polygon or MultiPolygon features",
            error.column()
        );
        FileError::malformed(path, Some(error.line()), message)
    })?;
    let malformed = |message: String| FileError::malformed(path, None, message);
    let items = match (document["type"].as_str(), &document["features"]) {
        (Some("FeatureCollection"), Value::Array(items)) => &items[..],
        (Some("Feature"), _) => std::slice::from_ref(&document),
        (kind, _) => {
            let kind = kind.map_or("nothing".to_owned(), |kind| format!("{kind:?}"));
            return Err(malformed(format!(
                "its type is {kind}, expected GeoJSON: a FeatureCollection with Polygon or MultiPolygon features"
            )));
        }
    };
    let stated = stated(&document["crs"]).map_err(|name| {
        malformed(format!("its crs is {name}, expected a code such as urn:ogc:def:crs:EPSG::32616"))
    })?;
    let features = items.iter().enumerate().map(|(index, item)| {
        feature(item).map_err(|message| malformed(format!("feature {}: {message}", index + 1)))
    });
    Ok((features.collect::<Result<_, _>>()?, stated))
}

/// JSON with `null` for each `NaN` and infinity outside of texts.
fn without_nan(text: &str) -> String {
    let mut is_text = false;
    let parts = text.split_inclusive('"').map(|part| {
        let (was_text, slashes) = (is_text, part.trim_end_matches('"'));
        let escaped = slashes.len() - slashes.trim_end_matches('\\').len();
        is_text ^= part.ends_with('"') && !(was_text && escaped % 2 == 1);
        match was_text {
            true => part.to_owned(),
            false => ["-Infinity", "Infinity", "-NaN", "NaN", "nan"]
                .iter()
                .fold(part.to_owned(), |part, word| part.replace(word, "null")),
        }
    });
    parts.collect()
}

/// The code at the end of a name such as `urn:ogc:def:crs:EPSG::32616`, of a compound one the first, which is in plan; `CRS84` is
/// longitude and latitude.
fn stated(crs: &Value) -> Result<Stated, String> {
    let name = &crs["properties"]["name"];
    if name.is_null() {
        return Ok(Stated::Nothing);
    }
    let text = name.as_str().unwrap_or_default();
    let mut parts = text.split([',', '&', '+']);
    let plan = parts.find(|part| part.contains(|c: char| c.is_ascii_digit())).unwrap_or_default();
    let last = plan.rsplit([':', '/']).next().unwrap_or_default();
    match last.parse() {
        _ if last == "CRS84" => Ok(Stated::Degrees),
        Ok(code) if text.to_uppercase().contains("EPSG") => Ok(Stated::code(code)),
        _ => Err(name.to_string()),
    }
}

fn feature(item: &Value) -> Result<Feature, String> {
    let properties = match &item["properties"] {
        Value::Object(properties) => properties.clone(),
        _ => Map::new(),
    };
    let id = Some(item["id"].clone()).filter(|id| !id.is_null());
    Ok(Feature { shape: shape(&item["geometry"])?, properties, id })
}

fn shape(geometry: &Value) -> Result<Shape, String> {
    let coordinates = &geometry["coordinates"];
    let polygons = match geometry["type"].as_str() {
        None => return Ok(Shape::NoArea("has no geometry".to_owned())),
        Some("Polygon") => vec![rings(coordinates)?],
        Some("MultiPolygon") => {
            let parts = coordinates.as_array().map(Vec::as_slice).unwrap_or_default();
            parts.iter().map(rings).collect::<Result<_, _>>()?
        }
        Some("GeometryCollection") => {
            let members = geometry["geometries"].as_array().map(Vec::as_slice).unwrap_or_default();
            let mut found = Vec::new();
            for member in members {
                if let Shape::Polygons(polygons) = shape(member)? {
                    found.extend(polygons);
                }
            }
            found
        }
        Some(other) => return Ok(Shape::NoArea(format!("is a {other}"))),
    };
    let polygons: Vec<Rings> = polygons.into_iter().filter(|rings| !rings.is_empty()).collect();
    Ok(match polygons.is_empty() {
        true => Shape::NoArea("has an empty geometry".to_owned()),
        false => Shape::Polygons(polygons),
    })
}

fn rings(coordinates: &Value) -> Result<Rings, String> {
    let list =
        |value: &Value| value.as_array().cloned().ok_or("its coordinates are no list".to_owned());
    let position = |position: &Value| {
        let numbers = position.as_array().map(Vec::as_slice).unwrap_or_default();
        match numbers {
            [x, y, ..] => match (x.as_f64(), y.as_f64()) {
                (Some(x), Some(y)) => Ok([x, y]),
                _ => Err(format!("the position {position} is no pair of numbers")),
            },
            _ => Err("a position has fewer than two numbers".to_owned()),
        }
    };
    let ring = |ring: &Value| list(ring)?.iter().map(position).collect::<Result<Vec<_>, _>>();
    list(coordinates)?.iter().map(ring).collect()
}
