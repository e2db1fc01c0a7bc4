//! The dense surface: what grows, the ground below it, and the height of the one over the other.
//!
//! A surface or a ground that another program, a sensor or an earlier date gave takes the place of one's own (`given`).
//!
//! For crops that stand on soil. Heights are looked for near the tie points and, on each block, as far beyond as larger cells see something.
//! What is not green is ground unless it surely stands on it.

mod given;
mod ground;
mod heights;
mod range;
mod store;
mod write;

use self::{
    given::GivenFiles,
    ground::{Fitted, Ground},
    write::{Found, Matching, SurfacePart},
};
use super::{
    Project, Stage, Task, batches::Part, dem, dem::read_surface, import, ortho, record::Key, stage,
};
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
    options::{Auto, Choice},
};
use rowgram_optim::output::FileError;
use rowgram_raster::{
    georeference::{Crs, Georeference},
    window::Window,
};
use rowgram_survey::mapping::{
    MapError, Surface, View,
    dem::SurfacePoint,
    dense::{Area, AreaOptions, Pass, Prior, Tile, TileMargins, TileStore, area::TILE},
    grid::{coverage, covering, median_gsd_m, rounded},
    orientation_sigma::OrientationSigma,
    views,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What plants are beside, for the prior.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GroundColour {
    /// What is not green is ground unless it surely stands on it, what is green is above it.
    Soil,
    /// Colours say nothing: buildings, ripe crops, meadows.
    Any,
}

rowgram_base::choices!(GroundColour: Soil, Any);

/// Which of two rasters has ellipsoidal heights, where the other has heights over the geoid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ellipsoidal {
    /// Those of the surface.
    Dsm,
    /// Those of the ground.
    Dtm,
}

rowgram_base::choices!(Ellipsoidal: Dsm, Dtm);

rowgram_base::options! {
    /// The dense surface of the canopy, the ground below it, and the height of the canopy.
    pub struct SurfaceOptions in "surface", main [cell_m, range_m, cloud] {
        /// Side of a cell; the median ground sampling distance of the photos where not set.
        pub cell_m: Option<f64> = None, limits POSITIVE, example "0.02";
        /// What is mapped: minimum x, minimum y, maximum x, maximum y; everything that photos show where not set.
        pub bounds_m: Option<[f64; 4]> = None, example "[500600.0, 4480100.0, 500700.0, 4480200.0]";
        /// Search range for heights above and below the surface of the tie points; auto derives it from the spread
        /// of neighbouring tie points, and searches higher for trees and houses.
        pub range_m: Auto<f64> = Auto::Auto, limits between(0.05, 200.0);
        /// How ground is recognised: soil, pixels that are not green are ground unless they clearly stand on it;
        /// any, by height alone.
        pub ground: GroundColour = GroundColour::Soil;
        /// Number of photos that are matched with the nearest photo at each place.
        pub others: usize = 4, limits between(1.0, 8.0);
        /// Also write the surface as a coloured cloud of points (dsm.laz).
        pub cloud: bool = false;
        /// The surface of another program in place of matching: a GeoTIFF of heights, or a point cloud (LAS, LAZ). Beside an
        /// orthomosaic that is given: the raster whose name has dsm or dem in it.
        pub dsm: Option<PathBuf> = None, example "\"dsm.tif\"";
        /// The ground of another program, of an airborne laser scan or of an earlier date: a GeoTIFF of heights, or a cloud with
        /// points of class 2. Beside an orthomosaic that is given: the raster whose name has dtm in it. Fitted to bare soil
        /// where there is none.
        pub dtm: Option<PathBuf> = None, example "\"dtm.tif\"";
        /// A geoid model (GTX, or GeoTIFF in degrees), where the heights of surface and dtm refer to two vertical datums: the
        /// ellipsoid, as those of most drones, and the sea, as those of most official terrain models.
        pub geoid: Option<PathBuf> = None, example "\"egm2008.gtx\"";
        /// Which of the two has ellipsoidal heights, where a geoid model is given.
        pub ellipsoidal: Ellipsoidal = Ellipsoidal::Dsm;
    }
}

