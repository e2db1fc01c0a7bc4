//! The sums of a share into the reduced system.

use super::{
    Sums,
    layout::{Layout, ShareWork, block_len, padded},
};
use crate::nlls::{eliminate::inner, structure::NONE};

impl<const K: usize, const S: usize, const D: usize> Layout<K, S, D> {
    /// Adds the sums of one share to the reduced system.
    pub(super) fn add_share<const P: usize>(&self, share: &ShareWork<P>, sums: &mut Sums<'_>) {
        for (ordinal, &slot) in share.slots.iter().enumerate() {
            let at = sums.matrix.value_ptr[slot as usize];
            let to = &mut sums.matrix.values[at..at + K * K];
            add_block::<K>(&share.values[ordinal * block_len(K)..], to);
        }
        for (k, &camera) in share.members.iter().enumerate() {
            let place = self.cameras[camera as usize].place as usize;
            let (tangent, start) = (self.tangents[place], sums.matrix.starts[place]);
            for i in 0..K {
                let from = k * padded(K) + i;
                sums.gradient[tangent + i] += share.gradient[from];
                sums.diagonal[tangent + i] += share.diagonal[from];
                sums.correction[start + i] += share.correction[from];
            }
        }
        self.add_shared_blocks(share, sums);
    }

    fn add_shared_blocks<const P: usize>(&self, share: &ShareWork<P>, sums: &mut Sums<'_>) {
        let lenses = self.shared.len();
        for (l, &place) in self.shared.iter().enumerate().filter(|(_, place)| **place != NONE) {
            let place = place as usize;
            let (tangent, start) = (self.tangents[place], sums.matrix.starts[place]);
            for i in 0..S {
                sums.gradient[tangent + i] += share.lens_gradient[l * S + i];
                sums.diagonal[tangent + i] += share.lens_diagonal[l * S + i];
                sums.correction[start + i] += share.lens_correction[l * S + i];
            }
            for (k, &camera) in share.members.iter().enumerate() {
                let camera_place = self.cameras[camera as usize].place as usize;
                let from = &share.camera_lens[(k * lenses + l) * K * S..][..K * S];
                add_rectangle(sums, camera_place, place, (K, S), from);
            }
            for (m, &other) in self.shared[..=l].iter().enumerate() {
                if other != NONE {
                    let from = &share.lens_lens[(l * lenses + m) * S * S..][..S * S];
                    add_rectangle(sums, place, other as usize, (S, S), from);
                }
            }
        }
    }
}

/// Adds a row-major block of kept blocks `row x column`, in whichever triangle it is stored.
fn add_rectangle(
    sums: &mut Sums<'_>,
    row: usize,
    column: usize,
    (rows, columns): (usize, usize),
    from: &[f64],
) {
    let Some(slot) = sums.matrix.slot(row.max(column), row.min(column)) else {
        debug_assert!(inner(from, from) == 0.0, "the pattern holds every pair that is seen");
        return;
    };
    let at = sums.matrix.value_ptr[slot];
    for i in 0..rows {
        for j in 0..columns {
            let to = if row >= column { j * rows + i } else { i * columns + j };
            sums.matrix.values[at + to] += from[i * columns + j];
        }
    }
}

/// Adds a block in the shares' layout to a column-major one.
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
