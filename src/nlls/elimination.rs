//! Elimination of one chunk of the blocks: the hot loop of the stored path.
//!
//! Per eliminated block with `V = L L^T`: `Y = W L^-T`, `u = L^-1 g_e`, and the reduced system receives
//! `-Y Y^T` and `-Y u` ([`super::normal`]).

use super::{
    cholesky::NotPositiveDefinite,
    factor::{Linearization, MAX_ARITY},
    problem::Problem,
    structure::{Chunk, NONE, Structure},
};

/// What one chunk of the eliminated blocks adds up, and what back-substitution needs of it.
#[derive(Debug, Default, Clone)]
pub(super) struct PartialSums {
    /// Blocks of the reduced matrix, as laid out in [`Chunk`].
    pub(super) values: Vec<f64>,
    /// `F^T r`, `-W V^-1 g_e` and the diagonal of `F^T F`, over the kept blocks of the chunk.
    pub(super) gradient: Vec<f64>,
    pub(super) correction: Vec<f64>,
    pub(super) diagonal: Vec<f64>,
    /// Per eliminated block: the Cholesky factor of `V`, `g_e` and the diagonal of `E^T E`.
    pub(super) factor: Vec<f64>,
    pub(super) gradient_e: Vec<f64>,
    pub(super) diagonal_e: Vec<f64>,
    scratch: Vec<f64>,
}

/// The weight of a diagonal entry in the damping.
#[inline(always)]
pub(super) fn damping(diagonal: f64) -> f64 {
    if diagonal > 0.0 { diagonal } else { 1.0 }
}

impl PartialSums {
    pub(super) fn new(chunk: &Chunk) -> PartialSums {
        let kept = chunk.starts.last().copied().unwrap_or(0);
        PartialSums {
            values: vec![0.0; chunk.len],
            gradient: vec![0.0; kept],
            correction: vec![0.0; kept],
            diagonal: vec![0.0; kept],
            ..PartialSums::default()
        }
    }
}

