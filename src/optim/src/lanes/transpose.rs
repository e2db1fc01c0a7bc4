//! Between several numbers per register and one record after the other: transposition in registers.

use super::{MAX_WIDTH, Register};
use pulp::Simd;
#[cfg(target_arch = "x86_64")]
use pulp::{cast, x86};
#[cfg(target_arch = "x86_64")]
use std::any::Any;

/// A register's worth of numbers in memory.
type Row = [f64; MAX_WIDTH];

/// Turns the first `S::F64_LANES` rows and columns of `rows` around the diagonal.
#[inline(always)]
#[cfg_attr(not(target_arch = "x86_64"), expect(unused_variables, reason = "plain loops only"))]
fn transpose<S: Simd>(simd: S, rows: &[Row; MAX_WIDTH]) -> [Row; MAX_WIDTH] {
    #[cfg(target_arch = "x86_64")]
    {
        let any: &dyn Any = &simd;
        if let Some(simd) = any.downcast_ref::<x86::V4>() {
            return transpose_by_8(*simd, rows);
        }
        if let Some(simd) = any.downcast_ref::<x86::V3>() {
            return transpose_by_4(*simd, rows);
        }
    }
    let mut turned = [[0.0; MAX_WIDTH]; MAX_WIDTH];
    for row in 0..S::F64_LANES {
        for column in 0..S::F64_LANES {
            turned[column][row] = rows[row][column];
        }
    }
    turned
}

#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn transpose_by_8(simd: x86::V4, rows: &[Row; MAX_WIDTH]) -> [Row; MAX_WIDTH] {
    let avx = simd.avx512f;
    // Pairs of rows: entries 0 2 4 6 and 1 3 5 7.
    let t0 = avx._mm512_unpacklo_pd(cast(rows[0]), cast(rows[1]));
    let t1 = avx._mm512_unpackhi_pd(cast(rows[0]), cast(rows[1]));
    let t2 = avx._mm512_unpacklo_pd(cast(rows[2]), cast(rows[3]));
    let t3 = avx._mm512_unpackhi_pd(cast(rows[2]), cast(rows[3]));
    let t4 = avx._mm512_unpacklo_pd(cast(rows[4]), cast(rows[5]));
    let t5 = avx._mm512_unpackhi_pd(cast(rows[4]), cast(rows[5]));
    let t6 = avx._mm512_unpacklo_pd(cast(rows[6]), cast(rows[7]));
    let t7 = avx._mm512_unpackhi_pd(cast(rows[6]), cast(rows[7]));
    // Quarters 0 2 (0x88) and 1 3 (0xdd) of two registers.
    let s0 = avx._mm512_shuffle_f64x2::<0x88>(t0, t2);
    let s1 = avx._mm512_shuffle_f64x2::<0x88>(t4, t6);
    let s2 = avx._mm512_shuffle_f64x2::<0xdd>(t0, t2);
    let s3 = avx._mm512_shuffle_f64x2::<0xdd>(t4, t6);
    let s4 = avx._mm512_shuffle_f64x2::<0x88>(t1, t3);
    let s5 = avx._mm512_shuffle_f64x2::<0x88>(t5, t7);
    let s6 = avx._mm512_shuffle_f64x2::<0xdd>(t1, t3);
    let s7 = avx._mm512_shuffle_f64x2::<0xdd>(t5, t7);
    [
        cast(avx._mm512_shuffle_f64x2::<0x88>(s0, s1)),
        cast(avx._mm512_shuffle_f64x2::<0x88>(s4, s5)),
        cast(avx._mm512_shuffle_f64x2::<0x88>(s2, s3)),
        cast(avx._mm512_shuffle_f64x2::<0x88>(s6, s7)),
        cast(avx._mm512_shuffle_f64x2::<0xdd>(s0, s1)),
        cast(avx._mm512_shuffle_f64x2::<0xdd>(s4, s5)),
        cast(avx._mm512_shuffle_f64x2::<0xdd>(s2, s3)),
        cast(avx._mm512_shuffle_f64x2::<0xdd>(s6, s7)),
    ]
}

#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn transpose_by_4(simd: x86::V3, rows: &[Row; MAX_WIDTH]) -> [Row; MAX_WIDTH] {
    let avx = simd.avx;
    let (r0, r1) = (cast(first_half(rows[0])), cast(first_half(rows[1])));
    let (r2, r3) = (cast(first_half(rows[2])), cast(first_half(rows[3])));
    let t0 = avx._mm256_unpacklo_pd(r0, r1);
    let t1 = avx._mm256_unpackhi_pd(r0, r1);
    let t2 = avx._mm256_unpacklo_pd(r2, r3);
    let t3 = avx._mm256_unpackhi_pd(r2, r3);
    let none = [0.0; MAX_WIDTH];
    [
        widened(cast(avx._mm256_permute2f128_pd::<0x20>(t0, t2))),
        widened(cast(avx._mm256_permute2f128_pd::<0x20>(t1, t3))),
        widened(cast(avx._mm256_permute2f128_pd::<0x31>(t0, t2))),
        widened(cast(avx._mm256_permute2f128_pd::<0x31>(t1, t3))),
        none,
        none,
        none,
        none,
    ]
}

