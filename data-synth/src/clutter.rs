//! What lies on the ground: crop residue and stones.
//!
//! Every square metre of the mapping frame has its own, from a stream of its own, so that they lie wherever a
//! photo looks and are the same in all photos.

use crate::{
    check::{ConfigError, within},
    streams::{Draw, Stage, stream},
};
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// How much lies on the ground.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ClutterConfig {
    /// Pieces of straw and stalk per square metre.
    pub residue_per_m2: f64,
    /// Stones and clods per square metre.
    pub stones_per_m2: f64,
}

impl Default for ClutterConfig {
    fn default() -> ClutterConfig {
        ClutterConfig { residue_per_m2: 6.0, stones_per_m2: 8.0 }
    }
}

impl ClutterConfig {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("clutter.residue_per_m2", self.residue_per_m2, 0.0..=500.0)?;
        within("clutter.stones_per_m2", self.stones_per_m2, 0.0..=500.0)
    }
}

/// A straight piece of straw.
pub(crate) struct Residue {
    pub(crate) middle_m: [f64; 2],
    pub(crate) azimuth_rad: f64,
    pub(crate) length_m: f64,
    pub(crate) width_m: f64,
    /// How far one end lies above the other, metres.
    pub(crate) rise_m: f64,
    pub(crate) brightness: f64,
}

/// A stone: a low dome.
pub(crate) struct Stone {
    pub(crate) middle_m: [f64; 2],
    pub(crate) radius_m: f64,
    pub(crate) height_m: f64,
    pub(crate) turn_rad: f64,
    pub(crate) brightness: f64,
}

/// The item number of a square metre, for positions within 8000 km.
fn cell(x: i64, y: i64) -> u64 {
    let part = |value: i64| (value + (1 << 23)) as u64 & 0xff_ffff;
    (part(x) << 24) | part(y)
}

impl ClutterConfig {
    /// The straw of the square metre whose lower left corner is (`x`, `y`).
    pub(crate) fn residue(&self, seed: u64, x: i64, y: i64) -> Vec<Residue> {
        if self.residue_per_m2 == 0.0 {
            return Vec::new();
        }
        let mut rng = stream(seed, Stage::Residue, cell(x, y));
        let count = count(self.residue_per_m2, rng.unit(), rng.normal());
        (0..count)
            .map(|_| {
                let middle_m = [x as f64 + rng.unit(), y as f64 + rng.unit()];
                // Mostly short pieces, now and then a long one.
                let length_m = 0.02 + 0.18 * rng.unit().powi(3);
                Residue {
                    middle_m,
                    azimuth_rad: rng.between(0.0, TAU),
                    length_m,
                    width_m: rng.between(0.003, 0.011),
                    rise_m: 0.3 * length_m * rng.unit() * rng.unit(),
                    brightness: rng.between(0.55, 1.15),
                }
            })
            .collect()
    }

    /// The stones of the square metre whose lower left corner is (`x`, `y`).
    pub(crate) fn stones(&self, seed: u64, x: i64, y: i64) -> Vec<Stone> {
        if self.stones_per_m2 == 0.0 {
            return Vec::new();
        }
        let mut rng = stream(seed, Stage::Stone, cell(x, y));
        let count = count(self.stones_per_m2, rng.unit(), rng.normal());
        (0..count)
            .map(|_| {
                let middle_m = [x as f64 + rng.unit(), y as f64 + rng.unit()];
                let radius_m = 0.008 + 0.035 * rng.unit().powi(3);
                Stone {
                    middle_m,
                    radius_m,
                    height_m: radius_m * rng.between(0.4, 1.0),
                    turn_rad: rng.between(0.0, TAU),
                    brightness: rng.between(0.7, 1.4),
                }
            })
            .collect()
    }
}

/// About a Poisson number: mean and variance are the density.
fn count(density: f64, unit: f64, normal: f64) -> usize {
    (density + density.sqrt() * normal + unit).floor().max(0.0) as usize
}
