//! The map that can be moved, within the page: the orthomosaic with plots, plants, gaps, photos and ground points.
//!
//! `map.js` draws it on a canvas, without any library; what it draws is JSON in the page.

use super::{Facts, pictures};
use crate::{
    Stage,
    plots::{self, PlotsOutcome},
};
use maud::{Markup, PreEscaped, html};
use rowgram_base::error::Error;
use rowgram_files::csv_table::CsvTable;
use rowgram_optim::output::FileError;
use rowgram_plants::phenotype::traits::Trait;
use rowgram_raster::georeference::Georeference;
use rowgram_survey::scene::Role;
use serde_json::{Value, json};

pub(super) const SCRIPT: &str = include_str!("map.js");
pub(super) const PHOTOS_SCRIPT: &str = include_str!("view/photos.js");
/// The longer side of the picture in the page: what a browser holds with ease, and shows rows of plants in a field of half
/// a hectare.
const SIDE_PX: usize = 2400;
/// The trait that plots are coloured by at first; where it is not known, the first that is.
const FIRST_TRAIT: &str = "canopy_cover";

/// What a server adds to the map; its scripts are files then.
#[derive(Debug, Clone, Copy)]
pub(super) struct Served {
    /// The orthomosaic in full resolution.
    pub(super) tiles: bool,
    /// The photos that show a place.
    pub(super) photos: bool,
}

/// The map and what moves it; without an orthomosaic there is none.
///
/// # Errors
/// Files of the results that cannot be read.
pub(super) fn map(facts: &Facts<'_>) -> Result<Option<Markup>, Error> {
    drawn(facts, None)
}

/// As [`map`], for a page that a server sends.
///
/// # Errors
/// As [`map`].
pub(super) fn served(facts: &Facts<'_>, served: Served) -> Result<Markup, Error> {
    Ok(drawn(facts, Some(served))?.unwrap_or_default())
}

fn drawn(facts: &Facts<'_>, served: Option<Served>) -> Result<Option<Markup>, Error> {
    let Some(ortho) = facts.orthomosaic() else { return Ok(None) };
    let source = facts.project.open_picture(&ortho)?;
    let place = source.georeference();
    let overview = pictures::overview(&source, SIDE_PX)?;
    let (width, height) = overview.size;
    let measured = facts.outcome.results.plots.as_ref();
    let all = measured.map(PlotsOutcome::traits).unwrap_or_default();
    let plots = plots(facts, &all, place)?;
    let known: Vec<usize> =
        (0..all.len()).filter(|&k| plots.iter().any(|plot| !plot["values"][k].is_null())).collect();
    let layer = |name: &str| facts.table(Stage::Locate, name);
    let plants = layer("plants.csv")?.map(|table| plants(&table));
    let gaps = layer("gaps.csv")?.map(|table| gaps(&table));
    let (photos, ground) = (photos(facts, place), ground(facts, place));
    let layers = [
        ("plots", "plots", plots.len()),
        ("plants", "plants", length(plants.as_ref())),
        ("gaps", "gaps", length(gaps.as_ref())),
        ("photos", "photos", length(Some(&photos))),
        ("ground", "ground points", length(Some(&ground))),
    ];
    let none = || json!({"u": [], "v": []});
    let data = json!({
        "size": [width, height],
        "gsd_m": facts.outcome.gsd_m,
        "georeference": place.map(|of| [of.origin, of.per_column, of.per_row].concat()),
        "crs": place.and_then(|place| place.crs.epsg).map(|code| format!("EPSG:{code}")),
        "picture": pictures::jpeg(&overview.on_paper(), SIDE_PX as u32)?,
        "traits": all.iter().map(|of| json!({"name": of.name, "meaning": of.meaning})).collect::<Vec<_>>(),
        "plots": plots,
        "plants": plants.unwrap_or_else(none),
        "gaps": gaps.unwrap_or_else(none),
        "photos": photos,
        "ground": ground,
        "tile_px": served.filter(|served| served.tiles).map(|_| super::view::TILE_PX),
    });
    let with_photos = served.is_some_and(|served| served.photos);
    let first = known.iter().position(|&k| all[k].name == FIRST_TRAIT).unwrap_or(0);
    // Nothing in the data may end the script.
    let data = data.to_string().replace('<', "\\u003c");
    Ok(Some(html! {
        div id="field-map" {
            div .tools {
                button type="button" data-zoom="in" aria-label="Zoom in" { "+" }
                button type="button" data-zoom="out" aria-label="Zoom out" { "−" }
                button type="button" data-zoom="all" { "whole field" }
                @for (layer, title, count) in layers {
                    @if count > 0 {
                        label {
                            input type="checkbox" data-layer=(layer) checked[layer == "plots" || layer == "plants"];
                            (title)
                        }
                    }
                }
                @if known.len() > 1 {
                    label {
                        "plots by "
                        select {
                            @for (at, &k) in known.iter().enumerate() {
                                option value=(all[k].name) title=(all[k].meaning) selected[at == first] { (all[k].name.replace('_', " ")) }
                            }
                        }
                    }
                    span .colour-bar hidden { span {} i {} span {} }
                }
            }
            div .sheet {
                canvas tabindex="0" role="img" aria-label="Map of the field: drag to move, wheel or plus and minus to zoom, click for values" {}
                div .hover hidden {}
            }
            div .values aria-live="polite" {
                p .note { "Drag to move the map, turn the wheel to zoom, click for values." }
            }
            @if with_photos { div .photos {} }
            script id="field-map-data" type="application/json" { (PreEscaped(data)) }
            @if served.is_some() { script src="map.js" {} } @else { script { (PreEscaped(SCRIPT)) } }
            @if with_photos { script src="photos.js" {} }
        }
    }))
}

