//! Cholesky factorisation of the (reduced) normal equations; with its parts the only file that knows
//! faer.
//!
//! The matrix is symmetric, stored as the blocks of its lower triangle ([`BlockMatrix`]). A
//! fill-reducing order is found once on the graph of blocks (approximate minimum degree), the
//! symbolic factorisation once ([`tree`]), and all memory is kept between factorisations
//! ([`fronts`]). A matrix that would fill in anyway is one dense front. The products inside a front
//! are faer's; the tree and what runs beside what are ours, because faer's own supernodal method
//! works on one front at a time and its threads meet at a barrier after every product.

mod fronts;
mod inverse;
mod tree;

use faer::{
    dyn_stack::{MemBuffer, MemStack},
    sparse::{SymbolicSparseColMatRef, linalg::amd},
};
use fronts::Fronts;
use tree::Tree;

/// The lower triangle of a symmetric matrix in blocks, column of blocks by column of blocks.
///
/// Block `(i, j)`, `i >= j`, is stored dense and column-major; diagonal blocks are stored whole.
#[derive(Debug, Clone, Default)]
pub(super) struct BlockMatrix {
    /// Where each block row begins; one more entry than blocks.
    pub(super) starts: Vec<usize>,
    /// Where the blocks of each block column begin in `rows`.
    pub(super) column_ptr: Vec<usize>,
    /// Block rows, ascending within a column; the first is the diagonal.
    pub(super) rows: Vec<u32>,
    /// Where the values of each block begin.
    pub(super) value_ptr: Vec<usize>,
    pub(super) values: Vec<f64>,
}

impl BlockMatrix {
    /// A zero matrix with the given block dimensions and, per block column, ascending block rows
    /// that begin with the diagonal.
    #[cfg(test)]
    pub(super) fn new(dims: &[usize], columns: &[Vec<u32>]) -> BlockMatrix {
        let mut matrix = BlockMatrix::pattern(dims, columns);
        matrix.allocate();
        matrix
    }

    /// The same without room for values.
    pub(super) fn pattern(dims: &[usize], columns: &[Vec<u32>]) -> BlockMatrix {
        let mut starts = vec![0];
        for dim in dims {
            starts.push(starts[starts.len() - 1] + dim);
        }
        let mut matrix = BlockMatrix { starts, column_ptr: vec![0], ..BlockMatrix::default() };
        let mut size = 0;
        for (column, rows) in columns.iter().enumerate() {
            debug_assert!(rows.first() == Some(&(column as u32)));
            for &row in rows {
                matrix.rows.push(row);
                matrix.value_ptr.push(size);
                size += dims[row as usize] * dims[column];
            }
            matrix.column_ptr.push(matrix.rows.len());
        }
        matrix.value_ptr.push(size);
        matrix
    }

    /// Makes room for the values: zeros.
    pub(super) fn allocate(&mut self) {
        self.values = vec![0.0; self.value_len()];
    }

    /// How many values its blocks have.
    pub(super) fn value_len(&self) -> usize {
        self.value_ptr.last().copied().unwrap_or(0)
    }

    pub(super) fn dimension(&self) -> usize {
        self.starts.last().copied().unwrap_or(0)
    }

    pub(super) fn block_count(&self) -> usize {
        self.starts.len() - 1
    }

    pub(super) fn dim(&self, block: usize) -> usize {
        self.starts[block + 1] - self.starts[block]
    }

    /// The slot of block `(row, column)`, `row >= column`, if it is stored.
    pub(super) fn slot(&self, row: usize, column: usize) -> Option<usize> {
        let range = self.column_ptr[column]..self.column_ptr[column + 1];
        let rows = &self.rows[range.clone()];
        rows.binary_search(&(row as u32)).ok().map(|k| range.start + k)
    }

    /// Adds `shift[k]` to diagonal entry `k`.
    pub(super) fn add_to_diagonal(&mut self, shift: &[f64]) {
        for block in 0..self.block_count() {
            let (dim, at) = (self.dim(block), self.value_ptr[self.column_ptr[block]]);
            for k in 0..dim {
                self.values[at + k * dim + k] += shift[self.starts[block] + k];
            }
        }
    }

    /// Multiplies row and column `k` by `scale[k]`.
    pub(super) fn scale(&mut self, scale: &[f64]) {
        for column in 0..self.block_count() {
            for slot in self.column_ptr[column]..self.column_ptr[column + 1] {
                let row = self.rows[slot] as usize;
                let (dim, at) = (self.dim(row), self.value_ptr[slot]);
                for j in 0..self.dim(column) {
                    for i in 0..dim {
                        self.values[at + j * dim + i] *=
                            scale[self.starts[row] + i] * scale[self.starts[column] + j];
                    }
                }
            }
        }
    }

