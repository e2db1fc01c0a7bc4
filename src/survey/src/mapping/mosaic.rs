//! A mosaic, tile by tile.
//!
//! For every cell of a tile its photo is chosen, photos are read as they are needed, and colours leave while the next tile
//! is computed. Where a photo has no data, the next best one takes its place. Nothing depends on how many photos are in
//! memory, or on the number of threads.

use super::{
    assignment::Assignment,
    colour_correction::ColourCorrection,
    paint::paint,
    photo_cache::PhotoCache,
    provenance,
    select::{CellSources, PhotoSelector},
};
use crate::mapping::undistort::Interpolation;
use rowgram_raster::{georeference::Georeference, window::Window};
use std::sync::mpsc;

/// Side of the tiles, cells: a multiple of the tiles of a GeoTIFF. What a tile needs stays in the processor's cache.
pub const TILE: usize = 512;
/// Side of a square of tiles that are computed one after the other, so that their photos are still in memory.
const SQUARE: usize = 2;
/// Longer side of the preview, pixels.
const PREVIEW: usize = 1600;

/// What is to be rendered.
#[derive(Clone, Copy)]
pub struct Mosaic<'a> {
    /// Chooses photos for cells.
    pub selector: &'a PhotoSelector<'a>,
    /// Where the cells are.
    pub grid: Georeference,
    /// Columns and rows.
    pub size: [usize; 2],
    /// How photos are read between their pixels.
    pub interpolation: Interpolation,
    /// What corrects the colours of each photo.
    pub corrections: Option<&'a [ColourCorrection]>,
    /// Photos that are assigned to cells, before the selector is asked.
    pub assignment: Option<&'a Assignment>,
    /// Whether tiles say where their colours come from.
    pub with_provenance: bool,
}

/// A finished part of a mosaic.
#[derive(Debug, Clone)]
pub struct Tile {
    /// Its cells.
    pub window: Window,
    /// Red, green, blue, alpha, row by row.
    pub rgba: Vec<u8>,
    /// [`provenance::BANDS`] samples of each cell, row by row; empty where nobody asked.
    pub provenance: Vec<u16>,
}

/// What came of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Rendered {
    /// Cells with a colour.
    pub coloured: usize,
    /// Cells of each photo.
    pub cells_of: Vec<usize>,
    /// The mosaic, small.
    pub preview: Preview,
}

/// Every so many cells of a mosaic one.
#[derive(Debug, Clone, PartialEq)]
pub struct Preview {
    /// Cells from one to the next.
    pub step: usize,
    /// Columns and rows.
    pub size: [usize; 2],
    /// Red, green, blue, alpha, row by row.
    pub rgba: Vec<[u8; 4]>,
    /// Number of the photo plus 1; 0 where there is none.
    pub source: Vec<u32>,
}

impl Preview {
    fn new([width, height]: [usize; 2]) -> Preview {
        let step = width.max(height).div_ceil(PREVIEW).max(1);
        let size = [width.div_ceil(step), height.div_ceil(step)];
        let cells = size[0] * size[1];
        Preview { step, size, rgba: vec![[0; 4]; cells], source: vec![0; cells] }
    }

    fn take(&mut self, window: Window, rgba: &[[u8; 4]], source: &[u32]) {
        let step = self.step;
        let first = [window.u, window.v].map(|n| n.next_multiple_of(step));
        for v in (first[1]..window.v + window.height).step_by(step) {
            for u in (first[0]..window.u + window.width).step_by(step) {
                let from = (v - window.v) * window.width + u - window.u;
                let to = v / step * self.size[0] + u / step;
                self.rgba[to] = rgba[from];
                self.source[to] = source[from];
            }
        }
    }
}

/// Renders a mosaic and hands its tiles to `take`, in the order of [`tiles`]; the next one is computed meanwhile.
///
/// # Errors
/// Photos that cannot be read, and what `take` says.
pub fn render<E: Send>(
    mosaic: &Mosaic<'_>,
    photos: &mut PhotoCache<'_, E>,
    mut take: impl FnMut(Tile) -> Result<(), E>,
) -> Result<Rendered, E> {
    let mut rendered = Rendered {
        coloured: 0,
        cells_of: vec![0; photos.count()],
        preview: Preview::new(mosaic.size),
    };
    let into = &mut rendered;
    std::thread::scope(|scope| {
        let (send, receive) = mpsc::sync_channel::<Tile>(1);
        let worker = scope.spawn(move || -> Result<(), E> {
            let mut sources = CellSources::default();
            for window in tiles(mosaic.size) {
                let tile = tile(mosaic, photos, into, (window, &mut sources))?;
                if send.send(tile).is_err() {
                    break;
                }
            }
            Ok(())
        });
        let mut taken = Ok(());
        for tile in &receive {
            taken = take(tile);
            if taken.is_err() {
                break;
            }
        }
        drop(receive);
        let worked = match worker.join() {
            Ok(worked) => worked,
            Err(panic) => std::panic::resume_unwind(panic),
        };
        taken.and(worked)
    })?;
    Ok(rendered)
}

