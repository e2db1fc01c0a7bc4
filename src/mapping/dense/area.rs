//! A whole area, tile by tile, and one ground under all of it.
//!
//! First all tiles with cells of twice the side, without the prior of colours, in layers that reach as far as heights may differ from
//! the base; their bare cells give the ground ([`Terrain`]), one lattice for the whole area, so that tiles have no steps. What
//! stands above it there says how high the layers of the second pass have to reach. Only one tile and the photos that it compares
//! are in memory; tiles go to a store, and what an interrupted attempt has left there is not matched again.

use super::{
    BarePlaces, DenseOptions, DenseTile, HeightCounts, LAYERS, Penalties, PosedPhoto,
    PosteriorOptions, Prior, Terrain, Tile, block, match_tile, rectify::greenness, tile,
};
use crate::mapping::{MapError, View, photo::DecodedPhoto};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// The usual side of a tile, cells: the photos that one tile compares are in memory together.
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
/// Width of the classes in which heights are counted, metres: a twentieth of the finest layers.
const CLASS_M: f64 = 5e-4;

/// How the surface of an area is matched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AreaOptions {
    /// How far above and below the base heights are looked for, metres.
    pub range_m: f64,
    /// How many photos are compared with the reference of a place.
    pub others: usize,
    /// Side of a tile, cells; a multiple of the blocks'.
    pub tile_cells: usize,
    /// Costs of steps in height.
    pub penalties: Penalties,
    /// What the colour of a pixel says of its height.
    pub prior: Prior,
}

/// What is known of an area besides its tiles.
#[derive(Debug, Clone, PartialEq)]
pub struct AreaGround {
    /// The ground under the canopy; `None` where nowhere is anything bare.
    pub terrain: Option<Terrain>,
    /// Distance of the layers of the second pass, metres.
    pub layer_m: f64,
}

/// Which of the two passes a tile is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Pass {
    /// Cells of twice the side, for the ground.
    Coarse,
    /// The surface.
    Fine,
}

/// Where matched tiles are kept. What an interrupted attempt has kept is not matched again.
pub trait TileStore<E> {
    /// A tile of a pass, by its number in [`starts`]; `None` where it has not been matched.
    ///
    /// # Errors
    /// Where it cannot be had.
    fn load(&mut self, pass: Pass, number: usize) -> Result<Option<DenseTile>, E>;

    /// Keeps a tile.
    ///
    /// # Errors
    /// Where it cannot be kept.
    fn save(&mut self, pass: Pass, number: usize, tile: &DenseTile) -> Result<(), E>;
}

/// All tiles in memory.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TilesInMemory(BTreeMap<(Pass, usize), DenseTile>);

impl<E> TileStore<E> for TilesInMemory {
    fn load(&mut self, pass: Pass, number: usize) -> Result<Option<DenseTile>, E> {
        Ok(self.0.get(&(pass, number)).cloned())
    }

