//! The orthomosaic, and orthophotos of single photos.

mod base;
mod colours;
mod photos;
mod plots;
mod record;
mod write;

use super::{Project, Stage, Task, dem, import, stage, surface};
pub(super) use photos::{read_photo, read_pixels};
pub use plots::WholePlots;
pub use record::{OrthophotoRecord, PhotoRecord};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
    options::{Auto, Choice},
};
use rowgram_survey::mapping::{
    canopy_height::CanopyHeight, colour_balance::ColourBalance, select::SelectionOptions,
    undistort::Interpolation,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
pub(super) use write::provenance_path;
pub use write::{OrthoFiles, OrthoInput, write_orthophotos};

rowgram_base::options! {
    /// The orthomosaic: every cell takes its colour from the photo whose camera is closest.
    pub struct OrthoOptions in "ortho", main [canopy_height_m, gsd_m, bounds_m, whole_plots] {
        /// Height above the surface at which the map is drawn. auto: the height of the canopy at which photos agree
        /// best, so that plants are in the same place whichever photo shows them; 0: the ground.
        pub canopy_height_m: Auto<f64> = Auto::Auto, limits between(-1000.0, 1000.0);
        /// Side of a pixel; the median ground sampling distance of the photos where not set.
        pub gsd_m: Option<f64> = None, limits POSITIVE, example "0.015";
        /// What the map shows: minimum x, minimum y, maximum x, maximum y; everything that photos show where not
        /// set.
        pub bounds_m: Option<[f64; 4]> = None, example "[500600.0, 4480100.0, 500700.0, 4480200.0]";
        /// The surface: a GeoTIFF of heights in the mapping frame. Where not set, that of the tie points, and of the dense
        /// surface where tie points are missing.
        pub dem: Option<PathBuf> = None, example "\"terrain.tif\"";
        /// Use only these photos, by name with or without ending; one whose name several photos share with its folder. All where empty.
        pub only: Vec<String> = Vec::new();
        /// The largest angle between line of sight and vertical.
        pub max_angle_deg: Option<f64> = None, limits between(0.1, 89.9), example "30.0";
        /// Occlusion test: leave out photos from which the surface hides the cell. Surface less than this above the
        /// line of sight does not hide it.
        pub visibility_m: Option<f64> = None, limits NON_NEGATIVE, example "0.05";
        /// Margin along the borders of photos that is not used.
        pub border_px: f64 = 0.0, limits NON_NEGATIVE;
        /// Polygons of plots (GeoJSON, GeoPackage, shapefile), each of which is to come from one photo: of those that show
        /// all of it the one whose camera is closest.
        pub whole_plots: Option<PathBuf> = None, example "\"plots.geojson\"";
        /// Interpolation between the pixels of photos.
        pub interpolation: Interpolation = Interpolation::Bilinear;
        /// Balance the colours of the photos: exposure and white balance of each, vignetting, illumination and view
        /// direction. ortho.json holds the factors of each photo.
        pub balance: bool = true;
        /// Write which photo every pixel comes from; needed by rowgram ortho query.
        pub provenance: bool = true;
        /// Also write the orthophoto of every single photo, into the folder frames.
        pub frames: bool = false;
        /// Memory for decoded photos. Results do not depend on it.
        pub memory_mb: usize = 600;
    }
}

impl OrthoOptions {
    /// How photos are chosen for cells.
    pub fn selection(&self) -> SelectionOptions {
        SelectionOptions {
            max_angle_rad: self.max_angle_deg.map(f64::to_radians),
            visibility_m: self.visibility_m,
            border_px: self.border_px,
        }
    }
}

/// An orthophoto, of many photos or of one. Files are named relative to the folder of the orthomosaic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Orthophoto {
    /// The picture: red, green, blue, alpha.
    pub file: PathBuf,
    /// Where each of its pixels comes from.
    pub provenance: Option<PathBuf>,
    /// The photos behind it.
    pub record: PathBuf,
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Side of a pixel, metres.
    pub gsd_m: f64,
    /// EPSG code of the mapping frame, where it has one.
    pub epsg: Option<u32>,
    /// EPSG code of what heights are measured from, where it is known.
    pub vertical_epsg: Option<u32>,
    /// Number of photos that it shows.
    pub photos: usize,
    /// Number of pixels with a colour.
    pub coloured_pixels: usize,
}

