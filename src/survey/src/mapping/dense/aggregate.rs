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
//! with `y` the pixel before `x`. The sum `S(x, h)` over eight paths stands for the energy. Reference: H. Hirschmueller, *Stereo
//! processing by semiglobal matching and mutual information*, 2008.
//!
//! Two passes over the rows make four paths each. Costs are bytes, so 64 layers are one or two registers.

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

/// Aggregates costs (layer by layer, row by row, at most `D` layers) over a picture: the sums of the eight paths, pixel by pixel. `P` is
/// `D + 2`; layers for which there are no costs have the cost `missing`. The costs are given up before memory for the sums is taken.
pub fn aggregate<const D: usize, const P: usize>(
    (costs, missing): (Vec<u8>, u8),
    picture: &[u8],
    width: usize,
    penalties: &Penalties,
) -> Vec<[u16; D]> {
    let height = picture.len() / width.max(1);
    let by_pixel = transpose::<D>((&costs, missing), width * height);
    drop(costs);
    let jumps = std::array::from_fn(|difference| {
        let jump = f64::from(penalties.jump) / (1.0 + penalties.edge * difference as f64);
        jump.round().max(1.5 * f64::from(penalties.step)) as u8
    });
    let mut sums = vec![[0u16; D]; width * height];
    for backwards in [false, true] {
        pulp::Arch::new().dispatch(Pass::<D, P> {
            costs: &by_pixel,
            picture,
            width,
            height,
            step: penalties.step,
            jumps: &jumps,
            backwards,
            sums: &mut sums,
        });
    }
    sums
}

/// From layers of pixels to pixels of layers.
fn transpose<const D: usize>((costs, missing): (&[u8], u8), cells: usize) -> Vec<[u8; D]> {
    const RUN: usize = 64;
    let mut out = vec![[missing; D]; cells];
    for (chunk, out) in out.chunks_mut(RUN).enumerate() {
        for (layer, costs) in costs.chunks_exact(cells).enumerate() {
            let from = &costs[chunk * RUN..][..out.len()];
            for (pixel, &cost) in out.iter_mut().zip(from) {
                pixel[layer] = cost;
            }
        }
    }
    out
}

/// Four of the eight paths: from the left and from the three pixels above, or the other way round.
struct Pass<'a, const D: usize, const P: usize> {
    costs: &'a [[u8; D]],
    picture: &'a [u8],
    width: usize,
    height: usize,
    step: u8,
    jumps: &'a [u8; 256],
    backwards: bool,
    sums: &'a mut [[u16; D]],
}

/// The costs along one path up to a pixel, with one more beyond either end, and the least of them.
#[derive(Clone, Copy)]
struct Path<const P: usize> {
    costs: [u8; P],
    least: u8,
}

impl<const P: usize> Path<P> {
    /// Before the first pixel of a path: all layers are as good.
    fn start() -> Path<P> {
        let mut costs = [0; P];
        costs[0] = u8::MAX;
        costs[P - 1] = u8::MAX;
        Path { costs, least: 0 }
    }
}

impl<const D: usize, const P: usize> pulp::WithSimd for Pass<'_, D, P> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Pass { costs, picture, width, height, step, jumps, backwards, sums } = self;
        let mut before = vec![[Path::<P>::start(); 3]; width + 2];
        let mut now = before.clone();
        for line in 0..height {
            let mut left = Path::<P>::start();
            for column in 0..width {
                let at = line * width + column;
                let index = |at: usize| if backwards { width * height - 1 - at } else { at };
                let pixel = index(at);
                let value = picture[pixel];
                let jump = |there: bool, back: usize| {
                    let other = if there { picture[index(at - back)] } else { value };
                    jumps[usize::from(value.abs_diff(other))]
                };
                let cost = &costs[pixel];
                let up = line > 0;
                left = go(&left, cost, step, jump(column > 0, 1));
                let [a, b, c] = [
                    go(&before[column][0], cost, step, jump(up && column > 0, width + 1)),
                    go(&before[column + 1][1], cost, step, jump(up, width)),
                    go(
                        &before[column + 2][2],
                        cost,
                        step,
                        jump(up && column + 1 < width, width - 1),
                    ),
                ];
                let sum = &mut sums[pixel];
                for d in 0..D {
                    // Eight bytes fit; said so because checks would keep the loop out of registers.
                    let [a, b, c] = [&a, &b, &c].map(|path| u16::from(path.costs[d + 1]));
                    let four = u16::from(left.costs[d + 1]).wrapping_add(a).wrapping_add(b);
                    sum[d] = sum[d].wrapping_add(four).wrapping_add(c);
                }
                now[column + 1] = [a, b, c];
            }
            std::mem::swap(&mut before, &mut now);
        }
    }
}

