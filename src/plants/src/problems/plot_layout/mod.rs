//! Where the plots of a field lie: a plan of plots, moved onto surveyed corners or onto the rows that were found.
//!
//! A plan has places `(s, t)`, metres: `s` along the rows, `t` across them to the left, from the middle of the field. With
//! the plan's nominal place on the map (origin `o`, heading `h` of the rows, counter-clockwise from east) the map position is
//!
//! ```text
//! x(s, t) = o + R(h) q,    q = [u; v] + R(theta) [ (1 + a) s ; (1 + b) t + k s + B(s / l) ]
//! B(z)    = c2 P2(z) + c3 P3(z) + c4 P4(z)
//! ```
//!
//! with the shift `u, v` (metres), the rotation `theta` (radians), the stretches `a` along and `b` across, the shear `k`, and
//! the bend that all rows share: Legendre polynomials over half the length `l` of the field, which are orthogonal to
//! shift and shear. Corners ([`corners`]) are observations of `q` itself, without bend. Rows that were found ([`fit`]) observe,
//! with `q' = R(-theta) (q - [u; v])`,
//!
//! ```text
//! across:  q'_2 - (1 + b) t_row(s) - k s - B(s / l) - d_row - w_2 = r,    s = q'_1 / (1 + a),    r ~ N(0, sigma_r^2)
//! ends:    q'_1 - (1 + a) (s_end +- g) - f_end - w_1 = e,                                        e ~ N(0, sigma_e^2)
//! ```
//!
//! `d_row ~ N(0, sigma_d^2)` is how far a row was planted beside its place, `g` how far the outermost plants stay from the end of a plot,
//! `f_end ~ N(0, sigma_f^2)` how far a whole line of ends is off, and `w` the shift of a single plot, where that is asked for. All
//! parameters have normal priors, so that nothing is undetermined; their standard deviations are options. The residuals of
//! rows and ends have Huber's loss. The four variances are estimated with the parameters (restricted
//! maximum likelihood by expectation maximisation for `sigma_d`, `sigma_f`; Huber's proposal 2 for `sigma_r`, `sigma_e`).
//!
//! Reference: P. J. Huber and E. M. Ronchetti, *Robust Statistics*, 2009, chapter 7; S. R. Searle et al., *Variance
//! Components*, 1992, chapter 8.

pub mod corners;
pub mod fit;

use rowgram_optim::nlls::{Dual, Scalar};

/// Free numbers of [`Placement::affine`].
pub const AFFINE: usize = 6;
/// Free numbers of `Placement::bend`.
pub const BEND: usize = 3;

/// Free numbers of a placement.
pub const FREE: usize = AFFINE + BEND;
/// Covariance of the affine numbers and the bend, row-major.
pub type Covariance = [[f64; FREE]; FREE];

/// Where a plan lies on the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// `o`, metres on the map.
    pub origin_m: [f64; 2],
    /// `h`, radians counter-clockwise from east.
    pub heading_rad: f64,
    /// `l`, half the length of the field along the rows, metres.
    pub half_length_m: f64,
    /// `u`, `v` in metres, `theta` in radians, `a`, `b`, `k`.
    pub affine: [f64; AFFINE],
    /// `c2`, `c3`, `c4`, metres.
    pub bend_m: [f64; BEND],
}

impl Placement {
    /// A plan in its nominal place.
    pub fn nominal(origin_m: [f64; 2], heading_rad: f64, half_length_m: f64) -> Placement {
        let (affine, bend_m) = ([0.0; AFFINE], [0.0; BEND]);
        Placement { origin_m, heading_rad, half_length_m, affine, bend_m }
    }

    /// The map position of a place of the plan, metres.
    pub fn map(&self, at: [f64; 2]) -> [f64; 2] {
        let q = moved(&self.affine, &self.bend_m, self.half_length_m, at);
        let (sin, cos) = self.heading_rad.sin_cos();
        [self.origin_m[0] + cos * q[0] - sin * q[1], self.origin_m[1] + sin * q[0] + cos * q[1]]
    }

    /// `q` of a map position: from the origin, along and across the heading, metres.
    pub fn frame(&self, at_m: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.heading_rad.sin_cos();
        let [x, y] = [at_m[0] - self.origin_m[0], at_m[1] - self.origin_m[1]];
        [cos * x + sin * y, cos * y - sin * x]
    }

    /// The place in the plan of a map position.
    pub fn plan(&self, at_m: [f64; 2]) -> [f64; 2] {
        let back = unmoved(&self.affine, self.frame(at_m));
        let s = back[0] / (1.0 + self.affine[3]);
        let across = back[1] - self.affine[5] * s - bend(&self.bend_m, s / self.half_length_m);
        [s, across / (1.0 + self.affine[4])]
    }

