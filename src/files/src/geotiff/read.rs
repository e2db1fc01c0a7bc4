//! Reading a raster by window.

use super::Sample;
use geotiff_reader::{Error as GeoError, GeoTiffFile, GeoTiffOpenOptions};
use image::RgbImage;
use ndarray::ArrayD;
use rowgram_optim::output::FileError;
use rowgram_raster::{
    crs,
    georeference::{Crs, CrsKind, Georeference},
    window::Window,
};
use std::path::{Path, PathBuf};
use tiff_reader::{Ifd, RasterLayout, TiffError, TiffFile, TiffSample};

/// Decoded tiles or strips that are kept for the next window, bytes.
const CACHE_BYTES: usize = 1 << 28;

/// `PhotometricInterpretation`: black is zero, RGB.
const BLACK_IS_ZERO: u16 = 1;
const RGB: u16 = 2;
/// `GDAL_NODATA`, the value of pixels without data as text.
const NODATA: u16 = 42_113;
/// `NewSubfileType`, and its bits for a mask and for a picture of lower resolution.
const SUBFILE: u16 = 254;
const MASK: u32 = 4;
const OVERVIEW: u32 = 1;
/// `ProjLinearUnitsGeoKey` and its code for the metre.
const LINEAR_UNITS: u16 = 3076;
pub(super) const METRE: u16 = 9001;
/// The same of the international foot and the foot of the US survey.
pub(super) const FOOT: u16 = 9002;
pub(super) const SURVEY_FOOT: u16 = 9003;
/// `VerticalGeoKey`, and the first code that is not of the registry.
const VERTICAL: u16 = 4096;
const USER_DEFINED: u16 = 32767;

/// An open raster.
///
/// Several threads may read from one at the same time.
pub struct Reader {
    path: PathBuf,
    file: File,
    directory: usize,
    layout: RasterLayout,
    photometric: u16,
    georeference: Option<Georeference>,
    nodata: Option<f64>,
    /// Directory of the internal mask: its pixels are 0 where the picture shows nothing.
    mask: Option<usize>,
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
        let (georeference, nodata) = match &file {
            File::Placed(file) => (georeference(file), file.nodata().map(str::to_owned)),
            File::Plain(file) => {
                let tag = file.ifd(directory).ok().and_then(|ifd| ifd.tag(NODATA));
                (None, tag.and_then(|tag| tag.value.as_str()).map(str::to_owned))
            }
        };
        let nodata = match nodata {
            None => None,
            Some(text) => Some(text.trim_matches(['\0', ' ']).trim().parse().map_err(|_| {
                malformed(format!("its nodata value is {text:?}, expected a number"))
            })?),
        };
        let mask = picture_mask(file.tiff(), [layout.width, layout.height], 0);
        let path = path.to_owned();
        let photometric = photometric.unwrap_or(BLACK_IS_ZERO);
        Ok(Reader { path, file, directory, layout, photometric, georeference, nodata, mask })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Number of columns.
    pub fn width(&self) -> usize {
        self.layout.width
    }

    /// Number of rows.
    pub fn height(&self) -> usize {
        self.layout.height
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
        self.bands() >= 3 || self.photometric > RGB
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
        let Window { u, v, width, height } = window;
        let read = self.file.tiff().read_window::<T>(self.directory, v, u, height, width);
        self.flat(read)
    }

    /// The values of the first band of a window as `f32`, whatever they are stored as; NaN where there
    /// are no data.
    ///
    /// # Errors
    /// As [`Reader::read`].
    pub fn read_f32(&self, window: Window) -> Result<Vec<f32>, FileError> {
        let first = |values: Vec<f32>| values.into_iter().step_by(self.bands()).collect::<Vec<_>>();
        macro_rules! from {
            ($($type:ty),+) => {$(
                if <$type>::matches_layout(&self.layout) {
                    let Window { u, v, width, height } = window;
                    let tiff = self.file.tiff();
                    let read = tiff.read_window::<$type>(self.directory, v, u, height, width);
                    let nodata = self.nodata.map(|value| value as $type);
                    let value = |x: $type| if Some(x) == nodata { f32::NAN } else { x as f32 };
                    return Ok(first(self.flat(read)?.into_iter().map(value).collect()));
                }
            )+};
        }
        from!(f32, f64, u8, i16, u16, i32, u32);
        Err(self.malformed(format!("its samples are {}, expected numbers", self.sample_name())))
    }

