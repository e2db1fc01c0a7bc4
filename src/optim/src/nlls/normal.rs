//! The numeric part of the normal equations: linearise, eliminate, solve, substitute back.
//!
//! With eliminated blocks `e` and retained blocks `k`, residual `r` and Jacobian `[E F]`, a damped step
//! solves
//!
//! ```text
//! [ V    W^T ] [ d_e ]     [ g_e ]     V = E^T E + lambda D_e,  U = F^T F + lambda D_k,
//! [ W    U   ] [ d_k ] = - [ g_k ]     W = F^T E,  g_e = E^T r,  g_k = F^T r
//! ```
//!
//! by `S d_k = -(g_k - W V^-1 g_e)`, `S = U - W V^-1 W^T`, and `d_e = -V^-1 (g_e + W^T d_k)`, one small
//! `V` at a time. `D` is the diagonal of `J^T J` (Marquardt), 1 where that is 0. Entries that must not
//! move have zero columns in `J` and 1 on the diagonal.

mod assembly;

use super::{
    LinearSolver,
    cholesky::{BlockMatrix, NotPositiveDefinite},
    elimination::{PartialSums, damping, eliminate},
    factor::{InfeasibleFactor, Linearization, batch_cost, linearize_batch},
    problem::Problem,
    schur::{self, FusedElimination, NormalEquationsMut, Settings},
    schur_solver::SchurSolver,
    strategy,
    structure::{NONE, Structure},
    summary::{BatchPath, LinearPath},
};
use crate::engine::SolveError;
use rayon::prelude::*;

/// The normal equations of one problem, with all their state.
#[derive(Debug)]
pub(super) struct Normal {
    pub(super) structure: Structure,
    pub(super) linearizations: Vec<Linearization>,
    pub(super) partials: Vec<PartialSums>,
    pub(super) matrix: BlockMatrix,
    pub(super) solver: SchurSolver,
    pub(super) spare: Linearization,
    /// Share of the losses' curvature in the next linearisation.
    pub(super) curvature_share: f64,
    /// `J^T r` over the tangents of all blocks.
    pub(super) gradient: Vec<f64>,
    /// Diagonal of `J^T J` over the tangents of all blocks.
    pub(super) diagonal: Vec<f64>,
    /// `-(g_k - W V^-1 g_e)`, then `d_k`.
    pub(super) retained_vector: Vec<f64>,
    /// The batch that is eliminated without being stored, if there is one that can be.
    pub(super) fused: Option<(usize, FusedElimination)>,
    /// How the reduced system is solved.
    pub(super) linear_path: LinearPath,
    /// What damping adds to the diagonal of the reduced system.
    pub(super) shift: Vec<f64>,
    /// How each batch is evaluated.
    pub(super) paths: Vec<BatchPath>,
    /// The largest `|g_k| / sqrt(D_k)` of the points that the fused batch eliminates.
    pub(super) fused_slope: f64,
    /// Whether [`Normal::gradient`] and [`Normal::diagonal`] are those of the current linearisation; an elimination that
    /// fails leaves them unfinished.
    pub(super) gradient_is_known: bool,
}

impl Normal {
    /// Analyses the problem. With `fuse`, a batch that can be eliminated without being stored is;
    /// then only [`Normal::attempt`] makes steps. `linear_tolerance` is for [`LinearSolver::IterativeSchur`].
    pub(super) fn new(
        problem: &Problem,
        linear: LinearSolver,
        linear_tolerance: f64,
        fuse: bool,
    ) -> Result<Normal, SolveError> {
        let (mut structure, mut matrix) = Structure::new(problem, linear)?;
        let mut choice = strategy::choose(&structure, &matrix, linear, fuse);
        let mut fused = Err("the method needs all Jacobians at once".into());
        if choice.is_implicit() {
            let mut diagonal = structure.uncouple(problem);
            diagonal.allocate();
            fused = schur::find(problem, &structure, &diagonal, true);
            match &fused {
                Ok(_) => matrix = diagonal,
                Err(why) => {
                    choice = strategy::explicit(&matrix, linear, why);
                    structure.couple(problem);
                }
            }
        }
        if !choice.is_implicit() {
            matrix.allocate();
            if fuse {
                fused = schur::find(problem, &structure, &matrix, false);
            }
        }
        let (solver, linear_path) = choice.solver(&matrix, linear_tolerance);
        let paths = paths(problem, &structure, linear, &fused);
        let fused = fused.ok();
        let mut tangent = problem.tangent_len();
        let mut partials = Vec::new();
        if fused.is_some() {
            // Vectors over tangents reach as far as the last retained block.
            let ends = structure.retained.iter().map(|&k| &problem.blocks[k]);
            tangent = ends.map(|block| block.tangent + block.dimension).max().unwrap_or(0);
            structure.forget_factors();
        } else {
            structure.complete(problem, &matrix);
            partials.extend(structure.chunks.iter().map(PartialSums::new));
        }
        Ok(Normal {
            linearizations: vec![Linearization::default(); problem.batches.len()],
            partials,
            retained_vector: vec![0.0; matrix.dimension()],
            matrix,
            solver,
            structure,
            spare: Linearization::default(),
            curvature_share: 0.0,
            fused,
            paths,
            linear_path,
            shift: Vec::new(),
            fused_slope: 0.0,
            gradient_is_known: false,
            gradient: vec![0.0; tangent],
            diagonal: vec![0.0; tangent],
        })
    }

