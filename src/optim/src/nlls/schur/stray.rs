//! Points that a joint step leaves far off, and where they belong.
//!
//! A joint step moves every point as if projection were linear. Where cameras move far that throws a few points to the wrong side of a
//! ray, where they stay: their own gradient is small there, and they hold their cameras back with them. With the cameras of the trial
//! values fixed a point is a problem of its own with `P` unknowns,
//!
//! ```text
//! min_x  1/2 sum_i rho(|r_i(x)|^2)
//! ```
//!
//! which is solved by Levenberg-Marquardt from where the step left the point, from where it was, and from some places on the ray through
//! it, also behind where it is seen from: a start may be there. What ends behind more cameras than the step left it is not taken. Only
//! points whose cost is many times the mean are looked at: in a block that converges there are none.
//!
//! Reference: Y. Jeong, D. Nister, D. Steedly, R. Szeliski, I.-S. Kweon, "Pushing the envelope of modern methods for bundle
//! adjustment", CVPR 2010 (embedded point iterations).

use super::{
    lanes::CameraCache,
    layout::Layout,
    point_system::{PointSystem, PriorSums},
};
use crate::nlls::{loss::BatchLoss, projection::SizedFactor};

// These were compared by final cost on `synth bundle --preset ladybug-1723`, seeds 1 to 8, and BAL's 49-7776 with `rowgram adjust --cost-tolerance 1e-6`
// (docs/decisions.md); of the distances with and without those behind, of the others no other values were tried.

/// Steps from each start, and the damping of the first.
const STEPS: usize = 12;
const DAMPING: f64 = 1e-3;
/// A step that gains less than this share of the cost is the last.
const GAIN: f64 = 1e-3;
/// Distances along the ray, in multiples of the one where the point was.
const ALONG_RAY: [f64; 9] = [0.5, 2.0, 0.25, 4.0, 0.1, 10.0, -1.0, -0.25, -4.0];

/// One point, with the cameras that see it at fixed values.
pub(super) struct LonePoint<'a, const K: usize, const S: usize, const D: usize> {
    pub(super) layout: &'a Layout<K, S, D>,
    /// Its place among the points.
    pub(super) point: usize,
    /// What the factor prepared of the cameras.
    pub(super) prepared: &'a CameraCache,
    pub(super) loss: &'a BatchLoss,
}

impl<const K: usize, const S: usize, const D: usize> LonePoint<'_, K, S, D> {
    fn observations(&self) -> std::ops::Range<usize> {
        let points = &self.layout.points;
        points[self.point].first as usize..points[self.point + 1].first as usize
    }

    fn camera<const Q: usize>(&self, observation: usize) -> [f64; Q] {
        let at = self.layout.observed_by[observation] as usize * self.prepared.stride;
        std::array::from_fn(|k| self.prepared.values[at + k])
    }

    /// Its cost at `x`; infinite where an observation is infeasible.
    pub(super) fn cost<F, const R: usize, const P: usize, const Q: usize>(
        &self,
        x: &[f64; P],
    ) -> f64
    where
        F: SizedFactor<R, K, S, P, Q, D>,
    {
        let mut total = 0.0;
        for i in self.observations() {
            let residual = F::residual(&self.camera::<Q>(i), x, &self.layout.data[i]);
            let square: f64 = residual.iter().map(|r| r * r).sum();
            total += self.loss.evaluate(square).value;
        }
        if total.is_finite() { 0.5 * total } else { f64::INFINITY }
    }

    /// How many cameras it is behind at `x`.
    fn behind<F, const R: usize, const P: usize, const Q: usize>(&self, x: &[f64; P]) -> usize
    where
        F: SizedFactor<R, K, S, P, Q, D>,
    {
        self.observations().filter(|&i| !F::is_in_front(&self.camera::<Q>(i), x)).count()
    }

    /// Where it costs least, from several starts, and that cost; `x` and `cost` where none is better.
    pub(super) fn best<F, const R: usize, const P: usize, const Q: usize>(
        &self,
        (x, cost): ([f64; P], f64),
        before: [f64; P],
        seen_from: Option<&[f64; P]>,
    ) -> ([f64; P], f64)
    where
        F: SizedFactor<R, K, S, P, Q, D>,
    {
        let mut best = (x, cost);
        let behind = self.behind::<F, R, P, Q>(&x);
        let mut descend = |start: [f64; P]| {
            let found = self.descend::<F, R, P, Q>(start);
            if found.1 < best.1 && self.behind::<F, R, P, Q>(&found.0) <= behind {
                best = found;
            }
        };
        descend(x);
        descend(before);
        if let Some(from) = seen_from {
            for factor in ALONG_RAY {
                descend(std::array::from_fn(|k| from[k] + factor * (before[k] - from[k])));
            }
        }
        best
    }

    fn descend<F, const R: usize, const P: usize, const Q: usize>(
        &self,
        start: [f64; P],
    ) -> ([f64; P], f64)
    where
        F: SizedFactor<R, K, S, P, Q, D>,
    {
        let (mut x, mut cost, mut damping) = (start, self.cost::<F, R, P, Q>(&start), DAMPING);
        if !cost.is_finite() {
            return (x, cost);
        }
        for _ in 0..STEPS {
            let sums = self.linearize::<F, R, P, Q>(&x);
            let mut system = PointSystem::new::<R>(&[], Some(&sums));
            if !system.factorize(damping, 0) {
                break;
            }
            let step = system.backward(system.forward(system.g)).map(|v| -v);
            let to = std::array::from_fn(|k| x[k] + step[k]);
            let there = self.cost::<F, R, P, Q>(&to);
            if there < cost {
                let gain = (cost - there) / cost;
                (x, cost) = (to, there);
                damping *= 0.1;
                if gain < GAIN {
                    break;
                }
            } else {
                damping *= 10.0;
            }
        }
        (x, cost)
    }

    /// The sums of its normal equations at `x`, by Gauss-Newton.
    fn linearize<F, const R: usize, const P: usize, const Q: usize>(
        &self,
        x: &[f64; P],
    ) -> PriorSums<P>
    where
        F: SizedFactor<R, K, S, P, Q, D>,
    {
        let mut sums = PriorSums::NONE;
        for i in self.observations() {
            let found = F::linearize(&self.camera::<Q>(i), x, &self.layout.data[i]);
            let square: f64 = found.residual.iter().map(|r| r * r).sum();
            let weight = self.loss.evaluate(square).first.max(0.0).sqrt();
            for (row, residual) in found.jacobian_point.iter().zip(found.residual) {
                sums.add(&row.map(|v| weight * v), weight * residual);
            }
        }
        sums
    }
}
