//! Cholesky factorisation of the (reduced) normal equations; the only file that knows faer.
//!
//! The matrix is symmetric, stored as the blocks of its lower triangle ([`BlockMatrix`]). A
//! fill-reducing order is found once on the graph of blocks (approximate minimum degree), the
//! symbolic factorisation once, and all memory is kept between factorisations. A matrix that would
//! fill in anyway is factorised dense.

use faer::{
    Conj, MatMut, Par, Side, Spec,
    dyn_stack::{MemBuffer, MemStack},
    linalg::cholesky::llt,
    perm::PermRef,
    sparse::{
        SparseColMatRef, SymbolicSparseColMatRef,
        linalg::{
            amd,
            cholesky::{
                CholeskySymbolicParams, LltRef, SymbolicCholesky, SymmetricOrdering,
                factorize_symbolic_cholesky,
            },
        },
    },
};

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
    pub(super) fn new(dims: &[usize], columns: &[Vec<u32>]) -> BlockMatrix {
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
        matrix.values = vec![0.0; size];
        matrix
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

    /// `y = A x`.
    pub(super) fn multiply(&self, x: &[f64], y: &mut [f64]) {
        y.fill(0.0);
        self.for_each_column(|row, column, values| {
            for (k, v) in values.iter().enumerate() {
                y[row + k] += v * x[column];
                if row + k != column {
                    y[column] += v * x[row + k];
                }
            }
        });
    }

    /// Calls `visit(row, column, first, values)` for each column of each block: `values` go to
    /// scalar rows `row..` of scalar column `column`, without what lies above the diagonal.
    fn for_each_column(&self, mut visit: impl FnMut(usize, usize, &[f64])) {
        for column in 0..self.block_count() {
            for k in 0..self.dim(column) {
                for slot in self.column_ptr[column]..self.column_ptr[column + 1] {
                    let row = self.rows[slot] as usize;
                    let dim = self.dim(row);
                    let skip = if row == column { k } else { 0 };
                    let at = self.value_ptr[slot] + k * dim;
                    visit(
                        self.starts[row] + skip,
                        self.starts[column] + k,
                        &self.values[at + skip..at + dim],
                    );
                }
            }
        }
    }
}

/// The matrix is not positive definite to working precision; where it is known, the eliminated
/// block (by its index in the problem) whose own matrix is not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct NotPositiveDefinite(pub(super) Option<usize>);

/// A Cholesky factorisation that remembers its analysis and memory.
pub(super) enum Cholesky {
    Dense { dimension: usize, factor: Vec<f64>, memory: MemBuffer },
    Sparse(Box<Sparse>),
}

pub(super) struct Sparse {
    symbolic: SymbolicCholesky<usize>,
    column_ptr: Vec<usize>,
    row_index: Vec<usize>,
    values: Vec<f64>,
    factor: Vec<f64>,
    memory: MemBuffer,
}

impl std::fmt::Debug for Cholesky {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Cholesky::Dense { dimension, .. } => write!(f, "Cholesky::Dense({dimension})"),
            Cholesky::Sparse(sparse) => write!(f, "Cholesky::Sparse({})", sparse.column_ptr.len()),
        }
    }
}

/// How faer cuts its work: by the dimension, never by the number of threads, for the cuts decide how
/// sums are rounded.
fn parallelism(dimension: usize) -> Par {
    if dimension < 1500 { Par::Seq } else { Par::Rayon(TWO) }
}

const TWO: std::num::NonZeroUsize = std::num::NonZeroUsize::MIN.saturating_add(1);

/// Below this dimension the dense factorisation always wins.
const SMALL: usize = 160;
/// Share of a full lower triangle from which a sparse factor is slower than a dense one.
const FULL: f64 = 0.7;

impl Cholesky {
    /// Analyses the pattern of `matrix`.
    pub(super) fn analyze(matrix: &BlockMatrix, prefer_dense: bool) -> Cholesky {
        let dimension = matrix.dimension();
        if !prefer_dense
            && dimension > SMALL
            && let Some(sparse) = Sparse::analyze(matrix)
            && (sparse.factor.len() as f64) < FULL * 0.5 * (dimension as f64).powi(2)
        {
            return Cholesky::Sparse(Box::new(sparse));
        }
        let par = parallelism(dimension);
        let factor = llt::factor::cholesky_in_place_scratch::<f64>(dimension, par, Spec::default());
        let solve = llt::solve::solve_in_place_scratch::<f64>(dimension, MAX_COLUMNS, par);
        let scratch = factor.or(solve);
        Cholesky::Dense {
            dimension,
            factor: vec![0.0; dimension * dimension],
            memory: MemBuffer::new(scratch),
        }
    }

