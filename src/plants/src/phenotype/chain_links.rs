//! The scores of all pairs of neighbours of a place at once, and sums of their exponentials: where [`super::dynamic_programming`] spends
//! its time.
//!
//! Leaf mass that two plants at `a` and `b` leave open is a sum over the mass between them. With `m_0(x)` and `m_1(x)` the mass up to `x`
//! and its first moment, and `k(x) = x m_0(x) - m_1(x)`, it is
//!
//! `k(a + c) + k(b - c) + 2 m_1(m) - (a + b) m_0(m)`, `m` the middle of `a` and `b`,
//!
//! and, where the middle is farther than `t` from what either covers,
//!
//! `k(a + c) - k(a + c + t) + k(b - c) - k(b - c - t)`.
//!
//! So every term is one of an array in order. All sums are added in eight lanes, in the same order on every machine.

use super::dynamic_programming::{Chain, STEP};

/// Numbers that are worked on together.
const LANES: usize = 8;

/// Makes the scores of links of a chain, in memory that is used again.
pub(super) struct Links<'c> {
    chain: &'c Chain<'c>,
    /// Logarithms of the densities of gaps, from the longest to none.
    gaps_back: Vec<f64>,
    /// `k(x)`.
    moments: Vec<f64>,
    /// `2 m_1(s / 2) - s m_0(s / 2)` for `s = a + b`.
    middles: Vec<f64>,
    /// The scores that were made last.
    pub(super) scores: Vec<f64>,
}

impl<'c> Links<'c> {
    pub(super) fn new(chain: &'c Chain<'c>) -> Links<'c> {
        let mass = &chain.profile.mass;
        let moment = |(x, [sum, first]): (usize, &[f64; 2])| x as f64 * sum - first;
        let middle = |s: usize| 2.0 * mass[s / 2][1] - s as f64 * mass[s / 2][0];
        Links {
            chain,
            gaps_back: chain.gaps.iter().rev().copied().collect(),
            moments: mass.iter().enumerate().map(moment).collect(),
            middles: (0..2 * mass.len()).map(middle).collect(),
            scores: Vec::with_capacity(chain.gaps.len()),
        }
    }

    /// The gaps from which on mass lies open, and from which on distances are truncated.
    fn turns(&self) -> [usize; 2] {
        let Chain { covered, truncated, .. } = *self.chain;
        [2 * covered + 1, 2 * (covered + truncated) + 1]
    }

    /// The scores of links from all places before `at`, [`Chain::before`].
    #[inline(always)]
    pub(super) fn back(&mut self, at: usize) {
        let chain = self.chain;
        let (covered, truncated, cost) = (chain.covered, chain.truncated, chain.weights[1] * STEP);
        let before = chain.before(at);
        let first = before.start;
        let turn = |gap: usize| (at + 1).saturating_sub(gap).clamp(first, before.end.max(first));
        let [open, far] = self.turns().map(turn);
        self.scores.clear();
        let skipped = chain.gaps.len() - 1 - (at - first);
        self.scores.extend_from_slice(&self.gaps_back[skipped..][..before.len()]);
        if open > first {
            let (of, to) = (&self.moments, at - covered);
            if far > first {
                let there = of[to] - of[to - truncated];
                let from = &of[first + covered..][..far - first];
                let truncated = &of[first + covered + truncated..][..far - first];
                for ((score, near), far) in self.scores.iter_mut().zip(from).zip(truncated) {
                    *score -= cost * (near - far + there);
                }
            }
            let there = of[to];
            let from = &of[far + covered..open + covered];
            let middle = &self.middles[far + at..open + at];
            let scores = &mut self.scores[far - first..open - first];
            for ((score, near), middle) in scores.iter_mut().zip(from).zip(middle) {
                *score -= cost * (near + there + middle);
            }
        }
        let overlapping = (at + 1).saturating_sub(chain.overlap.len()).max(first);
        for a in overlapping..before.end {
            self.scores[a - first] -= chain.claimed_twice(a, at);
        }
    }

    /// The scores of links to all places after `at` within reach, from two steps on.
    #[inline(always)]
    pub(super) fn ahead(&mut self, at: usize) {
        let chain = self.chain;
        let (covered, truncated, cost) = (chain.covered, chain.truncated, chain.weights[1] * STEP);
        let (count, first) = (chain.worth.len(), at + 2);
        let end = (at + chain.gaps.len()).min(count).max(first);
        self.scores.clear();
        self.scores.extend_from_slice(&chain.gaps[2..2 + (end - first)]);
        let [open, far] = self.turns().map(|gap| (at + gap).clamp(first, end));
        if open < end {
            let (of, from) = (&self.moments, at + covered);
            if far < end {
                let here = of[from] - of[from + truncated];
                let to = &of[far - covered..end - covered];
                let truncated = &of[far - covered - truncated..end - covered - truncated];
                let scores = &mut self.scores[far - first..];
                for ((score, near), far) in scores.iter_mut().zip(to).zip(truncated) {
                    *score -= cost * (here + near - far);
                }
            }
            let here = of[from];
            let to = &of[open - covered..far - covered];
            let middle = &self.middles[open + at..far + at];
            let scores = &mut self.scores[open - first..far - first];
            for ((score, near), middle) in scores.iter_mut().zip(to).zip(middle) {
                *score -= cost * (here + near + middle);
            }
        }
        for b in first..end.min(at + chain.overlap.len()) {
            self.scores[b - first] -= chain.claimed_twice(at, b);
        }
    }
}

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
pub(super) fn highest(terms: &[f64]) -> f64 {
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

/// `ln sum exp`, without overflow; minus infinity of nothing. The terms are used up.
pub(super) fn log_sum_exp(terms: &mut [f64]) -> f64 {
    struct Sum<'t>(&'t mut [f64]);
    impl pulp::WithSimd for Sum<'_> {
        type Output = f64;
        #[inline(always)]
        fn with_simd<S: pulp::Simd>(self, _: S) -> f64 {
            normalise(self.0)
        }
    }
    pulp::Arch::new().dispatch(Sum(terms))
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
            let found = log_sum_exp(&mut shares);
            assert!(found == exact || (found - exact).abs() < 1e-10, "{count}: {found} {exact}");
            let whole = dot(&shares, &vec![1.0; shares.len()]);
            assert!(count == 0 || (whole - 1.0).abs() < 1e-14, "{whole}");
        }
    }
}
