//! Semi-global aggregation: one height for every pixel, of which neighbours mostly agree.
//!
//! The heights `h` (layers) of all pixels should minimise
//!
//! ```text
//! E(h) = sum_x C_x(h_x) + sum_(x,y) [ P1 [|h_x - h_y| = 1] + P2(x, y) [|h_x - h_y| > 1] ]
//! P2(x, y) = max(3/2 P1, P2 / (1 + k |I_x - I_y|))
//! ```
//!
//! over pairs of neighbours; steps are cheaper where the picture has an edge. Along a straight path the minimum is found exactly by
//! dynamic programming,
//!
//! ```text
//! L(x, h) = C_x(h) + min( L(y, h), L(y, h -+ 1) + P1, min_i L(y, i) + P2 ) - min_i L(y, i)
//! ```
//!
//! with `y` the pixel before `x`. The sum `S(x, h)` over ten paths stands for the energy: down and up, straight, and by one and by two columns in a
//! row to either side. Paths along rows are not among them; those by two columns stand for these and need no transposed costs. Reference: H.
//! Hirschmueller, *Stereo processing by semiglobal matching and mutual information*, 2008.
//!
//! Costs are bytes; 32 columns are computed together, so that the least of all layers needs no minimum within a register.

use super::cost_volume::{CostVolume, LANES};

/// Penalties.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Penalties {
    /// Of a step of one layer, in matching costs (at most 72).
    pub step: u8,
    /// Of a larger step where the picture is smooth.
    pub jump: u8,
    /// How fast that falls with the difference of the picture, per grey value.
    pub edge: f64,
}

impl Default for Penalties {
    fn default() -> Penalties {
        Penalties { step: 6, jump: 60, edge: 0.15 }
    }
}

/// Aggregates costs over a picture, row by row: half of what the paths sum up to, above the least of the pixel and 255 at most.
pub fn aggregate(costs: &CostVolume, picture: &[u8], penalties: &Penalties, out: &mut CostVolume) {
    out.begin(costs.size(), costs.layers());
    let jumps = std::array::from_fn(|difference| {
        let jump = f64::from(penalties.jump) / (1.0 + penalties.edge * difference as f64);
        jump.round().max(1.5 * f64::from(penalties.step)) as u8
    });
    if costs.layers() > 0 && costs.size()[0] > 0 {
        let step = penalties.step;
        pulp::Arch::new().dispatch(Passes { costs, picture, step, jumps: &jumps, out });
    }
}

/// All paths, with the machine's SIMD.
struct Passes<'a> {
    costs: &'a CostVolume,
    picture: &'a [u8],
    step: u8,
    jumps: &'a [u8; 256],
    out: &'a mut CostVolume,
}

impl pulp::WithSimd for Passes<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Passes { costs, picture, step, jumps, out } = self;
        let height = costs.size()[1];
        let mut paths = Paths::new(costs, step);
        for row in 0..height {
            paths.row((costs, row), (picture, row.checked_sub(1)), jumps, out);
        }
        paths.reset();
        for row in (0..height).rev() {
            let before = Some(row + 1).filter(|&row| row < height);
            paths.row((costs, row), (picture, before), jumps, out);
        }
    }
}

/// The costs along a path up to 32 pixels: from those one layer below, at and above, the costs of the pixels, what is least before, and that with
/// the cost of a jump.
#[inline(always)]
fn next(
    [below, at, above]: [&[u8; LANES]; 3],
    cost: &[u8; LANES],
    step: u8,
    [least, jumped]: [&[u8; LANES]; 2],
) -> [u8; LANES] {
    let mut to = [0; LANES];
    for k in 0..LANES {
        let beside = below[k].min(above[k]).saturating_add(step);
        let best = at[k].min(beside).min(jumped[k]).wrapping_sub(least[k]);
        to[k] = cost[k].saturating_add(best);
    }
    to
}

/// 32 bytes.
#[inline(always)]
fn lanes(bytes: &[u8], from: usize) -> [u8; LANES] {
    let mut out = [0; LANES];
    out.copy_from_slice(&bytes[from..from + LANES]);
    out
}

#[inline(always)]
fn least(a: &[u8; LANES], b: &[u8; LANES]) -> [u8; LANES] {
    let mut out = [0; LANES];
    for k in 0..LANES {
        out[k] = a[k].min(b[k]);
    }
    out
}

/// `a + b`, at most 255.
#[inline(always)]
fn plus(a: &[u8; LANES], b: &[u8; LANES]) -> [u8; LANES] {
    let mut out = [0; LANES];
    for k in 0..LANES {
        out[k] = a[k].saturating_add(b[k]);
    }
    out
}

