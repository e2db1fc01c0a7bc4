//! A whole area, tile by tile, and one ground under all of it.
//!
//! First all tiles with cells of twice the side, without the prior of colours, in layers that reach as far as heights may differ from
//! the base, and farther where cells of eight times the side see trees or houses ([`Relief`]); their bare cells give the ground
//! ([`Terrain`]), one lattice for the whole area, so that tiles have no steps. What usually stands above it there says how high the
//! layers of the second pass have to reach, and trees and houses on a block how much higher on that block. Only one tile and the
//! photos that it compares are in memory; tiles go to a store, and what an interrupted attempt has left there is not matched again.

use super::{
    DenseOptions, DenseTile, GroundPlaces, LAYERS, MAX_LAYERS, MatchedPhoto, Penalties, PosedPhoto,
    PosteriorOptions, Prior, Relief, Terrain, Tile, block, match_tile, rectify::greenness, tile,
};
use crate::mapping::{MapError, View, photo::DecodedPhoto};
use rayon::prelude::*;
use rowgram_raster::height_counts::HeightCounts;
use std::{collections::BTreeMap, ops::Range};

/// The usual side of a tile, cells: the photos that one tile compares are in memory together.
pub const TILE: usize = 1024;
// Of the next, `USUAL`, `HIGHER` and `MIN_HEIGHT_CONFIDENCE` were chosen on the synthetic flight `small` (`rowgram synth flight --preset small`, then `run`), beside what the test of the run
// prints; docs/decisions.md has the numbers. No other flight was looked at.
/// Share of what surely stands on the ground in the coarse pass that decides how high layers reach: one leaf in ten may be mistaken
/// there, and mistakes are as high as the layers.
const USUAL: f64 = 0.9;
/// Share of all sure cells of the coarse pass that may be mistaken, where colours say nothing. Not measured.
const MISTAKEN: f64 = 0.001;
/// Layers reach so many times as high as that.
const HIGHER: f64 = 1.4;
/// Confidence (of 255) of a coarse cell that says how high layers have to reach.
const MIN_HEIGHT_CONFIDENCE: u8 = 80;
/// Layers below the ground, and above what stands on it, metres: what the ground may be off by.
const SPARE_M: f64 = 0.1;
/// The layers of the second pass reach at least so high, metres: young plants, where nothing stands surely. Not measured.
const MIN_TOP_M: f64 = 0.3;
// The next three were chosen while looking at the surfaces of three real flights (docs/accuracy.md), not by a measured optimum.
/// Side of the cells in which trees and houses are looked for, in coarse cells, and the values of a photo in each, across.
const OVERVIEW_CELLS: usize = 4;
/// Costs of steps there: large cells of crowns are as rough as leaves and need more support.
const OVERVIEW_PENALTIES: Penalties = Penalties { step: 10, jump: 70, edge: 0.02 };
/// Trees and houses are looked for where they may be so many times as far from the base as other heights.
const RELIEF: f64 = 1.5;
/// Width of the classes in which heights are counted, metres: a twentieth of the finest layers.
const CLASS_M: f64 = 5e-4;

/// How the surface of an area is matched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AreaOptions {
    /// How far above and below the base heights are looked for, metres.
    pub range_m: f64,
    /// How far above and below the base trees and houses are looked for, metres; nothing of the kind where it is hardly more.
    pub relief_m: f64,
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

/// Photos in memory.
struct Album<'a, E> {
    views: &'a [View],
    read: &'a (dyn Fn(usize) -> Result<DecodedPhoto, E> + Sync),
    photos: BTreeMap<usize, MatchedPhoto>,
}

impl<E: Send> Album<'_, E> {
    /// Brings these photos into memory, and no others.
    fn open(&mut self, needed: &[usize]) -> Result<(), E> {
        self.photos.retain(|k, _| needed.contains(k));
        let missing: Vec<usize> =
            needed.iter().copied().filter(|k| !self.photos.contains_key(k)).collect();
        let read = |k: usize| Ok((k, MatchedPhoto::new((self.read)(k)?)));
        let found: Vec<(usize, MatchedPhoto)> =
            missing.into_par_iter().map(read).collect::<Result<_, E>>()?;
        self.photos.extend(found);
        Ok(())
    }

    fn posed(&self) -> Vec<PosedPhoto<'_>> {
        self.photos.iter().map(|(&k, photo)| PosedPhoto { view: &self.views[k], photo }).collect()
    }
}

