//! The fused path: linearise, eliminate and forget, point by point.
//!
//! A point's observations are linearised several per register; then, with `V = sum Jp^T Jp + lambda D =
//! L L^T`, `Q_i = Jp_i L^-T` and `u = L^-1 g`, the reduced system receives for each pair of its cameras
//!
//! ```text
//! S_ij -= Jc_i^T (Q_i Q_j^T) Jc_j      S_ii += Jc_i^T (I - Q_i Q_i^T) Jc_i      b_i -= Jc_i^T Q_i u
//! ```
//!
//! a product of rank `R` (2 for image measurements) where the usual `W V^-1 W^T` has rank `P` (3). With
//! a shared block, `T = sum Q_i^T Js_i` gives `S_is += Jc_i^T (Js_i - Q_i T)` and `S_ss += sum Js^T Js - T^T T`.
//! Back-substitution linearises once more instead of reading Jacobians from memory, moves the point
//! and evaluates the trial cost while it is at hand. Nothing per observation is ever stored. A factor of another
//! batch that depends on a point alone, a prior, is stored and enters `V` and `g` of its point.
//!
//! Where the reduced system is not formed ([`product`]), `Jc` and `Q` of all observations are stored for its products.

mod accumulate;
mod lanes;
mod layout;
mod linearize;
mod plan;
mod point;
mod point_system;
mod prior;
mod product;
mod shared_block;
mod stray;
mod sweep;

use super::{
    cholesky::{BlockMatrix, NotPositiveDefinite},
    factor::Linearization,
    loss::BatchLoss,
    problem::Problem,
    projection::{Measurement, SizedFactor},
    structure::Structure,
};
use lanes::chunk_cost;
use plan::FusedPlan;
use rayon::prelude::*;
use sweep::{back_substitute_chunk, eliminate_chunk};

/// What a batch needs to know to offer its fused form.
#[derive(Debug)]
pub struct FusionRequest<'a> {
    problem: &'a Problem,
    structure: &'a Structure,
    matrix: &'a BlockMatrix,
    batch: usize,
    /// Store Jacobians for products with the reduced system, whose matrix holds diagonal blocks only.
    implicit: bool,
}

/// A batch's fused form.
#[derive(Debug)]
pub struct FusedElimination(pub(super) Box<dyn Eliminator>);

/// The batch that carries the eliminated blocks in its fused form, or why none can: of those with a factor of the
/// first block, the longest that can be fused.
pub(super) fn find(
    problem: &Problem,
    structure: &Structure,
    matrix: &BlockMatrix,
    implicit: bool,
) -> Result<(usize, FusedElimination), String> {
    let mut candidates: Vec<usize> =
        structure.factors(0).iter().map(|&(batch, _)| batch as usize).collect();
    candidates.dedup();
    candidates.sort_by_key(|&batch| std::cmp::Reverse(problem.batches[batch].batch.len()));
    let mut why = None;
    for batch in candidates {
        let request = FusionRequest { problem, structure, matrix, batch, implicit };
        match problem.batches[batch].batch.fuse(request) {
            Ok(work) => return Ok((batch, work)),
            Err(reason) => why = why.or(Some(reason)),
        }
    }
    Err(why.unwrap_or_else(|| "no block is marked for elimination".into()))
}

impl FusedElimination {
    pub(super) fn new<
        F: SizedFactor<R, K, S, P, Q, D>,
        const R: usize,
        const K: usize,
        const S: usize,
        const P: usize,
        const Q: usize,
        const D: usize,
    >(
        pairs: &[Measurement<D>],
        request: FusionRequest<'_>,
    ) -> Result<FusedElimination, String> {
        let plan = FusedPlan::<F, R, K, S, P, Q, D>::new(pairs, request)?;
        Ok(FusedElimination(Box::new(plan)))
    }
}

/// What decides one linearisation.
#[derive(Debug, Clone, Copy)]
pub(super) struct Settings<'a> {
    pub(super) loss: &'a BatchLoss,
    pub(super) curvature_share: f64,
    pub(super) lambda: f64,
}

/// Where the sums of a reduction go; retained blocks only.
pub(super) struct NormalEquationsMut<'a> {
    pub(super) matrix: &'a mut BlockMatrix,
    /// `J^T r` and the diagonal of `J^T J` over tangents.
    pub(super) gradient: &'a mut [f64],
    pub(super) diagonal: &'a mut [f64],
    /// `-W V^-1 g_e` over the reduced system.
    pub(super) correction: &'a mut [f64],
}

/// What came of moving the points.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct BackSubstitution {
    /// Cost at the trial values; infinite where one of them is infeasible.
    pub(super) cost: f64,
    /// The points' part of the predicted decrease.
    pub(super) predicted: f64,
    /// The points' part of `|D^1/2 d|^2`.
    pub(super) squared_length: f64,
    /// The largest entry of any point's step.
    pub(super) step_norm: f64,
}

