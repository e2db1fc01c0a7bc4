//! What points add to blocks that many cameras share: the arrow of the reduced system.

use super::layout::{Buffers, Layout, ShareWork, padded, point_record};
use crate::nlls::structure::NONE;

/// Adds a point with observations `first..end` of the chunk that begins with `origin`, and
/// `u = L^-1 g`.
#[inline(always)]
pub(super) fn add_shared<
    const R: usize,
    const K: usize,
    const S: usize,
    const P: usize,
    const D: usize,
>(
    layout: &Layout<K, S, D>,
    share: &mut ShareWork<P>,
    buffers: &mut Buffers,
    (first, end): (usize, usize),
    origin: usize,
    u: &[f64; P],
) {
    let lenses = layout.shared.len();
    // T_l = sum of Q_i^T Js_i over the observations through shared block l.
    let sums = &mut buffers.lens_sums[..lenses * P * S];
    sums.fill(0.0);
    for i in 0..end - first {
        let camera = layout.observed_by[origin + first + i] as usize;
        let lens = layout.cameras[camera].lens as usize;
        for row in 0..R {
            let js = &buffers.by_shared[(first + i) * padded(R * S) + row * S..][..S];
            let q = &buffers.whitened[(i * R + row) * P..][..P];
            let r = buffers.by_point[(first + i) * point_record(R, P) + row * (P + 1) + P];
            for a in 0..S {
                share.lens_gradient[lens * S + a] += js[a] * r;
                share.lens_diagonal[lens * S + a] += js[a] * js[a];
                for b in 0..S {
                    share.lens_lens[((lens * lenses + lens) * S + a) * S + b] += js[a] * js[b];
                }
                for k in 0..P {
                    sums[(lens * P + k) * S + a] += q[k] * js[a];
                }
            }
        }
    }
    for l in 0..lenses {
        let own = &sums[l * P * S..(l + 1) * P * S];
        for a in 0..S {
            for k in 0..P {
                share.lens_correction[l * S + a] -= own[k * S + a] * u[k];
            }
        }
        for m in 0..=l {
            let other = &sums[m * P * S..(m + 1) * P * S];
            let block = &mut share.lens_lens[(l * lenses + m) * S * S..][..S * S];
            for a in 0..S {
                for b in 0..S {
                    for k in 0..P {
                        block[a * S + b] -= own[k * S + a] * other[k * S + b];
                    }
                }
            }
        }
    }
    for i in 0..end - first {
        let camera = layout.observed_by[origin + first + i] as usize;
        let local = share.local[camera];
        if local == NONE {
            break;
        }
        let own = layout.cameras[camera].lens as usize;
        for l in 0..lenses {
            let block = &mut share.camera_lens[(local as usize * lenses + l) * K * S..][..K * S];
            let sums = &sums[l * P * S..(l + 1) * P * S];
            for row in 0..R {
                // A row of Js_i - Q_i T.
                let q = &buffers.whitened[(i * R + row) * P..][..P];
                let mut left = [0.0; S];
                for a in 0..S {
                    if l == own {
                        left[a] = buffers.by_shared[(first + i) * padded(R * S) + row * S + a];
                    }
                    for k in 0..P {
                        left[a] -= q[k] * sums[k * S + a];
                    }
                }
                let jacobian = &buffers.by_kept[((first + i) * R + row) * padded(K)..][..K];
                for (k, v) in jacobian.iter().enumerate() {
                    for a in 0..S {
                        block[k * S + a] += v * left[a];
                    }
                }
            }
        }
    }
}
