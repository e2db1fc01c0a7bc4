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

/// How distributions are made from costs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PosteriorOptions {
    /// Aggregated costs that make a layer `e` times less likely.
    pub temperature: f64,
    /// How often the distribution of heights is estimated anew; 0 takes all heights for equally likely.
    pub rounds: usize,
}

// Chosen on the synthetic flight `small` of seed 1 (60 % of overlap) and looked at on another seed, at mid and late stage with 80/70 %:
// docs/decisions.md has the numbers. At half the temperature standard deviations are half of what errors are.
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
    /// Columns.
    pub width: usize,
    /// Layers that take part.
    pub layers: usize,
    /// Class of each pixel; `CLASSES` where the reference shows nothing.
    pub class: &'a [u8],
    /// Layer of the ground below each pixel; empty where it is not known.
    pub ground: &'a [f32],
}

/// Likelihoods by cost above the least.
struct Likelihood(Vec<f32>);

impl Likelihood {
    fn new(temperature: f64) -> Likelihood {
        // Eight paths of costs of at most 255 each.
        const MAX_COST: usize = 8 * 255;
        Likelihood((0..=MAX_COST).map(|cost| (-(cost as f64) / temperature).exp() as f32).collect())
    }

    /// Of all layers of a pixel.
    #[inline(always)]
    fn of<const D: usize>(&self, sums: &[u16; D], out: &mut [f32; D]) {
        let least = sums.iter().copied().min().unwrap_or_default();
        for (out, &sum) in out.iter_mut().zip(sums) {
            let above = usize::from(sum.wrapping_sub(least)).min(self.0.len() - 1);
            *out = self.0[above];
        }
    }
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

    fn estimate(
        sums: &[[u16; D]],
        pixels: &Pixels<'_>,
        likelihood: &Likelihood,
        rounds: usize,
    ) -> Heights<D> {
        let even = 1.0 / pixels.layers as f32;
        let mut heights = Heights(std::array::from_fn(|_| vec![even; 2 * D + 1]));
        let height = sums.len() / pixels.width.max(1);
        let rows = (THINNED / 2..height).step_by(THINNED);
        let width = pixels.width;
        let taken: Vec<usize> = rows
            .flat_map(|v| (THINNED / 2..width).step_by(THINNED).map(move |u| v * width + u))
            .filter(|&at| usize::from(pixels.class[at]) < CLASSES)
            .collect();
        for _ in 0..rounds {
            let mut next: [Vec<f64>; CLASSES] = std::array::from_fn(|_| vec![0.0; 2 * D + 1]);
            let mut counts = [0usize; CLASSES];
            let mut p = [0.0f32; D];
            for &at in &taken {
                let class = usize::from(pixels.class[at]);
                likelihood.of(&sums[at], &mut p);
                let first = Self::first(pixels, at);
                let prior = &heights.0[class][first..first + D];
                let mut total = 0.0f32;
                for d in 0..pixels.layers {
                    p[d] *= prior[d];
                    total += p[d];
                }
                if total > 0.0 {
                    let share = 1.0 / f64::from(total);
                    for d in 0..pixels.layers {
                        next[class][first + d] += f64::from(p[d]) * share;
                    }
                    counts[class] += 1;
                }
            }
            for class in 0..CLASSES {
                if counts[class] < MIN_PIXELS {
                    continue;
                }
                let part = (1.0 - ANY_HEIGHT_SHARE) / counts[class] as f64;
                let any = ANY_HEIGHT_SHARE / pixels.layers as f64;
                let of = &next[class];
                for (k, out) in heights.0[class].iter_mut().enumerate() {
                    *out = (part * of[k] + any) as f32;
                }
            }
        }
        heights
    }
}

