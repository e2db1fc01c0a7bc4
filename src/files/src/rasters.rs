//! Photos and masks of any size, with their place on the map where they have one.
//!
//! TIFF files are read by bands of rows, so that a photo larger than the memory can be looked at; other
//! pictures are read whole.

use super::{
    FileError,
    geotiff::{self, Colour, Layout, Reader, Reading, Spectra, Square},
    images::{self, Picture},
    memory, output,
};
use image::{Rgb, RgbImage};
use rowgram_base::error::Error;
use rowgram_raster::{
    Mask,
    georeference::Georeference,
    mask::Thresholds,
    spectral::Band,
    window::{self, Window},
};
use std::{
    io::Read,
    ops::Range,
    path::{Path, PathBuf},
};

/// Rows that are read at a time; tiles are read once where it is a multiple of theirs.
pub const BAND_ROWS: usize = 512;

/// A photo or a mask that can be looked at.
pub enum Source {
    /// A TIFF file.
    File(Box<Reader>),
    /// A picture in memory.
    Picture {
        /// Its pixels.
        picture: Picture,
        /// Which of them (row by row) are transparent; `None` where none is.
        gaps: Option<Vec<bool>>,
        /// Where it lies on the map, if a world file beside it says so.
        place: Option<Georeference>,
    },
}

impl Source {
    /// Opens a PNG, JPEG, TIFF or GeoTIFF.
    ///
    /// # Errors
    /// Where the file cannot be read or is no such picture.
    pub fn open(path: &Path) -> Result<Source, FileError> {
        Source::open_with(path, &Reading::default())
    }

    /// As [`Source::open`], with bands and reflectance as the settings say.
    ///
    /// # Errors
    /// As [`Source::open`], and where the file cannot have these bands.
    pub fn open_with(path: &Path, reading: &Reading) -> Result<Source, FileError> {
        let mut first = [0; 4];
        let mut file = std::fs::File::open(path).map_err(|e| FileError::read(path, e))?;
        let tiff = file.read_exact(&mut first).is_ok() && geotiff::is_tiff(&first);
        if tiff {
            return Ok(Source::File(Box::new(Reader::open_with(path, reading)?)));
        }
        if !reading.bands.is_empty() {
            let message = "[project] bands: it is no TIFF, so its bands are red, green, blue";
            return Err(FileError::malformed(path, None, message));
        }
        let (picture, gaps) = images::read_with_gaps(path)?;
        let source = Source::Picture { picture, gaps, place: None };
        Ok(match geotiff::beside(path)? {
            Some(place) => {
                source.placed(place).map_err(|why| FileError::malformed(path, None, why))?
            }
            None => source,
        })
    }

    /// A picture in memory at its place, with square pixels where those of the file are oblong on the ground.
    ///
    /// # Errors
    /// A place that makes lines of pixels.
    fn placed(self, place: Georeference) -> Result<Source, String> {
        let (width, height) = self.size();
        let (square, place) = Square::of([width, height], Some(place))?;
        Ok(match self {
            Source::Picture { picture, gaps, .. } if square.is_oblong() => {
                let [columns, rows] = square.shown();
                let stored = [width, height];
                let (column, row) = (square.source(stored, 0), square.source(stored, 1));
                let at = |u: usize, v: usize| (column(u), row(v));
                let picture = match picture {
                    Picture::Mask(mask) => Picture::Mask(Mask::from_fn(columns, rows, |u, v| {
                        let (u, v) = at(u, v);
                        mask.get(u, v)
                    })),
                    Picture::Photo(photo) => {
                        Picture::Photo(RgbImage::from_fn(columns as u32, rows as u32, |u, v| {
                            let (u, v) = at(u as usize, v as usize);
                            *photo.get_pixel(u as u32, v as u32)
                        }))
                    }
                };
                let all = || (0..columns * rows).map(|k| at(k % columns, k / columns));
                let gaps = gaps.map(|gaps| all().map(|(u, v)| gaps[v * width + u]).collect());
                Source::Picture { picture, gaps, place }
            }
            Source::Picture { picture, gaps, .. } => Source::Picture { picture, gaps, place },
            file => file,
        })
    }