/// The first surface, in the folder of the stage.
pub const SURFACE: &str = "dsm.tif";
/// Standard deviation of its heights.
pub const SIGMA: &str = "dsm_sigma.tif";
/// The ground under the canopy.
pub const GROUND: &str = "dtm.tif";
/// Standard deviation of its heights.
pub const GROUND_SIGMA: &str = "dtm_sigma.tif";
/// The surface as a coloured cloud of points.
pub const CLOUD: &str = "dsm.laz";
/// The height of the surface over the ground.
pub const CANOPY: &str = "chm.tif";
/// The confidence in the heights of the surface, 0 to 255.
pub const CONFIDENCE: &str = "confidence.tif";

/// What was written; files are named relative to the folder of the stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SurfaceOutcome {
    /// Heights of the first surface, metres.
    pub surface: PathBuf,
    /// The file that its heights come from, where they were not matched.
    #[serde(default)]
    pub given: Option<String>,
    /// Heights of the ground, metres; `None` where nothing bare shows it.
    pub ground: Option<PathBuf>,
    /// Height of the surface over the ground, metres.
    pub canopy: Option<PathBuf>,
    /// The surface as points with colours, where it was asked for.
    #[serde(default)]
    pub cloud: Option<PathBuf>,
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Side of a cell, metres.
    pub cell_m: f64,
    /// EPSG code of the mapping frame, where it has one.
    pub epsg: Option<u32>,
    /// How far around the surface of the tie points heights were looked for, metres; `None` where nothing was matched.
    pub range_m: Option<f64>,
    /// Distance of the heights that were compared, metres.
    pub layer_m: Option<f64>,
    /// Cells that at least two photos show; of a surface that was given, those with a height.
    pub cells_seen: usize,
    /// Those of them with a height.
    pub cells_with_height: usize,
    /// Median standard deviation of the surface, metres.
    #[serde(default)]
    pub median_surface_sigma_m: Option<f64>,
    /// The part of it, and of that of the ground, that comes from the orientation of the photos, metres; `None` where no adjustment said how
    /// well tie points are known.
    #[serde(default)]
    pub median_orientation_sigma_m: Option<f64>,
    /// Median standard deviation of the ground, metres.
    pub median_ground_sigma_m: Option<f64>,
    /// Height over the ground that 50, 95 and 99 % of the cells do not exceed, metres.
    pub canopy_percentiles_m: Option<[f64; 3]>,
    /// What 5 and 50 % of the cells do not exceed, where those below the ground count as negative: about 0, and the canopy.
    #[serde(default)]
    pub above_ground_m: Option<[f64; 2]>,
    /// Where the colours of its picture end, metres over the ground.
    #[serde(default)]
    pub canopy_picture_to_m: Option<f64>,
}

/// The stage.
#[derive(Debug, Clone, Copy)]
pub struct SurfaceTask;

impl Task for SurfaceTask {
    type Options = SurfaceOptions;
    type Outcome = SurfaceOutcome;
    const STAGE: Stage = Stage::Surface;

