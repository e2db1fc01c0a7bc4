//! Plots cut out of the photos themselves, and their traits with the scatter between photos.
//!
//! An orthomosaic shows a plot once, from one photo or patched from several. Here each plot is drawn from every one of its best
//! photos alone ([`PlotFrame`]). What the photos say of a plot is averaged, and how much they differ is told beside: that is
//! what one look at a plot is worth.
//!
//! A photo shows a plot where all corners of its frame are in the picture. Photos that the stage align found blurred or wrongly
//! exposed come last, then the steeper view of the middle of the plot comes first.

mod comparison;
mod traits;
mod write;

use super::{
    Project, Stage, layers,
    ortho::read_pixels,
    photo_names,
    plots::{self, PlotsOutcome},
    query,
    record::{self, NewFolder},
};
pub use comparison::TraitComparison;
use image::RgbImage;
use rayon::prelude::*;
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
};
use rowgram_files::{images, polygons};
use rowgram_optim::output::FileError;
use rowgram_plants::phenotype::traits::PlotTraits;
use rowgram_raster::{georeference::Georeference, polygon::Polygon, spectral::Index};
use rowgram_survey::mapping::{
    Surface, View, photo::DecodedPhoto, plot_frame::PlotFrame, undistort::Interpolation,
};
use serde::{Deserialize, Serialize};
use std::{
    collections::HashSet,
    path::{Path, PathBuf},
};
use traits::LeafRule;
pub use traits::PhotoTraits;

/// The folder in the results.
pub const FOLDER: &str = "crops";
/// The most cells of a frame: a plot of 100 m x 100 m at 1 cm.
const MAX_CELLS: usize = 100_000_000;
/// Findings of the stage align about single photos.
const POOR_PHOTOS: [&str; 2] = ["photo-blurred", "photo-exposure"];

rowgram_base::options! {
    /// Plots cut out of the photos (rowgram plots crops).
    pub struct CropsOptions in "crops", main [photos_per_plot, margin_m] {
        /// Photos per plot, the best first.
        pub photos_per_plot: usize = 3, limits between(1.0, 1000.0);
        /// Ground around the plot that is shown, too.
        pub margin_m: f64 = 0.0, limits between(0.0, 1000.0);
        /// Size of a pixel on the ground. Where not set: that of the orthomosaic.
        pub gsd_m: Option<f64> = None, limits POSITIVE, example "0.005";
        /// Interpolation between the pixels of photos.
        pub interpolation: Interpolation = Interpolation::Bicubic;
        /// Also write the part of each photo as it was taken, without any interpolation.
        pub as_taken: bool = false;
    }
}

/// A plot in one photo.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlotCrop {
    /// Name of the plot.
    pub plot: String,
    /// Name of the photo.
    pub image: String,
    /// 1 for the best photo of the plot.
    pub rank: usize,
    /// The picture, in the folder of the crops.
    pub file: PathBuf,
    /// The part of the photo as it was taken, where it is written.
    pub as_taken: Option<PathBuf>,
    /// Columns and rows of the picture.
    pub size_px: [usize; 2],
    /// Corners of the plot in the picture, pixels; the centre of the first one is at 0, 0.
    pub polygon_px: Vec<Vec<[f64; 2]>>,
    /// The same in the photo.
    pub photo_polygon_px: Vec<Vec<[f64; 2]>>,
    /// First column and row of the part as it was taken.
    pub as_taken_from_px: Option<[u32; 2]>,
    /// Angle between the vertical and the line of sight to the middle of the plot, degrees.
    pub view_angle_deg: f64,
    /// What the photo says of the plot.
    pub traits: PhotoTraits,
}

/// The plots of a project in their photos.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CropsOutcome {
    /// The folder that they are in.
    pub folder: PathBuf,
    /// EPSG code of the map that world files refer to.
    pub epsg: Option<u32>,
    /// Size of a pixel on the ground, metres.
    pub gsd_m: f64,
    /// All crops, plot by plot, the best photo first.
    pub crops: Vec<PlotCrop>,
    /// Traits of all plots, from the orthomosaic and from the photos.
    pub comparison: Vec<TraitComparison>,
    /// Plots that no photo shows whole.
    pub without_photo: Vec<String>,
}