/// An area and what it is matched from.
pub struct Area<'a, E> {
    /// The photos' cameras.
    pub views: &'a [View],
    /// Decodes the photo of a view.
    pub read: &'a (dyn Fn(usize) -> Result<DecodedPhoto, E> + Sync),
    /// A surface near the ground, such as that of tie points.
    pub base: &'a (dyn Fn([f64; 2]) -> Option<f64> + Sync),
    /// Its cells.
    pub cells: Tile,
    /// How it is matched.
    pub options: AreaOptions,
}

impl<E: From<MapError> + Send> Area<'_, E> {
    /// Number of tiles of a pass.
    pub fn tiles(&self, pass: Pass) -> usize {
        starts(self.cells_of(pass).size, self.options.tile_cells).len()
    }

    fn cells_of(&self, pass: Pass) -> Tile {
        match pass {
            Pass::Coarse => coarse(&self.cells),
            Pass::Fine => self.cells,
        }
    }

    /// Matches all cells. Tiles go to `store`, which has all of [`Pass::Fine`] afterwards; `done` is called after each tile of both
    /// passes. In memory are one tile, the photos that it compares, and the lattice of the ground.
    ///
    /// # Errors
    /// What `read` and `store` say; fewer than two photos, no place that two photos show, a length that is none.
    pub fn match_all(
        &self,
        store: &mut dyn TileStore<E>,
        done: &mut dyn FnMut(),
    ) -> Result<AreaGround, E> {
        let mut album = self.album()?;
        let terrain = self.ground(&mut album, store, done)?;
        let fine = self.fine(terrain.as_ref(), store)?;
        let all = 0..self.tiles(Pass::Fine);
        self.surface(&mut album, all, (terrain.as_ref(), &fine), store, done)?;
        Ok(AreaGround { terrain, layer_m: fine.layer_m })
    }

    /// Matches some tiles of a pass, for [`Area::match_all`] to go on from; all of [`Pass::Coarse`] come before the first of [`Pass::Fine`].
    ///
    /// # Errors
    /// As [`Area::match_all`].
    pub fn match_tiles(
        &self,
        pass: Pass,
        numbers: Range<usize>,
        store: &mut dyn TileStore<E>,
        done: &mut dyn FnMut(),
    ) -> Result<(), E> {
        let mut album = self.album()?;
        match pass {
            Pass::Coarse => {
                for number in numbers {
                    self.coarse_tile(&mut album, number, store)?;
                    done();
                }
                Ok(())
            }
            Pass::Fine => {
                let terrain = self.ground(&mut album, store, &mut || ())?;
                let fine = self.fine(terrain.as_ref(), store)?;
                self.surface(&mut album, numbers, (terrain.as_ref(), &fine), store, done)
            }
        }
    }

    fn album(&self) -> Result<Album<'_, E>, E> {
        if self.views.len() < 2 {
            let found = self.views.len();
            let message = format!("{found} photos, expected at least 2 that overlap");
            return Err(MapError(message).into());
        }
        let lengths = [("cell", self.cells.cell_m), ("range of heights", self.options.range_m)];
        for (name, value) in lengths {
            if !(value.is_finite() && value > 0.0) {
                let message = format!("{name} {value} m, expected a positive length");
                return Err(MapError(message).into());
            }
        }
        Ok(Album { views: self.views, read: self.read, photos: BTreeMap::new() })
    }

    /// How the first pass is matched.
    fn wide(&self) -> DenseOptions {
        let span_m = 2.0 * self.options.range_m;
        let (layer_m, layers) = DenseOptions::layers_over(span_m, self.cells.cell_m, LAYERS);
        DenseOptions {
            layer_m,
            lowest_m: -self.options.range_m,
            layers,
            samples: 1,
            others: self.options.others,
            block_cells: DenseOptions::default().block_cells / 2,
            penalties: self.options.penalties,
            prior: Prior::None,
            posterior: PosteriorOptions { rounds: 0, ..PosteriorOptions::default() },
        }
    }

    fn coarse_tile(
        &self,
        album: &mut Album<'_, E>,
        number: usize,
        store: &mut dyn TileStore<E>,
    ) -> Result<DenseTile, E> {
        let part = self.part(Pass::Coarse, number);
        if let Some(found) = kept(store, (Pass::Coarse, number), &part)? {
            return Ok(found);
        }
        let wide = self.wide();
        let found = match self.overview(&part) {
            None => match_part(album, self.base, &part, &wide, None)?,
            Some((tile, options)) => {
                let overview = match_part(album, self.base, &tile, &options, None)?;
                match_part(album, self.base, &part, &wide, Some(&Relief::new(overview, &part)))?
            }
        };
        store.save(Pass::Coarse, number, &found)?;
        Ok(found)
    }

    /// The cells in which trees and houses on a part are looked for, and how; `None` where tie points speak of none.
    fn overview(&self, part: &Tile) -> Option<(Tile, DenseOptions)> {
        let range_m = self.options.relief_m;
        if range_m <= RELIEF * self.options.range_m {
            return None;
        }
        let tile = Tile {
            cell_m: OVERVIEW_CELLS as f64 * part.cell_m,
            size: part.size.map(|n| n.div_ceil(OVERVIEW_CELLS)),
            ..*part
        };
        let (layer_m, layers) = DenseOptions::layers_over(2.0 * range_m, tile.cell_m, MAX_LAYERS);
        let options = DenseOptions {
            layer_m,
            lowest_m: -range_m,
            layers,
            samples: OVERVIEW_CELLS,
            penalties: OVERVIEW_PENALTIES,
            ..self.wide()
        };
        Some((tile, options))
    }

    /// The cells of a tile.
    fn part(&self, pass: Pass, number: usize) -> Tile {
        let (area, side) = (self.cells_of(pass), self.options.tile_cells);
        let start = starts(area.size, side)[number];
        let size = [0, 1].map(|k| side.min(area.size[k] - start[k]));
        Tile { corner_m: area.place_m(start[0], start[1]), cell_m: area.cell_m, size }
    }

    /// The first pass, and the ground from it.
    fn ground(
        &self,
        album: &mut Album<'_, E>,
        store: &mut dyn TileStore<E>,
        done: &mut dyn FnMut(),
    ) -> Result<Option<Terrain>, E> {
        let cells = self.cells_of(Pass::Coarse);
        let cell_m = cells.cell_m;
        let mut places = GroundPlaces::new(cells.bounds_m(), tile::node_m(cell_m));
        let mut any = false;
        for number in 0..self.tiles(Pass::Coarse) {
            let found = self.coarse_tile(album, number, store)?;
            tile::sure_cells(&found).for_each(|(place, bare)| places.add(place, bare));
            // Cells reach half their side beyond their middles.
            let half = 0.5 * cell_m;
            places.close(found.tile.bounds_m().map(|[low, high]| [low + half, high - half]));
            any |= found.surface_m.iter().any(|z| z.is_finite());
            done();
        }
        if !any {
            let message = "nowhere do two photos show the same ground from places far enough apart";
            return Err(MapError(message.into()).into());
        }
        Ok(places.fit())
    }

    /// How the second pass is matched.
    fn fine(
        &self,
        terrain: Option<&Terrain>,
        store: &mut dyn TileStore<E>,
    ) -> Result<DenseOptions, E> {
        // Nothing bare: colours say nothing of the ground.
        let Some(terrain) = terrain else { return Ok(self.wide()) };
        let options = &self.options;
        let usual = usual_height_m(&self.cells_of(Pass::Coarse), terrain, options, store)?;
        // Without colours all sure cells are asked, most of which are ground.
        let higher = if options.prior == Prior::None { 1.0 } else { HIGHER };
        let span = (higher * usual).max(MIN_TOP_M) + 2.0 * SPARE_M;
        let (layer_m, layers) = DenseOptions::layers_over(span, self.cells.cell_m, LAYERS);
        Ok(DenseOptions {
            layer_m,
            layers,
            lowest_m: -SPARE_M,
            block_cells: DenseOptions::default().block_cells,
            prior: options.prior,
            posterior: PosteriorOptions::default(),
            ..self.wide()
        })
    }

    /// Tiles of the second pass.
    fn surface(
        &self,
        album: &mut Album<'_, E>,
        numbers: Range<usize>,
        (terrain, fine): (Option<&Terrain>, &DenseOptions),
        store: &mut dyn TileStore<E>,
        done: &mut dyn FnMut(),
    ) -> Result<(), E> {
        let ground = |place: [f64; 2]| match terrain {
            Some(terrain) => terrain.at_m(place),
            None => (self.base)(place),
        };
        for number in numbers {
            let part = self.part(Pass::Fine, number);
            if kept(store, (Pass::Fine, number), &part)?.is_none() {
                let coarse = store.load(Pass::Coarse, self.coarse_of(number))?;
                let relief = coarse.map(|found| Relief::new(found, &part));
                let found = match_part(album, &ground, &part, fine, relief.as_ref())?;
                store.save(Pass::Fine, number, &found)?;
            }
            done();
        }
        Ok(())
    }

    /// The tile of the coarse pass in which a tile of the fine pass lies.
    fn coarse_of(&self, number: usize) -> usize {
        let side = self.options.tile_cells;
        let [column, row] = starts(self.cells.size, side)[number].map(|start| start / (2 * side));
        row * self.cells_of(Pass::Coarse).size[0].div_ceil(side) + column
    }
}

