//! Writing a raster tile by tile, as a cloud optimised GeoTIFF.
//!
//! Tiles are compressed as they come, several at a time, into a temporary file; overviews are made on the way, each
//! pixel from the 2 x 2 below it, and a tile of one leaves as soon as the tiles below are there. When the
//! raster is complete, directories, overviews (the smallest first) and tiles are put in the order of a cloud
//! optimised file. Memory holds the tiles that are put and those of overviews that wait for others.

use super::{
    Sample, TILE,
    directory::{Directory, Level, emit},
    overview::halve,
};
use rayon::prelude::*;
use rowgram_optim::output::{self, FileError};
use rowgram_raster::{georeference::Georeference, spectral::Band, window::Window};
use std::{
    collections::BTreeMap,
    fs::File,
    io::{BufWriter, Read, Seek, SeekFrom, Write as _},
    path::{Path, PathBuf},
};
use tiff_core::{ByteOrder, Compression, Predictor};
use tiff_writer::compress::{BlockEncodingOptions, compress_block};

/// Effort of the compression, 1 to 9. Photos leave little to find for more of it.
const EFFORT: u32 = 1;

/// What the samples of a pixel are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Colour {
    /// Classes or labels: any mean of two of them would be wrong.
    Classes,
    /// A measured quantity; overviews are means.
    Values,
    /// So many numbers of different meaning; overviews take one of several pixels.
    Records(usize),
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
            Colour::Records(bands) => bands,
            Colour::Rgb => 3,
            Colour::Rgba => 4,
        }
    }
}

/// A raster that is being written.
pub struct Writer<T: Sample> {
    path: PathBuf,
    force: bool,
    layout: Layout,
    spool: BufWriter<File>,
    spooled: u64,
    levels: Vec<Level>,
    pending: BTreeMap<(usize, usize), Pending<T>>,
    fill: T,
    names: Vec<Band>,
}

/// A tile of an overview that waits for tiles below it.
struct Pending<T> {
    samples: Vec<T>,
    missing: usize,
}

/// Writes a raster atomically: `fill` puts its tiles, in any order; tiles that it does not put hold nodata,
/// or 0 where there is none. Beside the file there must be room for it twice.
///
/// # Errors
/// As [`output::write`]; where the layout cannot be written as a GeoTIFF; and whatever `fill` fails with.
pub fn write<T: Sample, E: From<FileError>>(
    path: &Path,
    force: bool,
    layout: &Layout,
    fill: impl FnOnce(&mut Writer<T>) -> Result<(), E>,
) -> Result<(), E> {
    let mut writer = Writer::begin(path, force, layout)?;
    fill(&mut writer)?;
    Ok(writer.finish()?)
}

impl<T: Sample> Writer<T> {
    /// Begins a raster, for where several are written at a time. It appears with [`Writer::finish`], and never without.
    ///
    /// # Errors
    /// As [`write()`].
    pub fn begin(path: &Path, force: bool, layout: &Layout) -> Result<Writer<T>, FileError> {
        output::check(path, force)?;
        let fits = |pixels: usize| pixels > 0 && u32::try_from(pixels).is_ok();
        if !fits(layout.width) || !fits(layout.height) {
            let (width, height) = (layout.width, layout.height);
            let message = format!("a raster of {width} x {height} pixels cannot be a GeoTIFF");
            let invalid = std::io::Error::new(std::io::ErrorKind::InvalidInput, message);
            return Err(FileError::write(path, invalid));
        }
        Ok(Writer {
            path: path.to_owned(),
            force,
            layout: *layout,
            spool: BufWriter::with_capacity(1 << 20, output::scratch(path)?),
            spooled: 0,
            levels: Level::all(layout),
            pending: BTreeMap::new(),
            fill: T::from_f64(layout.nodata.unwrap_or(0.0)),
            names: Vec::new(),
        })
    }