/// A plot and its frame.
struct Plot {
    name: String,
    /// Its name as that of a folder.
    folder: String,
    /// Rings of map positions.
    rings: Vec<Vec<[f64; 2]>>,
    frame: PlotFrame,
    /// Where its middle is in the orthomosaic, -1 to 1 of its width and height.
    place: [f64; 2],
}

/// What the crops are cut from.
struct Source<'a> {
    views: &'a [View],
    surface: &'a Surface,
    rule: Option<LeafRule>,
    options: &'a CropsOptions,
    folder: &'a Path,
}

/// Cuts every plot of a project out of its best photos, into `crops/` of the results.
///
/// # Errors
/// [`Error::NothingToDo`] where there are no plots or no photos; a folder that is there already without `force`; plots that
/// none of the photos shows; photos that cannot be read.
pub fn crops(
    project: &Project,
    options: &CropsOptions,
    force: bool,
    monitor: &mut dyn Monitor,
) -> Result<CropsOutcome, Error> {
    use rowgram_base::options::Options;
    options.validate().map_err(|why| Error::Argument(format!("[crops] {why}")))?;
    let _lock = project.lock()?;
    monitor.stage("crops");
    let origins = query::query(project, None)?;
    let (georeference, size) = origins.place()?;
    let gsd_m = match options.gsd_m.or(georeference.gsd_m()) {
        Some(gsd_m) => gsd_m,
        None => return Err(origins.fault("the map has no scale in metres".into())),
    };
    let plots = read_plots(project, georeference, size, gsd_m, options.margin_m)?;
    let folder = project.results().join(FOLDER);
    if folder.exists() && !force {
        return Err(FileError::Exists { path: folder }.into());
    }
    let fresh = NewFolder::begin(&folder)?;
    let source = Source {
        views: origins.views(),
        surface: origins.surface(),
        rule: LeafRule::of(project)?,
        options,
        folder: fresh.path(),
    };
    let chosen = choose(&plots, &source, &poor_photos(project));
    let without_photo: Vec<String> = (plots.iter().zip(&chosen))
        .filter(|(_, photos)| photos.is_empty())
        .map(|(plot, _)| plot.name.clone())
        .collect();
    if without_photo.len() == plots.len() {
        return Err(Error::Incomplete(format!(
            "no photo shows any of the {} plots whole; smaller plots, or photos from higher up, would be",
            plots.len()
        )));
    }
    if !without_photo.is_empty() {
        let message = format!(
            "{} of {} plots are in no photo as a whole and have no crops: {}",
            without_photo.len(),
            plots.len(),
            without_photo.join(", ")
        );
        monitor.diagnostic(&Diagnostic::warning("plots-not-whole", "crops", message));
    }
    let crops = cut(&plots, &chosen, &origins, &source, monitor)?;
    let epsg = georeference.crs.epsg;
    let (on_map, indices) = traits_on_map(project)?;
    let pairs = comparison::pairs(&crops, &on_map, &indices);
    comparison::write(&pairs, fresh.path())?;
    let comparison = comparison::summary(&pairs);
    let folder_of = folder.clone();
    let outcome = CropsOutcome { folder: folder_of, epsg, gsd_m, crops, comparison, without_photo };
    write::tables(&outcome, fresh.path())?;
    record::publish_folder(fresh, project.results(), FOLDER, force)?;
    Ok(outcome)
}

/// The traits of the plots in the orthomosaic, and the indices among them.
fn traits_on_map(project: &Project) -> Result<(Vec<PlotTraits>, Vec<Index>), Error> {
    let Some(record) = project.records().read(Stage::Plots) else { return Ok(Default::default()) };
    let outcome: PlotsOutcome = serde_json::from_value(record.outcome).map_err(|e| {
        let message = format!("its record is damaged ({e}); make it again");
        FileError::malformed(&project.folder(Stage::Plots), None, message)
    })?;
    Ok((outcome.plots, outcome.indices))
}