/// What the engine asks of a fused batch.
pub(super) trait Eliminator: Send + Sync + std::fmt::Debug {
    /// The cost at `x`; infinite where a factor is infeasible.
    fn cost(&mut self, problem: &Problem, x: &[f64], loss: &BatchLoss) -> f64;

    /// Adds the batch to the reduced system; returns the largest `|g_k| / sqrt(D_k)` of the points.
    /// `linearizations` are those of the other batches, whose factors of single points are priors.
    fn reduce(
        &mut self,
        problem: &Problem,
        x: &[f64],
        linearizations: &[Linearization],
        settings: Settings<'_>,
        sums: NormalEquationsMut<'_>,
    ) -> Result<f64, NotPositiveDefinite>;

    /// `y += S x` of the linearisation that was reduced last, without the damping of retained blocks: over the reduced
    /// system, whose blocks begin at `starts`.
    fn multiply(&mut self, starts: &[usize], x: &[f64], y: &mut [f64]);

    /// Writes the moved points into `trial`, which holds the moved retained blocks already; `step` is
    /// the retained blocks' step. A point whose observations cost more than a cost, shared among the observations of the batch, is
    /// started again.
    fn substitute(
        &mut self,
        problem: &Problem,
        x: &[f64],
        settings_and_restart_cost: (Settings<'_>, Option<f64>),
        step: &[f64],
        trial: &mut [f64],
    ) -> BackSubstitution;
}

impl<
    F: SizedFactor<R, K, S, P, Q, D>,
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const Q: usize,
    const D: usize,
> Eliminator for FusedPlan<F, R, K, S, P, Q, D>
{
    fn cost(&mut self, problem: &Problem, x: &[f64], loss: &BatchLoss) -> f64 {
        self.prepare(problem, x);
        let (layout, prepared) = (&self.layout, &self.prepared);
        let costs: Vec<f64> = self
            .chunks
            .par_iter()
            .map(|chunk| chunk_cost::<F, R, K, S, P, Q, D>(layout, chunk, prepared, x, loss))
            .collect();
        finite_or_infinite(costs.iter().sum::<f64>())
    }

    fn reduce(
        &mut self,
        problem: &Problem,
        x: &[f64],
        linearizations: &[Linearization],
        settings: Settings<'_>,
        mut sums: NormalEquationsMut<'_>,
    ) -> Result<f64, NotPositiveDefinite> {
        self.prepare(problem, x);
        self.priors.sum(problem, linearizations);
        let priors = &self.priors.sums;
        let (layout, prepared) = (&self.layout, &self.prepared);
        // The first chunk that fails is reported, whichever thread is the fastest.
        let largest = self
            .chunks
            .par_iter_mut()
            .map(|chunk| {
                eliminate_chunk::<F, R, K, S, P, Q, D>(layout, chunk, prepared, priors, x, settings)
            })
            .collect::<Vec<_>>()
            .into_iter()
            .collect::<Result<Vec<f64>, NotPositiveDefinite>>()?;
        for chunk in &self.chunks {
            layout.add_chunk(chunk, &mut sums);
        }
        Ok(largest.into_iter().fold(0.0, f64::max))
    }

    fn multiply(&mut self, starts: &[usize], x: &[f64], y: &mut [f64]) {
        self.multiply_reduced(starts, x, y);
    }

    fn substitute(
        &mut self,
        problem: &Problem,
        x: &[f64],
        (settings, restart_cost): (Settings<'_>, Option<f64>),
        step: &[f64],
        trial: &mut [f64],
    ) -> BackSubstitution {
        self.prepare_steps(problem, step);
        self.prepare_trial(problem, trial);
        let (layout, priors) = (&self.layout, &self.priors.sums);
        let prepared = (&self.prepared, &self.trial_prepared);
        let stray = restart_cost.map_or(f64::INFINITY, |cost| cost / layout.data.len() as f64);
        let moved: Vec<BackSubstitution> = self
            .chunks
            .par_iter_mut()
            .map(|chunk| {
                back_substitute_chunk::<F, R, K, S, P, Q, D>(
                    layout,
                    chunk,
                    prepared,
                    priors,
                    x,
                    (settings, stray),
                )
            })
            .collect();
        for chunk in &self.chunks {
            for (e, values) in chunk.range.clone().zip(&chunk.moved) {
                let at = layout.points[e].at as usize;
                trial[at..at + P].copy_from_slice(values);
            }
        }
        let mut total = BackSubstitution::default();
        for moved in moved {
            total.cost += moved.cost;
            total.predicted += moved.predicted;
            total.squared_length += moved.squared_length;
            total.step_norm = total.step_norm.max(moved.step_norm);
        }
        total.cost = finite_or_infinite(total.cost);
        total
    }
}

fn finite_or_infinite(cost: f64) -> f64 {
    if cost.is_finite() { cost } else { f64::INFINITY }
}
