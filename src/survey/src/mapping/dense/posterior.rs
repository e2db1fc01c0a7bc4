//! What the aggregated costs say of the height of a pixel: a distribution over the layers.
//!
//! With `S(x, h)` the aggregated cost of pixel `x` at layer `h`, `g_x` the layer of the ground there and `c` the class of its colour,
//!
//! ```text
//! p(h | x) ~ F_c(h - g_x) exp(-S(x, h) / T),   F_c = argmax sum_(x of class c) log sum_h F_c(h - g_x) exp(-S(x, h) / T)
//! ```
//!
//! `F_c` says how high pixels of this colour stand above the ground of the block. It is estimated from the block's own pixels
//! (empirical Bayes, by expectation maximisation): pixels that are sure of their height decide for those that are not, so that wrong matches
//! of leaves do not stand above the canopy. Few repetitions from an even start keep it smooth. The estimate is the most probable layer,
//! a parabola through the costs beside it gives the fraction, and the standard deviation is half the width of the middle 68 % of the
//! distribution. References: J. Kiefer and J. Wolfowitz, *Consistency of the maximum likelihood estimator in the presence of infinitely many
//! incidental parameters*, 1956; H. Robbins, *An empirical Bayes approach to statistics*, 1956.

use super::{
    MAX_LAYERS,
    cost_volume::{CostVolume, LANES, transpose_8x8, words},
};

/// How distributions are made from costs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PosteriorOptions {
    /// Aggregated costs that make a layer `e` times less likely.
    pub temperature: f64,
    /// How often the distribution of heights is estimated anew; 0 takes all heights for equally likely.
    pub rounds: usize,
}

// Chosen on the synthetic flight `small` of seed 1 (60 % of overlap) and looked at on another seed, at mid and late stage with 80/70 %:
// docs/decisions.md has the numbers, of sums over eight paths. At half the temperature standard deviations are half of what errors are.
impl Default for PosteriorOptions {
    fn default() -> PosteriorOptions {
        PosteriorOptions { temperature: 60.0, rounds: 5 }
    }
}

/// What is known of the height of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Estimate {
    /// Its layer and the fraction of a layer beyond it.
    pub layer: f32,
    /// Half the width of the middle 68 % of its distribution, layers.
    pub sigma: f32,
    /// How much worse the best layer is that is not beside it, in aggregated costs.
    pub margin: u16,
}

/// Classes of colours: soil, leaf, and what is neither for sure.
pub const CLASSES: usize = 3;
/// The class of what is neither for sure.
pub(super) const UNSURE: u8 = 2;
/// Every so-manieth pixel of every so-manieth row takes part in the estimate of the distributions.
const THINNED: usize = 4;
/// Share of pixels whose height may be any: stones, weeds, what the photos show wrongly.
const ANY_HEIGHT_SHARE: f64 = 0.02;
/// Fewer pixels of a class say nothing of its heights.
const MIN_PIXELS: usize = 50;

/// What is known of a block besides the costs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pixels<'a> {
    /// Class of each pixel; `CLASSES` where the reference shows nothing.
    pub class: &'a [u8],
    /// Layer of the ground below each pixel; empty where it is not known.
    pub ground: &'a [f32],
}

/// Aggregated costs are stored as halves ([`super::aggregate`]), so one of them stands for so much.
const COST_UNIT: f64 = 2.0;
/// Layers whose shares are summed together: as many numbers as a register of AVX2 holds.
const TOGETHER: usize = 8;

/// What costs say of the layers of a pixel, and what is known of their heights before.
struct Distribution<const D: usize> {
    /// Shares of the layers, not normalised; 0 for those that take no part.
    share: [f32; D],
    /// Sums of the shares of [`TOGETHER`] layers each, and of all.
    sums: [f32; D],
    total: f32,
    /// Halvings of the likelihood per cost.
    rate: f32,
    /// 1 for layers that take part, 0 for the others.
    part: [f32; D],
}

impl<const D: usize> Distribution<D> {
    fn new(options: &PosteriorOptions, layers: usize) -> Distribution<D> {
        let rate = (std::f64::consts::LOG2_E * COST_UNIT / options.temperature) as f32;
        let part = std::array::from_fn(|d| f32::from(u8::from(d < layers)));
        Distribution { share: [0.0; D], sums: [0.0; D], total: 0.0, rate, part }
    }

