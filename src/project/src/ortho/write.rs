//! Orthophotos of photos with poses: surface, canopy height, grid, colours; and the files of each.

use super::{
    OrthoOptions, OrthoOutcome, Orthophoto,
    photos::{Chosen, chosen, read_photo},
    plots::{WholePlots, table_path},
    record::{self, OrthophotoRecord},
};
use crate::{
    dem::{beside, read_surface},
    map_figures,
    photo_names::distinct,
};
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
    options::{Auto, Options},
};
use rowgram_files::geotiff::{self, Colour, Layout};
use rowgram_optim::output::{self, FileError, name_of};
use rowgram_raster::georeference::{Crs, CrsKind, Georeference};
use rowgram_survey::{
    mapping::{
        MapError, Surface, View, canopy_height,
        colour_balance::BalancedPhotos,
        grid::{coverage, covering, median_gsd_m, rounded},
        mosaic::{self, Mosaic, Rendered},
        photo_cache::PhotoCache,
        provenance::{BANDS, NO_PHOTO},
        select::PhotoSelector,
    },
    scene::Reconstruction,
};
use std::{
    ops::Range,
    path::{Path, PathBuf},
};

// Tiles are written whole.
const _: () = assert!(mosaic::TILE.is_multiple_of(geotiff::TILE));
/// The most pixels of an orthophoto.
pub(super) const MAX_PIXELS: f64 = 1e11;

/// What orthophotos are made of.
#[derive(Debug, Clone, Copy)]
pub struct OrthoInput<'a> {
    /// Photos with lenses and poses, metres in the mapping frame.
    pub reconstruction: &'a Reconstruction,
    /// The file of each photo, in the order of the reconstruction.
    pub photos: &'a [PathBuf],
    /// The surface: a GeoTIFF of heights in the mapping frame. The grid is chosen by it.
    pub surface: &'a Path,
    /// The same with its gaps filled, where it had any: photos are drawn on it.
    pub filled: Option<&'a Path>,
}

/// Where orthophotos go.
#[derive(Debug, Clone, Copy)]
pub struct OrthoFiles<'a> {
    /// The orthomosaic; its record, its provenance and the folder of frames are beside it.
    pub mosaic: &'a Path,
    /// Folder of pictures.
    pub figures: Option<&'a Path>,
    /// Whether files that exist are replaced.
    pub force: bool,
}

/// The provenance raster of an orthophoto.
pub(crate) fn provenance_path(orthophoto: &Path) -> PathBuf {
    beside(orthophoto, "provenance")
}

