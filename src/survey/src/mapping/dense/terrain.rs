//! The ground under the canopy, from the cells that show it.
//!
//! Nodes `z_i` on a square lattice, as dense as bare patches allow, minimise
//!
//! ```text
//! sum_i w_i rho(z_i - d_i) + lambda sum (second differences of z along rows and columns)^2
//! ```
//!
//! where `d_i` is the height of the bare cells around node `i`, from the lowest quarter of them, since soil beside leaves is matched at the height
//! of the leaves and hardly ever below the ground; `w_i` is their number over their variance (of no more cells than are independent), and
//! `rho` Cauchy's loss by reweighting, so that leaves taken for soil have no say. Where nothing is bare the ground goes on with constant
//! slope, and farther from bare cells than [`GroundPlaces::LOWEST_FROM_M`] it follows the lowest of what stands there (`d_i` the twentieth from below of all cells around the node,
//! with the small weight that has a say from that distance on): meadows, lawns, fields that have closed. Its standard deviation comes from the
//! weights of bare cells near a node, grows with the distance to them, and includes relief finer than the lattice: the median scatter of the bare cells around
//! a node.

use super::lattice::Lattice;
use rayon::prelude::*;
use rowgram_optim::robust::{median, sigma_of_errors};
use std::collections::BTreeMap;

/// Weight of the second differences relative to the usual node: relief of 2.5 nodes keeps four fifths of its height.
const STIFFNESS: f64 = 0.02;
/// Bare cells around a node, at least.
const LEAST_CELLS: usize = 4;
/// Bare cells around a node that count as independent, at most.
const MOST_CELLS: f64 = 25.0;
/// Least standard deviation of a bare cell, metres.
const LEAST_SIGMA_M: f64 = 0.003;
/// Cells around a node of which the lowest stand for the ground where none is bare, at least, and the share of those below it: as robust
/// as a low percentile of so few can be. Not measured.
const LEAST_STANDING: usize = 16;
const LOWEST: f64 = 0.05;
/// The finer lattice is used where its share of nodes with data is at least so much of the wider lattice's: where bare patches are wider than its nodes are
/// apart. On the synthetic flights of docs/accuracy.md the ratio for bare nodes is 0.97 to 0.99 at the mid stage, where the finer lattice keeps the ridges below plants, and
/// 0.86 to 0.87 at the late stage, where it would take leaves for soil. Chosen halfway with all of these in view.
const MIN_SEEN_RATIO: f64 = 0.92;
/// The most nodes of the finer lattice, 9 ha at 0.15 m: fitting takes about 150 bytes each (counted from its arrays, not measured).
const MAX_NODES: usize = 4_000_000;
/// Rounds of reweighting.
const ROUNDS: usize = 5;

/// Heights of the ground on a lattice.
#[derive(Debug, Clone, PartialEq)]
pub struct Terrain {
    /// The first node (north-west), metres.
    pub corner_m: [f64; 2],
    /// Distance of nodes, metres.
    pub node_m: f64,
    /// Columns and rows of nodes.
    pub size: [usize; 2],
    /// Height of each node, metres.
    pub height_m: Vec<f64>,
    /// Standard deviation of the ground around the node about that height, relief finer than the lattice included, metres.
    pub sigma_m: Vec<f64>,
}

/// Places of an area from which its ground is found, gathered part by part.
#[derive(Debug, Clone)]
pub struct GroundPlaces {
    /// The wider lattice, then the one with nodes half as far apart, if it has at most [`MAX_NODES`].
    lattices: Vec<NodePlaces>,
}

/// Places around the nodes of a lattice; nodes whose places have all come keep three numbers.
#[derive(Debug, Clone)]
struct NodePlaces {
    corner_m: [f64; 2],
    node_m: f64,
    size: [usize; 2],
    /// Heights around the nodes that may get more, metres: of bare places, and of what stands on the ground.
    open: BTreeMap<usize, [Vec<f64>; 2]>,
    /// Height of the other nodes, and its weight.
    data: Vec<f64>,
    weight: Vec<f64>,
    /// Scatter of the bare cells around the nodes that have enough of them, metres.
    scatter_m: Vec<f64>,
    /// Nodes that show what stands on the ground only.
    standing: Vec<bool>,
}

