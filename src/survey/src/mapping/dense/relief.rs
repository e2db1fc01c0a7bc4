//! How far the layers of a block have to reach, from a surface of larger cells.
//!
//! ```text
//! low  = q_01 of (z_c - plane) - 4 s   where that percentile is below the usual lowest layer
//! high = q_99 of (z_c - plane) + 4 s   where that percentile is above the usual highest layer
//! ```
//!
//! over the larger cells `c` of side `s` on the block, whose heights `z_c` are medians of what surely stands around them: trees, houses
//! and cliffs get layers of their own, and single wrong matches do not. Of these layers each pixel may take the usual ones, and those
//! near the larger cells around its place; where larger cells are not sure, only the usual ones. Near larger cells that stand on the ground
//! nothing has to be green where they are not: walls, roofs, ripe crops. Reference: M. Rothermel, K. Wenzel, D. Fritsch, N. Haala,
//! *MIN_VOTING_CONFIDENCE: photogrammetric surface reconstruction from imagery*, 2012 (ranges that a coarser level of a pyramid gives).

use super::{
    DenseOptions, DenseTile, LAYERS, MAX_LAYERS, Prior, Tile,
    cost_volume::CostVolume,
    rectify::{BlockPlane, greenness},
    sweep::WORST,
};
use std::ops::Range;

// All numbers below were chosen while looking at the surfaces of three real flights (docs/accuracy.md), not by a measured optimum; on four
// synthetic flights (`benches/surface/compare.py twin`) they change less than two in a hundred of the leaf cells within 5 cm.
/// Confidence (of 255) from which a cell has a say.
const MIN_VOTING_CONFIDENCE: u8 = 100;
/// Cells around a cell, in each direction, whose median is its height.
const AROUND: usize = 2;
/// Sure cells among those 25, at least.
const MIN_SHARE_OF_CONFIDENT: usize = 9;
/// The most that the prior adds to a cost: the larger of the defaults of [`Prior::GreenOnSoil`].
const MAX_PRIOR: u8 = 20;
/// What layers cost that a place cannot have: more than those in which nothing fits, with all that the prior may add.
const FORBIDDEN: u8 = WORST + MAX_PRIOR;
/// Share of the cells of a block left out at either end.
const TAIL: f64 = 0.01;
/// What layers reach beyond that, in cells of the surface that says how far.
const SPARE_CELLS: f64 = 4.0;
/// Height above the ground from which something stands on it whatever its colour, in cells of the surface that says so.
const STANDS_CELLS: f32 = 4.0;

/// A surface of larger cells than those that are matched.
#[derive(Debug, Clone)]
pub struct Relief {
    found: DenseTile,
    /// Median height of the sure cells around each cell, metres; NaN where there are few.
    height_m: Vec<f32>,
}

/// Which heights each place of a block may have.
#[derive(Debug)]
pub(super) struct Limits {
    tile: Tile,
    /// Columns and rows of the tile that they are of.
    columns: Range<usize>,
    rows: Range<usize>,
    /// Least and greatest height, metres: the usual ones, those near larger cells, and those near larger cells that stand on the ground.
    usual_m: Vec<[f32; 2]>,
    sure_m: Vec<[f32; 2]>,
    standing_m: Vec<[f32; 2]>,
    /// Whether layers reach beyond the usual ones.
    farther: bool,
}

/// The reference of a block and what its colours say.
#[derive(Debug, Clone, Copy)]
pub(super) struct Colours<'a> {
    /// Its projection centre in plan, cells, and its height above the plane, metres.
    pub centre: [f64; 2],
    pub above_m: f64,
    /// The costs that colours have added.
    pub prior: &'a Prior,
    /// Greenness of each pixel, and height of the ground above the plane (empty where the prior does not need it), metres.
    pub green: &'a [i16],
    pub ground_m: &'a [f32],
}

impl Colours<'_> {
    fn added(&self, pixel: usize, height_m: f64) -> u8 {
        let of = |ground_m: &f32| self.prior.cost(self.green[pixel], height_m as f32 - ground_m);
        self.ground_m.get(pixel).map_or(0, of)
    }
}

