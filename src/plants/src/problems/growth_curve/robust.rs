//! Robust curves of all series, and the first estimate of their common scatter.
//!
//! The scatter comes from the median over plots of what least squares leaves, of fewer than five plots from the mean; where the
//! residuals of the robust curves have a much smaller median, it is lowered towards that. Symbols as in [`super`].

use super::{
    GrowthModel, MIN_DATES, Sample, Untold,
    search::{improve, largest, residual_squares, robust_cost, search},
};
use rowgram_optim::nlls::Loss;
use rowgram_optim::robust::median;
use statrs::distribution::{ChiSquared, ContinuousCDF};

/// Scale of the robust loss, standard deviations: 95 % of the efficiency of least squares on normal errors (Holland and
/// Welsch, Commun. Stat. A6, 1977).
const CAUCHY_SCALE: f64 = 2.385;
/// A scatter of more than this many times what the median of the residuals says comes from wrong values.
const CONTAMINATED: f64 = 2.0;

/// The robust fits, and the first estimate of the scatter.
pub(super) struct FirstFits {
    pub(super) model: GrowthModel,
    pub(super) found: Vec<Result<[f64; 3], Untold>>,
    pub(super) scatter: Option<f64>,
}

impl FirstFits {
    /// Robust cost of all series at a common scatter.
    pub(super) fn cost(&self, series: &[Vec<Sample>], scatter: f64) -> f64 {
        let loss = (scatter, Loss::Cauchy(CAUCHY_SCALE));
        let of_series = |(samples, fitted): (&Vec<Sample>, &Result<[f64; 3], Untold>)| {
            fitted.as_ref().map_or(0.0, |found| robust_cost(self.model, samples, loss, found))
        };
        series.iter().zip(&self.found).map(of_series).sum()
    }
}

/// Fits a robust curve of one form to each series.
pub(super) fn first_fits(series: &[Vec<Sample>], model: GrowthModel) -> FirstFits {
    let mut found: Vec<Result<[f64; 3], Untold>> = series
        .iter()
        .map(|samples| {
            if samples.len() < MIN_DATES {
                return Err(Untold::TooFewDates);
            }
            search(model, samples, (0.05 * largest(samples), Loss::Trivial))
        })
        .collect();
    let mut variances = Vec::new();
    let (mut squares, mut freedom) = (0.0, 0);
    for (samples, fitted) in series.iter().zip(&found) {
        let Ok(parameters) = fitted else { continue };
        let of_plot = residual_squares(model, samples, parameters);
        let degrees = samples.len() - 3;
        variances.push(of_plot / degrees as f64);
        squares += of_plot;
        freedom += degrees;
    }
    if variances.is_empty() {
        return FirstFits { model, found, scatter: None };
    }
    let mean = squares / freedom as f64;
    // The median is not moved by plots with a wrong value; of a few plots it says too little.
    let degrees = freedom as f64 / variances.len() as f64;
    let variance = match ChiSquared::new(degrees) {
        Ok(spread) if variances.len() >= 5 => {
            median(variances.iter().copied()).unwrap_or(mean) * degrees / spread.inverse_cdf(0.5)
        }
        _ => mean,
    };
    let least = least_scatter(series);
    let mut scatter = variance.sqrt().max(least);
    refine(model, series, &mut found, scatter);
    // Of few plots one wrong value makes all of the variance; the median of the residuals of robust curves does not follow it.
    while let Some(typical) = typical_residual(model, series, &found, freedom)
        && scatter > CONTAMINATED * typical.max(least)
    {
        scatter = typical.max(least).max(0.25 * scatter);
        refine(model, series, &mut found, scatter);
    }
    FirstFits { model, found, scatter: Some(scatter) }
}

/// The scatter that rounding alone makes: of counts that of whole numbers, of other values next to none.
pub(super) fn least_scatter(series: &[Vec<Sample>]) -> f64 {
    let highest = series.iter().map(|samples| largest(samples)).fold(0.0, f64::max);
    let whole = series.iter().flatten().all(|sample| sample.value.fract() == 0.0);
    // The standard deviation of a number that is even over one unit.
    let counts = if whole { 1.0 / 12.0_f64.sqrt() } else { 0.0 };
    counts.max(1e-9 * highest)
}

/// Robust fits at this scatter. Least squares may have gone after a wrong value, so each begins anew, and from there too.
fn refine(
    model: GrowthModel,
    series: &[Vec<Sample>],
    found: &mut [Result<[f64; 3], Untold>],
    scatter: f64,
) {
    let loss = (scatter, Loss::Cauchy(CAUCHY_SCALE));
    for (samples, fitted) in series.iter().zip(found) {
        if let Ok(parameters) = fitted {
            let near = improve(model, samples, scatter, loss.1, parameters);
            let ends = [near, search(model, samples, loss).ok()].into_iter().flatten();
            let cost = |end: &[f64; 3]| robust_cost(model, samples, loss, end);
            if let Some(best) = ends.min_by(|a, b| cost(a).total_cmp(&cost(b))) {
                *parameters = best;
            }
        }
    }
}

/// Standard deviation from the median of all residuals, corrected for the parameters; `None` without any.
fn typical_residual(
    model: GrowthModel,
    series: &[Vec<Sample>],
    found: &[Result<[f64; 3], Untold>],
    freedom: usize,
) -> Option<f64> {
    let mut residuals: Vec<f64> = Vec::new();
    for (samples, fitted) in series.iter().zip(found) {
        if let Ok(parameters) = fitted {
            residuals
                .extend(samples.iter().map(|s| (s.value - model.value(*parameters, s.day)).abs()));
        }
    }
    let count = residuals.len() as f64;
    // Half of normal residuals are below 0.6745 standard deviations.
    let sigma = median(residuals)? / 0.6745;
    (freedom > 0).then(|| sigma * (count / freedom as f64).sqrt())
}
