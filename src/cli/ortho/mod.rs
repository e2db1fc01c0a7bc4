//! `rowgram ortho`: a mosaic of orthorectified photos, or each photo's own orthophoto.

pub(super) mod figures;
pub(super) mod project;
pub(super) mod query;
mod record;
mod render;

use crate::{
    error::Error,
    io::{FileError, geotiff, output},
    mapping::{
        MapError, Surface, View,
        balance::Overlaps,
        paint::Gain,
        photo::Photo,
        select::{Choice, Rules, Selector},
        surface::Heights,
    },
    raster::{
        georeference::{CrsKind, Georeference},
        undistort::Interpolation,
        window::Window,
    },
};
use clap::ValueEnum;
use project::{Block, Input};
use render::{Job, Photos, Rendered, render};
use serde::Serialize;
use std::{
    path::{Path, PathBuf},
    time::Instant,
};

/// Make an orthophoto mosaic, or orthophotos of single photos
///
/// Every cell of the map is taken to the ground by a surface, projected into the photos that may show it
/// (collinearity and lens), and takes its colour from the photo whose camera is closest. PROJECT is a folder that
/// rowgram align has been through, and rowgram dem; or give another program's model, or poses and a camera.
///
/// Writes a tiled, compressed GeoTIFF with overviews and an alpha channel (OUTPUT), and beside it, as
/// OUTPUT_provenance.tif, where each pixel came from: photo, column, row, view angle (degrees), distance to the
/// seam (metres; -1 where there is none); OUTPUT.json names the photos. rowgram query answers from them.
///
/// All options are off for the paper's form.
///
/// Examples:
///   rowgram ortho field --gsd 0.015
///   rowgram ortho --poses opk.csv --camera camera.toml --photos photos --dem dem.tif -o ortho.tif
///   rowgram ortho field --frames -o frames --gsd 0.02
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    #[command(flatten)]
    input: Input,
    /// The surface: a GeoTIFF of heights in the mapping frame [default: PROJECT/rowgram/dem.tif].
    #[arg(long, value_name = "FILE")]
    dem: Option<PathBuf>,
    /// The mosaic, or with --frames the folder [default: PROJECT/rowgram/ortho.tif].
    #[arg(short, long, value_name = "PATH")]
    output: Option<PathBuf>,
    /// An orthophoto of each photo instead of a mosaic.
    #[arg(long)]
    frames: bool,
    /// Only these photos, by name.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    only: Vec<String>,
    /// Side of a pixel, metres [default: the photos' median ground sampling distance].
    #[arg(long, value_name = "M")]
    gsd: Option<f64>,
    /// What the map shows: least x, least y, greatest x, greatest y, metres [default: all that photos show].
    #[arg(
        long,
        value_name = "X,Y,X,Y",
        value_delimiter = ',',
        num_args = 4,
        allow_negative_numbers = true
    )]
    bounds: Vec<f64>,
    /// Which photo a cell is taken from.
    #[arg(long, value_enum, default_value_t = ChoiceName::Closest)]
    choice: ChoiceName,
    /// The largest angle between line of sight and vertical, degrees.
    #[arg(long, value_name = "DEG")]
    max_angle: Option<f64>,
    /// Leave out photos from which the surface hides the cell; M metres above the line of sight hide nothing.
    #[arg(long, value_name = "M", num_args = 0..=1, default_missing_value = "0.05")]
    visibility: Option<f64>,
    /// Pixels along the borders of photos that are not used.
    #[arg(long, value_name = "PX", default_value_t = 0.0)]
    border: f64,
    /// Blend photos up to so many metres from the seams.
    #[arg(long, value_name = "M")]
    feather: Option<f64>,
    /// Bring the colours of overlapping photos together.
    #[arg(long)]
    balance: bool,
    /// How photos are read between their pixels.
    #[arg(long, value_enum, default_value_t = InterpolationName::Bilinear)]
    interpolation: InterpolationName,
    /// How the surface is read between its cells.
    #[arg(long, value_enum, default_value_t = HeightsName::Bilinear)]
    dem_interpolation: HeightsName,
    /// Do not write where the pixels came from.
    #[arg(long)]
    no_provenance: bool,
    /// Folder for pictures: preview, sources and seams, coverage; with CSV.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Megabytes of decoded photos that are kept.
    #[arg(long, value_name = "MB", default_value_t = 600)]
    memory: usize,
    /// Print what was done as one line of JSON.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum ChoiceName {
    /// Its camera is closest.
    Closest,
    /// It looks most straight down.
    Nadir,
    /// Its ground sampling distance is smallest.
    Gsd,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum InterpolationName {
    Bilinear,
    Bicubic,
    Lanczos,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum HeightsName {
    Bilinear,
    Bicubic,
}

/// What was written.
#[derive(Serialize)]
struct Map {
    output: String,
    provenance: Option<String>,
    width_px: usize,
    height_px: usize,
    gsd_m: f64,
    epsg: Option<u32>,
    photos: usize,
    coloured_pixels: usize,
    seconds: f64,
    megapixels_per_second: f64,
}

#[derive(Serialize)]
struct Report {
    maps: Vec<Map>,
    seconds: f64,
    peak_memory_mb: Option<f64>,
}

/// Runs the verb.
///
/// # Errors
/// What is missing or does not fit together, photos that cannot be read, outputs that cannot be written.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let started = Instant::now();
    args.check()?;
    let Block { mut views, crs, .. } = args.input.block()?;
    if views.is_empty() {
        return Err(Error::Argument(
            "there is no photo with a pose; give --model or --poses".into(),
        ));
    }
    for name in &args.only {
        let stem = Path::new(name).file_stem().and_then(|s| s.to_str());
        if !views.iter().any(|view| view.name == *name || Some(view.name.as_str()) == stem) {
            return Err(Error::Argument(format!("photo {name:?} has no pose")));
        }
    }
    if !args.only.is_empty() {
        views.retain(|view| {
            args.only.iter().any(|name| {
                let stem = Path::new(name).file_stem().and_then(|s| s.to_str());
                view.name == *name || Some(view.name.as_str()) == stem
            })
        });
    }
    let surface = args.surface(crs)?;
    let paths = args.input.photos(&views)?;
    let setting = Setting { args, views: &views, paths: &paths, surface: &surface };
    let mut maps = Vec::new();
    if args.frames {
        let folder = args.input.output(args.output.as_deref(), "frames")?;
        std::fs::create_dir_all(&folder).map_err(|e| FileError::write(&folder, e))?;
        let named = |k: usize| {
            let stem = paths[k].file_stem().unwrap_or_default().to_string_lossy();
            folder.join(format!("{stem}_ortho.tif"))
        };
        for k in 0..views.len() {
            setting.check_outputs(&named(k))?;
        }
        for k in 0..views.len() {
            if views[k].footprint_m(&surface).is_none() {
                tracing::warn!("{} shows nothing of the surface and is left out", views[k].name);
                continue;
            }
            let one = Setting { views: &views[k..=k], paths: &paths[k..=k], ..setting };
            maps.push(one.map(&named(k))?);
        }
        if maps.is_empty() {
            return Err(setting.nothing().into());
        }
    } else {
        let output = args.input.output(args.output.as_deref(), "ortho.tif")?;
        setting.check_outputs(&output)?;
        maps.push(setting.map(&output)?);
    }
    let report = Report {
        maps,
        seconds: started.elapsed().as_secs_f64(),
        peak_memory_mb: super::peak_memory_mb(),
    };
    if args.json {
        return super::print_json(&report);
    }
    for map in &report.maps {
        super::print(&format!(
            "{}: {} x {} pixels of {} m, {:.1} % coloured, {} photos, {:.1} s",
            map.output,
            map.width_px,
            map.height_px,
            map.gsd_m,
            100.0 * map.coloured_pixels as f64 / (map.width_px * map.height_px) as f64,
            map.photos,
            map.seconds
        ))?;
    }
    Ok(())
}

