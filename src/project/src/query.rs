//! Single pixels of an orthophoto: from a place in the mapping frame to the pixel of the photo behind it, and back.

use super::{
    Project, Stage, dem,
    ortho::{self, OrthophotoRecord, provenance_path},
    photo_names::number_of,
};
use rowgram_base::{
    error::Error,
    monitor::{Counter, Monitor},
};
use rowgram_files::geotiff::{self, Colour, Layout, Reader};
use rowgram_optim::output::FileError;
use rowgram_raster::{georeference::Georeference, window::Window};
use rowgram_survey::mapping::{
    Surface, View, mosaic,
    provenance::{self, BANDS, FULL_BANDS, NO_PHOTO, NONE},
    select::{PhotoSelector, SelectionOptions},
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The pixel of a photo behind a place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PhotoPixel {
    /// Name of the photo.
    pub image: String,
    /// Its file.
    pub path: PathBuf,
    /// Column in the photo, pixels; the centre of the first one is 0.
    pub u_px: f64,
    /// Row in the photo, pixels.
    pub v_px: f64,
    /// East coordinate of the place, metres.
    pub x_m: f64,
    /// North coordinate, metres.
    pub y_m: f64,
    /// Height at which the map is drawn there, metres.
    pub z_m: f64,
    /// Column of the orthophoto that the place lies in.
    pub column: usize,
    /// Row of the orthophoto.
    pub row: usize,
    /// Column in the photo of the centre of that pixel, pixels.
    pub pixel_u_px: f32,
    /// Row in the photo of the centre of that pixel, pixels.
    pub pixel_v_px: f32,
    /// Angle between line of sight and vertical, degrees.
    pub view_angle_deg: f32,
    /// Distance to the seam, metres; `None` where no other photo shows the place.
    pub to_seam_m: Option<f32>,
}

/// The place of a photo's pixel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MapPosition {
    /// Name of the photo.
    pub image: String,
    /// East coordinate, metres.
    pub x_m: f64,
    /// North coordinate, metres.
    pub y_m: f64,
    /// Height, metres.
    pub z_m: f64,
    /// Column in the orthophoto, the centre of its first pixel being 0.
    pub column: f64,
    /// Row in the orthophoto.
    pub row: f64,
    /// Whether the pixel of the orthophoto is taken from this photo; `None` where that is not known.
    pub is_source: Option<bool>,
}

/// A photo in whose frame a place lies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sighting {
    /// Number of the photo, as in the record of the orthophoto.
    pub number: usize,
    /// Its name.
    pub image: String,
    /// Column in the photo, pixels; the centre of the first one is 0.
    pub u_px: f64,
    /// Row in the photo, pixels.
    pub v_px: f64,
    /// Columns and rows of the photo.
    pub size_px: [u32; 2],
    /// Angle between line of sight and vertical, degrees.
    pub view_angle_deg: f64,
    /// Whether the pixel of the orthophoto is taken from this photo; `None` where that is not known.
    pub is_source: Option<bool>,
}

/// An orthophoto with the photos and the surface behind it.
#[derive(Debug)]
pub struct OrthophotoOrigins {
    orthophoto: PathBuf,
    views: Vec<View>,
    photos: Vec<PathBuf>,
    surface: Surface,
    selection: SelectionOptions,
}

/// The origins of the orthomosaic of a project; `dem` is the file of the surface where it is not where it was.
///
/// # Errors
/// [`Error::NothingToDo`] where there is no orthomosaic of photos; as [`OrthophotoOrigins::open`].
pub fn query(project: &Project, dem: Option<&Path>) -> Result<OrthophotoOrigins, Error> {
    let mosaic = project.finished(Stage::Ortho, ortho::ORTHOMOSAIC).ok_or_else(|| {
        Error::NothingToDo(format!(
            "there is no orthomosaic in {}; make one with rowgram ortho",
            project.folder(Stage::Ortho).display()
        ))
    })?;
    OrthophotoOrigins::open(&mosaic, dem)
}

impl OrthophotoOrigins {
    /// Reads the record of an orthophoto and its surface; `dem` is the file of the surface where it is not where it was.
    ///
    /// # Errors
    /// An orthophoto without its record; a surface that is not there.
    pub fn open(orthophoto: &Path, dem: Option<&Path>) -> Result<OrthophotoOrigins, Error> {
        let record = OrthophotoRecord::read(orthophoto)?;
        let surface = dem.unwrap_or(&record.dem);
        let surface = dem::read_surface(surface)?;
        Ok(OrthophotoOrigins {
            orthophoto: orthophoto.to_owned(),
            views: record.views(orthophoto)?,
            photos: record.photos.into_iter().map(|photo| photo.path).collect(),
            surface: surface.raised(record.canopy_height_m),
            selection: record.selection,
        })
    }