impl Limits {
    /// Whether they change anything: layers reach farther than usual, or something stands.
    fn matter(&self) -> bool {
        self.farther || self.standing_m.iter().any(|[low, high]| low < high)
    }

    /// Forbids what no place of a block may have, and takes back what colours have added where something stands. Gives the pixels that may show what stands; none where nothing does.
    pub(super) fn apply(
        &self,
        volume: &mut CostVolume,
        block: &BlockPlane,
        colours: &Colours<'_>,
        heights_m: &[f64],
    ) -> Vec<bool> {
        // A block beyond the larger cells has no limits.
        if !self.matter() || self.columns.is_empty() || self.rows.is_empty() {
            return vec![];
        }
        let Colours { centre, above_m, .. } = *colours;
        let [width, height] = block.size;
        let [first, step] = [[0.0, 0.0], [1.0, 1.0]].map(|at| {
            let [x, y] = block.place_m(at);
            let tile = &self.tile;
            [(x - tile.corner_m[0]) / tile.cell_m, (tile.corner_m[1] - y) / tile.cell_m]
        });
        let step = [step[0] - first[0], step[1] - first[1]];
        let clamp = |at: f64, range: &Range<usize>| {
            (at.round().max(range.start as f64) as usize).min(range.end - 1) - range.start
        };
        // What all places along a row of larger cells may have, and whether something stands on any.
        let along_row: Vec<([f32; 2], bool)> = (0..self.rows.len())
            .map(|row| {
                let of = row * self.columns.len()..(row + 1) * self.columns.len();
                let all = self.usual_m[of.clone()].iter();
                let all = all.fold([f32::NEG_INFINITY, f32::INFINITY], |all, usual| {
                    [all[0].max(usual[0]), all[1].min(usual[1])]
                });
                (all, self.standing_m[of].iter().any(|[low, high]| low < high))
            })
            .collect();
        let mut columns = vec![0; width];
        let mut standing = vec![false; width * height];
        for (layer, &h) in heights_m.iter().enumerate() {
            let share = h / above_m;
            let along = |k: usize, c: f64| first[k] + step[k] * (c + (centre[k] - c) * share);
            for (u, column) in columns.iter_mut().enumerate() {
                *column = clamp(along(0, u as f64), &self.columns);
            }
            for v in 0..height {
                let larger = clamp(along(1, v as f64), &self.rows);
                // The plane rises evenly along a row, so two places give all.
                let at = |u: f64| {
                    let [u, v] = [(u, 0), (v as f64, 1)].map(|(c, k)| c + (centre[k] - c) * share);
                    h + block.at_m(block.place_m([u, v]))
                };
                let (start_m, rise_m) = (at(0.0) as f32, (at(1.0) - at(0.0)) as f32);
                let (all_m, stands) = along_row[larger];
                let end_m = start_m + rise_m * (width - 1) as f32;
                let usual = start_m.min(end_m) >= all_m[0] && start_m.max(end_m) <= all_m[1];
                if !stands && (usual || !self.farther) {
                    continue;
                }
                let from = larger * self.columns.len();
                for (u, &column) in columns.iter().enumerate() {
                    let z = start_m + rise_m * u as f32;
                    let within = |limits: &[[f32; 2]]| {
                        let [low, high] = limits[from + column];
                        z >= low && z <= high
                    };
                    if within(&self.standing_m) {
                        let pixel = v * width + u;
                        let cost = volume.at_mut([u, v], layer);
                        *cost = cost.saturating_sub(colours.added(pixel, h));
                        standing[pixel] = true;
                    } else if self.farther && !within(&self.usual_m) && !within(&self.sure_m) {
                        *volume.at_mut([u, v], layer) = FORBIDDEN;
                    }
                }
            }
        }
        standing
    }
}