/// Eliminates the blocks of one chunk.
pub(super) fn eliminate(
    problem: &Problem,
    structure: &Structure,
    chunk: &Chunk,
    linearizations: &[Linearization],
    lambda: f64,
    partial: &mut PartialSums,
) -> Result<(), NotPositiveDefinite> {
    for sums in
        [&mut partial.values, &mut partial.gradient, &mut partial.correction, &mut partial.diagonal]
    {
        sums.fill(0.0);
    }
    for list in [&mut partial.factor, &mut partial.gradient_e, &mut partial.diagonal_e] {
        list.clear();
    }
    for e in chunk.eliminated.clone() {
        let own = structure.eliminated[e];
        let block = &problem.blocks[own];
        let n = block.dimension;
        let adjacent = structure.adjacent(e);
        let size_of = |k: u32| chunk.starts[k as usize + 1] - chunk.starts[k as usize];
        let height: usize = adjacent.iter().map(|&k| size_of(k)).sum();
        // V, g_e, then W with the rows of the adjacent kept blocks one after the other.
        partial.scratch.clear();
        partial.scratch.resize(n * n + n + height * n, 0.0);
        let (v, rest) = partial.scratch.split_at_mut(n * n);
        let (g, w) = rest.split_at_mut(n);
        for &(b, f) in structure.factors(e) {
            let (named, f) = (&problem.batches[b as usize], f as usize);
            let (rows, width) = (named.batch.rows(), named.width);
            let linearization = &linearizations[b as usize];
            let residual = &linearization.residual[f * rows..(f + 1) * rows];
            let jacobian = &linearization.jacobian[f * rows * width..(f + 1) * rows * width];
            let blocks = named.batch.blocks(f);
            let mut own_column = 0;
            for (block, dim) in blocks.iter().zip(&named.dims) {
                if block.index() == own {
                    break;
                }
                own_column += dim;
            }
            for (row, r) in jacobian.chunks_exact(width).zip(residual) {
                let own = &row[own_column..own_column + n];
                for i in 0..n {
                    g[i] += own[i] * r;
                    for j in 0..=i {
                        v[i * n + j] += own[i] * own[j];
                    }
                }
            }
            let mut column = 0;
            let mut seen: [(usize, usize, usize); MAX_ARITY] = Default::default();
            let mut count = 0;
            for (block, &dim) in blocks.iter().zip(&named.dims) {
                let place = structure.kept_index[block.index()];
                if place != NONE {
                    let local = chunk.kept.partition_point(|&other| other < place);
                    let position = adjacent.partition_point(|&other| (other as usize) < local);
                    let at: usize =
                        adjacent[..position].iter().map(|&k| size_of(k)).sum::<usize>() * n;
                    let start = chunk.starts[local];
                    for (row, r) in jacobian.chunks_exact(width).zip(residual) {
                        let own = &row[own_column..own_column + n];
                        for i in 0..dim {
                            let value = row[column + i];
                            partial.gradient[start + i] += value * r;
                            partial.diagonal[start + i] += value * value;
                            for j in 0..n {
                                w[at + i * n + j] += value * own[j];
                            }
                        }
                    }
                    seen[count] = (local, column, dim);
                    count += 1;
                }
                column += dim;
            }
            for &(row, row_column, row_dim) in &seen[..count] {
                for &(other, other_column, other_dim) in &seen[..count] {
                    if other <= row {
                        let at = chunk.at(row, other);
                        let to = &mut partial.values[at..at + row_dim * other_dim];
                        for line in jacobian.chunks_exact(width) {
                            for j in 0..other_dim {
                                for i in 0..row_dim {
                                    to[j * row_dim + i] +=
                                        line[row_column + i] * line[other_column + j];
                                }
                            }
                        }
                    }
                }
            }
        }
        partial.gradient_e.extend_from_slice(g);
        for k in 0..n {
            partial.diagonal_e.push(v[k * n + k]);
            let frozen = block.frozen >> k & 1 == 1;
            v[k * n + k] += if frozen { 1.0 } else { lambda * damping(v[k * n + k]) };
        }
        factor_in_place(v, n).map_err(|_| NotPositiveDefinite(Some(own)))?;
        partial.factor.extend_from_slice(v);
        forward_solve(v, n, g);
        for row in w.chunks_exact_mut(n) {
            forward_solve(v, n, row);
        }
        let mut row_at = 0;
        for (position, &row) in adjacent.iter().enumerate() {
            let row_dim = size_of(row);
            let y_row = &w[row_at..row_at + row_dim * n];
            for (i, y) in y_row.chunks_exact(n).enumerate() {
                partial.correction[chunk.starts[row as usize] + i] -= inner(y, g);
            }
            let mut column_at = 0;
            for &column in &adjacent[..=position] {
                let column_dim = size_of(column);
                let y_column = &w[column_at..column_at + column_dim * n];
                let at = chunk.at(row as usize, column as usize);
                let to = &mut partial.values[at..at + row_dim * column_dim];
                for (to, y_j) in to.chunks_exact_mut(row_dim).zip(y_column.chunks_exact(n)) {
                    for (to, y_i) in to.iter_mut().zip(y_row.chunks_exact(n)) {
                        *to -= inner(y_i, y_j);
                    }
                }
                column_at += column_dim * n;
            }
            row_at += row_dim * n;
        }
    }
    Ok(())
}

#[inline]
pub(super) fn inner(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Cholesky factor of a small row-major matrix, in its lower triangle.
pub(super) fn factor_in_place(a: &mut [f64], n: usize) -> Result<(), NotPositiveDefinite> {
    for j in 0..n {
        let pivot = a[j * n + j] - a[j * n..j * n + j].iter().map(|v| v * v).sum::<f64>();
        // A NaN fails this test too.
        if !(pivot > 0.0 && pivot.is_finite()) {
            return Err(NotPositiveDefinite(None));
        }
        let pivot = pivot.sqrt();
        a[j * n + j] = pivot;
        for i in j + 1..n {
            let (upper, lower) = a.split_at_mut(i * n);
            let sum = inner(&upper[j * n..j * n + j], &lower[..j]);
            lower[j] = (lower[j] - sum) / pivot;
        }
    }
    Ok(())
}

/// Solves `L y = b` in place.
pub(super) fn forward_solve(l: &[f64], n: usize, b: &mut [f64]) {
    for i in 0..n {
        let sum = inner(&l[i * n..i * n + i], &b[..i]);
        b[i] = (b[i] - sum) / l[i * n + i];
    }
}

/// Solves `L^T y = b` in place.
pub(super) fn backward_solve(l: &[f64], n: usize, b: &mut [f64]) {
    for i in (0..n).rev() {
        let mut sum = b[i];
        for k in i + 1..n {
            sum -= l[k * n + i] * b[k];
        }
        b[i] = sum / l[i * n + i];
    }
}
