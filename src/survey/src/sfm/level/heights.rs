//! Heights of a receiver, or of cameras, over the plan of a flight: a slope, an offset, and an error along the flight.

use nalgebra::{DMatrix, DVector, Matrix2, Vector2};
use rowgram_optim::robust::sigma_of_errors;

/// Degrees of freedom of the prior's heavy tails.
const TAILS: f64 = 6.0;
/// Jumps leave at least this many photos on each side.
const LEAST_SIDE: usize = 2;
/// By how much the score of an error along the flight must be less than that of none: odds of one to some hundreds.
const MARGIN: f64 = 4.0;

/// What is wrong with a receiver's heights along a flight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum HeightError {
    /// Nothing but noise and an offset.
    Constant,
    /// It grows with the place in the flight, metres over the whole flight.
    Drift(f64),
    /// From this place on all are off by so many metres.
    Jump(f64, f64),
}

impl HeightError {
    /// How large it is over the whole flight, metres.
    fn size_m(self) -> f64 {
        match self {
            HeightError::Constant => 0.0,
            HeightError::Drift(metres) | HeightError::Jump(_, metres) => metres.abs(),
        }
    }

    /// The error at a place in the flight, 0 to 1.
    pub(super) fn at(self, place: f64) -> f64 {
        match self {
            HeightError::Constant => 0.0,
            HeightError::Drift(metres) => metres * place,
            HeightError::Jump(from, metres) => f64::from(u8::from(place >= from)) * metres,
        }
    }
}

/// How accurate heights are taken to be.
#[derive(Debug, Clone, Copy)]
pub(super) struct HeightAccuracy {
    /// They agree no better than this, metres.
    pub(super) min_sigma_m: f64,
    /// Smaller errors along the flight are those of the block, metres.
    pub(super) min_error_m: f64,
}

impl Default for HeightAccuracy {
    /// Of a receiver that states nothing.
    fn default() -> HeightAccuracy {
        HeightAccuracy { min_sigma_m: 0.05, min_error_m: 0.0 }
    }
}

/// A slope with its information.
#[derive(Clone, Copy)]
pub(super) struct Slope {
    pub(super) value: Vector2<f64>,
    pub(super) information: Matrix2<f64>,
}

impl Slope {
    /// With an error of all of it that no number of observations makes smaller.
    pub(super) fn with_common_error(self, sigma: f64) -> Slope {
        let more = Matrix2::identity() + sigma * sigma * self.information;
        let information =
            more.try_inverse().map_or(self.information, |less| self.information * less);
        Slope { information: 0.5 * (information + information.transpose()), ..self }
    }

    pub(super) fn and(self, other: Slope) -> Slope {
        let information = self.information + other.information;
        let sum = self.information * self.value + other.information * other.value;
        let value = information.try_inverse().map_or(self.value, |inverse| inverse * sum);
        Slope { value, information }
    }
}

pub(super) fn robust_sigma(values: impl Iterator<Item = f64>, unknowns: usize) -> f64 {
    let values: Vec<f64> = values.collect();
    let n = values.len();
    let share = (n.saturating_sub(unknowns).max(1) as f64 / n.max(1) as f64).sqrt();
    sigma_of_errors(values).unwrap_or(0.0) / share
}

/// A photo's place in the plan and the flight, and a height, metres.
#[derive(Clone, Copy)]
pub(super) struct Sample {
    pub(super) plan: [f64; 2],
    pub(super) place: f64,
    pub(super) height: f64,
}

/// A fit of heights.
pub(super) struct HeightFit {
    pub(super) slope: Vector2<f64>,
    pub(super) information: Matrix2<f64>,
    pub(super) constant: f64,
    pub(super) error: HeightError,
    pub(super) sigma: f64,
    score: f64,
}

