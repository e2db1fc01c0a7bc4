//! The least-squares engine: what its documentation promises, promise by promise.

mod bundle;
mod covariance;
mod engine;
mod residuals;
pub mod toys;
