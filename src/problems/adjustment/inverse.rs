//! The blocks of the inverse normal matrix that the statistics need, and no others.
//!
//! An observation of a tie point needs the covariances among the images that see the point and
//! their lenses: the pattern of the reduced system. They are solved for block column by block
//! column, and only that pattern is kept.

use super::{posed::Posed, survey::Survey};
use crate::nlls::{BlockId, covariance::Covariance};
use std::collections::{BTreeSet, HashMap};

/// Blocks of the inverse, by the places of a pair in the problem.
#[derive(Debug)]
pub(super) struct SelectedInverse {
    blocks: HashMap<(u32, u32), Vec<f64>>,
}

fn place(block: BlockId) -> u32 {
    block.index() as u32
}

impl SelectedInverse {
    /// Solves for the blocks that the observations of `survey` couple, check points included.
    pub(super) fn new(survey: &Survey, posed: &Posed, covariance: &mut Covariance<'_>) -> Self {
        let mut partners: HashMap<BlockId, BTreeSet<BlockId>> = HashMap::new();
        let mut couple = |blocks: &[BlockId]| {
            for (k, &a) in blocks.iter().enumerate() {
                for &b in &blocks[..=k] {
                    // Each pair once: with the block that comes first.
                    partners.entry(a.min(b)).or_default().insert(a.max(b));
                }
            }
        };
        let lens = |image: usize| posed.lenses[survey.images[image].camera];
        let mut tracks: Vec<Vec<BlockId>> = vec![Vec::new(); survey.points.len()];
        for o in &survey.observations {
            let image = o.image as usize;
            tracks[o.point as usize].extend([posed.images[image], lens(image)]);
        }
        let mut seen: Vec<Vec<BlockId>> = vec![Vec::new(); survey.ground.len()];
        for mark in &survey.marks {
            let image = mark.image as usize;
            let track = &mut seen[mark.ground as usize];
            track.extend([posed.images[image], lens(image)]);
            track.extend(posed.ground[mark.ground as usize]);
        }
        for track in tracks.iter_mut().chain(&mut seen) {
            track.sort_unstable();
            track.dedup();
            couple(track);
        }
        for bar in &survey.scale_bars {
            let ends: Vec<BlockId> =
                bar.ends.iter().filter_map(|&end| posed.ground[end as usize]).collect();
            couple(&ends);
        }
        for &block in posed.images.iter().chain(&posed.lenses) {
            couple(&[block]);
        }
        let mut order: Vec<(BlockId, Vec<BlockId>)> = partners
            .into_iter()
            .map(|(block, others)| (block, others.into_iter().collect()))
            .collect();
        order.sort_by_key(|(block, _)| *block);
        let mut blocks = HashMap::new();
        for (block, others) in order {
            for (other, values) in others.iter().zip(covariance.cross_many(&others, block)) {
                blocks.insert((place(*other), place(block)), values);
            }
        }
        SelectedInverse { blocks }
    }

    /// The covariance of several blocks side by side, row-major, for blocks and their tangents.
    pub(super) fn among(&self, blocks: &[(BlockId, usize)]) -> nalgebra::DMatrix<f64> {
        let n: usize = blocks.iter().map(|(_, dim)| dim).sum();
        let mut out = nalgebra::DMatrix::zeros(n, n);
        let mut row = 0;
        for &(a, rows) in blocks {
            let mut column = 0;
            for &(b, columns) in blocks {
                // Stored once per pair, the later block first; 0 where it was not asked for.
                let stored = self.blocks.get(&(place(a.max(b)), place(a.min(b))));
                if let Some(values) = stored {
                    for i in 0..rows {
                        for j in 0..columns {
                            out[(row + i, column + j)] =
                                if a >= b { values[i * columns + j] } else { values[j * rows + i] };
                        }
                    }
                }
                column += columns;
            }
            row += rows;
        }
        out
    }
}
