//! The height of the canopy above the surface, from the parallax of leaves between photos.
//!
//! An object `h` above the surface is displaced by `h t` in an orthophoto, with `t` the tangent vector of the line of sight
//! from the vertical: a decimetre of height displaces leaves by several centimetres where a wide lens looks aside, which is
//! more than the precision of plant positions along a row, and the direction changes at a seam. An orthophoto at the height
//! of the canopy shows leaves in their places, whichever photo they come from. That height is the one at which photos
//! agree best,
//!
//! ```text
//! h = argmax  sum_b cov_b(e_i, e_j) / sqrt(sum_b var_b(e_i) sum_b var_b(e_j)),    e = max(0, (2G - R - B)/(R + G + B) - 1/20)
//! ```
//!
//! over blocks of cells `b` that two photos `i`, `j` show from different sides, each drawn at `h` above the surface.
//! Excess green `e` leaves out the soil, which agrees best at the surface itself. Reference: R. T. Collins, *A
//! space-sweep approach to true multi-image matching*, CVPR 1996.
//!
//! Constants were chosen on the synthetic flight `paper`: `rowgram synth flight --preset paper -o field`, `rowgram run field`,
//! which gives the height (`rowgram ortho field --json`) and the plants within 5 cm of the truth (`rowgram evaluate field`).

use super::{
    Surface, View,
    cells::{CELLS, CellBlock, Pixels},
    photo::DecodedPhoto,
    photo_cache::PhotoCache,
    select::{Candidate, PhotoSelector, SelectionOptions},
};
use crate::mapping::undistort::Interpolation;
use rayon::prelude::*;
use rowgram_raster::{georeference::Georeference, window::Window};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Side of the cells by which photos are compared is no less than this, metres: finer than leaves are.
const MIN_CELL_M: f64 = 0.01;
/// The lowest height that is tried, the step to the next, metres, and their number.
const LOWEST_M: f64 = -0.6;
const STEP_M: f64 = 0.02;
const HEIGHTS: usize = 181;
/// Number of blocks that are compared, about, and how many times as many places are tried for them.
const TARGET_BLOCKS: usize = 400;
const SCAN_FACTOR: usize = 8;
/// The most pairs of photos in which they are, so that few photos have to be read.
const MAX_PAIRS: usize = 48;
/// Difference of the tangents of two lines of sight: least, preferred and greatest. Enough to tell heights apart, and not so
/// much that two photos see different sides of a plant.
const TANGENT_DIFFERENCES: [f64; 3] = [0.1, 0.5, 1.2];
/// The least correlation at the height of the canopy, and by how much it must exceed the median over all heights.
const MIN_CORRELATION: f64 = 0.2;
const MIN_PROMINENCE: f64 = 0.05;

/// Two photos, and the first cells of the blocks in which they are compared.
#[derive(Debug, Clone, PartialEq)]
pub struct StereoBlocks {
    /// Indices of the photos.
    pub photos: [usize; 2],
    /// First cells.
    pub blocks: Vec<[usize; 2]>,
}

/// The height of the canopy.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CanopyHeight {
    /// Above the surface, metres.
    pub height_m: f64,
    /// The correlation there.
    pub correlation: f64,
    /// The correlation at the surface itself.
    pub surface_correlation: f64,
}

/// The height of the canopy above a surface; `None` where photos agree clearly better at no height.
///
/// Photos are compared at their ground sampling distance `gsd_m`, metres.
///
/// # Errors
/// Photos that cannot be read.
pub fn estimate<E: Send>(
    views: &[View],
    surface: &Surface,
    options: SelectionOptions,
    gsd_m: f64,
    photos: &mut PhotoCache<'_, E>,
) -> Result<Option<CanopyHeight>, E> {
    let [x, y] = surface.bounds_m();
    let cell_m = gsd_m.max(MIN_CELL_M);
    let grid = Georeference::north_up([x[0], y[1]], cell_m, surface.georeference.crs);
    let size = [x, y].map(|[low, high]| ((high - low) / cell_m) as usize + 1);
    let selector = PhotoSelector::new(views, surface, grid, options);
    let mut sweep = HeightSweep::default();
    for pair in stereo_blocks(&selector, size) {
        photos.each_group(&pair.photos, |photos| {
            if let [Some(first), Some(second)] = pair.photos.map(|k| photos[k]) {
                sweep.add(&selector, &pair, [first, second]);
            }
        })?;
    }
    Ok(sweep.best())
}

