//! The inverse in the pattern of the matrix, from its factor (Takahashi's equations over fronts).
//!
//! With the columns `[L_1; L_2]` of a front, `Y = L_2 L_1^-1` and the inverse `Z` among the rows below, which
//! are rows of its parent,
//!
//! `Z_21 = -Z_22 Y`, `Z_11 = (L_1 L_1^T)^-1 - Y^T Z_21`:
//!
//! from the root down this costs a few factorisations, where a solve for every column costs as many
//! as there are columns. What is added to what depends on the tree alone.
//!
//! Reference: K. Takahashi, J. Fagan and M. Chin, "Formation of a sparse bus impedance matrix and its
//! application to short circuit study", PICA 1973; over supernodes L. Lin et al., "SelInv", ACM TOMS 37(4), 2011.

use super::{
    BlockMatrix,
    fronts::{Fronts, PIECE},
    tree::{Entry, Front, NO_PARENT},
};
use faer::{
    Accum, Mat, MatMut, MatRef, Par,
    linalg::{
        matmul::matmul,
        triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place},
    },
};
use rayon::prelude::*;

impl Fronts {
    /// The blocks of the inverse of the matrix that was factorised, where `matrix`, of the same
    /// pattern, has any.
    pub(super) fn selected_inverse(&self, matrix: &BlockMatrix) -> BlockMatrix {
        let mut out = matrix.clone();
        let fronts = self.fronts();
        // Of fronts with children to come.
        let mut known: Vec<Option<Mat<f64>>> = fronts.iter().map(|_| None).collect();
        let mut waiting: Vec<usize> = fronts.iter().map(|front| front.children.len()).collect();
        for (k, front) in fronts.iter().enumerate().rev() {
            let mut z = Mat::zeros(front.order, front.order);
            if front.parent != NO_PARENT {
                if let Some(above) = &known[front.parent] {
                    gather(front, above, z.as_mut().get_mut(front.width.., front.width..));
                }
                waiting[front.parent] -= 1;
                if waiting[front.parent] == 0 {
                    known[front.parent] = None;
                }
            }
            complete(z.as_mut(), self.columns(k));
            front.entries.iter().for_each(|entry| take(entry, z.as_ref(), &mut out));
            if waiting[k] > 0 {
                known[k] = Some(z);
            }
        }
        out
    }
}

/// Takes the inverse among a front's rows below its own columns from its parent's.
fn gather(front: &Front, above: &Mat<f64>, mut to: MatMut<'_, f64>) {
    for &(own_column, column, columns) in &front.runs {
        for step in 0..columns as usize {
            for &(own_row, row, rows) in &front.runs {
                for k in 0..rows as usize {
                    to[(own_row as usize + k, own_column as usize + step)] =
                        above[(row as usize + k, column as usize + step)];
                }
            }
        }
    }
}

/// Fills in the first columns and rows of `z`, whose last ones are known.
fn complete(z: MatMut<'_, f64>, l: MatRef<'_, f64>) {
    let width = l.ncols();
    let (diagonal, below) = l.split_at_row(width);
    let (mut own, mut right, mut left, rest) = z.split_at_mut(width, width);
    let rest = rest.as_ref();
    let mut y = Mat::from_fn(width, below.nrows(), |i, j| below[(j, i)]);
    y.as_mut().par_col_chunks_mut(PIECE).for_each(|piece| {
        solve_upper_triangular_in_place(diagonal.transpose(), piece, Par::Seq);
    });
    let y = y.as_ref();
    left.as_mut().par_col_chunks_mut(PIECE).enumerate().with_max_len(1).for_each(|(k, piece)| {
        let y = y.subrows(k * PIECE, piece.ncols());
        matmul(piece, Accum::Replace, rest, y.transpose(), -1.0, Par::Seq);
    });
    let left = left.as_ref();
    own.as_mut().par_col_chunks_mut(PIECE).enumerate().with_max_len(1).for_each(
        |(k, mut piece)| {
            for column in 0..piece.ncols() {
                piece[(k * PIECE + column, column)] = 1.0;
            }
            solve_lower_triangular_in_place(diagonal, piece.as_mut(), Par::Seq);
            solve_upper_triangular_in_place(diagonal.transpose(), piece.as_mut(), Par::Seq);
            let left = left.subcols(k * PIECE, piece.ncols());
            matmul(piece, Accum::Add, y, left, -1.0, Par::Seq);
        },
    );
    for column in 0..width {
        for row in 0..column {
            own[(row, column)] = own[(column, row)];
        }
        for row in 0..right.ncols() {
            right[(column, row)] = left[(row, column)];
        }
    }
}

/// Takes one block out of a front.
fn take(entry: &Entry, z: MatRef<'_, f64>, out: &mut BlockMatrix) {
    let height = out.dim(out.rows[entry.slot] as usize);
    let values = &mut out.values[out.value_ptr[entry.slot]..out.value_ptr[entry.slot + 1]];
    for (column, values) in values.chunks_exact_mut(height).enumerate() {
        for (row, v) in values.iter_mut().enumerate() {
            let (i, j) = if entry.turned { (column, row) } else { (row, column) };
            *v = z[(entry.row + i, entry.column + j)];
        }
    }
}
