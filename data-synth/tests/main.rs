//! Closed loops over the public interface, one module per subject.

#![allow(clippy::unwrap_used, reason = "a test that fails may panic")]

mod block;
mod corruption;
mod field;
mod files;
mod first_surface;
mod flight;
mod habit;
mod photo;
mod threads;
mod tie_points;

/// Mean and standard deviation.
fn moments(values: &[f64]) -> (f64, f64) {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>();
    (mean, (variance / values.len() as f64).sqrt())
}

/// Whether `found` lies within `deviations` standard errors of a binomial proportion.
fn proportion_agrees(found: usize, of: usize, expected: f64, deviations: f64) -> bool {
    let error = (expected * (1.0 - expected) / of as f64).sqrt();
    (found as f64 / of as f64 - expected).abs() <= deviations * error
}