/// Makes the orthomosaic and, where they are wanted, the orthophoto of every photo.
///
/// # Errors
/// What does not fit together, photos that cannot be read, outputs that cannot be written or exist.
pub fn write_orthophotos(
    input: &OrthoInput<'_>,
    options: &OrthoOptions,
    files: &OrthoFiles<'_>,
    monitor: &mut dyn Monitor,
) -> Result<OrthoOutcome, Error> {
    options.validate().map_err(|why| Error::Argument(format!("[ortho] {why}")))?;
    let Chosen { views, photos, cameras } = chosen(input, &options.only)?;
    if views.len() >= usize::from(NO_PHOTO) {
        return Err(Error::Argument(format!(
            "an orthomosaic of {} photos: at most {NO_PHOTO} are possible; choose some with only",
            views.len()
        )));
    }
    let extent = surface(input, input.surface, monitor)?;
    let drawn = input.filled.map(|filled| surface(input, filled, monitor)).transpose()?;
    let surface = drawn.unwrap_or_else(|| extent.clone());
    let frames =
        if options.frames { frame_files(files.mosaic, &photos, &views)? } else { Vec::new() };
    for orthophoto in std::iter::once(files.mosaic).chain(frames.iter().map(PathBuf::as_path)) {
        output::check(orthophoto, files.force)?;
        output::check(&record::path(orthophoto), files.force)?;
        if options.provenance {
            output::check(&provenance_path(orthophoto), files.force)?;
        }
    }
    if options.whole_plots.is_some() {
        output::check(&table_path(files.mosaic), files.force)?;
    }
    let dem = input.filled.unwrap_or(input.surface);
    let mut work = Work { options, files, dem, extent, canopy_height_m: 0.0, colour: None };
    let (canopy_height_m, canopy) = match options.canopy_height_m {
        Auto::Given(metres) => (metres, None),
        Auto::Auto => {
            let found = work.canopy_height(&views, &photos, &surface)?;
            let subject = name_of(files.mosaic);
            monitor.diagnostic(&match &found {
                Some(found) => Diagnostic::info(
                    "canopy-height-found",
                    subject,
                    format!(
                        "the canopy is {:.3} m above the surface: there photos agree best about excess green (correlation {:.2}; {:.2} at the surface); the map is drawn at this height",
                        found.height_m, found.correlation, found.surface_correlation
                    ),
                ),
                None => Diagnostic::warning(
                    "canopy-height-not-found",
                    subject,
                    "photos agree about excess green clearly better at no height above the surface; the map is drawn at the surface",
                )
                .with_remedy("give the height with [ortho] canopy_height_m where plants have one"),
            });
            (found.map_or(0.0, |found| found.height_m), found)
        }
    };
    let surface = surface.raised(canopy_height_m);
    work.extent = work.extent.raised(canopy_height_m);
    work.canopy_height_m = canopy_height_m;
    if options.balance {
        work.colour = work.balance(&views, (&photos, &cameras), &surface, monitor)?;
    }
    let all = 0..views.len();
    let (mosaic, whole_plots) =
        work.orthophoto((&views, all), &photos, &surface, (files.mosaic, files.figures), monitor)?;
    let mut single = Vec::new();
    for (k, frame) in frames.iter().enumerate() {
        if views[k].footprint_m(&surface).is_none() {
            let message = "it shows none of the surface and has no orthophoto";
            monitor.diagnostic(&Diagnostic::warning("photo-off-surface", &views[k].name, message));
            continue;
        }
        let which = (views.as_slice(), k..k + 1);
        let (mut made, _) = work.orthophoto(which, &photos, &surface, (frame, None), monitor)?;
        let folder = frame.parent().and_then(Path::file_name).unwrap_or_default();
        let files = [Some(&mut made.file), made.provenance.as_mut(), Some(&mut made.record)];
        for file in files.into_iter().flatten() {
            *file = Path::new(folder).join(&*file);
        }
        single.push(made);
    }
    let colour = work.colour.map(|colour| colour.balance);
    Ok(OrthoOutcome { mosaic, canopy_height_m, canopy, colour, whole_plots, frames: single })
}

/// The orthophoto of every photo, in a folder beside the mosaic, which is made.
fn frame_files(mosaic: &Path, photos: &[PathBuf], views: &[View]) -> Result<Vec<PathBuf>, Error> {
    let folder = output::folder_of(mosaic).join("frames");
    std::fs::create_dir_all(&folder).map_err(|e| FileError::write(&folder, e))?;
    let names = photos.iter().zip(views).map(|(photo, view)| {
        let stem = photo.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        [stem, view.name.replace(['/', '\\'], "_")]
    });
    let names = distinct(&names.collect::<Vec<_>>()).into_iter();
    Ok(names.map(|name| folder.join(format!("{name}_ortho.tif"))).collect())
}

/// A surface, in the coordinate reference system of the photos.
fn surface(
    input: &OrthoInput<'_>,
    path: &Path,
    monitor: &mut dyn Monitor,
) -> Result<Surface, Error> {
    let fault = |message: String| Error::from(FileError::malformed(path, None, message));
    let mut surface = read_surface(path)?;
    let (known, of_photos) = (surface.georeference.crs, Crs::from(&input.reconstruction.reference));
    match (known.epsg, of_photos.epsg) {
        (Some(a), Some(b)) if a != b => {
            return Err(fault(format!(
                "it is in EPSG:{a}, the photos in EPSG:{b}; reproject it (gdalwarp -t_srs EPSG:{b})"
            )));
        }
        (None, Some(_)) => {
            surface.georeference.crs = Crs { vertical_epsg: known.vertical_epsg, ..of_photos };
        }
        _ => {}
    }
    match (known.vertical_epsg, of_photos.vertical_epsg) {
        (Some(a), Some(b)) if a != b => {
            return Err(fault(format!(
                "its heights are in EPSG:{a}, those of the photos in EPSG:{b}"
            )));
        }
        (None, vertical) => surface.georeference.crs.vertical_epsg = vertical,
        _ => {}
    }
    if surface.georeference.crs.kind == CrsKind::Unknown {
        let message = "it does not name its coordinate reference system; its coordinates are taken as metres in the frame of the photos";
        monitor.diagnostic(&Diagnostic::warning("dem-no-crs", name_of(path), message));
    }
    Ok(surface)
}