    /// Columns and rows.
    pub fn size(&self) -> (usize, usize) {
        match self {
            Source::File(reader) => (reader.width(), reader.height()),
            Source::Picture { picture: Picture::Photo(photo), .. } => {
                (photo.width() as usize, photo.height() as usize)
            }
            Source::Picture { picture: Picture::Mask(mask), .. } => (mask.width, mask.height),
        }
    }

    /// Where it lies on the map, if it says so.
    pub fn georeference(&self) -> Option<Georeference> {
        match self {
            Source::File(reader) => reader.georeference(),
            Source::Picture { place, .. } => *place,
        }
    }

    /// Whether it says which pixels show nothing.
    pub fn states_gaps(&self) -> bool {
        match self {
            Source::File(reader) => reader.states_gaps(),
            Source::Picture { gaps, .. } => gaps.is_some(),
        }
    }

    /// Whether it has colours; what has none is a mask.
    pub fn is_photo(&self) -> bool {
        match self {
            Source::File(reader) => reader.is_colour(),
            Source::Picture { picture, .. } => matches!(picture, Picture::Photo(_)),
        }
    }

    /// The same; a TIFF in colours that has just two grey values is the mask that it is, as other pictures are.
    ///
    /// # Errors
    /// Where the file is damaged.
    pub fn or_mask(self) -> Result<Source, FileError> {
        let Source::File(reader) = &self else { return Ok(self) };
        if !self.is_photo() || !reader.holds::<u8>() || reader.bands() > 4 {
            return Ok(self);
        }
        let (width, height) = self.size();
        let mut values: Vec<u8> = Vec::new();
        let mut data = Vec::new();
        for band in window::bands(height, BAND_ROWS, 0) {
            let (photo, gaps) = self.rgb_and_gaps(band.rows)?;
            for (k, &Rgb([r, g, b])) in photo.pixels().enumerate() {
                let is_gap = gaps.as_ref().is_some_and(|gaps| gaps[k]);
                let value = if is_gap { 0 } else { r };
                if !is_gap && (r != g || g != b) || !values.contains(&value) && values.len() == 2 {
                    return Ok(self);
                }
                if !values.contains(&value) {
                    values.push(value);
                }
                data.push(value);
            }
        }
        // One value alone may be a photo of nothing.
        let &[first, second] = &values[..] else { return Ok(self) };
        let plant = first.max(second);
        data.iter_mut().for_each(|value| *value = u8::from(*value == plant));
        let picture = Picture::Mask(Mask { width, height, data });
        Ok(Source::Picture { picture, gaps: None, place: self.georeference() })
    }

    /// Rows of a photo, or of a mask in black and white.
    ///
    /// # Errors
    /// Where the file is damaged.
    pub fn rgb(&self, rows: Range<usize>) -> Result<RgbImage, FileError> {
        Ok(self.rgb_and_gaps(rows)?.0)
    }

    /// As [`Source::rgb`], and which pixels (row by row) show nothing: transparent ones and those without data; `None`
    /// where there are none.
    ///
    /// # Errors
    /// As [`Source::rgb`].
    pub fn rgb_and_gaps(
        &self,
        rows: Range<usize>,
    ) -> Result<(RgbImage, Option<Vec<bool>>), FileError> {
        match self {
            Source::File(reader) => reader.read_rgb_and_gaps(Window::rows(reader.width(), rows)),
            Source::Picture { picture, gaps, .. } => {
                let crop = |photo: &RgbImage| {
                    let (width, height) = (photo.width(), rows.len() as u32);
                    image::imageops::crop_imm(photo, 0, rows.start as u32, width, height).to_image()
                };
                let photo = match picture {
                    Picture::Photo(photo) => crop(photo),
                    Picture::Mask(Mask { width, data, .. }) => {
                        let data = data[rows.start * width..rows.end * width].to_vec();
                        Mask { width: *width, height: rows.len(), data }.to_rgb()
                    }
                };
                let width = photo.width() as usize;
                let gaps = gaps.as_ref().map(|gaps| &gaps[rows.start * width..rows.end * width]);
                Ok((photo, gaps.filter(|gaps| gaps.contains(&true)).map(<[bool]>::to_vec)))
            }
        }
    }