#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn first_half([a, b, c, d, ..]: Row) -> [f64; 4] {
    [a, b, c, d]
}

#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn widened([a, b, c, d]: [f64; 4]) -> Row {
    [a, b, c, d, 0.0, 0.0, 0.0, 0.0]
}

/// Writes lane `l` of `values[k]` to `to[l * stride + k]`, for all lanes. What lies behind
/// the `values.len()` numbers of a record stays as it is.
#[inline(always)]
pub(crate) fn scatter<S: Simd>(simd: S, values: &[Register<S>], to: &mut [f64], stride: usize) {
    let width = Register::<S>::WIDTH;
    let to = &mut to[..(width - 1) * stride + values.len()];
    let mut rows = [[0.0; MAX_WIDTH]; MAX_WIDTH];
    let mut first = 0;
    while first < values.len() {
        let count = (values.len() - first).min(width);
        // The last record has no room behind it in `to`.
        if count == width {
            for k in 0..width {
                values[first + k].store(&mut rows[k]);
            }
            let turned = transpose(simd, &rows);
            for lane in 0..width {
                let at = lane * stride + first;
                to[at..at + width].copy_from_slice(&turned[lane][..width]);
            }
        } else {
            for k in first..first + count {
                let mut lanes = [0.0; MAX_WIDTH];
                values[k].store(&mut lanes);
                for lane in 0..width {
                    to[lane * stride + k] = lanes[lane];
                }
            }
        }
        first += count;
    }
}

/// Puts `rows[l][k]` into lane `l` of `out[k]`; rows are of whole registers of [`MAX_WIDTH`].
#[inline(always)]
pub(crate) fn gather<S: Simd>(
    simd: S,
    records: &[f64],
    stride: usize,
    which: &[u32; MAX_WIDTH],
    out: &mut [Row],
) {
    let width = Register::<S>::WIDTH;
    debug_assert!(out.len() <= stride && stride.is_multiple_of(MAX_WIDTH));
    let mut rows = [[0.0; MAX_WIDTH]; MAX_WIDTH];
    let mut first = 0;
    while first < out.len() {
        for lane in 0..width {
            let at = which[lane] as usize * stride + first;
            rows[lane][..width].copy_from_slice(&records[at..at + width]);
        }
        let turned = transpose(simd, &rows);
        let count = (out.len() - first).min(width);
        out[first..first + count].copy_from_slice(&turned[..count]);
        first += width;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pulp::{Arch, WithSimd};

    struct Try;

    impl WithSimd for Try {
        type Output = ();

        fn with_simd<S: Simd>(self, simd: S) {
            let width = Register::<S>::WIDTH;
            for (count, stride) in [(1, 8), (3, 3), (8, 8), (9, 16), (13, 13), (16, 24)] {
                let records: Vec<f64> = (0..MAX_WIDTH * stride).map(|k| k as f64).collect();
                let columns: Vec<Row> = (0..count)
                    .map(|k| std::array::from_fn(|lane| records[lane * stride + k]))
                    .collect();
                let values: Vec<_> = columns.iter().map(|c| Register::load(simd, c)).collect();
                let mut out = vec![-1.0; MAX_WIDTH * stride];
                scatter(simd, &values, &mut out, stride);
                for lane in 0..width {
                    for k in 0..count {
                        assert_eq!(out[lane * stride + k], records[lane * stride + k]);
                    }
                }
                if stride % MAX_WIDTH == 0 {
                    let which = [3, 0, 7, 1, 1, 2, 6, 5];
                    let mut out = vec![[-1.0; MAX_WIDTH]; count];
                    gather(simd, &records, stride, &which, &mut out);
                    for (k, out) in out.iter().enumerate() {
                        for lane in 0..width {
                            assert_eq!(out[lane], records[which[lane] as usize * stride + k]);
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn records_come_back_in_every_instruction_set() {
        Arch::new().dispatch(Try);
        Arch::Scalar.dispatch(Try);
        #[cfg(target_arch = "x86_64")]
        if let Some(simd) = x86::V3::try_new() {
            Simd::vectorize(simd, Try);
        }
    }
}
