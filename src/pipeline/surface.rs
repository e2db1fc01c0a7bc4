//! The dense surface: what grows, the ground below it, and the height of the one over the other.
//!
//! For crops that stand on soil. Heights are looked for near the tie points, and what is not green is ground: trees and houses come
//! out wrong, a lawn counts as canopy.

use super::{
    Project, Stage, Task, dem,
    dem::{read_surface, write_heights},
    figures, import, map_figures, ortho, stage,
};
use crate::{
    error::Error,
    io::{FileError, geotiff, qgis},
    mapping::{
        Surface,
        dem::SurfacePoint,
        dense::{
            AreaOptions, AreaSurface, Prior, Tile,
            area::{steps, surface_area},
        },
        grid::{coverage, covering, median_gsd_m, rounded},
        surface::HeightInterpolation,
        views,
    },
    monitor::{Counter, Diagnostic, Monitor},
    options::{Auto, Choice},
    raster::georeference::{Crs, Georeference},
};
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// What plants are beside, for the prior.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GroundColour {
    /// What is not green is ground, what is green is above it.
    Soil,
    /// Colours say nothing: buildings, ripe crops, meadows.
    Any,
}

crate::choices!(GroundColour: Soil, Any);

crate::options! {
    /// The dense surface of the canopy, the ground below it, and the height of the canopy.
    pub struct SurfaceOptions in "surface" {
        /// Side of a cell; the median ground sampling distance of the photos where not set.
        pub cell_m: Option<f64> = None, limits POSITIVE, example "0.02";
        /// What is mapped: least x, least y, greatest x, greatest y; everything that photos show where not set.
        pub bounds_m: Option<[f64; 4]> = None, example "[500600.0, 4480100.0, 500700.0, 4480200.0]";
        /// How far above and below the surface of the tie points heights are looked for; auto takes it from how much neighbouring
        /// tie points differ.
        pub range_m: Auto<f64> = Auto::Auto, limits between(0.05, 200.0);
        /// What the ground looks like: soil, what is not green is ground; any, colours say nothing of heights.
        pub ground: GroundColour = GroundColour::Soil;
        /// How many photos are compared with the one nearest to a place.
        pub others: usize = 4, limits between(1.0, 8.0);
    }
}

/// The first surface, in the folder of the stage.
pub const SURFACE: &str = "dsm.tif";
/// The ground under the canopy.
pub const GROUND: &str = "dtm.tif";
/// The height of the surface over the ground.
pub const CANOPY: &str = "chm.tif";

/// What was written; files are named relative to the folder of the stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SurfaceOutcome {
    /// Heights of the first surface, metres.
    pub surface: PathBuf,
    /// Heights of the ground, metres; `None` where nothing bare shows it.
    pub ground: Option<PathBuf>,
    /// Height of the surface over the ground, metres.
    pub canopy: Option<PathBuf>,
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Side of a cell, metres.
    pub cell_m: f64,
    /// EPSG code of the mapping frame, where it has one.
    pub epsg: Option<u32>,
    /// How far around the surface of the tie points heights were looked for, metres.
    pub range_m: f64,
    /// Distance of the heights that were compared, metres.
    pub layer_m: f64,
    /// Cells that at least two photos show.
    pub cells_seen: usize,
    /// Those of them with a height.
    pub cells_with_height: usize,
    /// Median standard deviation of the ground, metres.
    pub median_ground_sigma_m: Option<f64>,
    /// Height over the ground that 50, 95 and 99 % of the cells do not exceed, metres.
    pub canopy_percentiles_m: Option<[f64; 3]>,
}

/// The stage.
#[derive(Debug, Clone, Copy)]
pub struct SurfaceTask;

impl Task for SurfaceTask {
    type Options = SurfaceOptions;
    type Outcome = SurfaceOutcome;
    const STAGE: Stage = Stage::Surface;

    fn inputs(project: &Project, _: &SurfaceOptions) -> Result<Vec<PathBuf>, Error> {
        let mut files = project.reconstruction_files()?;
        files.push(base(project)?);
        files.extend(project.photos());
        Ok(files)
    }

