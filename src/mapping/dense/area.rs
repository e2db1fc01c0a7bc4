//! A whole area, tile by tile, and one ground under all of it.
//!
//! First all tiles with cells of twice the side, without the prior of colours, in layers that reach as far as heights may differ from
//! the base; their bare cells give the ground ([`Terrain`]), one lattice for the whole area, so that tiles have no steps. What
//! stands above it there says how high the layers of the second pass have to reach. Only photos that a tile compares are in
//! memory.

use super::{
    DenseOptions, DenseTile, LAYERS, Penalties, PosedPhoto, Prior, Terrain, Tile, block,
    match_tile, tile,
};
use crate::mapping::{MapError, View, photo::DecodedPhoto};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Side of a tile, cells: the photos that one tile compares are in memory together.
pub const TILE: usize = 1024;
// Of the next, `USUAL`, `HIGHER` and `SURE` were chosen on the synthetic flight `small` (`rowgram synth flight --preset small`, then `run`), beside what the test of the run
// prints; docs/decisions.md has the numbers. No other flight was looked at.
/// Share of what surely stands on the ground in the coarse pass that decides how high layers reach: one leaf in ten may be mistaken
/// there, and mistakes are as high as the layers.
const USUAL: f64 = 0.9;
/// Share of all sure cells of the coarse pass that may be mistaken, where colours say nothing. Not measured.
const MISTAKEN: f64 = 0.001;
/// Layers reach so many times as high as that.
const HIGHER: f64 = 1.4;
/// Confidence (of 255) of a coarse cell that says how high layers have to reach.
const SURE: u8 = 80;
/// Layers below the ground, and above what stands on it, metres: what the ground may be off by.
const SPARE_M: f64 = 0.1;
/// The layers of the second pass reach at least so high, metres: young plants, where nothing stands surely. Not measured.
const LEAST_TOP_M: f64 = 0.3;

/// How the surface of an area is matched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AreaOptions {
    /// How far above and below the base heights are looked for, metres.
    pub range_m: f64,
    /// How many photos are compared with the reference of a place.
    pub others: usize,
    /// Costs of steps in height.
    pub penalties: Penalties,
    /// What the colour of a pixel says of its height.
    pub prior: Prior,
}

/// The surface of an area; grids row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct AreaSurface {
    /// Its cells.
    pub area: Tile,
    /// Height of the first surface, metres; NaN where not known.
    pub surface_m: Vec<f32>,
    /// How much better that height is than any other, 0 to 255; 0 where a height was filled in.
    pub confidence: Vec<u8>,
    /// How many photos show the cell, of those compared.
    pub photos: Vec<u8>,
    /// The ground under the canopy; `None` where nowhere is anything bare.
    pub terrain: Option<Terrain>,
    /// Distance of the layers of the second pass, metres.
    pub layer_m: f64,
}

/// Photos in memory.
struct Album<'a, E> {
    views: &'a [View],
    read: &'a (dyn Fn(usize) -> Result<DecodedPhoto, E> + Sync),
    photos: BTreeMap<usize, DecodedPhoto>,
}

impl<E: Send> Album<'_, E> {
    /// Brings these photos into memory, and no others.
    fn open(&mut self, needed: &[usize]) -> Result<(), E> {
        self.photos.retain(|k, _| needed.contains(k));
        let missing: Vec<usize> =
            needed.iter().copied().filter(|k| !self.photos.contains_key(k)).collect();
        let found: Vec<(usize, DecodedPhoto)> =
            missing.into_par_iter().map(|k| Ok((k, (self.read)(k)?))).collect::<Result<_, E>>()?;
        self.photos.extend(found);
        Ok(())
    }

    fn posed(&self) -> Vec<PosedPhoto<'_>> {
        self.photos.iter().map(|(&k, photo)| PosedPhoto { view: &self.views[k], photo }).collect()
    }
}

/// Number of tiles of an area, both passes together: how often `done` of [`surface_area`] is called.
pub fn steps(area: &Tile) -> usize {
    starts(area).len() + starts(&coarse(area)).len()
}

