//! A mosaic window by window: photos are decoded when a window needs them, kept while there is room, and
//! colours leave for the file while the next window is computed.

use crate::{
    error::Error,
    io::{
        FileError,
        geotiff::{self, Colour, Layout, TILE},
        images,
    },
    mapping::{
        paint::{Blend, Gain, paint},
        photo::Photo,
        select::{Selector, Sources},
    },
    raster::{georeference::Georeference, undistort::Interpolation, window::Window},
};
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::{Arc, mpsc},
};

/// Side of the windows, pixels: what they need stays in the cache.
const SIDE: usize = 2 * TILE;
/// Windows of a square, one after the other, so that photos are still there.
const SQUARE: usize = 2;
/// Samples of a pixel of the provenance raster.
pub(super) const PROVENANCE_BANDS: usize = 5;
/// What stands for no source there.
pub(super) const NO_SOURCE: f32 = -1.0;
/// Longer side of the previews, pixels.
const PREVIEW: usize = 1600;

/// What is to be rendered.
pub(super) struct Job<'a> {
    pub(super) selector: &'a Selector<'a>,
    pub(super) paths: &'a [PathBuf],
    pub(super) grid: Georeference,
    pub(super) size: [usize; 2],
    pub(super) interpolation: Interpolation,
    pub(super) feather_m: Option<f64>,
    pub(super) gains: Option<&'a [Gain]>,
}

/// What came of it.
pub(super) struct Rendered {
    /// Cells with a colour.
    pub(super) coloured: usize,
    /// Cells of each photo.
    pub(super) cells_of: Vec<usize>,
    /// Every so many cells one is in the previews.
    pub(super) step: usize,
    /// Columns and rows of the previews.
    pub(super) preview_size: [usize; 2],
    /// Colours.
    pub(super) preview: Vec<[u8; 4]>,
    /// Number of the photo plus 1.
    pub(super) preview_source: Vec<u32>,
}

/// Decoded photos, the least recently used of which leave first.
pub(super) struct Photos<'a> {
    job_paths: &'a [PathBuf],
    room_bytes: usize,
    kept: BTreeMap<usize, (Arc<Photo>, u64)>,
    clock: u64,
}

