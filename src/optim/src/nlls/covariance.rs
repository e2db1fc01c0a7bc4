//! Covariances from the undamped normal equations, `C = (J^T J)^-1`, for residuals whitened to unit
//! variance (multiply by the a-posteriori variance factor otherwise).
//!
//! Columns of `C` are solved for where they are asked for, through the same elimination as a step:
//! with `E_b` the unit columns of block `b`, `S X_k = E_bk - W V^-1 E_be` and
//! `X_e = V^-1 (E_be - W^T X_k)`. Damping plays no part; parameters that the observations do not
//! determine are named, never hidden behind a small number on the diagonal.

use super::{
    LinearSolver,
    cholesky::{BlockMatrix, NotPositiveDefinite},
    elimination::{backward_solve, forward_solve},
    normal::Normal,
    problem::{BlockId, Problem},
    structure::NONE,
};
use crate::engine::SolveError;
use nalgebra::{DMatrix, SymmetricEigen};

/// Covariances of the blocks of one problem at one solution.
#[derive(Debug)]
pub struct Covariance<'a> {
    problem: &'a Problem,
    normal: Normal,
}

/// A direction is undetermined where its curvature, with every parameter scaled to unit curvature
/// of its own, is below this: some 1e4 roundings of a unit diagonal.
const RANK_TOLERANCE: f64 = 1e-12;
/// Undetermined directions looked for at once.
const DIRECTIONS: usize = 12;

impl<'a> Covariance<'a> {
    /// Factorises the normal equations of `problem` at `x`, without the losses' curvature (each
    /// residual with its weight `rho'`).
    ///
    /// # Errors
    /// [`SolveError::RankDeficient`] names the blocks that the observations leave undetermined.
    pub fn new(problem: &'a Problem, x: &[f64], linear: LinearSolver) -> Result<Self, SolveError> {
        let mut normal = reduced(problem, x, linear)?;
        if let Some(block) = weak_point(problem, &normal) {
            return Err(undetermined_point(problem, block));
        }
        let directions = null_space_directions(problem, &mut normal);
        if !directions.is_empty() {
            return Err(describe(problem, &normal, &directions));
        }
        // Looking for them put a shift into the factor.
        let Normal { solver, matrix, .. } = &mut normal;
        solver.factorize(matrix).map_err(|_| {
            SolveError::RankDeficient("the normal equations are not positive definite".into())
        })?;
        Ok(Covariance { problem, normal })
    }

    /// The covariance of one block's tangent, row-major; entries that were fixed are 0.
    pub fn block(&mut self, block: BlockId) -> Vec<f64> {
        self.cross(block, block)
    }

    /// The covariance between the tangents of two blocks, `first x second`, row-major.
    pub fn cross(&mut self, first: BlockId, second: BlockId) -> Vec<f64> {
        let solution = self.columns(second);
        self.cross_of(first, second, &solution)
    }

    /// [`Covariance::cross`] of several blocks with one, solved for once: how the blocks of a
    /// selected inverse are had without ever holding all of it.
    pub fn cross_many(&mut self, firsts: &[BlockId], second: BlockId) -> Vec<Vec<f64>> {
        let solution = self.columns(second);
        firsts.iter().map(|&first| self.cross_of(first, second, &solution)).collect()
    }

