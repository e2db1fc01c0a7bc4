//! A surface from elsewhere: the DSM of another program, a point cloud, and the ground below it.
//!
//! Cells are those of the raster that is given, so that its heights stay what they are. Where no ground is given it is fitted to what is
//! bare: the points of a cloud that are classified as ground, else cells where the cloud or the orthomosaic is not green.

use super::{
    SurfaceOptions, SurfaceOutcome,
    ground::{Datum, Fitted, Ground},
    heights::{self, BAND, Heights, cloud_crs, is_cloud},
    write::{self, Found, SurfacePart},
};
use crate::Project;
use image::RgbImage;
use rowgram_base::{
    error::Error,
    monitor::{Collector, Counter, Diagnostic, Monitor},
};
use rowgram_files::{cloud::CloudReader, rasters::Source};
use rowgram_optim::output::{FileError, name_of};
use rowgram_raster::{
    georeference::{Crs, Georeference, Transfer},
    window::{self, Window},
};
use rowgram_survey::mapping::{
    MapError,
    dense::{
        GroundPlaces, Terrain,
        tile::{is_bare, node_m},
    },
    grid::rounded,
};
use std::path::{Path, PathBuf};

/// Files that heights come from.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct GivenFiles {
    /// The surface in place of matching.
    pub(super) dsm: Option<PathBuf>,
    /// The ground.
    pub(super) dtm: Option<PathBuf>,
    /// Geoid heights.
    pub(super) geoid: Option<PathBuf>,
}

impl GivenFiles {
    /// What the options name, else what lies beside an orthomosaic that is given.
    pub(super) fn of(project: &Project, options: &SurfaceOptions) -> GivenFiles {
        let named = |path: &Option<PathBuf>| path.as_ref().map(|path| project.root().join(path));
        let beside = project.heights_beside();
        GivenFiles {
            dsm: named(&options.dsm).or(beside.dsm),
            dtm: named(&options.dtm).or(beside.dtm),
            geoid: named(&options.geoid),
        }
    }

    pub(super) fn all(&self) -> impl Iterator<Item = PathBuf> {
        [&self.dsm, &self.dtm, &self.geoid].into_iter().flatten().cloned()
    }

    /// The ground that is given.
    ///
    /// # Errors
    /// Files that cannot be read, a geoid without a ground.
    pub(super) fn ground(
        &self,
        options: &SurfaceOptions,
        map: Option<Crs>,
        monitor: &mut dyn Monitor,
    ) -> Result<Option<Ground>, Error> {
        let is_surface = options.ellipsoidal == super::Ellipsoidal::Dsm;
        let datum = self.geoid.as_deref().map(|path| Datum::read(path, is_surface)).transpose()?;
        let Some(path) = &self.dtm else {
            return match datum {
                None => Ok(None),
                Some(_) => Err(Error::Argument(
                    "[surface] geoid: there is no dtm; a geoid model brings the heights of a dtm to the vertical datum of the surface".into(),
                )),
            };
        };
        if !is_cloud(path) {
            let heights = Heights::raster(path)?;
            heights.warn(path, monitor);
            return Ok(Some(Ground::Given { heights, datum }));
        }
        if datum.is_some() {
            return Err(Error::Argument(
                "[surface] geoid: expected a dtm that is a GeoTIFF, found a point cloud".into(),
            ));
        }
        let fitted = of_cloud(path, map, false)?.ok_or_else(|| {
            let message = "none of its points is classified as ground (class 2); give it as [surface] dsm, or a raster of the ground";
            FileError::malformed(path, None, message)
        })?;
        Ok(Some(Ground::Fitted(fitted)))
    }
}

/// What the surface comes from, or why it cannot be had.
pub(super) fn doctor(
    project: &Project,
    options: &SurfaceOptions,
    files: &GivenFiles,
) -> Vec<Diagnostic> {
    let Some(dsm) = &files.dsm else { return Vec::new() };
    let mut found = Collector::default();
    let mut check = || -> Result<(), Error> {
        let ortho =
            project.given_orthomosaic().map(|path| project.open_picture(&path)).transpose()?;
        let map = ortho.as_ref().and_then(|source| Some((source.georeference()?, source.size())));
        // Of a cloud the head is read.
        if is_cloud(dsm) {
            cloud_crs(&CloudReader::open(dsm)?, map.map(|(place, _)| place.crs), dsm)?;
        } else if let Some((place, (width, height))) = map {
            let surface = Heights::raster(dsm)?;
            surface.require_on(dsm, &place, [width, height])?;
            surface.warn(dsm, &mut found);
        }
        match files.dtm.as_deref().filter(|dtm| is_cloud(dtm)) {
            Some(dtm) => cloud_crs(&CloudReader::open(dtm)?, None, dtm).map(drop)?,
            None => drop(files.ground(options, None, &mut found)?),
        }
        Ok(())
    };
    let said = match check() {
        Err(error) => Diagnostic::error("surface-unreadable", name_of(dsm), error.to_string()),
        Ok(()) => {
            let ground = match &files.dtm {
                Some(dtm) => format!("over the ground of {}", name_of(dtm)),
                None => "over a ground that is fitted to what is bare".to_owned(),
            };
            let message = format!("heights come from it, {ground}");
            Diagnostic::info("surface-given", name_of(dsm), message)
        }
    };
    found.diagnostics.push(said);
    found.diagnostics
}