/// One step of a path.
#[inline(always)]
fn go<const D: usize, const P: usize>(
    from: &Path<P>,
    cost: &[u8; D],
    step: u8,
    jump: u8,
) -> Path<P> {
    let mut to = Path::<P>::start();
    let beyond = from.least.saturating_add(jump);
    for d in 0..D {
        let beside = from.costs[d].min(from.costs[d + 2]).saturating_add(step);
        let best = from.costs[d + 1].min(beside).min(beyond).wrapping_sub(from.least);
        to.costs[d + 1] = cost[d].saturating_add(best);
    }
    let mut least = u8::MAX;
    for d in 0..D {
        least = least.min(to.costs[d + 1]);
    }
    to.least = least;
    to
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The layer of the least sum and the vertex of the parabola through it.
    fn best_layer<const D: usize>(sums: &[u16; D]) -> f64 {
        let at = (0..D).min_by_key(|&d| sums[d]).unwrap();
        if at == 0 || at + 1 == D {
            return at as f64;
        }
        let [a, c, b] = [at - 1, at, at + 1].map(|d| f64::from(sums[d]));
        at as f64 + if a + b > 2.0 * c { 0.5 * (a - b) / (a + b - 2.0 * c) } else { 0.0 }
    }

    /// Two heights side by side, costs with random winners in a third of the pixels.
    #[test]
    fn noise_is_outvoted_and_the_step_stays() {
        use rand::{RngExt, SeedableRng};
        const D: usize = 64;
        let (width, height) = (60, 40);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let truth = |at: usize| if at % width < 30 { 20.3 } else { 41.0 };
        let mut costs = vec![0; width * height * D];
        for at in 0..width * height {
            let wrong = (rng.random_range(0.0..1.0) < 0.3).then(|| rng.random_range(0.0..63.0));
            for d in 0..D {
                let off = (d as f64 - wrong.unwrap_or(truth(at))).abs();
                costs[d * width * height + at] = (10.0 + 10.0 * off).min(60.0) as u8;
            }
        }
        let picture: Vec<u8> =
            (0..width * height).map(|at| if at % width < 30 { 80 } else { 150 }).collect();
        let sums = aggregate::<D, { D + 2 }>((costs, 0), &picture, width, &Penalties::default());
        let best: Vec<f64> = sums.iter().map(best_layer).collect();
        let right = best.iter().enumerate().filter(|&(at, best)| (best - truth(at)).abs() < 0.6);
        // Each pixel on its own would be right in seven of ten. At the border fewer paths help, and beside the edge
        // steps are cheap.
        let share = right.count() as f64 / best.len() as f64;
        assert!(share > 0.85, "{share}");
    }

    /// The parabola finds fractions of a layer; the bounded costs of steps pull them towards its middle.
    #[test]
    fn fractions_of_a_layer_are_found() {
        let costs: Vec<u8> = (0..64)
            .flat_map(|d| {
                let off = f64::from(d) - 30.25;
                [(2.0 * off * off).min(72.0).round() as u8; 100]
            })
            .collect();
        let sums = aggregate::<64, 66>((costs, 0), &[7; 100], 10, &Penalties::default());
        let inner: Vec<f64> = sums[33..37].iter().map(best_layer).collect();
        assert!(inner.iter().all(|&b| b > 30.01 && b < 30.35), "{inner:?}");
    }
}
