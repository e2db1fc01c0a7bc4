//! Plot layouts: plots from corners and a design, or from polygons that are there; and their refinement on the rows that
//! the stage locate found.
//!
//! Written into a folder: `plots.gpkg`, `plots.geojson`, `plots.shp` (with its `.dbf`, `.shx`, `.prj`), `layout.csv` (a row per plot:
//! standard deviations and what was found of it), `layout.json` (the outcome), and with a picture `figures/layout.png`.

mod field;
mod files;
mod options;
mod outcome;

pub use options::LayoutOptions;
pub use outcome::{CornerResidual, Estimate, LayoutOutcome, PlotOutcome, RefinedLayout};

use super::super::{Project, Stage};
use field::Field;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
    options::{Choice, Options},
};
use rowgram_files::{
    csv_table::CsvTable,
    field_design::{FieldMap, Surveyed, corner_system, read_corners, read_field_map},
    polygons,
};
use rowgram_optim::output::{FileError, name_of};
use rowgram_plants::{
    phenotype::layout::{
        Plan,
        design::FieldCorner,
        observed::{FoundPlant, FoundRows},
        polygons as drawn,
        refine::refine,
    },
    problems::plot_layout::{
        AFFINE, Covariance, FREE, Placement,
        corners::{self, Corner},
    },
};
use rowgram_raster::{
    crs,
    georeference::{Crs, Georeference},
};
use serde_json::Value;
use std::path::Path;

/// Where a layout comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LayoutSource<'a> {
    /// A table of surveyed corners, with the design of the options.
    Corners(&'a Path),
    /// Polygons that are there.
    Polygons(&'a Path),
}

/// What is made into a layout.
#[derive(Debug)]
pub struct LayoutRequest<'a> {
    /// Where it comes from.
    pub source: LayoutSource<'a>,
    /// Entries of the plots, a table.
    pub field_map: Option<&'a Path>,
    /// The coordinate reference system of the corners, in words; that of the project, else a UTM zone for degrees.
    pub crs: Option<&'a str>,
    /// The project whose rows the layout is moved onto.
    pub project: Option<&'a Project>,
    /// The folder to write into.
    pub output: &'a Path,
    /// Whether files that exist are replaced.
    pub force: bool,
}

/// A plan, its place, and what comes with it.
struct Laid {
    plan: Plan,
    placement: Placement,
    /// Covariance of the place, where corners say it.
    covariance: Option<Covariance>,
    corners: Vec<CornerResidual>,
    /// Attributes of each plot.
    attributes: Vec<Vec<(String, Value)>>,
}

/// Makes a layout and writes it.
///
/// # Errors
/// Options that do not make a design, files that cannot be read or written, corners that do not fit anything, a project
/// without rows for polygons, rows that are not those of the layout.
pub fn layout(
    request: &LayoutRequest<'_>,
    options: &LayoutOptions,
    monitor: &mut dyn Monitor,
) -> Result<LayoutOutcome, Error> {
    options.validate().map_err(|why| Error::Argument(format!("[layout] {why}")))?;
    files::check(request.output, request.force)?;
    let field = request.project.map(Field::of).transpose()?.flatten();
    let crs = match (&field, request.source) {
        (Some(field), _) => field.place.crs,
        (None, LayoutSource::Corners(path)) => crs_of(request, path)?,
        (None, LayoutSource::Polygons(_)) => {
            return Err(Error::NothingToDo(
                "polygons are moved onto the rows of a project, and there is no orthomosaic"
                    .to_owned(),
            ));
        }
    };
    let metres = crs.kind.metres_per_unit().ok_or_else(|| {
        Error::Argument("the map is in degrees, expected a projected system in metres".to_owned())
    })?;
    if let Some(scale) = field.as_ref().and_then(|field| field.place.map_scale())
        && (scale - 1.0).abs() > 1e-3
    {
        return Err(Error::Argument(format!(
            "a metre of the map is {scale:.3} m on the ground, and layouts are laid out in metres: save the orthomosaic in a \
             projected system made for surveys, as UTM"
        )));
    }
    let plants = match request.project {
        Some(project) => plants(project, field.as_ref(), metres)?,
        None => None,
    };
    let mut laid = match request.source {
        LayoutSource::Corners(path) => from_corners(path, crs, metres, options, monitor)?,
        LayoutSource::Polygons(path) => {
            let found = plants.as_deref().ok_or_else(|| {
                Error::NothingToDo(
                    "no plants were located, which polygons are moved onto".to_owned(),
                )
            })?;
            from_polygons(path, field.as_ref(), metres, found, options)?
        }
    };
    if let Some(path) = request.field_map {
        join(&mut laid, &read_field_map(path)?, path, monitor);
    }
    let before = laid.placement;
    let refinement = match (&plants, &field) {
        (Some(plants), Some(field)) => {
            let is_visible = |at: [f64; 2]| field.is_visible(at.map(|x| x / metres));
            let assumed = options.assumptions();
            let found = refine(&laid.plan, &before, plants, &assumed, &is_visible)?;
            laid.placement = found.fit.placement;
            laid.covariance = Some(found.fit.covariance);
            Some(found)
        }
        _ => {
            if request.project.is_some() {
                let message = "no plants were located, so it lies where its corners are";
                monitor.diagnostic(
                    &Diagnostic::warning("layout-not-refined", "layout", message)
                        .with_remedy("run rowgram locate first, then this again"),
                );
            }
            None
        }
    };
    let outcome = outcome::of(&laid, &before, refinement.as_ref(), crs);
    outcome.tell(&laid.plan, refinement.as_ref(), monitor);
    files::write(request, &laid, refinement.as_ref(), (crs, metres), &outcome, monitor)?;
    if let Some(field) = &field {
        field.tell_outside(&laid, metres, monitor);
        field.draw(&laid, &before, metres, &request.output.join("figures"), request.force)?;
    }
    Ok(outcome)
}