impl<'a> Photos<'a> {
    pub(super) fn new(paths: &'a [PathBuf], room_bytes: usize) -> Photos<'a> {
        Photos { job_paths: paths, room_bytes, kept: BTreeMap::new(), clock: 0 }
    }

    /// Parts of some photos that fit in the room together, in the order of their numbers; at least one each.
    fn groups(&self, needed: &[usize], selector: &Selector<'_>) -> Vec<Vec<usize>> {
        let mut groups: Vec<Vec<usize>> = Vec::new();
        let mut bytes = usize::MAX;
        for &k in needed {
            let [w, h] = selector.views()[k].interior.size_px().map(|n| n as usize);
            let own = 4 * w * h;
            match groups.last_mut() {
                Some(group) if bytes.saturating_add(own) <= self.room_bytes => {
                    group.push(k);
                    bytes += own;
                }
                _ => {
                    groups.push(vec![k]);
                    bytes = own;
                }
            }
        }
        groups
    }

    /// Brings photos into memory.
    fn load(&mut self, group: &[usize], selector: &Selector<'_>) -> Result<(), Error> {
        self.clock += 1;
        let clock = self.clock;
        let mut missing = Vec::new();
        let mut bytes = 0;
        for &k in group {
            let [w, h] = selector.views()[k].interior.size_px().map(|n| n as usize);
            bytes += 4 * w * h;
            match self.kept.get_mut(&k) {
                Some((_, used)) => *used = clock,
                None => missing.push(k),
            }
        }
        let others = |kept: &BTreeMap<usize, (Arc<Photo>, u64)>| {
            let of = kept.values().filter(|(_, used)| *used != clock);
            of.map(|(photo, _)| photo.bytes()).sum::<usize>()
        };
        while bytes + others(&self.kept) > self.room_bytes {
            let oldest = self.kept.iter().filter(|(_, (_, used))| *used != clock);
            let Some(k) = oldest.min_by_key(|(k, (_, used))| (*used, **k)).map(|(k, _)| *k) else {
                break;
            };
            self.kept.remove(&k);
        }
        let decoded: Vec<Result<(usize, Photo), Error>> = missing
            .par_iter()
            .map(|&k| Ok((k, read(&self.job_paths[k], selector.views()[k].interior.size_px())?)))
            .collect();
        for photo in decoded {
            let (k, photo) = photo?;
            self.kept.insert(k, (Arc::new(photo), clock));
        }
        Ok(())
    }

    /// Loads photos part by part and hands each part to `with`, by index.
    pub(super) fn each_group(
        &mut self,
        needed: &[usize],
        selector: &Selector<'_>,
        mut with: impl FnMut(&[Option<&Photo>]),
    ) -> Result<(), Error> {
        for group in self.groups(needed, selector) {
            self.load(&group, selector)?;
            let mut photos: Vec<Option<&Photo>> = vec![None; self.job_paths.len()];
            for &k in &group {
                photos[k] = self.kept.get(&k).map(|(photo, _)| photo.as_ref());
            }
            with(&photos);
        }
        Ok(())
    }
}

/// Reads a photo that must be as large as its camera says.
fn read(path: &Path, size_px: [u32; 2]) -> Result<Photo, Error> {
    let mut first = [0; 4];
    let tiff = std::fs::File::open(path)
        .and_then(|mut file| std::io::Read::read_exact(&mut file, &mut first))
        .is_ok_and(|()| geotiff::is_tiff(&first));
    let (photo, gaps) = if tiff {
        let reader = geotiff::Reader::open(path)?;
        reader.read_rgb_and_gaps(Window::whole(reader.width(), reader.height()))?
    } else {
        images::read_colour_and_gaps(path)?
    };
    if [photo.width(), photo.height()] != size_px {
        return Err(FileError::malformed(
            path,
            None,
            format!(
                "it has {} x {} pixels, its camera {} x {}",
                photo.width(),
                photo.height(),
                size_px[0],
                size_px[1]
            ),
        )
        .into());
    }
    Ok(Photo::new(&photo, gaps.as_deref()))
}

/// A finished window.
struct Piece {
    window: Window,
    rgba: Vec<u8>,
    provenance: Vec<f32>,
}

/// Renders a mosaic into a file, and where its pixels come from into another.
///
/// # Errors
/// Photos that cannot be read, outputs that cannot be written.
pub(super) fn render(
    job: &Job<'_>,
    photos: &mut Photos<'_>,
    (output, provenance): (&Path, Option<&Path>),
    force: bool,
) -> Result<Rendered, Error> {
    let [width, height] = job.size;
    let step = width.max(height).div_ceil(PREVIEW).max(1);
    let preview_size = [width.div_ceil(step), height.div_ceil(step)];
    let mut rendered = Rendered {
        coloured: 0,
        cells_of: vec![0; job.paths.len()],
        step,
        preview_size,
        preview: vec![[0; 4]; preview_size[0] * preview_size[1]],
        preview_source: vec![0; preview_size[0] * preview_size[1]],
    };
    let layout =
        Layout { width, height, colour: Colour::Rgba, georeference: Some(job.grid), nodata: None };
    geotiff::write::<u8, Error>(output, force, &layout, |colours| {
        let Some(path) = provenance else {
            return windows(job, photos, &mut rendered, false, |piece| {
                Ok(colours.put(piece.window, &piece.rgba)?)
            });
        };
        let layout = Layout {
            colour: Colour::Records(PROVENANCE_BANDS),
            nodata: Some(f64::from(NO_SOURCE)),
            ..layout
        };
        geotiff::write::<f32, Error>(path, force, &layout, |records| {
            windows(job, photos, &mut rendered, true, |piece| {
                colours.put(piece.window, &piece.rgba)?;
                Ok(records.put(piece.window, &piece.provenance)?)
            })
        })
    })?;
    Ok(rendered)
}

/// Computes window after window in a thread of its own while the last one is taken away.
fn windows(
    job: &Job<'_>,
    photos: &mut Photos<'_>,
    rendered: &mut Rendered,
    provenance: bool,
    mut take: impl FnMut(Piece) -> Result<(), Error>,
) -> Result<(), Error> {
    let order = order(job.size);
    let count = order.len();
    let style = ProgressStyle::with_template("{msg:10} {wide_bar} {pos}/{len} {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    let progress = ProgressBar::new(count as u64).with_style(style).with_message("windows");
    std::thread::scope(|scope| {
        let (send, receive) = mpsc::sync_channel::<Piece>(1);
        let worker = scope.spawn(move || -> Result<(), Error> {
            let mut sources = Sources::default();
            for window in order {
                let piece = piece(job, photos, rendered, (window, &mut sources), provenance)?;
                if send.send(piece).is_err() {
                    break;
                }
            }
            Ok(())
        });
        let mut taken = Ok(());
        for piece in &receive {
            taken = take(piece);
            if taken.is_err() {
                break;
            }
            progress.inc(1);
        }
        drop(receive);
        let worked = worker.join().unwrap_or_else(|_| {
            Err(Error::Incomplete("a thread that computed the mosaic ended early".into()))
        });
        progress.finish_and_clear();
        taken.and(worked)
    })
}

/// All windows: squares of them, forth in one row of squares and back in the next.
fn order([width, height]: [usize; 2]) -> Vec<Window> {
    const FAR: usize = SQUARE * SIDE;
    let columns = width.div_ceil(FAR);
    let mut windows = Vec::new();
    for n in 0..columns * height.div_ceil(FAR) {
        let (row, place) = (n / columns, n % columns);
        let column = if row.is_multiple_of(2) { place } else { columns - 1 - place };
        let (left, top) = (column * FAR, row * FAR);
        for v in (top..height.min(top + FAR)).step_by(SIDE) {
            for u in (left..width.min(left + FAR)).step_by(SIDE) {
                let (width, height) = (SIDE.min(width - u), SIDE.min(height - v));
                windows.push(Window { u, v, width, height });
            }
        }
    }
    windows
}

fn piece(
    job: &Job<'_>,
    photos: &mut Photos<'_>,
    rendered: &mut Rendered,
    (window, sources): (Window, &mut Sources),
    provenance: bool,
) -> Result<Piece, Error> {
    let selector = job.selector;
    selector.sources_into(window, sources);
    let mut cells = cells_of(sources, job.paths.len());
    let mut rgba = vec![[0u8; 4]; window.pixels()];
    match job.feather_m {
        None => {
            photos.each_group(&used(&cells), selector, |photos| {
                paint(sources, photos, job.gains, job.interpolation, &mut rgba);
            })?;
            if has_gaps(sources, &rgba) {
                fill_gaps(job, photos, sources, &mut rgba)?;
                cells = cells_of(sources, job.paths.len());
            }
        }
        Some(feather_m) => {
            let needed = Blend::photos(selector, sources, feather_m);
            let mut blend = Blend::new(window);
            photos.each_group(&needed, selector, |photos| {
                let how = (job.interpolation, feather_m);
                blend.add(selector, sources, photos, job.gains, how);
            })?;
            blend.finish(&mut rgba);
            let empty: Vec<usize> = gaps(sources, &rgba).collect();
            for cell in empty {
                sources.source[cell] = 0;
                sources.pixel[cell] = [f32::NAN; 2];
            }
            cells = cells_of(sources, job.paths.len());
        }
    }
    let sources = &*sources;
    rendered.coloured += cells.iter().sum::<usize>();
    rendered.cells_of.iter_mut().zip(&cells).for_each(|(all, own)| *all += own);
    let step = rendered.step;
    let first = [window.u, window.v].map(|n| n.next_multiple_of(step));
    for v in (first[1]..window.v + window.height).step_by(step) {
        for u in (first[0]..window.u + window.width).step_by(step) {
            let from = (v - window.v) * window.width + u - window.u;
            let to = v / step * rendered.preview_size[0] + u / step;
            rendered.preview[to] = rgba[from];
            rendered.preview_source[to] = sources.source[from];
        }
    }
    let provenance = if provenance { records(selector, sources) } else { Vec::new() };
    Ok(Piece { window, rgba: rgba.into_flattened(), provenance })
}

/// Cells of each photo.
fn cells_of(sources: &Sources, count: usize) -> Vec<usize> {
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
fn has_gaps(sources: &Sources, rgba: &[[u8; 4]]) -> bool {
    let n = sources.source.len().min(rgba.len());
    let (source, rgba) = (&sources.source[..n], &rgba[..n]);
    let mut count = 0;
    for i in 0..n {
        count += usize::from((source[i] > 0) & (rgba[i][3] == 0));
    }
    count > 0
}

/// The cells whose photo has no data there.
fn gaps<'a>(sources: &'a Sources, rgba: &'a [[u8; 4]]) -> impl Iterator<Item = usize> + 'a {
    let both = sources.source.iter().zip(rgba).enumerate();
    both.filter(|(_, (source, colour))| **source > 0 && colour[3] == 0).map(|(cell, _)| cell)
}

/// Where a photo has no data the next best one is taken, and so on; where none has any there is no source.
fn fill_gaps(
    job: &Job<'_>,
    photos: &mut Photos<'_>,
    sources: &mut Sources,
    rgba: &mut [[u8; 4]],
) -> Result<(), Error> {
    let selector = job.selector;
    let window = sources.window;
    let among = selector.within(window);
    let mut candidates = Vec::new();
    let mut open: Vec<usize> = gaps(sources, rgba).collect();
    for rank in 1.. {
        let mut next = Sources { source: vec![0; window.pixels()], ..sources.clone() };
        for &cell in &open {
            let (u, v) = (window.u + cell % window.width, window.v + cell / window.width);
            candidates.clear();
            if let Some(point) = selector.point_m(u, v) {
                selector.candidates(point, &among, &mut candidates);
            }
            let candidate = candidates.get(rank);
            next.source[cell] = candidate.map_or(0, |candidate| candidate.view as u32 + 1);
            let pixel = candidate.map(|candidate| candidate.image_px.map(|value| value as f32));
            next.pixel[cell] = pixel.unwrap_or([f32::NAN; 2]);
            sources.source[cell] = next.source[cell];
            sources.pixel[cell] = next.pixel[cell];
        }
        let cells = cells_of(&next, job.paths.len());
        photos.each_group(&used(&cells), selector, |photos| {
            paint(&next, photos, job.gains, job.interpolation, rgba);
        })?;
        open = gaps(sources, rgba).collect();
        if open.is_empty() {
            break;
        }
    }
    Ok(())
}

/// Source, its pixel, view angle in degrees and distance to the seam in metres of every cell.
fn records(selector: &Selector<'_>, sources: &Sources) -> Vec<f32> {
    let window = sources.window;
    let seams = selector.seams_m(sources);
    let mut out = vec![NO_SOURCE; window.pixels() * PROVENANCE_BANDS];
    out.par_chunks_mut(window.width * PROVENANCE_BANDS).enumerate().for_each(|(j, row)| {
        for (i, cell) in row.chunks_exact_mut(PROVENANCE_BANDS).enumerate() {
            let at = j * window.width + i;
            let Some(own) = (sources.source[at] as usize).checked_sub(1) else { continue };
            let Some(point) = selector.point_m(window.u + i, window.v + j) else { continue };
            let seam = seams[at];
            let centre = selector.views()[own].centre_m();
            let plan = (centre[0] - point[0]).hypot(centre[1] - point[1]);
            let angle = plan.atan2(centre[2] - point[2]).to_degrees();
            cell[0] = own as f32;
            cell[1] = sources.pixel[at][0];
            cell[2] = sources.pixel[at][1];
            cell[3] = angle as f32;
            // Where no other photo shows the cell there is no seam.
            cell[4] = if seam.is_finite() { seam } else { NO_SOURCE };
        }
    });
    out
}
