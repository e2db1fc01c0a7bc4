//! What the fused path keeps in memory: observations by point, and the sums of each chunk.

use super::product::{StoredNumber, stored_record, whole};
use crate::{
    lanes::MAX_WIDTH,
    nlls::{
        block_table::BlockTable,
        cholesky::BlockMatrix,
        structure::{Chunk, NONE},
    },
};
use std::ops::Range;

/// Numbers per row of a retained Jacobian in memory: whole registers.
pub(super) const fn padded(k: usize) -> usize {
    k.div_ceil(8) * 8
}

/// Numbers per observation of the Jacobian by its point and the residual, `rows` of `p` and 1.
pub(super) const fn point_record(rows: usize, p: usize) -> usize {
    padded(rows * (p + 1))
}

/// Length of one block of the reduced system in a chunk: rows of whole registers, then the
/// columns that are left over, each padded.
pub(super) const fn block_len(k: usize) -> usize {
    k * (k / 8 * 8) + (k % 8) * padded(k)
}

/// Observations that are linearised before their points are eliminated: their Jacobians fit into
/// half of a first-level cache.
pub(super) const TILE: usize = 48;
/// The most tangent dimensions of a retained block that the fused path takes.
pub(super) const MAX_RETAINED: usize = 32;
/// The most numbers of a [`point_record`].
pub(super) const MAX_RECORD: usize = 32;
/// The most numbers prepared per camera, with its step and that of its shared block.
pub(super) const MAX_CAMERA_RECORD: usize = 96;
/// The most shared blocks; with more, every camera has about its own.
pub(super) const MAX_SHARED: usize = 8;

/// A retained block of the batch, fixed or not.
#[derive(Debug, Clone, Copy)]
pub(super) struct Camera {
    /// Its index in the problem.
    pub(super) block: u32,
    /// Its shared block's index in the problem.
    pub(super) shared: u32,
    /// Its place among the retained blocks, or [`NONE`].
    pub(super) place: u32,
    /// Its shared block's place in [`Layout::shared`].
    pub(super) lens: u32,
}

/// An eliminated block.
#[derive(Debug, Clone, Copy)]
pub(super) struct PointAt {
    /// Where its values begin.
    pub(super) at: u32,
    /// Where its observations begin.
    pub(super) first: u32,
    /// Its index in the problem.
    pub(super) block: u32,
    /// Bits of entries that must not move.
    pub(super) frozen: u32,
    /// Its place among the points with priors, or [`NONE`].
    pub(super) prior: u32,
}

/// What all chunks read.
#[derive(Debug)]
pub(super) struct Layout<const K: usize, const S: usize, const D: usize> {
    pub(super) cameras: Vec<Camera>,
    /// Where a camera's columns are frozen 0, others 1; empty where none is.
    pub(super) camera_mask: Vec<[f64; K]>,
    /// The columns of shared blocks that are free in any of them, ascending: the others take no part.
    pub(super) lens_columns: Vec<usize>,
    /// As `camera_mask`, for each of `lens_columns` in each shared block.
    pub(super) lens_mask: Vec<[f64; S]>,
    /// The places of the shared blocks among the retained ones, or [`NONE`].
    pub(super) shared: Vec<u32>,
    /// One more entry than points.
    pub(super) points: Vec<PointAt>,
    /// Per observation its camera; those of one point by their places, fixed ones last.
    pub(super) observed_by: Vec<u32>,
    pub(super) data: Vec<[f64; D]>,
    /// Where each retained block's tangent begins.
    pub(super) tangents: Vec<usize>,
}

impl<const K: usize, const S: usize, const D: usize> Layout<K, S, D> {
    /// Numbers per row of a Jacobian by a shared block: whole registers, none where nothing is free.
    #[inline(always)]
    pub(super) fn lens_width(&self) -> usize {
        padded(self.lens_columns.len())
    }
}

/// One chunk of the points and its sums.
#[derive(Debug)]
pub(super) struct ChunkSums<const P: usize> {
    pub(super) range: Range<usize>,
    /// Local place of each camera, or [`NONE`].
    pub(super) local: Vec<u32>,
    /// Cameras by local place.
    pub(super) members: Vec<u32>,
    /// Which block belongs to a pair of local cameras.
    pub(super) table: BlockTable,
    /// The slot of the reduced matrix behind each block.
    pub(super) slots: Vec<u32>,
    pub(super) values: Vec<f64>,
    pub(super) gradient: Vec<f64>,
    pub(super) correction: Vec<f64>,
    pub(super) diagonal: Vec<f64>,
    /// Per local camera and shared block, `K` rows of [`Layout::lens_width`].
    pub(super) camera_lens: Vec<f64>,
    /// Likewise per pair of shared blocks.
    pub(super) lens_lens: Vec<f64>,
    pub(super) lens_gradient: Vec<f64>,
    pub(super) lens_correction: Vec<f64>,
    pub(super) lens_diagonal: Vec<f64>,
    pub(super) moved: Vec<[f64; P]>,
    /// Where its points are seen from; empty where that is not known of all.
    pub(super) sights: Vec<[f64; P]>,
    /// Where the reduced system is not formed, one record per observation; see [`super::product`].
    pub(super) stored_jacobians: Vec<StoredNumber>,
    /// Its product with a vector, per local camera [`whole`] numbers.
    pub(super) product: Vec<f64>,
    pub(super) buffers: Buffers,
}