fn fit_heights(
    samples: &[Sample],
    prior: Option<Slope>,
    error: HeightError,
    least_sigma_m: f64,
) -> Option<HeightFit> {
    let columns = |sample: &Sample| -> Vec<f64> {
        let mut row = vec![sample.plan[0], sample.plan[1], 1.0];
        match error {
            HeightError::Constant => {}
            HeightError::Drift(_) => row.push(sample.place),
            HeightError::Jump(from, _) => row.push(f64::from(u8::from(sample.place >= from))),
        }
        row
    };
    let rows: Vec<Vec<f64>> = samples.iter().map(columns).collect();
    let (n, p) = (samples.len(), rows.first()?.len());
    let mut x = DVector::zeros(p);
    let mut sigma = f64::INFINITY;
    let mut prior_weight = 1.0;
    let mut normal = DMatrix::zeros(p, p);
    let mut left = vec![0.0_f64; n];
    for round in 0..12 {
        normal = DMatrix::zeros(p, p);
        let mut sum = DVector::zeros(p);
        let scale = if sigma.is_finite() { sigma } else { 1.0 };
        for (k, row) in rows.iter().enumerate() {
            let huber =
                if round == 0 { 1.0 } else { (2.0 * scale / left[k].abs().max(1e-12)).min(1.0) };
            let weight = huber / (scale * scale);
            let row = DVector::from_column_slice(row);
            normal += weight * &row * row.transpose();
            sum += weight * samples[k].height * row;
        }
        if let Some(prior) = prior {
            let known = prior.information * prior.value;
            for i in 0..2 {
                sum[i] += prior_weight * known[i];
                (0..2).for_each(|j| normal[(i, j)] += prior_weight * prior.information[(i, j)]);
            }
        }
        // A strip alone says nothing of the slope across it.
        (0..2).for_each(|k| normal[(k, k)] += 1e-6);
        x = normal.clone().cholesky()?.solve(&sum);
        for (k, row) in rows.iter().enumerate() {
            left[k] = samples[k].height - row.iter().zip(x.iter()).map(|(a, b)| a * b).sum::<f64>();
        }
        sigma = robust_sigma(left.iter().copied(), p - 2).max(least_sigma_m);
        prior_weight = prior.map_or(1.0, |prior| 1.0 / (1.0 + contradiction(&prior, &x) / TAILS));
    }
    let misfit: f64 = left
        .iter()
        .map(|r| {
            let u = r.abs() / sigma;
            if u < 2.0 { u * u } else { 4.0 * u - 4.0 }
        })
        .sum();
    let against = prior.map_or(0.0, |prior| TAILS * (1.0 + contradiction(&prior, &x) / TAILS).ln());
    let more = p - 3;
    let score = 2.0 * n as f64 * sigma.ln() + misfit + against + more as f64 * (n as f64).ln();
    let error = match error {
        HeightError::Constant => HeightError::Constant,
        HeightError::Drift(_) => HeightError::Drift(x[3]),
        HeightError::Jump(from, _) => HeightError::Jump(from, x[3]),
    };
    let information = Matrix2::new(normal[(0, 0)], normal[(0, 1)], normal[(1, 0)], normal[(1, 1)]);
    let slope = Vector2::new(x[0], x[1]);
    Some(HeightFit { slope, information, constant: x[2], error, sigma, score })
}

fn contradiction(prior: &Slope, x: &DVector<f64>) -> f64 {
    let off = Vector2::new(x[0], x[1]) - prior.value;
    off.dot(&(prior.information * off))
}

/// The best of all that may be wrong with heights.
pub(super) fn review_heights(
    samples: &[Sample],
    prior: Slope,
    accuracy: &HeightAccuracy,
) -> Option<HeightFit> {
    let fit = |error| fit_heights(samples, Some(prior), error, accuracy.min_sigma_m);
    let mut best = fit(HeightError::Constant)?;
    let mut candidates = Vec::new();
    if samples.len() >= 5 {
        candidates.push(HeightError::Drift(1.0));
        let mut places: Vec<f64> = samples.iter().map(|sample| sample.place).collect();
        places.sort_by(f64::total_cmp);
        let inner = LEAST_SIDE..places.len() - LEAST_SIDE + 1;
        let every = inner.len().div_ceil(200).max(1);
        candidates.extend(inner.step_by(every).map(|k| HeightError::Jump(places[k], 1.0)));
    }
    for error in candidates {
        if let Some(fit) = fit(error)
            && fit.score + MARGIN < best.score
            && fit.error.size_m() >= accuracy.min_error_m
        {
            best = fit;
        }
    }
    Some(best)
}

/// Slopes of heights over a plan, robustly and without anything known beforehand.
pub(super) fn plane(samples: &[Sample]) -> Option<HeightFit> {
    fit_heights(samples, None, HeightError::Constant, HeightAccuracy::default().min_sigma_m)
}