/// Blocks of a map of `size` cells, each with two photos that show it from different sides, ordered by photos; photos
/// are many at most, so that few have to be read.
pub fn stereo_blocks(
    selector: &PhotoSelector<'_>,
    [width, height]: [usize; 2],
) -> Vec<StereoBlocks> {
    let places = (SCAN_FACTOR * TARGET_BLOCKS) as f64;
    let step = ((width as f64 * height as f64 / places).sqrt().ceil() as usize).max(1);
    let rows: Vec<usize> = (step / 2..height).step_by(step).collect();
    let found: Vec<([usize; 2], [usize; 2])> = rows
        .par_iter()
        .flat_map_iter(|&v| {
            let among = selector.within(Window { u: 0, v, width, height: 1 });
            let mut candidates = Vec::new();
            (step / 2..width).step_by(step).filter_map(move |u| {
                let point = selector.point_m(u, v)?;
                selector.candidates(point, &among, &mut candidates);
                Some((stereo_partners(selector, point, &candidates)?, [u, v]))
            })
        })
        .collect();
    let mut by_photos: BTreeMap<[usize; 2], Vec<[usize; 2]>> = BTreeMap::new();
    for (photos, block) in found {
        by_photos.entry(photos).or_default().push(block);
    }
    let every = by_photos.len().div_ceil(MAX_PAIRS).max(1);
    let mut pairs: Vec<StereoBlocks> = by_photos
        .into_iter()
        .step_by(every)
        .map(|(photos, blocks)| StereoBlocks { photos, blocks })
        .collect();
    let count: usize = pairs.iter().map(|pair| pair.blocks.len()).sum();
    let every = count.div_ceil(TARGET_BLOCKS).max(1);
    for pair in &mut pairs {
        let mut place = 0;
        pair.blocks.retain(|_| {
            place += 1;
            place % every == 1 || every == 1
        });
    }
    pairs
}

/// The photo of a cell and the one that sees it from another side, in order.
fn stereo_partners(
    selector: &PhotoSelector<'_>,
    point_m: [f64; 3],
    candidates: &[Candidate],
) -> Option<[usize; 2]> {
    let (first, others) = candidates.split_first()?;
    let tangent = |view: usize| {
        let c = selector.views[view].centre_m();
        let up = (c[2] - point_m[2]).max(1e-9);
        [(point_m[0] - c[0]) / up, (point_m[1] - c[1]) / up]
    };
    let own = tangent(first.view);
    let apart = |view: usize| {
        let t = tangent(view);
        (t[0] - own[0]).hypot(t[1] - own[1])
    };
    let (_, second) = others
        .iter()
        .map(|other| (apart(other.view), other.view))
        .filter(|(apart, _)| (TANGENT_DIFFERENCES[0]..=TANGENT_DIFFERENCES[2]).contains(apart))
        .map(|(apart, view)| ((apart - TANGENT_DIFFERENCES[1]).abs(), view))
        .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))?;
    Some([first.view.min(second), first.view.max(second)])
}

/// How well photos agree, height by height.
#[derive(Debug, Clone, PartialEq)]
pub struct HeightSweep {
    /// Covariances and both variances, times the number of cells.
    sums: Vec<[f64; 3]>,
}

impl Default for HeightSweep {
    fn default() -> HeightSweep {
        HeightSweep { sums: vec![[0.0; 3]; HEIGHTS] }
    }
}

fn height_m(step: usize) -> f64 {
    LOWEST_M + STEP_M * step as f64
}

