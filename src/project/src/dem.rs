//! The surface from the tie points of a reconstruction.

use super::{Project, Stage, Task, map_figures, stage};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
    options::Auto,
};
use rowgram_files::{
    geotiff::{self, Colour, Layout, TILE},
    qgis::{self, Style},
};
use rowgram_optim::{
    output::{self, FileError, name_of},
    robust::median,
};
use rowgram_raster::{
    georeference::{Crs, Georeference},
    window::{self, Window},
};
use rowgram_survey::{
    mapping::{
        Surface, View,
        dem::{CloudOptions, CloudStatistics, SurfacePoint},
        elevation::{ElevationModel, ElevationOptions, Extent, elevation_model},
        view::{Bounds, views},
    },
    scene::Reconstruction,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

rowgram_base::options! {
    /// The surface, interpolated from the tie points by natural neighbours.
    pub struct DemOptions in "dem", main [cell_m, extend_m] {
        /// Side of a cell; half the median distance of neighbouring points where not set.
        pub cell_m: Option<f64> = None, limits POSITIVE, example "0.1";
        /// Points farther from the plane of their neighbours than this many typical distances are outliers.
        pub outlier_ratio: f64 = 5.0, limits POSITIVE;
        /// The longest side of a triangle that is filled; 30 times the median distance of neighbouring points where not set.
        pub largest_gap_m: Option<f64> = None, limits POSITIVE, example "2.0";
        /// How far the surface is extrapolated beyond its points and over gaps: on the plane of the field plus the
        /// offset of the nearest heights. auto: as far as photos show ground; 0: not at all. Standard deviations
        /// are never extrapolated.
        pub extend_m: Auto<f64> = Auto::Given(0.0), limits NON_NEGATIVE;
    }
}

impl DemOptions {
    /// How the elevation model is made of points that photos show over `shown_m`.
    ///
    /// # Errors
    /// A surface as far as photos show ground, where none does.
    pub fn elevation(&self, shown_m: Option<Bounds>) -> Result<ElevationOptions, Error> {
        let extent = match (self.extend_m, shown_m) {
            (Auto::Given(metres), _) if metres > 0.0 => Extent::Beyond(metres),
            (Auto::Given(_), _) => Extent::Points,
            (Auto::Auto, Some(bounds)) => Extent::Over(bounds),
            (Auto::Auto, None) => {
                return Err(Error::Argument(
                    "[dem] extend_m = \"auto\": there are no photos with a pose that look down, expected metres".into(),
                ));
            }
        };
        Ok(ElevationOptions {
            cloud: CloudOptions {
                outlier_ratio: self.outlier_ratio,
                largest_gap_m: self.largest_gap_m,
            },
            cell_m: self.cell_m,
            extent,
        })
    }
}

/// What was written. Files are named relative to the folder of the surface.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DemOutcome {
    /// The surface: heights in metres.
    pub surface: PathBuf,
    /// Standard deviations of the heights, metres; `None` where the points have none.
    pub sigma: Option<PathBuf>,
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Side of a cell, metres.
    pub cell_m: f64,
    /// EPSG code of the mapping frame, where it has one.
    pub epsg: Option<u32>,
    /// EPSG code of what heights are measured from, where it is known.
    pub vertical_epsg: Option<u32>,
    /// What became of the points.
    #[serde(flatten)]
    pub statistics: CloudStatistics,
    /// Number of points left out.
    pub outlier_count: usize,
    /// Number of cells with a height.
    pub cells_with_height: usize,
    /// Number of those beyond the points or in gaps between them.
    pub continued_cells: usize,
    /// The least height, metres.
    pub min_height_m: f64,
    /// The greatest height, metres.
    pub max_height_m: f64,
    /// Median standard deviation of heights, metres.
    pub median_sigma_m: Option<f64>,
}

/// The stage.
#[derive(Debug, Clone, Copy)]
pub struct DemTask;

impl Task for DemTask {
    type Options = DemOptions;
    type Outcome = DemOutcome;
    const STAGE: Stage = Stage::Dem;

    fn inputs(project: &Project, _: &DemOptions) -> Result<Vec<PathBuf>, Error> {
        project.reconstruction_files()
    }