impl GroundPlaces {
    /// Farther than so from bare places the ground follows the lowest of what stands on it, metres: half the width of a wide plot.
    /// Waves of the ground 20 times as long keep 99 % of their height. Not measured.
    pub const LOWEST_FROM_M: f64 = 6.0;

    /// None yet; nodes are `node_m` apart, or half of it, and cover `bounds_m` (least and greatest x and y).
    pub fn new(bounds_m: [[f64; 2]; 2], node_m: f64) -> GroundPlaces {
        let is_small = |node_m: &f64| {
            nodes_over(bounds_m, *node_m).into_iter().product::<usize>() <= MAX_NODES
        };
        let finer_m = Some(0.5 * node_m).filter(is_small);
        let distances_m = std::iter::once(node_m).chain(finer_m);
        GroundPlaces { lattices: distances_m.map(|m| NodePlaces::new(bounds_m, m)).collect() }
    }

    /// Adds a place: x, y, z in metres, and whether it is bare.
    pub fn add(&mut self, place_m: [f64; 3], bare: bool) {
        self.lattices.iter_mut().for_each(|lattice| lattice.add(place_m, bare));
    }

    /// All places within `bounds_m` have come.
    pub fn close(&mut self, bounds_m: [[f64; 2]; 2]) {
        self.lattices.iter_mut().for_each(|lattice| lattice.close(bounds_m));
    }

    /// The ground; `None` where no node has enough bare places.
    pub fn fit(self) -> Option<Terrain> {
        let mut chosen: Option<NodePlaces> = None;
        for mut lattice in self.lattices {
            lattice.close_all();
            let seen = lattice.shares_seen();
            let before = chosen.as_ref().map_or([0.0; 2], NodePlaces::shares_seen);
            if (0..2).all(|k| seen[k] >= MIN_SEEN_RATIO * before[k]) {
                chosen = Some(lattice);
            }
        }
        chosen?.fit()
    }
}

/// Columns and rows of nodes over an area.
fn nodes_over(bounds_m: [[f64; 2]; 2], node_m: f64) -> [usize; 2] {
    bounds_m.map(|[low, high]| ((high - low) / node_m).ceil() as usize + 1)
}

impl NodePlaces {
    fn new(bounds_m: [[f64; 2]; 2], node_m: f64) -> NodePlaces {
        let corner_m = [bounds_m[0][0], bounds_m[1][1]];
        let size = nodes_over(bounds_m, node_m);
        let nodes = size[0] * size[1];
        let (data, weight, standing) = (vec![0.0; nodes], vec![0.0; nodes], vec![false; nodes]);
        let (open, scatter_m) = (BTreeMap::new(), vec![]);
        NodePlaces { corner_m, node_m, size, open, data, weight, scatter_m, standing }
    }

    /// The nearest node of a place, before it is rounded: column, row.
    fn node(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [(x - self.corner_m[0]) / self.node_m, (self.corner_m[1] - y) / self.node_m]
    }

    fn add(&mut self, [x, y, z]: [f64; 3], bare: bool) {
        let at = self.node([x, y]).map(f64::round);
        let inside = (0..2).all(|k| at[k] >= 0.0 && at[k] < self.size[k] as f64);
        if inside && z.is_finite() {
            let at = at[1] as usize * self.size[0] + at[0] as usize;
            self.open.entry(at).or_default()[usize::from(!bare)].push(z);
        }
    }

    fn close(&mut self, bounds_m: [[f64; 2]; 2]) {
        let (low, high) = (
            self.node([bounds_m[0][0], bounds_m[1][1]]),
            self.node([bounds_m[0][1], bounds_m[1][0]]),
        );
        let width = self.size[0];
        let is_whole = |at: usize| {
            let at = [(at % width) as f64, (at / width) as f64];
            (0..2).all(|k| at[k] - 0.5 > low[k] && at[k] + 0.5 < high[k])
        };
        let whole: Vec<usize> = self.open.keys().copied().filter(|&at| is_whole(at)).collect();
        for at in whole {
            self.reduce(at);
        }
    }

