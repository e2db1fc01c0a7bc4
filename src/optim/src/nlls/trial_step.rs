//! Damped steps: solve the reduced system, substitute back, try where that leads.

use super::{
    cholesky::NotPositiveDefinite,
    elimination::{backward_solve, forward_solve, inner},
    factor::batch_cost,
    normal::Normal,
    problem::Problem,
    schur::{BackSubstitution, Settings},
    structure::NONE,
};
use rayon::prelude::*;

/// A damped step that was tried.
#[derive(Debug, Clone, Copy)]
pub(super) struct TrialStep {
    /// The decrease that the model promises.
    pub(super) predicted: f64,
    /// `|D^1/2 d|`.
    pub(super) length: f64,
    /// The largest entry of the step.
    pub(super) step_norm: f64,
    /// The cost at the trial values; infinite where a factor is infeasible there.
    pub(super) cost: f64,
}

impl Normal {
    /// Solves for the step `d` over the tangents of all blocks.
    ///
    /// # Errors
    /// As [`super::schur_solver::SchurSolver::solve`].
    pub(super) fn solve(
        &mut self,
        problem: &Problem,
        d: &mut [f64],
    ) -> Result<(), NotPositiveDefinite> {
        d.fill(0.0);
        // retained_vector holds -W V^-1 g_e; the right-hand side is -(g_k + that).
        for (place, &block) in self.structure.retained.iter().enumerate() {
            let block = &problem.blocks[block];
            let start = self.matrix.starts[place];
            for k in 0..block.dimension {
                let g = self.gradient[block.tangent + k];
                self.retained_vector[start + k] = -(g + self.retained_vector[start + k]);
            }
        }
        let (shift, starts, fused) = (&self.shift, &self.matrix.starts, &mut self.fused);
        self.solver.solve(&self.matrix, &mut self.retained_vector, |x, y| {
            for ((y, x), shift) in y.iter_mut().zip(x).zip(shift) {
                *y = x * shift;
            }
            if let Some((_, work)) = fused {
                work.0.multiply(starts, x, y);
            }
        })?;
        for (place, &block) in self.structure.retained.iter().enumerate() {
            let block = &problem.blocks[block];
            let n = block.dimension;
            let start = self.matrix.starts[place];
            d[block.tangent..block.tangent + n]
                .copy_from_slice(&self.retained_vector[start..start + n]);
        }
        if self.fused.is_none() {
            self.substitute(problem, d);
        }
        Ok(())
    }

    /// Tries the step with damping `lambda` from the current linearisation at `x`: writes it to
    /// `step` and the values it leads to to `trial`; points beyond `restart_cost` are started again. `None` where the
    /// system is not positive definite.
    pub(super) fn attempt(
        &mut self,
        problem: &Problem,
        x: &[f64],
        (lambda, restart_cost): (f64, Option<f64>),
        step: &mut [f64],
        trial: &mut [f64],
    ) -> Option<TrialStep> {
        self.reduce(problem, x, lambda).ok()?;
        self.solve(problem, step).ok()?;
        let (mut predicted, mut square) = (0.0, 0.0);
        // -(g d + 1/2 d H d) with H d = -g - lambda D d.
        for ((d, g), w) in step.iter().zip(&self.gradient).zip(&self.diagonal) {
            predicted += 0.5 * d * (lambda * w * d - g);
            square += d * d * w;
        }
        let step_norm = step.iter().fold(0.0, |most: f64, v| v.abs().max(most));
        let mut moved = BackSubstitution::default();
        if let Some((batch, work)) = &mut self.fused {
            let settings = Settings {
                loss: &problem.batches[*batch].loss,
                curvature_share: self.curvature_share,
                lambda,
            };
            problem.plus_within(x, step, trial);
            moved = work.0.substitute(problem, x, (settings, restart_cost), step, trial);
            moved.cost += self.stored_cost(problem, trial);
        } else {
            problem.plus(x, step, trial);
            moved.cost = self.stored_cost(problem, trial);
        }
        let attempt = TrialStep {
            predicted: predicted + moved.predicted,
            length: (square + moved.squared_length).sqrt(),
            step_norm: step_norm.max(moved.step_norm),
            cost: if moved.cost.is_finite() { moved.cost } else { f64::INFINITY },
        };
        (attempt.predicted.is_finite() && attempt.length.is_finite()).then_some(attempt)
    }

