//! The numeric factorisation over a [`Tree`] of dense fronts (multifrontal), and solving with it.
//!
//! Subtrees are factorised at the same time, each with memory of its own; the fronts above them
//! one after the other, their larger parts cut into pieces of a fixed size. What is added to what,
//! and in which order, depends on the tree alone, so that neither does the result on the number
//! of threads.

use super::{
    BlockMatrix, NotPositiveDefinite,
    tree::{Entry, Front, NO_PARENT, Task, Tree},
};
use faer::{
    Accum, MatMut, MatRef, Par, Spec,
    dyn_stack::{MemBuffer, MemStack},
    linalg::{
        cholesky::llt,
        matmul::{
            matmul,
            triangular::{self, BlockStructure},
        },
        triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place},
    },
};
use rayon::prelude::*;

/// Columns factorised at a time.
const PANEL: usize = 96;
/// Columns of an update, or rows below a panel, that one thread works on at a time.
pub(super) const PIECE: usize = 96;
/// Fronts of fewer rows are not worth cutting.
const CUT_FROM: usize = 256;

/// A factorisation with all its memory.
#[derive(Debug)]
pub(super) struct Fronts {
    tree: Tree,
    memory: Vec<FrontMemory>,
    /// Right-hand sides of one front.
    local: Vec<f64>,
}

/// What one task works in.
#[derive(Debug)]
struct FrontMemory {
    /// The fronts' columns, one front after the other, each column-major.
    factor: Vec<f64>,
    /// Updates that wait for their parents: lower triangles by columns.
    stack: Vec<f64>,
    /// The update of the front at hand, square.
    update: Vec<f64>,
    scratch: Scratch,
}

struct Scratch(MemBuffer);

impl std::fmt::Debug for Scratch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Scratch")
    }
}

impl Fronts {
    pub(super) fn new(tree: Tree) -> Fronts {
        let memory = tree.tasks.iter().map(FrontMemory::new).collect();
        Fronts { tree, memory, local: Vec::new() }
    }

    pub(super) fn factorize(&mut self, matrix: &BlockMatrix) -> Result<(), NotPositiveDefinite> {
        let Fronts { tree, memory, .. } = self;
        let Some((above, subtrees)) = memory.split_last_mut() else { return Ok(()) };
        subtrees
            .par_iter_mut()
            .zip(&tree.tasks)
            .with_max_len(1)
            .map(|(memory, task)| memory.factorize(matrix, tree, task, &[]))
            .collect::<Result<(), NotPositiveDefinite>>()?;
        tree.tasks.last().map_or(Ok(()), |task| above.factorize(matrix, tree, task, subtrees))
    }

    pub(super) fn fronts(&self) -> &[Front] {
        &self.tree.fronts
    }

    /// The factor's columns of front `k`.
    pub(super) fn columns(&self, k: usize) -> MatRef<'_, f64> {
        let front = &self.tree.fronts[k];
        let (rows, width) = (front.order, front.width);
        let factor = &self.memory[self.tree.task_of[k]].factor[front.factor_at..];
        MatRef::from_column_major_slice(&factor[..rows * width], rows, width)
    }

    /// Solves for `columns` right-hand sides of `dimension` stored one after the other.
    pub(super) fn solve(&mut self, rhs: &mut [f64], dimension: usize, columns: usize) {
        debug_assert_eq!(rhs.len(), dimension * columns);
        let Fronts { tree, memory, local } = self;
        for (k, front) in tree.fronts.iter().enumerate() {
            let (l, mut b) = front_system(tree, memory, k, local, columns);
            front.gather(rhs, dimension, b.as_mut());
            let (mut top, mut bottom) = b.split_at_row_mut(front.width);
            let (diagonal, below) = l.split_at_row(front.width);
            solve_lower_triangular_in_place(diagonal, top.as_mut(), Par::Seq);
            matmul(bottom.as_mut(), Accum::Add, below, top.as_ref(), -1.0, Par::Seq);
            front.scatter(top.as_ref(), bottom.as_ref(), rhs, dimension);
        }
        for (k, front) in tree.fronts.iter().enumerate().rev() {
            let (l, mut b) = front_system(tree, memory, k, local, columns);
            front.gather(rhs, dimension, b.as_mut());
            let (mut top, bottom) = b.split_at_row_mut(front.width);
            let (diagonal, below) = l.split_at_row(front.width);
            matmul(top.as_mut(), Accum::Add, below.transpose(), bottom.as_ref(), -1.0, Par::Seq);
            solve_upper_triangular_in_place(diagonal.transpose(), top.as_mut(), Par::Seq);
            front.scatter(top.as_ref(), bottom.as_ref(), rhs, dimension);
        }
    }
}