/// The tiles of a mosaic of `[width, height]` cells: squares of them, forth in one row of squares and back in the next.
pub fn tiles([width, height]: [usize; 2]) -> Vec<Window> {
    const FAR: usize = SQUARE * TILE;
    let columns = width.div_ceil(FAR);
    let mut windows = Vec::new();
    for n in 0..columns * height.div_ceil(FAR) {
        let (row, place) = (n / columns, n % columns);
        let column = if row.is_multiple_of(2) { place } else { columns - 1 - place };
        let (left, top) = (column * FAR, row * FAR);
        for v in (top..height.min(top + FAR)).step_by(TILE) {
            for u in (left..width.min(left + FAR)).step_by(TILE) {
                let (width, height) = (TILE.min(width - u), TILE.min(height - v));
                windows.push(Window { u, v, width, height });
            }
        }
    }
    windows
}

fn tile<E: Send>(
    mosaic: &Mosaic<'_>,
    photos: &mut PhotoCache<'_, E>,
    rendered: &mut Rendered,
    (window, sources): (Window, &mut CellSources),
) -> Result<Tile, E> {
    let selector = mosaic.selector;
    let count = photos.count();
    selector.sources_into(window, sources);
    if let Some(assignment) = mosaic.assignment {
        selector.assign(assignment, sources);
    }
    let mut cells = cells_of(sources, count);
    let mut rgba = vec![[0u8; 4]; window.pixels()];
    photos.each_group(&used(&cells), |photos| {
        paint(sources, photos, mosaic.corrections, mosaic.interpolation, &mut rgba);
    })?;
    if has_gaps(sources, &rgba) {
        fill_gaps(mosaic, photos, sources, &mut rgba)?;
        cells = cells_of(sources, count);
    }
    let sources = &*sources;
    rendered.coloured += cells.iter().sum::<usize>();
    rendered.cells_of.iter_mut().zip(&cells).for_each(|(all, own)| *all += own);
    rendered.preview.take(window, &rgba, &sources.source);
    let provenance = if mosaic.with_provenance { provenance::compact(sources) } else { Vec::new() };
    Ok(Tile { window, rgba: rgba.into_flattened(), provenance })
}

/// Cells of each photo.
fn cells_of(sources: &CellSources, count: usize) -> Vec<usize> {
    // The first one counts the cells without a photo; neighbours mostly have the same one.
    let mut cells = vec![0; count + 1];
    let source = &sources.source;
    let mut start = 0;
    while start < source.len() {
        let mut end = start + 1;
        while end < source.len() && source[end] == source[start] {
            end += 1;
        }
        cells[source[start] as usize] += end - start;
        start = end;
    }
    cells.split_off(1)
}

fn used(cells: &[usize]) -> Vec<usize> {
    (0..cells.len()).filter(|&k| cells[k] > 0).collect()
}

/// Whether there is a cell whose photo has no data there.
fn has_gaps(sources: &CellSources, rgba: &[[u8; 4]]) -> bool {
    let n = sources.source.len().min(rgba.len());
    let (source, rgba) = (&sources.source[..n], &rgba[..n]);
    let mut count = 0;
    for i in 0..n {
        count += usize::from((source[i] > 0) & (rgba[i][3] == 0));
    }
    count > 0
}

/// The cells whose photo has no data there.
fn gaps<'a>(sources: &'a CellSources, rgba: &'a [[u8; 4]]) -> impl Iterator<Item = usize> + 'a {
    let both = sources.source.iter().zip(rgba).enumerate();
    both.filter(|(_, (source, colour))| **source > 0 && colour[3] == 0).map(|(cell, _)| cell)
}

/// Where a photo has no data the next best one is taken, and so on; where none has any there is no source.
fn fill_gaps<E: Send>(
    mosaic: &Mosaic<'_>,
    photos: &mut PhotoCache<'_, E>,
    sources: &mut CellSources,
    rgba: &mut [[u8; 4]],
) -> Result<(), E> {
    let selector = mosaic.selector;
    let window = sources.window;
    let among = selector.within(window);
    let mut candidates = Vec::new();
    let mut open: Vec<usize> = gaps(sources, rgba).collect();
    let first = sources.source.clone();
    for rank in 0.. {
        let mut next = CellSources { source: vec![0; window.pixels()], ..sources.clone() };
        for &cell in &open {
            let (u, v) = (window.u + cell % window.width, window.v + cell / window.width);
            candidates.clear();
            if let Some(point) = selector.point_m(u, v) {
                selector.candidates(point, &among, &mut candidates);
            }
            // The photo without data is passed over, whatever its place among the candidates is.
            let mut others = candidates.iter().filter(|of| of.view as u32 + 1 != first[cell]);
            let candidate = others.nth(rank);
            next.source[cell] = candidate.map_or(0, |candidate| candidate.view as u32 + 1);
            let pixel = candidate.map(|candidate| candidate.image_px.map(|value| value as f32));
            next.pixel[cell] = pixel.unwrap_or([f32::NAN; 2]);
            sources.source[cell] = next.source[cell];
            sources.passed_over[cell] = true;
            sources.pixel[cell] = next.pixel[cell];
        }
        let cells = cells_of(&next, photos.count());
        photos.each_group(&used(&cells), |photos| {
            paint(&next, photos, mosaic.corrections, mosaic.interpolation, rgba);
        })?;
        open = gaps(sources, rgba).collect();
        if open.is_empty() {
            break;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
