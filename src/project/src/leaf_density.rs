//! Local density of leaf pixels.

use super::{
    Project, Stage, Task, figures,
    leaf_mask::{self, LeafMask},
    stage,
};
use image::{Rgb, RgbImage};
use rowgram_base::{error::Error, monitor::Monitor, options::Auto};
use rowgram_files::geotiff::{self, Colour, Layout};
use rowgram_optim::output::FileError;
use rowgram_raster::{
    Mask, density,
    georeference::Georeference,
    window::{self, Window},
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

rowgram_base::options! {
    /// Local density of leaf pixels.
    pub struct LeafDensityOptions in "leaf_density" {
        /// Side of the neighbourhood.
        pub window_px: usize = 41, limits ODD;
    }
}

/// Local density in numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeafDensityOutcome {
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Side of the neighbourhood.
    pub window_px: usize,
    /// Leaf pixels.
    pub leaf_pixels: usize,
    /// The most leaf pixels of any neighbourhood.
    pub largest: u32,
    /// Their mean over all pixels.
    pub mean: f64,
}

/// Counts the leaf pixels around every pixel of the leaf mask: `leaf-density/density.tif`.
///
/// # Errors
/// [`Error::NothingToDo`] without a leaf mask; as [`stage::perform`].
pub fn leaf_density(
    project: &Project,
    options: &LeafDensityOptions,
    monitor: &mut dyn Monitor,
) -> Result<LeafDensityOutcome, Error> {
    stage::perform::<LeafDensity>(project, options, monitor)
}

/// The stage.
pub struct LeafDensity;

impl Task for LeafDensity {
    type Options = LeafDensityOptions;
    type Outcome = LeafDensityOutcome;
    const STAGE: Stage = Stage::LeafDensity;

    fn inputs(project: &Project, _: &LeafDensityOptions) -> Result<Vec<PathBuf>, Error> {
        Ok(vec![project.mask()?])
    }

    fn work(
        project: &Project,
        options: &LeafDensityOptions,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<LeafDensityOutcome, Error> {
        let (source, LeafMask { mask, .. }) =
            leaf_mask::read_any_leaf_mask(&project.mask()?, Auto::Auto, monitor)?;
        let files = LeafDensityFiles {
            density: &folder.join("density.tif"),
            figures: Some(&folder.join("figures")),
            force: true,
        };
        map_leaf_density(&mask, source.georeference(), files, options)
    }
}

/// What is written of a density.
#[derive(Debug, Clone, Copy)]
pub struct LeafDensityFiles<'a> {
    /// The number of leaf pixels around every pixel: a GeoTIFF of whole numbers.
    pub density: &'a Path,
    /// Folder of pictures: `density.png`, from dark blue (none) to yellow (the most there is).
    pub figures: Option<&'a Path>,
    /// Whether files that exist are replaced.
    pub force: bool,
}

/// Writes the local density of a leaf mask; beyond its border there are no leaves.
///
/// # Errors
/// A neighbourhood that cannot be; files that cannot be written.
pub fn map_leaf_density(
    mask: &Mask,
    georeference: Option<Georeference>,
    files: LeafDensityFiles<'_>,
    options: &LeafDensityOptions,
) -> Result<LeafDensityOutcome, Error> {
    let half = density::half_window(options.window_px)?;
    let layout = Layout {
        width: mask.width,
        height: mask.height,
        colour: Colour::Values,
        georeference,
        nodata: None,
    };
    let (mut largest, mut sum) = (0, 0.0);
    geotiff::write::<u32, FileError>(files.density, files.force, &layout, |writer| {
        for band in window::bands(mask.height, geotiff::TILE, half) {
            let counts = density::rows(mask, half, band.rows.clone());
            largest = counts.iter().copied().max().unwrap_or(0).max(largest);
            sum += counts.iter().map(|&count| f64::from(count)).sum::<f64>();
            writer.put(Window::rows(mask.width, band.rows), &counts)?;
        }
        Ok(())
    })?;
    if let Some(folder) = files.figures {
        figures::write_picture(folder, "density.png", files.force, &picture(mask, half, largest))?;
    }
    Ok(LeafDensityOutcome {
        width_px: mask.width,
        height_px: mask.height,
        window_px: options.window_px,
        leaf_pixels: mask.count(),
        largest,
        mean: sum / mask.data.len().max(1) as f64,
    })
}

/// The density in colours, every so many pixels.
fn picture(mask: &Mask, half: usize, largest: u32) -> RgbImage {
    let step = figures::step(mask.width, mask.height);
    let (width, height) = (mask.width.div_ceil(step), mask.height.div_ceil(step));
    let mut picture = RgbImage::new(width as u32, height as u32);
    for band in window::bands(mask.height, geotiff::TILE, half) {
        let counts = density::rows(mask, half, band.rows.clone());
        for v in band.rows.clone().filter(|v| v.is_multiple_of(step)) {
            let row = &counts[(v - band.rows.start) * mask.width..][..mask.width];
            for (u, &count) in row.iter().step_by(step).enumerate() {
                let share = f64::from(count) / f64::from(largest.max(1));
                picture.put_pixel(u as u32, (v / step) as u32, Rgb(density::colour(share)));
            }
        }
    }
    picture
}