/// Number of places of a layer.
fn length(layer: Option<&Value>) -> usize {
    layer.and_then(|layer| layer["u"].as_array()).map_or(0, Vec::len)
}

/// A tenth of a pixel is finer than anybody points.
fn tenth(value: f64) -> f64 {
    (10.0 * value).round() / 10.0
}

fn column(values: impl Iterator<Item = f64>) -> Vec<Value> {
    values.map(|value| if value.is_finite() { json!(value) } else { Value::Null }).collect()
}

/// Columns `u` and `v` of a table.
fn places(table: &CsvTable) -> [Vec<Value>; 2] {
    ["u_px", "v_px"].map(|name| {
        let numbers = table.numbers(name).unwrap_or_default();
        column(numbers.into_iter().map(tenth))
    })
}

fn plants(table: &CsvTable) -> Value {
    let [u, v] = places(table);
    let confidence = table.numbers("confidence").unwrap_or_else(|| vec![1.0; table.len()]);
    let row = table.numbers("row").unwrap_or_else(|| vec![f64::NAN; table.len()]);
    json!({"u": u, "v": v, "confidence": column(confidence.into_iter()), "row": column(row.into_iter())})
}

fn gaps(table: &CsvTable) -> Value {
    let [u, v] = places(table);
    json!({"u": u, "v": v, "plants": column(table.numbers("plants").unwrap_or_default().into_iter())})
}

/// Polygons of the plots with the values of all traits.
fn plots(
    facts: &Facts<'_>,
    all: &[Trait],
    place: Option<Georeference>,
) -> Result<Vec<Value>, Error> {
    let (Some(outcome), Some(path)) =
        (&facts.outcome.results.plots, facts.file(Stage::Plots, plots::POLYGONS))
    else {
        return Ok(Vec::new());
    };
    let text = std::fs::read(&path).map_err(|e| FileError::read(&path, e))?;
    let collection: Value = serde_json::from_slice(&text)
        .map_err(|e| FileError::malformed(&path, e.line(), e.to_string()))?;
    let features = collection["features"].as_array().cloned().unwrap_or_default();
    let pixel = |at: &Value| -> Option<[f64; 2]> {
        let at = [at[0].as_f64()?, at[1].as_f64()?];
        place.map_or(Some(at), |place| place.pixel(at)).map(|at| at.map(tenth))
    };
    let ring = |ring: &Value| -> Vec<[f64; 2]> {
        ring.as_array().into_iter().flatten().filter_map(pixel).collect()
    };
    let shown = features.iter().zip(&outcome.plots).map(|(feature, traits)| {
        let rings = feature["geometry"]["coordinates"].as_array().into_iter().flatten();
        json!({
            "name": traits.plot,
            "rings": rings.map(ring).collect::<Vec<_>>(),
            "values": all.iter().map(|of| of.value(traits)).collect::<Vec<_>>(),
        })
    });
    Ok(shown.collect())
}

/// Where the cameras were.
fn photos(facts: &Facts<'_>, place: Option<Georeference>) -> Value {
    let (mut u, mut v, mut names) = (Vec::new(), Vec::new(), Vec::new());
    if let (Some((scene, _)), Some(place)) = (&facts.block, place) {
        for image in &scene.images {
            let [x, y, _] = image.pose.centre_m();
            if let Some(at) = place.pixel([x, y]) {
                u.push(tenth(at[0]));
                v.push(tenth(at[1]));
                names.push(image.name.as_str());
            }
        }
    }
    json!({"u": u, "v": v, "name": names})
}

/// Control and check points with their errors.
fn ground(facts: &Facts<'_>, place: Option<Georeference>) -> Value {
    let (mut u, mut v, mut names, mut checks) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut errors = Vec::new();
    if let (Some((_, adjustment)), Some(place)) = (&facts.block, place) {
        for point in &adjustment.ground {
            let [x, y, _] = point.adjusted_m;
            if let Some(at) = place.pixel([x, y]) {
                u.push(tenth(at[0]));
                v.push(tenth(at[1]));
                names.push(point.name.as_str());
                checks.push(point.role == Role::Check);
                let cm = |metres: f64| format!("{:.1}", 100.0 * metres);
                errors.push(point.difference_m.map(cm).join(", "));
            }
        }
    }
    json!({"u": u, "v": v, "name": names, "check": checks, "error_cm": errors})
}