    /// Names the bands in the file, in their order.
    pub fn name_bands(&mut self, bands: &[Band]) {
        self.names = bands.to_vec();
    }

    /// Puts the file in its place.
    ///
    /// # Errors
    /// As [`write()`].
    pub fn finish(mut self) -> Result<(), FileError> {
        let mut spool = self.complete()?;
        output::write_seekable(&self.path, self.force, |file| {
            let directory = Directory::new::<T>(&self.layout, &self.names);
            let failed = |error| FileError::write(&self.path, error);
            let mut out = BufWriter::with_capacity(1 << 20, file);
            emit(&mut out, &directory, &self.levels, &mut |offset, length, out| {
                spool.seek(SeekFrom::Start(offset))?;
                let copied = std::io::copy(&mut (&mut spool).take(length), out)?;
                (copied == length)
                    .then_some(())
                    .ok_or_else(|| std::io::ErrorKind::UnexpectedEof.into())
            })
            .and_then(|()| out.flush())
            .map_err(failed)
        })
    }

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
        let across = self.levels[0].across();
        let places: Vec<(usize, usize)> = (window.v..below)
            .step_by(TILE)
            .flat_map(|v| (window.u..right).step_by(TILE).map(move |u| (u, v)))
            .collect();
        let index = |&(u, v): &(usize, usize)| v / TILE * across + u / TILE;
        if places.iter().any(|place| self.levels[0].blocks[index(place)].is_some()) {
            return Err(self.failed(format!("{window:?} was written twice")));
        }
        let fill = self.fill;
        let tiles = places
            .par_iter()
            .map(|place| {
                let &(u, v) = place;
                let mut tile = vec![fill; TILE * TILE * bands];
                let length = TILE.min(right - u) * bands;
                for row in v..(v + TILE).min(below) {
                    let from = ((row - window.v) * window.width + u - window.u) * bands;
                    let to = (row - v) * TILE * bands;
                    tile[to..to + length].copy_from_slice(&samples[from..from + length]);
                }
                (index(place), tile)
            })
            .collect();
        self.add(0, tiles)
    }

    /// Compresses tiles of a level and hands them to the level above.
    fn add(&mut self, level: usize, tiles: Vec<(usize, Vec<T>)>) -> Result<(), FileError> {
        let layout = self.layout;
        let size = self.levels[level].size;
        let across = self.levels[level].across();
        let above = level + 1 < self.levels.len();
        type Done<T> = (Result<Vec<u8>, String>, Option<Vec<T>>);
        let done: Vec<Done<T>> = tiles
            .par_iter()
            .map(|(index, tile)| {
                let at = [index % across * TILE, index / across * TILE];
                let valid = [0, 1].map(|k| TILE.min(size[k] - at[k]));
                (compress(tile, &layout), above.then(|| halve(tile, valid, &layout, self.fill)))
            })
            .collect();
        let mut complete = Vec::new();
        for ((index, _), (bytes, half)) in tiles.iter().zip(done) {
            let bytes = bytes.map_err(|message| self.failed(message))?;
            self.spool(level, *index, &bytes)?;
            if let Some(half) = half {
                let (column, row) = (index % across, index / across);
                complete.extend(self.merge(level + 1, [column, row], &half));
            }
        }
        if complete.is_empty() { Ok(()) } else { self.add(level + 1, complete) }
    }

    /// Puts a halved tile into its quarter of the tile above; that tile where it is complete.
    fn merge(
        &mut self,
        level: usize,
        [column, row]: [usize; 2],
        half: &[T],
    ) -> Option<(usize, Vec<T>)> {
        let bands = self.layout.bands();
        let below = [self.levels[level - 1].across(), self.levels[level - 1].down()];
        let parent = [column / 2, row / 2];
        let index = parent[1] * self.levels[level].across() + parent[0];
        let children = (0..2).map(|k| (below[k] - 2 * parent[k]).min(2)).product();
        let fill = self.fill;
        let pending = self.pending.entry((level, index)).or_insert_with(|| Pending {
            samples: vec![fill; TILE * TILE * bands],
            missing: children,
        });
        let length = TILE / 2 * bands;
        let corner = (row % 2 * TILE + column % 2) * length;
        for (k, line) in half.chunks_exact(length).enumerate() {
            let to = corner + k * TILE * bands;
            pending.samples[to..to + length].copy_from_slice(line);
        }
        pending.missing -= 1;
        if pending.missing > 0 {
            return None;
        }
        self.pending.remove(&(level, index)).map(|pending| (index, pending.samples))
    }

    fn spool(&mut self, level: usize, index: usize, bytes: &[u8]) -> Result<(), FileError> {
        self.spool.write_all(bytes).map_err(|error| FileError::write(&self.path, error))?;
        self.levels[level].blocks[index] = Some((self.spooled, bytes.len() as u64));
        self.spooled += bytes.len() as u64;
        Ok(())
    }

    /// Fills what was not put, and gives the spooled tiles.
    fn complete(&mut self) -> Result<File, FileError> {
        let empty = vec![self.fill; TILE * TILE * self.layout.bands()];
        let bytes = compress(&empty, &self.layout).map_err(|message| self.failed(message))?;
        for level in 0..self.levels.len() {
            let waiting: Vec<usize> = self
                .pending
                .range((level, 0)..(level + 1, 0))
                .map(|((_, index), _)| *index)
                .collect();
            let tiles = waiting
                .into_iter()
                .filter_map(|index| Some((index, self.pending.remove(&(level, index))?.samples)))
                .collect();
            self.add(level, tiles)?;
            for index in 0..self.levels[level].blocks.len() {
                if self.levels[level].blocks[index].is_none() {
                    self.spool(level, index, &bytes)?;
                }
            }
        }
        let failed = |error| FileError::write(&self.path, error);
        self.spool.flush().map_err(failed)?;
        self.spool.get_ref().try_clone().map_err(failed)
    }

    fn failed(&self, message: String) -> FileError {
        FileError::write(&self.path, std::io::Error::other(message))
    }
}

