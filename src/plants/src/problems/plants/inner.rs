//! One plant, its pixels held: the convex inner problem.
//!
//! With `median`, the exact minimiser of the stated cost,
//! `F(x) = w sum_n |z_n - x| + 1/2 x^T H x - g^T x`, `w = 1/sigma`, and with `mean` the closed form
//! of the same with squared distances, `F(x) = w/2 sum_n |z_n - x|^2 + 1/2 x^T H x - g^T x`. `x` and
//! `z_n` are offsets from the plant's present place, in pixels; `H` (positive semi-definite) and `g`
//! are the prior's.
//!
//! The sum of norms is not smooth at its pixels. A pixel `z_k` of multiplicity `m` is the minimiser
//! exactly when the gradient of the rest is no longer than `w m` there (the vertex case); it is
//! tested at the pixel next to the iterate. Elsewhere Newton steps converge quadratically; one that
//! does not decrease `F` is replaced by a Weiszfeld step, which always does, so the result is never
//! worse than the start.
//!
//! Reference: Y. Vardi and C.-H. Zhang, "The multivariate L1-median and associated data depth",
//! PNAS 97 (2000), for the vertex case.

use super::quadratic::{Quadratic, solve2};

/// The minimiser of `w/2 sum |z_n - x|^2` + prior.
pub fn mean(u: &[f64], v: &[f64], weight: f64, prior: &Quadratic) -> [f64; 2] {
    if u.is_empty() {
        return prior.minimiser();
    }
    let mass = weight * u.len() as f64;
    let [uu, uv, vv] = prior.hessian;
    let right = [
        weight * u.iter().sum::<f64>() + prior.pull[0],
        weight * v.iter().sum::<f64>() + prior.pull[1],
    ];
    solve2([uu + mass, uv, vv + mass], right).unwrap_or([0.0; 2])
}

/// `F`, its derivatives and what a Weiszfeld step needs, all at one place.
#[derive(Debug, Clone, Copy)]
struct Local {
    value: f64,
    gradient: [f64; 2],
    hessian: [f64; 3],
    /// `w sum 1/d_n`.
    stiffness: f64,
    /// Pixels at the very place, left out of the derivatives.
    here: usize,
    /// The nearest other pixel, and its squared distance.
    nearest: usize,
    nearest2: f64,
}

/// `F` of the mean at `x`, but for a constant.
pub(super) fn mean_cost(u: &[f64], v: &[f64], weight: f64, prior: &Quadratic, x: [f64; 2]) -> f64 {
    let squares: f64 =
        u.iter().zip(v).map(|(zu, zv)| (zu - x[0]).powi(2) + (zv - x[1]).powi(2)).sum();
    0.5 * weight * squares + prior.value(x)
}

/// `F` of the median at `x`, but for a constant.
pub(super) fn median_cost(
    u: &[f64],
    v: &[f64],
    weight: f64,
    prior: &Quadratic,
    x: [f64; 2],
) -> f64 {
    evaluate(u, v, weight, prior, x).value
}

/// Pixels taken at once; their sums are kept apart and added at the end.
const LANES: usize = 4;
/// Below this distance (squared, in pixels) a pixel is the place itself.
const HERE2: f64 = 1e-20;

/// The sums of one evaluation, one per lane.
#[derive(Default)]
struct Lanes {
    distance: [f64; LANES],
    gradient: [[f64; LANES]; 2],
    hessian: [[f64; LANES]; 3],
    stiffness: [f64; LANES],
    here: [f64; LANES],
}

impl Lanes {
    /// Adds a pixel; without a branch, so that several go at once.
    #[inline(always)]
    fn add(&mut self, lane: usize, du: f64, dv: f64) -> f64 {
        let d2 = du * du + dv * dv;
        let apart = d2 > HERE2;
        let d = d2.sqrt();
        let inverse = if apart { 1.0 / d } else { 0.0 };
        let (eu, ev) = (du * inverse, dv * inverse);
        self.distance[lane] += d;
        self.gradient[0][lane] += eu;
        self.gradient[1][lane] += ev;
        self.hessian[0][lane] += ev * ev * inverse;
        self.hessian[1][lane] -= eu * ev * inverse;
        self.hessian[2][lane] += eu * eu * inverse;
        self.stiffness[lane] += inverse;
        self.here[lane] += if apart { 0.0 } else { 1.0 };
        if apart { d2 } else { f64::INFINITY }
    }
}

