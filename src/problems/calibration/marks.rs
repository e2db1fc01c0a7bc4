//! The residuals of a calibration: where the corners of the board should be in the photos, minus
//! where they were measured, in pixels.

use super::Mark;
use crate::{
    camera::{Interior, Lens, Model},
    geometry::{cross, dot, rotation},
    nlls::{Batch, BlockId, InfeasibleFactor, Point},
};
use std::ops::Range;

/// Marks of `N` blocks each: lens and pose, then perhaps the height of the corner. Marks of one
/// photo follow each other, so what its pose needs is computed once.
#[derive(Debug, Clone)]
pub(super) struct BoardMarks<const N: usize> {
    model: Model,
    size_px: [u32; 2],
    blocks: Vec<[BlockId; N]>,
    marks: Vec<Mark>,
}

/// Of a flat board.
pub(super) type FlatMarks = BoardMarks<2>;
/// Of a board of any shape.
pub(super) type Marks = BoardMarks<3>;

impl<const N: usize> BoardMarks<N> {
    pub(super) fn new(
        model: Model,
        size_px: [u32; 2],
        marks: Vec<([BlockId; N], Mark)>,
    ) -> BoardMarks<N> {
        let (blocks, marks) = marks.into_iter().unzip();
        BoardMarks { model, size_px, blocks, marks }
    }
}

impl<const N: usize> Batch for BoardMarks<N> {
    fn len(&self) -> usize {
        self.marks.len()
    }

    fn rows(&self) -> usize {
        2
    }

    fn blocks(&self, factor: usize) -> &[BlockId] {
        &self.blocks[factor]
    }

    fn linearize(
        &self,
        range: Range<usize>,
        x: Point<'_>,
        residual: &mut [f64],
        mut jacobian: Option<&mut [f64]>,
        width: usize,
    ) -> Result<(), InfeasibleFactor> {
        let Some(first) = self.blocks.get(range.start) else { return Ok(()) };
        let values = x.block(first[0]);
        let centre = self.size_px.map(|n| 0.5 * (f64::from(n) - 1.0));
        let lens = Interior::unchecked(self.model, self.size_px, centre, values);
        let parameters = values.len();
        let mut pose = None;
        let (mut r, mut t) = ([[0.0; 3]; 3], [0.0; 3]);
        for (k, factor) in range.enumerate() {
            let blocks = &self.blocks[factor];
            let mark = &self.marks[factor];
            if pose != Some(blocks[1]) {
                let values = x.block(blocks[1]);
                r = rotation::matrix([values[0], values[1], values[2], values[3]]);
                t = [values[4], values[5], values[6]];
                pose = Some(blocks[1]);
            }
            let height = if N > 2 { x.block(blocks[2])[0] } else { 0.0 };
            let board = [mark.board_m[0], mark.board_m[1], height];
            let point: [f64; 3] = std::array::from_fn(|i| dot(r[i], board) + t[i]);
            let out = &mut residual[2 * k..2 * k + 2];
            match jacobian.as_deref_mut() {
                None => {
                    let image_px = lens.project(point).ok_or(InfeasibleFactor(factor))?;
                    out[0] = image_px[0] - mark.image_px[0];
                    out[1] = image_px[1] - mark.image_px[1];
                }
                Some(all) => {
                    let found =
                        lens.project_with_derivatives(point).ok_or(InfeasibleFactor(factor))?;
                    for row in 0..2 {
                        out[row] = found.image_px[row] - mark.image_px[row];
                        let start = (2 * k + row) * width;
                        let to = &mut all[start..start + width];
                        to[..parameters].copy_from_slice(&found.by_parameters[row][..parameters]);
                        let j = found.by_point[row];
                        // dP = w x P + s
                        to[parameters..parameters + 3].copy_from_slice(&cross(point, j));
                        to[parameters + 3..parameters + 6].copy_from_slice(&j);
                        if N > 2 {
                            to[parameters + 6] = dot(j, [r[0][2], r[1][2], r[2][2]]);
                        }
                    }
                }
            }
            if !(out[0].is_finite() && out[1].is_finite()) {
                return Err(InfeasibleFactor(factor));
            }
        }
        Ok(())
    }
}