/// Of cells smaller than this every other one is looked at for the ground, as the coarse pass of matching does, metres.
const EVERY_OTHER_BELOW_M: f64 = 0.1;

/// Does the stage with a surface from elsewhere.
///
/// # Errors
/// Files that cannot be read or lie elsewhere, outputs that cannot be written.
pub(super) fn work(
    project: &Project,
    (options, files): (&SurfaceOptions, &GivenFiles),
    dsm: &Path,
    folder: &Path,
    monitor: &mut dyn Monitor,
) -> Result<SurfaceOutcome, Error> {
    if options.cloud {
        let message = format!(
            "[surface] cloud: the surface comes from {} and is not matched, so it has no colours",
            name_of(dsm)
        );
        return Err(Error::Argument(message));
    }
    let ortho = project.given_orthomosaic().map(|path| project.open_picture(&path)).transpose()?;
    let map = ortho.as_ref().and_then(|source| source.georeference()).map(|place| place.crs);
    let surface = heights::open(dsm, options.cell_m, map)?;
    if let Some((place, (width, height))) =
        ortho.as_ref().and_then(|source| Some((source.georeference()?, source.size())))
    {
        surface.require_on(dsm, &place, [width, height])?;
    }
    if options.cell_m.is_some() && !is_cloud(dsm) {
        let message = "the cells are those of the raster that is given; cell_m is for clouds";
        monitor.diagnostic(&Diagnostic::warning("surface-cells", name_of(dsm), message));
    }
    surface.warn(dsm, monitor);
    let ground = match files.ground(options, map, monitor)? {
        Some(ground) => ground,
        None => {
            let of_points = match is_cloud(dsm) {
                true => of_cloud(dsm, map, ortho.is_none())?,
                false => None,
            };
            match (of_points, &ortho) {
                (Some(fitted), _) => Ground::Fitted(fitted),
                (None, Some(ortho)) => of_colours(&surface, ortho, monitor)?,
                (None, None) => Ground::Unknown,
            }
        }
    };
    let pixel_m = surface.place.pixel_m().unwrap_or([f64::NAN; 2]);
    let found = Found {
        place: &surface.place,
        size: surface.size,
        ground: &ground,
        cell_m: rounded((pixel_m[0] * pixel_m[1]).sqrt(), 5),
        matching: None,
    };
    let mut load = |_, window| Ok(SurfacePart::Given(surface.window(window)?));
    let mut outcome = write::write(&found, &mut load, folder).map_err(|error| match error {
        why if why.is::<MapError>() => FileError::malformed(dsm, None, why.to_string()).into(),
        other => other,
    })?;
    outcome.given = Some(name_of(dsm));
    if let (Some(dtm), None) = (&files.dtm, outcome.above_ground_m) {
        let message = format!("it has no height where {} has one", name_of(dsm));
        return Err(FileError::malformed(dtm, None, message).into());
    }
    let ground = match (&files.dtm, &ground) {
        (Some(dtm), _) => format!("the ground is {}", name_of(dtm)),
        (None, Ground::Unknown) => "there is no ground below it".to_owned(),
        (None, _) => "the ground below it is fitted to what is bare".to_owned(),
    };
    let message = format!("heights are those of {}, nothing is matched; {ground}", name_of(dsm));
    monitor.diagnostic(&Diagnostic::info("surface-given", "surface", message));
    Ok(outcome)
}

/// The ground through points of a cloud: those that are classified as ground; where there are none and colours may say what is bare, those
/// that are not green.
fn of_cloud(path: &Path, map: Option<Crs>, by_colour: bool) -> Result<Option<Fitted>, Error> {
    let mut reader = CloudReader::open(path)?;
    let crs = cloud_crs(&reader, map, path)?;
    let bounds_m = reader.bounds();
    let area_m2 = bounds_m.iter().map(|[low, high]| high - low).product::<f64>();
    let node_m = node_m((area_m2 / reader.points() as f64).sqrt());
    let [mut by_class, mut by_hue] = [(); 2].map(|()| GroundPlaces::new(bounds_m, node_m));
    let mut is_classified = false;
    reader.each(|point| {
        is_classified |= point.is_ground;
        by_class.add(point.position, point.is_ground);
        if let (true, Some(colour)) = (by_colour && !is_classified, point.colour) {
            by_hue.add(point.position, is_bare(colour));
        }
    })?;
    let places = match is_classified {
        true => by_class,
        false => by_hue,
    };
    Ok(places.fit().map(|terrain| Fitted::on_map(terrain, crs)))
}

