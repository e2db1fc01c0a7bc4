//! Reading a raster by window.

mod colours;
mod masks;
mod spectra;

pub use spectra::Spectra;

use super::{
    Sample, TILE,
    bands::{self, Bands},
    place,
    square::Square,
};
use crate::memory;
use geotiff_reader::{Error as GeoError, GeoTiffFile, GeoTiffOpenOptions};
use image::RgbImage;
use ndarray::ArrayD;
use rowgram_optim::output::FileError;
use rowgram_raster::{georeference::Georeference, spectral::Band, window::Window};
use std::{
    path::{Path, PathBuf},
    sync::OnceLock,
};
use tiff_reader::{Ifd, RasterLayout, TiffError, TiffFile, TiffSample};

/// Decoded tiles or strips that are kept for the next window, bytes: two rows of tiles of a colour map 32,000 pixels wide.
const CACHE_BYTES: usize = 1 << 27;

/// `PhotometricInterpretation`: black is zero, RGB.
const BLACK_IS_ZERO: u16 = 1;
/// White is zero, as scanners and old programs write single values.
const WHITE_IS_ZERO: u16 = 0;
const RGB: u16 = 2;
/// `GDAL_NODATA`, the value of pixels without data as text.
const NODATA: u16 = 42_113;
/// An open raster.
///
/// Several threads may read from one at the same time. A raster whose pixels are oblong on the ground is read as one with
/// square pixels (nearest neighbour), so that lengths in pixels are lengths: sizes, windows and place are of that one.
pub struct Reader {
    path: PathBuf,
    file: File,
    directory: usize,
    layout: RasterLayout,
    photometric: u16,
    georeference: Option<Georeference>,
    square: Square,
    bands: Bands,
    nodata: Option<f64>,
    /// Metres of a unit of heights.
    vertical_m: f64,
    /// The sample value of full brightness, once it is known.
    full: OnceLock<f64>,
    /// The sample value of a reflectance of 1 by the settings, and as it was found.
    given_reflectance: Option<f64>,
    reflectance: OnceLock<f64>,
    /// Directory of the mask, whose pixels are 0 where the picture shows nothing. Those of a file beside count on after those of the file.
    mask: Option<usize>,
    mask_beside: Option<TiffFile>,
}

/// How a raster is read, as far as that is not left to the file.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Reading {
    /// What its bands show, in their order; none where the file says so.
    pub bands: Vec<Band>,
    /// The sample value that stands for a reflectance of 1.
    pub full_reflectance: Option<f64>,
}

enum File {
    Placed(Box<GeoTiffFile>),
    Plain(TiffFile),
}

impl Reader {
    /// Opens a TIFF file; it need not lie on a map.
    ///
    /// # Errors
    /// Where the file cannot be read or is no TIFF that can be used.
    pub fn open(path: &Path) -> Result<Reader, FileError> {
        Reader::open_with(path, &Reading::default())
    }

