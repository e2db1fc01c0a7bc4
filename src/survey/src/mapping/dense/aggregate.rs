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
//! Costs are bytes, and 32 columns go on together, so the layers of a pixel are never in one register.

use super::volume::{LANES, Volume};

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
pub fn aggregate(costs: &Volume, picture: &[u8], penalties: &Penalties, out: &mut Volume) {
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
    costs: &'a Volume,
    picture: &'a [u8],
    step: u8,
    jumps: &'a [u8; 256],
    out: &'a mut Volume,
}

impl pulp::WithSimd for Passes<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Passes { costs, picture, step, jumps, out } = self;
        let height = costs.size()[1];
        let mut paths = Paths::new(costs, step);
        for row in 0..height {
            paths.go((costs, row), (picture, row.checked_sub(1)), jumps, out);
        }
        paths.begin();
        for row in (0..height).rev() {
            let before = Some(row + 1).filter(|&row| row < height);
            paths.go((costs, row), (picture, before), jumps, out);
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

const NONE: [u8; LANES] = [0; LANES];
const ALL: [u8; LANES] = [u8::MAX; LANES];

/// Bytes before the columns of a picture, where nothing is.
const BESIDE: usize = LANES;

/// Columns from a pixel to that of the row before from which a path comes.
const FROM: [isize; 5] = [-2, 2, -1, 1, 0];

/// Paths that come from the row before.
struct Paths {
    step: u8,
    /// Of each path the layers of the row before and one more beyond, with room beside the picture, and those of the row.
    costs: [[Vec<u8>; 2]; FROM.len()],
    least: [[Vec<u8>; 2]; FROM.len()],
    room: usize,
    /// What they sum up to.
    sums: Vec<[u8; LANES]>,
    jumps: [Vec<u8>; FROM.len()],
}

impl Paths {
    fn new(costs: &Volume, step: u8) -> Paths {
        let layers = costs.layers();
        let room = costs.chunks() * LANES + 2 * BESIDE;
        let both = |bytes: usize| [vec![0; bytes], vec![0; bytes]];
        let mut paths = Paths {
            step,
            costs: std::array::from_fn(|_| both((layers + 1) * room)),
            least: std::array::from_fn(|_| both(room)),
            room,
            sums: vec![NONE; layers],
            jumps: std::array::from_fn(|_| vec![0; room - 2 * BESIDE]),
        };
        paths.begin();
        paths
    }

    /// Before the first row: all layers are as good.
    fn begin(&mut self) {
        let beyond = self.sums.len() * self.room;
        for of in self.costs.as_flattened_mut() {
            of.fill(0);
            of[beyond..].fill(u8::MAX);
        }
        self.least.as_flattened_mut().iter_mut().for_each(|of| of.fill(0));
    }

    /// Goes on with a row and adds it to `out`.
    #[inline(always)]
    fn go(
        &mut self,
        (costs, row): (&Volume, usize),
        (picture, before): (&[u8], Option<usize>),
        jumps: &[u8; 256],
        out: &mut Volume,
    ) {
        let width = costs.size()[0];
        let now = &picture[row * width..][..width];
        let before = &picture[before.unwrap_or(row) * width..][..width];
        for (jumped, from) in self.jumps.iter_mut().zip(FROM) {
            // Where the path comes from beside the picture nothing has cost anything, so any jump will do.
            let (left, right) = ((-from).max(0) as usize, from.max(0) as usize);
            let n = width.saturating_sub(left + right);
            let now = now.iter().skip(left).take(n);
            let before = before.iter().skip(right).take(n);
            for (jumped, (now, &before)) in jumped.iter_mut().skip(left).zip(now.zip(before)) {
                *jumped = jumps[usize::from(now.abs_diff(before))];
            }
        }
        for chunk in 0..costs.chunks() {
            self.chunk(costs.chunk(row, chunk), chunk * LANES, out.chunk_mut(row, chunk));
        }
        for of in self.costs.iter_mut().chain(&mut self.least) {
            of.swap(0, 1);
        }
    }

    #[inline(always)]
    fn chunk(&mut self, costs: &[[u8; LANES]], to: usize, out: &mut [[u8; LANES]]) {
        self.sums.fill(NONE);
        self.two::<0, 1>(costs, to);
        self.two::<2, 3>(costs, to);
        self.one::<4>(costs, to);
        let (mut own, mut others) = (ALL, ALL);
        for (out, sum) in out.iter().zip(&self.sums) {
            (own, others) = (least(&own, sum), least(&others, out));
        }
        for (out, sum) in out.iter_mut().zip(&self.sums) {
            *out = plus(&less(sum, &own), &less(out, &others));
        }
    }

    #[inline(always)]
    fn two<const A: usize, const B: usize>(&mut self, costs: &[[u8; LANES]], to: usize) {
        let (room, to_here, step) = (self.room, to + BESIDE, self.step);
        let [from_a, from_b] = [A, B].map(|path| to_here.wrapping_add_signed(FROM[path]));
        let [Ok([[a0, a1], [b0, b1]]), Ok([[la0, la1], [lb0, lb1]])] =
            [&mut self.costs, &mut self.least].map(|of| of.get_disjoint_mut([A, B]))
        else {
            return;
        };
        let (la, lb) = (lanes(la0, from_a), lanes(lb0, from_b));
        let ja = plus(&lanes(&self.jumps[A], to), &la);
        let jb = plus(&lanes(&self.jumps[B], to), &lb);
        let (mut below_a, mut below_b, mut own_a, mut own_b) = (ALL, ALL, ALL, ALL);
        let (mut at_a, mut at_b) = (lanes(a0, from_a), lanes(b0, from_b));
        let mut line = 0;
        for (cost, sum) in costs.iter().zip(&mut self.sums) {
            let above_a = lanes(a0, line + room + from_a);
            let above_b = lanes(b0, line + room + from_b);
            let a = next([&below_a, &at_a, &above_a], cost, step, [&la, &ja]);
            let b = next([&below_b, &at_b, &above_b], cost, step, [&lb, &jb]);
            a1[line + to_here..][..LANES].copy_from_slice(&a);
            b1[line + to_here..][..LANES].copy_from_slice(&b);
            (own_a, own_b) = (least(&own_a, &a), least(&own_b, &b));
            (below_a, at_a, below_b, at_b) = (at_a, above_a, at_b, above_b);
            *sum = plus(sum, &half(&a, &b));
            line += room;
        }
        la1[to_here..][..LANES].copy_from_slice(&own_a);
        lb1[to_here..][..LANES].copy_from_slice(&own_b);
    }

    #[inline(always)]
    fn one<const A: usize>(&mut self, costs: &[[u8; LANES]], to: usize) {
        let (room, to_here, step) = (self.room, to + BESIDE, self.step);
        let from = to_here.wrapping_add_signed(FROM[A]);
        let ([before, now], [least_before, least_now]) = (&mut self.costs[A], &mut self.least[A]);
        let lowest = lanes(least_before, from);
        let jumped = plus(&lanes(&self.jumps[A], to), &lowest);
        let (mut below, mut at, mut own) = (ALL, lanes(before, from), ALL);
        let mut line = 0;
        for (cost, sum) in costs.iter().zip(&mut self.sums) {
            let above = lanes(before, line + room + from);
            let to = next([&below, &at, &above], cost, step, [&lowest, &jumped]);
            now[line + to_here..][..LANES].copy_from_slice(&to);
            own = least(&own, &to);
            (below, at) = (at, above);
            *sum = plus(sum, &half(&to, &NONE));
            line += room;
        }
        least_now[to_here..][..LANES].copy_from_slice(&own);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The layer of the least sum and the vertex of the parabola through it.
    fn best_layer(sums: &Volume, pixel: [usize; 2]) -> f64 {
        let of = |d: usize| sums.at(pixel, d);
        let at = (0..sums.layers()).min_by_key(|&d| of(d)).unwrap();
        if at == 0 || at + 1 == sums.layers() {
            return at as f64;
        }
        let [a, c, b] = [at - 1, at, at + 1].map(|d| f64::from(of(d)));
        at as f64 + if a + b > 2.0 * c { 0.5 * (a - b) / (a + b - 2.0 * c) } else { 0.0 }
    }

    fn best_layers(costs: &Volume, picture: &[u8]) -> Vec<f64> {
        let mut sums = Volume::default();
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
        let mut costs = Volume::new([width, height], LAYERS);
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
        let mut costs = Volume::new([10, 10], 64);
        for at in 0..6400 {
            let off = (at / 100) as f64 - 30.25;
            *costs.at_mut([at % 10, at / 10 % 10], at / 100) =
                (2.0 * off * off).min(72.0).round() as u8;
        }
        let best = best_layers(&costs, &[7; 100]);
        let inner = &best[33..37];
        assert!(inner.iter().all(|&b| b > 30.01 && b < 30.35), "{inner:?}");
    }

    /// Number by number what the vectors do, for paths from one place.
    #[test]
    fn sums_are_those_of_the_recursion() {
        use rand::{RngExt, SeedableRng};
        const LAYERS: usize = 9;
        let (width, height) = (45, 7);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(8);
        let mut costs = Volume::new([width, height], LAYERS);
        let mut of = vec![[0i64; LAYERS]; width * height];
        for (at, of) in of.iter_mut().enumerate() {
            for (d, of) in of.iter_mut().enumerate() {
                let cost = rng.random_range(0..40u8);
                *costs.at_mut([at % width, at / width], d) = cost;
                *of = i64::from(cost);
            }
        }
        let picture = vec![50u8; width * height];
        let penalties = Penalties::default();
        let (step, jump) = (i64::from(penalties.step), i64::from(penalties.jump));
        let mut wanted = vec![[0i64; LAYERS]; width * height];
        for back in [false, true] {
            for from in FROM {
                let mut path = vec![[0i64; LAYERS]; width * height];
                for line in 0..height {
                    let row = if back { height - 1 - line } else { line };
                    for column in 0..width {
                        let before = column.checked_add_signed(from).filter(|&c| c < width);
                        let before = match before {
                            Some(c) if line > 0 => {
                                path[if back { row + 1 } else { row - 1 } * width + c]
                            }
                            _ => [0; LAYERS],
                        };
                        let least = before.iter().copied().min().unwrap();
                        for d in 0..LAYERS {
                            let mut best = before[d].min(least + jump);
                            if d > 0 {
                                best = best.min(before[d - 1] + step);
                            }
                            if d + 1 < LAYERS {
                                best = best.min(before[d + 1] + step);
                            }
                            path[row * width + column][d] =
                                of[row * width + column][d] + best - least;
                        }
                    }
                }
                for (wanted, path) in wanted.as_flattened_mut().iter_mut().zip(path.as_flattened())
                {
                    *wanted += path;
                }
            }
        }
        let mut sums = Volume::default();
        aggregate(&costs, &picture, &penalties, &mut sums);
        for (at, wanted) in wanted.iter().enumerate() {
            // Between two layers of a pixel, halves are rounded up six times, and each pass has its own least layer.
            let found: Vec<i64> =
                (0..LAYERS).map(|d| 2 * i64::from(sums.at([at % width, at / width], d))).collect();
            for d in 1..LAYERS {
                let off = (found[d] - found[0]) - (wanted[d] - wanted[0]);
                assert!(off.abs() <= 8, "{at} {d}: {found:?} {wanted:?}");
            }
        }
    }
}