fn compress<T: Sample>(tile: &[T], layout: &Layout) -> Result<Vec<u8>, String> {
    if let (Colour::Rgb | Colour::Rgba, Some(bytes)) = (layout.colour, T::as_bytes(tile)) {
        return Ok(compress_colours(bytes, layout.bands()));
    }
    let options = BlockEncodingOptions {
        byte_order: ByteOrder::LittleEndian,
        compression: Compression::Deflate,
        predictor: predictor::<T>(layout),
        samples_per_pixel: layout.bands() as u16,
        row_width_pixels: TILE,
        jpeg_options: None,
        jpeg_sampling: None,
        deflate_level: Some(EFFORT),
    };
    compress_block(tile, options, 0).map_err(|error| error.to_string())
}

/// As [`compress`], several times faster: what is left of colours after the predictor is noise around 0, for which
/// a fixed code is as good as one made for the tile.
fn compress_colours(tile: &[u8], bands: usize) -> Vec<u8> {
    let length = TILE * bands;
    let mut differences = vec![0u8; tile.len()];
    for row in 0..TILE {
        let range = row * length..(row + 1) * length;
        let (out, row) = (&mut differences[range.clone()], &tile[range]);
        out[..bands].copy_from_slice(&row[..bands]);
        let (out, here, before) = (&mut out[bands..], &row[bands..], &row[..length - bands]);
        for k in 0..length - bands {
            out[k] = here[k].wrapping_sub(before[k]);
        }
    }
    fdeflate::compress_to_vec(&differences)
}

/// What is stored instead of the samples, so that they compress.
pub(super) fn predictor<T: Sample>(layout: &Layout) -> Predictor {
    match layout.colour {
        Colour::Classes => Predictor::None,
        _ if T::IS_FLOAT => Predictor::FloatingPoint,
        _ => Predictor::Horizontal,
    }
}