/// What was written.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OrthoOutcome {
    /// The orthomosaic.
    #[serde(flatten)]
    pub mosaic: Orthophoto,
    /// How far above the surface it is drawn, metres.
    pub canopy_height_m: f64,
    /// The height of the canopy, where it was estimated and found.
    pub canopy: Option<CanopyHeight>,
    /// How colours were brought together, where they were.
    pub colour: Option<ColourBalance>,
    /// Which photos plots come from, where they were to be whole.
    pub whole_plots: Option<WholePlots>,
    /// Orthophotos of single photos, where they were wanted.
    pub frames: Vec<Orthophoto>,
}

/// The file of the orthomosaic in the folder of the stage.
pub const ORTHOMOSAIC: &str = "ortho.tif";
/// The surface of the tie points with its gaps filled, in the same folder, where it had any.
pub const FILLED: &str = "dem_filled.tif";

/// The stage.
#[derive(Debug, Clone, Copy)]
pub struct OrthoTask;

impl Task for OrthoTask {
    type Options = OrthoOptions;
    type Outcome = OrthoOutcome;
    const STAGE: Stage = Stage::Ortho;

    fn inputs(project: &Project, options: &OrthoOptions) -> Result<Vec<PathBuf>, Error> {
        let mut files = project.reconstruction_files()?;
        files.push(surface_file(project, options)?);
        files.extend(dense_surface(project, options).into_iter().flatten());
        files.extend(options.whole_plots.as_ref().map(|path| project.root().join(path)));
        files.extend(project.photos());
        Ok(files)
    }

    fn work(
        project: &Project,
        options: &OrthoOptions,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<OrthoOutcome, Error> {
        let reconstruction = project.reconstruction()?;
        let photos = import::photo_files(&reconstruction, &project.photo_folder())?;
        let surface = surface_file(project, options)?;
        let mut filled = None;
        if let Some(dense) = dense_surface(project, options) {
            let to = folder.join(FILLED);
            let cells = base::fill(&surface, &dense, &to)?;
            if cells > 0 {
                let message =
                    format!("{cells} cells without tie points have heights of the dense surface");
                let subject = Stage::Ortho.word();
                monitor.diagnostic(&Diagnostic::info("ortho-gaps-filled", subject, message));
                filled = Some(to);
            }
        }
        let input = OrthoInput {
            reconstruction: &reconstruction,
            photos: &photos,
            surface: &surface,
            filled: filled.as_deref(),
        };
        let whole_plots = options.whole_plots.as_ref().map(|path| project.root().join(path));
        let options = OrthoOptions { whole_plots, ..options.clone() };
        let (mosaic, figures) = (folder.join(ORTHOMOSAIC), folder.join("figures"));
        let files = OrthoFiles { mosaic: &mosaic, figures: Some(&figures), force: false };
        write_orthophotos(&input, &options, &files, monitor)
    }
}

/// The surface that the options name, else that of the project.
fn surface_file(project: &Project, options: &OrthoOptions) -> Result<PathBuf, Error> {
    let own = || project.finished(Stage::Dem, dem::SURFACE);
    options.dem.as_ref().map(|path| project.root().join(path)).or_else(own).ok_or_else(|| {
        Error::NothingToDo(format!(
            "there is no surface in {}; make one with rowgram surface dem, or name one with [ortho] dem",
            project.folder(Stage::Dem).display()
        ))
    })
}

/// Heights of the dense surface, which has some where tie points are missing, and the confidence in them; none where the options name a
/// surface.
fn dense_surface(project: &Project, options: &OrthoOptions) -> Option<[PathBuf; 2]> {
    let file = |name| project.finished(Stage::Surface, name);
    let both = || Some([file(surface::SURFACE)?, file(surface::CONFIDENCE)?]);
    options.dem.is_none().then(both).flatten()
}

/// Makes the orthomosaic of a project, from its reconstruction, its photos and its surface.
///
/// # Errors
/// A project that has not been aligned or has no surface, photos that cannot be read.
pub fn ortho(
    project: &Project,
    options: &OrthoOptions,
    monitor: &mut dyn Monitor,
) -> Result<OrthoOutcome, Error> {
    stage::perform::<OrthoTask>(project, options, monitor)
}
