//! Single leaves.

use super::{
    Project, Stage, Task,
    figures::View,
    leaf_mask::{self, LeafMask},
    stage,
};
use image::Rgb;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
    options::Auto,
};
use rowgram_files::{
    labels,
    leaves::{self as table, Rows},
    points,
    rasters::{BAND_ROWS, Source},
};
use rowgram_optim::output::FileError;
use rowgram_plants::phenotype::leaves::{self, Bridging, Leaf, LeafOptions, LeafShape};
use rowgram_raster::{Mask, hsv, overlay::draw_line, window};
use serde::{Deserialize, Serialize};
use std::{
    f64::consts::TAU,
    path::{Path, PathBuf},
};

rowgram_base::options! {
    /// Single leaves, joined from slices across them (stroke width transform).
    pub struct LeavesOptions in "leaves" with {
        /// How leaves are told apart.
        pub leaf: LeafOptions,
    } {
        /// Ground sampling distance, metres per pixel; that of the raster where not set. Without both, lengths are in pixels
        /// only.
        pub gsd_m: Option<f64> = None, limits GSD_M, example "0.015";
        /// The paper's method alone: all leaves are blades, greedy bridging, neither curvature nor splitting.
        pub paper: bool = false;
    }
}

impl LeavesOptions {
    /// How leaves are told apart, with the paper's choices where they are asked for.
    fn method(&self) -> LeafOptions {
        if !self.paper {
            return self.leaf;
        }
        let (bridging, curvature, split) = (Bridging::Greedy, false, false);
        LeafOptions { bridging, curvature, split, shape: LeafShape::Blade, ..self.leaf }
    }
}

/// Single leaves in numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeavesOutcome {
    /// Columns of the raster.
    pub width_px: usize,
    /// Rows of the raster.
    pub height_px: usize,
    /// Ground sampling distance, metres per pixel, where it is known.
    pub gsd_m: Option<f64>,
    /// Leaves.
    pub leaves: usize,
    /// Whether they were found as broad leaves, else as blades.
    pub is_broad: bool,
    /// Leaf pixels.
    pub leaf_pixels: usize,
    /// Usual width of a leaf; 0 without leaves.
    pub usual_width_px: f64,
    /// Median length of a leaf.
    pub median_length_px: Option<f64>,
    /// Median length of a leaf.
    pub median_length_m: Option<f64>,
    /// Plants that leaves were assigned to.
    pub plants: Option<usize>,
    /// Leaves without a plant in reach.
    pub leaves_without_plant: Option<usize>,
}

/// Measures every leaf of the leaf mask: `leaves/leaves.csv`, and `leaves/per_plant.csv` where plants are located.
///
/// # Errors
/// [`Error::NothingToDo`] without an orthomosaic or a leaf mask; as [`stage::perform`].
pub fn leaves(
    project: &Project,
    options: &LeavesOptions,
    monitor: &mut dyn Monitor,
) -> Result<LeavesOutcome, Error> {
    stage::perform::<LeavesStage>(project, options, monitor)
}

/// The stage.
pub struct LeavesStage;

impl Task for LeavesStage {
    type Options = LeavesOptions;
    type Outcome = LeavesOutcome;
    const STAGE: Stage = Stage::Leaves;

    fn inputs(project: &Project, _: &LeavesOptions) -> Result<Vec<PathBuf>, Error> {
        let mut files = vec![project.mask()?, project.orthomosaic()?];
        files.extend(project.finished(Stage::Locate, "plants.csv"));
        Ok(files)
    }

    fn work(
        project: &Project,
        options: &LeavesOptions,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<LeavesOutcome, Error> {
        let ortho = project.orthomosaic()?;
        let (_, LeafMask { mask, .. }) =
            leaf_mask::read_any_leaf_mask(&project.mask()?, Auto::Auto, monitor)?;
        let plants = project.finished(Stage::Locate, "plants.csv");
        let plants = plants.as_deref().map(points::read).transpose()?;
        let subject = super::record::relative(project.root(), &ortho).display().to_string();
        let picture =
            LeafPicture { source: &project.open_picture(&ortho)?, mask: &mask, subject: &subject };
        let per_plant = folder.join("per_plant.csv");
        let files = LeavesFiles {
            leaves: &folder.join("leaves.csv"),
            per_plant: plants.is_some().then_some(per_plant.as_path()),
            labels: None,
            figures: Some(&folder.join("figures")),
            force: true,
        };
        measure_leaves(picture, plants.as_deref(), files, options, monitor)
    }
}

/// A raster and its leaf mask.
#[derive(Clone, Copy)]
pub struct LeafPicture<'a> {
    /// The raster, for its colours and its place.
    pub source: &'a Source,
    /// Its leaf mask, of the same size.
    pub mask: &'a Mask,
    /// Its name in diagnostics.
    pub subject: &'a str,
}