    fn inputs(project: &Project, options: &SurfaceOptions) -> Result<Vec<PathBuf>, Error> {
        let given = GivenFiles::of(project, options);
        let mut files: Vec<PathBuf> = given.all().collect();
        if given.dsm.is_some() {
            files.extend(project.given_orthomosaic());
            return Ok(files);
        }
        files.extend(project.reconstruction_files()?);
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
        let given = GivenFiles::of(project, options);
        let outcome = match &given.dsm {
            Some(dsm) => given::work(project, (options, &given), dsm, folder, monitor)?,
            None => matched(project, (options, &given), folder, monitor)?,
        };
        let subject = Stage::Surface.word();
        if outcome.ground.is_none() {
            let message =
                "nothing bare was found, so there is no ground and no height of the canopy";
            monitor.diagnostic(
                &Diagnostic::warning("surface-no-ground", subject.clone(), message)
                    .with_remedy("give the ground: [surface] dtm"),
            );
        }
        if let Some([low, middle]) = outcome.above_ground_m
            && given.dtm.is_some()
            && (low > MAX_LOW_M || middle < MIN_MIDDLE_M)
        {
            let message = format!(
                "95 % of the surface lie more than {low:.2} m above the ground that is given, half of it more than {middle:.2} m: do \
                 they refer to two vertical datums, or are they in two units?"
            );
            monitor.diagnostic(
                &Diagnostic::warning("surface-datum", subject, message).with_remedy(
                    "[surface] geoid brings ellipsoidal heights and heights over the sea together; heights in feet have to be converted to metres",
                ),
            );
        }
        Ok(outcome)
    }
}

/// Files that heights come from, and whether they can be read; for a project with an orthomosaic.
pub(super) fn doctor(project: &Project) -> (Vec<PathBuf>, Vec<Diagnostic>) {
    let options = &project.config().surface;
    let files = GivenFiles::of(project, options);
    let said = given::doctor(project, options, &files);
    (files.all().collect(), said)
}

/// Somewhere a crop shows the ground, or is lower than this; half of it is not below the ground by more than what two surveys are off by,
/// metres. First choices, not measured.
const MAX_LOW_M: f64 = 4.0;
const MIN_MIDDLE_M: f64 = -0.3;