    /// `y = A x`, block by block.
    pub(super) fn multiply(&self, x: &[f64], y: &mut [f64]) {
        y.fill(0.0);
        for column in 0..self.block_count() {
            let (c, width) = (self.starts[column], self.dim(column));
            for slot in self.column_ptr[column]..self.column_ptr[column + 1] {
                let row = self.rows[slot] as usize;
                let (r, dim) = (self.starts[row], self.dim(row));
                let values = &self.values[self.value_ptr[slot]..self.value_ptr[slot + 1]];
                for (k, values) in values.chunks_exact(dim).enumerate().take(width) {
                    // Diagonal blocks are sound below the diagonal only.
                    let skip = if row == column { k } else { 0 };
                    let mut transposed = 0.0;
                    for i in skip..dim {
                        y[r + i] += values[i] * x[c + k];
                        transposed += values[i] * x[r + i];
                    }
                    if row == column {
                        transposed -= values[k] * x[c + k];
                    }
                    y[c + k] += transposed;
                }
            }
        }
    }
}

/// The matrix is not positive definite to working precision; where it is known, the eliminated
/// block (by its index in the problem) whose own matrix is not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct NotPositiveDefinite(pub(super) Option<usize>);

/// A Cholesky factorisation that remembers its analysis and state.
#[derive(Debug)]
pub(super) struct Cholesky {
    dimension: usize,
    fronts: Fronts,
}

/// An order of elimination and what it costs.
#[derive(Debug)]
pub(super) struct Order(Tree);

impl Order {
    /// Multiply-adds of the factorisation.
    pub(super) fn work(&self) -> f64 {
        self.0.fronts.iter().map(tree::Front::work).sum()
    }

    /// Numbers in the factor.
    pub(super) fn factor_len(&self) -> usize {
        self.0.factor_len()
    }

    /// The matrix is one front.
    pub(super) fn is_dense(&self) -> bool {
        self.0.fronts.len() == 1
    }
}

/// Below this dimension the dense factorisation always wins.
const SMALL: usize = 160;
/// Share of a full lower triangle from which a sparse factor is slower than a dense one.
const FULL: f64 = 0.8;
/// Right-hand sides solved at a time.
const MAX_COLUMNS: usize = 32;

impl Cholesky {
    /// Analyses the pattern of `matrix`.
    #[cfg(test)]
    fn analyze(matrix: &BlockMatrix, prefer_dense: bool) -> Cholesky {
        Cholesky::new(matrix, Cholesky::order(matrix, prefer_dense))
    }

    /// Makes room for the factor of `matrix` along `order`.
    pub(super) fn new(matrix: &BlockMatrix, order: Order) -> Cholesky {
        Cholesky { dimension: matrix.dimension(), fronts: Fronts::new(order.0) }
    }

    /// The order in which `matrix`, whose values do not matter, is factorised.
    pub(super) fn order(matrix: &BlockMatrix, prefer_dense: bool) -> Order {
        let dimension = matrix.dimension();
        let full = 0.5 * (dimension as f64).powi(2);
        let tree =
            (!prefer_dense && dimension > SMALL && (matrix.value_len() as f64) < FULL * full)
                .then(|| Tree::sparse(matrix))
                .flatten()
                .filter(|tree| (tree.factor_len() as f64) < FULL * full)
                .unwrap_or_else(|| Tree::dense(matrix));
        Order(tree)
    }

    /// Factorises `matrix`, whose pattern is the one that was analysed.
    pub(super) fn factorize(&mut self, matrix: &BlockMatrix) -> Result<(), NotPositiveDefinite> {
        self.fronts.factorize(matrix)
    }

    /// The blocks of the inverse where `matrix`, which was factorised, has any.
    pub(super) fn selected_inverse(&self, matrix: &BlockMatrix) -> BlockMatrix {
        self.fronts.selected_inverse(matrix)
    }

    /// Solves for `columns` right-hand sides stored one after the other.
    pub(super) fn solve(&mut self, rhs: &mut [f64], columns: usize) {
        debug_assert_eq!(rhs.len(), self.dimension * columns);
        for chunk in rhs.chunks_mut(self.dimension.max(1) * MAX_COLUMNS) {
            self.fronts.solve(chunk, self.dimension, chunk.len() / self.dimension);
        }
    }
}