impl Args {
    fn check(&self) -> Result<(), Error> {
        let positive = |name: &str, value: Option<f64>| match value {
            Some(value) if !(value.is_finite() && value > 0.0) => {
                Err(Error::Argument(format!("--{name} {value}: expected a positive number")))
            }
            _ => Ok(()),
        };
        positive("gsd", self.gsd)?;
        positive("feather", self.feather)?;
        positive("max-angle", self.max_angle)?;
        if self.max_angle.is_some_and(|angle| angle >= 90.0) {
            return Err(Error::Argument("--max-angle: expected less than 90 degrees".into()));
        }
        if self.border < 0.0 || !self.border.is_finite() {
            return Err(Error::Argument(format!("--border {}: expected 0 or more", self.border)));
        }
        if let [left, bottom, right, top] = self.bounds[..]
            && !(left < right && bottom < top)
        {
            return Err(Error::Argument(format!(
                "--bounds {left},{bottom},{right},{top}: expected least x, least y, greatest x, greatest y"
            )));
        }
        Ok(())
    }

    fn surface(&self, crs: Option<crate::raster::georeference::Crs>) -> Result<Surface, Error> {
        let path = match (&self.dem, self.input.results()) {
            (Some(path), _) => path.clone(),
            (None, Some(folder)) if folder.join("dem.tif").is_file() => folder.join("dem.tif"),
            _ => {
                return Err(Error::Argument(
                    "there is no surface: give --dem, or make one with rowgram dem".into(),
                ));
            }
        };
        let between = match self.dem_interpolation {
            HeightsName::Bilinear => Heights::Bilinear,
            HeightsName::Bicubic => Heights::Bicubic,
        };
        let mut surface = read_surface(&path, between)?;
        let known = surface.georeference.crs;
        match (known.epsg, crs.and_then(|crs| crs.epsg)) {
            (Some(a), Some(b)) if a != b => {
                return Err(FileError::malformed(
                    &path,
                    None,
                    format!("it is in EPSG:{a}, the photos in EPSG:{b}; reproject it (gdalwarp -t_srs EPSG:{b})"),
                )
                .into());
            }
            (None, Some(_)) => surface.georeference.crs = crs.unwrap_or(known),
            _ => {}
        }
        if surface.georeference.crs.kind == CrsKind::Unknown {
            tracing::warn!(
                "{} does not say its coordinate reference system; taken as metres of the photos' frame",
                path.display()
            );
        }
        Ok(surface)
    }

