//! Residual factors and the homogeneous batches that the engine works on.
//!
//! A factor is one residual `r(x_1, ..., x_k)` of a few parameter blocks, whitened (divided by its
//! standard deviation), with its Jacobian `[dr/dx_1 ... dr/dx_k]` with respect to the *tangent* of
//! each block ([`Manifold`]).

use super::{
    loss::BatchLoss,
    problem::BlockId,
    schur::{FusedElimination, FusionRequest},
};
use rayon::prelude::*;
use std::ops::Range;

/// A factor cannot be evaluated at these values: a point behind the camera, say.
///
/// Where a step leads there, the step is refused; at the start it is an error. It is never a zero
/// residual, which would reward going there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Infeasible;

/// The Jacobian of one factor: `rows` by the tangent dimensions of its blocks, side by side.
#[derive(Debug)]
pub struct Jacobian<'a> {
    entries: &'a mut [f64],
    width: usize,
}

impl<'a> Jacobian<'a> {
    /// A Jacobian over `entries`, row-major with rows of length `width`.
    pub fn new(entries: &'a mut [f64], width: usize) -> Jacobian<'a> {
        debug_assert!(width > 0 && entries.len().is_multiple_of(width));
        Jacobian { entries, width }
    }

    pub(super) fn entries(&mut self) -> &mut [f64] {
        self.entries
    }

    /// Row `row`: the derivatives by the first block, then by the second, and so on. All zero
    /// when the factor gets it.
    pub fn row(&mut self, row: usize) -> &mut [f64] {
        &mut self.entries[row * self.width..(row + 1) * self.width]
    }
}

/// One residual of a few parameter blocks.
///
/// This is the open set: a new kind of observation or prior is one type with this trait, and
/// [`super::check::check_jacobian`] tests it.
pub trait Factor: Send + Sync {
    /// Length of the residual; the same for all factors of one type.
    fn rows(&self) -> usize;

    /// The blocks it depends on, each once. All factors of one batch have blocks of the same
    /// tangent dimensions in the same order.
    fn blocks(&self) -> &[BlockId];

    /// Writes the residual and, where wanted, its Jacobian. `x` holds the values of
    /// [`Factor::blocks`] in their order.
    ///
    /// # Errors
    /// [`Infeasible`] where the residual has no meaning.
    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible>;
}

/// The current values of all blocks, as factors see them.
#[derive(Debug, Clone, Copy)]
pub struct Values<'a> {
    pub(super) values: &'a [f64],
    pub(super) offsets: &'a [usize],
}

impl<'a> Values<'a> {
    /// The values of one block.
    #[inline]
    pub fn block(&self, id: BlockId) -> &'a [f64] {
        let k = id.index();
        &self.values[self.offsets[k]..self.offsets[k + 1]]
    }
}

/// Which factor of a batch could not be evaluated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InfeasibleFactor(pub usize);

/// A run of factors of one type; what the engine calls.
///
/// [`Factors`] makes one from any list of factors.
pub trait Batch: Send + Sync {
    /// How many factors there are.
    fn len(&self) -> usize;

    /// Whether there is none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Length of each residual.
    fn rows(&self) -> usize;

    /// Length of the residual of one factor; [`super::Problem::add`] requires that of all.
    fn rows_of(&self, _factor: usize) -> usize {
        self.rows()
    }

    /// The blocks of one factor.
    fn blocks(&self, factor: usize) -> &[BlockId];

    /// Linearises the factors of `range`: residuals one after the other, Jacobians (if wanted,
    /// zeroed by the caller) one after the other in the layout of [`Jacobian`] with rows of
    /// length `width`. The residuals are the same with and without Jacobians.
    ///
    /// # Errors
    /// The first factor of the range that is infeasible.
    fn linearize(
        &self,
        range: Range<usize>,
        x: Values<'_>,
        residual: &mut [f64],
        jacobian: Option<&mut [f64]>,
        width: usize,
    ) -> Result<(), InfeasibleFactor>;

    /// Numbers stored by each block of a factor and the sum of their tangent dimensions, where the
    /// type of the batch says so: [`super::Problem::add`] compares them.
    fn expected_sizes(&self) -> Option<(Vec<usize>, usize)> {
        None
    }