/// What is written of leaves.
#[derive(Debug, Clone, Copy)]
pub struct LeavesFiles<'a> {
    /// The leaves: `.csv`, a table; `.gpkg` (for QGIS) or `.geojson`, their axes with the same columns.
    pub leaves: &'a Path,
    /// With plants: a CSV table of plants with their number of leaves.
    pub per_plant: Option<&'a Path>,
    /// One label per leaf, 0 elsewhere, as a GeoTIFF.
    pub labels: Option<&'a Path>,
    /// Folder of pictures: `leaves.png`, the leaves with their axes.
    pub figures: Option<&'a Path>,
    /// Whether files that exist are replaced.
    pub force: bool,
}

/// Measures every leaf of a mask, and assigns it to one of the plants (positions in pixels) where there are any.
///
/// # Errors
/// A raster that cannot be read, of another size than the mask; files that cannot be written.
pub fn measure_leaves(
    picture: LeafPicture<'_>,
    plants: Option<&[[f64; 2]]>,
    files: LeavesFiles<'_>,
    options: &LeavesOptions,
    monitor: &mut dyn Monitor,
) -> Result<LeavesOutcome, Error> {
    let LeafPicture { source, mask, subject } = picture;
    if source.size() != (mask.width, mask.height) {
        let (width, height) = source.size();
        return Err(Error::Argument(format!(
            "{subject} has {width} x {height} pixels and its leaf mask {} x {}: expected the same size",
            mask.width, mask.height
        )));
    }
    let georeference = source.georeference();
    let gsd_m = leaf_mask::gsd_m(source, options.gsd_m, subject, monitor);
    if gsd_m.is_none() {
        let message = "no ground sampling distance in metres is known; lengths are in pixels";
        monitor.diagnostic(
            &Diagnostic::warning("no-scale", subject, message)
                .with_remedy("give the ground sampling distance (--gsd-m, or [leaves] gsd_m)"),
        );
    }
    let mut found = leaves::find(mask, &options.method());
    if let Some(gsd_m) = gsd_m.filter(|&gsd_m| found.are_too_large(gsd_m)) {
        let [width_cm, length_cm] = [found.usual_width_px, found.median_length_px().unwrap_or(0.0)]
            .map(|px| 100.0 * gsd_m * px);
        let message = format!(
            "areas of leaf are {width_cm:.0} cm wide and {length_cm:.0} cm long, which no leaf of a field crop is: no single leaf is told apart"
        );
        monitor.diagnostic(
            &Diagnostic::warning("leaves-not-single", subject, message).with_remedy(
                "check the ground sampling distance; look at an earlier photo, or at one from lower above",
            ),
        );
        found.leaves.clear();
    } else if found.leaves.is_empty() {
        let message = "the leaf mask is empty; there is no leaf";
        monitor.diagnostic(&Diagnostic::warning("no-leaves", subject, message));
    }
    let hues = if source.is_photo() { Some(hues(source, &found.leaves)?) } else { None };
    let owners = plants.map(|plants| leaves::assign(&found, plants));
    let rows = Rows {
        leaves: &found.leaves,
        hues: hues.as_deref(),
        owners: owners.as_deref(),
        gsd_m,
        georeference,
    };
    match ending(files.leaves).as_deref() {
        Some("gpkg") => rows.write_gpkg(files.leaves, files.force, plants)?,
        Some("geojson") => rows.write_geojson(files.leaves, files.force)?,
        _ => rows.write_csv(files.leaves, files.force)?,
    }
    if let Some(path) = files.labels {
        let sets: Vec<_> = found.leaves.iter().map(|leaf| leaf.runs.as_slice()).collect();
        labels::write(path, files.force, source.size(), georeference, &sets)?;
    }
    if let Some(folder) = files.figures {
        let mut view = View::of(source)?;
        draw(&mut view, &found.leaves);
        view.write(folder, "leaves.png", files.force)?;
    }
    if let (Some(path), Some(plants), Some(owners)) = (files.per_plant, plants, &owners) {
        table::write_per_plant(path, files.force, plants, owners)?;
    }
    let length_px = found.median_length_px();
    Ok(LeavesOutcome {
        width_px: mask.width,
        height_px: mask.height,
        gsd_m,
        leaves: found.leaves.len(),
        is_broad: found.is_broad,
        leaf_pixels: mask.count(),
        usual_width_px: found.usual_width_px,
        median_length_px: length_px,
        median_length_m: length_px.zip(gsd_m).map(|(length, gsd)| length * gsd),
        plants: plants.map(<[_]>::len),
        leaves_without_plant: owners
            .map(|owners| owners.iter().filter(|owner| owner.is_none()).count()),
    })
}