    fn rules(&self) -> Rules {
        Rules {
            choice: match self.choice {
                ChoiceName::Closest => Choice::Closest,
                ChoiceName::Nadir => Choice::Nadir,
                ChoiceName::Gsd => Choice::Gsd,
            },
            max_angle_rad: self.max_angle.map(f64::to_radians),
            visibility_m: self.visibility,
            border_px: self.border,
        }
    }

    fn interpolation(&self) -> Interpolation {
        match self.interpolation {
            InterpolationName::Bilinear => Interpolation::Bilinear,
            InterpolationName::Bicubic => Interpolation::Bicubic,
            InterpolationName::Lanczos => Interpolation::Lanczos,
        }
    }
}

/// Reads heights from a GeoTIFF.
///
/// # Errors
/// Names the file: no place on the map, degrees, no heights.
pub(super) fn read_surface(path: &Path, between: Heights) -> Result<Surface, Error> {
    let reader = geotiff::Reader::open(path)?;
    let fault = |message: String| FileError::malformed(path, None, message);
    let place = reader.georeference().ok_or_else(|| {
        fault("it does not say where it lies on the map; expected a GeoTIFF of heights".into())
    })?;
    if reader.is_colour() {
        return Err(fault("it holds colours, expected heights (one band)".into()).into());
    }
    let size = [reader.width(), reader.height()];
    let heights = reader.read_f32(Window::whole(size[0], size[1]))?;
    Surface::new(place, size, heights, between).map_err(|error| fault(error.to_string()).into())
}