impl Relief {
    /// Of a matched tile, for blocks that lie in `part`.
    pub fn new(found: DenseTile, part: &Tile) -> Relief {
        let [width, height] = found.tile.size;
        let mut height_m = vec![f32::NAN; width * height];
        let mut around = Vec::with_capacity((2 * AROUND + 1).pow(2));
        let [columns, rows] =
            under(&found.tile, part.corner_m, part.size.map(|n| n as f64 * part.cell_m));
        for row in rows {
            for column in columns.clone() {
                around.clear();
                for j in row.saturating_sub(AROUND)..(row + AROUND + 1).min(height) {
                    for i in column.saturating_sub(AROUND)..(column + AROUND + 1).min(width) {
                        let at = j * width + i;
                        if found.confidence[at] >= MIN_VOTING_CONFIDENCE
                            && found.surface_m[at].is_finite()
                        {
                            around.push(found.surface_m[at]);
                        }
                    }
                }
                if around.len() >= MIN_SHARE_OF_CONFIDENT {
                    let middle = around.len() / 2;
                    height_m[row * width + column] =
                        *around.select_nth_unstable_by(middle, f32::total_cmp).1;
                }
            }
        }
        Relief { found, height_m }
    }

    /// Indices of the cells on a block.
    fn cells(&self, block: &BlockPlane) -> impl Iterator<Item = usize> + use<> {
        let width = self.found.tile.size[0];
        let size_m = block.size.map(|n| n as f64 * block.cell_m);
        let [columns, rows] = under(&self.found.tile, block.corner_m, size_m);
        rows.flat_map(move |row| columns.clone().map(move |column| row * width + column))
    }

    /// The least and the greatest height above the plane of a block, metres; `None` where nothing is known.
    fn range_m(&self, block: &BlockPlane) -> Option<[f64; 2]> {
        let tile = &self.found.tile;
        let above = |at: usize| {
            let place = tile.place_m(at % tile.size[0], at / tile.size[0]);
            f64::from(self.height_m[at]) - block.at_m(place)
        };
        let mut heights: Vec<f64> =
            self.cells(block).map(above).filter(|z| z.is_finite()).collect();
        heights.sort_by(f64::total_cmp);
        let last = heights.len().checked_sub(1)?;
        let cut = (TAIL * last as f64).round() as usize;
        Some([heights[cut], heights[last - cut]])
    }

    /// What places on a block may have; `usual` is above the ground, metres, and `farther` whether the layers reach beyond.
    pub(super) fn limits(
        &self,
        block: &BlockPlane,
        (usual, farther): ([f64; 2], bool),
        prior: &Prior,
        ground: &dyn Fn([f64; 2]) -> Option<f64>,
    ) -> Limits {
        let tile = self.found.tile;
        let size_m = block.size.map(|n| n as f64 * block.cell_m);
        let [columns, rows] = under(&tile, block.corner_m, size_m);
        let spare = (SPARE_CELLS * tile.cell_m) as f32;
        const NOTHING: [f32; 2] = [f32::INFINITY, f32::NEG_INFINITY];
        let stands_m = STANDS_CELLS * tile.cell_m as f32;
        let is_sure = |at: usize| self.found.confidence[at] >= MIN_VOTING_CONFIDENCE;
        let is_leaf = |at: usize| prior.is_leaf(greenness(self.found.colour[at]));
        let places = rows.clone().flat_map(|row| columns.clone().map(move |column| [column, row]));
        let ground_m: Vec<Option<f64>> =
            places.map(|[column, row]| ground(tile.place_m(column, row))).collect();
        if !farther {
            // Mostly nothing is as high above the lowest ground, and nothing is limited.
            let lowest = ground_m.iter().flatten().fold(f64::INFINITY, |low, &z| low.min(z));
            let may_stand = |at: usize| {
                is_sure(at) && self.found.surface_m[at] - lowest as f32 > stands_m && !is_leaf(at)
            };
            let [wider, higher] = [(&columns, tile.size[0]), (&rows, tile.size[1])]
                .map(|(of, n)| of.start.saturating_sub(AROUND)..(of.end + AROUND).min(n));
            let mut cells =
                higher.flat_map(|row| wider.clone().map(move |column| row * tile.size[0] + column));
            if !(prior.needs_ground() && cells.any(may_stand)) {
                let none = || Vec::new();
                let (usual_m, sure_m, standing_m) = (none(), none(), none());
                return Limits { tile, columns, rows, usual_m, sure_m, standing_m, farther };
            }
        }
        let mut ground_m = ground_m.into_iter();
        let (mut usual_m, mut sure_m, mut standing_m) = (Vec::new(), Vec::new(), Vec::new());
        for row in rows.clone() {
            for column in columns.clone() {
                let z = ground_m.next().flatten();
                usual_m.push(z.map_or(NOTHING, |z| usual.map(|h| (z + h) as f32)));
                let mut limits = NOTHING;
                let (mut sure, mut standing) = (0, 0);
                for j in row.saturating_sub(AROUND)..(row + AROUND + 1).min(tile.size[1]) {
                    for i in column.saturating_sub(AROUND)..(column + AROUND + 1).min(tile.size[0])
                    {
                        let at = j * tile.size[0] + i;
                        let top = self.height_m[at];
                        if top.is_finite() {
                            limits = [limits[0].min(top - spare), limits[1].max(top + spare)];
                        }
                        if is_sure(at) {
                            let stands =
                                z.is_some_and(|z| self.found.surface_m[at] - z as f32 > stands_m);
                            sure += 1;
                            standing += usize::from(stands && !is_leaf(at));
                        }
                    }
                }
                sure_m.push(limits);
                let stands =
                    prior.needs_ground() && sure >= MIN_SHARE_OF_CONFIDENT && 2 * standing > sure;
                standing_m.push(if stands { limits } else { NOTHING });
            }
        }
        Limits { tile, columns, rows, usual_m, sure_m, standing_m, farther }
    }