    fn work(
        project: &Project,
        options: &DemOptions,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<DemOutcome, Error> {
        let reconstruction = project.reconstruction()?;
        let cloud = Cloud::of(&reconstruction);
        let output = folder.join(SURFACE);
        let figures = folder.join("figures");
        write_elevation(&cloud, options, (&output, Some(&figures), false), monitor)
    }
}

/// Points, and what photos show of the ground that they are on.
#[derive(Debug, Clone, PartialEq)]
pub struct Cloud {
    /// The points.
    pub points: Vec<SurfacePoint>,
    /// Their reference system.
    pub crs: Crs,
    /// What photos show of the ground: least and greatest x and y, metres; `None` without photos.
    pub shown_m: Option<Bounds>,
}

impl Cloud {
    /// The points of a reconstruction. What a photo shows is taken at their middle height; one that looks so flat that it shows many times
    /// what the others do does not count.
    pub fn of(reconstruction: &Reconstruction) -> Cloud {
        let points = SurfacePoint::of(reconstruction);
        let middle = median(points.iter().map(|point| point.position_m[2]));
        let footprint = |view: &View| {
            let bounds = middle.map(|z| view.footprint_between_m([z, z]))?;
            let diagonal = bounds.map(|[low, high]| high - low);
            Some((diagonal[0].hypot(diagonal[1]), bounds))
                .filter(|(diagonal, _)| diagonal.is_finite())
        };
        let mut footprints: Vec<(f64, Bounds)> =
            views(reconstruction).iter().filter_map(footprint).collect();
        footprints.sort_by(|a, b| a.0.total_cmp(&b.0));
        let usual = footprints.get(footprints.len() / 2).map_or(0.0, |(diagonal, _)| *diagonal);
        let kept = footprints.iter().filter(|(diagonal, _)| *diagonal <= FLATTEST * usual);
        let shown_m = kept
            .map(|(_, bounds)| *bounds)
            .reduce(|a, b| std::array::from_fn(|k| [a[k][0].min(b[k][0]), a[k][1].max(b[k][1])]));
        Cloud { points, crs: Crs::from(&reconstruction.reference), shown_m }
    }
}

/// A photo that shows more than so many times the usual length of ground looks too flat to say how far a map should go. A first choice, not tuned.
const FLATTEST: f64 = 3.0;

/// The file of the surface in the folder of the stage.
pub const SURFACE: &str = "dem.tif";

/// Makes the surface of a project from the tie points of its reconstruction.
///
/// # Errors
/// A project that has not been aligned, a reconstruction without scale, too few points.
pub fn dem(
    project: &Project,
    options: &DemOptions,
    monitor: &mut dyn Monitor,
) -> Result<DemOutcome, Error> {
    stage::perform::<DemTask>(project, options, monitor)
}

/// Makes the elevation model of points and writes it: the surface to `output`, what belongs to it beside, and pictures into
/// `figures`. Files that exist are replaced only where `force` says so.
///
/// # Errors
/// Too few points, outputs that cannot be written.
pub fn write_elevation(
    cloud: &Cloud,
    options: &DemOptions,
    (output, figures, force): (&Path, Option<&Path>, bool),
    monitor: &mut dyn Monitor,
) -> Result<DemOutcome, Error> {
    let sigma = beside(output, "sigma");
    let style_path = output.with_extension("qml");
    [output, &sigma, &style_path].into_iter().try_for_each(|path| output::check(path, force))?;
    let model = elevation_model(&cloud.points, cloud.crs, &options.elevation(cloud.shown_m)?)?;
    let ElevationModel { surface, sigmas_m, statistics, .. } = &model;
    let place = &surface.georeference;
    let size = [surface.width, surface.height];
    write_heights(output, place, size, &surface.heights_m, force)?;
    let sorted = model.sorted_sigmas_m();
    if sorted.is_empty() {
        let message = "the points have no standard deviations, so the surface has none";
        monitor.diagnostic(&Diagnostic::warning("dem-no-sigma", name_of(output), message));
    } else {
        write_heights(&sigma, place, size, sigmas_m, force)?;
    }
    if let Some(folder) = figures {
        std::fs::create_dir_all(folder).map_err(|e| FileError::write(folder, e))?;
        map_figures::draw_elevation(folder, &model, force)?;
    }
    let [min_height_m, max_height_m] = surface.range_m();
    let style = Style::Raster { range: [min_height_m, max_height_m], quantity: "m" };
    qgis::write(&style_path, force, &style)?;
    Ok(DemOutcome {
        surface: name_of(output).into(),
        sigma: (!sorted.is_empty()).then(|| name_of(&sigma).into()),
        width_px: size[0],
        height_px: size[1],
        cell_m: surface.cell_m(),
        epsg: place.crs.epsg,
        vertical_epsg: place.crs.vertical_epsg,
        statistics: statistics.clone(),
        outlier_count: statistics.outliers.len(),
        continued_cells: model.continued_cells,
        cells_with_height: surface.heights_m.iter().filter(|z| z.is_finite()).count(),
        min_height_m,
        max_height_m,
        median_sigma_m: sorted.get(sorted.len() / 2).map(|&sigma| f64::from(sigma)),
    })
}

/// `folder/stem_what.tif` beside `folder/stem.tif`.
pub(super) fn beside(path: &Path, what: &str) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{stem}_{what}.tif"))
}

/// What stands for no height: finite, so that every program understands it.
pub(super) const NODATA: f32 = -9999.0;

/// Writes heights, metres, row by row; NaN where there is none.
///
/// # Errors
/// Where it cannot be written.
pub(super) fn write_heights(
    path: &Path,
    place: &Georeference,
    [width, height]: [usize; 2],
    values: &[f32],
    force: bool,
) -> Result<(), Error> {
    let layout = Layout {
        width,
        height,
        colour: Colour::Values,
        georeference: Some(*place),
        nodata: Some(f64::from(NODATA)),
    };
    geotiff::write::<f32, Error>(path, force, &layout, |writer| {
        for band in window::bands(height, TILE, 0) {
            let rows = &values[band.rows.start * width..band.rows.end * width];
            let known: Vec<f32> =
                rows.iter().map(|&z| if z.is_finite() { z } else { NODATA }).collect();
            writer.put(Window::rows(width, band.rows), &known)?;
        }
        Ok(())
    })
}

/// Reads heights from a GeoTIFF.
///
/// # Errors
/// Names the file: no georeference, degrees, colours, no heights.
pub fn read_surface(path: &Path) -> Result<Surface, Error> {
    let reader = geotiff::Reader::open(path)?;
    let fault = |message: String| FileError::malformed(path, None, message);
    let place = reader.georeference().ok_or_else(|| {
        fault("it is not georeferenced; expected a GeoTIFF of heights in the mapping frame".into())
    })?;
    if reader.is_colour() {
        return Err(fault("it holds colours, expected heights (one band)".into()).into());
    }
    let size = [reader.width(), reader.height()];
    let heights = reader.read_f32(Window::whole(size[0], size[1]))?;
    Surface::new(place, size, heights).map_err(|error| fault(error.to_string()).into())
}
