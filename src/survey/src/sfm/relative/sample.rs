//! Random sampling with local optimisation: a model from few data, judged by all.
//!
//! Score: `sum_k max(0, 1 - d_k^2 / t^2)` (MSAC). A hypothesis that fits only roughly, because what it
//! assumes is only roughly so, is found by a loose tolerance, one among many wrong data by a tight
//! one; so the best by any of several tolerances is refined. Sampling ends when a sample without an outlier has been
//! drawn with the wanted confidence, given the share of inliers found so far. Every draw comes from
//! the generator that is passed in. References: M. Fischler and R. Bolles, CACM 24(6), 1981; O. Chum,
//! J. Matas and J. Kittler, *Locally optimized RANSAC*, DAGM 2003.

use rand::{Rng, RngExt};

/// What is sampled.
pub trait Samples {
    /// A hypothesis.
    type Model: Clone;
    /// How many data decide one.
    const SIZE: usize;

    /// How many data there are.
    fn count(&self) -> usize;

    /// All models of a sample of `SIZE` different data.
    fn solve(&self, sample: &[usize], out: &mut Vec<Self::Model>);

    /// The squared distance of a datum from a model; infinite where it cannot be.
    fn squared_distance(&self, model: &Self::Model, datum: usize) -> f64;

    /// A better model from the data near one, and the squared tolerance within which they were
    /// looked for; `None` where it cannot be improved.
    fn refine(&self, model: &Self::Model, squared_tolerance: f64) -> Option<Self::Model>;
}

/// How it is sampled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sampling {
    /// Distance up to which a datum is an inlier, in the unit of the distances.
    pub tolerance: f64,
    /// How many times that a hypothesis that is not yet refined may be off.
    pub coarse: f64,
    /// Probability with which a sample without an outlier is among those drawn.
    pub confidence: f64,
    /// The fewest samples.
    pub least: usize,
    /// The most samples.
    pub most: usize,
}

/// The best model found.
#[derive(Debug, Clone, PartialEq)]
pub struct Sampled<M> {
    /// The model.
    pub model: M,
    /// Its score within the tolerance.
    pub score: f64,
    /// Its inliers, ascending.
    pub inliers: Vec<u32>,
    /// How many samples were drawn.
    pub samples: usize,
}

fn score<S: Samples>(data: &S, model: &S::Model, squared_tolerance: f64) -> f64 {
    (0..data.count())
        .map(|k| (1.0 - data.squared_distance(model, k) / squared_tolerance).max(0.0))
        .sum()
}

/// Tolerances by which hypotheses are judged before they are refined.
const SCALES: usize = 3;

fn scores<S: Samples>(data: &S, model: &S::Model, squared: &[f64; SCALES]) -> [f64; SCALES] {
    let mut sums = [0.0; SCALES];
    for k in 0..data.count() {
        let distance = data.squared_distance(model, k);
        for (sum, squared) in sums.iter_mut().zip(squared) {
            *sum += (1.0 - distance / squared).max(0.0);
        }
    }
    sums
}

fn count<S: Samples>(data: &S, model: &S::Model, squared_tolerance: f64) -> usize {
    (0..data.count()).filter(|&k| data.squared_distance(model, k) <= squared_tolerance).count()
}

/// Refines a hypothesis from the coarse to the fine tolerance.
fn polish<S: Samples>(data: &S, start: &S::Model, sampling: &Sampling) -> S::Model {
    let mut model = start.clone();
    let mut factor = sampling.coarse.max(1.0);
    loop {
        let squared = (factor * sampling.tolerance).powi(2);
        match data.refine(&model, squared) {
            Some(better) if score(data, &better, squared) >= score(data, &model, squared) => {
                model = better;
            }
            _ => {}
        }
        if factor <= 1.0 {
            return model;
        }
        factor = (0.4 * factor).max(1.0);
    }
}

/// Samples; `None` where there are too few data or no sample gives a model.
pub fn sample<S: Samples>(
    data: &S,
    sampling: &Sampling,
    rng: &mut impl Rng,
) -> Option<Sampled<S::Model>> {
    let n = data.count();
    if n < S::SIZE {
        return None;
    }
    let fine = sampling.tolerance * sampling.tolerance;
    let factors = [sampling.coarse, sampling.coarse.sqrt(), 1.0];
    let scales: [f64; SCALES] = factors.map(|factor| fine * factor.max(1.0).powi(2));
    let mut best: Option<(f64, S::Model)> = None;
    let mut best_at = [0.0; SCALES];
    let mut needed = sampling.most;
    let mut samples = 0;
    let mut drawn = vec![0usize; S::SIZE];
    let mut models = Vec::new();
    while samples < needed.clamp(sampling.least.min(sampling.most), sampling.most) {
        samples += 1;
        draw(&mut drawn, n, rng);
        models.clear();
        data.solve(&drawn, &mut models);
        for model in &models {
            let found = scores(data, model, &scales);
            if (0..SCALES).all(|k| found[k] <= best_at[k]) {
                continue;
            }
            best_at = std::array::from_fn(|k| found[k].max(best_at[k]));
            let polished = polish(data, model, sampling);
            let found = score(data, &polished, fine);
            if best.as_ref().is_none_or(|(most, _)| found > *most) {
                let share = count(data, &polished, fine) as f64 / n as f64;
                best = Some((found, polished));
                needed = samples_needed(share, S::SIZE, sampling.confidence);
            }
        }
    }
    let (score, model) = best?;
    let inliers =
        (0..n).filter(|&k| data.squared_distance(&model, k) <= fine).map(|k| k as u32).collect();
    Some(Sampled { model, score, inliers, samples })
}

/// How many samples of `size` have none but inliers with this confidence.
pub fn samples_needed(share: f64, size: usize, confidence: f64) -> usize {
    let all = share.powi(size as i32);
    if all >= 1.0 - 1e-12 {
        return 1;
    }
    let needed = (1.0 - confidence).ln() / (-all).ln_1p();
    if needed.is_finite() { needed.ceil().max(1.0) as usize } else { usize::MAX }
}

/// Different numbers below `n`.
fn draw(out: &mut [usize], n: usize, rng: &mut impl Rng) {
    for k in 0..out.len() {
        loop {
            let next = rng.random_range(0..n);
            if !out[..k].contains(&next) {
                out[k] = next;
                break;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_number_of_samples_is_the_textbook_one() {
        // Fischler and Bolles: half outliers, samples of two and of five, 99 %.
        assert_eq!(samples_needed(0.5, 2, 0.99), 17);
        assert_eq!(samples_needed(0.5, 5, 0.99), 146);
        assert_eq!(samples_needed(1.0, 5, 0.99), 1);
        assert_eq!(samples_needed(0.0, 5, 0.99), usize::MAX);
    }
}