    /// What its bands show, where that is known and they hold anything; red, green, blue where it is no TIFF.
    ///
    /// # Errors
    /// Where the file is damaged.
    pub fn roles(&self) -> Result<Vec<Option<Band>>, FileError> {
        match self {
            Source::File(reader) => reader.filled_roles(),
            Source::Picture { .. } => Ok([Band::Red, Band::Green, Band::Blue].map(Some).to_vec()),
        }
    }

    /// The reflectances of rows of a photo: the bands of [`Source::roles`] of each pixel side by side; and which pixels show nothing,
    /// where some do.
    ///
    /// # Errors
    /// As [`Source::rgb_and_gaps`].
    pub fn spectra(&self, rows: Range<usize>) -> Result<Spectra, FileError> {
        match self {
            Source::File(reader) => reader.read_spectra(Window::rows(reader.width(), rows)),
            Source::Picture { .. } => {
                let (photo, gaps) = self.rgb_and_gaps(rows)?;
                Ok((photo.into_raw().into_iter().map(|x| f32::from(x) / 255.0).collect(), gaps))
            }
        }
    }

    /// The mask: that of a photo by the thresholds, or the picture itself, which then has two values,
    /// of which the larger is plant (one value alone is plant unless it is 0).
    ///
    /// # Errors
    /// Where the file is damaged, or has neither colours nor just two values.
    pub fn mask(&self, mut of_photo: impl FnMut(&RgbImage) -> Mask) -> Result<Mask, Error> {
        let reader = match self {
            Source::Picture { picture: Picture::Mask(mask), .. } => return Ok(mask.clone()),
            Source::Picture { picture: Picture::Photo(photo), .. } => return Ok(of_photo(photo)),
            Source::File(reader) => reader,
        };
        let (width, height) = self.size();
        if !self.is_photo() {
            return two_values(reader).map_err(Error::from);
        }
        memory::require(reader.path(), "its mask", (width as u64).saturating_mul(height as u64))?;
        let mut data = Vec::with_capacity(width * height);
        for band in window::bands(height, BAND_ROWS, 0) {
            data.extend_from_slice(&of_photo(&self.rgb(band.rows)?).data);
        }
        Ok(Mask { width, height, data })
    }
}

/// The mask in a file of single values.
fn two_values(reader: &Reader) -> Result<Mask, FileError> {
    let (width, height) = (reader.width(), reader.height());
    memory::require(reader.path(), "its mask", (width as u64).saturating_mul(height as u64))?;
    let mut values: Vec<f32> = Vec::new();
    let mut data = Vec::with_capacity(width * height);
    for band in window::bands(height, BAND_ROWS, 0) {
        for value in reader.read_f32(Window::rows(width, band.rows))? {
            // What has no data is no plant.
            let value = match (value.is_nan(), reader.white_is_zero()) {
                (false, false) => value,
                (false, true) => -value,
                (true, false) => 0.0,
                (true, true) => f32::MIN,
            };
            let place = values.iter().position(|&other| other == value).unwrap_or_else(|| {
                values.push(value);
                values.len() - 1
            });
            if place > 1 {
                let message = "it holds single values and more than two of them, expected a mask (two \
                               values) or a photo in colours";
                return Err(FileError::malformed(reader.path(), None, message));
            }
            data.push(place as u8);
        }
    }
    let plant = match values[..] {
        [first, second] => u8::from(second > first),
        [0.0] => 1,
        _ => 0,
    };
    data.iter_mut().for_each(|pixel| *pixel = u8::from(*pixel == plant));
    Ok(Mask { width, height, data })
}

/// A picture of one grey value a pixel that is written band by band: a GeoTIFF for a name in `.tif` or `.tiff`, which is not held
/// in memory, else a PNG, which is.
pub struct GreyWriter(Grey);

enum Grey {
    Tiff(Box<geotiff::Writer<u8>>),
    Picture { path: PathBuf, force: bool, size: (usize, usize), values: Vec<u8> },
}