/// The system that a table of corners names in its first line.
fn stated(path: &Path) -> Result<Option<crs::Crs>, FileError> {
    let system = corner_system(path)?.map(|words| crs::Crs::from_words(&words)).transpose();
    system.map_err(|why| FileError::malformed(path, 1, why.to_string()))
}

/// The system of corners that no project places: the one that is named, that of their table, the UTM zone of degrees, else metres of one's own.
fn crs_of(request: &LayoutRequest<'_>, path: &Path) -> Result<Crs, Error> {
    let of_words = |words: &str| {
        crs::Crs::from_words(words).map_err(|why| Error::Argument(format!("--crs {words}: {why}")))
    };
    let of_project = || request.project.and_then(|project| project.config().project.crs.as_deref());
    let named = match request.crs.or_else(of_project) {
        Some(words) => Some(of_words(words)?),
        None => stated(path)?,
    };
    let named = match named {
        Some(system) => Some(system),
        None => {
            let in_degrees = read_corners(path)?.into_iter().find_map(|(_, at)| match at {
                Surveyed::Degrees(at) => Some(at),
                Surveyed::Metres(_) => None,
            });
            let zone =
                in_degrees.map(|[longitude, latitude]| crs::Crs::utm_of(latitude, longitude));
            zone.transpose().map_err(|why| Error::Argument(why.to_string()))?
        }
    };
    Ok(named.map_or(Crs::LOCAL, |system| Crs::from(&system)))
}

/// The plants that were located, metres on the map; `None` where there are none yet.
fn plants(
    project: &Project,
    field: Option<&Field>,
    metres: f64,
) -> Result<Option<Vec<FoundPlant>>, Error> {
    let Some(path) = project.finished(Stage::Locate, "plants.csv") else { return Ok(None) };
    let Some(field) = field else { return Ok(None) };
    let table = CsvTable::read(&path)?;
    let (Some(places), Some(rows)) = (table.pairs("u_px", "v_px"), table.numbers("row")) else {
        let message = "it has no plants with rows; locate them with the row model";
        return Err(FileError::malformed(&path, None, message).into());
    };
    let plant = |(at, row): ([f64; 2], f64)| {
        let at_m = field.place_of_plants.map(at).map(|x| x * metres);
        (row >= 1.0).then(|| FoundPlant { at_m, row: row as usize - 1 })
    };
    Ok(Some(places.into_iter().zip(rows).filter_map(plant).collect()))
}

