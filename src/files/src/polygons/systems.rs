//! What the coordinates of polygons are, and how they become those of a raster's map.
//!
//! A GeoJSON file that states no system is in longitude and latitude where the standard says so (RFC 7946) and its numbers
//! allow nothing else, otherwise in the raster's own.

use super::Feature;
use rowgram_raster::{
    crs,
    georeference::{CrsKind, Georeference},
};

/// What the coordinates of a file are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Stated {
    /// The file does not say.
    Nothing,
    /// Longitude and latitude, degrees.
    Degrees,
    /// A system of the EPSG registry.
    Epsg(u32),
    /// A system without a code: its PROJ string.
    Definition(String),
}

impl Stated {
    /// A code of the registry. Geographic ones are degrees whatever their datum is where that differs from WGS84 by less than
    /// the outline of a plot is worth.
    pub(super) fn code(epsg: u32) -> Stated {
        match crs::Crs::of_code(epsg) {
            Ok(system) if system.is_geographic() && system.is_global() => Stated::Degrees,
            _ => Stated::Epsg(epsg),
        }
    }

    /// What well-known text describes.
    pub(super) fn well_known_text(text: &str) -> Result<Stated, String> {
        let system = crs::Crs::of_well_known_text(text).map_err(|error| error.to_string())?;
        Ok(match system.epsg() {
            Some(code) => Stated::code(code),
            None if system.is_geographic() && system.is_global() => Stated::Degrees,
            None => Stated::Definition(system.definition().to_owned()),
        })
    }

    fn system(&self) -> Result<Option<crs::Crs>, String> {
        match self {
            Stated::Nothing => Ok(None),
            Stated::Degrees => crs::Crs::of_code(4326).map(Some),
            Stated::Epsg(code) => crs::Crs::of_code(*code).map(Some),
            Stated::Definition(definition) => crs::Crs::of_definition(definition).map(Some),
        }
        .map_err(|error| error.to_string())
    }

    fn for_people(&self) -> String {
        match self {
            Stated::Nothing => "does not say its reference system".to_owned(),
            Stated::Degrees => "says that it is in longitude and latitude".to_owned(),
            Stated::Epsg(code) => format!("says that it is in EPSG:{code}"),
            Stated::Definition(definition) => format!("says that it is in {definition}"),
        }
    }
}

/// Whether two systems that do not say how their datum lies to WGS84 have the same.
fn same_datum(a: &crs::Crs, b: &crs::Crs) -> bool {
    let of = |system: &crs::Crs| -> Vec<String> {
        let datum = ["+ellps=", "+datum=", "+towgs84=", "+a=", "+b=", "+rf=", "+nadgrids="];
        let words = system.definition().split_whitespace();
        words
            .filter(|word| datum.iter().any(|key| word.starts_with(key)))
            .map(str::to_owned)
            .collect()
    };
    of(a) == of(b)
}

/// From coordinates of a file to those of a map.
pub(super) type ToMap = Box<dyn Fn([f64; 2]) -> Result<[f64; 2], String>>;

pub(super) fn in_degrees([x, y]: [f64; 2]) -> bool {
    x.abs() <= 180.0 && y.abs() <= 90.0
}

/// How coordinates of a file become those of the raster's map.
pub(super) fn to_map(
    place: Option<&Georeference>,
    stated: &Stated,
    features: &[Feature],
) -> Result<ToMap, String> {
    let Some(place) = place else {
        return match stated {
            Stated::Nothing => Ok(Box::new(Ok)),
            _ => Err(
                "it has a reference system and the raster has none: draw the polygons in pixels"
                    .into(),
            ),
        };
    };
    let all_degrees = || features.iter().flat_map(Feature::positions).all(in_degrees);
    let is_known = place.crs.kind != CrsKind::Geographic && place.crs.system().is_some();
    let stated = match stated {
        Stated::Nothing if is_known && !in_degrees(place.origin) && all_degrees() => {
            &Stated::Degrees
        }
        stated => stated,
    };
    from_to(stated, place)
}

fn from_to(stated: &Stated, place: &Georeference) -> Result<ToMap, String> {
    let is_same = match stated {
        Stated::Nothing => true,
        Stated::Epsg(code) => place.crs.epsg == Some(*code),
        Stated::Degrees => place.crs.kind == CrsKind::Geographic,
        Stated::Definition(definition) => place.crs.definition == Some(definition),
    };
    let Some(from) = stated.system()?.filter(|_| !is_same) else { return Ok(Box::new(Ok)) };
    let Some(onto) = place.crs.system() else {
        return Err(match (stated, place.crs.epsg) {
            (_, Some(code)) => format!(
                "the raster is in EPSG:{code}, which is not known; the file {}",
                stated.for_people()
            ),
            (Stated::Degrees, _) => {
                "it is in longitude and latitude, and the raster does not say its reference system"
                    .to_owned()
            }
            (_, None) => format!(
                "it is in {}, and the raster does not say its reference system",
                from.name()
            ),
        });
    };
    // Well-known text of Esri names a datum and does not say where it lies: some hundred metres from WGS84, or more.
    for definition in [from.definition(), onto.definition()] {
        let is_known =
            crs::knows_datum(definition) && !definition.contains("+towgs84=0,0,0,0,0,0,0");
        if !is_known && !crs::is_global(definition) && !same_datum(&from, &onto) {
            return Err(format!(
                "where the datum of its system ({definition}) lies is not known; save the file in the system of the map"
            ));
        }
    }
    Ok(Box::new(move |[x, y]| {
        let [latitude, longitude] = from.to_wgs84(x, y).map_err(|e| e.to_string())?;
        onto.from_wgs84(latitude, longitude).map_err(|e| e.to_string())
    }))
}