    /// `p_d exp(-(S_d - min S)/T)`.
    #[inline(always)]
    fn set(&mut self, costs: &[u8; D], prior: &[f32]) {
        let mut least = u8::MAX;
        for &cost in costs {
            least = least.min(cost);
        }
        let prior = &prior[..D];
        for d in 0..D {
            let likely = half_to_the(f32::from(costs[d].wrapping_sub(least)) * self.rate);
            self.share[d] = likely * prior[d] * self.part[d];
        }
        self.total = 0.0;
        for group in 0..D / TOGETHER {
            let of = &self.share[group * TOGETHER..][..TOGETHER];
            let mut four = [0.0f32; TOGETHER / 2];
            for k in 0..TOGETHER / 2 {
                four[k] = of[k] + of[k + TOGETHER / 2];
            }
            self.sums[group] = (four[0] + four[2]) + (four[1] + four[3]);
            self.total += self.sums[group];
        }
    }

    /// What is known of a pixel.
    #[inline(always)]
    fn estimate(&mut self, costs: &[u8; D], layers: usize, prior: &[f32]) -> Estimate {
        self.set(costs, prior);
        let best = self.best();
        let mut shift = 0.0;
        if best > 0 && best + 1 < layers {
            let [a, c, b] = [0, 1, 2].map(|k| f32::from(costs[best + k - 1]));
            let bend = a + b - 2.0 * c;
            // The prior may have chosen a layer that is no minimum of the costs.
            if bend > 0.0 {
                shift = (0.5 * (a - b) / bend).clamp(-0.5, 0.5);
            }
        }
        let mut second = u8::MAX;
        for d in 0..D {
            let other = (d as u16).abs_diff(best as u16) > 2;
            second = second.min(if other { costs[d] } else { u8::MAX });
        }
        Estimate {
            layer: best as f32 + shift,
            sigma: self.half_width(layers),
            margin: COST_UNIT as u16 * u16::from(second.saturating_sub(costs[best])),
        }
    }

    /// The layer of the greatest share; the lowest of several.
    #[inline(always)]
    fn best(&self) -> usize {
        // Of numbers that are not negative the bits have the same order, and the greatest of whole numbers needs no order of comparisons.
        let (mut most, mut first) = (0, u32::MAX);
        for share in &self.share {
            most = most.max(share.to_bits());
        }
        for d in 0..D {
            first = first.min(if self.share[d].to_bits() == most { d as u32 } else { u32::MAX });
        }
        (first as usize).min(D - 1)
    }

    /// Half the width of the middle 68 %, where the share of a layer is even over its width.
    #[inline(always)]
    fn half_width(&self, layers: usize) -> f32 {
        let low = self.tail::<false>();
        let high = D as f32 - self.tail::<true>();
        (0.5 * (high.min(layers as f32) - low)).max(0.0)
    }

    /// Layers from the lowest on (from the highest where `DOWN`) that have the share of a tail together. Counts in place of branches, which
    /// no processor foresees here.
    #[inline(always)]
    fn tail<const DOWN: bool>(&self) -> f32 {
        // Of a normal distribution beyond one standard deviation.
        const TAIL: f32 = 0.158_655;
        let wanted = TAIL * self.total;
        let groups = D / TOGETHER;
        let (mut sum, mut below, mut whole) = (0.0f32, 0.0f32, 0);
        for group in 0..groups - 1 {
            sum += self.sums[if DOWN { groups - 1 - group } else { group }];
            whole += usize::from(sum < wanted);
            below = if sum < wanted { sum } else { below };
        }
        let from = TOGETHER * if DOWN { groups - 1 - whole } else { whole };
        let of = &self.share[from..][..TOGETHER];
        let (mut sum, mut single) = (below, 0);
        for k in 0..TOGETHER - 1 {
            sum += of[if DOWN { TOGETHER - 1 - k } else { k }];
            single += usize::from(sum < wanted);
            below = if sum < wanted { sum } else { below };
        }
        let last = of[if DOWN { TOGETHER - 1 - single } else { single }];
        let part = ((wanted - below) / last.max(f32::MIN_POSITIVE)).min(1.0);
        (whole * TOGETHER + single) as f32 + part
    }
}

/// `2^-x` for `x` from 0 on, within a ten-thousandth: the whole part goes to the exponent, and a polynomial of third degree stands for the
/// rest, its coefficients those of least relative error over -1/2 to 1/2.
#[inline(always)]
fn half_to_the(x: f32) -> f32 {
    // Beside 3 2^22 a number has no fractions, and its last bits are the rounded value, whatever its sign.
    const BESIDE: f32 = 12_582_912.0;
    // Beyond, a float is as good as 0.
    let x = if x < 120.0 { x } else { 120.0 };
    let beside = x + BESIDE;
    let rest = x - (beside - BESIDE);
    let power = 0.999_928_1 + rest * (-0.693_261 + rest * (0.242_611_1 - rest * 0.055_171_7));
    // The rounded part is taken off the exponent of the power.
    f32::from_bits(power.to_bits().wrapping_sub(beside.to_bits() << 23))
}