/// The columns of front `k` and room for its right-hand sides.
fn front_system<'a>(
    tree: &Tree,
    memory: &'a [FrontMemory],
    k: usize,
    local: &'a mut Vec<f64>,
    columns: usize,
) -> (MatRef<'a, f64>, MatMut<'a, f64>) {
    let front = &tree.fronts[k];
    let factor = &memory[tree.task_of[k]].factor[front.factor_at..];
    if local.len() < front.order * columns {
        local.resize(front.order * columns, 0.0);
    }
    let (rows, width) = (front.order, front.width);
    (
        MatRef::from_column_major_slice(&factor[..rows * width], rows, width),
        MatMut::from_column_major_slice_mut(&mut local[..rows * columns], rows, columns),
    )
}

impl Front {
    fn gather(&self, rhs: &[f64], dimension: usize, mut b: MatMut<'_, f64>) {
        for column in 0..b.ncols() {
            let rhs = &rhs[column * dimension..(column + 1) * dimension];
            for (row, &scalar) in self.scalars.iter().enumerate() {
                b[(row, column)] = rhs[scalar as usize];
            }
        }
    }

    fn scatter(
        &self,
        top: MatRef<'_, f64>,
        bottom: MatRef<'_, f64>,
        rhs: &mut [f64],
        dimension: usize,
    ) {
        for column in 0..top.ncols() {
            let rhs = &mut rhs[column * dimension..(column + 1) * dimension];
            let (own, rest) = self.scalars.split_at(self.width);
            for (row, &scalar) in own.iter().enumerate() {
                rhs[scalar as usize] = top[(row, column)];
            }
            for (row, &scalar) in rest.iter().enumerate() {
                rhs[scalar as usize] = bottom[(row, column)];
            }
        }
    }
}

impl FrontMemory {
    fn new(task: &Task) -> FrontMemory {
        let scratch =
            llt::factor::cholesky_in_place_scratch::<f64>(PANEL, Par::Seq, Spec::default());
        FrontMemory {
            factor: vec![0.0; task.factor_len],
            stack: vec![0.0; task.stack_len],
            update: vec![0.0; task.update_len],
            scratch: Scratch(MemBuffer::new(scratch)),
        }
    }

    /// Factorises the fronts of one task; `others` are the tasks that came before.
    fn factorize(
        &mut self,
        matrix: &BlockMatrix,
        tree: &Tree,
        task: &Task,
        others: &[FrontMemory],
    ) -> Result<(), NotPositiveDefinite> {
        for &k in &task.fronts {
            let front = &tree.fronts[k];
            let (rows, width, rest) = (front.order, front.width, front.rest());
            let columns = &mut self.factor[front.factor_at..front.factor_at + rows * width];
            columns.fill(0.0);
            let update = &mut self.update[..rest * rest];
            update.fill(0.0);
            for entry in &front.entries {
                add_entry(matrix, entry, columns, rows);
            }
            for &child in &front.children {
                let child_task = tree.task_of[child];
                let other = others.get(child_task);
                debug_assert!(other.is_some() || task.fronts.contains(&child));
                let stack = other.map_or(&self.stack, |memory| &memory.stack);
                extend_add(&tree.fronts[child], stack, columns, update, (rows, width));
            }
            let mut l = MatMut::from_column_major_slice_mut(columns, rows, width);
            factorize_columns(l.as_mut(), &mut self.scratch)?;
            if front.parent != NO_PARENT {
                let u = MatMut::from_column_major_slice_mut(update, rest, rest);
                subtract_lower(u, l.as_ref().split_at_row(width).1);
                let mut to = front.update_at;
                for column in 0..rest {
                    let from = &update[column * rest + column..(column + 1) * rest];
                    self.stack[to..to + from.len()].copy_from_slice(from);
                    to += from.len();
                }
            }
        }
        Ok(())
    }
}