/// Evaluates `F` at `x`.
fn evaluate(u: &[f64], v: &[f64], weight: f64, prior: &Quadratic, x: [f64; 2]) -> Local {
    let mut lanes = Lanes::default();
    let (mut block, mut nearest2) = (0, f64::INFINITY);
    let (head_u, tail_u) = u.as_chunks::<LANES>();
    let (head_v, tail_v) = v.as_chunks::<LANES>();
    for (k, (us, vs)) in head_u.iter().zip(head_v).enumerate() {
        let mut d2 = [0.0; LANES];
        for lane in 0..LANES {
            d2[lane] = lanes.add(lane, x[0] - us[lane], x[1] - vs[lane]);
        }
        let least = d2[0].min(d2[1]).min(d2[2].min(d2[3]));
        if least < nearest2 {
            (block, nearest2) = (k * LANES, least);
        }
    }
    for (k, (zu, zv)) in tail_u.iter().zip(tail_v).enumerate() {
        let d2 = lanes.add(0, x[0] - zu, x[1] - zv);
        if d2 < nearest2 {
            (block, nearest2) = (head_u.len() * LANES + k, d2);
        }
    }
    let distance2 = |n: usize| (x[0] - u[n]).powi(2) + (x[1] - v[n]).powi(2);
    let last = (block + LANES).min(u.len());
    let nearest = (block..last).find(|&n| distance2(n) == nearest2).unwrap_or(block);
    let sum = |lanes: &[f64; LANES]| (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]);
    let pull = prior.gradient(x);
    Local {
        value: weight * sum(&lanes.distance) + prior.value(x),
        gradient: [0, 1].map(|k| weight * sum(&lanes.gradient[k]) + pull[k]),
        hessian: [0, 1, 2].map(|k| weight * sum(&lanes.hessian[k]) + prior.hessian[k]),
        stiffness: weight * sum(&lanes.stiffness),
        here: sum(&lanes.here) as usize,
        nearest,
        nearest2,
    }
}

impl Local {
    /// Whether the place, being a pixel of its own, is the minimiser.
    fn is_optimal_vertex(&self, weight: f64) -> bool {
        self.here > 0 && self.gradient[0].hypot(self.gradient[1]) <= weight * self.here as f64
    }

    /// Whether a pixel near `x`, at `offset` from it, could be the minimiser: by the derivatives at
    /// `x` without that pixel, with room for their change on the way. Sure once `x` is very near.
    fn may_be_optimal(&self, weight: f64, offset: [f64; 2]) -> bool {
        let d = self.nearest2.sqrt();
        let (eu, ev) = (-offset[0] / d, -offset[1] / d);
        let [uu, uv, vv] = self.hessian;
        let (stiff, [du, dv]) = (weight / d, offset);
        let (uu, uv, vv) = (uu - stiff * ev * ev, uv + stiff * eu * ev, vv - stiff * eu * eu);
        let gradient = [
            self.gradient[0] - weight * eu + uu * du + uv * dv,
            self.gradient[1] - weight * ev + uv * du + vv * dv,
        ];
        let room = 1e-9 + 0.5 * self.stiffness * d;
        gradient[0].hypot(gradient[1]) <= 2.0 * weight + room
    }

    /// A step that decreases `F` for certain: the minimiser of a quadratic that lies above it.
    fn weiszfeld(&self, weight: f64, prior: &Quadratic) -> [f64; 2] {
        let [uu, uv, vv] = prior.hessian;
        let downhill = self.gradient.map(|g| -g);
        if self.here == 0 {
            return solve2([uu + self.stiffness, uv, vv + self.stiffness], downhill)
                .unwrap_or([0.0; 2]);
        }
        // Off a pixel that is not the minimiser; the same curvature both ways keeps it exact.
        let left = 1.0 - weight * self.here as f64 / downhill[0].hypot(downhill[1]);
        downhill.map(|g| g * left / (self.stiffness + uu + vv))
    }

    /// Whether this place is better than `before`: by its value or, where rounding hides the
    /// difference, by its gradient.
    fn improves(&self, before: &Local) -> bool {
        let noise = 1e-14 * before.value.abs();
        let slope = |local: &Local| local.gradient[0].hypot(local.gradient[1]);
        self.value < before.value - noise
            || (self.value <= before.value + noise && slope(self) < slope(before))
    }
}

