//! Writing a raster tile by tile, as a cloud optimised GeoTIFF.

use super::{Sample, TILE};
use crate::{
    io::{FileError, output},
    raster::{
        georeference::{CrsKind, Georeference},
        window::Window,
    },
};
use geotiff_writer::{
    CogBuilder, CogTileWriter, Compression, ExtraSample, GeoKeyValue, GeoTiffBuilder, GeoTransform,
    ModelType, PhotometricInterpretation, Predictor, Resampling, TiffVariant,
};
use ndarray::ArrayView3;
use std::{
    fs::File,
    io::{BufWriter, Write as _},
    path::{Path, PathBuf},
};

/// `ProjectedCSTypeGeoKey`, `ProjLinearUnitsGeoKey`; user-defined, and the metre.
const PROJECTED_CRS: u16 = 3072;
const LINEAR_UNITS: u16 = 3076;
const USER_DEFINED: u16 = 32767;
const METRE: u16 = 9001;

/// What the samples of a pixel are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Colour {
    /// Classes or labels: any mean of two of them would be wrong.
    Classes,
    /// A measured quantity; overviews are means.
    Values,
    /// Red, green, blue.
    Rgb,
    /// Red, green, blue, and 0 where there are no data.
    Rgba,
}

/// What is to be written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Layout {
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// What a pixel holds.
    pub colour: Colour,
    /// Where it lies on the map.
    pub georeference: Option<Georeference>,
    /// The value that stands for no data. A finite one: overviews average over the others, and NaN is
    /// not equal to itself.
    pub nodata: Option<f64>,
}

impl Layout {
    /// Samples of a pixel.
    pub fn bands(&self) -> usize {
        match self.colour {
            Colour::Classes | Colour::Values => 1,
            Colour::Rgb => 3,
            Colour::Rgba => 4,
        }
    }
}

/// A raster that is being written.
pub struct Writer<'f, T: Sample> {
    path: PathBuf,
    layout: Layout,
    tiles: CogTileWriter<T, BufWriter<&'f mut File>>,
}

/// Writes a raster atomically: `fill` puts its tiles, in any order; tiles that it does not put hold nodata,
/// or 0 where there is none. The system's folder for temporary files must have room for all of it,
/// uncompressed.
///
/// # Errors
/// As [`output::write`]; where the layout cannot be written as a GeoTIFF; and whatever `fill` fails with.
pub fn write<T: Sample, E: From<FileError>>(
    path: &Path,
    force: bool,
    layout: &Layout,
    fill: impl FnOnce(&mut Writer<'_, T>) -> Result<(), E>,
) -> Result<(), E> {
    let failed = |error: geotiff_writer::Error| {
        FileError::write(path, std::io::Error::other(error.to_string()))
    };
    let builder = builder::<T>(path, layout)?;
    output::write_seekable(path, force, |file| {
        let tiles = builder.tile_writer(BufWriter::new(file)).map_err(failed)?;
        let mut writer = Writer { path: path.to_owned(), layout: *layout, tiles };
        fill(&mut writer)?;
        let mut file = writer.tiles.finish().map_err(failed)?;
        file.flush().map_err(|error| FileError::write(path, error))?;
        Ok(())
    })
}

impl<T: Sample> Writer<'_, T> {
    /// What is being written.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Puts a window: its samples row by row, those of a pixel side by side. It begins at multiples
    /// of [`TILE`] and ends at such or at the border; every tile is put once.
    ///
    /// # Errors
    /// Where the window or the number of samples is another, or the disk is full.
    pub fn put(&mut self, window: Window, samples: &[T]) -> Result<(), FileError> {
        let Layout { width, height, .. } = self.layout;
        let bands = self.layout.bands();
        let (right, below) = (window.u + window.width, window.v + window.height);
        let at_grid = |start: usize, end: usize, size: usize| {
            start.is_multiple_of(TILE) && end <= size && (end.is_multiple_of(TILE) || end == size)
        };
        if !at_grid(window.u, right, width)
            || !at_grid(window.v, below, height)
            || samples.len() != window.pixels() * bands
        {
            return Err(self.failed(format!(
                "{window:?} with {} samples does not fit the tiles of {width} x {height} pixels",
                samples.len()
            )));
        }
        let all = ArrayView3::from_shape((window.height, window.width, bands), samples)
            .map_err(|error| self.failed(error.to_string()))?;
        for v in (window.v..below).step_by(TILE) {
            for u in (window.u..right).step_by(TILE) {
                let rows = v - window.v..(v - window.v + TILE).min(window.height);
                let columns = u - window.u..(u - window.u + TILE).min(window.width);
                let tile = all.slice(ndarray::s![rows, columns, ..]);
                let put = self.tiles.write_tile_3d(u, v, &tile);
                put.map_err(|error| self.failed(error.to_string()))?;
            }
        }
        Ok(())
    }

    fn failed(&self, message: String) -> FileError {
        FileError::write(&self.path, std::io::Error::other(message))
    }
}