/// The height above the ground that what surely stands on it usually does not exceed, from the tiles of the coarse pass.
fn usual_height_m<E>(
    coarse: &Tile,
    terrain: &Terrain,
    options: &AreaOptions,
    store: &mut dyn TileStore<E>,
) -> Result<f64, E> {
    let mut counts = HeightCounts::new(CLASS_M);
    for number in 0..starts(coarse.size, options.tile_cells).len() {
        let Some(found) = store.load(Pass::Coarse, number)? else { continue };
        for at in 0..found.surface_m.len() {
            let green = greenness(found.colour[at]);
            if found.confidence[at] < MIN_HEIGHT_CONFIDENCE
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
pub fn starts([width, height]: [usize; 2], tile_cells: usize) -> Vec<[usize; 2]> {
    let side = tile_cells.max(1);
    let rows = (0..height).step_by(side);
    rows.flat_map(|row| (0..width).step_by(side).map(move |column| [column, row])).collect()
}

/// What is kept of a tile with these cells.
fn kept<E>(
    store: &mut dyn TileStore<E>,
    (pass, number): (Pass, usize),
    part: &Tile,
) -> Result<Option<DenseTile>, E> {
    Ok(store.load(pass, number)?.filter(|found| found.tile == *part))
}

/// Matches a tile; nothing but NaN where no two photos show it.
fn match_part<E: From<MapError> + Send>(
    album: &mut Album<'_, E>,
    ground: &(dyn Fn([f64; 2]) -> Option<f64> + Sync),
    part: &Tile,
    options: &DenseOptions,
    relief: Option<&Relief>,
) -> Result<DenseTile, E> {
    let views: Vec<&View> = album.views.iter().collect();
    let mut needed: Vec<usize> = tile::blocks(&views, ground, part, options)
        .into_iter()
        .filter_map(|(_, plane)| block::choose(&views, &plane, options.others))
        .flat_map(|(reference, others)| std::iter::once(reference).chain(others))
        .collect();
    needed.sort_unstable();
    needed.dedup();
    if needed.len() < 2 {
        return Ok(tile::nothing(part));
    }
    album.open(&needed)?;
    Ok(match_tile(&album.posed(), ground, part, options, relief)?)
}
