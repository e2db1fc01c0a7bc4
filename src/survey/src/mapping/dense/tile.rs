//! A tile of the ground and its blocks.

use super::{
    DenseOptions, PosedPhoto, Relief,
    block::{Block, BlockBuffers, choose, match_block},
    joins::{Margin, Part, join, tolerance_m},
    rectify::{BlockPlane, greenness},
};
use crate::mapping::{MapError, View};
use rayon::prelude::*;

/// Least side of a block, cells: as wide as what its neighbours share with it on both sides.
const MIN_BLOCK: usize = 32;
/// Distance of the nodes of the ground, metres, and at least this many coarse cells.
const NODE_M: f64 = 0.3;
const NODE_CELLS: f64 = 6.0;
/// Confidence (of 255) from which a coarse cell may show the ground.
const MIN_GROUND_CONFIDENCE: u8 = 30;
/// Greenness below which a cell may show the ground.
const BARE_BELOW: i16 = 2;

/// Cells of the ground: north up, metres of the frame in which the photos are posed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tile {
    /// Centre of the first (north-western) cell, metres.
    pub corner_m: [f64; 2],
    /// Side of a cell, metres.
    pub cell_m: f64,
    /// Columns and rows.
    pub size: [usize; 2],
}

impl Tile {
    /// The centre of a cell.
    pub fn place_m(&self, column: usize, row: usize) -> [f64; 2] {
        [
            self.corner_m[0] + column as f64 * self.cell_m,
            self.corner_m[1] - row as f64 * self.cell_m,
        ]
    }

    /// Least and greatest x and y.
    pub(super) fn bounds_m(&self) -> [[f64; 2]; 2] {
        let [x, y] = self.corner_m;
        let [width, height] = self.size.map(|n| n as f64 * self.cell_m);
        [[x, x + width], [y - height, y]]
    }
}

/// The surface of a tile; all grids row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct DenseTile {
    /// Its cells.
    pub tile: Tile,
    /// Height of the first surface, metres; NaN where not known.
    pub surface_m: Vec<f32>,
    /// How much better that height is than any other, 0 to 255; 0 where a height was filled in.
    pub confidence: Vec<u8>,
    /// How many photos show the cell, of those compared.
    pub photos: Vec<u8>,
    /// Standard deviation of the height relative to its neighbours, metres; NaN where not known.
    pub sigma_m: Vec<f32>,
    /// Red, green, blue of what is seen; black where nothing is.
    pub colour: Vec<[u8; 3]>,
    /// Heights around it, for its neighbours ([`super::TileMargins`]).
    pub margin: Margin,
}

