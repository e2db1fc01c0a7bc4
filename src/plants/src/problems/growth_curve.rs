//! Growth curves of plots: a trait over the days of a season.
//!
//! ```text
//! min over (ln K, ln r, h)   1/2 sum_i rho( ((y_i - f(t_i; K, r, h)) / s)^2 ),
//!
//! logistic   f = K / (1 + exp(-r (t - h)))
//! Gompertz   f = K 2^(-exp(-r (t - h)))
//! ```
//!
//! `t` days, `K` the final value in the unit of the trait, `r` the rate per day, `h` the day on which half of the final value is
//! reached, the same in both forms. Growth begins where the tangent at the steepest place meets zero: `h - 2/r` for the logistic
//! curve, `h - (1 - ln ln 2)/r` for Gompertz's (the lag of Zwietering et al., Appl. Environ. Microbiol. 56, 1990, 1875-1881).
//!
//! A plot has few dates, so the scatter `s` is common to all plots of a trait: `s^2` is the sum of squared residuals over
//! `sum_p (n_p - 3)`, which also are the degrees of freedom of Student's t in all intervals. A first estimate of it is the
//! median over plots, a value that its plot's robust fit (`rho` of Cauchy) contradicts by more than the same t distribution
//! allows is an outlier, and the final fit is that of least squares to the others.
//!
//! Curves that the dates do not determine have no parameters but a reason ([`Untold`]).

mod robust;
mod search;

use robust::{FirstFits, first_fits, least_scatter};
use rowgram_optim::nlls::{Dual, LinearSolver, Loss, Scalar, covariance::Covariance};
use search::{improve, problem_of, residual_squares};
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, FisherSnedecor, StudentsT};
use std::f64::consts::LN_2;

/// Which form a curve has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GrowthModel {
    /// Symmetric about its steepest place.
    Logistic,
    /// Steepest early, slow towards its end.
    Gompertz,
}

rowgram_base::choices!(GrowthModel: Logistic, Gompertz);

/// A trait of a plot on a day.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// The day.
    pub day: f64,
    /// The value, in the unit of the trait.
    pub value: f64,
}

/// Why a curve has no parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Untold {
    /// There are fewer than four dates with a value.
    TooFewDates,
    /// The values do not grow by more than their scatter.
    NoGrowth,
    /// Growth has not slowed by the last date, or was over by the first: the dates do not determine the curve.
    NotBracketed,
}

rowgram_base::choices!(Untold: TooFewDates, NoGrowth, NotBracketed);

impl Untold {
    /// The reason for a person.
    pub fn reason(self) -> &'static str {
        match self {
            Untold::TooFewDates => "fewer than four dates have a value",
            Untold::NoGrowth => "the values do not grow by more than their scatter",
            Untold::NotBracketed => {
                "growth has not slowed by the last date or was over by the first"
            }
        }
    }
}

/// A number with its standard deviation and 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// The number.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// Lower end of the interval.
    pub low: f64,
    /// Upper end of the interval.
    pub high: f64,
}

/// The curve of one plot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GrowthCurve {
    /// Its form.
    pub model: GrowthModel,
    /// `ln K`, `ln r`, `h`.
    pub parameters: [f64; 3],
    /// Their covariance.
    pub covariance: [[f64; 3]; 3],
    /// Quantile of Student's t of the 95 % intervals.
    pub t95: f64,
    /// Final value, in the unit of the trait.
    pub final_value: Estimate,
    /// Rate, per day.
    pub rate_per_day: Estimate,
    /// Day on which half of the final value is reached.
    pub half_day: Estimate,
    /// Day on which growth begins: the tangent at the steepest place meets zero.
    pub onset_day: Estimate,
    /// Which of the samples are outliers, by their place in the series.
    pub outliers: Vec<usize>,
}

/// The curves of all plots for one trait.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GrowthFits {
    /// Their form.
    pub model: GrowthModel,
    /// Standard deviation of a value about its curve, common to all plots; `None` where no plot has a curve.
    pub scatter: Option<f64>,
    /// Degrees of freedom of that standard deviation.
    pub degrees_of_freedom: usize,
    /// The curve of each series, or why there is none.
    pub curves: Vec<Result<GrowthCurve, Untold>>,
}

/// Fewest dates of a curve: one more than it has parameters.
const MIN_DATES: usize = 4;
/// A final value whose logarithm is less sure than this is none: its 95 % interval spans a factor of four.
const MAX_LOG_SIGMA: f64 = 0.35;
/// One good series in a hundred loses a value to the test for outliers.
const OUTLIER_LEVEL: f64 = 0.01;
/// Level of the test of growth against none.
const GROWTH_LEVEL: f64 = 0.99;
/// Beyond this many time constants before the half day a curve is zero.
const LONGEST: f64 = 40.0;

