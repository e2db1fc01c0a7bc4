//! The blocks of the inverse normal matrix that the statistics need, and no others.
//!
//! An observation of a tie point needs the covariances among the images that see the point and
//! their lenses: the pattern of the reduced system, in which the inverse is had for a few
//! factorisations. What else is asked for is solved for.

use super::problem::{AdjustmentProblem, ScaleDatum};
use crate::scene::Reconstruction;
use rowgram_optim::{
    engine::SolveError,
    nlls::{BlockId, covariance::Covariance, manifold::MAX_TANGENT},
};
use std::collections::{BTreeSet, HashMap};

/// Blocks of the inverse, by the indices of a pair in the problem.
#[derive(Debug)]
pub(super) struct SelectedInverse {
    blocks: HashMap<(u32, u32), Vec<f64>>,
    /// How the scale was held.
    pub(super) scale_datum: Option<ScaleDatum>,
}

fn place(block: BlockId) -> u32 {
    block.index() as u32
}

impl SelectedInverse {
    /// Solves for the blocks that the observations of `reconstruction` couple, check points included.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] where the problem lacks a batch of the adjustment.
    pub(super) fn new(
        reconstruction: &Reconstruction,
        adjustment: &AdjustmentProblem,
        covariance: &mut Covariance<'_>,
    ) -> Result<Self, SolveError> {
        let mut partners: HashMap<BlockId, BTreeSet<BlockId>> = HashMap::new();
        let mut couple = |blocks: &[BlockId]| {
            for (k, &a) in blocks.iter().enumerate() {
                for &b in &blocks[..=k] {
                    // Each pair once: with the block that comes first.
                    partners.entry(a.min(b)).or_default().insert(a.max(b));
                }
            }
        };
        let lens = |image: usize| adjustment.lenses[reconstruction.images[image].camera];
        let mut tracks: Vec<Vec<BlockId>> = vec![Vec::new(); reconstruction.points.len()];
        for o in &reconstruction.observations {
            let image = o.image as usize;
            tracks[o.point as usize].extend([adjustment.images[image], lens(image)]);
        }
        let mut seen: Vec<Vec<BlockId>> = vec![Vec::new(); reconstruction.ground.len()];
        for mark in &reconstruction.marks {
            let image = mark.image as usize;
            let track = &mut seen[mark.ground as usize];
            track.extend([adjustment.images[image], lens(image)]);
            track.extend(adjustment.ground[mark.ground as usize]);
        }
        for track in tracks.iter_mut().chain(&mut seen) {
            track.sort_unstable();
            track.dedup();
            couple(track);
        }
        for (_, name, _) in &adjustment.batches {
            adjustment.problem.factor_blocks(name)?.for_each(&mut couple);
        }
        for &block in adjustment.images.iter().chain(&adjustment.lenses) {
            couple(&[block]);
        }
        let mut order: Vec<(BlockId, Vec<BlockId>)> = partners
            .into_iter()
            .map(|(block, others)| (block, others.into_iter().collect()))
            .collect();
        order.sort_by_key(|(block, _)| *block);
        let mut blocks = HashMap::new();
        let mut apart: Vec<(BlockId, Vec<BlockId>)> = Vec::new();
        let selected = covariance.selected_inverse();
        for (block, mut others) in order {
            others.retain(|&other| match selected.cross(other, block) {
                Some(values) => {
                    blocks.insert((place(other), place(block)), values);
                    false
                }
                None => true,
            });
            if !others.is_empty() {
                apart.push((block, others));
            }
        }
        // Images that share a check point and no other.
        for (block, others) in apart {
            for (other, values) in others.iter().zip(covariance.cross_many(&others, block)) {
                blocks.insert((place(*other), place(block)), values);
            }
        }
        Ok(SelectedInverse { blocks, scale_datum: adjustment.scale_datum() })
    }

    /// Adds `A C B^T` to `sum`, `C` the covariance of two blocks (0 where it was not asked for) and `A`,
    /// `B` two rows each over their tangents.
    pub(super) fn accumulate_covariance(
        &self,
        (a, by_a): (BlockId, &[f64]),
        (b, by_b): (BlockId, &[f64]),
        sum: &mut [[f64; 2]; 2],
    ) {
        // Stored once per pair, the later block first.
        let Some(values) = self.blocks.get(&(place(a.max(b)), place(a.min(b)))) else { return };
        let (late, early, turned) = if a >= b { (by_a, by_b, false) } else { (by_b, by_a, true) };
        let (rows, columns) = (late.len() / 2, early.len() / 2);
        for (i, late) in late.chunks_exact(rows).enumerate() {
            let mut through = [0.0; MAX_TANGENT];
            for (weight, values) in late.iter().zip(values.chunks_exact(columns)) {
                for (sum, v) in through.iter_mut().zip(values) {
                    *sum += weight * v;
                }
            }
            for (j, early) in early.chunks_exact(columns).enumerate() {
                let product: f64 = through.iter().zip(early).map(|(v, w)| v * w).sum();
                let (row, column) = if turned { (j, i) } else { (i, j) };
                sum[row][column] += product;
            }
        }
    }

    /// The covariance of one block with another, for blocks and their tangents; 0 where it was not asked for.
    pub(super) fn between(
        &self,
        (a, rows): (BlockId, usize),
        (b, columns): (BlockId, usize),
    ) -> nalgebra::DMatrix<f64> {
        match self.blocks.get(&(place(a.max(b)), place(a.min(b)))) {
            Some(values) => nalgebra::DMatrix::from_fn(rows, columns, |i, j| {
                // Stored once per pair, the later block first.
                if a >= b { values[i * columns + j] } else { values[j * rows + i] }
            }),
            None => nalgebra::DMatrix::zeros(rows, columns),
        }
    }

    /// The covariance of several blocks side by side, row-major, for blocks and their tangents.
    pub(super) fn among(&self, blocks: &[(BlockId, usize)]) -> nalgebra::DMatrix<f64> {
        let n: usize = blocks.iter().map(|(_, dim)| dim).sum();
        let mut out = nalgebra::DMatrix::zeros(n, n);
        let mut row = 0;
        for &(a, rows) in blocks {
            let mut column = 0;
            for &(b, columns) in blocks {
                out.view_mut((row, column), (rows, columns))
                    .copy_from(&self.between((a, rows), (b, columns)));
                column += columns;
            }
            row += rows;
        }
        out
    }
}