/// The minimiser of `w sum |z_n - x|` + prior; `F` there is never larger than at the origin.
pub fn median(u: &[f64], v: &[f64], weight: f64, prior: &Quadratic) -> [f64; 2] {
    /// Steps shorter than this end the search; in pixels.
    const SHORT_PX: f64 = 1e-11;
    /// The same after a Newton step: the next would be about its square.
    const SHORT_NEWTON_PX: f64 = 1e-6;
    /// Rounds of the search; twenty are seldom needed.
    const ROUNDS: usize = 200;
    /// The nearest pixel is tested as the minimiser once it is this close; squared pixels.
    const MAX_CLOSE_PX2: f64 = 0.5;
    if u.is_empty() {
        return prior.minimiser();
    }
    let mut x = [0.0; 2];
    let mut local = evaluate(u, v, weight, prior, x);
    let mut tested = usize::MAX;
    for _ in 0..ROUNDS {
        if local.is_optimal_vertex(weight) {
            break;
        }
        if local.nearest2 < MAX_CLOSE_PX2 && tested != local.nearest {
            let vertex = [u[local.nearest], v[local.nearest]];
            if local.may_be_optimal(weight, [vertex[0] - x[0], vertex[1] - x[1]]) {
                tested = local.nearest;
            }
            if tested == local.nearest
                && evaluate(u, v, weight, prior, vertex).is_optimal_vertex(weight)
            {
                return vertex;
            }
        }
        let newton = if local.here == 0 {
            solve2(local.hessian, [-local.gradient[0], -local.gradient[1]])
        } else {
            None
        };
        let mut short_px = if newton.is_some() { SHORT_NEWTON_PX } else { SHORT_PX };
        let mut step = newton.unwrap_or_else(|| local.weiszfeld(weight, prior));
        let mut next = evaluate(u, v, weight, prior, [x[0] + step[0], x[1] + step[1]]);
        if newton.is_some() && !next.improves(&local) {
            short_px = SHORT_PX;
            step = local.weiszfeld(weight, prior);
            next = evaluate(u, v, weight, prior, [x[0] + step[0], x[1] + step[1]]);
        }
        if !next.improves(&local) {
            break;
        }
        x = [x[0] + step[0], x[1] + step[1]];
        local = next;
        if step[0].hypot(step[1]) <= short_px {
            break;
        }
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn cost(u: &[f64], v: &[f64], weight: f64, prior: &Quadratic, x: [f64; 2]) -> f64 {
        let data: f64 = u.iter().zip(v).map(|(u, v)| (u - x[0]).hypot(v - x[1])).sum();
        let value = weight * data + prior.value(x);
        let fast = median_cost(u, v, weight, prior, x);
        assert!((value - fast).abs() <= 1e-12 * (1.0 + value.abs()), "{value} {fast}");
        value
    }

    #[test]
    fn the_median_satisfies_the_optimality_condition_and_no_neighbour_is_better() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for case in 0..300 {
            let count = [1, 2, 3, 4, 7, 60, 250][case % 7];
            let side = [2, 6, 40][case / 7 % 3];
            let mut draw = || f64::from(rng.random_range(-side..=side));
            let (u, v): (Vec<f64>, Vec<f64>) = (0..count).map(|_| (draw(), draw())).unzip();
            let mut prior = Quadratic::default();
            if case % 3 > 0 {
                prior.add([0.3, 0.95], draw() / 3.0, 4.0);
            }
            if case % 3 > 1 {
                prior.add([0.95, -0.3], draw() / 3.0, 9.0);
            }
            let weight = 1.0 / f64::from(1 + side);
            let x = median(&u, &v, weight, &prior);
            let local = evaluate(&u, &v, weight, &prior, x);
            let norm = local.gradient[0].hypot(local.gradient[1]);
            assert!(norm <= weight * local.here as f64 + 1e-8, "case {case}: {norm} {local:?}");
            for angle in 0..16 {
                let (s, c) = (f64::from(angle) * 0.39).sin_cos();
                for radius in [1e-4, 0.1, 2.0] {
                    let y = [x[0] + radius * c, x[1] + radius * s];
                    assert!(
                        cost(&u, &v, weight, &prior, x)
                            <= cost(&u, &v, weight, &prior, y) + 1e-12 * (1.0 + count as f64)
                    );
                }
            }
        }
    }

    #[test]
    fn collinear_and_coincident_pixels_have_a_median() {
        let x = median(&[-3.0, 1.0, 2.0, 10.0], &[0.0; 4], 0.1, &Quadratic::default());
        assert!((1.0..=2.0).contains(&x[0]) && x[1] == 0.0, "{x:?}");
        let x = median(&[-3.0, 1.0, 10.0], &[-3.0, 1.0, 10.0], 0.1, &Quadratic::default());
        assert_eq!(x, [1.0, 1.0]);
        let x = median(&[5.0; 9], &[7.0; 9], 0.1, &Quadratic::default());
        assert!((x[0] - 5.0).abs().max((x[1] - 7.0).abs()) < 1e-12, "{x:?}");
    }

    #[test]
    fn without_pixels_the_prior_decides_and_moves_no_further_than_it_must() {
        let mut prior = Quadratic::default();
        assert_eq!(median(&[], &[], 1.0, &prior), [0.0, 0.0]);
        prior.add([0.6, 0.8], 5.0, 2.0);
        let x = median(&[], &[], 1.0, &prior);
        approx::assert_abs_diff_eq!(x[0], 3.0, epsilon = 1e-12);
        approx::assert_abs_diff_eq!(x[1], 4.0, epsilon = 1e-12);
        prior.add([1.0, 0.0], 0.0, 2.0);
        let x = mean(&[], &[], 1.0, &prior);
        approx::assert_abs_diff_eq!(x[0], 0.0, epsilon = 1e-9);
        approx::assert_abs_diff_eq!(x[1], 6.25, epsilon = 1e-9);
    }

    #[test]
    fn the_mean_without_a_prior_is_the_mean() {
        let x = mean(&[1.0, 2.0, 6.0], &[0.0, 3.0, 3.0], 0.7, &Quadratic::default());
        assert!((x[0] - 3.0).abs().max((x[1] - 2.0).abs()) < 1e-12, "{x:?}");
    }
}