/// `a - b`, where `a` is not less.
#[inline(always)]
fn less(a: &[u8; LANES], b: &[u8; LANES]) -> [u8; LANES] {
    let mut out = [0; LANES];
    for k in 0..LANES {
        out[k] = a[k].wrapping_sub(b[k]);
    }
    out
}

/// Half the sum, rounded up.
#[inline(always)]
fn half(a: &[u8; LANES], b: &[u8; LANES]) -> [u8; LANES] {
    let mut out = [0; LANES];
    for k in 0..LANES {
        out[k] = (u16::from(a[k]).wrapping_add(u16::from(b[k])).wrapping_add(1) >> 1) as u8;
    }
    out
}

const ZEROS: [u8; LANES] = [0; LANES];
const MAXIMA: [u8; LANES] = [u8::MAX; LANES];

/// Columns of padding on either side of a row, where nothing costs anything; at least as many as a path moves in a row.
const PADDING: usize = LANES;

/// Columns from a pixel to its predecessor in the row before, path by path.
const PREDECESSORS: [isize; 5] = [-2, 2, -1, 1, 0];

/// A path: its costs in the row before and in this one.
struct Path {
    predecessor: isize,
    /// Bytes of a padded row.
    row_bytes: usize,
    /// Layer by layer, with one more beyond the last: of the row before, and of this one.
    costs: [Vec<u8>; 2],
    /// The least of all layers, likewise.
    least: [Vec<u8>; 2],
    /// Penalties of a larger step, by column.
    jumps: Vec<u8>,
}

/// Where a path is among the layers of 32 columns.
struct PathState {
    below: [u8; LANES],
    at: [u8; LANES],
    /// The least before, that with the penalty of a larger step, and the least of this row so far.
    least_before: [u8; LANES],
    jumped: [u8; LANES],
    least: [u8; LANES],
}

impl Path {
    fn new(predecessor: isize, chunks: usize, layers: usize) -> Path {
        let row_bytes = chunks * LANES + 2 * PADDING;
        let both = |bytes: usize| [vec![0; bytes], vec![0; bytes]];
        let costs = both((layers + 1) * row_bytes);
        let jumps = vec![0; chunks * LANES];
        let mut path = Path { predecessor, row_bytes, costs, least: both(row_bytes), jumps };
        path.reset();
        path
    }

    /// Before the first row: all layers are as good.
    fn reset(&mut self) {
        let beyond = self.costs[0].len() - self.row_bytes;
        for costs in &mut self.costs {
            costs.fill(0);
            costs[beyond..].fill(u8::MAX);
        }
        self.least.iter_mut().for_each(|least| least.fill(0));
    }

    /// Penalties between a row of the picture and the one before. Where the predecessor is beside the picture nothing has cost anything, so any
    /// penalty will do.
    #[inline(always)]
    fn set_jumps(&mut self, now: &[u8], before: &[u8], jumps: &[u8; 256]) {
        let left = (-self.predecessor).max(0) as usize;
        let right = self.predecessor.max(0) as usize;
        let count = now.len().saturating_sub(left + right);
        let pairs = now.iter().skip(left).zip(before.iter().skip(right)).take(count);
        for (jump, (now, &before)) in self.jumps.iter_mut().skip(left).zip(pairs) {
            *jump = jumps[usize::from(now.abs_diff(before))];
        }
    }

    #[inline(always)]
    fn predecessor_of(&self, column: usize) -> usize {
        (column + PADDING).wrapping_add_signed(self.predecessor)
    }

    /// Before the first layer of 32 columns.
    #[inline(always)]
    fn start(&self, column: usize) -> PathState {
        let from = self.predecessor_of(column);
        let least_before = lanes(&self.least[0], from);
        let jumped = plus(&lanes(&self.jumps, column), &least_before);
        let at = lanes(&self.costs[0], from);
        PathState { below: MAXIMA, at, least_before, jumped, least: MAXIMA }
    }

    /// Goes on with a layer: `layer` is where its row begins.
    #[inline(always)]
    fn advance(
        &mut self,
        state: &mut PathState,
        (column, layer): (usize, usize),
        cost: &[u8; LANES],
        step: u8,
    ) -> [u8; LANES] {
        let from = layer + self.row_bytes + self.predecessor_of(column);
        let above = lanes(&self.costs[0], from);
        let neighbours = [&state.below, &state.at, &above];
        let to = next(neighbours, cost, step, [&state.least_before, &state.jumped]);
        self.costs[1][layer + column + PADDING..][..LANES].copy_from_slice(&to);
        state.least = least(&state.least, &to);
        (state.below, state.at) = (state.at, above);
        to
    }