    /// The cost at `x` of all batches but the fused one; infinite where a factor is infeasible.
    fn stored_cost(&mut self, problem: &Problem, x: &[f64]) -> f64 {
        let fused = self.fused.as_ref().map(|(batch, _)| *batch);
        let mut total = 0.0;
        for (k, named) in problem.batches.iter().enumerate().filter(|(k, _)| Some(*k) != fused) {
            let (point, spare) = (problem.all_values(x), &mut self.spare.residual);
            match batch_cost(problem.batches[k].batch.as_ref(), &named.loss, point, spare) {
                Ok(cost) => total += cost,
                Err(_) => return f64::INFINITY,
            }
        }
        total
    }

    /// `max_k |g_k| / sqrt(D_k)` at the current linearisation.
    pub(super) fn largest_slope(&self) -> f64 {
        self.gradient
            .iter()
            .zip(&self.diagonal)
            .filter(|(_, d)| **d > 0.0)
            .fold(self.fused_slope, |most: f64, (g, d)| (g.abs() / d.sqrt()).max(most))
    }

    /// Fills in `d_e` where `d` holds `d_k`.
    fn substitute(&self, problem: &Problem, d: &mut [f64]) {
        let retained: &[f64] = d;
        let steps: Vec<Vec<f64>> = self
            .partials
            .par_iter()
            .zip(&self.structure.chunks)
            .map(|(partial, chunk)| {
                let mut steps = partial.gradient_e.clone();
                let (mut at, mut factor_at) = (0, 0);
                for e in chunk.eliminated.clone() {
                    let block = self.structure.eliminated[e];
                    let n = problem.blocks[block].dimension;
                    let step = &mut steps[at..at + n];
                    for &(b, f) in self.structure.factors(e) {
                        self.add_coupling(problem, (b as usize, f as usize), block, retained, step);
                    }
                    let factor = &partial.factor[factor_at..factor_at + n * n];
                    forward_solve(factor, n, step);
                    backward_solve(factor, n, step);
                    step.iter_mut().for_each(|v| *v = -*v);
                    at += n;
                    factor_at += n * n;
                }
                steps
            })
            .collect();
        for (steps, chunk) in steps.iter().zip(&self.structure.chunks) {
            let mut at = 0;
            for e in chunk.eliminated.clone() {
                let block = &problem.blocks[self.structure.eliminated[e]];
                let n = block.dimension;
                d[block.tangent..block.tangent + n].copy_from_slice(&steps[at..at + n]);
                at += n;
            }
        }
    }

    /// `out += E^T F d_k` for one factor of the eliminated block `eliminated`.
    fn add_coupling(
        &self,
        problem: &Problem,
        (b, f): (usize, usize),
        eliminated: usize,
        d: &[f64],
        out: &mut [f64],
    ) {
        let named = &problem.batches[b];
        let (rows, width) = (named.batch.rows(), named.width);
        let jacobian = &self.linearizations[b].jacobian[f * rows * width..(f + 1) * rows * width];
        for row in jacobian.chunks_exact(width) {
            let (mut product, mut own, mut column) = (0.0, 0, 0);
            for (block, &dim) in named.batch.blocks(f).iter().zip(&named.dims) {
                if block.index() == eliminated {
                    own = column;
                } else if self.structure.retained_index[block.index()] != NONE {
                    let at = problem.blocks[block.index()].tangent;
                    product += inner(&row[column..column + dim], &d[at..at + dim]);
                }
                column += dim;
            }
            for (out, v) in out.iter_mut().zip(&row[own..]) {
                *out += v * product;
            }
        }
    }

    /// `|J v|^2` at the current linearisation.
    pub(super) fn squared_product(&self, problem: &Problem, v: &[f64]) -> f64 {
        let mut total = 0.0;
        for (named, linearization) in problem.batches.iter().zip(&self.linearizations) {
            let (rows, width) = (named.batch.rows(), named.width);
            let partial: Vec<f64> = linearization
                .jacobian
                .par_chunks(rows * width * 1024)
                .enumerate()
                .map(|(chunk, jacobians)| {
                    let mut sum = 0.0;
                    for (k, jacobian) in jacobians.chunks_exact(rows * width).enumerate() {
                        for row in jacobian.chunks_exact(width) {
                            let (mut product, mut column) = (0.0, 0);
                            let blocks = named.batch.blocks(chunk * 1024 + k);
                            for (block, dim) in blocks.iter().zip(&named.dims) {
                                let at = problem.blocks[block.index()].tangent;
                                product += inner(&row[column..column + dim], &v[at..at + dim]);
                                column += dim;
                            }
                            sum += product * product;
                        }
                    }
                    sum
                })
                .collect();
            total += partial.iter().sum::<f64>();
        }
        total
    }
}