impl GrowthModel {
    /// `f` at a day, over numbers with derivatives.
    fn value<T: Scalar>(self, [ln_final, ln_rate, half]: [T; 3], day: f64) -> T {
        let z = (-half + day) * ln_rate.exp();
        if z.value() < -LONGEST {
            return T::constant(0.0);
        }
        match self {
            GrowthModel::Logistic => ln_final.exp() / ((-z).exp() + 1.0),
            GrowthModel::Gompertz => (ln_final - (-z).exp() * LN_2).exp(),
        }
    }

    /// From the half day back to the onset, time constants `1/r`.
    fn lag(self) -> f64 {
        match self {
            GrowthModel::Logistic => 2.0,
            GrowthModel::Gompertz => 1.0 - LN_2.ln(),
        }
    }
}

impl GrowthCurve {
    /// The curve on a day, and its standard deviation.
    pub fn at(&self, day: f64) -> [f64; 2] {
        let found = dual(self.model, &self.parameters, day);
        [found.value, quadratic(&found.derivatives, &self.covariance).max(0.0).sqrt()]
    }
}

fn dual(model: GrowthModel, parameters: &[f64; 3], day: f64) -> Dual<3> {
    model.value(std::array::from_fn(|k| Dual::variable(parameters[k], k)), day)
}

fn quadratic(g: &[f64; 3], c: &[[f64; 3]; 3]) -> f64 {
    (0..3).map(|i| (0..3).map(|j| g[i] * c[i][j] * g[j]).sum::<f64>()).sum()
}

/// Fits a curve to each series; without a form the one that all series together are nearer to.
pub fn fit(series: &[Vec<Sample>], model: Option<GrowthModel>) -> GrowthFits {
    let Some(model) = model else {
        let both =
            [GrowthModel::Logistic, GrowthModel::Gompertz].map(|model| first_fits(series, model));
        let scatter = both.iter().filter_map(|fits| fits.scatter).fold(f64::INFINITY, f64::min);
        let [logistic, gompertz] = both.each_ref().map(|fits| fits.cost(series, scatter));
        let [first, second] = both;
        let better = if gompertz < logistic { second } else { first };
        return better.finish(series);
    };
    first_fits(series, model).finish(series)
}

/// A series without its outliers, and its curve by least squares.
struct Trimmed {
    outliers: Vec<usize>,
    kept: Vec<Sample>,
    parameters: [f64; 3],
}

impl FirstFits {
    /// Takes out outliers, fits the rest by least squares, and estimates the scatter again.
    fn finish(self, series: &[Vec<Sample>]) -> GrowthFits {
        let model = self.model;
        let Some(scatter) = self.scatter else {
            let curves =
                self.found.into_iter().map(|found| Err(found.err().unwrap_or(Untold::NoGrowth)));
            return GrowthFits {
                model,
                scatter: None,
                degrees_of_freedom: 0,
                curves: curves.collect(),
            };
        };
        let freedom: usize = series
            .iter()
            .zip(&self.found)
            .filter(|(_, found)| found.is_ok())
            .map(|(samples, _)| samples.len() - 3)
            .sum();
        let mut fits: Vec<Result<Trimmed, Untold>> = Vec::new();
        for (samples, found) in series.iter().zip(self.found) {
            fits.push(found.map(|parameters| {
                let outliers = outliers(model, samples, &parameters, scatter, freedom);
                let kept: Vec<Sample> = (0..samples.len())
                    .filter(|k| !outliers.contains(k))
                    .map(|k| samples[k])
                    .collect();
                let end = improve(model, &kept, scatter, Loss::Trivial, &parameters);
                Trimmed { outliers, kept, parameters: end.unwrap_or(parameters) }
            }));
        }
        let (mut squares, mut freedom) = (0.0, 0);
        for Trimmed { kept, parameters, .. } in fits.iter().flatten() {
            squares += residual_squares(model, kept, parameters);
            freedom += kept.len() - 3;
        }
        let scatter = (squares / freedom.max(1) as f64).sqrt().max(least_scatter(series));
        let t95 =
            StudentsT::new(0.0, 1.0, freedom.max(1) as f64).map_or(1.96, |t| t.inverse_cdf(0.975));
        let curves = fits
            .into_iter()
            .map(|fit| {
                let Trimmed { outliers, kept, parameters } = fit?;
                curve(model, &kept, parameters, outliers, [scatter, freedom as f64, t95])
            })
            .collect();
        GrowthFits { model, scatter: Some(scatter), degrees_of_freedom: freedom, curves }
    }
}