/// Matches the cells of an area. `base` is a surface near the ground, such as that of tie points. `read` decodes the photo of a
/// view; `done` is called after each tile.
///
/// # Errors
/// What `read` says; fewer than two photos, no place that two photos show, a length that is none.
pub fn surface_area<E: From<MapError> + Send>(
    views: &[View],
    read: &(dyn Fn(usize) -> Result<DecodedPhoto, E> + Sync),
    base: &(dyn Fn([f64; 2]) -> Option<f64> + Sync),
    area: &Tile,
    options: &AreaOptions,
    done: &mut dyn FnMut(),
) -> Result<AreaSurface, E> {
    if views.len() < 2 {
        let found = views.len();
        return Err(MapError(format!("{found} photos, expected at least 2 that overlap")).into());
    }
    for (name, value) in [("cell", area.cell_m), ("range of heights", options.range_m)] {
        if !(value.is_finite() && value > 0.0) {
            return Err(MapError(format!("{name} {value} m, expected a positive length")).into());
        }
    }
    let mut album = Album { views, read, photos: BTreeMap::new() };
    let wide = DenseOptions {
        layer_m: 2.0 * options.range_m / (LAYERS - 1) as f64,
        lowest_m: -options.range_m,
        layers: LAYERS,
        others: options.others,
        block_cells: DenseOptions::default().block_cells / 2,
        penalties: options.penalties,
        prior: Prior::None,
    };
    let (mut bare, mut seen, mut any) = (Vec::new(), Vec::new(), false);
    match_tiles(&mut album, base, &coarse(area), &wide, &mut |_, found| {
        bare.extend(tile::bare_cells(&found));
        any |= found.surface_m.iter().any(|z| z.is_finite());
        let stands = |at: &usize| {
            found.confidence[*at] >= SURE
                && (options.prior == Prior::None || options.prior.is_leaf(found.green[*at]))
        };
        seen.extend((0..found.surface_m.len()).filter(stands).map(|at| {
            let [x, y] = found.tile.place_m(at % found.tile.size[0], at / found.tile.size[0]);
            [x, y, f64::from(found.surface_m[at])]
        }));
        done();
    })?;
    if !any {
        let message = "nowhere do two photos show the same ground from places far enough apart";
        return Err(MapError(message.into()).into());
    }
    let node_m = tile::node_m(2.0 * area.cell_m);
    let terrain = Terrain::fit(&bare, area.bounds_m(), node_m);
    drop(bare);
    let fine = match &terrain {
        // Nothing bare: colours say nothing of the ground.
        None => wide,
        Some(terrain) => {
            let above = |&[x, y, z]: &[f64; 3]| Some(z - terrain.at_m([x, y])?);
            let mut above: Vec<f64> = seen.iter().filter_map(above).collect();
            // Without colours all sure cells are asked, most of which are ground.
            let (share, higher) = match options.prior {
                Prior::None => (1.0 - MISTAKEN, 1.0),
                Prior::GreenOnSoil { .. } => (USUAL, HIGHER),
            };
            let at = (share * above.len().saturating_sub(1) as f64) as usize;
            let usual = match above.is_empty() {
                true => 0.0,
                false => *above.select_nth_unstable_by(at, f64::total_cmp).1,
            };
            let span = (higher * usual).max(LEAST_TOP_M) + 2.0 * SPARE_M;
            let layer_m = (span / (LAYERS - 1) as f64).max(area.cell_m);
            DenseOptions {
                layer_m,
                layers: (span / layer_m).ceil() as usize + 1,
                lowest_m: -SPARE_M,
                block_cells: DenseOptions::default().block_cells,
                prior: options.prior,
                ..wide
            }
        }
    };
    drop(seen);
    let [width, height] = area.size;
    let mut result = AreaSurface {
        area: *area,
        surface_m: vec![f32::NAN; width * height],
        confidence: vec![0; width * height],
        photos: vec![0; width * height],
        terrain: None,
        layer_m: fine.layer_m,
    };
    let ground = |place: [f64; 2]| match &terrain {
        Some(terrain) => terrain.at_m(place),
        None => base(place),
    };
    match_tiles(&mut album, &ground, area, &fine, &mut |[column, row], found| {
        let [columns, rows] = found.tile.size;
        for j in 0..rows {
            let (to, from) = ((row + j) * width + column, j * columns);
            let (to, from) = (to..to + columns, from..from + columns);
            result.surface_m[to.clone()].copy_from_slice(&found.surface_m[from.clone()]);
            result.confidence[to.clone()].copy_from_slice(&found.confidence[from.clone()]);
            result.photos[to].copy_from_slice(&found.photos[from]);
        }
        done();
    })?;
    result.terrain = terrain;
    Ok(result)
}

/// The same area with cells of twice the side.
fn coarse(area: &Tile) -> Tile {
    Tile { cell_m: 2.0 * area.cell_m, size: area.size.map(|n| n.div_ceil(2)), ..*area }
}

/// First columns and rows of the tiles.
fn starts(area: &Tile) -> Vec<[usize; 2]> {
    let [width, height] = area.size;
    let rows = (0..height).step_by(TILE);
    rows.flat_map(|row| (0..width).step_by(TILE).map(move |column| [column, row])).collect()
}

/// Matches all tiles that photos show, one after the other; `sink` takes what was found, and nothing but NaN where no two
/// photos show the tile.
fn match_tiles<E: From<MapError> + Send>(
    album: &mut Album<'_, E>,
    ground: &(dyn Fn([f64; 2]) -> Option<f64> + Sync),
    area: &Tile,
    options: &DenseOptions,
    sink: &mut dyn FnMut([usize; 2], DenseTile),
) -> Result<(), E> {
    let views: Vec<&View> = album.views.iter().collect();
    for start in starts(area) {
        let part = Tile {
            corner_m: area.place_m(start[0], start[1]),
            cell_m: area.cell_m,
            size: [0, 1].map(|k| TILE.min(area.size[k] - start[k])),
        };
        let mut needed: Vec<usize> = tile::blocks(&views, ground, &part, options)
            .into_iter()
            .filter_map(|(_, plane)| block::choose(&views, &plane, options.others))
            .flat_map(|(reference, others)| std::iter::once(reference).chain(others))
            .collect();
        needed.sort_unstable();
        needed.dedup();
        let found = if needed.len() < 2 {
            tile::nothing(&part)
        } else {
            album.open(&needed)?;
            match_tile(&album.posed(), ground, &part, options)?
        };
        sink(start, found);
    }
    Ok(())
}