/// A fill-reducing order of the blocks, new to old: minimum degree on the graph of blocks, which is
/// as good as on the scalars and cheaper by the square of the block size.
fn order(matrix: &BlockMatrix) -> Option<Vec<usize>> {
    let blocks = matrix.block_count();
    let rows: Vec<usize> = matrix.rows.iter().map(|&row| row as usize).collect();
    let graph =
        SymbolicSparseColMatRef::new_checked(blocks, blocks, &matrix.column_ptr, None, &rows);
    let (mut forward, mut inverse) = (vec![0usize; blocks], vec![0usize; blocks]);
    let mut memory = MemBuffer::new(amd::order_maybe_unsorted_scratch::<usize>(blocks, rows.len()));
    amd::order_maybe_unsorted(
        &mut forward,
        &mut inverse,
        graph,
        amd::Control::default(),
        MemStack::new(&mut memory),
    )
    .ok()?;
    Some(forward)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A banded positive definite block matrix with blocks of 1 to 3.
    fn banded(blocks: usize, band: usize) -> BlockMatrix {
        let dims: Vec<usize> = (0..blocks).map(|k| 1 + k % 3).collect();
        let columns: Vec<Vec<u32>> =
            (0..blocks).map(|c| (c..blocks.min(c + band)).map(|r| r as u32).collect()).collect();
        let mut matrix = BlockMatrix::new(&dims, &columns);
        for (k, v) in matrix.values.iter_mut().enumerate() {
            *v = 0.1 * ((k * 7919 % 101) as f64 / 101.0 - 0.5);
        }
        let n = matrix.dimension();
        // Diagonal blocks are read below the diagonal only.
        matrix.add_to_diagonal(&vec![3.0; n]);
        matrix
    }

    fn multiply(matrix: &BlockMatrix, x: &[f64]) -> Vec<f64> {
        let mut y = vec![0.0; x.len()];
        matrix.multiply(x, &mut y);
        y
    }

    #[test]
    fn dense_and_sparse_solve_the_same_system() {
        let matrix = banded(200, 4);
        let n = matrix.dimension();
        let x: Vec<f64> = (0..2 * n).map(|k| (k as f64).sin()).collect();
        let rhs: Vec<f64> = [multiply(&matrix, &x[..n]), multiply(&matrix, &x[n..])].concat();
        for dense in [true, false] {
            let mut cholesky = Cholesky::analyze(&matrix, dense);
            for _ in 0..2 {
                cholesky.factorize(&matrix).unwrap();
                let mut solution = rhs.clone();
                cholesky.solve(&mut solution, 2);
                for (a, b) in solution.iter().zip(&x) {
                    assert!((a - b).abs() < 1e-12, "{a} {b}");
                }
            }
        }
    }

    #[test]
    fn the_selected_inverse_is_that_of_solving_column_by_column() {
        // A band, and a far corner that fills in.
        let mut columns: Vec<Vec<u32>> = (0..150)
            .map(|c| (c..150.min(c + 5)).chain(if c % 9 == 0 { 147..150 } else { 0..0 }).collect())
            .collect();
        columns.iter_mut().for_each(|column| {
            column.sort_unstable();
            column.dedup();
        });
        let dims: Vec<usize> = (0..150).map(|k| 1 + k * 7 % 4).collect();
        let mut matrix = BlockMatrix::new(&dims, &columns);
        for (k, v) in matrix.values.iter_mut().enumerate() {
            *v = 0.1 * ((k * 7919 % 101) as f64 / 101.0 - 0.5);
        }
        let n = matrix.dimension();
        matrix.add_to_diagonal(&vec![3.0; n]);
        for dense in [true, false] {
            let mut cholesky = Cholesky::analyze(&matrix, dense);
            cholesky.factorize(&matrix).unwrap();
            assert_eq!(cholesky.fronts.fronts().len() > 1, !dense);
            let mut all = vec![0.0; n * n];
            (0..n).for_each(|k| all[k * n + k] = 1.0);
            cholesky.solve(&mut all, n);
            let inverse = cholesky.selected_inverse(&matrix);
            for column in 0..matrix.block_count() {
                for slot in matrix.column_ptr[column]..matrix.column_ptr[column + 1] {
                    let row = matrix.rows[slot] as usize;
                    let values = &inverse.values[matrix.value_ptr[slot]..];
                    for j in 0..matrix.dim(column) {
                        for i in 0..matrix.dim(row) {
                            let at = (matrix.starts[column] + j) * n + matrix.starts[row] + i;
                            let found = values[j * matrix.dim(row) + i];
                            assert!((found - all[at]).abs() < 1e-14, "{found} {}", all[at]);
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn an_indefinite_matrix_is_refused() {
        let mut matrix = banded(200, 4);
        let n = matrix.dimension();
        let mut shift = vec![0.0; n];
        shift[n / 2] = -10.0;
        matrix.add_to_diagonal(&shift);
        for dense in [true, false] {
            let result = Cholesky::analyze(&matrix, dense).factorize(&matrix);
            assert_eq!(result, Err(NotPositiveDefinite(None)));
        }
        let mut broken = banded(60, 2);
        broken.values[3] = f64::NAN;
        assert_eq!(
            Cholesky::analyze(&broken, true).factorize(&broken),
            Err(NotPositiveDefinite(None))
        );
    }
}