/// Room for the observations of one tile, one record per observation.
#[derive(Debug, Default)]
pub(super) struct Buffers {
    /// Per row the Jacobian by the point, then the residual; [`point_record`] numbers.
    pub(super) jacobian_point: Vec<f64>,
    /// `R` rows of `padded(K)`.
    pub(super) jacobian_camera: Vec<f64>,
    /// `R` rows of [`Layout::lens_width`].
    pub(super) jacobian_shared: Vec<f64>,
    /// `Q_i`, of one point.
    pub(super) whitened: Vec<f64>,
    /// `Q_i u` of one point, or `J d` of a tile.
    pub(super) along: Vec<f64>,
    /// `T` of each shared block, `P` rows of [`Layout::lens_width`].
    pub(super) lens_sums: Vec<f64>,
    /// `Js_i - Q_i T`, `R` rows.
    pub(super) lens_left: Vec<f64>,
}

impl<const P: usize> ChunkSums<P> {
    /// The accumulators of `chunk` for observations of `rows` rows; `None` where the reduced
    /// matrix lacks a block.
    pub(super) fn new<const K: usize, const S: usize, const D: usize>(
        chunk: &Chunk,
        layout: &Layout<K, S, D>,
        matrix: &BlockMatrix,
        rows: usize,
        implicit: bool,
    ) -> Option<Self> {
        // Cameras are in the order of their places, and so are the retained blocks of the chunk.
        let mut members: Vec<u32> = Vec::new();
        let mut in_chunk: Vec<usize> = Vec::new();
        let mut local = vec![NONE; layout.cameras.len()];
        let mut next = 0;
        for (k, camera) in layout.cameras.iter().enumerate() {
            while next < chunk.retained.len() && chunk.retained[next] < camera.place {
                next += 1;
            }
            if chunk.retained.get(next) == Some(&camera.place) {
                local[k] = members.len() as u32;
                members.push(k as u32);
                in_chunk.push(next);
            }
        }
        let n = members.len();
        let mut member_of = vec![NONE; chunk.retained.len()];
        for (member, &k) in in_chunk.iter().enumerate() {
            member_of[k] = member as u32;
        }
        let mut pairs: Vec<Vec<u32>> = vec![Vec::new(); n];
        chunk.for_each_pair(|row, column| {
            let (row, column) = (member_of[row], member_of[column]);
            if row != NONE && column != NONE {
                pairs[row as usize].push(column);
            }
        });
        let mut count = 0;
        let table = BlockTable::new(pairs.into_iter(), |_, _| {
            count += 1;
            count - 1
        });
        let place = |k: usize| layout.cameras[members[k] as usize].place as usize;
        let mut slots = Vec::with_capacity(table.len());
        table.for_each(|row, column, _| slots.push(matrix.slot(place(row), place(column))));
        let slots = slots
            .into_iter()
            .map(|slot| slot.map(|slot| slot as u32))
            .collect::<Option<Vec<_>>>()?;
        let (lenses, width) = (layout.shared.len(), layout.lens_width());
        let ends = [chunk.eliminated.start, chunk.eliminated.end].map(|e| layout.points[e].first);
        let observations = (ends[1] - ends[0]) as usize;
        let longest = chunk
            .eliminated
            .clone()
            .map(|e| (layout.points[e + 1].first - layout.points[e].first) as usize)
            .max()
            .unwrap_or(0);
        Some(ChunkSums {
            range: chunk.eliminated.clone(),
            values: vec![0.0; slots.len() * block_len(K)],
            gradient: vec![0.0; n * padded(K)],
            correction: vec![0.0; n * padded(K)],
            diagonal: vec![0.0; n * padded(K)],
            camera_lens: vec![0.0; n * lenses * K * width],
            lens_lens: vec![0.0; lenses * lenses * width * width],
            lens_gradient: vec![0.0; lenses * width],
            lens_correction: vec![0.0; lenses * width],
            lens_diagonal: vec![0.0; lenses * width],
            moved: vec![[0.0; P]; chunk.eliminated.len()],
            sights: Vec::new(),
            stored_jacobians: vec![
                0.0;
                if implicit {
                    observations * stored_record(rows, K, P)
                } else {
                    0
                }
            ],
            product: vec![0.0; if implicit { n * whole(K) } else { 0 }],
            buffers: Buffers::new::<K, P>(longest.max(TILE), rows, (lenses, width)),
            local,
            members,
            table,
            slots,
        })
    }

    pub(super) fn clear(&mut self) {
        for sums in [
            &mut self.values,
            &mut self.gradient,
            &mut self.correction,
            &mut self.diagonal,
            &mut self.camera_lens,
            &mut self.lens_lens,
            &mut self.lens_gradient,
            &mut self.lens_correction,
            &mut self.lens_diagonal,
        ] {
            sums.fill(0.0);
        }
    }
}

impl Buffers {
    /// Room for `count` observations of `rows` rows, and for the lanes behind the last.
    fn new<const K: usize, const P: usize>(
        count: usize,
        rows: usize,
        (lenses, width): (usize, usize),
    ) -> Buffers {
        let records = count + MAX_WIDTH;
        let points = records * point_record(rows, P);
        let lens_left = vec![0.0; rows * width];
        let rows = records * rows;
        Buffers {
            jacobian_point: vec![0.0; points],
            jacobian_camera: vec![0.0; rows * padded(K)],
            jacobian_shared: vec![0.0; rows * width],
            whitened: vec![0.0; rows * P],
            along: vec![0.0; rows],
            lens_sums: vec![0.0; lenses * P * width],
            lens_left,
        }
    }
}