    /// The plane and the options of a block. Where layers reach farther than usual, the plane is in the middle of them.
    pub(super) fn fit(
        &self,
        block: &BlockPlane,
        options: &DenseOptions,
    ) -> (BlockPlane, DenseOptions) {
        let (mut block, mut options) = (*block, *options);
        let usual = [options.lowest_m, options.highest_m()];
        let Some([low, high]) = self.range_m(&block) else { return (block, options) };
        if low >= usual[0] && high <= usual[1] {
            return (block, options);
        }
        let spare = SPARE_CELLS * self.found.tile.cell_m;
        let low = if low < usual[0] { low - spare } else { usual[0] };
        let high = if high > usual[1] { high + spare } else { usual[1] };
        let span = high - low;
        if span > options.layer_m * (LAYERS - 1) as f64 {
            options.layer_m = options.layer_m.max(block.cell_m).max(span / (MAX_LAYERS - 1) as f64);
        }
        options.layers = (span / options.layer_m).ceil() as usize + 1;
        block.height_m += 0.5 * (low + high);
        options.lowest_m = -0.5 * span;
        (block, options)
    }
}

/// Columns and rows of the cells of a tile in a rectangle whose north-western corner is given, and one more around it.
fn under(tile: &Tile, corner_m: [f64; 2], size_m: [f64; 2]) -> [Range<usize>; 2] {
    let first = [corner_m[0] - tile.corner_m[0], tile.corner_m[1] - corner_m[1]];
    [0, 1].map(|k| {
        let from = (first[k] / tile.cell_m - 1.0).floor().max(0.0) as usize;
        let to = ((first[k] + size_m[k]) / tile.cell_m + 2.0).max(0.0) as usize;
        from..to.min(tile.size[k])
    })
}

#[cfg(test)]
mod tests {
    use super::super::tile::nothing;
    use super::*;

    /// Level ground of 40 x 40 cells of 0.2 m with a house 5 m high on 10 x 10 of them, and single wrong matches.
    fn relief(wrong: bool) -> Relief {
        let tile = Tile { corner_m: [100.0, 200.0], cell_m: 0.2, size: [40, 40] };
        let mut found = nothing(&tile);
        for at in 0..1600 {
            let [u, v] = [at % 40, at / 40];
            let house = (10..20).contains(&u) && (10..20).contains(&v);
            found.surface_m[at] = if house { 55.0 } else { 50.0 };
            if wrong && u % 7 == 0 && v % 5 == 0 {
                found.surface_m[at] = 80.0;
            }
            found.confidence[at] = 200;
            found.colour[at] = [120, 110, 100];
        }
        Relief::new(found, &tile)
    }

    fn block(corner_m: [f64; 2]) -> BlockPlane {
        BlockPlane { corner_m, cell_m: 0.05, size: [40, 40], height_m: 50.0, slope: [0.0; 2] }
    }