    /// Where the orthophoto lies, and its columns and rows.
    ///
    /// # Errors
    /// An orthophoto that cannot be read or lies nowhere.
    pub(super) fn place(&self) -> Result<(Georeference, [usize; 2]), Error> {
        let reader = Reader::open(&self.orthophoto)?;
        let place = reader
            .georeference()
            .ok_or_else(|| self.fault("it is not georeferenced".to_owned()))?;
        Ok((place, [reader.width(), reader.height()]))
    }

    /// The photos with lenses and poses.
    pub(super) fn views(&self) -> &[View] {
        &self.views
    }

    /// The surface that the orthophoto is drawn on.
    pub(super) fn surface(&self) -> &Surface {
        &self.surface
    }

    pub(super) fn fault(&self, message: String) -> Error {
        Error::Argument(format!("{}: {message}", self.orthophoto.display()))
    }

    /// The provenance raster.
    fn raster(&self) -> Result<Reader, Error> {
        let reader = Reader::open(&provenance_path(&self.orthophoto))?;
        if reader.bands() != BANDS {
            let message = format!(
                "it has {} bands, expected the {BANDS} of a provenance raster; make the orthophoto again",
                reader.bands()
            );
            return Err(FileError::malformed(reader.path(), None, message).into());
        }
        Ok(reader)
    }

    /// All that is known of the cells of a window; [`FULL_BANDS`] numbers each.
    fn full(&self, reader: &Reader, window: Window) -> Result<Vec<f32>, Error> {
        let grid = reader
            .georeference()
            .ok_or_else(|| self.fault("its provenance is not georeferenced".into()))?;
        let stored = reader.read::<u16>(window)?;
        let photo =
            |cell: &[u16; BANDS]| cell[0] != NO_PHOTO && usize::from(cell[0]) >= self.views.len();
        if let Some(cell) = stored.as_chunks::<BANDS>().0.iter().find(|cell| photo(cell)) {
            return Err(self.fault(format!("there is no photo number {}", cell[0])));
        }
        let selector = PhotoSelector::new(&self.views, &self.surface, grid, self.selection);
        Ok(provenance::full(&selector, window, &stored))
    }

    /// Column, row and provenance of the pixel at a place; `None` where it has no colour.
    fn stored(&self, at: [f64; 2]) -> Result<Option<(usize, usize, Vec<f32>)>, Error> {
        let reader = self.raster()?;
        let outside = || self.fault(format!("it does not show ({}, {})", at[0], at[1]));
        let place = reader.georeference().and_then(|place| place.pixel(at)).ok_or_else(outside)?;
        let (u, v) = (place[0].round(), place[1].round());
        let inside =
            u >= 0.0 && v >= 0.0 && u < reader.width() as f64 && v < reader.height() as f64;
        if !inside {
            return Err(outside());
        }
        let (u, v) = (u as usize, v as usize);
        let record = self.full(&reader, Window { u, v, width: 1, height: 1 })?;
        Ok((record[0] != NONE).then_some((u, v, record)))
    }

    /// Writes the photo, column and row in it, view angle (degrees) and distance to the seam (metres) of every pixel as a GeoTIFF of
    /// 32-bit numbers; -1 where there is none.
    ///
    /// # Errors
    /// A provenance raster that cannot be read, an output that cannot be written or exists.
    pub fn write_full(
        &self,
        path: &Path,
        force: bool,
        monitor: &mut dyn Monitor,
    ) -> Result<(), Error> {
        let reader = self.raster()?;
        let size = [reader.width(), reader.height()];
        let tiles = mosaic::tiles(size);
        let counter = Counter::new(monitor, "computing pixels", tiles.len(), "tiles");
        let layout = Layout {
            width: size[0],
            height: size[1],
            colour: Colour::Records(FULL_BANDS),
            georeference: reader.georeference(),
            nodata: Some(f64::from(NONE)),
        };
        geotiff::write::<f32, Error>(path, force, &layout, |writer| {
            for window in tiles {
                writer.put(window, &self.full(&reader, window)?)?;
                counter.tick();
            }
            Ok(())
        })
    }