fn builder<T: Sample>(path: &Path, layout: &Layout) -> Result<CogBuilder, FileError> {
    let side = |pixels: usize| {
        u32::try_from(pixels).ok().filter(|&pixels| pixels > 0).ok_or_else(|| {
            let (width, height) = (layout.width, layout.height);
            let message = format!("a raster of {width} x {height} pixels cannot be a GeoTIFF");
            FileError::write(path, std::io::Error::new(std::io::ErrorKind::InvalidInput, message))
        })
    };
    let (width, height) = (side(layout.width)?, side(layout.height)?);
    let float = T::SAMPLE_FORMAT == 3;
    let (photometric, predictor) = match layout.colour {
        Colour::Classes => (PhotometricInterpretation::MinIsBlack, Predictor::None),
        Colour::Values if float => {
            (PhotometricInterpretation::MinIsBlack, Predictor::FloatingPoint)
        }
        Colour::Values => (PhotometricInterpretation::MinIsBlack, Predictor::Horizontal),
        Colour::Rgb | Colour::Rgba => (PhotometricInterpretation::Rgb, Predictor::Horizontal),
    };
    let mut builder = GeoTiffBuilder::new(width, height)
        .bands(layout.bands() as u32)
        .photometric(photometric)
        .predictor(predictor)
        .compression(Compression::Deflate)
        .predictor(predictor)
        .tile_size(TILE as u32, TILE as u32)
        .tiff_variant(TiffVariant::Auto);
    if layout.colour == Colour::Rgba {
        builder = builder.extra_samples(vec![ExtraSample::UnassociatedAlpha]);
    }
    if let Some(nodata) = layout.nodata {
        builder = builder.nodata(&nodata.to_string());
    }
    if let Some(place) = &layout.georeference {
        builder = placed(builder, place);
    }
    let largest = layout.width.max(layout.height);
    let levels = (1..31).map(|power| 1u32 << power);
    let levels = levels.take_while(|&level| largest > TILE * (level as usize) / 2).collect();
    let resampling = match layout.colour {
        Colour::Classes => Resampling::NearestNeighbor,
        Colour::Values | Colour::Rgb | Colour::Rgba => Resampling::Average,
    };
    Ok(CogBuilder::new(builder).overview_levels(levels).resampling(resampling))
}

fn placed(builder: GeoTiffBuilder, place: &Georeference) -> GeoTiffBuilder {
    let corner = place.map([-0.5, -0.5]);
    let builder = builder.transform(GeoTransform {
        origin_x: corner[0],
        pixel_width: place.per_column[0],
        skew_x: place.per_row[0],
        origin_y: corner[1],
        skew_y: place.per_column[1],
        pixel_height: place.per_row[1],
    });
    let code = place.crs.epsg.and_then(|epsg| u16::try_from(epsg).ok());
    match (place.crs.kind, code) {
        (CrsKind::Projected, Some(code)) => builder.projected_epsg(code),
        (CrsKind::Geographic, Some(code)) => builder.geographic_epsg(code),
        (CrsKind::Projected, None) => builder
            .model_type(ModelType::Projected)
            .geokey(PROJECTED_CRS, GeoKeyValue::Short(USER_DEFINED))
            .geokey(LINEAR_UNITS, GeoKeyValue::Short(METRE)),
        (CrsKind::Geographic, None) => builder.model_type(ModelType::Geographic),
        (CrsKind::Unknown, Some(code)) => builder.epsg(code),
        (CrsKind::Unknown, None) => builder,
    }
}