    /// The batch's fused form, where it has one ([`super::ProjectionFactor`]).
    ///
    /// # Errors
    /// Why it has none, for [`super::BatchPath`].
    fn fuse(&self, _request: FusionRequest<'_>) -> Result<FusedElimination, String> {
        Err("only a ProjectionBatch can be eliminated while it is linearised".into())
    }
}

/// A batch made of single factors.
#[derive(Debug, Clone)]
pub struct Factors<F>(pub Vec<F>);

/// The most blocks one factor may have.
pub(super) const MAX_ARITY: usize = 8;

impl<F: Factor> Batch for Factors<F> {
    fn len(&self) -> usize {
        self.0.len()
    }

    fn rows(&self) -> usize {
        self.0.first().map_or(0, Factor::rows)
    }

    fn rows_of(&self, factor: usize) -> usize {
        self.0[factor].rows()
    }

    fn blocks(&self, factor: usize) -> &[BlockId] {
        self.0[factor].blocks()
    }

    fn linearize(
        &self,
        range: Range<usize>,
        x: Values<'_>,
        residual: &mut [f64],
        mut jacobian: Option<&mut [f64]>,
        width: usize,
    ) -> Result<(), InfeasibleFactor> {
        let rows = self.rows();
        let stride = rows * width;
        let first = range.start;
        for (k, factor) in self.0[range].iter().enumerate() {
            let mut values: [&[f64]; MAX_ARITY] = [&[]; MAX_ARITY];
            let blocks = factor.blocks();
            for (value, &block) in values.iter_mut().zip(blocks) {
                *value = x.block(block);
            }
            let mut entries = jacobian
                .as_deref_mut()
                .map(|all| Jacobian::new(&mut all[k * stride..(k + 1) * stride], width));
            factor
                .linearize(
                    &values[..blocks.len()],
                    &mut residual[k * rows..(k + 1) * rows],
                    entries.as_mut(),
                )
                .map_err(|Infeasible| InfeasibleFactor(first + k))?;
        }
        Ok(())
    }
}

/// Factors handled by one task; fixed, so that partial sums never depend on the threads.
const FACTORS_PER_TASK: usize = 512;

/// Residuals and Jacobians of one batch at one point, weighted by its loss.
#[derive(Debug, Default, Clone)]
pub(super) struct Linearization {
    pub(super) residual: Vec<f64>,
    pub(super) jacobian: Vec<f64>,
}

/// How the loss enters the normal equations: which share of its (negative) curvature along the
/// residual is stored, next to its weight `rho'`.
///
/// All of it is the Gauss-Newton Hessian of the robust cost itself, right near the optimum and far
/// too optimistic away from it; none of it is iteratively reweighted least squares, safe
/// everywhere and slow at the end, where its model promises half of what a step gains.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Curvature {
    /// None at first, then by how well the model predicts the decrease.
    #[default]
    Adaptive,
    /// All (Triggs' correction).
    Full,
    /// None (iteratively reweighted least squares).
    Reweighted,
}

/// The residuals of a batch, one after the other.
pub(super) fn batch_residuals(
    batch: &dyn Batch,
    x: Values<'_>,
) -> Result<Vec<f64>, InfeasibleFactor> {
    let rows = batch.rows();
    let mut residual = vec![0.0; batch.len() * rows];
    residual
        .par_chunks_mut(FACTORS_PER_TASK * rows)
        .enumerate()
        .map(|(chunk, residual)| {
            let first = chunk * FACTORS_PER_TASK;
            batch.linearize(first..first + residual.len() / rows, x, residual, None, 1)
        })
        .collect::<Result<(), InfeasibleFactor>>()?;
    Ok(residual)
}

/// Evaluates `1/2 sum rho(|r|^2)` over a batch; `residual` is its working memory.
pub(super) fn batch_cost(
    batch: &dyn Batch,
    loss: &BatchLoss,
    x: Values<'_>,
    residual: &mut Vec<f64>,
) -> Result<f64, InfeasibleFactor> {
    let rows = batch.rows();
    residual.resize(batch.len() * rows, 0.0);
    let partial: Result<Vec<f64>, _> = residual
        .par_chunks_mut(FACTORS_PER_TASK * rows)
        .enumerate()
        .map(|(chunk, residual)| {
            let first = chunk * FACTORS_PER_TASK;
            let count = residual.len() / rows;
            let range = first..first + count;
            batch.linearize(range, x, residual, None, 1)?;
            Ok(chunk_cost(residual, rows, loss))
        })
        .collect();
    Ok(0.5 * partial?.iter().sum::<f64>())
}

