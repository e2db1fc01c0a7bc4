//! Priors on points: factors of other batches that depend on one eliminated block and on no other free one.

use super::point_system::PriorSums;
use crate::nlls::{factor::Linearization, problem::Problem, structure::FactorRef};

/// The priors on the points of a fused batch.
#[derive(Debug, Default)]
pub(super) struct Priors<const P: usize> {
    /// Each factor, the place of its point among those with priors, and its column of that point.
    factors: Vec<(FactorRef, usize, usize)>,
    /// What the factors of each of those points add to its normal equations.
    pub(super) sums: Vec<PriorSums<P>>,
}

impl<const P: usize> Priors<P> {
    /// Lists a factor of the point that was begun last, or of a new one; `column` is where the point's part of
    /// its Jacobian begins.
    pub(super) fn push(&mut self, factor: FactorRef, column: usize, new: bool) {
        if new {
            self.sums.push(PriorSums::NONE);
        }
        self.factors.push((factor, self.sums.len() - 1, column));
    }

    /// Sums up the normal equations at the current linearisation.
    pub(super) fn sum(&mut self, problem: &Problem, linearizations: &[Linearization]) {
        self.sums.fill(PriorSums::NONE);
        for &((b, f), place, column) in &self.factors {
            let (named, f) = (&problem.batches[b as usize], f as usize);
            let (rows, width) = (named.batch.rows(), named.width);
            let found = &linearizations[b as usize];
            let jacobian =
                found.jacobian[f * rows * width..(f + 1) * rows * width].chunks_exact(width);
            for (row, &residual) in jacobian.zip(&found.residual[f * rows..]) {
                self.sums[place].add(&row[column..column + P], residual);
            }
        }
    }
}