impl GreyWriter {
    /// Begins a picture of so many columns and rows. It appears with [`GreyWriter::finish`], and never without.
    ///
    /// # Errors
    /// As [`super::output::check`], and where a picture of that size cannot be written.
    pub fn begin(
        path: &Path,
        force: bool,
        size: (usize, usize),
        colour: Colour,
        georeference: Option<Georeference>,
    ) -> Result<GreyWriter, FileError> {
        Ok(GreyWriter(if is_tiff_name(path) {
            let (width, height) = size;
            let layout = Layout { width, height, colour, georeference, nodata: None };
            Grey::Tiff(Box::new(geotiff::Writer::begin(path, force, &layout)?))
        } else {
            output::check(path, force)?;
            memory::require(
                path,
                "a picture that is no TIFF",
                (size.0 as u64).saturating_mul(size.1 as u64),
            )?;
            let values = Vec::with_capacity(size.0 * size.1);
            Grey::Picture { path: path.to_owned(), force, size, values }
        }))
    }

    /// Puts the next rows, from the top: [`BAND_ROWS`] of them, or the last ones.
    ///
    /// # Errors
    /// As [`geotiff::Writer::put`].
    pub fn put(&mut self, rows: Range<usize>, samples: &[u8]) -> Result<(), FileError> {
        match &mut self.0 {
            Grey::Tiff(writer) => {
                let window = Window::rows(writer.layout().width, rows);
                writer.put(window, samples)
            }
            Grey::Picture { values, .. } => {
                values.extend_from_slice(samples);
                Ok(())
            }
        }
    }

    /// Puts the file in its place.
    ///
    /// # Errors
    /// As [`super::output::write`], and where the picture has no pixel or other ones were put than it has.
    pub fn finish(self) -> Result<(), FileError> {
        match self.0 {
            Grey::Tiff(writer) => writer.finish(),
            Grey::Picture { path, force, size, values } => {
                images::write_grey(&path, force, size, &values)
            }
        }
    }
}

/// Reads a TIFF file of posterior probabilities in 1/255, of a mask of this size.
///
/// # Errors
/// Where the file cannot be read, or has another size or other samples.
pub fn read_posterior(path: &Path, (width, height): (usize, usize)) -> Result<Vec<u8>, FileError> {
    let reader = Reader::open(path)?;
    if (reader.width(), reader.height()) != (width, height) {
        let (columns, rows) = (reader.width(), reader.height());
        let message = format!("it has {columns} x {rows} pixels, its mask {width} x {height}");
        return Err(FileError::malformed(path, None, message));
    }
    reader.read::<u8>(Window::whole(width, height))
}

/// Whether a name ends like that of a TIFF file.
pub fn is_tiff_name(path: &Path) -> bool {
    path.extension().is_some_and(|end| ["tif", "tiff"].iter().any(|t| end.eq_ignore_ascii_case(t)))
}

/// The mask of a photo or mask, and its place on the map; see [`Source::mask`].
///
/// # Errors
/// As [`Source::open`] and [`Source::mask`].
pub fn read_mask(
    path: &Path,
    thresholds: &Thresholds,
) -> Result<(Mask, Option<Georeference>), Error> {
    let source = Source::open(path)?;
    let mask = source.mask(|photo| thresholds.mask(photo))?;
    Ok((mask, source.georeference()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_colour_tiff_of_two_grey_values_is_a_mask() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mask.tif");
        let open = |photo: &RgbImage| {
            images::write_as_named(&path, true, photo).unwrap();
            Source::open(&path).unwrap().or_mask().unwrap()
        };
        let mut photo = RgbImage::from_fn(9, 7, |u, _| Rgb([if u < 3 { 255 } else { 0 }; 3]));
        let Source::Picture { picture: Picture::Mask(mask), .. } = open(&photo) else {
            panic!("expected a mask");
        };
        assert_eq!((mask.count(), mask.get(2, 6), mask.get(3, 0)), (21, true, false));
        photo.put_pixel(8, 6, Rgb([90, 100, 80]));
        assert!(open(&photo).is_photo());
        assert!(open(&RgbImage::from_pixel(9, 7, Rgb([255; 3]))).is_photo());
    }
}