    fn sevens([columns, rows]: [usize; 2], layers: usize) -> CostVolume {
        let mut volume = CostVolume::new([columns, rows], layers);
        for at in 0..columns * rows * layers {
            *volume.at_mut([at % columns, at / columns % rows], at / columns / rows) = 7;
        }
        volume
    }

    #[test]
    fn layers_reach_a_roof_and_not_a_wrong_match() {
        let options =
            DenseOptions { lowest_m: -0.1, layer_m: 0.05, layers: 20, ..Default::default() };
        for wrong in [false, true] {
            let relief = relief(wrong);
            // Away from the house nothing changes.
            let away = block([105.0, 199.0]);
            assert_eq!(relief.fit(&away, &options), (away, options));
            // On it layers go from the ground to the roof.
            let (plane, on) = relief.fit(&block([101.5, 198.5]), &options);
            let low = plane.height_m + on.lowest_m;
            let high = plane.height_m + on.highest_m();
            assert!((low - 49.9).abs() < 0.01 && (55.8..55.86).contains(&high), "{low} {high}");
            assert!((plane.height_m - 0.5 * (49.9 + 55.8)).abs() < 0.01, "{}", plane.height_m);
            assert_eq!(on.layer_m, 0.05);
            assert!(on.layers > LAYERS && on.layers <= MAX_LAYERS);
            // The roof stands on the ground, what is beside the house does not.
            let usual = [options.lowest_m, options.highest_m()];
            let prior = &options.prior;
            let limits = relief.limits(&plane, (usual, true), prior, &|_| Some(50.0));
            let heights_m: Vec<f64> =
                (0..on.layers).map(|k| on.lowest_m + on.layer_m * k as f64).collect();
            let mut volume = sevens(plane.size, on.layers);
            let (green, ground_m) = (vec![-5; 1600], vec![(50.0 - plane.height_m) as f32; 1600]);
            let colours = Colours {
                centre: [20.0; 2],
                above_m: 60.0,
                prior,
                green: &green,
                ground_m: &ground_m,
            };
            prior.add(&mut volume, &green, &ground_m, &heights_m);
            let standing = limits.apply(&mut volume, &plane, &colours, &heights_m);
            assert!(standing[26 * 40 + 26] && !standing[2 * 40 + 2]);
            let cost = |pixel: [usize; 2], z: f64| {
                let layer = ((z - plane.height_m - on.lowest_m) / on.layer_m).round() as usize;
                volume.at(pixel, layer)
            };
            // In the middle of the roof (26, 26): the roof costs what photos say, between is forbidden. Beside the house
            // (2, 2) the ground is free, what stands there costs, and the roof's height is forbidden.
            assert_eq!([55.0, 53.0, 50.0].map(|z| cost([26, 26], z)), [7, FORBIDDEN, 7]);
            assert_eq!([50.0, 50.5, 55.0].map(|z| cost([2, 2], z)), [7, 27, FORBIDDEN]);
        }
    }

    #[test]
    fn beyond_the_larger_cells_nothing_is_limited() {
        let options =
            DenseOptions { lowest_m: -0.1, layer_m: 0.05, layers: 2, ..Default::default() };
        let (relief, away) = (relief(false), block([300.0, 100.0]));
        assert_eq!(relief.fit(&away, &options), (away, options));
        let limits = relief.limits(&away, ([-0.1, 0.0], true), &options.prior, &|_| Some(50.0));
        let colours = Colours {
            centre: [20.0; 2],
            above_m: 60.0,
            prior: &options.prior,
            green: &[0; 1600],
            ground_m: &[],
        };
        let mut volume = sevens([40, 40], 2);
        assert!(limits.apply(&mut volume, &away, &colours, &[-0.1, -0.05]).is_empty());
        assert_eq!(volume, sevens([40, 40], 2));
    }

    #[test]
    fn layers_are_farther_apart_where_they_do_not_reach() {
        let options =
            DenseOptions { lowest_m: -0.1, layer_m: 0.01, layers: 20, ..Default::default() };
        let mut plane = block([101.5, 198.5]);
        plane.cell_m = 0.01;
        plane.size = [200; 2];
        let (_, on) = relief(false).fit(&plane, &options);
        assert!((on.layer_m - 5.9 / 255.0).abs() < 1e-9 && on.layers <= MAX_LAYERS, "{on:?}");
    }
}