fn read_plots(
    project: &Project,
    georeference: Georeference,
    size: [usize; 2],
    gsd_m: f64,
    margin_m: f64,
) -> Result<Vec<Plot>, Error> {
    let path = project.finished(Stage::Plots, plots::POLYGONS).ok_or_else(|| {
        Error::NothingToDo(format!(
            "there are no plots in {}; make them with rowgram plots",
            project.folder(Stage::Plots).display()
        ))
    })?;
    let fault =
        |name: &str, why: &str| FileError::malformed(&path, None, format!("plot {name:?} {why}"));
    // Folders of plots stand beside the tables.
    let mut folders: HashSet<String> = write::TABLES.map(str::to_owned).into();
    let plot = |polygons::Named { name, polygon, .. }: polygons::Named| {
        let on_map = |ring: &Vec<[f64; 2]>| ring.iter().map(|at| georeference.map(*at)).collect();
        let rings: Vec<Vec<[f64; 2]>> = polygon.rings.iter().map(on_map).collect();
        let frame = PlotFrame::around(&rings.concat(), margin_m, gsd_m, georeference.crs)
            .ok_or_else(|| fault(&name, "has no area"))?;
        if frame.width.saturating_mul(frame.height) > MAX_CELLS {
            let why =
                format!("has {} x {} pixels, more than can be drawn", frame.width, frame.height);
            return Err(fault(&name, &why));
        }
        let middle = middle(&polygon);
        let place = [0, 1].map(|axis| (2.0 * middle[axis] + 1.0) / size[axis] as f64 - 1.0);
        let folder = photo_names::free(&mut folders, &write::as_file_name(&name));
        Ok(Plot { name, folder, rings, frame, place })
    };
    let named = layers::layer(project, &path, Some(&georeference), None)?.polygons;
    Ok(named.into_iter().map(plot).collect::<Result<_, _>>()?)
}

/// Mean of the corners of the first ring.
fn middle(polygon: &Polygon) -> [f64; 2] {
    let ring = polygon.rings.first().map_or(&[][..], Vec::as_slice);
    let count = ring.len().max(1) as f64;
    [0, 1].map(|axis| ring.iter().map(|at| at[axis]).sum::<f64>() / count)
}

/// Photos that the stage align has something to say of.
fn poor_photos(project: &Project) -> HashSet<String> {
    let found = project.records().read(Stage::Align).map(|record| record.diagnostics);
    let poor = found.into_iter().flatten().filter(|of| POOR_PHOTOS.contains(&&*of.code));
    poor.map(|of| of.subject).collect()
}

/// A photo of a plot, and the angle at which it sees its middle.
type Chosen = (usize, f64);

/// The best photos of each plot.
fn choose(plots: &[Plot], source: &Source<'_>, poor: &HashSet<String>) -> Vec<Vec<Chosen>> {
    let of_plot = |plot: &Plot| {
        let middle = plot
            .frame
            .georeference
            .map([0.5 * (plot.frame.width as f64 - 1.0), 0.5 * (plot.frame.height as f64 - 1.0)]);
        let [x, y] = middle;
        let Some(z) = source.surface.at(middle) else { return Vec::new() };
        let mut photos: Vec<(bool, usize, f64)> = (source.views.iter().enumerate())
            .filter(|(_, view)| view.pixel([x, y, z]).is_some())
            .filter(|(_, view)| plot.frame.is_inside(view, source.surface))
            .map(|(number, view)| {
                let [cx, cy, cz] = view.centre_m();
                let angle_deg = (cx - x).hypot(cy - y).atan2(cz - z).to_degrees();
                (poor.contains(&view.name), number, angle_deg)
            })
            .collect();
        photos.sort_by(|a, b| a.0.cmp(&b.0).then(a.2.total_cmp(&b.2)));
        photos.truncate(source.options.photos_per_plot);
        photos.into_iter().map(|(_, number, angle_deg)| (number, angle_deg)).collect()
    };
    plots.par_iter().map(of_plot).collect()
}