/// What all orthophotos have in common.
pub(super) struct Work<'a> {
    pub(super) options: &'a OrthoOptions,
    pub(super) files: &'a OrthoFiles<'a>,
    dem: &'a Path,
    /// What the grid is chosen by.
    extent: Surface,
    canopy_height_m: f64,
    colour: Option<BalancedPhotos>,
}

impl Work<'_> {
    fn canopy_height(
        &self,
        views: &[View],
        photos: &[PathBuf],
        surface: &Surface,
    ) -> Result<Option<canopy_height::CanopyHeight>, Error> {
        let gsd_m = median_gsd_m(views, surface).ok_or_else(|| nothing(views, surface))?;
        let read = |k: usize| read_photo(&photos[k], views[k].interior.size_px());
        // Both photos of a pair are needed at a time.
        let mut cache =
            PhotoCache::new(views, &read, self.options.memory_mb << 20).with_room_for_two();
        canopy_height::estimate(views, surface, self.options.selection(), gsd_m, &mut cache)
    }

    /// The grid of an orthophoto: the borders of its pixels lie on multiples of their side.
    fn grid(
        &self,
        views: &[View],
        subject: &str,
        monitor: &mut dyn Monitor,
    ) -> Result<(Georeference, [usize; 2]), Error> {
        let surface = &self.extent;
        let crs = surface.georeference.crs;
        let gsd_m = match self.options.gsd_m {
            Some(gsd_m) => gsd_m,
            // Three digits are enough to name it.
            None => median_gsd_m(views, surface)
                .map(|gsd_m| rounded(gsd_m, 3))
                .ok_or_else(|| nothing(views, surface))?,
        };
        let bounds_m = match self.options.bounds_m {
            Some([left, bottom, right, top]) => {
                if !(left < right && bottom < top) {
                    return Err(Error::Argument(format!(
                        "bounds_m = {left},{bottom},{right},{top}: expected least x, least y, greatest x, greatest y"
                    )));
                }
                [[left, right], [bottom, top]]
            }
            None => {
                let found = coverage(views, surface);
                let bounds = found.bounds_m.ok_or_else(|| nothing(views, surface))?;
                let mut warn = |code, message| {
                    monitor.diagnostic(&Diagnostic::warning(code, subject, message));
                };
                if !found.outside.is_empty() {
                    let first = &views[found.outside[0]].name;
                    let n = found.outside.len();
                    warn(
                        "photo-off-surface",
                        format!("{n} photos ({first} ...) show none of the surface"),
                    );
                }
                if !found.partly_outside.is_empty() {
                    warn(
                        "photo-beyond-surface",
                        format!(
                            "edges of {} of {} photos extend beyond the surface and stay transparent",
                            found.partly_outside.len(),
                            views.len()
                        ),
                    );
                }
                bounds
            }
        };
        Ok(covering(bounds_m, gsd_m, crs, MAX_PIXELS)?)
    }

    /// Makes an orthophoto and everything beside it.
    fn orthophoto(
        &self,
        (all, which): (&[View], Range<usize>),
        files: &[PathBuf],
        surface: &Surface,
        (output, figures): (&Path, Option<&Path>),
        monitor: &mut dyn Monitor,
    ) -> Result<(Orthophoto, Option<WholePlots>), Error> {
        let options = self.options;
        let (views, photos) = (&all[which.clone()], &files[which.clone()]);
        let (grid, size) = self.grid(views, &name_of(output), monitor)?;
        let selector = PhotoSelector::new(views, surface, grid, options.selection());
        let read = |k: usize| read_photo(&photos[k], views[k].interior.size_px());
        let mut cache = PhotoCache::new(views, &read, options.memory_mb << 20);
        let colour = self.colour.as_ref();
        let corrections = colour.map(|colour| &colour.corrections[which.clone()]);
        let (assignment, whole_plots) = match output == self.files.mosaic {
            true => self.assignment(&selector, (grid, size), monitor)?,
            false => Default::default(),
        };
        let mosaic = Mosaic {
            selector: &selector,
            grid,
            size,
            interpolation: options.interpolation,
            corrections,
            assignment: (!assignment.is_empty()).then_some(&assignment),
            with_provenance: options.provenance,
        };
        let provenance = options.provenance.then(|| provenance_path(output));
        let paths = (output, provenance.as_deref());
        let rendered = render(&mosaic, &mut cache, paths, self.files.force, monitor)?;
        if rendered.coloured == 0 {
            let message = "no pixel has a colour";
            monitor.diagnostic(&Diagnostic::warning("ortho-empty", name_of(output), message));
        }
        let (cameras, photo_records) = record::photos_of(output, &which, all, files, colour);
        let record = OrthophotoRecord {
            version: OrthophotoRecord::VERSION,
            epsg: grid.crs.epsg,
            width_px: size[0],
            height_px: size[1],
            gsd_m: grid.per_column[0],
            dem: self.dem.to_owned(),
            canopy_height_m: self.canopy_height_m,
            selection: options.selection(),
            cameras,
            photos: photo_records,
        };
        record.write(output, self.files.force)?;
        if let Some(folder) = figures {
            std::fs::create_dir_all(folder).map_err(|e| FileError::write(folder, e))?;
            map_figures::draw_mosaic(folder, &selector, &rendered, grid, self.files.force)?;
        }
        let made = Orthophoto {
            file: name_of(output).into(),
            provenance: provenance.map(|path| name_of(&path).into()),
            record: name_of(&record::path(output)).into(),
            width_px: size[0],
            height_px: size[1],
            gsd_m: grid.per_column[0],
            epsg: grid.crs.epsg,
            vertical_epsg: grid.crs.vertical_epsg,
            photos: rendered.cells_of.iter().filter(|&&cells| cells > 0).count(),
            coloured_pixels: rendered.coloured,
        };
        Ok((made, whole_plots))
    }
}

