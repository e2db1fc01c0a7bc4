//! The two classes of a photo, estimated from the photo: background and vegetation along one axis of colour.
//!
//! ```text
//! z = g + w (y - y_v) - max(0, -2 - y) - S(u, v),   g = -a*, y = b* of L*a*b*, smoothed over 3 x 3 pixels or more
//! z | background ~ N(m_b, s^2),   z | vegetation ~ N(m_v, s^2),   s^2 = (m_v - m_b)^2 / 10
//! P(vegetation | z) = 1 / (1 + exp(-(z - T) (m_v - m_b) / s^2)),   T = m_b + 0.45 (m_v - m_b).
//! ```
//!
//! `m_b` is the mean of what lies below `T`, `m_v` the mean of what lies above beyond the mirror image of the
//! background (soil is as often redder as greener than its mean, leaves are only greener): so bare soil with some
//! plants in it is not cut in two. For the same reason `T` stays off the upper part of a peak of the histogram that is less green than leaves: that is soil, for
//! example in little light, where colours are noisy. Both have priors worth some thousandths of the photo, so that neither class is
//! invented where it is absent. `m_b`, `m_v` and `T` are iterated to a fixed point (iterative selection). `S` is a
//! quadratic surface fitted to the background, for vignettes of colour; `w`, from the covariance of confident pixels
//! of both classes (Fisher's discriminant), lets yellow ground be told from yellow-green leaves, and the blue of cloth and
//! plastic never counts as leaf.
//!
//! Reference: T. W. Ridler, S. Calvard, "Picture thresholding using an iterative selection method", IEEE Trans.
//! SMC 8, 1978.

use rowgram_optim::robust::median;
use serde::{Deserialize, Serialize};

/// Share of the way from background to vegetation at which both are equally likely. Chosen, as the two weights below
/// and the mirror's stretch, on masks of wheat, rice, potato, carrot and rosettes together (0.4 to 0.6 were compared).
const BOUNDARY: f64 = 0.45;
/// Greenness of leaves before the photo is seen, and the share of a photo that this is worth.
const VEGETATION: (f64, f64) = (14.0, 0.004);
/// The same for the background.
const BACKGROUND: (f64, f64) = (-2.0, 0.003);
/// A peak of the histogram that is greener than this is not soil: it is the threshold that the priors alone give.
pub(super) const GREENEST_SOIL: f64 = BACKGROUND.0 + BOUNDARY * (VEGETATION.0 - BACKGROUND.0);
/// The threshold does not go down to where the histogram is higher than this share of its peak of soil, unless it has a minimum there. Chosen on wheat, rice,
/// potato and rosettes, with all photos darkened, too (0.3 to 0.8 were compared): the masks of dark rosettes then agree to 0.93 instead of
/// 0.70 of their union with the true ones, and dark bare soil with seedlings is not cut in two.
const MAX_SHARE_OF_PEAK: f64 = 0.6;
/// Redder background counts as this: trays and bricks say nothing of the soil.
const REDDEST: f64 = -6.0;
/// The greener half of the background is this much wider than the redder one.
const MIRROR: f64 = 1.1;
/// Bluer than this is penalised.
const BLUE: f32 = -2.0;
/// Variance of a class over the squared distance of the means.
const VARIANCE: f64 = 0.1;
/// Pixels farther from the threshold than this share of the distance of the classes are confident. On what it was chosen is not recorded.
pub(super) const MARGIN: f64 = 0.15;
/// Largest weight of yellowness.
const YELLOW: f64 = 0.5;

/// Lower end, step and number of the bins of a histogram of `z`.
const BINS: (f64, f64, usize) = (-64.0, 0.5, 272);

/// What was estimated of a photo. Greenness is `-a*` of CIE L\*a\*b\*.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Model {
    /// Mean of the background on the axis `z`.
    pub background: f64,
    /// Mean of vegetation on it.
    pub vegetation: f64,
    /// Where both are equally likely.
    pub threshold: f64,
    /// Weight of yellowness `b*`.
    pub yellow_weight: f64,
    /// Mean yellowness of vegetation.
    pub yellow_mean: f64,
    /// Coefficients of `x, y, x^2 - 1/3, x y, y^2 - 1/3` of the background's surface, `x` and `y` from -1 to 1.
    pub surface: [f64; 5],
    /// What linear red, green and blue are multiplied by before they are converted to greenness and yellowness.
    #[serde(default = "neutral")]
    pub white_balance: [f64; 3],
    /// Pixels to either side over which colours are smoothed before pixels are classified; 0 for NDVI, which is not smoothed.
    #[serde(default = "usual_smoothing")]
    pub smoothing_px: usize,
    /// Whether greenness is not that of colours but the NDVI, as [`super::Seen`] has it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub has_ndvi: bool,
}