    /// As [`Reader::open`], with bands and reflectance as the settings say.
    ///
    /// # Errors
    /// As [`Reader::open`], and where the file cannot have these bands.
    pub fn open_with(path: &Path, reading: &Reading) -> Result<Reader, FileError> {
        // The crate's own error for a file that cannot be opened has no kind.
        drop(std::fs::File::open(path).map_err(|e| FileError::read(path, e))?);
        let options = || GeoTiffOpenOptions {
            block_cache_bytes: CACHE_BYTES,
            block_cache_slots: 1 << 16,
            ..GeoTiffOpenOptions::default()
        };
        let malformed = |message: String| FileError::malformed(path, None, message);
        let file = match GeoTiffFile::open_with_options(path, options()) {
            Ok(file) => File::Placed(Box::new(file)),
            Err(GeoError::NotGeoTiff) => File::Plain(
                TiffFile::open_with_options(path, options())
                    .map_err(|e| malformed(format!("damaged or unsupported TIFF: {e}")))?,
            ),
            Err(e) => return Err(malformed(format!("damaged or unsupported GeoTIFF: {e}"))),
        };
        let directory = match &file {
            File::Placed(file) => file.base_ifd_index(),
            File::Plain(_) => 0,
        };
        let (layout, photometric) = file
            .tiff()
            .ifd(directory)
            .and_then(|ifd| Ok((ifd.raster_layout()?, ifd.photometric_interpretation())))
            .map_err(|e| malformed(format!("damaged or unsupported TIFF: {e}")))?;
        if layout.width == 0 || layout.height == 0 {
            return Err(malformed("the picture has no pixel".to_owned()));
        }
        for ifd in file.tiff().ifds() {
            memory::require(path, "decoding a tile or strip of it", block_bytes(ifd))?;
        }
        let (georeference, mut nodata) = match &file {
            File::Placed(file) => (place::of_file(file, path)?, file.nodata().map(str::to_owned)),
            File::Plain(file) => {
                let ifd = file.ifd(directory).ok();
                let place = ifd.map(|ifd| place::of_plain(ifd, path)).transpose()?.flatten();
                let tag = ifd.and_then(|ifd| ifd.tag(NODATA));
                (place, tag.and_then(|tag| tag.value.as_str()).map(str::to_owned))
            }
        };
        let vertical_m = match &file {
            File::Placed(file) => place::vertical_unit_m(file),
            File::Plain(_) => None,
        };
        let size = [layout.width, layout.height];
        let own_mask = masks::picture_mask(file.tiff(), size, 0);
        let mask_path = place::mask_beside(path);
        let mask_beside = match own_mask.is_none() && mask_path.is_file() {
            true => Some(masks::open(&mask_path, size, options())?),
            false => None,
        };
        let mask = own_mask.or(mask_beside.as_ref().map(|_| file.tiff().ifds().len()));
        let photometric = photometric.unwrap_or(BLACK_IS_ZERO);
        let bands = match file.tiff().ifd(directory) {
            Ok(ifd)
                if matches!(photometric, BLACK_IS_ZERO | RGB)
                    || photometric == WHITE_IS_ZERO && layout.samples_per_pixel == 1 =>
            {
                let beside = place::metadata_beside(path);
                let beside = beside.iter().find_map(|path| std::fs::read_to_string(path).ok());
                let samples = layout.samples_per_pixel;
                nodata = beside.as_deref().and_then(bands::nodata_beside).or(nodata);
                Bands::of(ifd, samples, photometric == RGB, beside.as_deref(), &reading.bands)
                    .map_err(malformed)?
            }
            _ => Bands::decoded(),
        };
        let nodata = match nodata {
            None => None,
            Some(text) => Some(text.trim_matches(['\0', ' ']).trim().parse().map_err(|_| {
                malformed(format!("its nodata value is {text:?}, expected a number"))
            })?),
        };
        let unit_m = bands.unit_m;
        let (square, georeference) = Square::of([layout.width, layout.height], georeference)
            .map_err(|why| FileError::malformed(path, None, why))?;
        let path = path.to_owned();
        Ok(Reader {
            path,
            file,
            directory,
            layout,
            photometric,
            georeference,
            square,
            bands,
            nodata,
            vertical_m: vertical_m.or(unit_m).unwrap_or(1.0),
            full: OnceLock::new(),
            given_reflectance: reading.full_reflectance,
            reflectance: OnceLock::new(),
            mask,
            mask_beside,
        })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether the lesser of two values is the brighter one.
    pub fn white_is_zero(&self) -> bool {
        self.photometric == WHITE_IS_ZERO
    }

    /// Number of columns.
    pub fn width(&self) -> usize {
        self.square.shown()[0]
    }

    /// Number of rows.
    pub fn height(&self) -> usize {
        self.square.shown()[1]
    }

    /// Columns and rows as stored, where pixels are oblong on the ground and read as square ones.
    pub fn stored_size(&self) -> Option<[usize; 2]> {
        self.square.is_oblong().then_some([self.layout.width, self.layout.height])
    }

    /// Number of samples of a pixel, alpha among them.
    pub fn bands(&self) -> usize {
        self.layout.samples_per_pixel
    }

    /// Where it lies on the map, if it says so.
    pub fn georeference(&self) -> Option<Georeference> {
        self.georeference
    }

    /// The value that stands for no data, if there is one; it may be NaN.
    pub fn nodata(&self) -> Option<f64> {
        self.nodata
    }

    /// Whether its pixels are colours rather than single values.
    pub fn is_colour(&self) -> bool {
        self.bands.is_colour
    }

    /// Whether its samples are of kind `T`.
    pub fn holds<T: Sample>(&self) -> bool {
        T::matches_layout(&self.layout)
    }

    /// The samples of a window as stored: row by row, the samples of a pixel side by side.
    ///
    /// # Errors
    /// Where the window is not inside the raster, its samples are of another kind, or the file is damaged.
    pub fn read<T: Sample>(&self, window: Window) -> Result<Vec<T>, FileError> {
        if !self.holds::<T>() {
            return Err(self.malformed(format!(
                "its samples are {}, expected {}",
                self.sample_name(),
                T::NAME
            )));
        }
        self.window::<T>(self.directory, window, true)
    }

    /// Refuses a window that does not fit into memory as stored and as single precision.
    fn require(&self, window: Window) -> Result<(), FileError> {
        let pixel = self.layout.pixel_stride_bytes() as u64 + 4 * self.bands() as u64;
        let pixels = (window.width as u64).saturating_mul(window.height as u64);
        let what = format!("decoding {} x {} pixels", window.width, window.height);
        memory::require(&self.path, &what, pixels.saturating_mul(pixel))
    }

    /// The values of the first band of a window as `f32`, whatever they are stored as, by the scale and offset of the file, heights in
    /// metres; NaN where there are no data, -9999 among them.
    ///
    /// # Errors
    /// As [`Reader::read`].
    pub fn read_f32(&self, window: Window) -> Result<Vec<f32>, FileError> {
        // What most programs write for no data, some without saying so.
        const NO_DATA: f32 = -9999.0;
        let [scale, offset] = self.bands.scales.as_ref().map_or([1.0, 0.0], |scales| scales[0]);
        let [scale, offset] = [scale, offset].map(|of| of * self.vertical_m);
        let in_metres = |value: f32| match value {
            NO_DATA => f32::NAN,
            _ if [scale, offset] == [1.0, 0.0] => value,
            _ => (f64::from(value) * scale + offset) as f32,
        };
        let all = self.values(self.directory, window)?.into_iter().step_by(self.bands());
        let mut all: Vec<f32> = all.map(in_metres).collect();
        if let Some(mask) = self.mask {
            let seen = self.window::<u8>(mask, window, false)?;
            all.iter_mut().zip(seen).filter(|(_, seen)| *seen == 0).for_each(|of| *of.0 = f32::NAN);
        }
        Ok(all)
    }

    /// All samples of a window as `f32`; NaN where they are the value of no data.
    fn values(&self, directory: usize, window: Window) -> Result<Vec<f32>, FileError> {
        macro_rules! from {
            ($($type:ty),+) => {$(
                if <$type>::matches_layout(&self.layout) {
                    // A number that no sample can be, such as 256 for bytes, is no value of no data.
                    let fits = |value: &f64| (*value as $type as f64 - value).abs() <= 1e-6 * value.abs();
                    let nodata = self.nodata.filter(fits).map(|value| value as $type);
                    let value = |x: $type| if Some(x) == nodata { f32::NAN } else { x as f32 };
                    let read = self.window::<$type>(directory, window, true)?;
                    return Ok(read.into_iter().map(value).collect());
                }
            )+};
        }
        from!(f32, f64, u8, i16, u16, i32, u32);
        Err(self.malformed(format!("its samples are {}, expected numbers", self.sample_name())))
    }

    /// The samples of a window of a directory, as stored or decoded into colours.
    fn window<T: TiffSample>(
        &self,
        directory: usize,
        window: Window,
        stored: bool,
    ) -> Result<Vec<T>, FileError> {
        self.require(window)?;
        let own = self.file.tiff();
        let (tiff, directory) = match (&self.mask_beside, directory.checked_sub(own.ifds().len())) {
            (Some(beside), Some(directory)) => (beside, directory),
            _ => (own, directory),
        };
        let ifd = tiff.ifd(directory).map_err(|e| self.malformed(format!("damaged TIFF: {e}")))?;
        let size = [ifd.width() as usize, ifd.height() as usize];
        let read = |Window { u, v, width, height }: Window| {
            self.flat(if stored {
                tiff.read_window::<T>(directory, v, u, height, width)
            } else {
                tiff.read_decoded_window::<T>(directory, v, u, height, width)
            })
        };
        // The decoder holds a window twice, so that a large one is read band by band; but a tile or strip that the cache has no room for
        // would be decoded again for each band.
        let is_kept = block_bytes(ifd) <= CACHE_BYTES as u64;
        let read_by_bands = |window: Window| {
            if window.height <= 2 * TILE || !is_kept {
                return read(window);
            }
            let mut all = Vec::new();
            for v in (window.v..window.row_range().end).step_by(TILE) {
                let height = TILE.min(window.row_range().end - v);
                let band = read(Window { v, height, ..window })?;
                if all.is_empty() {
                    all.reserve_exact(band.len() / height * window.height);
                }
                all.extend(band);
            }
            Ok(all)
        };
        self.square.read(size, window, read_by_bands)
    }

    /// A window as a picture in 8-bit colours. 16 bits in full range are scaled (65535 becomes 255), reflectance and others to
    /// what the raster has; grey has three equal channels; pixels without data, with alpha 0 or outside the file's internal
    /// mask are black.
    ///
    /// # Errors
    /// As [`Reader::read`], and where it is not known which bands are colours.
    pub fn read_rgb(&self, window: Window) -> Result<RgbImage, FileError> {
        Ok(self.read_rgb_and_gaps(window)?.0)
    }

    /// As [`Reader::read_rgb`], and which pixels (row by row) have no data; `None` where all have.
    ///
    /// # Errors
    /// As [`Reader::read_rgb`].
    pub fn read_rgb_and_gaps(
        &self,
        window: Window,
    ) -> Result<(RgbImage, Option<Vec<bool>>), FileError> {
        self.rgb_and_gaps(self.directory, self.mask, window)
    }

    fn flat<T>(&self, read: Result<ArrayD<T>, TiffError>) -> Result<Vec<T>, FileError> {
        match read {
            Ok(array) => Ok(array.into_raw_vec_and_offset().0),
            Err(TiffError::Io(source, _)) => Err(FileError::read(&self.path, source)),
            Err(error) => Err(self.malformed(format!("damaged or unsupported TIFF: {error}"))),
        }
    }

    fn malformed(&self, message: String) -> FileError {
        FileError::malformed(&self.path, None, message)
    }

    fn sample_name(&self) -> String {
        let kind = match self.layout.sample_format {
            1 => "",
            2 => " signed",
            3 => " floating point",
            _ => " of an unknown kind",
        };
        format!("{}-bit{kind}", self.layout.bits_per_sample)
    }
}

impl File {
    fn tiff(&self) -> &TiffFile {
        match self {
            File::Placed(file) => file.tiff(),
            File::Plain(file) => file,
        }
    }
}

/// What a tile or strip takes when it is decoded, which is the least that any window takes.
fn block_bytes(ifd: &Ifd) -> u64 {
    let rows = |rows: u32| u64::from(rows).min(ifd.height().into());
    let [width, height] = match (ifd.tile_width(), ifd.tile_height()) {
        (Some(width), Some(height)) => [u64::from(width), u64::from(height)],
        _ => [u64::from(ifd.width()), rows(ifd.rows_per_strip())],
    };
    let pixel = ifd.raster_layout().map_or(1, |layout| layout.pixel_stride_bytes() as u64);
    width.saturating_mul(height).saturating_mul(pixel)
}