/// How likely heights are by class and layer above the lowest possible; heights are shifted so that the ground is at layer `D`.
struct Heights<const D: usize>([Vec<f32>; CLASSES]);

impl<const D: usize> Heights<D> {
    /// Where the heights of a pixel begin.
    #[inline(always)]
    fn first(pixels: &Pixels<'_>, at: usize) -> usize {
        let ground = pixels.ground.get(at).copied().unwrap_or(0.0);
        if ground.is_finite() {
            (D as f32 - ground).round().clamp(0.0, D as f32) as usize
        } else {
            D
        }
    }

    #[inline(always)]
    fn estimate(sums: &CostVolume, pixels: &Pixels<'_>, options: &PosteriorOptions) -> Heights<D> {
        let even = 1.0 / sums.layers() as f32;
        let mut heights = Heights(std::array::from_fn(|_| vec![even; 2 * D + 1]));
        if options.rounds == 0 {
            return heights;
        }
        let [width, height] = sums.size();
        let mut taken = Vec::new();
        let mut layers = [[u8::MAX; D]; LANES];
        for row in (THINNED / 2..height).step_by(THINNED) {
            for chunk in 0..sums.chunks() {
                costs_by_pixel(sums.chunk(row, chunk), &mut layers);
                for k in (THINNED / 2..LANES.min(width - chunk * LANES)).step_by(THINNED) {
                    let at = row * width + chunk * LANES + k;
                    let class = usize::from(pixels.class[at]);
                    if class < CLASSES {
                        taken.push((layers[k], class, Self::first(pixels, at)));
                    }
                }
            }
        }
        let mut of = Distribution::<D>::new(options, sums.layers());
        for _ in 0..options.rounds {
            let mut next: [Vec<f64>; CLASSES] = std::array::from_fn(|_| vec![0.0; 2 * D + 1]);
            let mut counts = [0usize; CLASSES];
            for (costs, class, first) in &taken {
                let (class, first) = (*class, *first);
                of.set(costs, &heights.0[class][first..first + D]);
                if of.total > 0.0 {
                    let part = 1.0 / f64::from(of.total);
                    for (next, &share) in next[class][first..first + D].iter_mut().zip(&of.share) {
                        *next += f64::from(share) * part;
                    }
                    counts[class] += 1;
                }
            }
            for class in 0..CLASSES {
                if counts[class] < MIN_PIXELS {
                    continue;
                }
                let part = (1.0 - ANY_HEIGHT_SHARE) / counts[class] as f64;
                let any = ANY_HEIGHT_SHARE / sums.layers() as f64;
                let of = &next[class];
                for (k, out) in heights.0[class].iter_mut().enumerate() {
                    *out = (part * of[k] + any) as f32;
                }
            }
        }
        heights
    }
}

/// From the columns of each layer to the layers of each column.
#[inline(always)]
fn costs_by_pixel<const D: usize>(layers: &[[u8; LANES]], out: &mut [[u8; D]; LANES]) {
    for (eight, layers) in layers.chunks(8).enumerate() {
        // Layers that take no part fit nowhere.
        let mut rows = [[u64::MAX; 4]; 8];
        for (row, layer) in rows.iter_mut().zip(layers) {
            *row = words(layer);
        }
        transpose_8x8(&mut rows);
        for (c, row) in rows.iter().enumerate() {
            for (k, of) in row.iter().enumerate() {
                out[8 * k + c][8 * eight..][..8].copy_from_slice(&of.to_le_bytes());
            }
        }
    }
}

/// The heights of all pixels, from their aggregated costs.
pub(super) fn estimates(
    sums: &CostVolume,
    pixels: &Pixels<'_>,
    options: &PosteriorOptions,
) -> Vec<Estimate> {
    fn of<const D: usize>(estimates: Estimates<'_>) -> Vec<Estimate> {
        const { assert!(D.is_multiple_of(TOGETHER)) };
        pulp::Arch::new().dispatch(Padded::<D>(estimates))
    }
    // Loops over a fixed number of layers are vectorised, those over any number take twice the time.
    let estimates = Estimates { sums, pixels, options };
    match sums.layers() {
        0..=16 => of::<16>(estimates),
        17..=32 => of::<32>(estimates),
        33..=48 => of::<48>(estimates),
        49..=64 => of::<64>(estimates),
        65..=96 => of::<96>(estimates),
        97..=128 => of::<128>(estimates),
        129..=192 => of::<192>(estimates),
        _ => of::<MAX_LAYERS>(estimates),
    }
}