fn from_corners(
    path: &Path,
    crs: Crs,
    metres: f64,
    options: &LayoutOptions,
    monitor: &mut dyn Monitor,
) -> Result<Laid, Error> {
    let design = options.design()?;
    let plan = design.plan()?;
    let projection = crs.system();
    let stated = stated(path)?;
    let refused = |why: crs::CrsError| FileError::malformed(path, None, why.to_string());
    let surveyed: Vec<(FieldCorner, [f64; 2])> = read_corners(path)?
        .into_iter()
        .map(|(corner, at)| {
            let at = match at {
                Surveyed::Metres(at) => match (&stated, &projection) {
                    (Some(from), Some(onto)) if from.definition() != onto.definition() => {
                        let [latitude, longitude] = from.to_wgs84(at[0], at[1]).map_err(refused)?;
                        onto.from_wgs84(latitude, longitude).map_err(refused)?
                    }
                    _ => at,
                },
                Surveyed::Degrees([longitude, latitude]) => {
                    let known = projection.as_ref().ok_or_else(|| {
                        let message = "its corners are in degrees, and the map does not say its reference system";
                        FileError::malformed(path, None, message)
                    })?;
                    known.from_wgs84(latitude, longitude).map_err(refused)?
                }
            };
            Ok((corner, at.map(|x| x * metres)))
        })
        .collect::<Result<_, Error>>()?;
    let observed: Vec<Corner> = surveyed
        .iter()
        .map(|&(corner, surveyed_m)| Corner { at: design.corner(corner), surveyed_m })
        .collect();
    let (origin, heading) = near(&observed).ok_or_else(|| {
        FileError::malformed(path, None, "its corners lie in one place, expected those of a field")
    })?;
    let start = Placement::nominal(origin, heading, plan.half_length_m());
    let fitted = corners::fit(&start, &observed, &options.corner_sigmas())?;
    let residuals: Vec<CornerResidual> = surveyed
        .iter()
        .zip(&fitted.residuals_m)
        .map(|((corner, _), [along_m, across_m])| CornerResidual {
            corner: *corner,
            along_m: *along_m,
            across_m: *across_m,
        })
        .collect();
    outcome::tell_corners(&name_of(path), &residuals, &fitted, options, monitor);
    let mut covariance = [[0.0; FREE]; FREE];
    for (row, of) in covariance.iter_mut().zip(&fitted.covariance) {
        row[..AFFINE].copy_from_slice(of);
    }
    let attributes = plan
        .plots
        .iter()
        .map(|plot| {
            vec![("range".to_owned(), plot.range.into()), ("column".to_owned(), plot.column.into())]
        })
        .collect();
    Ok(Laid {
        plan,
        placement: fitted.placement,
        covariance: Some(covariance),
        corners: residuals,
        attributes,
    })
}

/// Origin and heading that bring the plan near its corners: the rotation between the two, about their means.
fn near(corners: &[Corner]) -> Option<([f64; 2], f64)> {
    let count = corners.len() as f64;
    let mean = |of: fn(&Corner) -> [f64; 2]| {
        [0, 1].map(|axis| corners.iter().map(|corner| of(corner)[axis]).sum::<f64>() / count)
    };
    let (plan, map) = (mean(|corner| corner.at), mean(|corner| corner.surveyed_m));
    let (mut sin, mut cos) = (0.0, 0.0);
    for corner in corners {
        let a = [corner.at[0] - plan[0], corner.at[1] - plan[1]];
        let b = [corner.surveyed_m[0] - map[0], corner.surveyed_m[1] - map[1]];
        sin += a[0] * b[1] - a[1] * b[0];
        cos += a[0] * b[0] + a[1] * b[1];
    }
    if sin.hypot(cos) < 1e-6 {
        return None;
    }
    let heading = sin.atan2(cos);
    let (sin, cos) = heading.sin_cos();
    let origin = [map[0] - cos * plan[0] + sin * plan[1], map[1] - sin * plan[0] - cos * plan[1]];
    Some((origin, heading))
}

fn from_polygons(
    path: &Path,
    field: Option<&Field>,
    metres: f64,
    plants: &[FoundPlant],
    options: &LayoutOptions,
) -> Result<Laid, Error> {
    let place: Option<&Georeference> = field.map(|field| &field.place);
    let named = polygons::read(path, place)?;
    let map = |at: [f64; 2]| place.map_or(at, |place| place.map(at)).map(|x| x * metres);
    let pairs = named.iter().map(|plot| (plot.name.as_str(), &plot.polygon));
    let outlines = drawn::drawn(pairs, map);
    let origin = drawn::middle(&outlines);
    // Of the four directions of the sides, the one that the rows run along.
    let found = FoundRows::new(plants, &Placement::nominal(origin, 0.0, 1.0));
    let quarter = std::f64::consts::FRAC_PI_2;
    let turns = ((found.turn_rad() - drawn::direction(&outlines)) / quarter).round();
    let heading = drawn::direction(&outlines) + turns * quarter;
    let spacing = options.row_spacing_m.or_else(|| found.row_spacing_m()).ok_or_else(|| {
        Error::Argument(
            "[layout] row_spacing_m: not set, and fewer than two rows were found".to_owned(),
        )
    })?;
    let plan = drawn::plan(&outlines, origin, heading, options.rows_per_plot, spacing)?;
    let placement = Placement::nominal(origin, heading, plan.half_length_m());
    let attributes = named.into_iter().map(|plot| plot.attributes).collect();
    Ok(Laid {
        plan,
        placement,
        covariance: None,
        corners: Vec::new(),
        attributes: aligned(attributes),
    })
}