/// The heights of all pixels.
pub(super) fn estimates<const D: usize>(
    sums: &[[u16; D]],
    pixels: &Pixels<'_>,
    options: &PosteriorOptions,
) -> Vec<Estimate> {
    let likelihood = Likelihood::new(options.temperature);
    let heights = Heights::<D>::estimate(sums, pixels, &likelihood, options.rounds);
    let mut out = vec![Estimate::default(); sums.len()];
    let mut p = [0.0f32; D];
    for (at, (sums, out)) in sums.iter().zip(&mut out).enumerate() {
        let class = usize::from(pixels.class[at]);
        if class >= CLASSES {
            continue;
        }
        likelihood.of(sums, &mut p);
        let first = Heights::<D>::first(pixels, at);
        let prior = &heights.0[class][first..first + D];
        let (mut best, mut most, mut total) = (0, -1.0f32, 0.0f32);
        for d in 0..pixels.layers {
            p[d] *= prior[d];
            total += p[d];
            if p[d] > most {
                (best, most) = (d, p[d]);
            }
        }
        let mut shift = 0.0;
        if best > 0 && best + 1 < pixels.layers {
            let [a, c, b] = [0, 1, 2].map(|k| f32::from(sums[best + k - 1]));
            let bend = a + b - 2.0 * c;
            // The prior may have chosen a layer that is no minimum of the costs.
            if bend > 0.0 {
                shift = (0.5 * (a - b) / bend).clamp(-0.5, 0.5);
            }
        }
        let mut second = u16::MAX;
        for d in 0..pixels.layers {
            let away = d.abs_diff(best) > 2;
            second = second.min(if away { sums[d] } else { u16::MAX });
        }
        *out = Estimate {
            layer: best as f32 + shift,
            sigma: half_width(&p[..pixels.layers], total),
            margin: second.saturating_sub(sums[best]),
        };
    }
    out
}

/// Half the width of the middle 68 % of a distribution over layers, each of which is even over its width.
#[inline(always)]
fn half_width(p: &[f32], total: f32) -> f32 {
    const TAIL: f32 = 0.158_655;
    // Layers from one end on that have the share of a tail together.
    let layers_of_tail = |layers: &mut dyn Iterator<Item = &f32>| -> f32 {
        let (wanted, mut sum, mut whole) = (TAIL * total, 0.0f32, 0.0f32);
        for &share in layers {
            if sum + share >= wanted {
                return whole + (wanted - sum) / share.max(f32::MIN_POSITIVE);
            }
            sum += share;
            whole += 1.0;
        }
        whole
    };
    let low = layers_of_tail(&mut p.iter());
    let high = p.len() as f32 - layers_of_tail(&mut p.iter().rev());
    (0.5 * (high - low)).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sure_pixels_decide_for_those_with_two_minima() {
        // All are at layer 10; in one of eight a wrong match far above costs a little less.
        const WIDTH: usize = 63;
        let of = |at: usize| -> [u16; 64] {
            std::array::from_fn(|d| {
                let off = |from: usize| (30 * d.abs_diff(from) as u16).min(400);
                if at.is_multiple_of(8) { (off(10) + 20).min(off(40)) } else { off(10) }
            })
        };
        let sums: Vec<[u16; 64]> = (0..64 * WIDTH).map(of).collect();
        let class = vec![1; sums.len()];
        let pixels = Pixels { width: WIDTH, layers: 64, class: &class, ground: &[] };
        let wrong = |rounds: usize| {
            let options = PosteriorOptions { rounds, ..PosteriorOptions::default() };
            let found = estimates(&sums, &pixels, &options);
            found.iter().filter(|found| (found.layer - 10.0).abs() > 1.0).count()
        };
        assert_eq!((wrong(0), wrong(5)), (sums.len() / 8, 0));
    }

    #[test]
    fn the_standard_deviation_is_that_of_a_normal_distribution() {
        // Costs of a parabola are a normal distribution: S / T = (h - m)^2 / (2 s^2).
        let (m, s, t) = (30.3, 4.0, PosteriorOptions::default().temperature);
        let sums = [std::array::from_fn(|d| {
            (t * (d as f64 - m).powi(2) / (2.0 * s * s)).round().min(2000.0) as u16
        })];
        let pixels = Pixels { width: 1, layers: 64, class: &[1], ground: &[] };
        let found = estimates::<64>(&sums, &pixels, &PosteriorOptions::default())[0];
        assert!((f64::from(found.sigma) - s).abs() < 0.15, "{found:?}");
        assert!((f64::from(found.layer) - m).abs() < 0.1, "{found:?}");
    }
}