fn neutral() -> [f64; 3] {
    [1.0; 3]
}

/// Pixels to either side over which the colours of usual photos are smoothed, and of all photos before their classes are estimated.
pub const USUAL_SMOOTHING_PX: usize = 1;

pub(super) fn usual_smoothing() -> usize {
    USUAL_SMOOTHING_PX
}

/// A smoothed pixel: its place in -1..1, greenness, yellowness.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sample {
    pub(super) x: f32,
    pub(super) y: f32,
    pub(super) green: f32,
    pub(super) yellow: f32,
}

impl Sample {
    fn basis(&self) -> [f64; 5] {
        let (x, y) = (f64::from(self.x), f64::from(self.y));
        [x, y, x * x - 1.0 / 3.0, x * y, y * y - 1.0 / 3.0]
    }
}

/// Greenness less the penalty of blue.
#[inline(always)]
pub(super) fn leaf_green(green: f32, yellow: f32) -> f32 {
    green - (BLUE - yellow).max(0.0)
}

/// A histogram of `z`, as shares of the photo.
struct Histogram {
    share: Vec<f64>,
    /// The same, smoothed by a Gaussian.
    smooth: Vec<f64>,
}

impl Histogram {
    fn of(values: impl Iterator<Item = f64>) -> Histogram {
        /// Standard deviation of the smoothing and its reach, bins. On wheat 5 bins instead of 3 cost 0.017 of the intersection over union.
        const SMOOTHING: (f64, usize) = (3.0, 12);
        let (from, step, bins) = BINS;
        let mut share = vec![0.0; bins];
        let mut count = 0.0_f64;
        for value in values {
            share[(((value - from) / step).max(0.0) as usize).min(bins - 1)] += 1.0;
            count += 1.0;
        }
        share.iter_mut().for_each(|h| *h /= count.max(1.0));
        let (sigma, reach) = SMOOTHING;
        let weight = |off: usize| (-0.5 * (off as f64 / sigma).powi(2)).exp();
        let smooth = (0..bins).map(|bin| {
            let near = bin.saturating_sub(reach)..(bin + reach + 1).min(bins);
            near.map(|other| weight(bin.abs_diff(other)) * share[other]).sum()
        });
        let smooth = smooth.collect();
        Histogram { share, smooth }
    }

    fn centre(bin: usize) -> f64 {
        let (from, step, _) = BINS;
        from + step * (bin as f64 + 0.5)
    }

    fn at(&self, z: f64) -> f64 {
        let (from, step, bins) = BINS;
        let bin = (z - from) / step - 0.5;
        if bin < 0.0 || bin >= (bins - 1) as f64 {
            return 0.0;
        }
        let (low, part) = (bin as usize, bin.fract());
        self.share[low] * (1.0 - part) + self.share[low + 1] * part
    }

    /// The threshold, or the next greater one that is not on the upper part of a peak of soil: below it, or in a minimum.
    fn off_peak(&self, threshold: f64) -> f64 {
        let (from, step, bins) = BINS;
        let smooth = &self.smooth;
        let mut bin = ((threshold - from) / step - 0.5).clamp(1.0, (bins - 2) as f64) as usize;
        let mut peak = bin;
        while peak > 0 && smooth[peak - 1] >= smooth[peak] {
            peak -= 1;
        }
        let limit = MAX_SHARE_OF_PEAK * smooth[peak];
        if peak == bin || Self::centre(peak) >= GREENEST_SOIL || smooth[bin] <= limit {
            return threshold;
        }
        while bin + 1 < bins && smooth[bin] > limit && smooth[bin + 1] < smooth[bin] {
            bin += 1;
        }
        Self::centre(bin)
    }
}

/// Means and threshold of one histogram.
#[derive(Debug, Clone, Copy)]
struct Classes {
    background: f64,
    vegetation: f64,
    threshold: f64,
}

impl Classes {
    fn of(values: impl Iterator<Item = f64>) -> Classes {
        let histogram = Histogram::of(values);
        let bins = histogram.share.len();
        let centre = Histogram::centre;
        let mut threshold = 12.0;
        let (mut background, mut vegetation) = (BACKGROUND.0, VEGETATION.0);
        for _ in 0..100 {
            let (mut weight, mut sum) = (BACKGROUND.1, BACKGROUND.1 * BACKGROUND.0);
            let below = (0..bins).take_while(|&bin| centre(bin) < threshold);
            for bin in below {
                weight += histogram.share[bin];
                sum += histogram.share[bin] * centre(bin).max(REDDEST);
            }
            background = sum / weight;
            let (mut weight, mut sum) = (VEGETATION.1, VEGETATION.1 * VEGETATION.0);
            for bin in (0..bins).filter(|&bin| centre(bin) >= threshold) {
                let mirrored = background - (centre(bin) - background) / MIRROR;
                let excess = (histogram.share[bin] - histogram.at(mirrored) / MIRROR).max(0.0);
                weight += excess;
                sum += excess * centre(bin);
            }
            vegetation = sum / weight;
            let mut next = background + BOUNDARY * (vegetation - background);
            if next < threshold {
                next = histogram.off_peak(next).min(threshold);
            }
            let change = next - threshold;
            // Half a step: whole ones can oscillate between two bins.
            threshold += 0.5 * change;
            if change.abs() < 0.02 {
                break;
            }
        }
        Classes { background, vegetation, threshold }
    }