/// The same attributes for every plot, in the order in which they first appear.
fn aligned(of_plots: Vec<Vec<(String, Value)>>) -> Vec<Vec<(String, Value)>> {
    let mut names: Vec<String> = Vec::new();
    for (name, _) in of_plots.iter().flatten() {
        if !names.contains(name) {
            names.push(name.clone());
        }
    }
    let of = |own: Vec<(String, Value)>| {
        let value = |name: &String| {
            own.iter().find(|(other, _)| other == name).map_or(Value::Null, |(_, v)| v.clone())
        };
        names.iter().map(|name| (name.clone(), value(name))).collect()
    };
    of_plots.into_iter().map(of).collect()
}

/// Joins the entries of a field map to the plots by their names. Range and column of a layout that is made of corners are its own.
fn join(laid: &mut Laid, map: &FieldMap, path: &Path, monitor: &mut dyn Monitor) {
    let (mut lacking, mut contradicted) = (Vec::new(), Vec::new());
    let is_numbered = !laid.corners.is_empty();
    for (plot, own) in laid.plan.plots.iter().zip(&mut laid.attributes) {
        let values = map.plots.get(&plot.name);
        if values.is_none() {
            lacking.push(plot.name.as_str());
        }
        for (k, column) in map.columns.iter().enumerate() {
            let value = values.map_or(Value::Null, |values| values[k].clone());
            let kept = set(own, (column, value), is_numbered);
            contradicted.extend(kept.map(|what| format!("{} ({what})", plot.name)));
        }
    }
    if !contradicted.is_empty() {
        let message = format!(
            "its ranges and columns of {} entries are not those of the layout, which are kept: {}",
            contradicted.len(),
            few(&contradicted)
        );
        monitor.diagnostic(
            &Diagnostic::warning("field-map-contradicts", name_of(path), message)
                .with_remedy("compare plots_to, numbering and serpentine with the field map"),
        );
    }
    let is_there = |name: &String| laid.plan.plots.iter().any(|plot| plot.name == *name);
    let unknown: Vec<&str> =
        map.plots.keys().filter(|name| !is_there(name)).map(String::as_str).collect();
    let mut words = Vec::new();
    if !lacking.is_empty() {
        words.push(format!("{} plots have no entry: {}", lacking.len(), few(&lacking)));
    }
    if !unknown.is_empty() {
        words.push(format!("{} entries are of no plot: {}", unknown.len(), few(&unknown)));
    }
    if !words.is_empty() {
        monitor.diagnostic(
            &Diagnostic::warning("field-map-unmatched", name_of(path), words.join("; "))
                .with_remedy("compare first_number, numbering and serpentine with the field map"),
        );
    }
}

/// Sets an attribute of a plot, but range and column of one that `is_numbered` by them; says which of these the value contradicts.
fn set(
    own: &mut Vec<(String, Value)>,
    (column, value): (&str, Value),
    is_numbered: bool,
) -> Option<String> {
    match own.iter_mut().find(|(name, _)| name.eq_ignore_ascii_case(column)) {
        Some((name, before)) if is_numbered && ["range", "column"].contains(&name.as_str()) => {
            let is_other = !value.is_null() && value != *before;
            is_other.then(|| format!("{name} {before}, there {value}"))
        }
        Some((_, before)) => {
            *before = value;
            None
        }
        None => {
            own.push((column.to_owned(), value));
            None
        }
    }
}

/// The first few of some names.
fn few(names: &[impl AsRef<str>]) -> String {
    const SHOWN: usize = 8;
    let shown: Vec<&str> = names.iter().take(SHOWN).map(AsRef::as_ref).collect();
    let rest = if names.len() > SHOWN { ", ..." } else { "" };
    format!("{}{rest}", shown.join(", "))
}

impl CornerResidual {
    /// The word of its corner.
    fn word(&self) -> String {
        self.corner.word()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_of_the_layout_are_kept() {
        let mut own =
            vec![("range".to_owned(), Value::from(2)), ("entry".to_owned(), Value::from(7))];
        assert_eq!(set(&mut own, ("Range", Value::from(2)), true), None);
        let said = set(&mut own, ("Range", Value::from(3)), true);
        assert_eq!(said.as_deref(), Some("range 2, there 3"));
        assert_eq!(own[0].1, 2);
        assert_eq!(set(&mut own, ("range", Value::from(3)), false), None);
        assert_eq!(set(&mut own, ("entry", Value::from(8)), true), None);
        assert_eq!([&own[0].1, &own[1].1], [3, 8]);
    }
}