#[derive(Clone, Copy)]
struct Setting<'a> {
    args: &'a Args,
    views: &'a [View],
    paths: &'a [PathBuf],
    surface: &'a Surface,
}

impl Setting<'_> {
    fn check_outputs(&self, output: &Path) -> Result<(), Error> {
        output::check(output, self.args.force)?;
        output::check(&record::path(output), self.args.force)?;
        if !self.args.no_provenance {
            output::check(&provenance_path(output), self.args.force)?;
        }
        Ok(())
    }

    fn nothing(&self) -> MapError {
        let [[left, right], [bottom, top]] = self.surface.bounds_m();
        let centre = self.views[0].centre_m();
        MapError(format!(
            "no photo shows any of the surface, which lies within x {left:.1} to {right:.1}, y {bottom:.1} to {top:.1}; \
             photo {} was taken at x {:.1}, y {:.1}, z {:.1}. Are both in one coordinate reference system, heights too?",
            self.views[0].name, centre[0], centre[1], centre[2]
        ))
    }

    /// The grid of the map: its pixels' borders lie on multiples of their size.
    fn grid(&self) -> Result<(Georeference, [usize; 2]), Error> {
        let args = self.args;
        let gsd = match args.gsd {
            Some(gsd) => gsd,
            None => {
                let mut all: Vec<f64> =
                    self.views.iter().filter_map(|view| view.gsd_m(self.surface)).collect();
                all.sort_by(f64::total_cmp);
                let median = all.get(all.len() / 2).ok_or_else(|| self.nothing())?;
                // Three digits are enough to name it.
                let unit = 10f64.powf(median.log10().floor() - 2.0);
                (median / unit).round() * unit
            }
        };
        let [x, y] = match args.bounds[..] {
            [left, bottom, right, top] => [[left, right], [bottom, top]],
            _ => {
                let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
                let mut beyond = 0;
                for view in self.views {
                    match view.footprint_m(self.surface) {
                        Some(footprint) => {
                            for (all, own) in bounds.iter_mut().zip(footprint) {
                                *all = [all[0].min(own[0]), all[1].max(own[1])];
                            }
                        }
                        None => beyond += 1,
                    }
                }
                if beyond > 0 && beyond < self.views.len() {
                    tracing::warn!("{beyond} photos show nothing of the surface");
                }
                bounds
            }
        };
        if x[0] > x[1] {
            return Err(self.nothing().into());
        }
        let span = |[low, high]: [f64; 2]| {
            let first = (low / gsd).floor();
            (first, (high / gsd).ceil() - first)
        };
        let ((left, columns), (bottom, rows)) = (span(x), span(y));
        if columns * rows > 1e11 {
            return Err(Error::Argument(format!(
                "the map would have {columns:.0} x {rows:.0} pixels of {gsd} m; give a larger --gsd or --bounds"
            )));
        }
        let origin = [(left + 0.5) * gsd, (bottom + rows - 0.5) * gsd];
        let grid = Georeference::north_up(origin, gsd, self.surface.georeference.crs);
        Ok((grid, [columns.max(1.0) as usize, rows.max(1.0) as usize]))
    }

    fn map(&self, output: &Path) -> Result<Map, Error> {
        let started = Instant::now();
        let args = self.args;
        let (grid, size) = self.grid()?;
        let selector = Selector::new(self.views, self.surface, grid, args.rules());
        let mut photos = Photos::new(self.paths, args.memory << 20);
        let gains = match args.balance {
            true => Some(self.gains(&selector, size, &mut photos)?),
            false => None,
        };
        let job = Job {
            selector: &selector,
            paths: self.paths,
            grid,
            size,
            interpolation: args.interpolation(),
            feather_m: args.feather,
            gains: gains.as_deref(),
        };
        let provenance = (!args.no_provenance).then(|| provenance_path(output));
        let rendered = render(&job, &mut photos, (output, provenance.as_deref()), args.force)?;
        if rendered.coloured == 0 {
            tracing::warn!("{}: no pixel has a colour", output.display());
        }
        record::write(output, self, &grid, size, gains.as_deref())?;
        if let Some(folder) = &args.figures {
            self.figures(folder, output, &selector, &rendered, grid)?;
        }
        let seconds = started.elapsed().as_secs_f64();
        Ok(Map {
            output: output.display().to_string(),
            provenance: provenance.map(|path| path.display().to_string()),
            width_px: size[0],
            height_px: size[1],
            gsd_m: grid.per_column[0],
            epsg: grid.crs.epsg,
            photos: rendered.cells_of.iter().filter(|&&cells| cells > 0).count(),
            coloured_pixels: rendered.coloured,
            seconds,
            megapixels_per_second: 1e-6 * (size[0] * size[1]) as f64 / seconds,
        })
    }

    fn figures(
        &self,
        folder: &Path,
        output: &Path,
        selector: &Selector<'_>,
        rendered: &Rendered,
        grid: Georeference,
    ) -> Result<(), Error> {
        let folder = match self.args.frames {
            true => folder.join(output.file_stem().unwrap_or_default()),
            false => folder.to_owned(),
        };
        std::fs::create_dir_all(&folder).map_err(|e| FileError::write(&folder, e))?;
        figures::mosaic(&folder, selector, rendered, grid, self.args.force)
    }

    /// Gains from cells on a coarse grid, as many as tell the means apart.
    fn gains(
        &self,
        selector: &Selector<'_>,
        [width, height]: [usize; 2],
        photos: &mut Photos<'_>,
    ) -> Result<Vec<Gain>, Error> {
        let step = ((width * height) as f64 / 40_000.0).sqrt().ceil().max(1.0) as usize;
        let among: Vec<u32> = (0..self.views.len() as u32).collect();
        let mut candidates = Vec::new();
        let mut wanted: Vec<Vec<(usize, [f32; 2])>> = vec![Vec::new(); self.views.len()];
        let mut cells = 0;
        for v in (step / 2..height).step_by(step) {
            for u in (step / 2..width).step_by(step) {
                let Some(point) = selector.point_m(u, v) else { continue };
                selector.candidates(point, &among, &mut candidates);
                if candidates.len() >= 2 {
                    for candidate in &candidates {
                        let at = candidate.image_px.map(|value| value as f32);
                        wanted[candidate.view].push((cells, at));
                    }
                    cells += 1;
                }
            }
        }
        let mut colours: Vec<Vec<(usize, [f32; 3])>> = vec![Vec::new(); cells];
        let all: Vec<usize> = (0..self.views.len()).filter(|&k| !wanted[k].is_empty()).collect();
        photos.each_group(&all, selector, |photos: &[Option<&Photo>]| {
            for (k, photo) in photos.iter().enumerate() {
                let Some(photo) = photo else { continue };
                for &(cell, at) in &wanted[k] {
                    let [r, g, b, _] = photo.at(at, Interpolation::Bilinear);
                    colours[cell].push((k, [r, g, b]));
                }
            }
        })?;
        let mut overlaps = Overlaps::default();
        for seen in &colours {
            for (i, &first) in seen.iter().enumerate() {
                seen[i + 1..].iter().for_each(|&second| overlaps.add(first, second));
            }
        }
        if overlaps.pairs() == 0 {
            tracing::warn!("--balance: no two photos show the same ground");
        }
        Ok(overlaps.gains(self.views.len())?)
    }
}

/// Where the provenance of a mosaic is.
pub(super) fn provenance_path(output: &Path) -> PathBuf {
    let stem = output.file_stem().unwrap_or_default().to_string_lossy();
    output.with_file_name(format!("{stem}_provenance.tif"))
}