    /// A window as a picture in 8-bit colours. 16 bits are scaled (65535 becomes 255); grey has three
    /// equal channels; pixels without data, with alpha 0 or outside the file's internal mask are black.
    ///
    /// # Errors
    /// As [`Reader::read`], and where the samples are not of 8 or 16 bits.
    pub fn read_rgb(&self, window: Window) -> Result<RgbImage, FileError> {
        Ok(self.read_rgb_and_gaps(window)?.0)
    }

    /// Columns and rows of the pictures of lower resolution in the file, the largest first.
    pub fn overviews(&self) -> Vec<[usize; 2]> {
        self.overview_directories().into_iter().map(|(_, size)| size).collect()
    }

    /// As [`Reader::read_rgb`], from the picture of lower resolution that has number `overview` in
    /// [`Reader::overviews`].
    ///
    /// # Errors
    /// As [`Reader::read_rgb`], and where there is no such picture.
    pub fn read_overview_rgb(
        &self,
        overview: usize,
        window: Window,
    ) -> Result<RgbImage, FileError> {
        let of = self.overview_directories();
        let &(directory, size) = of
            .get(overview)
            .ok_or_else(|| self.malformed(format!("there is no overview number {overview}")))?;
        let mask = picture_mask(self.file.tiff(), size, OVERVIEW);
        Ok(self.rgb_and_gaps(directory, mask, window)?.0)
    }