    /// After the last layer of 32 columns.
    #[inline(always)]
    fn finish(&mut self, state: &PathState, column: usize) {
        self.least[1][column + PADDING..][..LANES].copy_from_slice(&state.least);
    }
}

/// The five paths of a pass over the rows.
struct Paths {
    step: u8,
    paths: [Path; PREDECESSORS.len()],
    /// Half of what they sum up to, of 32 columns.
    sums: Vec<[u8; LANES]>,
}

impl Paths {
    fn new(costs: &CostVolume, step: u8) -> Paths {
        let layers = costs.layers();
        let path = |predecessor| Path::new(predecessor, costs.chunks(), layers);
        Paths { step, paths: PREDECESSORS.map(path), sums: vec![ZEROS; layers] }
    }

    fn reset(&mut self) {
        self.paths.iter_mut().for_each(Path::reset);
    }

    /// Goes on with a row and adds it to `out`.
    #[inline(always)]
    fn row(
        &mut self,
        (costs, row): (&CostVolume, usize),
        (picture, before): (&[u8], Option<usize>),
        jumps: &[u8; 256],
        out: &mut CostVolume,
    ) {
        let width = costs.size()[0];
        let now = &picture[row * width..][..width];
        let before = &picture[before.unwrap_or(row) * width..][..width];
        for path in &mut self.paths {
            path.set_jumps(now, before, jumps);
        }
        for chunk in 0..costs.chunks() {
            self.chunk(costs.chunk(row, chunk), chunk * LANES, out.chunk_mut(row, chunk));
        }
        for path in &mut self.paths {
            path.costs.swap(0, 1);
            path.least.swap(0, 1);
        }
    }

