//! One block of cells: which photos, what they say, and where their points fall on the ground.

use super::{
    DenseOptions, MAX_LAYERS, Relief,
    aggregate::aggregate,
    cost_volume::CostVolume,
    joins::Margin,
    matched::PosedPhoto,
    posterior::{self, Pixels},
    rectify::{BlockPlane, colours, greenness, rectify},
    relief::Colours,
    sweep::{MAX_OTHERS, REACH, Rectified, costs, transfer},
};
use crate::mapping::View;
use std::ops::Range;

/// Cells beyond the core of a block that its neighbours have too, so that paths begin before it.
const OVERLAP: usize = 16;
/// Photos closer to the reference than this, per height of flight, say little of heights.
const MIN_BASE: f64 = 0.05;
/// How far from its middle the pixels of leaves reach, in cells: at their edges they share pixels with soil.
const LEAF_REACH: f64 = 0.75;

/// Of the pixels that fall on a cell the one stays that is highest when lowered by so many of its standard deviations: a wrong match does
/// not hide what is sure.
const LOWERED: f32 = 1.0;
/// Standard deviations of leaves are so many times what costs say, since some matches are wrong. Chosen on the synthetic flights of seeds 1 to 3
/// of `docs/accuracy.md` (`benches/surface/compare.py`), where errors are 1.6 to 2.0 times what is stated without it.
const LEAF_SIGMA_FACTOR: f32 = 1.7;

/// What was found for the cells of a block, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct Block {
    /// Height of the first surface, metres; NaN where not known.
    pub height_m: Vec<f32>,
    /// How much better the best height is than any other, 0 to 255; 0 where a height was filled in.
    pub confidence: Vec<u8>,
    /// How many photos show the cell, of those compared.
    pub photos: Vec<u8>,
    /// Standard deviation of the height relative to its neighbours, metres; NaN where not known.
    pub sigma_m: Vec<f32>,
    /// Red, green, blue of what is seen; black where nothing is.
    pub colour: Vec<[u8; 3]>,
    /// Heights around it.
    pub margin: Margin,
}

/// Cost volumes that blocks reuse.
#[derive(Debug, Default)]
pub(super) struct BlockBuffers {
    costs: CostVolume,
    sums: CostVolume,
}

/// A surface of larger cells that says which heights places may have besides usual ones above the ground, metres.
pub(super) type Limits<'a> = (&'a Relief, [f64; 2]);