/// Renders a mosaic into a file, and where its pixels come from into another.
fn render(
    mosaic: &Mosaic<'_>,
    photos: &mut PhotoCache<'_, Error>,
    (output, provenance): (&Path, Option<&Path>),
    force: bool,
    monitor: &mut dyn Monitor,
) -> Result<Rendered, Error> {
    let [width, height] = mosaic.size;
    let tiles = mosaic::tiles(mosaic.size).len();
    let counter = Counter::new(monitor, "orthorectifying", tiles, "tiles");
    let layout = Layout {
        width,
        height,
        colour: Colour::Rgba,
        georeference: Some(mosaic.grid),
        nodata: None,
    };
    let mut rendered = None;
    let Some(path) = provenance else {
        geotiff::write::<u8, Error>(output, force, &layout, |colours| {
            rendered = Some(mosaic::render(mosaic, photos, |tile| {
                counter.tick();
                Ok(colours.put(tile.window, &tile.rgba)?)
            })?);
            Ok(())
        })?;
        return rendered.ok_or_else(|| nothing_rendered(output));
    };
    let records =
        Layout { colour: Colour::Records(BANDS), nodata: Some(f64::from(NO_PHOTO)), ..layout };
    // The colours are done first: they need most room, and where there is too little neither file is left.
    geotiff::write::<u16, Error>(path, force, &records, |records| {
        geotiff::write::<u8, Error>(output, force, &layout, |colours| {
            rendered = Some(mosaic::render(mosaic, photos, |tile| {
                counter.tick();
                colours.put(tile.window, &tile.rgba)?;
                Ok(records.put(tile.window, &tile.provenance)?)
            })?);
            Ok(())
        })
    })?;
    rendered.ok_or_else(|| nothing_rendered(output))
}

fn nothing_rendered(output: &Path) -> Error {
    Error::Incomplete(format!("{}: nothing was rendered", output.display()))
}

pub(super) fn nothing(views: &[View], surface: &Surface) -> MapError {
    let [[left, right], [bottom, top]] = surface.bounds_m();
    let centre = views[0].centre_m();
    MapError(format!(
        "no photo shows any of the surface, which lies within x {left:.1} to {right:.1}, y {bottom:.1} to {top:.1} m; \
         photo {} was taken at x {:.1}, y {:.1}, z {:.1} m. Expected both in one coordinate reference system, heights too",
        views[0].name, centre[0], centre[1], centre[2]
    ))
}
