//! Tie points straight from geometry: what matching would measure, without rendering a photo.
//!
//! A point belongs to one photo, so that none goes without; it lies on the ground or a little above it where a
//! random pixel of that photo looks, and is measured in some of the photos that see it, at least two: 2 plus a
//! geometric number, most tracks short and some long, as matched features have them.

use crate::{
    camera::Camera,
    check::{ConfigError, within},
    field::Field,
    flight::Shot,
    streams::{Draw, Stage, stream},
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// How many tie points, and how they are measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TiePointConfig {
    /// Tie points for each photo; 0 makes none.
    pub per_photo: usize,
    /// Mean number of photos that a point is measured in, as far as that many see it.
    pub mean_track: f64,
    /// Standard deviation of a point's height above the ground, metres; only heights above it occur.
    pub roughness_m: f64,
    /// Standard deviation of each measured coordinate, pixels.
    pub sigma_px: f64,
    /// Probability that a measurement is gross.
    pub outlier_fraction: f64,
    /// Largest displacement of a gross measurement (the least is a fifth of it), pixels.
    pub outlier_px: f64,
}

impl Default for TiePointConfig {
    fn default() -> TiePointConfig {
        TiePointConfig {
            per_photo: 0,
            mean_track: 3.4,
            roughness_m: 0.03,
            sigma_px: 0.5,
            outlier_fraction: 0.01,
            outlier_px: 40.0,
        }
    }
}

impl TiePointConfig {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("tie_points.per_photo", self.per_photo, 0..=100_000)?;
        within("tie_points.mean_track", self.mean_track, 2.0..=100.0)?;
        within("tie_points.roughness_m", self.roughness_m, 0.0..=2.0)?;
        within("tie_points.sigma_px", self.sigma_px, 0.0..=100.0)?;
        within("tie_points.outlier_fraction", self.outlier_fraction, 0.0..=1.0)?;
        within("tie_points.outlier_px", self.outlier_px, 0.0..=100_000.0)
    }
}

/// A point and its measurements.
#[derive(Debug, Clone, PartialEq)]
pub struct TiePoint {
    /// Where it is, metres.
    pub place_m: [f64; 3],
    /// Its measurements, by photo.
    pub seen: Vec<Sighting>,
}

/// One measurement of a tie point.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// Photo, from 0.
    pub shot: usize,
    /// Measured position, pixels.
    pub measured_px: [f64; 2],
    /// Where it would have been measured without error, pixels.
    pub true_px: [f64; 2],
    /// Whether the measurement is gross.
    pub outlier: bool,
}

/// The tie points of a flight, photo by photo. A photo that shares no ground with another has none.
pub fn measure(
    config: &TiePointConfig,
    field: &Field,
    shots: &[Shot],
    camera: &Camera,
) -> Vec<TiePoint> {
    let [across, along] = camera.half_footprint();
    // Farther than this no photo sees, tilts and low ground included.
    let reach_m: Vec<f64> =
        shots.iter().map(|shot| 1.6 * f64::hypot(across, along) * shot.centre_m[2] + 1.0).collect();
    let count = config.per_photo * shots.len();
    (0..count)
        .into_par_iter()
        .filter_map(|point| place(config, field, shots, camera, &reach_m, point))
        .collect()
}

fn place(
    config: &TiePointConfig,
    field: &Field,
    shots: &[Shot],
    camera: &Camera,
    reach_m: &[f64],
    point: usize,
) -> Option<TiePoint> {
    let seed = field.config.flight_seed();
    let mut rng = stream(seed, Stage::TiePoint, point as u64);
    let owner = point / config.per_photo;
    let (width, height) =
        (f64::from(camera.config().width_px), f64::from(camera.config().height_px));
    for _ in 0..200 {
        let (u, v) = (width * rng.unit() - 0.5, height * rng.unit() - 0.5);
        let above_m = config.roughness_m * rng.normal().abs();
        let (origin, ray) = shots[owner].ray(camera, u, v);
        let Some(reach) = field.terrain.meet(origin, ray, origin[2]) else { continue };
        let mut place_m = [0, 1, 2].map(|i| origin[i] + reach * ray[i]);
        place_m[2] += above_m;
        let mut seen: Vec<(usize, [f64; 2])> = shots
            .iter()
            .enumerate()
            .filter(|(shot, from)| {
                let (dx, dy) = (place_m[0] - from.centre_m[0], place_m[1] - from.centre_m[1]);
                dx * dx + dy * dy <= reach_m[*shot] * reach_m[*shot]
            })
            .filter_map(|(shot, from)| {
                let pixel = from.project(camera, place_m)?;
                camera.inside(pixel, 0.0).then_some((shot, pixel))
            })
            .collect();
        let Some(own) = seen.iter().position(|&(shot, _)| shot == owner) else { continue };
        if seen.len() < 2 {
            continue;
        }
        seen.swap(0, own);
        let extra = config.mean_track - 2.0;
        let stay = extra / (1.0 + extra);
        let more = if extra > 0.0 { ((1.0 - rng.unit()).ln() / stay.ln()) as usize } else { 0 };
        let length = (2 + more).min(seen.len());
        for next in 1..length {
            let other = next + (rng.unit() * (seen.len() - next) as f64) as usize;
            seen.swap(next, other);
        }
        seen.truncate(length);
        seen.sort_by_key(|&(shot, _)| shot);
        let mut noise = stream(seed, Stage::TieNoise, point as u64);
        let mut gross = stream(seed, Stage::TieOutlier, point as u64);
        let seen = seen.into_iter().map(|(shot, true_px)| {
            let mut measured_px = true_px.map(|value| value + config.sigma_px * noise.normal());
            let outlier = gross.unit() < config.outlier_fraction;
            let (direction, far) =
                (gross.between(0.0, std::f64::consts::TAU), gross.between(0.2, 1.0));
            if outlier {
                measured_px[0] += config.outlier_px * far * direction.cos();
                measured_px[1] += config.outlier_px * far * direction.sin();
            }
            Sighting { shot, measured_px, true_px, outlier }
        });
        return Some(TiePoint { place_m, seen: seen.collect() });
    }
    None
}