    fn work(
        project: &Project,
        options: &SurfaceOptions,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<SurfaceOutcome, Error> {
        let reconstruction = project.reconstruction()?;
        if !reconstruction.reference.has_scale() {
            let message = "the reconstruction has no scale, so heights have no metres; give camera positions or control";
            return Err(Error::NothingToDo(message.into()));
        }
        let files = import::photo_files(&reconstruction, &project.photo_folder())?;
        let base = read_surface(&base(project)?, HeightInterpolation::Bilinear)?;
        let views = views(&reconstruction);
        let crs = Crs::of(&reconstruction.reference);
        let (place, size) = grid(&views, &base, options, crs)?;
        let area = Tile { corner_m: place.origin, cell_m: place.per_column[0], size };
        let range_m = match options.range_m {
            Auto::Given(range_m) => range_m,
            Auto::Auto => range_of(&SurfacePoint::of(&reconstruction), area.cell_m),
        };
        let prior = match options.ground {
            GroundColour::Soil => Prior::default(),
            GroundColour::Any => Prior::None,
        };
        let area_options =
            AreaOptions { range_m, others: options.others, penalties: Default::default(), prior };
        let counter = Counter::new(monitor, "matching the surface", steps(&area), "tiles");
        let read = |k: usize| ortho::read_photo(&files[k], views[k].interior.size_px());
        let height = |at: [f64; 2]| base.at(at);
        let found =
            surface_area(&views, &read, &height, &area, &area_options, &mut || counter.tick())
                .map_err(left_out)?;
        let subject = Stage::Surface.word();
        if found.terrain.is_none() {
            let message =
                "nothing bare was found, so there is no ground and no height of the canopy";
            monitor.diagnostic(&Diagnostic::warning("surface-no-ground", subject, message));
        }
        write(&found, &place, range_m, folder)
    }
}

/// Makes the dense surface of a project.
///
/// # Errors
/// A project that has not been aligned or has no surface of tie points, photos that cannot be read.
pub fn surface(
    project: &Project,
    options: &SurfaceOptions,
    monitor: &mut dyn Monitor,
) -> Result<SurfaceOutcome, Error> {
    stage::perform::<SurfaceTask>(project, options, monitor)
}

/// The surface of the tie points.
fn base(project: &Project) -> Result<PathBuf, Error> {
    project.existing(Stage::Dem, dem::SURFACE).ok_or_else(|| {
        Error::NothingToDo(format!(
            "there is no surface of tie points in {}; make one with rowgram dem",
            project.folder(Stage::Dem).display()
        ))
    })
}

/// What cannot be matched is nothing to do, and no failure of a run.
fn left_out(error: Error) -> Error {
    match error {
        Error::Map(why) => Error::NothingToDo(why.to_string()),
        other => other,
    }
}

/// The cells: those of the orthomosaic, where both are made by default.
fn grid(
    views: &[crate::mapping::View],
    base: &Surface,
    options: &SurfaceOptions,
    crs: Crs,
) -> Result<(Georeference, [usize; 2]), Error> {
    let nothing =
        || Error::NothingToDo("no photo shows any of the surface of the tie points".into());
    let cell_m = match options.cell_m {
        Some(cell_m) => cell_m,
        None => rounded(median_gsd_m(views, base).ok_or_else(nothing)?, 3),
    };
    let bounds_m = match options.bounds_m {
        Some([left, bottom, right, top]) if left < right && bottom < top => {
            [[left, right], [bottom, top]]
        }
        Some([left, bottom, right, top]) => {
            return Err(Error::Argument(format!(
                "bounds_m = {left},{bottom},{right},{top}: expected least x, least y, greatest x, greatest y"
            )));
        }
        None => coverage(views, base).bounds_m.ok_or_else(nothing)?,
    };
    Ok(covering(bounds_m, cell_m, crs, MAX_CELLS)?)
}

/// The most cells: six bytes of each are in memory.
const MAX_CELLS: f64 = 1e9;
/// Side of the squares in which tie points are compared, in cells.
const SQUARE_CELLS: f64 = 60.0;
/// Fewer points in a square say nothing.
const LEAST_POINTS: usize = 8;
/// Share of the squares that differ less than what the range is for.
const USUAL: f64 = 0.9;
/// The range is so much more than what tie points of a square differ by, metres: they seldom lie on the highest leaves.
const MORE_M: f64 = 0.3;
/// Limits of the range, metres.
const RANGE_M: [f64; 2] = [0.5, 30.0];

/// Fewer squares than this do not say what is usual; larger squares are tried.
const LEAST_SQUARES: usize = 10;
/// How often the side of the squares is doubled.
const DOUBLINGS: usize = 5;

/// How far heights are looked for: what tie points of the same square differ by, from the lowest twentieth to the highest.
fn range_of(points: &[SurfacePoint], cell_m: f64) -> f64 {
    let mut side_m = SQUARE_CELLS * cell_m;
    let mut spans = Vec::new();
    for _ in 0..DOUBLINGS {
        spans = spans_m(points, side_m);
        if spans.len() >= LEAST_SQUARES {
            break;
        }
        side_m *= 2.0;
    }
    let at = (USUAL * spans.len().saturating_sub(1) as f64) as usize;
    let span = spans.get(at).copied().unwrap_or(0.0);
    rounded((span + MORE_M).clamp(RANGE_M[0], RANGE_M[1]), 3)
}

/// What heights differ by in squares of this side, without the twentieths at both ends; sorted.
fn spans_m(points: &[SurfacePoint], side_m: f64) -> Vec<f64> {
    let mut squares: BTreeMap<[i64; 2], Vec<f64>> = BTreeMap::new();
    for point in points {
        let [x, y, z] = point.position_m;
        squares.entry([x, y].map(|c| (c / side_m).floor() as i64)).or_default().push(z);
    }
    let enough = squares.into_values().filter(|heights| heights.len() >= LEAST_POINTS);
    let mut spans: Vec<f64> = enough
        .map(|mut heights| {
            heights.sort_by(f64::total_cmp);
            let cut = heights.len() / 20;
            heights[heights.len() - 1 - cut] - heights[cut]
        })
        .collect();
    spans.sort_by(f64::total_cmp);
    spans
}

/// Writes rasters, tables and pictures.
fn write(
    found: &AreaSurface,
    place: &Georeference,
    range_m: f64,
    folder: &Path,
) -> Result<SurfaceOutcome, Error> {
    let [width, height] = found.area.size;
    let size = [width, height];
    let pictures = folder.join("figures");
    std::fs::create_dir_all(&pictures).map_err(|e| FileError::write(&pictures, e))?;
    write_heights(&folder.join(SURFACE), place, size, &found.surface_m, false)?;
    for (name, values) in [("confidence.tif", &found.confidence), ("photos.tif", &found.photos)] {
        write_bytes(&folder.join(name), place, size, values)?;
    }
    let on_grid = |at: &dyn Fn([f64; 2]) -> Option<f64>| -> Vec<f32> {
        let cells = (0..width * height).map(|k| found.area.place_m(k % width, k / width));
        cells.map(|place| at(place).map_or(f32::NAN, |value| value as f32)).collect()
    };
    let known = |values: &[f32]| -> Vec<f32> {
        let mut known: Vec<f32> = values.iter().copied().filter(|v| v.is_finite()).collect();
        known.sort_by(f32::total_cmp);
        known
    };
    let share = |sorted: &[f32], share: f64| {
        sorted.get((share * sorted.len().saturating_sub(1) as f64) as usize).map(|&v| f64::from(v))
    };
    let surface =
        Surface::new(*place, size, found.surface_m.clone(), HeightInterpolation::Bilinear)?;
    map_figures::draw_surface(&pictures, &surface)?;
    let mut outcome = SurfaceOutcome {
        surface: SURFACE.into(),
        ground: None,
        canopy: None,
        width_px: width,
        height_px: height,
        cell_m: place.per_column[0],
        epsg: place.crs.epsg,
        range_m,
        layer_m: found.layer_m,
        cells_seen: found.photos.iter().filter(|&&n| n >= 2).count(),
        cells_with_height: (0..found.surface_m.len())
            .filter(|&at| found.photos[at] >= 2 && found.surface_m[at].is_finite())
            .count(),
        median_ground_sigma_m: None,
        canopy_percentiles_m: None,
    };
    let Some(terrain) = &found.terrain else { return Ok(outcome) };
    // The ground is known where photos show something; beyond it is a guess.
    let mut ground = on_grid(&|at| terrain.at_m(at));
    let mut sigma = on_grid(&|at| terrain.sigma_at_m(at).filter(|sigma| sigma.is_finite()));
    for at in 0..ground.len() {
        if found.photos[at] < 2 {
            (ground[at], sigma[at]) = (f32::NAN, f32::NAN);
        }
    }
    // Not `max`, which takes zero for what is not known.
    let above = |(top, ground): (&f32, &f32)| if top < ground { 0.0 } else { top - ground };
    let canopy: Vec<f32> = found.surface_m.iter().zip(&ground).map(above).collect();
    write_heights(&folder.join(GROUND), place, size, &ground, false)?;
    write_heights(&folder.join("dtm_sigma.tif"), place, size, &sigma, false)?;
    write_heights(&folder.join(CANOPY), place, size, &canopy, false)?;
    let (heights, sigmas) = (known(&canopy), known(&sigma));
    let top_m = share(&heights, 0.995).unwrap_or(0.0).max(0.05);
    let style = qgis::Style::Raster { range: [0.0, top_m], quantity: "m" };
    qgis::write(&folder.join("chm.qml"), false, &style)?;
    map_figures::draw_canopy(&pictures, size, &canopy, top_m)?;
    profile(&pictures, found, &ground)?;
    outcome.ground = Some(GROUND.into());
    outcome.canopy = Some(CANOPY.into());
    outcome.median_ground_sigma_m = share(&sigmas, 0.5);
    outcome.canopy_percentiles_m = share(&heights, 0.5)
        .zip(share(&heights, 0.95))
        .zip(share(&heights, 0.99))
        .map(|((a, b), c)| [a, b, c]);
    Ok(outcome)
}

fn write_bytes(
    path: &Path,
    place: &Georeference,
    [width, height]: [usize; 2],
    values: &[u8],
) -> Result<(), Error> {
    let layout = geotiff::Layout {
        width,
        height,
        colour: geotiff::Colour::Values,
        georeference: Some(*place),
        nodata: None,
    };
    geotiff::write::<u8, Error>(path, false, &layout, |writer| {
        for band in crate::raster::window::bands(height, geotiff::TILE, 0) {
            let rows = &values[band.rows.start * width..band.rows.end * width];
            writer.put(crate::raster::window::Window::rows(width, band.rows), rows)?;
        }
        Ok(())
    })
}

/// Surface and ground along the middle row of the map, drawn, and along its middle row and column as a table.
fn profile(folder: &Path, found: &AreaSurface, ground: &[f32]) -> Result<(), Error> {
    let [width, height] = found.area.size;
    let text = |value: f32| if value.is_finite() { format!("{value:.4}") } else { String::new() };
    let mut csv = String::from("direction,x_m,y_m,surface_m,ground_m\n");
    let along = (0..width).map(|u| ("east", u, height / 2));
    let across = (0..height).map(|v| ("south", width / 2, v));
    for (direction, u, v) in along.chain(across) {
        let [x, y] = found.area.place_m(u, v);
        let at = v * width + u;
        let (top, below) = (text(found.surface_m[at]), text(ground[at]));
        csv += &format!("{direction},{x:.4},{y:.4},{top},{below}\n");
    }
    let first = (height / 2) * width;
    let line = |values: &[f32]| -> Vec<(f64, f64)> {
        let cells = values[first..first + width].iter().enumerate();
        let known = cells.filter(|(_, z)| z.is_finite());
        known.map(|(u, &z)| (u as f64 * found.area.cell_m, f64::from(z))).collect()
    };
    let svg = figures::profile(&line(&found.surface_m), &line(ground))
        .map_err(|e| FileError::write(folder, std::io::Error::other(e.to_string())))?;
    Ok(figures::write_drawing(folder, "profile.svg", false, &svg, &csv)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_range_follows_what_neighbouring_tie_points_differ_by() {
        let points = |top: f64| -> Vec<SurfacePoint> {
            (0..900)
                .map(|k| {
                    let (x, y) = (f64::from(k % 30) * 0.1, f64::from(k / 30) * 0.1);
                    // A slope of a tenth, and a canopy on every second point.
                    let z = 100.0 + 0.1 * x + if k % 2 == 0 { top } else { 0.0 };
                    SurfacePoint { position_m: [x, y, z], sigma_z_m: f64::NAN }
                })
                .collect()
        };
        let (low, high) = (range_of(&points(0.4), 0.015), range_of(&points(2.5), 0.015));
        assert!((0.7..0.9).contains(&low), "{low}");
        assert!((2.8..3.0).contains(&high), "{high}");
        assert_eq!(range_of(&[], 0.015), RANGE_M[0]);
    }
}