    fn reduce(&mut self, at: usize) {
        let Some([mut bare, mut standing]) = self.open.remove(&at) else { return };
        if bare.len() >= LEAST_CELLS {
            let (height, sigma) = from_below(&mut bare);
            self.data[at] = height;
            self.scatter_m.push(sigma);
            let sigma = sigma.max(LEAST_SIGMA_M);
            self.weight[at] = (bare.len() as f64).min(MOST_CELLS) / (sigma * sigma);
        } else if bare.len() + standing.len() >= LEAST_STANDING {
            standing.append(&mut bare);
            let low = (LOWEST * standing.len() as f64) as usize;
            self.data[at] = *standing.select_nth_unstable_by(low, f64::total_cmp).1;
            self.standing[at] = true;
        }
    }

    /// All places have come: reduces the nodes that are still open.
    fn close_all(&mut self) {
        let rest: Vec<usize> = self.open.keys().copied().collect();
        rest.into_iter().for_each(|at| self.reduce(at));
    }

    /// Share of the nodes that have bare cells, and of those that have bare cells or what stands on the ground; after [`Self::close_all`].
    fn shares_seen(&self) -> [f64; 2] {
        let bare = self.weight.iter().filter(|&&weight| weight > 0.0).count();
        let standing = self.standing.iter().filter(|&&standing| standing).count();
        [bare, bare + standing].map(|seen| seen as f64 / self.weight.len() as f64)
    }

    fn fit(self) -> Option<Terrain> {
        let NodePlaces { corner_m, node_m, size, data, weight, standing, scatter_m, .. } = self;
        let known: Vec<f64> = weight.iter().copied().filter(|&w| w > 0.0).collect();
        if known.is_empty() {
            return None;
        }
        let stiffness = STIFFNESS * median(known).unwrap_or(0.0);
        // Data of weight w have a say from (stiffness / w)^(1/4) nodes on.
        let lowest = stiffness * (node_m / GroundPlaces::LOWEST_FROM_M).powi(4);
        let total: f64 = weight.iter().sum();
        let mean_m = data.iter().zip(&weight).map(|(d, w)| d * w).sum::<f64>() / total;
        let mut lattice = Lattice {
            size,
            data: data.iter().map(|d| d - mean_m).collect(),
            weight: vec![],
            stiffness: [stiffness; 2],
        };
        let mut height = vec![];
        let mut robust = weight.clone();
        for _ in 0..ROUNDS {
            let of = |k: usize| if standing[k] { lowest } else { robust[k] };
            lattice.weight = (0..data.len()).map(of).collect();
            height = lattice.solve(height).value;
            let off: Vec<f64> = (0..data.len()).map(|k| lattice.data[k] - height[k]).collect();
            let errors = (0..data.len()).filter(|&k| weight[k] > 0.0).map(|k| off[k]);
            let scale = sigma_of_errors(errors).unwrap_or(0.0).max(LEAST_SIGMA_M);
            for k in 0..data.len() {
                let r = off[k] / (2.4 * scale);
                robust[k] = weight[k] / (1.0 + r * r);
            }
        }
        let height_m = height.into_iter().map(|z| z + mean_m).collect();
        let mut terrain = Terrain { corner_m, node_m, size, height_m, sigma_m: vec![] };
        let fine_m = median(scatter_m).unwrap_or(0.0);
        terrain.sigma_m = terrain.sigmas(&robust).into_iter().map(|s| s.hypot(fine_m)).collect();
        Some(terrain)
    }
}

/// The height of the ground among bare cells, some of which were matched at the height of the leaves beside them, and its scatter, metres. The
/// lowest quarter is taken for the lower tail of a normal distribution; how far the median of all is above its middle counts as scatter.
/// The quantiles 0.05 and 0.15 in place of 0.1 and 0.25 give the same (docs/decisions.md).
fn from_below(cells: &mut [f64]) -> (f64, f64) {
    // The standard normal distribution has a tenth, and a quarter, below these.
    const TENTH: f64 = -1.281_552;
    const QUARTER: f64 = -0.674_490;
    cells.sort_unstable_by(f64::total_cmp);
    let quantile = |share: f64| {
        let at = share * (cells.len() - 1) as f64;
        let (below, above) = (cells[at as usize], cells[(at.ceil() as usize).min(cells.len() - 1)]);
        below + at.fract() * (above - below)
    };
    let [tenth, quarter, middle] = [0.1, 0.25, 0.5].map(quantile);
    let sigma = (quarter - tenth) / (QUARTER - TENTH);
    let height = quarter - QUARTER * sigma;
    (height, sigma.hypot(middle - height))
}