    /// The covariances of all pairs of retained blocks that a factor or an eliminated block couples, at the
    /// cost of a few factorisations.
    pub fn selected_inverse(&self) -> SelectedCovariance<'_> {
        let Normal { solver, matrix, .. } = &self.normal;
        SelectedCovariance { of: self, inverse: solver.selected_inverse(matrix) }
    }

    /// Whether an entry of a block's tangent must not move.
    fn is_frozen(&self, block: BlockId, k: usize) -> bool {
        self.problem.blocks[block.index()].frozen >> k & 1 == 1
    }

    fn cross_of(&self, first: BlockId, second: BlockId, solution: &[f64]) -> Vec<f64> {
        let (rows, columns) = (self.problem.dimension(first), self.problem.dimension(second));
        let mut out = vec![0.0; rows * columns];
        for column in 0..columns {
            let values = self.rows_of(first, second, column, solution);
            for row in 0..rows {
                out[row * columns + column] = values[row];
            }
        }
        for row in 0..rows {
            for column in 0..columns {
                if self.is_frozen(first, row) || self.is_frozen(second, column) {
                    out[row * columns + column] = 0.0;
                }
            }
        }
        out
    }

    /// The retained part of the columns of `C` that belong to `block`, column after column.
    fn columns(&mut self, block: BlockId) -> Vec<f64> {
        let index = block.index();
        let n = self.problem.dimension(block);
        let dimension = self.normal.matrix.dimension();
        let mut rhs = vec![0.0; dimension * n];
        let place = self.normal.structure.retained_index[index];
        let e = self.normal.structure.eliminated_index[index];
        if place != NONE {
            let start = self.normal.matrix.starts[place as usize];
            for k in 0..n {
                rhs[k * dimension + start + k] = 1.0;
            }
        } else if e != NONE {
            let factor = self.normal.point_factor(e as usize).to_vec();
            for (retained, transposed) in self.normal.coupling(self.problem, e as usize) {
                let start = self.normal.matrix.starts[retained];
                let dim = transposed.len() / n;
                for column in 0..n {
                    let mut unit = vec![0.0; n];
                    unit[column] = 1.0;
                    solve_small(&factor, n, &mut unit);
                    for j in 0..dim {
                        let sum: f64 = (0..n).map(|i| transposed[i * dim + j] * unit[i]).sum();
                        rhs[column * dimension + start + j] = -sum;
                    }
                }
            }
        } else {
            return rhs;
        }
        if let Some(cholesky) = self.normal.solver.cholesky() {
            cholesky.solve(&mut rhs, n);
        }
        rhs
    }

    /// Rows `block` of column `column` of `of`, given the retained part of its columns.
    fn rows_of(&self, block: BlockId, of: BlockId, column: usize, solution: &[f64]) -> Vec<f64> {
        let index = block.index();
        let n = self.problem.dimension(block);
        let dimension = self.normal.matrix.dimension();
        let retained = &solution[column * dimension..(column + 1) * dimension];
        let place = self.normal.structure.retained_index[index];
        let e = self.normal.structure.eliminated_index[index];
        if place != NONE {
            let start = self.normal.matrix.starts[place as usize];
            return retained[start..start + n].to_vec();
        }
        let mut values = vec![0.0; n];
        if e == NONE {
            return values;
        }
        if block == of {
            values[column] = 1.0;
        }
        for (other, transposed) in self.normal.coupling(self.problem, e as usize) {
            let start = self.normal.matrix.starts[other];
            let dim = transposed.len() / n;
            for i in 0..n {
                for j in 0..dim {
                    values[i] -= transposed[i * dim + j] * retained[start + j];
                }
            }
        }
        solve_small(self.normal.point_factor(e as usize), n, &mut values);
        values
    }
}

/// Covariances of coupled blocks, from [`Covariance::selected_inverse`].
#[derive(Debug)]
pub struct SelectedCovariance<'a> {
    of: &'a Covariance<'a>,
    inverse: Option<BlockMatrix>,
}

impl SelectedCovariance<'_> {
    /// As [`Covariance::cross`]; `None` of blocks that nothing couples, and of eliminated ones.
    pub fn cross(&self, first: BlockId, second: BlockId) -> Option<Vec<f64>> {
        let (of, structure) = (self.of, &self.of.normal.structure);
        let [rows, columns] = [first, second].map(|block| of.problem.dimension(block));
        if [first, second].iter().any(|block| of.problem.blocks[block.index()].is_fixed()) {
            return Some(vec![0.0; rows * columns]);
        }
        let inverse = self.inverse.as_ref()?;
        let [a, b] = [first, second].map(|block| structure.retained_index[block.index()]);
        if [a, b].contains(&NONE) {
            return None;
        }
        let (row, column) = (a.max(b) as usize, a.min(b) as usize);
        let values = &inverse.values[inverse.value_ptr[inverse.slot(row, column)?]..];
        let height = inverse.dim(row);
        Some(
            (0..rows * columns)
                .map(|k| match (k / columns, k % columns) {
                    (i, j) if of.is_frozen(first, i) || of.is_frozen(second, j) => 0.0,
                    (i, j) if a >= b => values[j * height + i],
                    (i, j) => values[i * height + j],
                })
                .collect(),
        )
    }
}

fn solve_small(factor: &[f64], n: usize, b: &mut [f64]) {
    forward_solve(factor, n, b);
    backward_solve(factor, n, b);
}

/// An eliminated block whose own matrix has lost a pivot to rounding.
fn weak_point(problem: &Problem, normal: &Normal) -> Option<usize> {
    (0..normal.structure.eliminated.len()).find_map(|e| {
        let block = normal.structure.eliminated[e];
        let n = problem.blocks[block].dimension;
        let factor = normal.point_factor(e);
        let weak = (0..n).any(|k| {
            let diagonal: f64 = factor[k * n..=k * n + k].iter().map(|v| v * v).sum();
            factor[k * n + k].powi(2) < RANK_TOLERANCE * diagonal
        });
        weak.then_some(block)
    })
}

fn undetermined_point(problem: &Problem, block: usize) -> SolveError {
    SolveError::RankDeficient(format!(
        "{} is not determined by its observations (seen once, or along nearly one line?); leave it out or give it a prior",
        problem.describe(Problem::id(block))
    ))
}