    fn distance(&self) -> f64 {
        self.vegetation - self.background
    }
}

impl Model {
    /// Estimates the classes from smoothed pixels spread over the photo.
    pub(super) fn fit(samples: &[Sample]) -> Model {
        let green = |s: &Sample| f64::from(leaf_green(s.green, s.yellow));
        let mut z: Vec<f64> = samples.iter().map(green).collect();
        let mut classes = Classes::of(z.iter().copied());
        let mut surface = [0.0; 5];
        for _ in 0..2 {
            let step = background_surface(samples, &z, &classes);
            for (z, sample) in z.iter_mut().zip(samples) {
                *z -= dot(&step, &sample.basis());
            }
            for (sum, step) in surface.iter_mut().zip(step) {
                *sum += step;
            }
            classes = Classes::of(z.iter().copied());
        }
        let (yellow_weight, yellow_mean) = discriminant(samples, &z, &classes);
        if yellow_weight > 0.0 {
            for (z, sample) in z.iter_mut().zip(samples) {
                *z += yellow_weight * (f64::from(sample.yellow) - yellow_mean);
            }
            classes = Classes::of(z.iter().copied());
        }
        let Classes { background, vegetation, threshold } = classes;
        Model {
            background,
            vegetation,
            threshold,
            yellow_weight,
            yellow_mean,
            surface,
            white_balance: neutral(),
            smoothing_px: usual_smoothing(),
            has_ndvi: false,
        }
    }

    /// The model of a small part of the photo around a place, given in -1..1 of its width and height: the background's
    /// surface is what it is there.
    pub fn at(&self, [x, y]: [f64; 2]) -> Model {
        let [constant, linear, quadratic] = self.surface_of_row(y);
        let level = constant + x * (linear + x * quadratic);
        Model { threshold: self.threshold + level, surface: [0.0; 5], ..*self }
    }

    /// A smoothed pixel on the axis.
    pub(super) fn z(&self, sample: &Sample) -> f64 {
        let green = f64::from(leaf_green(sample.green, sample.yellow));
        let yellow = f64::from(sample.yellow) - self.yellow_mean;
        green + self.yellow_weight * yellow - dot(&self.surface, &sample.basis())
    }

    /// Posterior log odds of vegetation for a unit of `z` above the threshold.
    pub fn log_odds_per_unit(&self) -> f64 {
        1.0 / (VARIANCE * (self.vegetation - self.background).max(1.0))
    }

    /// The background's surface in row `y` (-1..1): constant, linear and quadratic coefficient of `x`.
    pub(super) fn surface_of_row(&self, y: f64) -> [f64; 3] {
        let s = &self.surface;
        [s[1] * y + s[4] * (y * y - 1.0 / 3.0) - s[2] / 3.0, s[0] + s[3] * y, s[2]]
    }
}