impl HeightSweep {
    /// Compares two photos in their blocks.
    pub fn add(
        &mut self,
        selector: &PhotoSelector<'_>,
        pair: &StereoBlocks,
        photos: [&DecodedPhoto; 2],
    ) {
        let of_blocks: Vec<Vec<[f64; 3]>> = pair
            .blocks
            .par_iter()
            .map_init(Scratch::new, |scratch, &block| {
                (0..HEIGHTS)
                    .map(|step| scratch.compare(selector, pair.photos, photos, block, step))
                    .collect()
            })
            .collect();
        for sums in of_blocks {
            for (all, own) in self.sums.iter_mut().zip(sums) {
                (0..3).for_each(|k| all[k] += own[k]);
            }
        }
    }

    fn correlation(&self, step: usize) -> f64 {
        let [both, first, second] = self.sums[step];
        if first > 0.0 && second > 0.0 { both / (first * second).sqrt() } else { 0.0 }
    }

    /// The height at which photos agree best; `None` where none stands out.
    pub fn best(&self) -> Option<CanopyHeight> {
        let all: Vec<f64> = (0..HEIGHTS).map(|step| self.correlation(step)).collect();
        let best = (0..HEIGHTS).max_by(|&a, &b| all[a].total_cmp(&all[b]))?;
        let mut sorted = all.clone();
        sorted.sort_by(f64::total_cmp);
        let is_prominent =
            all[best] >= MIN_CORRELATION && all[best] >= sorted[HEIGHTS / 2] + MIN_PROMINENCE;
        if !is_prominent || best == 0 || best + 1 == HEIGHTS {
            return None;
        }
        // The vertex of the parabola through the best and its neighbours.
        let (before, at, after) = (all[best - 1], all[best], all[best + 1]);
        let bend = before - 2.0 * at + after;
        let shift = if bend < 0.0 { 0.5 * (before - after) / bend } else { 0.0 };
        let surface = (-LOWEST_M / STEP_M).round() as usize;
        Some(CanopyHeight {
            height_m: height_m(best) + STEP_M * shift.clamp(-0.5, 0.5),
            correlation: at,
            surface_correlation: all[surface],
        })
    }
}

/// Working memory of a block.
struct Scratch {
    cells: CellBlock,
    raised: CellBlock,
    first: [usize; 2],
    at: [Box<Pixels>; 2],
}

impl Scratch {
    fn new() -> Scratch {
        let pixels = || Box::new([[f32::NAN; 2]; CELLS]);
        Scratch {
            cells: CellBlock::new(),
            raised: CellBlock::new(),
            first: [usize::MAX; 2],
            at: [pixels(), pixels()],
        }
    }

    fn compare(
        &mut self,
        selector: &PhotoSelector<'_>,
        views: [usize; 2],
        photos: [&DecodedPhoto; 2],
        block: [usize; 2],
        step: usize,
    ) -> [f64; 3] {
        if self.first != block {
            self.first = block;
            self.cells.fill(block, &selector.grid, selector.surface, &selector.to_surface);
        }
        self.raised.clone_from(&self.cells);
        self.raised.raise(height_m(step));
        for (&k, at) in views.iter().zip(&mut self.at) {
            let view = &selector.views[k];
            if self.raised.project(view, &selector.frame(view), at) == 0 {
                return [0.0; 3];
            }
        }
        let (mut n, mut sums, mut products) = (0.0, [0.0; 2], [0.0; 3]);
        for (&a, &b) in self.at[0].iter().zip(self.at[1].iter()) {
            if a[0].is_nan() || b[0].is_nan() {
                continue;
            }
            let (Some(a), Some(b)) = (excess_green(photos[0], a), excess_green(photos[1], b))
            else {
                continue;
            };
            n += 1.0;
            sums = [sums[0] + a, sums[1] + b];
            products = [products[0] + a * b, products[1] + a * a, products[2] + b * b];
        }
        if n < 0.5 * CELLS as f64 {
            return [0.0; 3];
        }
        [
            products[0] - sums[0] * sums[1] / n,
            (products[1] - sums[0] * sums[0] / n).max(0.0),
            (products[2] - sums[1] * sums[1] / n).max(0.0),
        ]
    }
}