fn add_entry(matrix: &BlockMatrix, entry: &Entry, columns: &mut [f64], rows: usize) {
    let values = &matrix.values[matrix.value_ptr[entry.slot]..matrix.value_ptr[entry.slot + 1]];
    let height = matrix.dim(matrix.rows[entry.slot] as usize);
    let at = entry.column * rows + entry.row;
    if entry.turned {
        for (column, values) in values.chunks_exact(height).enumerate() {
            for (row, v) in values.iter().enumerate() {
                columns[at + row * rows + column] = *v;
            }
        }
    } else {
        // What lies above the diagonal is never read.
        for (column, values) in values.chunks_exact(height).enumerate() {
            let to = at + column * rows;
            columns[to..to + height].copy_from_slice(values);
        }
    }
}

/// Adds a child's update to the columns and the update of its parent.
fn extend_add(
    child: &Front,
    stack: &[f64],
    columns: &mut [f64],
    update: &mut [f64],
    (rows, width): (usize, usize),
) {
    let rest = rows - width;
    let mut from = child.update_at;
    for (k, &(own_column, to_column, length)) in child.runs.iter().enumerate() {
        for step in 0..length {
            let column = (to_column + step) as usize;
            let (to, offset) = if column < width {
                (&mut columns[column * rows..(column + 1) * rows], 0)
            } else {
                (&mut update[(column - width) * rest..(column - width + 1) * rest], width)
            };
            for (later, &(own_row, to_row, length)) in child.runs[k..].iter().enumerate() {
                let skip = if later == 0 { step } else { 0 };
                debug_assert!(later > 0 || own_row == own_column);
                let first = (to_row + skip) as usize - offset;
                let to = &mut to[first..first + (length - skip) as usize];
                for (to, from) in to.iter_mut().zip(&stack[from..]) {
                    *to += from;
                }
                from += (length - skip) as usize;
            }
        }
    }
}

/// Cholesky of the upper square of `l`, and the rows below it.
fn factorize_columns(
    mut l: MatMut<'_, f64>,
    scratch: &mut Scratch,
) -> Result<(), NotPositiveDefinite> {
    let (rows, width) = (l.nrows(), l.ncols());
    let mut first = 0;
    while first < width {
        let count = PANEL.min(width - first);
        let (panel, right) = l.as_mut().get_mut(first.., first..).split_at_col_mut(count);
        let (mut diagonal, mut below) = panel.split_at_row_mut(count);
        llt::factor::cholesky_in_place(
            diagonal.as_mut(),
            Default::default(),
            Par::Seq,
            MemStack::new(&mut scratch.0),
            Spec::default(),
        )
        .map_err(|_| NotPositiveDefinite(None))?;
        // A NaN passes every comparison that would reject a bad pivot.
        if !(0..count).all(|k| diagonal[(k, k)].is_finite() && diagonal[(k, k)] > 0.0) {
            return Err(NotPositiveDefinite(None));
        }
        let diagonal = diagonal.as_ref();
        if rows - first < CUT_FROM {
            solve_lower_triangular_in_place(diagonal, below.as_mut().transpose_mut(), Par::Seq);
        } else {
            below.as_mut().par_row_chunks_mut(PIECE).for_each(|piece| {
                solve_lower_triangular_in_place(diagonal, piece.transpose_mut(), Par::Seq);
            });
        }
        let trailing = right.split_at_row_mut(count).1;
        subtract_lower(trailing, below.as_ref());
        first += count;
    }
    Ok(())
}

/// `a -= x y^T` on and below the diagonal of the first columns, `y` the first rows of `x`.
fn subtract_lower(a: MatMut<'_, f64>, x: MatRef<'_, f64>) {
    let (rows, columns) = (a.nrows(), a.ncols());
    if rows < CUT_FROM {
        subtract_piece(a, x, 0);
    } else if columns > 0 {
        a.par_col_chunks_mut(PIECE)
            .enumerate()
            .with_max_len(1)
            .for_each(|(k, piece)| subtract_piece(piece, x, k * PIECE));
    }
}

/// Columns `first..` of [`subtract_lower`].
fn subtract_piece(a: MatMut<'_, f64>, x: MatRef<'_, f64>, first: usize) {
    let columns = a.ncols();
    let a = a.split_at_row_mut(first).1;
    let (square, below) = a.split_at_row_mut(columns);
    let x = x.split_at_row(first).1;
    let (own, rest) = x.split_at_row(columns);
    triangular::matmul(
        square,
        BlockStructure::TriangularLower,
        Accum::Add,
        own,
        BlockStructure::Rectangular,
        own.transpose(),
        BlockStructure::Rectangular,
        -1.0,
        Par::Seq,
    );
    matmul(below, Accum::Add, rest, own.transpose(), -1.0, Par::Seq);
}
