//! Sums of exponentials of scores, added in eight lanes in the same order on every machine.

/// Numbers that are worked on together: one register of AVX-512, two of AVX2.
const LANES: usize = 8;

/// `exp(x)` for `x <= 0`, within two units in the last place, without a branch; 0 far below.
#[inline(always)]
fn exp(x: f64) -> f64 {
    /// 1.5 * 2^52: adding it rounds to a whole number, which is then in the last bits.
    const ROUND: f64 = 6_755_399_441_055_744.0;
    /// The logarithm of 2 in two parts, the first of which ends in zero bits, so that whole times it is exact (as in fdlibm).
    const LN_2: [f64; 2] = [6.931_471_803_691_238e-1, 1.908_214_929_270_587_7e-10];
    /// 1 / k! from k = 12 down.
    const SERIES: [f64; 13] = [
        2.087_675_698_786_81e-9,
        2.505_210_838_544_172e-8,
        2.755_731_922_398_589e-7,
        2.755_731_922_398_589_3e-6,
        2.480_158_730_158_73e-5,
        1.984_126_984_126_984e-4,
        1.388_888_888_888_889e-3,
        8.333_333_333_333_333e-3,
        4.166_666_666_666_666_4e-2,
        1.666_666_666_666_666_6e-1,
        0.5,
        1.0,
        1.0,
    ];
    let x = x.max(-700.0);
    let whole = x * std::f64::consts::LOG2_E + ROUND;
    let times = whole - ROUND;
    let rest = (x - times * LN_2[0]) - times * LN_2[1];
    let power = SERIES.iter().fold(0.0, |sum, term| sum * rest + term);
    power * f64::from_bits(whole.to_bits().wrapping_add(1023) << 52)
}

#[inline(always)]
fn total(lanes: [f64; LANES]) -> f64 {
    let [a, b, c, d, e, f, g, h] = lanes;
    ((a + b) + (c + d)) + ((e + f) + (g + h))
}

/// The largest of some numbers, minus infinity of none.
#[inline(always)]
fn highest(terms: &[f64]) -> f64 {
    let (blocks, rest) = terms.as_chunks::<LANES>();
    let mut lanes = [f64::NEG_INFINITY; LANES];
    for block in blocks {
        for (highest, term) in lanes.iter_mut().zip(block) {
            *highest = if *term > *highest { *term } else { *highest };
        }
    }
    lanes.iter().chain(rest).copied().fold(f64::NEG_INFINITY, f64::max)
}

/// Replaces `terms` by their shares of the sum of their exponentials, and returns the logarithm of that sum; minus infinity of nothing.
#[inline(always)]
pub(super) fn normalise(terms: &mut [f64]) -> f64 {
    let highest = highest(terms);
    if highest == f64::NEG_INFINITY {
        terms.fill(0.0);
        return highest;
    }
    let mut lanes = [0.0; LANES];
    let (blocks, rest) = terms.as_chunks_mut::<LANES>();
    for block in blocks {
        for (sum, term) in lanes.iter_mut().zip(block) {
            *term = exp(*term - highest);
            *sum += *term;
        }
    }
    for (sum, term) in lanes.iter_mut().zip(rest) {
        *term = exp(*term - highest);
        *sum += *term;
    }
    let sum = total(lanes);
    let share = 1.0 / sum;
    terms.iter_mut().for_each(|term| *term *= share);
    highest + sum.ln()
}

/// The sum of products.
#[inline(always)]
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut lanes = [0.0; LANES];
    let ((a_blocks, a_rest), (b_blocks, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (a, b) in a_blocks.iter().zip(b_blocks) {
        for ((sum, a), b) in lanes.iter_mut().zip(a).zip(b) {
            *sum += a * b;
        }
    }
    for ((sum, a), b) in lanes.iter_mut().zip(a_rest).zip(b_rest) {
        *sum += a * b;
    }
    total(lanes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponentials_are_those_of_the_library() {
        for k in 0..20_000 {
            let x = -0.037 * f64::from(k) * 0.99;
            let (fast, exact) = (exp(x), x.exp());
            assert!(x < -700.0 || (fast - exact).abs() <= 5e-16 * exact, "{x}: {fast:e} {exact:e}");
        }
        assert_eq!(exp(0.0), 1.0);
        assert!(exp(f64::NEG_INFINITY) < 1e-300);
    }

    #[test]
    fn sums_of_exponentials_neither_overflow_nor_vanish() {
        for count in [0, 1, 7, 8, 9, 100] {
            let terms: Vec<f64> = (0..count).map(|k| 1e4 - 0.3 * f64::from(k * k % 41)).collect();
            let exact = 1e4 + terms.iter().map(|t| (t - 1e4).exp()).sum::<f64>().ln();
            let mut shares = terms.clone();
            let found = normalise(&mut shares);
            assert!(found == exact || (found - exact).abs() < 1e-10, "{count}: {found} {exact}");
            let whole = dot(&shares, &vec![1.0; shares.len()]);
            assert!(count == 0 || (whole - 1.0).abs() < 1e-14, "{whole}");
        }
    }
}