    /// Factorises `matrix`, whose pattern is the one that was analysed.
    pub(super) fn factorize(&mut self, matrix: &BlockMatrix) -> Result<(), NotPositiveDefinite> {
        match self {
            Cholesky::Dense { dimension, factor, memory } => {
                let n = *dimension;
                factor.fill(0.0);
                matrix.for_each_column(|row, column, values| {
                    let at = column * n + row;
                    factor[at..at + values.len()].copy_from_slice(values);
                });
                let a = MatMut::from_column_major_slice_mut(factor, n, n);
                llt::factor::cholesky_in_place(
                    a,
                    Default::default(),
                    parallelism(n),
                    MemStack::new(memory),
                    Spec::default(),
                )
                .map_err(|_| NotPositiveDefinite(None))?;
                // A NaN passes every comparison that would reject a bad pivot.
                (0..n)
                    .all(|k| factor[k * n + k].is_finite() && factor[k * n + k] > 0.0)
                    .then_some(())
                    .ok_or(NotPositiveDefinite(None))
            }
            Cholesky::Sparse(sparse) => sparse.factorize(matrix),
        }
    }

    /// Solves for `columns` right-hand sides stored one after the other.
    pub(super) fn solve(&mut self, rhs: &mut [f64], columns: usize) {
        match self {
            Cholesky::Dense { dimension, factor, memory } => {
                let n = *dimension;
                let l = faer::MatRef::from_column_major_slice(factor, n, n);
                for chunk in rhs.chunks_mut(n * MAX_COLUMNS) {
                    let count = chunk.len() / n;
                    llt::solve::solve_in_place(
                        l,
                        MatMut::from_column_major_slice_mut(chunk, n, count),
                        Par::Seq,
                        MemStack::new(memory),
                    );
                }
                debug_assert_eq!(rhs.len(), n * columns);
            }
            Cholesky::Sparse(sparse) => sparse.solve(rhs, columns),
        }
    }
}

/// Right-hand sides solved at a time.
const MAX_COLUMNS: usize = 32;

impl Sparse {
    fn analyze(matrix: &BlockMatrix) -> Option<Sparse> {
        let n = matrix.dimension();
        let (mut column_ptr, mut row_index) = (vec![0; n + 1], Vec::new());
        matrix.for_each_column(|row, column, values| {
            row_index.extend(row..row + values.len());
            column_ptr[column + 1] = row_index.len();
        });
        let (forward, inverse) = order(matrix)?;
        let pattern = SymbolicSparseColMatRef::new_checked(n, n, &column_ptr, None, &row_index);
        let symbolic = factorize_symbolic_cholesky(
            pattern,
            Side::Lower,
            SymmetricOrdering::Custom(PermRef::new_checked(&forward, &inverse, n)),
            CholeskySymbolicParams::default(),
        )
        .ok()?;
        let scratch = symbolic
            .factorize_numeric_llt_scratch::<f64>(parallelism(n), Spec::default())
            .or(symbolic.solve_in_place_scratch::<f64>(MAX_COLUMNS, Par::Seq));
        Some(Sparse {
            values: vec![0.0; row_index.len()],
            factor: vec![0.0; symbolic.len_val()],
            memory: MemBuffer::new(scratch),
            symbolic,
            column_ptr,
            row_index,
        })
    }

    fn factorize(&mut self, matrix: &BlockMatrix) -> Result<(), NotPositiveDefinite> {
        let n = self.column_ptr.len() - 1;
        let (mut at, values) = (0, &mut self.values);
        matrix.for_each_column(|_, _, column| {
            values[at..at + column.len()].copy_from_slice(column);
            at += column.len();
        });
        let pattern =
            SymbolicSparseColMatRef::new_checked(n, n, &self.column_ptr, None, &self.row_index);
        self.symbolic
            .factorize_numeric_llt(
                &mut self.factor,
                SparseColMatRef::new(pattern, self.values.as_slice()),
                Side::Lower,
                Default::default(),
                parallelism(n),
                MemStack::new(&mut self.memory),
                Spec::default(),
            )
            .map_err(|_| NotPositiveDefinite(None))?;
        self.factor.iter().all(|v| v.is_finite()).then_some(()).ok_or(NotPositiveDefinite(None))
    }

    fn solve(&mut self, rhs: &mut [f64], columns: usize) {
        let n = self.column_ptr.len() - 1;
        debug_assert_eq!(rhs.len(), n * columns);
        let factor = LltRef::new(&self.symbolic, self.factor.as_slice());
        for chunk in rhs.chunks_mut(n * MAX_COLUMNS) {
            let count = chunk.len() / n;
            factor.solve_in_place_with_conj(
                Conj::No,
                MatMut::from_column_major_slice_mut(chunk, n, count),
                Par::Seq,
                MemStack::new(&mut self.memory),
            );
        }
    }
}

/// A fill-reducing order of the scalars: minimum degree on the graph of blocks, which is as good
/// as on the scalars and cheaper by the square of the block size.
fn order(matrix: &BlockMatrix) -> Option<(Vec<usize>, Vec<usize>)> {
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
    let scalars: Vec<usize> =
        forward.iter().flat_map(|&b| matrix.starts[b]..matrix.starts[b + 1]).collect();
    let mut back = vec![0; scalars.len()];
    for (new, &old) in scalars.iter().enumerate() {
        back[old] = new;
    }
    Some((scalars, back))
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
            assert_eq!(matches!(cholesky, Cholesky::Dense { .. }), dense);
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