/// The ground through the cells of a surface where the orthomosaic shows what is not green.
fn of_colours(
    surface: &Heights,
    ortho: &Source,
    monitor: &mut dyn Monitor,
) -> Result<Ground, Error> {
    let (Some(pixel_m), Some(own)) = (surface.place.pixel_m(), ortho.georeference()) else {
        return Ok(Ground::Unknown);
    };
    let frame = Fitted::frame_of(&surface.place, pixel_m);
    let [width, height] = surface.size;
    let side = |k: usize| surface.size[k] as f64 * pixel_m[k];
    let step = if pixel_m[0] < EVERY_OTHER_BELOW_M { 2 } else { 1 };
    let coarse_m = pixel_m[0].max(pixel_m[1]) * step as f64;
    let mut places = GroundPlaces::new([[0.0, side(0)], [-side(1), 0.0]], node_m(coarse_m));
    let transfer = Transfer::between(&surface.place.crs, &own.crs);
    let counter = Counter::new(monitor, "looking for bare ground", height.div_ceil(BAND), "bands");
    for band in window::bands(height, BAND, 0) {
        let values = surface.window(Window::rows(width, band.rows.clone()))?;
        let first = band.rows.start;
        let cells = band.rows.clone().filter(|v| v.is_multiple_of(step));
        let cells = cells.flat_map(|v| (0..width).step_by(step).map(move |u| [u, v]));
        let known = cells.filter(|[u, v]| values[(v - first) * width + u].is_finite());
        let at: Vec<([usize; 2], [f64; 2])> = known
            .filter_map(|[u, v]| {
                let there = transfer.at(surface.place.map([u as f64, v as f64]))?;
                Some(([u, v], own.pixel(there)?))
            })
            .collect();
        let colours = Colours::around(ortho, &own, &at, pixel_m)?;
        for ([u, v], at) in at {
            let z = f64::from(values[(v - first) * width + u]);
            if let Some(colour) = colours.at(at) {
                let place = [u as f64 * pixel_m[0], -(v as f64) * pixel_m[1]];
                places.add([place[0], place[1], z], is_bare(colour));
            }
        }
        let low = -(band.rows.end as f64 - 1.0) * pixel_m[1];
        places.close([[0.0, side(0)], [low, 0.0]]);
        counter.tick();
    }
    let fitted = places.fit().map(|terrain: Terrain| Fitted { terrain, frame });
    Ok(fitted.map_or(Ground::Unknown, Ground::Fitted))
}

/// Rows of an orthomosaic around some places.
struct Colours {
    picture: RgbImage,
    gaps: Option<Vec<bool>>,
    /// The first of the rows.
    first: f64,
    /// Pixels to either side of a place that are in its colour.
    reach: f64,
}

/// At most so many pixels to either side stand for a cell: 17 by 17 are enough for a mean colour.
const MAX_REACH: f64 = 8.0;

impl Colours {
    /// Around the places of cells that are so large on the ground.
    fn around(
        ortho: &Source,
        own: &Georeference,
        at: &[([usize; 2], [f64; 2])],
        pixel_m: [f64; 2],
    ) -> Result<Colours, Error> {
        let gsd_m = own.gsd_m().unwrap_or(pixel_m[0]);
        let reach = (0.5 * (pixel_m[0] / gsd_m - 1.0)).round().clamp(0.0, MAX_REACH);
        let rows = at.iter().map(|(_, at)| at[1]);
        let (low, high) =
            rows.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        let end = ortho.size().1 as f64;
        let [first, last] = [low - reach, high + reach + 1.0].map(|v| v.round().clamp(0.0, end));
        let rows = first as usize..(last as usize).max(first as usize);
        let (picture, gaps) = match rows.is_empty() {
            true => (RgbImage::new(0, 0), None),
            false => ortho.rgb_and_gaps(rows)?,
        };
        Ok(Colours { picture, gaps, first, reach })
    }

    /// The mean colour around a place; `None` where the orthomosaic shows nothing.
    fn at(&self, [u, v]: [f64; 2]) -> Option<[u8; 3]> {
        let (u, v) = (u.round(), v.round() - self.first);
        let range = |at: f64, end: u32| {
            let [low, high] = [at - self.reach, at + self.reach + 1.0];
            low.clamp(0.0, f64::from(end)) as u32..high.clamp(0.0, f64::from(end)) as u32
        };
        let (width, height) = self.picture.dimensions();
        let (mut sums, mut count) = ([0u32; 3], 0);
        for row in range(v, height) {
            for column in range(u, width) {
                let is_gap =
                    |gaps: &Vec<bool>| gaps[row as usize * width as usize + column as usize];
                if self.gaps.as_ref().is_some_and(is_gap) {
                    continue;
                }
                let colour = self.picture.get_pixel(column, row).0;
                sums.iter_mut().zip(colour).for_each(|(sum, value)| *sum += u32::from(value));
                count += 1;
            }
        }
        (count > 0).then(|| sums.map(|sum| (sum / count) as u8))
    }
}