    /// The cost at `x`, or which factor of which batch cannot be evaluated.
    pub(super) fn cost(
        &mut self,
        problem: &Problem,
        x: &[f64],
    ) -> Result<f64, (usize, InfeasibleFactor)> {
        let mut total = 0.0;
        for (k, named) in problem.batches.iter().enumerate() {
            if let Some((batch, work)) = &mut self.fused
                && *batch == k
            {
                let cost = work.0.cost(problem, x, &named.loss);
                if cost.is_finite() {
                    total += cost;
                    continue;
                }
                // Below, the scalar form says which factor it is.
            }
            let point = problem.all_values(x);
            total += batch_cost(named.batch.as_ref(), &named.loss, point, &mut self.spare.residual)
                .map_err(|infeasible| (k, infeasible))?;
        }
        Ok(total)
    }

    /// Linearises all batches at `x`; returns the cost.
    pub(super) fn linearize(
        &mut self,
        problem: &Problem,
        x: &[f64],
    ) -> Result<f64, (usize, InfeasibleFactor)> {
        let mut total = 0.0;
        for (k, (named, out)) in problem.batches.iter().zip(&mut self.linearizations).enumerate() {
            if self.fused.as_ref().is_some_and(|(batch, _)| *batch == k) {
                continue;
            }
            let point = problem.all_values(x);
            let batch = named.batch.as_ref();
            total +=
                linearize_batch(batch, &named.loss, self.curvature_share, point, named.width, out)
                    .map_err(|infeasible| (k, infeasible))?;
        }
        self.freeze(problem);
        Ok(total)
    }

    /// Clears the columns of entries that must not move.
    fn freeze(&mut self, problem: &Problem) {
        if problem.blocks.iter().all(|block| block.frozen == 0) {
            return;
        }
        for (named, out) in problem.batches.iter().zip(&mut self.linearizations) {
            // Empty for the batch that is never stored.
            let stride = named.batch.rows() * named.width;
            out.jacobian.par_chunks_mut(stride).enumerate().for_each(|(f, jacobian)| {
                let mut column = 0;
                for (block, dim) in named.batch.blocks(f).iter().zip(&named.dims) {
                    let frozen = problem.blocks[block.index()].frozen;
                    for k in (0..*dim).filter(|k| frozen >> k & 1 == 1) {
                        jacobian
                            .iter_mut()
                            .skip(column + k)
                            .step_by(named.width)
                            .for_each(|v| *v = 0.0);
                    }
                    column += dim;
                }
            });
        }
    }

    /// Forms the reduced system at the current linearisation, which is the one at `x`, with damping
    /// `lambda`; fills [`Normal::gradient`] and [`Normal::diagonal`].
    pub(super) fn eliminate(
        &mut self,
        problem: &Problem,
        x: &[f64],
        lambda: f64,
    ) -> Result<(), NotPositiveDefinite> {
        self.matrix.values.fill(0.0);
        self.retained_vector.fill(0.0);
        self.gradient.fill(0.0);
        self.diagonal.fill(0.0);
        self.gradient_is_known = false;
        if let Some((batch, work)) = &mut self.fused {
            let settings = Settings {
                loss: &problem.batches[*batch].loss,
                curvature_share: self.curvature_share,
                lambda,
            };
            let sums = NormalEquationsMut {
                matrix: &mut self.matrix,
                gradient: &mut self.gradient,
                diagonal: &mut self.diagonal,
                correction: &mut self.retained_vector,
            };
            self.fused_slope = work.0.reduce(problem, x, &self.linearizations, settings, sums)?;
        } else {
            let (structure, linearizations) = (&self.structure, &self.linearizations);
            // The first chunk that fails is reported, whichever thread is the fastest.
            self.partials
                .par_iter_mut()
                .zip(&structure.chunks)
                .map(|(partial, chunk)| {
                    eliminate(problem, structure, chunk, linearizations, lambda, partial)
                })
                .collect::<Vec<_>>()
                .into_iter()
                .collect::<Result<(), NotPositiveDefinite>>()?;
            self.add_partials(problem);
        }
        self.add_camera_only_factors(problem);
        self.gradient_is_known = true;
        self.shift.clear();
        for &block in &self.structure.retained {
            let block = &problem.blocks[block];
            for k in 0..block.dimension {
                let frozen = block.frozen >> k & 1 == 1;
                let diagonal = damping(self.diagonal[block.tangent + k]);
                self.shift.push(if frozen { 1.0 } else { lambda * diagonal });
            }
        }
        self.matrix.add_to_diagonal(&self.shift);
        Ok(())
    }