    #[inline(always)]
    fn chunk(&mut self, costs: &[[u8; LANES]], column: usize, out: &mut [[u8; LANES]]) {
        let Paths { step, paths: [a, b, c, d, straight], sums } = self;
        sums.fill(ZEROS);
        // Two at a time, as many as registers hold.
        for [a, b] in [[a, b], [c, d]] {
            let (mut of_a, mut of_b, mut layer) = (a.start(column), b.start(column), 0);
            for (cost, sum) in costs.iter().zip(sums.iter_mut()) {
                let along_a = a.advance(&mut of_a, (column, layer), cost, *step);
                let along_b = b.advance(&mut of_b, (column, layer), cost, *step);
                *sum = plus(sum, &half(&along_a, &along_b));
                layer += a.row_bytes;
            }
            a.finish(&of_a, column);
            b.finish(&of_b, column);
        }
        let (mut state, mut layer) = (straight.start(column), 0);
        for (cost, sum) in costs.iter().zip(sums.iter_mut()) {
            let along = straight.advance(&mut state, (column, layer), cost, *step);
            *sum = plus(sum, &half(&along, &ZEROS));
            layer += straight.row_bytes;
        }
        straight.finish(&state, column);
        let (mut least_sum, mut least_out) = (MAXIMA, MAXIMA);
        for (out, sum) in out.iter().zip(&*sums) {
            (least_sum, least_out) = (least(&least_sum, sum), least(&least_out, out));
        }
        for (out, sum) in out.iter_mut().zip(&*sums) {
            *out = plus(&less(sum, &least_sum), &less(out, &least_out));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The layer of the least sum and the vertex of the parabola through it.
    fn best_layer(sums: &CostVolume, pixel: [usize; 2]) -> f64 {
        let of = |d: usize| sums.at(pixel, d);
        let at = (0..sums.layers()).min_by_key(|&d| of(d)).unwrap();
        if at == 0 || at + 1 == sums.layers() {
            return at as f64;
        }
        let [a, c, b] = [at - 1, at, at + 1].map(|d| f64::from(of(d)));
        at as f64 + if a + b > 2.0 * c { 0.5 * (a - b) / (a + b - 2.0 * c) } else { 0.0 }
    }

    fn best_layers(costs: &CostVolume, picture: &[u8]) -> Vec<f64> {
        let mut sums = CostVolume::default();
        aggregate(costs, picture, &Penalties::default(), &mut sums);
        let width = costs.size()[0];
        (0..picture.len()).map(|at| best_layer(&sums, [at % width, at / width])).collect()
    }

    /// Two heights side by side, costs with random winners in a third of the pixels.
    #[test]
    fn noise_is_outvoted_and_the_step_stays() {
        use rand::{RngExt, SeedableRng};
        const LAYERS: usize = 64;
        let (width, height) = (60, 40);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let truth = |at: usize| if at % width < 30 { 20.3 } else { 41.0 };
        let mut costs = CostVolume::new([width, height], LAYERS);
        for at in 0..width * height {
            let wrong = (rng.random_range(0.0..1.0) < 0.3).then(|| rng.random_range(0.0..63.0));
            for d in 0..LAYERS {
                let off = (d as f64 - wrong.unwrap_or(truth(at))).abs();
                *costs.at_mut([at % width, at / width], d) = (10.0 + 10.0 * off).min(60.0) as u8;
            }
        }
        let picture: Vec<u8> =
            (0..width * height).map(|at| if at % width < 30 { 80 } else { 150 }).collect();
        let best = best_layers(&costs, &picture);
        let right = best.iter().enumerate().filter(|&(at, best)| (best - truth(at)).abs() < 0.6);
        // Each pixel on its own would be right in seven of ten. At the border fewer paths help, and beside the edge
        // steps are cheap.
        let share = right.count() as f64 / best.len() as f64;
        assert!(share > 0.85, "{share}");
    }

    /// The parabola finds fractions of a layer; the bounded costs of steps pull them towards its middle.
    #[test]
    fn fractions_of_a_layer_are_found() {
        let mut costs = CostVolume::new([10, 10], 64);
        for at in 0..6400 {
            let off = (at / 100) as f64 - 30.25;
            *costs.at_mut([at % 10, at / 10 % 10], at / 100) =
                (2.0 * off * off).min(72.0).round() as u8;
        }
        let best = best_layers(&costs, &[7; 100]);
        let inner = &best[33..37];
        assert!(inner.iter().all(|&b| b > 30.01 && b < 30.35), "{inner:?}");
    }

    /// The recursion of the head of this file, number by number.
    #[test]
    fn sums_are_those_of_the_recursion() {
        use rand::{RngExt, SeedableRng};
        const LAYERS: usize = 9;
        let (width, height) = (45, 7);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(8);
        let mut costs = CostVolume::new([width, height], LAYERS);
        let mut of = vec![[0i64; LAYERS]; width * height];
        for (at, of) in of.iter_mut().enumerate() {
            for (d, of) in of.iter_mut().enumerate() {
                let cost = rng.random_range(0..40u8);
                *costs.at_mut([at % width, at / width], d) = cost;
                *of = i64::from(cost);
            }
        }
        let picture: Vec<u8> = (0..width * height).map(|_| rng.random_range(0..255)).collect();
        let penalties = Penalties::default();
        let step = i64::from(penalties.step);
        let jump = |difference: u8| {
            let jump = f64::from(penalties.jump) / (1.0 + penalties.edge * f64::from(difference));
            jump.round().max(1.5 * f64::from(penalties.step)) as i64
        };
        let mut wanted = vec![[0i64; LAYERS]; width * height];
        for back in [false, true] {
            for from in PREDECESSORS {
                let mut path = vec![[0i64; LAYERS]; width * height];
                for line in 0..height {
                    let row = if back { height - 1 - line } else { line };
                    for column in 0..width {
                        let at = row * width + column;
                        let other = column.checked_add_signed(from).filter(|&c| c < width);
                        let other = other.filter(|_| line > 0);
                        let other = other.map(|c| if back { row + 1 } else { row - 1 } * width + c);
                        let before = other.map_or([0; LAYERS], |other| path[other]);
                        let jump = jump(other.map_or(0, |o| picture[at].abs_diff(picture[o])));
                        let least = before.iter().copied().min().unwrap();
                        for d in 0..LAYERS {
                            let mut best = before[d].min(least + jump);
                            if d > 0 {
                                best = best.min(before[d - 1] + step);
                            }
                            if d + 1 < LAYERS {
                                best = best.min(before[d + 1] + step);
                            }
                            path[at][d] = of[at][d] + best - least;
                        }
                    }
                }
                for (wanted, path) in wanted.as_flattened_mut().iter_mut().zip(path.as_flattened())
                {
                    *wanted += path;
                }
            }
        }
        let mut sums = CostVolume::default();
        aggregate(&costs, &picture, &penalties, &mut sums);
        for (at, wanted) in wanted.iter().enumerate() {
            // What a pass takes off is the same for all layers of a pixel; each of six halves is rounded up by at most 1 of the whole sum.
            let found: Vec<i64> =
                (0..LAYERS).map(|d| 2 * i64::from(sums.at([at % width, at / width], d))).collect();
            for d in 1..LAYERS {
                let off = (found[d] - found[0]) - (wanted[d] - wanted[0]);
                assert!(off.abs() <= 6, "{at} {d}: {found:?} {wanted:?}");
            }
        }
    }
}