    /// The photo and its pixel behind a place, metres in the mapping frame.
    ///
    /// # Errors
    /// A place that the orthophoto does not show.
    pub fn photo_pixel(&self, at_m: [f64; 2]) -> Result<PhotoPixel, Error> {
        let [x_m, y_m] = at_m;
        let (column, row, record) = self
            .stored(at_m)?
            .ok_or_else(|| self.fault(format!("no photo shows ({x_m}, {y_m})")))?;
        let k = record[0] as usize;
        let view =
            self.views.get(k).ok_or_else(|| self.fault(format!("there is no photo number {k}")))?;
        let z_m = self
            .surface
            .at(at_m)
            .ok_or_else(|| self.fault(format!("the surface has no height at ({x_m}, {y_m})")))?;
        // At the border of a photo the pixel's centre may be in it and the place just outside.
        let pixel = view.pixel([x_m, y_m, z_m]);
        let [u_px, v_px] = pixel.unwrap_or([f64::from(record[1]), f64::from(record[2])]);
        Ok(PhotoPixel {
            image: view.name.clone(),
            path: self.photos[k].clone(),
            u_px,
            v_px,
            x_m,
            y_m,
            z_m,
            column,
            row,
            pixel_u_px: record[1],
            pixel_v_px: record[2],
            view_angle_deg: record[3],
            to_seam_m: (record[4] != NONE).then_some(record[4]),
        })
    }

    /// Every photo in whose frame a place lies, the steepest first. What stands between the camera and the place is not
    /// looked at.
    ///
    /// # Errors
    /// A place where the surface has no height.
    pub fn sightings(&self, at_m: [f64; 2]) -> Result<Vec<Sighting>, Error> {
        let [x_m, y_m] = at_m;
        let z_m = self.surface.at(at_m).filter(|z_m| z_m.is_finite());
        let z_m =
            z_m.ok_or_else(|| self.fault(format!("the surface has no height at ({x_m}, {y_m})")))?;
        let source = match provenance_path(&self.orthophoto).is_file() {
            // A place that the orthophoto does not show has no source.
            true => Some(self.stored(at_m).ok().flatten().map(|(_, _, record)| record[0] as usize)),
            false => None,
        };
        let of = |(number, view): (usize, &View)| {
            let [u_px, v_px] = view.pixel([x_m, y_m, z_m])?;
            let [x, y, z] = view.centre_m();
            let level = (x - x_m).hypot(y - y_m);
            Some(Sighting {
                number,
                image: view.name.clone(),
                u_px,
                v_px,
                size_px: view.interior.size_px(),
                view_angle_deg: level.atan2(z - z_m).to_degrees(),
                is_source: source.map(|source| source == Some(number)),
            })
        };
        let mut found: Vec<_> = self.views.iter().enumerate().filter_map(of).collect();
        found.sort_by(|a, b| a.view_angle_deg.total_cmp(&b.view_angle_deg));
        Ok(found)
    }

    /// The file of a photo by its number.
    pub fn photo(&self, number: usize) -> Option<&Path> {
        self.photos.get(number).map(PathBuf::as_path)
    }

    /// The place of a pixel of a photo, named with or without its ending.
    ///
    /// # Errors
    /// A name of no photo or of several, a pixel that does not show the surface.
    pub fn map_position(&self, image: &str, image_px: [f64; 2]) -> Result<MapPosition, Error> {
        let k = number_of(self.views.iter().map(|view| view.name.as_str()), image)
            .map_err(|why| self.fault(why))?;
        let [u, v] = image_px;
        let point = self.views[k].ground(image_px, &self.surface).ok_or_else(|| {
            self.fault(format!("pixel ({u}, {v}) of {image} does not show the surface"))
        })?;
        let at = [point[0], point[1]];
        let raster = Reader::open(&self.orthophoto)?;
        let pixel = raster.georeference().and_then(|place| place.pixel(at));
        let [column, row] = pixel.ok_or_else(|| self.fault("it is not georeferenced".into()))?;
        let is_source = match provenance_path(&self.orthophoto).is_file() {
            true => self
                .stored(at)
                .ok()
                .map(|stored| stored.is_some_and(|(_, _, record)| record[0] as usize == k)),
            false => None,
        };
        Ok(MapPosition {
            image: self.views[k].name.clone(),
            x_m: point[0],
            y_m: point[1],
            z_m: point[2],
            column,
            row,
            is_source,
        })
    }
}