/// Directions of the retained parameters, scaled to unit curvature each, that have next to none
/// together: inverse subspace iteration with Rayleigh-Ritz.
fn null_space_directions(problem: &Problem, normal: &mut Normal) -> Vec<Vec<f64>> {
    let n = normal.matrix.dimension();
    if n == 0 {
        return Vec::new();
    }
    let scale: Vec<f64> = normal
        .structure
        .retained
        .iter()
        .flat_map(|&block| {
            let block = &problem.blocks[block];
            block.tangent..block.tangent + block.dimension
        })
        .map(|k| normal.diagonal[k])
        .map(|d| if d > 0.0 { 1.0 / d.sqrt() } else { 1.0 })
        .collect();
    let mut scaled = normal.matrix.clone();
    scaled.scale(&scale);
    let mut shifted = scaled.clone();
    // Makes the factorisation exist; small against what counts as undetermined.
    let mut shift = RANK_TOLERANCE * 0.01;
    shifted.add_to_diagonal(&vec![shift; n]);
    while normal.solver.factorize(&shifted).is_err() && shift < 1.0 {
        shifted.add_to_diagonal(&vec![9.0 * shift; n]);
        shift *= 10.0;
    }
    let count = DIRECTIONS.min(n);
    // Any start with a part along every direction will do; this one is the same every time.
    let mut basis = DMatrix::from_fn(n, count, |i, j| {
        ((i * count + j) as f64 * 0.754_877_666_246_692_7).fract() - 0.5
    });
    for _ in 0..4 {
        basis = basis.qr().q();
        if let Some(cholesky) = normal.solver.cholesky() {
            cholesky.solve(basis.as_mut_slice(), count);
        }
    }
    let basis = basis.qr().q();
    let mut image = DMatrix::zeros(n, count);
    for k in 0..count {
        let mut product = vec![0.0; n];
        scaled.multiply(basis.column(k).as_slice(), &mut product);
        image.set_column(k, &nalgebra::DVector::from_vec(product));
    }
    let ritz = SymmetricEigen::new(basis.transpose() * image);
    (0..count)
        .filter(|&k| ritz.eigenvalues[k] < RANK_TOLERANCE)
        .map(|k| (&basis * ritz.eigenvectors.column(k)).as_slice().to_vec())
        .collect()
}

/// A direction of the parameters that the observations leave undetermined: its entries by block,
/// scaled so that every parameter has unit curvature of its own, and of unit length over all retained
/// blocks.
pub type Direction = Vec<(BlockId, Vec<f64>)>;

/// The directions of the retained blocks that the observations leave undetermined at `x`, at most a
/// dozen; none where there is a covariance.
///
/// # Errors
/// Where a factor cannot be evaluated or is not finite, or an eliminated block is undetermined by itself.
pub fn null_space(
    problem: &Problem,
    x: &[f64],
    linear: LinearSolver,
) -> Result<Vec<Direction>, SolveError> {
    let mut normal = reduced(problem, x, linear)?;
    let directions = null_space_directions(problem, &mut normal);
    Ok(directions
        .iter()
        .map(|direction| {
            (0..normal.structure.retained.len())
                .map(|place| {
                    let range = normal.matrix.starts[place]..normal.matrix.starts[place + 1];
                    (Problem::id(normal.structure.retained[place]), direction[range].to_vec())
                })
                .collect()
        })
        .collect())
}

/// The reduced normal equations at `x`.
fn reduced(problem: &Problem, x: &[f64], linear: LinearSolver) -> Result<Normal, SolveError> {
    let mut normal = Normal::new(problem, linear.direct(), 0.0, false)?;
    normal
        .linearize(problem, x)
        .map_err(|(batch, factor)| problem.infeasible(&problem.batches[batch], factor))?;
    if let Err(NotPositiveDefinite(block)) = normal.reduce(problem, x, 0.0) {
        normal.require_finite(problem, x)?;
        if let Some(block) = block {
            return Err(undetermined_point(problem, block));
        }
    }
    Ok(normal)
}

fn describe(problem: &Problem, normal: &Normal, directions: &[Vec<f64>]) -> SolveError {
    let mut chunks: Vec<(f64, usize)> = (0..normal.structure.retained.len())
        .map(|place| {
            let range = normal.matrix.starts[place]..normal.matrix.starts[place + 1];
            let chunk: f64 = directions.iter().flat_map(|d| &d[range.clone()]).map(|v| v * v).sum();
            (chunk, place)
        })
        .collect();
    chunks.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let total: f64 = chunks.iter().map(|(chunk, _)| chunk).sum();
    let involved: Vec<_> = chunks.iter().filter(|(chunk, _)| *chunk > 1e-3 * total).collect();
    let names: Vec<String> = involved
        .iter()
        .take(6)
        .map(|(_, place)| {
            let range = normal.matrix.starts[*place]..normal.matrix.starts[*place + 1];
            let entries: Vec<String> = (0..range.len())
                .filter(|k| directions.iter().any(|d| d[range.start + k].powi(2) > 1e-3))
                .map(|k| k.to_string())
                .collect();
            let name = problem.describe(Problem::id(normal.structure.retained[*place]));
            if entries.is_empty() {
                name
            } else {
                format!("{name} (entries {})", entries.join(" "))
            }
        })
        .collect();
    let more = involved.len().saturating_sub(names.len());
    let at_least = if directions.len() == DIRECTIONS { "at least " } else { "" };
    SolveError::RankDeficient(format!(
        "the observations leave {at_least}{} direction(s) undetermined, moving {}{}; \
         fix the gauge, fix one of the parameters or add observations",
        directions.len(),
        names.join(", "),
        if more > 0 { format!(" and {more} more") } else { String::new() }
    ))
}