    /// Derivatives of `q` at a place of the plan by the affine numbers, then by the bend: along, across.
    pub fn derivatives(&self, at: [f64; 2]) -> [[f64; FREE]; 2] {
        let affine: [Dual<FREE>; AFFINE] =
            std::array::from_fn(|k| Dual::variable(self.affine[k], k));
        let bend: [Dual<FREE>; BEND] =
            std::array::from_fn(|k| Dual::variable(self.bend_m[k], AFFINE + k));
        moved(&affine, &bend, self.half_length_m, at).map(|q| q.derivatives)
    }

    /// Standard deviations of the map position of a place of the plan along and across the heading, metres, by the
    /// covariance of the affine numbers and the bend.
    pub fn sigma_m(&self, covariance: &Covariance, at: [f64; 2]) -> [f64; 2] {
        self.derivatives(at).map(|row| {
            let of = |j: usize| (0..FREE).map(|k| covariance[j][k] * row[k]).sum::<f64>();
            (0..FREE).map(|j| row[j] * of(j)).sum::<f64>().max(0.0).sqrt()
        })
    }

    /// The greatest distance of a row from its chord over a length of the plan, metres.
    pub fn sagitta_m(&self, from: [f64; 2], to: [f64; 2]) -> f64 {
        let at = |share: f64| {
            bend(&self.bend_m, (from[0] + share * (to[0] - from[0])) / self.half_length_m)
        };
        let chord = |share: f64| at(0.0) + share * (at(1.0) - at(0.0));
        (1..8)
            .map(|k| f64::from(k) / 8.0)
            .fold(0.0, |most, share| f64::max(most, (at(share) - chord(share)).abs()))
    }
}

/// `q` of a place of the plan.
fn moved<T: Scalar>(
    [u, v, theta, a, b, k]: &[T; AFFINE],
    bend_m: &[T; BEND],
    half_length_m: f64,
    [s, t]: [f64; 2],
) -> [T; 2] {
    let (sin, cos) = (theta.sin(), theta.cos());
    let along = (*a + 1.0) * s;
    let across = (*b + 1.0) * t + *k * s + bend(bend_m, T::constant(s / half_length_m));
    [*u + cos * along - sin * across, *v + sin * along + cos * across]
}

/// `R(-theta) (q - [u; v])`.
fn unmoved<T: Scalar>([u, v, theta, ..]: &[T; AFFINE], q: [f64; 2]) -> [T; 2] {
    let (sin, cos) = (theta.sin(), theta.cos());
    let [x, y] = [-*u + q[0], -*v + q[1]];
    [cos * x + sin * y, cos * y - sin * x]
}

/// `B(z)`; constant beyond the ends, where nothing observes it.
fn bend<T: Scalar>([c2, c3, c4]: &[T; BEND], z: T) -> T {
    let z = if z.value().abs() > 1.0 { T::constant(z.value().signum()) } else { z };
    let z2 = z * z;
    *c2 * (z2 * 1.5 + -0.5)
        + *c3 * ((z2 * 2.5 + -1.5) * z)
        + *c4 * ((z2 * 4.375 + -3.75) * z2 + 0.375)
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    #[test]
    fn map_and_plan_are_inverse_and_derivatives_are_true() {
        let placement = Placement {
            origin_m: [500_000.0, 4_480_000.0],
            heading_rad: 0.4,
            half_length_m: 9.0,
            affine: [0.4, -0.3, 0.02, 0.01, -0.008, 0.003],
            bend_m: [0.05, -0.02, 0.01],
        };
        for at in [[-9.0, 7.0], [0.0, 0.0], [3.3, -6.1]] {
            let back = placement.plan(placement.map(at));
            assert_abs_diff_eq!(back[0], at[0], epsilon = 1e-8);
            assert_abs_diff_eq!(back[1], at[1], epsilon = 1e-8);
            let found = placement.derivatives(at);
            for k in 0..FREE {
                let with = |step: f64| {
                    let mut other = placement;
                    let numbers = other.affine.iter_mut().chain(&mut other.bend_m);
                    numbers.enumerate().filter(|(n, _)| *n == k).for_each(|(_, x)| *x += step);
                    other.frame(other.map(at))
                };
                let (low, high) = (with(-1e-4), with(1e-4));
                for row in 0..2 {
                    // Map coordinates of 4e6 m leave 1e-9 m, over steps of 2e-4.
                    let difference = (high[row] - low[row]) / 2e-4;
                    assert_abs_diff_eq!(found[row][k], difference, epsilon = 2e-4);
                }
            }
        }
    }

    #[test]
    fn a_bow_has_its_sagitta_and_no_mean() {
        let mut placement = Placement::nominal([0.0; 2], 0.0, 10.0);
        placement.bend_m = [0.06, 0.0, 0.0];
        // 1.5 c2 z^2 - 0.5 c2 from z = -1 to 1.
        assert_abs_diff_eq!(placement.sagitta_m([-10.0, 0.0], [10.0, 0.0]), 0.09, epsilon = 1e-12);
        let mean: f64 =
            (0..2000).map(|k| placement.map([-9.995 + 0.01 * f64::from(k), 0.0])[1]).sum();
        assert_abs_diff_eq!(mean / 2000.0, 0.0, epsilon = 1e-6);
    }
}