fn covariance_of(
    model: GrowthModel,
    samples: &[Sample],
    parameters: &[f64; 3],
    scatter: f64,
) -> Option<[[f64; 3]; 3]> {
    let (problem, block) = problem_of(model, samples, scatter, Loss::Trivial, parameters)?;
    let x = problem.start();
    let flat = Covariance::new(&problem, &x, LinearSolver::Dense).ok()?.block(block);
    let finite = flat.iter().all(|value| value.is_finite());
    finite.then(|| std::array::from_fn(|i| std::array::from_fn(|j| flat[3 * i + j])))
}

/// Values that are too far from the robust curve, as long as enough are left.
fn outliers(
    model: GrowthModel,
    samples: &[Sample],
    parameters: &[f64; 3],
    scatter: f64,
    freedom: usize,
) -> Vec<usize> {
    let covariance = covariance_of(model, samples, parameters, scatter);
    let limit = StudentsT::new(0.0, 1.0, freedom.max(1) as f64)
        .map_or(f64::INFINITY, |t| t.inverse_cdf(1.0 - 0.5 * OUTLIER_LEVEL / samples.len() as f64));
    let mut far: Vec<(f64, usize)> = samples
        .iter()
        .enumerate()
        .filter_map(|(k, sample)| {
            let found = dual(model, parameters, sample.day);
            let share =
                covariance.map_or(0.0, |c| quadratic(&found.derivatives, &c) / (scatter * scatter));
            // The robust curve hardly follows an outlier, so what it would take of a good value is at most added here.
            let off =
                (sample.value - found.value).abs() / scatter / (1.0 + share.clamp(0.0, 1.0)).sqrt();
            (off > limit).then_some((off, k))
        })
        .collect();
    far.sort_unstable_by(|a, b| b.0.total_cmp(&a.0));
    far.truncate(samples.len() - MIN_DATES);
    let mut outliers: Vec<usize> = far.into_iter().map(|(_, k)| k).collect();
    outliers.sort_unstable();
    outliers
}

fn curve(
    model: GrowthModel,
    samples: &[Sample],
    parameters: [f64; 3],
    outliers: Vec<usize>,
    [scatter, freedom, t95]: [f64; 3],
) -> Result<GrowthCurve, Untold> {
    let mean = samples.iter().map(|s| s.value).sum::<f64>() / samples.len() as f64;
    let without: f64 = samples.iter().map(|s| (s.value - mean).powi(2)).sum();
    let gained = (without - residual_squares(model, samples, &parameters)) / 2.0;
    let limit = FisherSnedecor::new(2.0, freedom.max(1.0))
        .map_or(f64::INFINITY, |f| f.inverse_cdf(GROWTH_LEVEL));
    if gained <= limit * scatter * scatter {
        return Err(Untold::NoGrowth);
    }
    let covariance =
        covariance_of(model, samples, &parameters, scatter).ok_or(Untold::NotBracketed)?;
    let sigma = |k: usize| f64::max(covariance[k][k], 0.0).sqrt();
    let days = || samples.iter().map(|s| s.day);
    let span = days().fold(f64::NEG_INFINITY, f64::max) - days().fold(f64::INFINITY, f64::min);
    if sigma(0) > MAX_LOG_SIGMA || sigma(2) > 0.5 * span {
        return Err(Untold::NotBracketed);
    }
    let [ln_final, ln_rate, half] = parameters;
    let of_log = |ln: f64, sigma: f64| Estimate {
        value: ln.exp(),
        sigma: ln.exp() * sigma,
        low: (ln - t95 * sigma).exp(),
        high: (ln + t95 * sigma).exp(),
    };
    let plain = |value: f64, sigma: f64| Estimate {
        value,
        sigma,
        low: value - t95 * sigma,
        high: value + t95 * sigma,
    };
    let lag_days = model.lag() / ln_rate.exp();
    // d onset / d (ln K, ln r, h) = (0, lag / r, 1).
    let onset_sigma = quadratic(&[0.0, lag_days, 1.0], &covariance).max(0.0).sqrt();
    Ok(GrowthCurve {
        model,
        parameters,
        covariance,
        t95,
        final_value: of_log(ln_final, sigma(0)),
        rate_per_day: of_log(ln_rate, sigma(1)),
        half_day: plain(half, sigma(2)),
        onset_day: plain(half - lag_days, onset_sigma),
        outliers,
    })
}

#[cfg(test)]
mod tests;
