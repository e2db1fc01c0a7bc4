//! `rowgram ortho`: a mosaic of orthorectified photos, or each photo's own orthophoto.

mod above;
pub(super) mod figures;
mod map;
mod options;
pub(super) mod project;
pub(super) mod query;
mod record;
mod render;

use crate::{
    error::Error,
    io::{FileError, output},
    mapping::{MapError, Surface, View},
};
pub(super) use options::Args;
use options::read_surface;
use project::Block;
use serde::Serialize;
use std::{
    path::{Path, PathBuf},
    time::Instant,
};

/// What was written.
#[derive(Serialize)]
struct Map {
    output: String,
    provenance: Option<String>,
    width_px: usize,
    height_px: usize,
    gsd_m: f64,
    /// How far above the surface it was drawn.
    above_m: f64,
    epsg: Option<u32>,
    vertical_epsg: Option<u32>,
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
    let on_surface =
        Setting { args, views: &views, paths: &paths, surface: &surface, above_m: 0.0 };
    let outputs = on_surface.outputs()?;
    for output in &outputs {
        on_surface.check_outputs(output)?;
    }
    let above_m = on_surface.above_m()?;
    let surface = surface.raised(above_m);
    let setting = Setting { args, views: &views, paths: &paths, surface: &surface, above_m };
    let mut maps = Vec::new();
    if args.frames {
        for (k, output) in outputs.iter().enumerate() {
            if views[k].footprint_m(&surface).is_none() {
                tracing::warn!("{} shows nothing of the surface and is left out", views[k].name);
                continue;
            }
            let one = Setting { views: &views[k..=k], paths: &paths[k..=k], ..setting };
            maps.push(one.map(output)?);
        }
        if maps.is_empty() {
            return Err(setting.nothing().into());
        }
    } else {
        for output in &outputs {
            maps.push(setting.map(output)?);
        }
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

#[derive(Clone, Copy)]
struct Setting<'a> {
    args: &'a Args,
    views: &'a [View],
    paths: &'a [PathBuf],
    surface: &'a Surface,
    /// How far it was raised.
    above_m: f64,
}

impl Setting<'_> {
    /// The files of the maps: of each photo, or the one of all.
    fn outputs(&self) -> Result<Vec<PathBuf>, Error> {
        let args = self.args;
        if !args.frames {
            return Ok(vec![args.input.output(args.output.as_deref(), "ortho.tif")?]);
        }
        let folder = args.input.output(args.output.as_deref(), "frames")?;
        std::fs::create_dir_all(&folder).map_err(|e| FileError::write(&folder, e))?;
        let named = |path: &PathBuf| {
            let stem = path.file_stem().unwrap_or_default().to_string_lossy();
            folder.join(format!("{stem}_ortho.tif"))
        };
        Ok(self.paths.iter().map(named).collect())
    }

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
}

/// Where the provenance of a mosaic is.
pub(super) fn provenance_path(output: &Path) -> PathBuf {
    let stem = output.file_stem().unwrap_or_default().to_string_lossy();
    output.with_file_name(format!("{stem}_provenance.tif"))
}
