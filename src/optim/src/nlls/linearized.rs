//! The factors of one batch at one point, for statistics.

use super::problem::{BlockId, NamedBatch, Problem};
use crate::engine::SolveError;

/// The blocks of a factor, its residual, and its Jacobian row by row.
pub type LinearizedFactor = (Vec<BlockId>, Vec<f64>, Vec<f64>);

impl Problem {
    /// The raw residuals and Jacobians of the batch called `name`, without its loss.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] where there is no such batch, [`SolveError::InfeasibleStart`] where
    /// one of its factors cannot be evaluated.
    pub fn linearized(&self, x: &[f64], name: &str) -> Result<Vec<LinearizedFactor>, SolveError> {
        let named = self.named(name)?;
        let (rows, width) = (named.batch.rows(), named.width);
        (0..named.batch.len())
            .map(|factor| {
                let mut residual = vec![0.0; rows];
                let mut jacobian = vec![0.0; rows * width];
                named
                    .batch
                    .linearize(
                        factor..factor + 1,
                        self.all_values(x),
                        &mut residual,
                        Some(&mut jacobian),
                        width,
                    )
                    .map_err(|infeasible| self.infeasible(named, infeasible))?;
                Ok((named.batch.blocks(factor).to_vec(), residual, jacobian))
            })
            .collect()
    }

    /// The blocks of every factor of a batch.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] where there is no such batch.
    pub fn factor_blocks(
        &self,
        name: &str,
    ) -> Result<impl Iterator<Item = &[BlockId]>, SolveError> {
        let named = self.named(name)?;
        Ok((0..named.batch.len()).map(|factor| named.batch.blocks(factor)))
    }

    fn named(&self, name: &str) -> Result<&NamedBatch, SolveError> {
        let found = self.batches.iter().find(|named| named.name == name);
        found.ok_or_else(|| SolveError::Misuse(format!("there is no batch {name:?}")))
    }
}