/// Matches a block from its reference and the others ([`choose`]); `ground` gives the height of the ground at a place, for the prior.
/// `None` where the reference is not well above all layers.
pub(super) fn match_block(
    photos: &[PosedPhoto<'_>],
    (reference, others): (usize, &[usize]),
    core: &BlockPlane,
    ground: &dyn Fn([f64; 2]) -> Option<f64>,
    options: &DenseOptions,
    limits: Option<Limits<'_>>,
    buffers: &mut BlockBuffers,
) -> Option<Block> {
    let layers = options.layers.clamp(2, MAX_LAYERS);
    let heights_m: Vec<f64> =
        (0..layers).map(|k| options.lowest_m + options.layer_m * k as f64).collect();
    let ends_m = [heights_m[0], heights_m[layers - 1]];
    let margins = margins(photos[reference], core, ends_m)?;
    let size = [0, 1].map(|k| core.size[k] + margins[k].iter().sum::<usize>());
    let [width, height] = size;
    let whole = core.window(margins.map(|[before, _]| -(before as isize)), size);
    let picture = rectify(photos[reference], &whole, options.samples);
    let colour = colours(photos[reference], &whole, options.samples);
    let green: Vec<i16> = colour.iter().copied().map(greenness).collect();
    let others: Vec<Rectified> = others
        .iter()
        .map(|&k| {
            let (first, size) = reach(&picture, photos[k], &whole, ends_m);
            let window = whole.window(first, size);
            rectify(photos[k], &window, options.samples).placed(first)
        })
        .collect();
    let BlockBuffers { costs: volume, sums } = buffers;
    costs(&picture, &others, &heights_m, volume);
    let mut ground_m = Vec::new();
    if options.prior.needs_ground() {
        ground_m = ground_above(&whole, ground);
        options.prior.add(volume, &green, &ground_m, &heights_m);
    }
    let mut standing = vec![];
    if let Some((relief, usual)) = limits {
        let farther = options.lowest_m < usual[0] || options.highest_m() > usual[1];
        let limits = relief.limits(&whole, (usual, farther), &options.prior, ground);
        let of_colours = Colours {
            centre: picture.centre,
            above_m: picture.above_m,
            prior: &options.prior,
            green: &green,
            ground_m: &ground_m,
        };
        standing = limits.apply(volume, &whole, &of_colours, &heights_m);
    }
    let class: Vec<u8> = (0..width * height)
        .map(|at| match (picture.values[at], &options.prior) {
            (0, _) => posterior::CLASSES as u8,
            _ if standing.get(at) == Some(&true) => posterior::UNSURE,
            (_, prior) => prior.class(green[at]),
        })
        .collect();
    let to_layer = |z: f32| (z - options.lowest_m as f32) / options.layer_m as f32;
    let ground_layers: Vec<f32> = ground_m.into_iter().map(to_layer).collect();
    let pixels = Pixels { class: &class, ground: &ground_layers };
    aggregate(volume, &picture.values, &options.penalties, sums);
    let best = posterior::estimates(sums, &pixels, &options.posterior);
    // Each pixel of the reference to its cells; what surely is the highest stays.
    let mut top_m = vec![f32::NEG_INFINITY; width * height];
    let mut rank_m = vec![f32::NEG_INFINITY; width * height];
    let mut from = vec![usize::MAX; width * height];
    for row in REACH..height - REACH {
        for column in REACH..width - REACH {
            let at = row * width + column;
            if picture.values[at] == 0 {
                continue;
            }
            let z = options.lowest_m + options.layer_m * f64::from(best[at].layer);
            let share = z / picture.above_m;
            let [u, v] = [column as f64, row as f64];
            let [u, v] = [u + (picture.centre[0] - u) * share, v + (picture.centre[1] - v) * share];
            let half = if options.prior.is_leaf(green[at]) { LEAF_REACH } else { 0.5 };
            let [columns, rows] = [(u, width), (v, height)].map(|(c, n)| within(c, half, n));
            let rank = z as f32 - LOWERED * best[at].sigma * options.layer_m as f32;
            for j in rows {
                for i in columns.clone() {
                    let cell = j * width + i;
                    if rank > rank_m[cell] {
                        rank_m[cell] = rank;
                        (top_m[cell], from[cell]) = (z as f32, at);
                    }
                }
            }
        }
    }
    let [columns, rows] = core.size;
    let cells = columns * rows;
    let mut block = Block {
        height_m: vec![f32::NAN; cells],
        confidence: vec![0; cells],
        photos: vec![0; cells],
        sigma_m: vec![f32::NAN; cells],
        colour: vec![[0; 3]; cells],
        margin: Margin::unknown(core.size),
    };
    let in_whole = |cell: [isize; 2]| [0, 1].map(|k| (cell[k] + margins[k][0] as isize) as usize);
    // Hidden in the reference: what is behind, so the lowest beside it.
    let lowest_beside = |[u, v]: [usize; 2]| {
        let rows = (v - 1..=v + 1).map(|j| &top_m[j * width + u - 1..=j * width + u + 1]);
        rows.flatten().copied().filter(|z| z.is_finite()).fold(f32::INFINITY, f32::min)
    };
    let above_plane = |cell: [isize; 2], z: f32| {
        (f64::from(z) + core.at_m(core.place_m(cell.map(|n| n as f64)))) as f32
    };
    // The cell whose height a cell takes. Only in the last pass: those of larger cells are about trees, houses and the ground, and were not compared.
    let taken_from = |[u, v]: [usize; 2]| -> usize {
        let own = v * width + u;
        if options.prior.needs_ground() { third_lowest(&top_m, own, width) } else { own }
    };
    for cell in Margin::places(core.size) {
        let [u, v] = in_whole(cell);
        let own_m = top_m[v * width + u];
        let z = if own_m.is_finite() { top_m[taken_from([u, v])] } else { lowest_beside([u, v]) };
        if z.is_finite() {
            block.margin.set(cell, above_plane(cell, z));
        }
    }
    for row in 0..rows {
        for column in 0..columns {
            let cell = [column as isize, row as isize];
            let (out, [u, v]) = (row * columns + column, in_whole(cell));
            let z;
            let own = from[v * width + u];
            if own != usize::MAX {
                let chosen = taken_from([u, v]);
                let source = from[chosen];
                z = top_m[chosen];
                // Ten paths of 72 at most; a margin of a fifth of that is as sure as it gets.
                block.confidence[out] = (f32::from(best[source].margin) * 1.6).min(255.0) as u8;
                // What is seen there stays what is seen there.
                block.colour[out] = colour[own];
                let is_leaf = options.prior.is_leaf(green[source]);
                let factor = if is_leaf { LEAF_SIGMA_FACTOR } else { 1.0 };
                block.sigma_m[out] = factor * best[source].sigma * options.layer_m as f32;
            } else {
                z = lowest_beside([u, v]);
            }
            if z.is_finite() {
                block.height_m[out] = above_plane(cell, z);
            }
            let seen = |other: &&Rectified| other.at([u, v]) > 0;
            let reference = u8::from(picture.values[v * width + u] > 0);
            block.photos[out] = reference + others.iter().filter(seen).count() as u8;
        }
    }
    Some(block)
}

/// Height of the ground above the plane of a block at every cell, metres: bilinear between every fourth cell. NaN where the ground is not known at
/// one of the four around it.
fn ground_above(block: &BlockPlane, ground: &dyn Fn([f64; 2]) -> Option<f64>) -> Vec<f32> {
    // A third of the distance of the nodes of the ground at most (`tile::node_m`: six coarse cells are twelve of these).
    const SPACING_CELLS: usize = 4;
    let [width, height] = block.size;
    let nodes = width.div_ceil(SPACING_CELLS) + 1;
    let node = |column: usize, row: usize| {
        let place = block.place_m([column, row].map(|n| (n * SPACING_CELLS) as f64));
        ground(place).map_or(f32::NAN, |z| (z - block.at_m(place)) as f32)
    };
    let line = |row: usize| -> Vec<f32> { (0..nodes).map(|column| node(column, row)).collect() };
    let (mut above, mut below) = (line(0), line(1));
    let mut out = vec![f32::NAN; width * height];
    for (row, out) in out.chunks_exact_mut(width).enumerate() {
        if row.is_multiple_of(SPACING_CELLS) && row > 0 {
            above = std::mem::replace(&mut below, line(row / SPACING_CELLS + 1));
        }
        let share = (row % SPACING_CELLS) as f32 / SPACING_CELLS as f32;
        let at = |k: usize| above[k] + share * (below[k] - above[k]);
        for (k, out) in out.chunks_mut(SPACING_CELLS).enumerate() {
            let (left, right) = (at(k), at(k + 1));
            for (i, out) in out.iter_mut().enumerate() {
                *out = left + i as f32 / SPACING_CELLS as f32 * (right - left);
            }
        }
    }
    out
}

/// Of a cell and its eight neighbours the one with the third lowest known height; where fewer than nine are known, the one at the same share of the order. Matching
/// makes leaves wider than they are, probably through the census window and because each cell keeps the highest of the points that fall on it. With its own
/// height, 17 to 42 % of the soil cells beside leaves are off by more than 7.5 cm, and the 95th percentile of the heights of squares is 2.0 to 3.4 cm too great
/// (synthetic flights of seeds 1 to 3 of `docs/accuracy.md`, `benches/surface/compare.py`); with the third lowest 12 to 35 %, and the bias is 0.7 cm at most. Other ranks:
/// `docs/decisions.md`.
fn third_lowest(top_m: &[f32], own: usize, width: usize) -> usize {
    let mut lowest = [(f32::INFINITY, own); 3];
    let mut known = 0;
    for from in [own - width - 1, own - 1, own + width - 1] {
        for at in from..from + 3 {
            if !top_m[at].is_finite() {
                continue;
            }
            known += 1;
            let mut moved = (top_m[at], at);
            for place in &mut lowest {
                if moved.0 < place.0 {
                    std::mem::swap(&mut moved, place);
                }
            }
        }
    }
    lowest[2 * known / 9].1
}

/// The cells, of so many, whose middles are within half a width of a position. Without roundings, which are calls where the processor need
/// not have them.
#[inline(always)]
fn within(position: f64, half: f64, cells: usize) -> Range<usize> {
    // A negative number becomes 0.
    let (low, high) = (position - half, position + half);
    let first = low as usize;
    let first = first + usize::from((first as f64) < low);
    let end = if high < 0.0 { 0 } else { (high as usize + 1).min(cells) };
    first..end
}

/// The reference, nearest in plan to the middle, and the nearest others that show at least the inner half.
pub(super) fn choose(
    views: &[&View],
    block: &BlockPlane,
    count: usize,
) -> Option<(usize, Vec<usize>)> {
    let at = |share: [f64; 2]| {
        let [x, y] = block.place_m([0, 1].map(|k| share[k] * block.size[k] as f64));
        [x, y, block.at_m([x, y])]
    };
    let middle = at([0.5, 0.5]);
    const INNER: [[f64; 2]; 4] = [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]];
    let away = |from: [f64; 3], k: usize| {
        let c = views[k].centre_m();
        (c[0] - from[0]).hypot(c[1] - from[1])
    };
    let mut near: Vec<usize> = (0..views.len())
        .filter(|&k| INNER.iter().all(|&share| views[k].pixel(at(share)).is_some()))
        .collect();
    near.sort_by(|&a, &b| away(middle, a).total_cmp(&away(middle, b)).then(a.cmp(&b)));
    let reference = *near.first()?;
    let centre = views[reference].centre_m();
    let least_m = MIN_BASE * (centre[2] - middle[2]);
    let others: Vec<usize> = near[1..]
        .iter()
        .copied()
        .filter(|&k| away(centre, k) >= least_m)
        .take(count.min(MAX_OTHERS))
        .collect();
    (!others.is_empty()).then_some((reference, others))
}

