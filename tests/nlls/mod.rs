//! The least-squares engine: what its documentation promises, promise by promise.

mod bundle;
mod covariance;
mod engine;
pub mod toys;