/// Excess green where there is much of it; `None` where the photo has no data.
fn excess_green(photo: &DecodedPhoto, at: [f32; 2]) -> Option<f64> {
    let colour = photo.at(at, Interpolation::Bilinear);
    if !DecodedPhoto::has_data(colour) {
        return None;
    }
    let [r, g, b, _] = colour.map(f64::from);
    let sum = r + g + b;
    // In the dark colours are noise.
    Some(if sum < 30.0 { 0.0 } else { ((2.0 * g - r - b) / sum - 0.05).max(0.0) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Interior, Model},
        mapping::{Surface, View, select::SelectionOptions},
        scene::Pose,
    };
    use image::{Rgb, RgbImage};
    use rowgram_raster::georeference::{Crs, Georeference};

    const SIZE: [u32; 2] = [800, 600];

    /// Four photos from 10 m over level ground at 2 m, along a line.
    fn views() -> Vec<View> {
        let interior =
            Interior::new(Model::Smac, SIZE, &[600.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
                .unwrap();
        let level = [1.0, 0.0, 0.0, 0.0];
        (0..4)
            .map(|k| {
                let centre = [4.0 * f64::from(k) - 6.0, 0.0, 12.0];
                View::new("p", interior, Pose::from_centre(level, centre), None)
            })
            .collect()
    }

    /// Green discs of 6 cm so far above textured soil, as a view shows them.
    fn photo(view: &View, above_m: f64, leaves: bool) -> DecodedPhoto {
        let random = |a: i64, b: i64| {
            let n = (a * 7919 + b * 104_729).wrapping_mul(0x9E37_79B9) as u64;
            ((n ^ (n >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9) >> 40) as u8
        };
        let image = RgbImage::from_fn(SIZE[0], SIZE[1], |u, v| {
            let (from, ray) = view.ray([f64::from(u), f64::from(v)]).unwrap();
            let at = |z: f64| {
                let s = (z - from[2]) / ray[2];
                [from[0] + s * ray[0], from[1] + s * ray[1]]
            };
            let [x, y] = at(2.0 + above_m);
            let cell = [x, y].map(|c| (c / 0.3).floor());
            let (a, b) = (cell[0] as i64, cell[1] as i64);
            let middle = [
                (cell[0] + 0.2 + 0.6 * f64::from(random(a, b)) / 255.0) * 0.3,
                (cell[1] + 0.2 + 0.6 * f64::from(random(b, a + 5)) / 255.0) * 0.3,
            ];
            if leaves && (x - middle[0]).hypot(y - middle[1]) < 0.06 {
                return Rgb([60, 150, 50]);
            }
            let [x, y] = at(2.0).map(|c| (c / 0.05).floor() as i64);
            let grey = 100 + random(x, y) / 4;
            Rgb([grey + 20, grey, grey - 30])
        });
        DecodedPhoto::new(&image, None)
    }

    fn found(above_m: f64, leaves: bool) -> Option<CanopyHeight> {
        let views = views();
        let photos: Vec<DecodedPhoto> =
            views.iter().map(|view| photo(view, above_m, leaves)).collect();
        let place = Georeference::north_up([-12.0, 8.0], 1.0, Crs::LOCAL);
        let surface = Surface::new(place, [25, 17], vec![2.0; 25 * 17]).unwrap();
        let grid = Georeference::north_up([-12.0, 8.0], 0.016, Crs::LOCAL);
        let selector = PhotoSelector::new(&views, &surface, grid, SelectionOptions::default());
        let mut sweep = HeightSweep::default();
        let pairs = stereo_blocks(&selector, [1500, 1000]);
        let blocks: usize = pairs.iter().map(|pair| pair.blocks.len()).sum();
        assert!(pairs.len() >= 3 && (100..=TARGET_BLOCKS).contains(&blocks), "{blocks}");
        for pair in &pairs {
            sweep.add(&selector, pair, pair.photos.map(|k| &photos[k]));
        }
        sweep.best()
    }

    #[test]
    fn leaves_are_as_high_as_they_are() {
        for above_m in [0.0, 0.137, -0.25] {
            let found = found(above_m, true).unwrap();
            assert!((found.height_m - above_m).abs() < 0.006, "{above_m}: {found:?}");
            assert!(found.correlation > 0.6 && found.correlation >= found.surface_correlation);
        }
    }

    #[test]
    fn soil_alone_says_nothing_of_leaves() {
        assert_eq!(found(0.3, false), None);
    }
}