    fn save(&mut self, pass: Pass, number: usize, tile: &DenseTile) -> Result<(), E> {
        self.0.insert((pass, number), tile.clone());
        Ok(())
    }
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

/// Number of tiles of an area, both passes together: how often `done` of [`match_area`] is called.
pub fn steps(area: &Tile, tile_cells: usize) -> usize {
    starts(area, tile_cells).len() + starts(&coarse(area), tile_cells).len()
}

/// Matches the cells of an area. `base` is a surface near the ground, such as that of tie points. `read` decodes the photo of a
/// view; tiles go to `store`, which has all of [`Pass::Fine`] afterwards; `done` is called after each tile. In memory are one tile, the photos
/// that it compares, and the lattice of the ground.
///
/// # Errors
/// What `read` and `store` say; fewer than two photos, no place that two photos show, a length that is none.
pub fn match_area<E: From<MapError> + Send>(
    views: &[View],
    read: &(dyn Fn(usize) -> Result<DecodedPhoto, E> + Sync),
    base: &(dyn Fn([f64; 2]) -> Option<f64> + Sync),
    area: &Tile,
    options: &AreaOptions,
    store: &mut dyn TileStore<E>,
    done: &mut dyn FnMut(),
) -> Result<AreaGround, E> {
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
        posterior: PosteriorOptions { rounds: 0, ..PosteriorOptions::default() },
    };
    let (coarse, side) = (coarse(area), options.tile_cells);
    let mut bare = BarePlaces::new(area.bounds_m(), tile::node_m(coarse.cell_m));
    let mut any = false;
    for number in 0..starts(&coarse, options.tile_cells).len() {
        let found =
            match_one(&mut album, base, (&coarse, side, number), &wide, Pass::Coarse, store)?;
        tile::bare_cells(&found).for_each(|place| bare.add(place));
        // Cells reach half their side beyond their middles.
        let half = 0.5 * coarse.cell_m;
        bare.close(found.tile.bounds_m().map(|[low, high]| [low + half, high - half]));
        any |= found.surface_m.iter().any(|z| z.is_finite());
        done();
    }
    if !any {
        let message = "nowhere do two photos show the same ground from places far enough apart";
        return Err(MapError(message.into()).into());
    }
    let terrain = bare.fit();
    let fine = match &terrain {
        // Nothing bare: colours say nothing of the ground.
        None => wide,
        Some(terrain) => {
            let usual = usual_height_m(&coarse, terrain, options, store)?;
            // Without colours all sure cells are asked, most of which are ground.
            let higher = if options.prior == Prior::None { 1.0 } else { HIGHER };
            let span = (higher * usual).max(LEAST_TOP_M) + 2.0 * SPARE_M;
            let layer_m = (span / (LAYERS - 1) as f64).max(area.cell_m);
            DenseOptions {
                layer_m,
                layers: (span / layer_m).ceil() as usize + 1,
                lowest_m: -SPARE_M,
                block_cells: DenseOptions::default().block_cells,
                prior: options.prior,
                posterior: PosteriorOptions::default(),
                ..wide
            }
        }
    };
    let ground = |place: [f64; 2]| match &terrain {
        Some(terrain) => terrain.at_m(place),
        None => base(place),
    };
    for number in 0..starts(area, options.tile_cells).len() {
        match_one(&mut album, &ground, (area, side, number), &fine, Pass::Fine, store)?;
        done();
    }
    Ok(AreaGround { terrain, layer_m: fine.layer_m })
}

/// The height above the ground that what surely stands on it usually does not exceed, from the tiles of the coarse pass.
fn usual_height_m<E>(
    coarse: &Tile,
    terrain: &Terrain,
    options: &AreaOptions,
    store: &mut dyn TileStore<E>,
) -> Result<f64, E> {
    let mut counts = HeightCounts::new(CLASS_M);
    for number in 0..starts(coarse, options.tile_cells).len() {
        let Some(found) = store.load(Pass::Coarse, number)? else { continue };
        for at in 0..found.surface_m.len() {
            let green = greenness(found.colour[at]);
            if found.confidence[at] < SURE
                || options.prior != Prior::None && !options.prior.is_leaf(green)
            {
                continue;
            }
            let place = found.tile.place_m(at % found.tile.size[0], at / found.tile.size[0]);
            let above = terrain.at_m(place).map(|z| f64::from(found.surface_m[at]) - z);
            above.into_iter().for_each(|above| counts.add(above));
        }
    }
    let share = if options.prior == Prior::None { 1.0 - MISTAKEN } else { USUAL };
    Ok(counts.percentile_m(share).unwrap_or(0.0))
}

/// The same area with cells of twice the side.
fn coarse(area: &Tile) -> Tile {
    Tile { cell_m: 2.0 * area.cell_m, size: area.size.map(|n| n.div_ceil(2)), ..*area }
}

/// First columns and rows of the tiles of an area.
pub fn starts(area: &Tile, tile_cells: usize) -> Vec<[usize; 2]> {
    let ([width, height], side) = (area.size, tile_cells.max(1));
    let rows = (0..height).step_by(side);
    rows.flat_map(|row| (0..width).step_by(side).map(move |column| [column, row])).collect()
}

/// A tile that is kept, or else is matched and kept; nothing but NaN where no two photos show it.
fn match_one<E: From<MapError> + Send>(
    album: &mut Album<'_, E>,
    ground: &(dyn Fn([f64; 2]) -> Option<f64> + Sync),
    (area, side, number): (&Tile, usize, usize),
    options: &DenseOptions,
    pass: Pass,
    store: &mut dyn TileStore<E>,
) -> Result<DenseTile, E> {
    let start = starts(area, side)[number];
    let part = Tile {
        corner_m: area.place_m(start[0], start[1]),
        cell_m: area.cell_m,
        size: [0, 1].map(|k| side.min(area.size[k] - start[k])),
    };
    if let Some(found) = store.load(pass, number)?.filter(|found| found.tile == part) {
        return Ok(found);
    }
    let views: Vec<&View> = album.views.iter().collect();
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
    store.save(pass, number, &found)?;
    Ok(found)
}
