//! Which property of polygons is their name.

use super::{Feature, Shape};
use crate::words::is_none;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};

/// Properties that are a name, the first one first; compared without case, spaces and underscores. That of a plot goes before
/// `name`, which may be that of a genotype, and before numbers that programs give to rows.
pub const NAMES: [&str; 9] =
    ["plot", "plotid", "plotname", "plotno", "plotnumber", "name", "id", "fid", "objectid"];
/// Properties that are no attributes: the number of leaves, and numbers that programs give to rows.
const NO_ATTRIBUTES: [&str; 4] = ["leaves", "fid", "ogc_fid", "objectid"];

fn plain(name: &str) -> String {
    name.chars().filter(|c| c.is_alphanumeric()).flat_map(char::to_lowercase).collect()
}

/// The names of features.
pub(super) struct Names {
    /// The property that has them; `None` where they are numbers.
    pub(super) key: Option<String>,
    /// Those of all features.
    pub(super) texts: Vec<String>,
}

/// The name that a value is: 101.0 is 101.
fn text(value: &Value) -> Option<String> {
    match value {
        Value::String(text) => Some(text.trim().to_owned()).filter(|text| !text.is_empty()),
        Value::Number(number) => match number.as_f64() {
            Some(x) if x.fract() == 0.0 && x.abs() < 9e15 => Some(format!("{x:.0}")),
            _ => Some(number.to_string()),
        },
        Value::Bool(is) => Some(is.to_string()),
        Value::Null | Value::Array(_) | Value::Object(_) => None,
    }
}

/// What a feature is called that has no name where others have one: its number may be the name of another plot, or in a field book.
const UNNAMED: &str = "unnamed";

/// The name of each feature by a property; by its number where no feature has that.
fn by(features: &[Feature], key: &str) -> Vec<String> {
    let value = |feature: &Feature| feature.properties.get(key).and_then(text);
    let is_named = features.iter().any(|feature| value(feature).is_some());
    let name = |(index, feature): (usize, &Feature)| {
        let id = || feature.id.as_ref().and_then(text);
        let number = match is_named {
            true => format!("{UNNAMED} {}", index + 1),
            false => (index + 1).to_string(),
        };
        value(feature).or_else(id).unwrap_or(number)
    };
    features.iter().enumerate().map(name).collect()
}

/// Features with an area that have no name where others have one.
fn without_name(features: &[Feature], Names { key, texts }: &Names) -> Option<String> {
    let key = key.as_deref()?;
    let is_without = |(feature, name): &(&Feature, &String)| {
        let has_area = matches!(feature.shape, Shape::Polygons(_));
        has_area
            && name.starts_with(UNNAMED)
            && feature.properties.get(key).and_then(text).is_none()
    };
    let all = features.iter().zip(texts).filter(is_without);
    let names: Vec<&str> = all.map(|(_, name)| name.as_str()).collect();
    (!names.is_empty()).then(|| {
        format!("polygons have no {key}, so no table of plots can name them: {}", names.join(", "))
    })
}

/// The first name that two features with an area have.
fn repeated<'a>(features: &[Feature], names: &'a [String]) -> Option<&'a str> {
    let mut seen = BTreeSet::new();
    let areas = features.iter().zip(names);
    let mut areas = areas.filter(|(feature, _)| matches!(feature.shape, Shape::Polygons(_)));
    areas.find(|(_, name)| !seen.insert(name.as_str())).map(|(_, name)| name.as_str())
}

/// The names of features: of the property that is given, else of the first usual one in which all differ.
pub(super) fn of(
    features: &[Feature],
    given: Option<&str>,
    notes: &mut Vec<String>,
) -> Result<Names, String> {
    let names = chosen(features, given, notes)?;
    notes.extend(without_name(features, &names));
    Ok(names)
}