    fn overview_directories(&self) -> Vec<(usize, [usize; 2])> {
        let base = [self.width(), self.height()];
        let mut found: Vec<_> = (self.file.tiff().ifds().iter().enumerate())
            .filter(|(_, ifd)| subfile(ifd) & (MASK | OVERVIEW) == OVERVIEW)
            .map(|(k, ifd)| (k, [ifd.width() as usize, ifd.height() as usize]))
            // A file may hold pictures of something else.
            .filter(|(_, size)| (0..2).all(|axis| size[axis] > 0 && size[axis] < base[axis]))
            .collect();
        found.sort_by_key(|&(_, size)| std::cmp::Reverse(size));
        found
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

    fn rgb_and_gaps(
        &self,
        directory: usize,
        mask: Option<usize>,
        window: Window,
    ) -> Result<(RgbImage, Option<Vec<bool>>), FileError> {
        let Window { width, height, .. } = window;
        let mut gaps = Vec::with_capacity(window.pixels());
        let stored = matches!(self.photometric, BLACK_IS_ZERO | RGB);
        let mut rgb = Vec::with_capacity(3 * window.pixels());
        if u8::matches_layout(&self.layout) {
            let samples = self.pixels::<u8>(directory, window, stored)?;
            self.add_rgb(&samples, window, 255, |x| x, (&mut rgb, &mut gaps));
        } else if u16::matches_layout(&self.layout) {
            let samples = self.pixels::<u16>(directory, window, stored)?;
            let byte = |x: u16| ((u32::from(x) * 255 + 32_767) / 65_535) as u8;
            self.add_rgb(&samples, window, 65_535, byte, (&mut rgb, &mut gaps));
        } else {
            return Err(self.malformed(format!(
                "its samples are {}, expected colours of 8 or 16 bits",
                self.sample_name()
            )));
        }
        if let Some(mask) = mask {
            let Window { u, v, width, height } = window;
            let read = self.file.tiff().read_decoded_window::<u8>(mask, v, u, height, width);
            let seen = self.flat(read)?;
            for ((gap, pixel), seen) in gaps.iter_mut().zip(rgb.chunks_exact_mut(3)).zip(seen) {
                if seen == 0 {
                    *gap = true;
                    pixel.fill(0);
                }
            }
        }
        let rgb = RgbImage::from_raw(width as u32, height as u32, rgb).ok_or_else(|| {
            self.malformed("damaged: it has fewer pixels than it says".to_owned())
        })?;
        Ok((rgb, gaps.contains(&true).then_some(gaps)))
    }

    fn pixels<T: Sample>(
        &self,
        at: usize,
        window: Window,
        stored: bool,
    ) -> Result<Vec<T>, FileError> {
        let Window { u, v, width, height } = window;
        let tiff = self.file.tiff();
        self.flat(if stored {
            tiff.read_window::<T>(at, v, u, height, width)
        } else {
            tiff.read_decoded_window::<T>(at, v, u, height, width)
        })
    }

    fn add_rgb<T: Sample + Into<f64> + PartialEq>(
        &self,
        samples: &[T],
        window: Window,
        largest: u32,
        byte: impl Fn(T) -> u8,
        (rgb, gaps): (&mut Vec<u8>, &mut Vec<bool>),
    ) {
        let bands = samples.len() / window.pixels().max(1);
        // Without a note to the contrary a second or fourth band is alpha.
        let alpha = matches!(bands, 2 | 4).then_some(bands - 1);
        let nodata = self.nodata.filter(|value| (0.0..=f64::from(largest)).contains(value));
        let colours = if bands >= 3 { 3 } else { 1 };
        for pixel in samples.chunks_exact(bands.max(1)) {
            let empty = alpha.is_some_and(|band| pixel[band].into() == 0.0)
                || nodata.is_some_and(|value| pixel[..colours].iter().all(|&x| x.into() == value));
            gaps.push(empty);
            match (empty, colours) {
                (true, _) => rgb.extend([0; 3]),
                (false, 3) => rgb.extend([byte(pixel[0]), byte(pixel[1]), byte(pixel[2])]),
                (false, _) => rgb.extend([byte(pixel[0]); 3]),
            }
        }
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

/// What a directory is: bits [`MASK`] and [`OVERVIEW`].
fn subfile(ifd: &Ifd) -> u32 {
    ifd.tag(SUBFILE).and_then(|tag| tag.value.as_u32()).unwrap_or(0)
}

/// The directory of the mask of a picture of this size, as GDAL writes it beside a picture; `overview` is [`OVERVIEW`] or 0,
/// as the picture is.
fn picture_mask(tiff: &TiffFile, size: [usize; 2], overview: u32) -> Option<usize> {
    tiff.ifds().iter().position(|ifd| {
        let own = [ifd.width() as usize, ifd.height() as usize];
        subfile(ifd) & (MASK | OVERVIEW) == MASK | overview && own == size
    })
}

/// By the unit that the file states, else by that of its code.
fn kind_of_unit(file: &GeoTiffFile) -> CrsKind {
    let by_code = || match file.epsg().map(crs::Crs::metres_per_unit) {
        None => CrsKind::Projected,
        Some(None) => CrsKind::Unknown,
        Some(Some(metres)) => {
            let all = [CrsKind::Projected, CrsKind::Feet, CrsKind::SurveyFeet];
            // The two feet differ by two millionths.
            let same = |kind: &CrsKind| {
                kind.metres_per_unit().is_some_and(|of| (of / metres - 1.0).abs() < 1e-7)
            };
            all.into_iter().find(same).unwrap_or(CrsKind::Unknown)
        }
    };
    match file.geokeys().get_short(LINEAR_UNITS) {
        Some(METRE) => CrsKind::Projected,
        Some(FOOT) => CrsKind::Feet,
        Some(SURVEY_FOOT) => CrsKind::SurveyFeet,
        Some(_) => CrsKind::Unknown,
        None => by_code(),
    }
}

fn georeference(file: &GeoTiffFile) -> Option<Georeference> {
    let transform = file.transform()?;
    let info = file.crs();
    let kind = match info.model_type {
        1 => kind_of_unit(file),
        2 => CrsKind::Geographic,
        _ => CrsKind::Unknown,
    };
    let code = file.geokeys().get_short(VERTICAL);
    let vertical_epsg = code.filter(|code| (1..USER_DEFINED).contains(code)).map(u32::from);
    let (x, y) = transform.pixel_to_geo(0.5, 0.5);
    Some(Georeference {
        origin: [x, y],
        per_column: [transform.pixel_width, transform.skew_y],
        per_row: [transform.skew_x, transform.pixel_height],
        crs: Crs { epsg: file.epsg(), kind, vertical_epsg },
    })
}