/// What heights are estimated from.
struct Estimates<'a> {
    sums: &'a CostVolume,
    pixels: &'a Pixels<'a>,
    options: &'a PosteriorOptions,
}

/// [`estimates`] with the machine's SIMD and room for `D` layers.
struct Padded<'a, const D: usize>(Estimates<'a>);

impl<const D: usize> pulp::WithSimd for Padded<'_, D> {
    type Output = Vec<Estimate>;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Vec<Estimate> {
        let Estimates { sums, pixels, options } = self.0;
        let heights = Heights::<D>::estimate(sums, pixels, options);
        let ([width, height], layers) = (sums.size(), sums.layers());
        let mut out = vec![Estimate::default(); width * height];
        let mut of = Distribution::<D>::new(options, layers);
        let mut costs = [[u8::MAX; D]; LANES];
        for row in 0..height {
            for chunk in 0..sums.chunks() {
                costs_by_pixel(sums.chunk(row, chunk), &mut costs);
                let from = row * width + chunk * LANES;
                let n = LANES.min(width - chunk * LANES);
                for (k, out) in out[from..from + n].iter_mut().enumerate() {
                    let class = usize::from(pixels.class[from + k]);
                    if class < CLASSES {
                        let first = Heights::<D>::first(pixels, from + k);
                        *out = of.estimate(&costs[k], layers, &heights.0[class][first..first + D]);
                    }
                }
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn powers_of_a_half_are_exact_to_four_digits() {
        for k in 0..12_000 {
            let x = 0.01 * k as f32;
            let off = f64::from(half_to_the(x)) / (-f64::from(x)).exp2() - 1.0;
            assert!(off.abs() < 1e-4, "{x}: {off}");
        }
        assert!(half_to_the(1e6) < 1e-35);
    }

    fn volume(size: [usize; 2], layers: usize, of: impl Fn(usize, usize) -> f64) -> CostVolume {
        let mut volume = CostVolume::new(size, layers);
        for at in 0..size[0] * size[1] {
            for d in 0..layers {
                *volume.at_mut([at % size[0], at / size[0]], d) =
                    of(at, d).round().min(255.0) as u8;
            }
        }
        volume
    }

    #[test]
    fn sure_pixels_decide_for_those_with_two_minima() {
        // All are at layer 10; in one of eight a wrong match far above costs a little less.
        const SIZE: [usize; 2] = [63, 64];
        let of = |at: usize, d: usize| {
            let off = |from: usize| (15 * d.abs_diff(from)).min(200) as f64;
            if at.is_multiple_of(8) { (off(10) + 10.0).min(off(40)) } else { off(10) }
        };
        let sums = volume(SIZE, 64, of);
        let class = vec![1; SIZE[0] * SIZE[1]];
        let pixels = Pixels { class: &class, ground: &[] };
        let wrong = |rounds: usize| {
            let options = PosteriorOptions { rounds, ..PosteriorOptions::default() };
            let found = estimates(&sums, &pixels, &options);
            found.iter().filter(|found| (found.layer - 10.0).abs() > 1.0).count()
        };
        assert_eq!((wrong(0), wrong(5)), (SIZE[0] * SIZE[1] / 8, 0));
    }

    #[test]
    fn the_standard_deviation_is_that_of_a_normal_distribution() {
        // Costs of a parabola are a normal distribution: S / T = (h - m)^2 / (2 s^2).
        let (m, s, t) = (30.3, 4.0, PosteriorOptions::default().temperature / COST_UNIT);
        let sums = volume([1, 1], 64, |_, d| t * (d as f64 - m).powi(2) / (2.0 * s * s));
        let pixels = Pixels { class: &[1], ground: &[] };
        let found = estimates(&sums, &pixels, &PosteriorOptions::default())[0];
        assert!((f64::from(found.sigma) - s).abs() < 0.15, "{found:?}");
        // Costs are whole numbers, of which three beside the least hardly differ on so wide a parabola.
        assert!((f64::from(found.layer) - m).abs() < s / 8.0, "{found:?}");
    }
}
