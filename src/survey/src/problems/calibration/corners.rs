//! The residuals of a calibration: where the corners of the board should be in the photos, minus
//! where they were measured, in pixels.

use super::Mark;
use crate::camera::{Interior, Lens, MAX_PARAMETERS, Model};
use rowgram_optim::{
    geometry::{cross, dot, rotation},
    nlls::{Batch, BlockId, InfeasibleFactor, Values},
};
use std::ops::Range;

/// How a block of free parameters makes a lens.
#[derive(Debug, Clone)]
pub(super) struct LensParameters {
    model: Model,
    size_px: [u32; 2],
    /// Values of all parameters; the free ones are replaced.
    values: [f64; MAX_PARAMETERS],
    /// Places of the free ones.
    free: Vec<usize>,
}

impl LensParameters {
    pub(super) fn new(interior: &Interior, free: &[bool]) -> LensParameters {
        let mut values = [0.0; MAX_PARAMETERS];
        values[..interior.values().len()].copy_from_slice(interior.values());
        LensParameters {
            model: interior.model(),
            size_px: interior.size_px(),
            values,
            free: (0..free.len()).filter(|&k| free[k]).collect(),
        }
    }

    pub(super) fn free_count(&self) -> usize {
        self.free.len()
    }

    /// All values of the model.
    pub(super) fn values(&self, block: &[f64]) -> [f64; MAX_PARAMETERS] {
        let mut values = self.values;
        for (&place, &value) in self.free.iter().zip(block) {
            values[place] = value;
        }
        values
    }

    /// The values of the free ones.
    pub(super) fn block(&self) -> Vec<f64> {
        self.free.iter().map(|&place| self.values[place]).collect()
    }

    /// The lens of a block, at no pose yet.
    pub(super) fn posed_lens(&self, block: &[f64]) -> PosedLens<'_> {
        let centre = self.size_px.map(|n| 0.5 * (f64::from(n) - 1.0));
        let lens = Interior::unchecked(self.model, self.size_px, centre, &self.values(block));
        PosedLens { lens, free: &self.free, rotation: [[0.0; 3]; 3], translation: [0.0; 3] }
    }
}

/// A lens at a pose.
#[derive(Debug, Clone)]
pub(super) struct PosedLens<'a> {
    lens: Interior,
    free: &'a [usize],
    rotation: [[f64; 3]; 3],
    translation: [f64; 3],
}

impl PosedLens<'_> {
    pub(super) fn with_pose(&self, pose: &[f64]) -> Self {
        PosedLens {
            rotation: rotation::matrix([pose[0], pose[1], pose[2], pose[3]]),
            translation: [pose[4], pose[5], pose[6]],
            ..self.clone()
        }
    }

    #[inline]
    fn point(&self, mark: &Mark, height: f64) -> [f64; 3] {
        let board = [mark.board_m[0], mark.board_m[1], height];
        let (r, t) = (&self.rotation, &self.translation);
        [dot(r[0], board) + t[0], dot(r[1], board) + t[1], dot(r[2], board) + t[2]]
    }

    #[inline]
    pub(super) fn residual(&self, mark: &Mark, height: f64) -> Option<[f64; 2]> {
        let image_px = self.lens.project(self.point(mark, height))?;
        Some([image_px[0] - mark.image_px[0], image_px[1] - mark.image_px[1]])
    }

    /// The residual; its derivatives by the free parameters and the pose go to `rows`; those by the
    /// height are given back.
    #[inline]
    pub(super) fn linearize(
        &self,
        mark: &Mark,
        height: f64,
        rows: [&mut [f64]; 2],
    ) -> Option<([f64; 2], [f64; 2])> {
        let point = self.point(mark, height);
        let found = self.lens.project_with_derivatives(point)?;
        let mut by_height = [0.0; 2];
        let up = [self.rotation[0][2], self.rotation[1][2], self.rotation[2][2]];
        let count = self.free.len();
        for (k, row) in rows.into_iter().enumerate() {
            for (to, &place) in row[..count].iter_mut().zip(self.free) {
                *to = found.by_parameters[k][place];
            }
            let j = found.by_point[k];
            // dP = w x P + s
            row[count..count + 3].copy_from_slice(&cross(point, j));
            row[count + 3..count + 6].copy_from_slice(&j);
            by_height[k] = dot(j, up);
        }
        let u = found.image_px;
        Some(([u[0] - mark.image_px[0], u[1] - mark.image_px[1]], by_height))
    }
}

/// Corners one by one, of `N` blocks each: lens and pose, then perhaps the height of the corner.
/// Those of one photo follow each other, so what its pose needs is computed once.
#[derive(Debug, Clone)]
pub(super) struct CornerObservations<const N: usize> {
    lenses: LensParameters,
    blocks: Vec<[BlockId; N]>,
    marks: Vec<Mark>,
}

impl<const N: usize> CornerObservations<N> {
    pub(super) fn new(
        lenses: LensParameters,
        marks: Vec<([BlockId; N], Mark)>,
    ) -> CornerObservations<N> {
        let (blocks, marks) = marks.into_iter().unzip();
        CornerObservations { lenses, blocks, marks }
    }
}

impl<const N: usize> Batch for CornerObservations<N> {
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
        x: Values<'_>,
        residual: &mut [f64],
        mut jacobian: Option<&mut [f64]>,
        width: usize,
    ) -> Result<(), InfeasibleFactor> {
        let Some(first) = self.blocks.get(range.start) else { return Ok(()) };
        let mut posed_lens = self.lenses.posed_lens(x.block(first[0]));
        let mut pose = None;
        for (k, factor) in range.enumerate() {
            let blocks = &self.blocks[factor];
            let mark = &self.marks[factor];
            if pose != Some(blocks[1]) {
                posed_lens = posed_lens.with_pose(x.block(blocks[1]));
                pose = Some(blocks[1]);
            }
            let height = if N > 2 { x.block(blocks[2])[0] } else { 0.0 };
            let found = match jacobian.as_deref_mut() {
                None => posed_lens.residual(mark, height),
                Some(all) => {
                    let (upper, lower) =
                        all[2 * k * width..2 * (k + 1) * width].split_at_mut(width);
                    posed_lens.linearize(mark, height, [&mut *upper, &mut *lower]).map(
                        |(residual, by_height)| {
                            if N > 2 {
                                upper[width - 1] = by_height[0];
                                lower[width - 1] = by_height[1];
                            }
                            residual
                        },
                    )
                }
            };
            match found {
                Some(r) if r[0].is_finite() && r[1].is_finite() => {
                    residual[2 * k..2 * k + 2].copy_from_slice(&r);
                }
                _ => return Err(InfeasibleFactor(factor)),
            }
        }
        Ok(())
    }
}