/// Draws and writes all crops, each photo being read once.
fn cut(
    plots: &[Plot],
    chosen: &[Vec<Chosen>],
    origins: &query::OrthophotoOrigins,
    source: &Source<'_>,
    monitor: &mut dyn Monitor,
) -> Result<Vec<PlotCrop>, Error> {
    // Of each photo: plot, rank, angle.
    let mut of_photo: Vec<Vec<(usize, usize, f64)>> = vec![Vec::new(); source.views.len()];
    for (plot, photos) in chosen.iter().enumerate() {
        for (rank, &(photo, angle_deg)) in photos.iter().enumerate() {
            of_photo[photo].push((plot, rank, angle_deg));
        }
    }
    for plot in
        plots.iter().zip(chosen).filter(|(_, photos)| !photos.is_empty()).map(|(plot, _)| plot)
    {
        let folder = source.folder.join(&plot.folder);
        std::fs::create_dir(&folder).map_err(|e| FileError::write(&folder, e))?;
    }
    let used: Vec<usize> = (0..of_photo.len()).filter(|&k| !of_photo[k].is_empty()).collect();
    let names = source.views.iter().enumerate().map(|(number, view)| {
        let stem = origins.photo(number).and_then(Path::file_stem).unwrap_or_default();
        [&stem.to_string_lossy(), view.name.as_str()].map(write::as_file_name)
    });
    let file_names = photo_names::distinct(&names.collect::<Vec<_>>());
    let counter = Counter::new(monitor, "cutting plots out", used.len(), "photos");
    let of_one = |&number: &usize| -> Result<Vec<(usize, usize, PlotCrop)>, Error> {
        let view = &source.views[number];
        let path = origins
            .photo(number)
            .ok_or_else(|| Error::Incomplete(format!("{}: its file is not known", view.name)))?;
        let (pixels, gaps) = read_pixels(path, view.interior.size_px())?;
        let photo = Photo {
            view,
            decoded: DecodedPhoto::new(&pixels, gaps.as_deref()),
            pixels,
            file_name: &file_names[number],
        };
        let crops = of_photo[number].iter().map(|&(plot, rank, angle_deg)| {
            let crop = one(&plots[plot], &photo, source, rank, angle_deg)?;
            Ok((plot, rank, crop))
        });
        let crops = crops.collect::<Result<Vec<_>, Error>>();
        counter.tick();
        crops
    };
    let found: Vec<Vec<(usize, usize, PlotCrop)>> =
        used.par_iter().map(of_one).collect::<Result<_, Error>>()?;
    let mut found: Vec<(usize, usize, PlotCrop)> = found.into_iter().flatten().collect();
    found.sort_by_key(|&(plot, rank, _)| (plot, rank));
    Ok(found.into_iter().map(|(_, _, crop)| crop).collect())
}

/// A photo that is read.
struct Photo<'a> {
    view: &'a View,
    decoded: DecodedPhoto,
    pixels: RgbImage,
    /// What its crops are called.
    file_name: &'a str,
}

/// Draws a plot from a photo, writes it, and measures its traits.
fn one(
    plot: &Plot,
    photo: &Photo<'_>,
    source: &Source<'_>,
    rank: usize,
    view_angle_deg: f64,
) -> Result<PlotCrop, Error> {
    let Source { surface, options, folder, .. } = source;
    let Plot { frame, rings, .. } = plot;
    let (picture, shown) = frame.draw(&photo.decoded, photo.view, surface, options.interpolation);
    let in_frame = |at: &[f64; 2]| frame.georeference.pixel(*at);
    let in_photo = |&[x, y]: &[f64; 2]| photo.view.pixel([x, y, surface.at([x, y])?]);
    let all = |place: &dyn Fn(&[f64; 2]) -> Option<[f64; 2]>| -> Vec<Vec<[f64; 2]>> {
        rings.iter().map(|ring| ring.iter().filter_map(place).collect()).collect()
    };
    let (polygon_px, photo_polygon_px) = (all(&in_frame), all(&in_photo));
    let area = Polygon { rings: polygon_px.clone() };
    let traits = PhotoTraits::of(&picture, &shown, &area, source.rule.as_ref(), plot.place)?;
    let name = photo.file_name;
    let file = Path::new(&plot.folder).join(format!("{name}.png"));
    images::write_photo(&folder.join(&file), false, &picture)?;
    write::world_file(&folder.join(&file), &frame.georeference)?;
    let (mut as_taken, mut as_taken_from_px) = (None, None);
    if options.as_taken
        && let Some((from, part)) = write::part_around(&photo.pixels, &photo_polygon_px)
    {
        let file = Path::new(&plot.folder).join(format!("{name}.as-taken.png"));
        images::write_photo(&folder.join(&file), false, &part)?;
        (as_taken, as_taken_from_px) = (Some(file), Some(from));
    }
    Ok(PlotCrop {
        plot: plot.name.clone(),
        image: photo.view.name.clone(),
        rank: rank + 1,
        file,
        as_taken,
        size_px: [frame.width, frame.height],
        polygon_px,
        photo_polygon_px,
        as_taken_from_px,
        view_angle_deg,
        traits,
    })
}
