//! Elimination of one chunk of the blocks: the hot loop of the stored path.
//!
//! Per eliminated block with `V = L L^T`: `Y = W L^-T`, `u = L^-1 g_e`, and the reduced system receives
//! `-Y Y^T` and `-Y u` ([`super::normal`]).

use super::{
    cholesky::NotPositiveDefinite,
    factor::{Linearization, MAX_ARITY},
    problem::{BlockId, NamedBatch, Problem},
    structure::{Chunk, NONE, Structure},
};

/// What one chunk of the eliminated blocks adds up, and what back-substitution needs of it.
#[derive(Debug, Default, Clone)]
pub(super) struct PartialSums {
    /// Blocks of the reduced matrix, as laid out in [`Chunk`].
    pub(super) values: Vec<f64>,
    /// `F^T r`, `-W V^-1 g_e` and the diagonal of `F^T F`, over the retained blocks of the chunk.
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
        let retained = chunk.starts.last().copied().unwrap_or(0);
        PartialSums {
            values: vec![0.0; chunk.len],
            gradient: vec![0.0; retained],
            correction: vec![0.0; retained],
            diagonal: vec![0.0; retained],
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
    partial.clear();
    let mut scratch = std::mem::take(&mut partial.scratch);
    for e in chunk.eliminated.clone() {
        let own = structure.eliminated[e];
        let block = &problem.blocks[own];
        let n = block.dimension;
        let adjacent = structure.adjacent(e);
        let height: usize = adjacent.iter().map(|&k| chunk.size(k)).sum();
        // V, g_e, then W with the rows of the adjacent retained blocks one after the other.
        scratch.clear();
        scratch.resize(n * n + n + height * n, 0.0);
        let (v, rest) = scratch.split_at_mut(n * n);
        let (g, w) = rest.split_at_mut(n);
        for &(b, f) in structure.factors(e) {
            let (named, f) = (&problem.batches[b as usize], f as usize);
            let factor = LinearFactor::new(named, &linearizations[b as usize], f);
            let own_column = factor.column_of(own);
            factor.add_own(own_column, v, g);
            let mut seen = [(0, 0, 0); MAX_ARITY];
            let mut count = 0;
            for (block, column, dim) in factor.columns() {
                let index = structure.retained_index[block.index()];
                if index != NONE {
                    let local = chunk.retained.partition_point(|&other| other < index);
                    let position = adjacent.partition_point(|&other| (other as usize) < local);
                    let at: usize =
                        adjacent[..position].iter().map(|&k| chunk.size(k)).sum::<usize>() * n;
                    let w = &mut w[at..at + dim * n];
                    factor.add_retained((own_column, n), column, w, partial, chunk.starts[local]);
                    seen[count] = (local, column, dim);
                    count += 1;
                }
            }
            factor.add_products(&seen[..count], chunk, partial);
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
        partial.subtract_products(chunk, adjacent, w, g);
    }
    partial.scratch = scratch;
    Ok(())
}

/// One linearised factor of a batch.
struct LinearFactor<'a> {
    blocks: &'a [BlockId],
    dims: &'a [usize],
    width: usize,
    residual: &'a [f64],
    jacobian: &'a [f64],
}

impl<'a> LinearFactor<'a> {
    fn new(named: &'a NamedBatch, linearization: &'a Linearization, f: usize) -> Self {
        let (rows, width) = (named.batch.rows(), named.width);
        LinearFactor {
            blocks: named.batch.blocks(f),
            dims: &named.dims,
            width,
            residual: &linearization.residual[f * rows..(f + 1) * rows],
            jacobian: &linearization.jacobian[f * rows * width..(f + 1) * rows * width],
        }
    }

    /// Each block with its first column and its dimension.
    fn columns(&self) -> impl Iterator<Item = (BlockId, usize, usize)> + 'a {
        let mut next = 0;
        self.blocks.iter().zip(self.dims).map(move |(&block, &dim)| {
            let column = next;
            next += dim;
            (block, column, dim)
        })
    }

    fn column_of(&self, own: usize) -> usize {
        self.columns().find(|(block, ..)| block.index() == own).map_or(0, |(_, column, _)| column)
    }

    fn rows(&self) -> impl Iterator<Item = (&'a [f64], &'a f64)> {
        self.jacobian.chunks_exact(self.width).zip(self.residual)
    }

    /// `V += E^T E`, `g += E^T r`.
    #[inline]
    fn add_own(&self, column: usize, v: &mut [f64], g: &mut [f64]) {
        let n = g.len();
        for (row, r) in self.rows() {
            let own = &row[column..column + n];
            for i in 0..n {
                g[i] += own[i] * r;
                for j in 0..=i {
                    v[i * n + j] += own[i] * own[j];
                }
            }
        }
    }

    /// `W += F^T E`, the gradient and the diagonal of the retained block at `column`, which begins at
    /// `start` in the chunk's vectors.
    #[inline]
    fn add_retained(
        &self,
        (own_column, n): (usize, usize),
        column: usize,
        w: &mut [f64],
        partial: &mut PartialSums,
        start: usize,
    ) {
        for (row, r) in self.rows() {
            let own = &row[own_column..own_column + n];
            for (i, w) in w.chunks_exact_mut(n).enumerate() {
                let value = row[column + i];
                partial.gradient[start + i] += value * r;
                partial.diagonal[start + i] += value * value;
                for j in 0..n {
                    w[j] += value * own[j];
                }
            }
        }
    }

    /// `F^T F` of all pairs of the retained blocks `seen`: local index, column, dimension.
    #[inline]
    fn add_products(
        &self,
        seen: &[(usize, usize, usize)],
        chunk: &Chunk,
        partial: &mut PartialSums,
    ) {
        for &(row, row_column, row_dim) in seen {
            for &(other, other_column, other_dim) in seen {
                if other <= row {
                    let at = chunk.at(row, other);
                    let to = &mut partial.values[at..at + row_dim * other_dim];
                    for line in self.jacobian.chunks_exact(self.width) {
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
}

impl PartialSums {
    fn clear(&mut self) {
        for sums in [&mut self.values, &mut self.gradient, &mut self.correction, &mut self.diagonal]
        {
            sums.fill(0.0);
        }
        for list in [&mut self.factor, &mut self.gradient_e, &mut self.diagonal_e] {
            list.clear();
        }
    }

    /// `-Y Y^T` and `-Y u` of one eliminated block; `y` holds the rows of its adjacent retained blocks.
    #[inline]
    fn subtract_products(&mut self, chunk: &Chunk, adjacent: &[u32], y: &[f64], u: &[f64]) {
        let n = u.len();
        let mut row_at = 0;
        for (position, &row) in adjacent.iter().enumerate() {
            let row_dim = chunk.size(row);
            let y_row = &y[row_at..row_at + row_dim * n];
            for (i, y) in y_row.chunks_exact(n).enumerate() {
                self.correction[chunk.starts[row as usize] + i] -= inner(y, u);
            }
            let mut column_at = 0;
            for &column in &adjacent[..=position] {
                let column_dim = chunk.size(column);
                let y_column = &y[column_at..column_at + column_dim * n];
                let at = chunk.at(row as usize, column as usize);
                let to = &mut self.values[at..at + row_dim * column_dim];
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
