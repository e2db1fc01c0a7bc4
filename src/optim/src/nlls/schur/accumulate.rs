//! The sums of a chunk into the reduced system.

use super::{
    NormalEquationsMut,
    layout::{ChunkSums, Layout, block_len, padded},
};
use crate::nlls::{elimination::inner, structure::NONE};

impl<const K: usize, const S: usize, const D: usize> Layout<K, S, D> {
    /// Adds the sums of one chunk to the reduced system.
    pub(super) fn add_chunk<const P: usize>(
        &self,
        chunk: &ChunkSums<P>,
        sums: &mut NormalEquationsMut<'_>,
    ) {
        for (ordinal, &slot) in chunk.slots.iter().enumerate() {
            let at = sums.matrix.value_ptr[slot as usize];
            let to = &mut sums.matrix.values[at..at + K * K];
            add_block::<K>(&chunk.values[ordinal * block_len(K)..], to);
        }
        for (k, &camera) in chunk.members.iter().enumerate() {
            let place = self.cameras[camera as usize].place as usize;
            let (tangent, start) = (self.tangents[place], sums.matrix.starts[place]);
            for i in 0..K {
                let from = k * padded(K) + i;
                sums.gradient[tangent + i] += chunk.gradient[from];
                sums.diagonal[tangent + i] += chunk.diagonal[from];
                sums.correction[start + i] += chunk.correction[from];
            }
        }
        self.add_shared_blocks(chunk, sums);
    }

    fn add_shared_blocks<const P: usize>(
        &self,
        chunk: &ChunkSums<P>,
        sums: &mut NormalEquationsMut<'_>,
    ) {
        let (lenses, width) = (self.shared.len(), self.lens_width());
        if width == 0 {
            return;
        }
        let columns = self.lens_columns.as_slice();
        let all: [usize; K] = std::array::from_fn(|k| k);
        for (l, &place) in self.shared.iter().enumerate().filter(|(_, place)| **place != NONE) {
            let place = place as usize;
            let (tangent, start) = (self.tangents[place], sums.matrix.starts[place]);
            for (k, &i) in columns.iter().enumerate() {
                sums.gradient[tangent + i] += chunk.lens_gradient[l * width + k];
                sums.diagonal[tangent + i] += chunk.lens_diagonal[l * width + k];
                sums.correction[start + i] += chunk.lens_correction[l * width + k];
            }
            let lens = Side { place, dimensions: S, entries: columns };
            for (k, &camera) in chunk.members.iter().enumerate() {
                let place = self.cameras[camera as usize].place as usize;
                let camera = Side { place, dimensions: K, entries: &all };
                let from = &chunk.camera_lens[(k * lenses + l) * K * width..][..K * width];
                add_rectangle(sums, camera, lens, from);
            }
            for (m, &other) in self.shared[..=l].iter().enumerate() {
                if other != NONE {
                    let from = &chunk.lens_lens[(l * lenses + m) * width * width..];
                    let other = Side { place: other as usize, ..lens };
                    add_rectangle(sums, lens, other, &from[..width * width]);
                }
            }
        }
    }
}

/// The rows or the columns of a rectangle.
#[derive(Clone, Copy)]
struct Side<'a> {
    /// Its block's place among the retained ones.
    place: usize,
    /// How many the block has.
    dimensions: usize,
    /// Which of them.
    entries: &'a [usize],
}

/// Adds a row-major block of retained blocks, its rows padded, in whichever triangle it is stored.
fn add_rectangle(sums: &mut NormalEquationsMut<'_>, row: Side<'_>, column: Side<'_>, from: &[f64]) {
    let turned = row.place < column.place;
    let Some(slot) = sums.matrix.slot(row.place.max(column.place), row.place.min(column.place))
    else {
        debug_assert!(inner(from, from) == 0.0, "the pattern holds every pair that is seen");
        return;
    };
    let at = sums.matrix.value_ptr[slot];
    let width = padded(column.entries.len());
    for (from, &i) in from.chunks_exact(width).zip(row.entries) {
        for (from, &j) in from.iter().zip(column.entries) {
            let to = if turned { i * column.dimensions + j } else { j * row.dimensions + i };
            sums.matrix.values[at + to] += from;
        }
    }
}

/// Adds a block in the chunks' layout to a column-major one.
fn add_block<const K: usize>(from: &[f64], to: &mut [f64]) {
    let whole = K / 8 * 8;
    for i in 0..K {
        for j in 0..whole {
            to[j * K + i] += from[i * whole + j];
        }
    }
    for j in whole..K {
        let column = &from[K * whole + (j - whole) * padded(K)..];
        for i in 0..K {
            to[j * K + i] += column[i];
        }
    }
}