fn dot(a: &[f64; 5], b: &[f64; 5]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Robust least squares of the background on the surface's basis, held near zero where there is little background.
fn background_surface(samples: &[Sample], z: &[f64], classes: &Classes) -> [f64; 5] {
    let limit = classes.background + 0.3 * classes.distance();
    let below: Vec<f64> = z.iter().copied().filter(|&z| z < limit).collect();
    if below.len() < 100 {
        return [0.0; 5];
    }
    let median = median(below).unwrap_or(0.0);
    let mut normal = nalgebra::SMatrix::<f64, 5, 5>::identity() * (0.02 * samples.len() as f64);
    let mut right = nalgebra::SVector::<f64, 5>::zeros();
    for (sample, &z) in samples.iter().zip(z).filter(|(_, z)| **z < limit) {
        let residual = z - median;
        let weight = 1.0 / (1.0 + (residual / 3.0).powi(2));
        let basis = nalgebra::SVector::from(sample.basis());
        normal += basis * basis.transpose() * weight;
        right += basis * (weight * residual);
    }
    normal.cholesky().map_or([0.0; 5], |factor| factor.solve(&right).into())
}

/// Fisher's discriminant of confident pixels of both classes: weight and mean of yellowness.
fn discriminant(samples: &[Sample], z: &[f64], classes: &Classes) -> (f64, f64) {
    let margin = MARGIN * classes.distance();
    let (mut low, mut high) = (Moments::default(), Moments::default());
    let (mut above, mut yellow) = (0.0_f64, 0.0);
    for (sample, &z) in samples.iter().zip(z) {
        let y = f64::from(sample.yellow);
        if z > classes.threshold + margin {
            high.add(z, y);
        } else if z < classes.threshold - margin {
            low.add(z, y);
        }
        if z > classes.threshold {
            above += 1.0;
            yellow += y;
        }
    }
    if low.count < 50.0 || high.count < 50.0 {
        return (0.0, 0.0);
    }
    let ([zz, zy, yy], [hz, hy, hh]) = (low.covariance(), high.covariance());
    let [a, b, c] = [(zz + hz) / 2.0 + 1.0, (zy + hy) / 2.0, (yy + hh) / 2.0 + 1.0];
    let (dz, dy) = (high.mean().0 - low.mean().0, high.mean().1 - low.mean().1);
    let (along, across) = (c * dz - b * dy, a * dy - b * dz);
    let weight = if along > 0.0 { (across / along).clamp(0.0, YELLOW) } else { 0.0 };
    (weight, yellow / above.max(1.0))
}

#[derive(Default)]
struct Moments {
    count: f64,
    sum: (f64, f64),
    squares: [f64; 3],
}

impl Moments {
    fn add(&mut self, z: f64, y: f64) {
        self.count += 1.0;
        self.sum = (self.sum.0 + z, self.sum.1 + y);
        for (sum, value) in self.squares.iter_mut().zip([z * z, z * y, y * y]) {
            *sum += value;
        }
    }

    fn mean(&self) -> (f64, f64) {
        (self.sum.0 / self.count, self.sum.1 / self.count)
    }

    fn covariance(&self) -> [f64; 3] {
        let (z, y) = self.mean();
        let [zz, zy, yy] = self.squares.map(|square| square / self.count);
        [zz - z * z, zy - z * y, yy - y * y]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Samples of a field: a share of leaves, noisy soil, a vignette.
    fn field(share: f64, vignette: f32, noise: f32, leaf: f32) -> Vec<Sample> {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut normal = || (0..12).map(|_| rng.random::<f32>()).sum::<f32>() - 6.0;
        (0..40_000)
            .map(|i| {
                let (x, y) = ((i % 200) as f32 / 99.5 - 1.0, (i / 200) as f32 / 99.5 - 1.0);
                let plant = ((i * 7919) % 10_000) as f64 <= share * 10_000.0 - 1.0;
                let green = if plant { leaf + 3.0 * normal() } else { -3.0 + noise * normal() };
                Sample { x, y, green: green + vignette * (x * x + y * y), yellow: 10.0 + normal() }
            })
            .collect()
    }

    #[test]
    fn threshold_lies_between_the_classes_whatever_their_shares() {
        for share in [0.005, 0.02, 0.2, 0.6, 0.95] {
            let model = Model::fit(&field(share, 0.0, 1.5, 15.0));
            assert!((2.0..9.0).contains(&model.threshold), "{share}: {model:?}");
        }
    }

    #[test]
    fn bare_noisy_soil_is_not_cut_in_two() {
        let samples = field(0.0, 0.0, 3.0, 15.0);
        let model = Model::fit(&samples);
        let above = samples.iter().filter(|s| f64::from(s.green) > model.threshold).count();
        assert!(above < 800, "{above} of {} samples of soil: {model:?}", samples.len());
    }

    #[test]
    fn dark_soil_with_stones_is_not_cut_in_two() {
        // In little light soil is grey and noisy; stones and shade are bluish.
        let mut samples = field(0.003, 0.0, 3.2, 25.0);
        for (k, sample) in samples.iter_mut().enumerate().filter(|(_, sample)| sample.green < 12.0)
        {
            sample.green += 2.5;
            sample.yellow = if k % 12 == 0 { -20.0 } else { sample.yellow };
        }
        let model = Model::fit(&samples);
        let above = samples.iter().filter(|s| f64::from(s.green) > model.threshold).count();
        assert!(above < samples.len() / 6, "{above} of {} samples: {model:?}", samples.len());
    }

    #[test]
    fn vignette_of_colour_is_taken_out() {
        let samples = field(0.02, 5.0, 1.0, 20.0);
        let model = Model::fit(&samples);
        assert!((model.surface[2] - 5.0).abs() < 1.0, "{model:?}");
        let corner = samples[0].basis();
        let row = model.surface_of_row(-1.0);
        assert!((dot(&model.surface, &corner) - (row[0] - row[1] + row[2])).abs() < 1e-9);
    }
}