/// Does the stage with photos.
fn matched(
    project: &Project,
    (options, given): (&SurfaceOptions, &GivenFiles),
    folder: &Path,
    monitor: &mut dyn Monitor,
) -> Result<SurfaceOutcome, Error> {
    let scene = Scene::new(project, options)?;
    let ground = given.ground(options, Some(scene.place.crs), monitor)?;
    let mut store = store::TilesOnDisk::new(project, scene.key);
    let own = scene.with_area(|area| {
        let steps = area.tiles(Pass::Coarse) + area.tiles(Pass::Fine);
        let counter = Counter::new(monitor, "matching the surface", steps, "tiles");
        area.match_all(&mut store, &mut || counter.tick())
    })?;
    let matching = Matching {
        range_m: scene.options.range_m,
        layer_m: own.layer_m,
        orientation: scene.orientation.as_ref(),
    };
    let ground = ground.unwrap_or_else(|| match own.terrain {
        Some(terrain) => Ground::Fitted(Fitted::on_map(terrain, scene.place.crs)),
        None => Ground::Unknown,
    });
    let found = Found {
        place: &scene.place,
        size: scene.cells.size,
        ground: &ground,
        cell_m: scene.cells.cell_m,
        matching: Some(matching),
    };
    let gone = || {
        let message = "a tile of the surface that was matched is gone; run the stage again";
        Error::from(FileError::read(folder, std::io::Error::other(message)))
    };
    let margins = TileMargins::read(found.size, TILE, own.layer_m, &mut store)?;
    let mut load = |number: usize, window: Window| {
        let tile = TileStore::<Error>::load(&mut store, Pass::Fine, number)?;
        let mut tile = tile.ok_or_else(gone)?;
        margins.join([window.u, window.v], &mut tile);
        Ok::<_, Error>(tile)
    };
    let mut part = |number, window| Ok(SurfacePart::Matched(load(number, window)?));
    let mut outcome = write::write(&found, &mut part, folder)?;
    if options.cloud {
        write::cloud(&found, &mut load, &folder.join(CLOUD))?;
        outcome.cloud = Some(CLOUD.into());
    }
    // The rasters have it all.
    store.forget()?;
    Ok(outcome)
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

/// What a surface is matched from.
struct Scene {
    views: Vec<View>,
    files: Vec<PathBuf>,
    base: Surface,
    place: Georeference,
    cells: Tile,
    /// What orientation leaves of heights unknown, where an adjustment says so.
    orientation: Option<OrientationSigma>,
    options: AreaOptions,
    /// Of all that decides the tiles.
    key: Key,
}

impl Scene {
    fn new(project: &Project, options: &SurfaceOptions) -> Result<Scene, Error> {
        let reconstruction = project.reconstruction()?;
        let files = import::photo_files(&reconstruction, &project.photo_folder())?;
        let base = read_surface(&base(project)?)?;
        let views = views(&reconstruction);
        let crs = Crs::from(&reconstruction.reference);
        let (place, size) = grid(&views, &base, options, crs)?;
        let cells = Tile { corner_m: place.origin, cell_m: place.per_column[0], size };
        let points = SurfacePoint::of(&reconstruction);
        let orientation = OrientationSigma::of(&points);
        let (range_m, relief_m) = match options.range_m {
            Auto::Given(range_m) => (range_m, range_m),
            Auto::Auto => {
                let of = |range: fn(&[SurfacePoint], f64) -> f64| range(&points, cells.cell_m);
                (of(range::range_of), of(range::relief_of))
            }
        };
        let prior = match options.ground {
            GroundColour::Soil => Prior::default(),
            GroundColour::Any => Prior::None,
        };
        let area_options = AreaOptions {
            range_m,
            relief_m,
            others: options.others,
            tile_cells: TILE,
            penalties: Default::default(),
            prior,
        };
        let inputs = project.contents(&SurfaceTask::inputs(project, options)?)?;
        let key = stage::key::<SurfaceTask>(project, options, &inputs);
        let key = Key::begin().text(&key).finish();
        Ok(Scene { views, files, base, place, cells, orientation, options: area_options, key })
    }

    /// Does something with the area, whose photos are read as they are needed.
    fn with_area<R>(
        &self,
        work: impl FnOnce(&Area<'_, Error>) -> Result<R, Error>,
    ) -> Result<R, Error> {
        let read = |k: usize| ortho::read_photo(&self.files[k], self.views[k].interior.size_px());
        let base = |at: [f64; 2]| self.base.at(at);
        let (views, cells, options) = (self.views.as_slice(), self.cells, self.options);
        work(&Area { views, read: &read, base: &base, cells, options }).map_err(left_out)
    }
}

/// Matches a part of the tiles of a pass and keeps them for [`surface`]; all of the coarse pass come before the first of the fine one.
/// Gives the number of tiles.
///
/// # Errors
/// As [`surface`].
pub fn match_tiles(
    project: &Project,
    options: &SurfaceOptions,
    (pass, part): (Pass, Part),
    monitor: &mut dyn Monitor,
) -> Result<usize, Error> {
    let scene = Scene::new(project, options)?;
    let mut store = store::TilesOnDisk::new(project, scene.key);
    scene.with_area(|area| {
        let numbers = part.range(area.tiles(pass));
        let count = numbers.len();
        let counter = Counter::new(monitor, "matching the surface", count, "tiles");
        area.match_tiles(pass, numbers, &mut store, &mut || counter.tick())?;
        Ok(count)
    })
}

/// The surface of the tie points.
fn base(project: &Project) -> Result<PathBuf, Error> {
    project.finished(Stage::Dem, dem::SURFACE).ok_or_else(|| {
        Error::NothingToDo(format!(
            "there is no surface of tie points in {}; make one with rowgram surface dem",
            project.folder(Stage::Dem).display()
        ))
    })
}

/// What cannot be matched is nothing to do, and no failure of a run.
fn left_out(error: Error) -> Error {
    match error {
        why if why.is::<MapError>() => Error::NothingToDo(why.to_string()),
        other => other,
    }
}

/// The cells: those of the orthomosaic, where both are made by default.
fn grid(
    views: &[View],
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

/// The most cells: beyond are mistakes in a number.
const MAX_CELLS: f64 = 1e11;
