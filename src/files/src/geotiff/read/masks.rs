//! The other pictures of a TIFF: of lower resolution, and masks of what it shows, which may be in a file beside it.

use super::Reader;
use geotiff_reader::GeoTiffOpenOptions;
use image::RgbImage;
use rowgram_optim::output::FileError;
use rowgram_raster::window::Window;
use std::path::Path;
use tiff_reader::{Ifd, TiffFile};

/// `NewSubfileType`, and its bits for a mask and for a picture of lower resolution.
const SUBFILE: u16 = 254;
const MASK: u32 = 4;
const OVERVIEW: u32 = 1;

impl Reader {
    /// Columns and rows of the pictures of lower resolution in the file, the largest first.
    pub fn overviews(&self) -> Vec<[usize; 2]> {
        self.overview_directories().into_iter().map(|(_, size)| size).collect()
    }

    /// As [`Reader::read_rgb_and_gaps`], from the picture of lower resolution that has number `overview` in
    /// [`Reader::overviews`].
    ///
    /// # Errors
    /// As [`Reader::read_rgb`], and where there is no such picture.
    pub fn read_overview_rgb_and_gaps(
        &self,
        overview: usize,
        window: Window,
    ) -> Result<(RgbImage, Option<Vec<bool>>), FileError> {
        let of = self.overview_directories();
        let &(directory, size) = of
            .get(overview)
            .ok_or_else(|| self.malformed(format!("there is no overview number {overview}")))?;
        let stored = self.file.tiff().ifds().get(directory);
        let size = stored.map_or(size, |ifd| [ifd.width() as usize, ifd.height() as usize]);
        let mask = picture_mask(self.file.tiff(), size, OVERVIEW);
        self.rgb_and_gaps(directory, mask, window)
    }

    /// Whether the file says which pixels show nothing: by alpha, a value without data or a mask.
    pub fn states_gaps(&self) -> bool {
        self.bands.alpha.is_some() || self.nodata.is_some() || self.mask.is_some()
    }

    fn overview_directories(&self) -> Vec<(usize, [usize; 2])> {
        // Of a mask beside the file the parts of lower resolution are not looked for.
        if self.mask_beside.is_some() {
            return Vec::new();
        }
        let base = [self.width(), self.height()];
        let mut found: Vec<_> = (self.file.tiff().ifds().iter().enumerate())
            .filter(|(_, ifd)| subfile(ifd) & (MASK | OVERVIEW) == OVERVIEW)
            .map(|(k, ifd)| {
                (k, self.square.shown_of([ifd.width() as usize, ifd.height() as usize]))
            })
            // A file may hold pictures of something else.
            .filter(|(_, size)| (0..2).all(|axis| size[axis] > 0 && size[axis] < base[axis]))
            .collect();
        found.sort_by_key(|&(_, size)| std::cmp::Reverse(size));
        found
    }
}

/// What a directory is: bits [`MASK`] and [`OVERVIEW`].
fn subfile(ifd: &Ifd) -> u32 {
    ifd.tag(SUBFILE).and_then(|tag| tag.value.as_u32()).unwrap_or(0)
}

/// The directory of the mask of a picture of this size, as GDAL writes it beside a picture; `overview` is [`OVERVIEW`] or 0,
/// as the picture is.
pub(super) fn picture_mask(tiff: &TiffFile, size: [usize; 2], overview: u32) -> Option<usize> {
    tiff.ifds().iter().position(|ifd| {
        let own = [ifd.width() as usize, ifd.height() as usize];
        subfile(ifd) & (MASK | OVERVIEW) == MASK | overview && own == size
    })
}

/// Opens the mask of a picture of this size that is a file of its own.
pub(super) fn open(
    path: &Path,
    size: [usize; 2],
    options: GeoTiffOpenOptions,
) -> Result<TiffFile, FileError> {
    let file = TiffFile::open_with_options(path, options).map_err(|error| {
        FileError::malformed(path, None, format!("damaged or unsupported TIFF: {error}"))
    })?;
    let found = file.ifd(0).and_then(|ifd| ifd.raster_layout());
    let is_mask = found.as_ref().is_ok_and(|of| {
        [of.width, of.height] == size && of.samples_per_pixel == 1 && of.bits_per_sample <= 8
    });
    if !is_mask {
        let message = format!("expected the mask of a picture of {} x {} pixels", size[0], size[1]);
        return Err(FileError::malformed(path, None, message));
    }
    Ok(file)
}