fn chosen(
    features: &[Feature],
    given: Option<&str>,
    notes: &mut Vec<String>,
) -> Result<Names, String> {
    // In their order in the file, which maps of properties do not keep.
    let mut keys: BTreeMap<&str, usize> = BTreeMap::new();
    for key in features.iter().flat_map(|feature| feature.properties.iter()) {
        if text(key.1).is_some() {
            *keys.entry(key.0).or_default() += 1;
        }
    }
    let listed = || keys.keys().copied().collect::<Vec<_>>().join(", ");
    if let Some(given) = given {
        let key = keys.keys().find(|key| key.eq_ignore_ascii_case(given)).ok_or_else(|| {
            format!(
                "no polygon has the property {given} ([project] plot_key); there are: {}",
                listed()
            )
        })?;
        let texts = by(features, key);
        return match repeated(features, &texts) {
            Some(name) => Err(format!(
                "two polygons are named {name:?} by {key} ([project] plot_key), expected a name for each"
            )),
            None => Ok(Names { key: Some((*key).to_owned()), texts }),
        };
    }
    let usual: Vec<&str> = (NAMES.iter())
        .flat_map(|name| keys.keys().copied().filter(move |key| plain(key) == *name))
        .collect();
    let is_unique = |key: &str| repeated(features, &by(features, key)).is_none();
    let unique: Vec<&str> = usual.iter().copied().filter(|key| is_unique(key)).collect();
    if let Some(key) = unique.first() {
        let repeated: Vec<&str> = usual.iter().copied().take_while(|other| other != key).collect();
        let others =
            unique[1..].iter().filter(|key| !["fid", "objectid"].contains(&plain(key).as_str()));
        let others: Vec<&str> = others.copied().collect();
        if !(repeated.is_empty() && others.is_empty()) {
            let mut note = format!("polygons are named by {key}");
            if !repeated.is_empty() {
                note += &format!(" ({} has the same name several times)", repeated.join(", "));
            }
            if !others.is_empty() {
                note += &format!("; {} would do as well", others.join(", "));
            }
            notes.push(note + " ([project] plot_key)");
        }
        return Ok(Names { key: Some((*key).to_owned()), texts: by(features, key) });
    }
    let numbers = by(features, "");
    let key = usual.first().map(|key| (*key).to_owned());
    let texts = key.as_ref().map_or(numbers, |key| by(features, key));
    match repeated(features, &texts) {
        Some(name) => {
            let usable: Vec<&str> = keys.keys().copied().filter(|key| is_unique(key)).collect();
            let remedy = match usable[..] {
                [] => "parts of one plot belong into one MultiPolygon".to_owned(),
                _ => format!("unique are: {} ([project] plot_key)", usable.join(", ")),
            };
            Err(format!("two polygons are named {name:?}, expected a name for each; {remedy}"))
        }
        None => {
            if key.is_none()
                && !keys.is_empty()
                && features.iter().all(|feature| feature.id.is_none())
            {
                notes.push(format!(
                    "polygons are named by their number: no property is one of {} ([project] plot_key; there are: {})",
                    NAMES.join(", "),
                    listed()
                ));
            }
            Ok(Names { key, texts })
        }
    }
}

type Properties = (Option<f64>, Vec<(String, Value)>);

/// The counted leaves and the attributes of a feature.
pub(super) fn properties(
    feature: &Feature,
    name: &str,
    key: Option<&str>,
) -> Result<Properties, String> {
    let counted = feature.properties.iter().find(|(key, _)| key.eq_ignore_ascii_case("leaves"));
    let leaves = match counted.map(|(_, value)| value).filter(|value| !value.is_null()) {
        // A shapefile or a form may have a column of text.
        Some(Value::String(text)) if is_none(text) => None,
        Some(value) => {
            let number = match value {
                Value::String(text) => text.trim().parse().ok().filter(|x: &f64| x.is_finite()),
                value => value.as_f64(),
            };
            Some(number.ok_or_else(|| {
                format!("feature {name}: its property leaves is {value}, expected a number")
            })?)
        }
        None => None,
    };
    let is_own = |other: &str| {
        key == Some(other) || NO_ATTRIBUTES.iter().any(|own| own.eq_ignore_ascii_case(other))
    };
    let attributes = feature.properties.iter().filter(|(key, value)| {
        !is_own(key) && (value.is_string() || value.is_number() || value.is_boolean())
    });
    Ok((leaves, attributes.map(|(key, value)| (key.clone(), value.clone())).collect()))
}