impl Terrain {
    /// What the weights within two nodes leave; twice as much for every further two nodes without any.
    fn sigmas(&self, weight: &[f64]) -> Vec<f64> {
        let [columns, rows] = self.size;
        const REACHES: [usize; 4] = [2, 4, 8, 16];
        // By distance along a row or a column.
        let near = REACHES.map(|reach| -> Vec<f64> {
            let of = |d: usize| (-2.0 * (d * d) as f64 / (reach * reach) as f64).exp();
            (0..=reach).map(of).collect()
        });
        let of = |at: usize| {
            let (column, row) = (at % columns, at / columns);
            let mut factor = 1.0;
            for (reach, near) in REACHES.into_iter().zip(&near) {
                let mut sum = 0.0;
                for j in row.saturating_sub(reach)..(row + reach + 1).min(rows) {
                    let from = column.saturating_sub(reach);
                    let line = &weight
                        [j * columns + from..j * columns + (column + reach + 1).min(columns)];
                    let along: f64 =
                        line.iter().zip(from..).map(|(w, i)| w * near[i.abs_diff(column)]).sum();
                    sum += along * near[j.abs_diff(row)];
                }
                if sum > 0.0 {
                    return factor / sum.sqrt();
                }
                factor *= 2.0;
            }
            f64::INFINITY
        };
        (0..weight.len()).into_par_iter().map(of).collect()
    }

    /// The height of the ground at a place, linear between the nodes; `None` beyond them.
    #[inline]
    pub fn at_m(&self, place_m: [f64; 2]) -> Option<f64> {
        self.between([&self.height_m], place_m).map(|[height_m]| height_m)
    }

    /// The height of the ground at a place and its standard deviation.
    #[inline]
    pub fn with_sigma_at_m(&self, place_m: [f64; 2]) -> Option<[f64; 2]> {
        self.between([&self.height_m, &self.sigma_m], place_m)
    }