/// Matches the cells of a tile. `ground` gives a height near the ground (within the layers of the options) everywhere on the tile; it
/// is the ground itself where the prior needs it. A surface of larger cells says where layers have to reach farther.
///
/// # Errors
/// Fewer than two photos, a cell or layer that is no length, nowhere a height of the ground.
pub fn match_tile(
    photos: &[PosedPhoto<'_>],
    ground: &(dyn Fn([f64; 2]) -> Option<f64> + Sync),
    tile: &Tile,
    options: &DenseOptions,
    relief: Option<&Relief>,
) -> Result<DenseTile, MapError> {
    if photos.len() < 2 {
        let found = photos.len();
        return Err(MapError(format!("{found} photos, expected at least 2 that overlap")));
    }
    for (name, value) in [("cell", tile.cell_m), ("distance of layers", options.layer_m)] {
        if !(value.is_finite() && value > 0.0) {
            return Err(MapError(format!("{name} {value} m, expected a positive length")));
        }
    }
    let width = tile.size[0];
    let mut result = nothing(tile);
    let views: Vec<&View> = photos.iter().map(|photo| photo.view).collect();
    let planes = blocks(&views, ground, tile, options);
    if planes.is_empty() {
        if plane(tile.corner_m, tile.cell_m, tile.size, ground).is_none() {
            return Err(MapError("no height of the ground is known on this tile".into()));
        }
        return Ok(result);
    }
    let one = |buffers: &mut BlockBuffers, plane: &BlockPlane| {
        let (reference, others) = choose(&views, plane, options.others)?;
        let usual = [options.lowest_m, options.highest_m()];
        let (plane, options) = match relief {
            Some(relief) => relief.fit(plane, options),
            None => (*plane, *options),
        };
        let limits = relief.map(|relief| (relief, usual));
        match_block(photos, (reference, &others), &plane, ground, &options, limits, buffers)
    };
    let of = |buffers: &mut BlockBuffers, (_, plane): &_| one(buffers, plane);
    let blocks: Vec<Option<Block>> =
        planes.par_iter().map_init(BlockBuffers::default, of).collect();
    let found = planes
        .iter()
        .zip(&blocks)
        .filter_map(|((start, _), block)| block.as_ref().map(|block| (*start, block)));
    for ([column, row], block) in found.clone() {
        let [columns, rows] = block.margin.size();
        for j in 0..rows {
            let (to, from) = ((row + j) * width + column, j * columns);
            result.surface_m[to..to + columns].copy_from_slice(&block.height_m[from..][..columns]);
            let confidence = &block.confidence[from..][..columns];
            result.confidence[to..to + columns].copy_from_slice(confidence);
            result.sigma_m[to..to + columns].copy_from_slice(&block.sigma_m[from..][..columns]);
            result.photos[to..to + columns].copy_from_slice(&block.photos[from..][..columns]);
            result.colour[to..to + columns].copy_from_slice(&block.colour[from..][..columns]);
        }
        // Around the tile, each block what is next to it.
        for [u, v] in Margin::places(block.margin.size()) {
            let cell = [u + column as isize, v + row as isize];
            let next = [0, 1].map(|k| cell[k].clamp(0, tile.size[k] as isize - 1));
            let is_next = (0..columns as isize).contains(&(next[0] - column as isize))
                && (0..rows as isize).contains(&(next[1] - row as isize));
            if let Some(z) = block.margin.at([u, v]).filter(|_| is_next) {
                result.margin.set(cell, z);
            }
        }
    }
    let parts: Vec<Part<'_>> =
        found.map(|(start, block)| Part { start, margin: &block.margin }).collect();
    for part in &parts {
        join(part, &parts, tolerance_m(options.layer_m), &mut result.surface_m, |[u, v]| {
            v * width + u
        });
    }
    Ok(result)
}

/// A tile of which nothing is known.
pub(super) fn nothing(tile: &Tile) -> DenseTile {
    let cells = tile.size[0] * tile.size[1];
    DenseTile {
        tile: *tile,
        surface_m: vec![f32::NAN; cells],
        confidence: vec![0; cells],
        photos: vec![0; cells],
        sigma_m: vec![f32::NAN; cells],
        colour: vec![[0; 3]; cells],
        margin: Margin::unknown(tile.size),
    }
}

/// First column and row of the blocks of a tile that two photos show, and the plane of each. A block of which photos show only a part is
/// cut into four, down to a side of [`MIN_BLOCK`].
pub(super) fn blocks(
    views: &[&View],
    ground: &dyn Fn([f64; 2]) -> Option<f64>,
    tile: &Tile,
    options: &DenseOptions,
) -> Vec<([usize; 2], BlockPlane)> {
    let [width, height] = tile.size;
    let side = options.block_cells.max(MIN_BLOCK);
    let starts = (0..height)
        .step_by(side)
        .flat_map(|row| (0..width).step_by(side).map(move |column| [column, row]));
    let mut open: Vec<([usize; 2], usize)> = starts.map(|start| (start, side)).collect();
    open.reverse();
    let mut found = Vec::new();
    while let Some(([column, row], side)) = open.pop() {
        if column >= width || row >= height {
            continue;
        }
        let size = [side.min(width - column), side.min(height - row)];
        let plane = plane(tile.place_m(column, row), tile.cell_m, size, ground);
        // Whatever is left at the end is as small as blocks are; before, the reference has to show all of it.
        let is_shown = |plane: &BlockPlane| match choose(views, plane, options.others) {
            Some((reference, _)) => side == MIN_BLOCK || shows_all(views[reference], plane),
            None => false,
        };
        match plane.filter(is_shown) {
            Some(plane) => found.push(([column, row], plane)),
            None if side > MIN_BLOCK => {
                let half = side / 2;
                let parts = [[half, half], [0, half], [half, 0], [0, 0]];
                open.extend(parts.map(|[u, v]| ([column + u, row + v], half)));
            }
            None => {}
        }
    }
    found
}

/// Whether a photo shows the four corners of a block.
fn shows_all(view: &View, block: &BlockPlane) -> bool {
    let [u, v] = block.size.map(|n| n as f64 - 1.0);
    [[0.0, 0.0], [u, 0.0], [0.0, v], [u, v]].into_iter().all(|cell| {
        let [x, y] = block.place_m(cell);
        view.pixel([x, y, block.at_m([x, y])]).is_some()
    })
}

/// Cells of a coarse tile that are sure: x, y, z in metres, and whether they may show the ground.
pub(super) fn sure_cells(found: &DenseTile) -> impl Iterator<Item = ([f64; 3], bool)> + '_ {
    let is_sure = |at: &usize| found.confidence[*at] >= MIN_GROUND_CONFIDENCE;
    (0..found.surface_m.len()).filter(is_sure).map(|at| {
        let [x, y] = found.tile.place_m(at % found.tile.size[0], at / found.tile.size[0]);
        ([x, y, f64::from(found.surface_m[at])], is_bare(found.colour[at]))
    })
}

/// Whether what has this colour may be the ground.
pub fn is_bare(colour: [u8; 3]) -> bool {
    greenness(colour) < BARE_BELOW
}

/// Distance of the nodes of the ground under cells of this side, metres.
pub fn node_m(coarse_cell_m: f64) -> f64 {
    NODE_M.max(NODE_CELLS * coarse_cell_m)
}

/// The plane through nine heights of the ground over a block; level where the ground is known at one place only.
fn plane(
    corner_m: [f64; 2],
    cell_m: f64,
    size: [usize; 2],
    ground: &dyn Fn([f64; 2]) -> Option<f64>,
) -> Option<BlockPlane> {
    let half = size.map(|n| 0.5 * (n - 1) as f64 * cell_m);
    let (mut sum, mut count) = (0.0, 0.0);
    let (mut rise, mut square) = ([0.0; 2], [0.0; 2]);
    for j in [-1.0, 0.0, 1.0] {
        for i in [-1.0, 0.0, 1.0] {
            let away = [i * half[0], j * half[1]];
            let place = [corner_m[0] + half[0] + away[0], corner_m[1] - half[1] + away[1]];
            if let Some(z) = ground(place) {
                sum += z;
                count += 1.0;
                for k in 0..2 {
                    rise[k] += z * away[k];
                    square[k] += away[k] * away[k];
                }
            }
        }
    }
    if count == 0.0 {
        return None;
    }
    let mean = sum / count;
    // The nine places lie symmetrically, so the slopes do not depend on each other; with gaps the plane is level.
    let slope =
        [0, 1].map(|k| if count == 9.0 && square[k] > 0.0 { rise[k] / square[k] } else { 0.0 });
    let height_m = mean - slope[0] * half[0] + slope[1] * half[1];
    Some(BlockPlane { corner_m, cell_m, size, height_m, slope })
}