    /// [`Normal::eliminate`], then factorises the reduced system.
    pub(super) fn reduce(
        &mut self,
        problem: &Problem,
        x: &[f64],
        lambda: f64,
    ) -> Result<(), NotPositiveDefinite> {
        self.eliminate(problem, x, lambda)?;
        self.solver.factorize(&self.matrix)
    }

    /// Refuses residuals and Jacobians at `x` that are not finite.
    ///
    /// # Errors
    /// [`SolveError::NotFinite`] names the first factor that has one.
    pub(super) fn require_finite(&self, problem: &Problem, x: &[f64]) -> Result<(), SolveError> {
        for named in &problem.batches {
            let (rows, width) = (named.batch.rows(), named.width);
            let (mut residual, mut jacobian) = (vec![0.0; rows], vec![0.0; rows * width]);
            for f in 0..named.batch.len() {
                jacobian.fill(0.0);
                let entries = Some(&mut jacobian[..]);
                let values = problem.all_values(x);
                named
                    .batch
                    .linearize(f..f + 1, values, &mut residual, entries, width)
                    .map_err(|infeasible| problem.infeasible(named, infeasible))?;
                let what = if residual.iter().any(|v| !v.is_finite()) {
                    "the residual"
                } else if jacobian.iter().any(|v| !v.is_finite()) {
                    "the Jacobian"
                } else {
                    continue;
                };
                let factor = problem.describe_factor(named, f);
                return Err(SolveError::NotFinite(format!("{what} of {factor}")));
            }
        }
        Ok(())
    }

    /// The Cholesky factor of `V` of eliminated block `e`, row-major.
    pub(super) fn point_factor(&self, e: usize) -> &[f64] {
        let chunks = &self.structure.chunks;
        let chunk = chunks.partition_point(|chunk| chunk.eliminated.end <= e);
        let (squares, first) = (&self.structure.squares, chunks[chunk].eliminated.start);
        &self.partials[chunk].factor[squares[e] - squares[first]..squares[e + 1] - squares[first]]
    }

    /// `W^T` of eliminated block `e`: per adjacent retained block its place and `E^T F`, row-major.
    pub(super) fn coupling(&self, problem: &Problem, e: usize) -> Vec<(usize, Vec<f64>)> {
        let own = self.structure.eliminated[e];
        let n = problem.blocks[own].dimension;
        let mut found: Vec<(usize, Vec<f64>)> = Vec::new();
        for &(b, f) in self.structure.factors(e) {
            let (named, f) = (&problem.batches[b as usize], f as usize);
            let (rows, width) = (named.batch.rows(), named.width);
            let jacobian = &self.linearizations[b as usize].jacobian[f * rows * width..];
            let blocks = named.batch.blocks(f);
            let columns = columns_of(&named.dims);
            let own_column =
                blocks.iter().position(|block| block.index() == own).map_or(0, |k| columns[k]);
            for (k, block) in blocks.iter().enumerate() {
                let place = self.structure.retained_index[block.index()];
                if place == NONE {
                    continue;
                }
                let (place, dim) = (place as usize, named.dims[k]);
                let position = found.iter().position(|(other, _)| *other == place);
                let position = position.unwrap_or_else(|| {
                    found.push((place, vec![0.0; n * dim]));
                    found.len() - 1
                });
                for row in jacobian[..rows * width].chunks_exact(width) {
                    for i in 0..n {
                        for j in 0..dim {
                            found[position].1[i * dim + j] +=
                                row[own_column + i] * row[columns[k] + j];
                        }
                    }
                }
            }
        }
        found
    }
}

/// How each batch will be evaluated, and why.
fn paths(
    problem: &Problem,
    structure: &Structure,
    linear: LinearSolver,
    fused: &Result<(usize, FusedElimination), String>,
) -> Vec<BatchPath> {
    let mut camera_only = vec![0; problem.batches.len()];
    structure.camera_only_factors.iter().for_each(|&(b, _)| camera_only[b as usize] += 1);
    problem
        .batches
        .iter()
        .enumerate()
        .map(|(k, named)| match (linear, fused) {
            (_, Ok((batch, _))) if *batch == k => BatchPath::Fused,
            (LinearSolver::Dense, _) => BatchPath::Dense,
            (LinearSolver::Sparse, _) => {
                BatchPath::Stored("the sparse solver eliminates no block".into())
            }
            _ if camera_only[k] == named.batch.len() => {
                BatchPath::Stored("no factor depends on an eliminated block".into())
            }
            (_, Err(why)) => BatchPath::Stored(why.clone()),
            (_, Ok((batch, _))) => {
                BatchPath::Stored(format!("batch {:?} is fused", problem.batches[*batch].name))
            }
        })
        .collect()
}

fn columns_of(dims: &[usize]) -> Vec<usize> {
    dims.iter()
        .scan(0, |column, dim| {
            let here = *column;
            *column += dim;
            Some(here)
        })
        .collect()
}