    #[inline(always)]
    fn between<const N: usize>(&self, values: [&[f64]; N], [x, y]: [f64; 2]) -> Option<[f64; N]> {
        let [columns, rows] = self.size;
        let u = (x - self.corner_m[0]) / self.node_m;
        let v = (self.corner_m[1] - y) / self.node_m;
        // What is no number is not inside.
        if !(u >= -0.5 && u <= columns as f64 - 0.5 && v >= -0.5 && v <= rows as f64 - 0.5) {
            return None;
        }
        // A negative number becomes 0.
        let (i, j) =
            ((u as usize).min(columns.saturating_sub(2)), (v as usize).min(rows.saturating_sub(2)));
        let (s, t) = (u - i as f64, v - j as f64);
        let (above, below) = (j * columns, (j + 1).min(rows - 1) * columns);
        let next = (i + 1).min(columns - 1);
        Some(values.map(|values| {
            let along = |row: usize| values[row + i] * (1.0 - s) + values[row + next] * s;
            along(above) * (1.0 - t) + along(below) * t
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use statrs::distribution::ContinuousCDF as _;

    #[test]
    fn the_ground_goes_on_under_leaves_and_ignores_what_stands_on_it() {
        let truth = |x: f64, y: f64| 100.0 + 0.02 * x - 0.03 * y + 0.05 * (x / 1.5).sin();
        let mut bare = Vec::new();
        for j in 0..120 {
            for i in 0..120 {
                let (x, y) = (0.05 * f64::from(i), 0.05 * f64::from(j));
                // A canopy without soil, and one cell in ten that is a leaf.
                if !((2.0..2.6).contains(&x) && (2.0..2.6).contains(&y)) {
                    let leaf = if (i * 7 + j * 13) % 10 == 0 { 0.3 } else { 0.0 };
                    let rough = 0.004 * f64::from((i * 31 + j * 17) % 7 - 3);
                    bare.push([x, y, truth(x, y) + leaf + rough]);
                }
            }
        }
        let ground = |bare: &[[f64; 3]]| {
            let mut places = GroundPlaces::new([[0.0, 6.0], [0.0, 6.0]], 0.3);
            bare.iter().for_each(|&place| places.add(place, true));
            places.fit()
        };
        let terrain = ground(&bare).unwrap();
        for place in [[1.0, 1.0], [4.7, 3.1], [2.3, 2.3]] {
            let off = terrain.at_m(place).unwrap() - truth(place[0], place[1]);
            assert!(off.abs() < 0.006, "{place:?}: {off}");
        }
        let [open, hidden] =
            [[4.5, 4.5], [2.3, 2.3]].map(|p| terrain.with_sigma_at_m(p).unwrap()[1]);
        assert!(hidden > open && open < 0.01, "{open} {hidden}");
        assert_eq!(terrain.at_m([9.0, 1.0]), None);
        assert_eq!(ground(&bare[..3]), None);
    }

    #[test]
    fn nodes_are_as_dense_as_bare_patches_allow() {
        let ridges = |x: f64| 0.017 * (std::f64::consts::TAU * x / 0.75).cos();
        // Of ten cells of 3 cm in each direction so many are bare.
        let fit = |patch: usize| {
            let mut places = GroundPlaces::new([[0.0, 6.0]; 2], 0.3);
            for at in 0..200 * 200 {
                let (i, j) = (at % 200, at / 200);
                let [x, y] = [i, j].map(|k| 0.03 * k as f64);
                places.add([x, y, ridges(x)], i % 10 < patch && j % 10 < patch);
            }
            places.fit().unwrap()
        };
        let (open, closed) = (fit(10), fit(3));
        assert_eq!([open.node_m, closed.node_m], [0.15, 0.3]);
        let off = |terrain: &Terrain| (terrain.at_m([3.0, 3.0]).unwrap() - ridges(3.0)).abs();
        assert!(off(&open) < 0.006 && off(&closed) > off(&open), "{} {}", off(&open), off(&closed));
        // Hundreds of bare cells near a node give its height to a fraction of a millimetre; ridges between the nodes remain.
        let least = open.sigma_m.iter().copied().fold(f64::INFINITY, f64::min);
        assert!((0.001..0.006).contains(&least), "{least}");
    }

    #[test]
    fn soil_matched_at_the_height_of_leaves_does_not_lift_the_ground() {
        // Quantiles of a normal distribution stand for its sample.
        let cells = |raised: usize| -> Vec<f64> {
            let normal = statrs::distribution::Normal::new(2.0, 0.01).unwrap();
            let of = |k: usize| normal.inverse_cdf((k as f64 + 0.5) / 100.0);
            (0..100).map(|k| of(k) + if k * 37 % 100 < raised { 0.3 } else { 0.0 }).collect()
        };
        let (height, sigma) = from_below(&mut cells(0));
        assert!((height - 2.0).abs() < 0.001 && (sigma - 0.01).abs() < 0.001, "{height} {sigma}");
        // The middle of all cells would be at the leaves.
        let (height, sigma) = from_below(&mut cells(55));
        assert!((height - 2.0).abs() < 0.02 && sigma > 0.2, "{height} {sigma}");
        assert_eq!(from_below(&mut [1.0; 4]), (1.0, 0.0));
    }

    /// A meadow of 60 m on a slope that bends, with a bare strip at its edge: the ground is below the grass everywhere, and a plot of
    /// a crop 6 m wide does not lift it.
    #[test]
    fn far_from_bare_places_the_ground_follows_the_lowest_of_what_stands_there() {
        let truth = |x: f64, y: f64| 50.0 + 0.05 * x + 2.0 * (y / 20.0).sin();
        let mut places = GroundPlaces::new([[0.0, 60.0], [0.0, 60.0]], 0.5);
        for j in 0..600 {
            for i in 0..600 {
                let (x, y) = (0.1 * f64::from(i), 0.1 * f64::from(j));
                let crop = (4.0..10.0).contains(&x) && (4.0..10.0).contains(&y);
                let bare = x < 12.0 && !crop;
                let above = match (bare, crop) {
                    (true, _) => 0.0,
                    (_, true) => 0.8,
                    _ => 0.01 * f64::from((i * 31 + j * 17) % 10),
                };
                places.add([x, y, truth(x, y) + above], bare);
            }
        }
        let terrain = places.fit().unwrap();
        for (place, most) in
            [([40.0, 30.0], 0.05), ([55.0, 5.0], 0.05), ([7.0, 7.0], 0.02), ([2.0, 50.0], 0.01)]
        {
            let off = terrain.at_m(place).unwrap() - truth(place[0], place[1]);
            assert!(off.abs() < most, "{place:?}: {off}");
        }
    }
}