/// The ending of a name, in lower case.
fn ending(path: &Path) -> Option<String> {
    path.extension().map(|ending| ending.to_string_lossy().to_lowercase())
}

/// The mean hue of each leaf, degrees; the mean of directions on the circle, so that red is no green.
fn hues(source: &Source, leaves: &[Leaf]) -> Result<Vec<Option<f64>>, FileError> {
    let (_, height) = source.size();
    let bands: Vec<window::Band> = window::bands(height, BAND_ROWS, 0).collect();
    let mut of_band: Vec<Vec<(usize, usize)>> = vec![Vec::new(); bands.len()];
    for (leaf, runs) in leaves.iter().map(|leaf| &leaf.runs).enumerate() {
        for (run, place) in runs.iter().enumerate() {
            of_band[place.v as usize / BAND_ROWS].push((leaf, run));
        }
    }
    // Sine and cosine of the 180 hues.
    let directions: Vec<(f64, f64)> =
        (0..256).map(|hue| (f64::from(hue) * TAU / 180.0).sin_cos()).collect();
    let mut sums = vec![[0.0; 2]; leaves.len()];
    for (band, runs) in bands.iter().zip(of_band) {
        if runs.is_empty() {
            continue;
        }
        let photo = source.rgb(band.rows.clone())?;
        for (leaf, run) in runs {
            let run = leaves[leaf].runs[run];
            for u in run.start..run.end {
                let rgb = photo.get_pixel(u, run.v - band.rows.start as u32).0;
                let (sin, cos) = directions[usize::from(hsv::from_rgb(rgb)[0])];
                sums[leaf][0] += sin;
                sums[leaf][1] += cos;
            }
        }
    }
    let hue = |sum: &[f64; 2]| {
        (sum[0].hypot(sum[1]) > 1e-9).then(|| sum[0].atan2(sum[1]).rem_euclid(TAU).to_degrees())
    };
    Ok(sums.iter().map(hue).collect())
}

/// Colours of neighbouring leaves: hues a golden section of the circle apart.
fn colour(leaf: usize) -> [f64; 3] {
    let hue = (leaf as f64 * 0.618_034).fract() * 6.0;
    let part = |shift: f64| {
        let x = (hue + shift) % 6.0;
        (255.0 * (2.0 - (x - 3.0).abs()).clamp(0.0, 1.0)).round()
    };
    [part(3.0), part(1.0), part(5.0)]
}

/// Tints the pixels of each leaf in a colour of its own and draws its axis.
fn draw(view: &mut View, leaves: &[Leaf]) {
    let step = view.step as u32;
    for (index, leaf) in leaves.iter().enumerate() {
        let colour = colour(index);
        for run in leaf.runs.iter().filter(|run| run.v.is_multiple_of(step)) {
            for u in (run.start.next_multiple_of(step)..run.end).step_by(view.step) {
                let pixel = view.picture.get_pixel_mut(u / step, run.v / step);
                for k in 0..3 {
                    let mixed = 0.3 * f64::from(pixel.0[k]) + 0.7 * colour[k];
                    pixel.0[k] = mixed.round() as u8;
                }
            }
        }
    }
    for leaf in leaves {
        let axis: Vec<[f64; 2]> = leaf.axis_px.iter().map(|&at| view.position(at)).collect();
        draw_line(&mut view.picture, &axis, Rgb([255; 3]), 1);
    }
}