/// Why no polygon lies on a raster: the reading of the coordinates under which most do, or how far away they are.
pub(super) fn misfit(
    place: Option<&Georeference>,
    (width, height): (usize, usize),
    stated: &Stated,
    features: &[Feature],
) -> Option<String> {
    let place = place?;
    let middles: Vec<[f64; 2]> = features.iter().filter_map(middle).collect();
    let system = place.crs.system()?;
    let size = [width as f64, height as f64];
    let centre = place.map([0.5 * size[0], 0.5 * size[1]]);
    let [latitude, longitude] = system.to_wgs84(centre[0], centre[1]).ok()?;
    let on_raster = |reading: &ToMap| {
        let is_on = |at: &&[f64; 2]| {
            let pixel = reading(**at).ok().and_then(|at| place.pixel(at));
            pixel.is_some_and(|at| (0..2).all(|k| at[k] >= -0.5 && at[k] < size[k] - 0.5))
        };
        2 * middles.iter().filter(is_on).count() > middles.len()
    };
    let exchanged = |reading: ToMap| -> ToMap { Box::new(move |[x, y]| reading([y, x])) };
    let all = middles.len();
    let off = format!("none of its {all} polygons lies on the map");
    let map_name = match place.crs.epsg {
        Some(code) => format!("EPSG:{code}"),
        None => "the system of the map".to_owned(),
    };
    // The usual errors first: axes exchanged, then the systems that are used where the map lies.
    let mut readings =
        vec![(stated.clone(), true), (Stated::Degrees, false), (Stated::Degrees, true)];
    readings.extend(systems_near(latitude, longitude).map(|code| (Stated::Epsg(code), false)));
    readings.extend(place.crs.epsg.map(|code| (Stated::Epsg(code), false)));
    readings.extend(place.crs.epsg.map(|code| (Stated::Epsg(code), true)));
    for (reading, is_exchanged) in readings {
        let Ok(straight) = from_to(&reading, place) else { continue };
        let to_map = if is_exchanged { exchanged(straight) } else { straight };
        if !on_raster(&to_map) {
            continue;
        }
        let read = match &reading {
            Stated::Nothing => map_name.clone(),
            Stated::Degrees if is_exchanged => "latitude, longitude".to_owned(),
            Stated::Degrees => "longitude, latitude".to_owned(),
            Stated::Epsg(code) => format!("EPSG:{code}"),
            Stated::Definition(definition) => definition.clone(),
        };
        let (cause, remedy) = if is_exchanged {
            let axes = "x and y are exchanged".to_owned();
            let which = if in_degrees(middles[0]) {
                "latitude stands before longitude".to_owned()
            } else {
                axes
            };
            (which, "write x (longitude, easting) before y".to_owned())
        } else {
            (
                format!("it {}", stated.for_people()),
                format!("state {read} in the file, or save it in {map_name}"),
            )
        };
        return Some(format!("{off}; read as {read} they do: {cause}. {remedy}"));
    }
    let reading = from_to(stated, place).ok()?;
    let first = middles.first().and_then(|&at| reading(at).ok())?;
    let unit_m = place.gsd_m()?
        / place.pixel([place.origin[0] + 1.0, place.origin[1]]).map(|at| {
            let first = place.pixel(place.origin).unwrap_or_default();
            1.0 / (at[0] - first[0]).hypot(at[1] - first[1])
        })?;
    let apart_km = (first[0] - centre[0]).hypot(first[1] - centre[1]) * unit_m / 1000.0;
    Some(format!(
        "{off}; they are about {apart_km:.1} km away from it (it {}): is it of another field, or in another reference system \
         than it says?",
        stated.for_people()
    ))
}

/// The middle of the box around a feature.
fn middle(feature: &Feature) -> Option<[f64; 2]> {
    let first = feature.positions().next()?;
    let [low, high] = feature.positions().fold([first; 2], |[low, high], at| {
        [[0, 1].map(|k| at[k].min(low[k])), [0, 1].map(|k| at[k].max(high[k]))]
    });
    Some([0, 1].map(|k| 0.5 * (low[k] + high[k])))
}

/// Codes of systems that are used at a place: UTM zones around it on the usual datums, and the projection of web maps.
fn systems_near(latitude_deg: f64, longitude_deg: f64) -> impl Iterator<Item = u32> {
    let zone = ((longitude_deg + 180.0) / 6.0).floor() as i64 + 1;
    let near = [0, 1, -1, 2, -2].map(|step| ((zone + step - 1).rem_euclid(60) + 1) as u32);
    let base: &[u32] = if latitude_deg < 0.0 { &[32700, 32600] } else { &[32600, 32700] };
    let utm = base.iter().flat_map(move |base| near.map(|zone| base + zone));
    utm.collect::<Vec<_>>().into_iter().chain([3857])
}