/// Cells before and behind a block, along columns and rows, whose pixels of the reference may show points of the block; `ends_m` are the lowest
/// and the highest layer. `None` where the photo is not well above all layers.
fn margins(photo: PosedPhoto<'_>, block: &BlockPlane, ends_m: [f64; 2]) -> Option<[[usize; 2]; 2]> {
    let [x, y, z] = photo.view.centre_m();
    let above_m = z - block.at_m([x, y]);
    let most = ends_m[0].abs().max(ends_m[1].abs());
    if above_m <= 2.0 * most {
        return None;
    }
    let centre = block.cell([x, y]);
    // The point X at the height h is seen at p = (X - C h/F) / (1 - h/F).
    let moved = |k: usize, end: f64| {
        ends_m.map(|h| h / above_m).map(|share| share * (end - centre[k]) / (1.0 - share))
    };
    Some([0, 1].map(|k| {
        let before = moved(k, 0.0).into_iter().fold(0.0, f64::min);
        let behind = moved(k, block.size[k] as f64).into_iter().fold(0.0, f64::max);
        [-before, behind].map(|cells| OVERLAP + cells.ceil() as usize + 1)
    }))
}

/// First column and row, and how many of them, that another photo needs for all layers and for the plane itself.
fn reach(
    reference: &Rectified,
    photo: PosedPhoto<'_>,
    block: &BlockPlane,
    ends_m: [f64; 2],
) -> ([isize; 2], [usize; 2]) {
    let centre = photo.view.centre_m();
    let other = Rectified {
        values: Vec::new(),
        width: 0,
        height: 0,
        origin: [0; 2],
        centre: block.cell([centre[0], centre[1]]),
        above_m: centre[2] - block.at_m([centre[0], centre[1]]),
    };
    let (mut low, mut high) = ([0.0f64; 2], block.size.map(|n| n as f64));
    for height_m in ends_m {
        let (scale, offset) = transfer(reference, &other, height_m);
        for k in 0..2 {
            low[k] = low[k].min(offset[k]);
            high[k] = high[k].max(scale * block.size[k] as f64 + offset[k]);
        }
    }
    // A photo far away or hardly above the plane shows nothing useful beyond twice the block.
    let far = 2.0 * block.size[0].max(block.size[1]) as f64;
    let first = low.map(|low| low.max(-far).floor() as isize - 2);
    let size = [0, 1].map(|k| {
        let end = high[k].min(block.size[k] as f64 + far).ceil() as isize + 2;
        (end - first[k]) as usize
    });
    (first, size)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_takes_the_third_lowest_height_that_is_known_around_it() {
        const UNKNOWN: f32 = f32::NEG_INFINITY;
        // A leaf over two columns; where it is beside soil, six of nine cells show the soil.
        let mut top_m = [
            [0.02, 0.0, 0.01, 0.3, 0.31],
            [0.0, 0.01, 0.02, 0.32, 0.3],
            [0.01, 0.02, 0.0, 0.3, 0.33],
        ];
        let taken = |top_m: &[[f32; 5]; 3], column: usize| {
            let flat = top_m.as_flattened();
            flat[third_lowest(flat, 5 + column, 5)]
        };
        assert_eq!([1, 2, 3].map(|column| taken(&top_m, column)), [0.0, 0.01, 0.02]);
        // Inside a leaf its own heights are left.
        top_m = top_m.map(|row| [row[0], row[3], row[4], row[3], row[1]]);
        assert_eq!(taken(&top_m, 2), 0.3);
        // Of five the second lowest, of one that one.
        top_m[0] = [UNKNOWN; 5];
        top_m[1][1] = UNKNOWN;
        assert_eq!(taken(&top_m, 2), 0.3);
        top_m = [[UNKNOWN; 5]; 3];
        top_m[1][2] = 0.4;
        assert_eq!(taken(&top_m, 2), 0.4);
    }
}
