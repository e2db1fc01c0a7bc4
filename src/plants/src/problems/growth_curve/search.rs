//! The curve of one series: starts on a grid, the best of them improved by the engine.
//!
//! ```text
//! min over (ln K, ln r, h)   1/2 sum_i rho( ((y_i - f(t_i; K, r, h)) / s)^2 )
//! ```
//!
//! For a rate and a half day of the grid, `K` follows from the values by linear least squares, or as the median of what they say
//! one by one. Symbols as in [`super`].

use super::{GrowthModel, Sample, Untold};
use rowgram_optim::nlls::{
    self, Euclidean, Infeasible, Loss, Options, Problem, Residual, Residuals, Scalar, Vector,
};
use rowgram_optim::robust::median;

const STEPS: u64 = 100;

/// One value as a residual, in standard deviations.
pub(super) struct Deviation {
    pub(super) model: GrowthModel,
    pub(super) sample: Sample,
    pub(super) sigma: f64,
}

impl Residual<1> for Deviation {
    type Blocks = (Vector<3>,);

    fn evaluate<T: Scalar>(&self, (parameters,): ([T; 3],)) -> Result<[T; 1], Infeasible> {
        let found = self.model.value(parameters, self.sample.day);
        let off = (found - self.sample.value) / self.sigma;
        if off.value().is_finite() { Ok([off]) } else { Err(Infeasible) }
    }
}

/// The problem of one series.
pub(super) fn problem_of(
    model: GrowthModel,
    samples: &[Sample],
    sigma: f64,
    loss: Loss,
    start: &[f64; 3],
) -> Option<(Problem, nlls::BlockId)> {
    let mut problem = Problem::new();
    let block = problem.block("curve", Euclidean(3), start).ok()?;
    let residuals = samples.iter().map(|&sample| ([block], Deviation { model, sample, sigma }));
    problem.add("values", loss, Residuals::new(residuals)).ok()?;
    Some((problem, block))
}

/// Sum of squared residuals.
pub(super) fn residual_squares(
    model: GrowthModel,
    samples: &[Sample],
    parameters: &[f64; 3],
) -> f64 {
    samples.iter().map(|s| (s.value - model.value(*parameters, s.day)).powi(2)).sum()
}

/// The best parameters from a start.
pub(super) fn improve(
    model: GrowthModel,
    samples: &[Sample],
    sigma: f64,
    loss: Loss,
    start: &[f64; 3],
) -> Option<[f64; 3]> {
    let (problem, block) = problem_of(model, samples, sigma, loss, start)?;
    let mut x = problem.start();
    nlls::solve(&problem, &mut x, &Options::default(), STEPS).ok()?;
    let found = problem.values(&x, block);
    let found: [f64; 3] = found.try_into().ok()?;
    found.iter().all(|value| value.is_finite()).then_some(found)
}

/// Starts that are improved.
const BEST_STARTS: usize = 4;

/// Sum of the losses of all values.
pub(super) fn robust_cost(
    model: GrowthModel,
    samples: &[Sample],
    (sigma, loss): (f64, Loss),
    parameters: &[f64; 3],
) -> f64 {
    let rho = |s: &Sample| {
        let off = (s.value - model.value(*parameters, s.day)) / sigma;
        loss.evaluate(off * off).value
    };
    samples.iter().map(rho).sum()
}

/// The best curve from a grid of starts, values having a standard deviation and a loss.
pub(super) fn search(
    model: GrowthModel,
    samples: &[Sample],
    (sigma, loss): (f64, Loss),
) -> Result<[f64; 3], Untold> {
    let days = || samples.iter().map(|sample| sample.day);
    let (first, last) =
        (days().fold(f64::INFINITY, f64::min), days().fold(f64::NEG_INFINITY, f64::max));
    let span = last - first;
    let largest = largest(samples);
    if !(span > 0.0 && largest > 0.0) {
        return Err(Untold::NoGrowth);
    }
    let cost = |parameters: &[f64; 3]| robust_cost(model, samples, (sigma, loss), parameters);
    let mut starts: Vec<(f64, [f64; 3])> = Vec::new();
    for step in -2..=14 {
        let half = first + span * f64::from(step) / 12.0;
        for rate in [2.0, 4.0, 8.0, 16.0, 32.0, 64.0].map(|rate| (rate / span).ln()) {
            let shape: Vec<(f64, f64)> =
                samples.iter().map(|s| (s.value, model.value([0.0, rate, half], s.day))).collect();
            let (yf, ff) =
                shape.iter().fold((0.0, 0.0), |(yf, ff), (y, f)| (yf + y * f, ff + f * f));
            // By least squares, and by the median of what the values say one by one, which a wrong one does not move.
            let median = median(shape.iter().filter(|(_, f)| *f > 0.1).map(|(y, f)| y / f));
            for last in [(ff > 0.0).then(|| yf / ff), median].into_iter().flatten() {
                if last > 0.0 {
                    let start = [last.ln(), rate, half];
                    starts.push((cost(&start), start));
                }
            }
        }
    }
    starts.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let ends = starts.iter().take(BEST_STARTS).filter_map(|(_, start)| {
        let end = improve(model, samples, sigma, loss, start)?;
        Some((cost(&end), end))
    });
    ends.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, end)| end).ok_or(Untold::NotBracketed)
}

/// The largest value, at least 0.
pub(super) fn largest(samples: &[Sample]) -> f64 {
    samples.iter().map(|sample| sample.value).fold(0.0, f64::max)
}
