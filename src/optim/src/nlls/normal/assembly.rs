//! Assembly of the reduced system: what the chunks of eliminated blocks sum up, and the factors of retained blocks alone.
//!
//! Symbols as in [`super`]. Chunks and factors are added in their order, so that sums do not depend on the number of threads.

use super::Normal;
use crate::nlls::{cholesky::BlockMatrix, problem::Problem, structure::NONE};

impl Normal {
    /// Adds the sums of the chunks of eliminated blocks.
    pub(super) fn add_partials(&mut self, problem: &Problem) {
        for (partial, chunk) in self.partials.iter().zip(&self.structure.chunks) {
            for &(local, global, len) in &chunk.copies {
                let to = &mut self.matrix.values[global..global + len];
                for (to, from) in to.iter_mut().zip(&partial.values[local..local + len]) {
                    *to += from;
                }
            }
            for (k, &retained) in chunk.retained.iter().enumerate() {
                let block = problem.blocks[self.structure.retained[retained as usize]].tangent;
                let start = self.matrix.starts[retained as usize];
                for (offset, local) in (chunk.starts[k]..chunk.starts[k + 1]).enumerate() {
                    self.gradient[block + offset] += partial.gradient[local];
                    self.diagonal[block + offset] += partial.diagonal[local];
                    self.retained_vector[start + offset] += partial.correction[local];
                }
            }
            let mut at = 0;
            for e in chunk.eliminated.clone() {
                let block = &problem.blocks[self.structure.eliminated[e]];
                let n = block.dimension;
                let to = block.tangent..block.tangent + n;
                self.gradient[to.clone()].copy_from_slice(&partial.gradient_e[at..at + n]);
                self.diagonal[to].copy_from_slice(&partial.diagonal_e[at..at + n]);
                at += n;
            }
        }
    }

    /// Adds the factors that depend on no eliminated block.
    pub(super) fn add_camera_only_factors(&mut self, problem: &Problem) {
        for &(b, f) in &self.structure.camera_only_factors {
            let named = &problem.batches[b as usize];
            let (rows, width) = (named.batch.rows(), named.width);
            let linearization = &self.linearizations[b as usize];
            let f = f as usize;
            let residual = &linearization.residual[f * rows..(f + 1) * rows];
            let jacobian = &linearization.jacobian[f * rows * width..(f + 1) * rows * width];
            let blocks = named.batch.blocks(f);
            let mut column = 0;
            for (k, block) in blocks.iter().enumerate() {
                let place = self.structure.retained_index[block.index()];
                if place != NONE {
                    let dim = named.dims[k];
                    let at = problem.blocks[block.index()].tangent;
                    for row in 0..rows {
                        let j = &jacobian[row * width + column..row * width + column + dim];
                        for (offset, v) in j.iter().enumerate() {
                            self.gradient[at + offset] += v * residual[row];
                            self.diagonal[at + offset] += v * v;
                        }
                    }
                    let mut other_column = 0;
                    for (other, other_dim) in blocks[..=k].iter().zip(&named.dims) {
                        let other_place = self.structure.retained_index[other.index()];
                        if other_place != NONE {
                            add_product(
                                &mut self.matrix,
                                (place as usize, column, dim),
                                (other_place as usize, other_column, *other_dim),
                                jacobian,
                                width,
                            );
                        }
                        other_column += other_dim;
                    }
                }
                column += named.dims[k];
            }
        }
    }
}

/// Adds `J_row^T J_column` to a block of the reduced matrix; both given as (place, column, dim).
fn add_product(
    matrix: &mut BlockMatrix,
    first: (usize, usize, usize),
    second: (usize, usize, usize),
    jacobian: &[f64],
    width: usize,
) {
    let (row, column) = if first.0 >= second.0 { (first, second) } else { (second, first) };
    let Some(slot) = matrix.slot(row.0, column.0) else {
        debug_assert!(false, "the pattern holds every pair of every factor");
        return;
    };
    let at = matrix.value_ptr[slot];
    let to = &mut matrix.values[at..at + row.2 * column.2];
    for line in jacobian.chunks_exact(width) {
        for j in 0..column.2 {
            for i in 0..row.2 {
                to[j * row.2 + i] += line[row.1 + i] * line[column.1 + j];
            }
        }
    }
}