fn chunk_cost(residual: &[f64], rows: usize, loss: &BatchLoss) -> f64 {
    residual.chunks_exact(rows).map(|r| loss.evaluate(r.iter().map(|v| v * v).sum()).value).sum()
}

/// Linearises a batch and folds the loss into residuals and Jacobians; returns its cost.
pub(super) fn linearize_batch(
    batch: &dyn Batch,
    loss: &BatchLoss,
    curvature_share: f64,
    x: Values<'_>,
    width: usize,
    out: &mut Linearization,
) -> Result<f64, InfeasibleFactor> {
    let rows = batch.rows();
    let stride = rows * width;
    out.residual.resize(batch.len() * rows, 0.0);
    out.jacobian.resize(batch.len() * stride, 0.0);
    let partial: Result<Vec<f64>, _> = out
        .residual
        .par_chunks_mut(FACTORS_PER_TASK * rows)
        .zip(out.jacobian.par_chunks_mut(FACTORS_PER_TASK * stride))
        .enumerate()
        .map(|(chunk, (residual, jacobian))| {
            let first = chunk * FACTORS_PER_TASK;
            let range = first..first + residual.len() / rows;
            jacobian.fill(0.0);
            batch.linearize(range, x, residual, Some(jacobian), width)?;
            let cost = chunk_cost(residual, rows, loss);
            if !loss.is_trivial() {
                for (r, j) in residual.chunks_exact_mut(rows).zip(jacobian.chunks_exact_mut(stride))
                {
                    apply_loss(loss, curvature_share, r, j, width);
                }
            }
            Ok(cost)
        })
        .collect();
    Ok(0.5 * partial?.iter().sum::<f64>())
}

/// Replaces `r`, `J` by `r~`, `J~` with `J~^T r~` the gradient of `1/2 rho(|r|^2)` and `J~^T J~` its
/// Gauss-Newton Hessian `rho' J^T (I + c 2 rho''/rho' r r^T) J` with the share `c` of the loss's
/// curvature, as far as that is positive (Triggs et al., section 4.3).
fn apply_loss(
    loss: &BatchLoss,
    curvature_share: f64,
    r: &mut [f64],
    jacobian: &mut [f64],
    width: usize,
) {
    let s: f64 = r.iter().map(|v| v * v).sum();
    let weights = robust_weights(loss, curvature_share, s);
    if weights.shift > 0.0 {
        for column in 0..width {
            let along: f64 =
                r.iter().enumerate().map(|(k, v)| v * jacobian[k * width + column]).sum();
            for (k, v) in r.iter().enumerate() {
                let entry = &mut jacobian[k * width + column];
                *entry = weights.jacobian * (*entry - weights.shift * along * v);
            }
        }
    } else {
        jacobian.iter_mut().for_each(|v| *v *= weights.jacobian);
    }
    r.iter_mut().for_each(|v| *v *= weights.residual);
}

/// How a loss changes one residual and its Jacobian: `J~ = jacobian (J - shift r r^T J)`,
/// `r~ = residual r`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weights {
    pub(super) jacobian: f64,
    pub(super) shift: f64,
    pub(super) residual: f64,
}

/// The weights at `s = |r|^2`.
#[inline]
pub(super) fn robust_weights(loss: &BatchLoss, curvature_share: f64, s: f64) -> Weights {
    let rho = loss.evaluate(s);
    let weight = rho.first.sqrt();
    if curvature_share == 0.0 || rho.second == 0.0 || s == 0.0 || rho.first == 0.0 {
        return Weights { jacobian: weight, shift: 0.0, residual: weight };
    }
    // alpha is held below 1 so that r / (1 - alpha) stays finite.
    let radial = 1.0 + 2.0 * curvature_share * s * rho.second / rho.first;
    let alpha = 1.0 - radial.max(MIN_RADIAL_CURVATURE).sqrt();
    Weights { jacobian: weight, shift: alpha / s, residual: weight / (1.0 - alpha) }
}

/// The least share of the curvature along an outlying residual that is left; 0 would be the exact
/// Hessian of Huber's linear part and leave the step there to the damping alone.
const MIN_RADIAL_CURVATURE: f64 = 1e-2;
