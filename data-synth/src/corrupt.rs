//! What corrupts a field's picture, apart from what is true: weeds, false pixels, missed pixels.
//!
//! Weeds are things of their own, drawn with the leaves; false and missed pixels are errors of the
//! segmentation, made on the finished mask. With mask `Y`, a pixel with `Y = 0` becomes 1 with the
//! false fraction and one with `Y = 1` becomes 0 with the missed fraction, each pixel on its own.
//! None of them touches the plants.

use crate::{
    check::{ConfigError, within},
    field::Field,
    leaf::{self, Leaf, Shape},
    picture,
    streams::{Draw, Stage, stream},
};
use image::{GrayImage, RgbImage};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::f64::consts::{PI, TAU};

/// How a field's picture is corrupted; nothing by default.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Corruption {
    /// Weeds per square metre of the picture.
    pub weeds_per_m2: f64,
    /// Share of the weeds that are grasses, whose leaves have axes as the crop's do; the others are
    /// broad-leaved rosettes.
    pub grass_share: f64,
    /// Probability that a pixel that shows no leaf is taken for one.
    pub false_fraction: f64,
    /// Probability that a leaf pixel is not taken for one.
    pub missed_fraction: f64,
}

/// A weed: a small rosette or a tuft of grass.
#[derive(Debug, Clone, PartialEq)]
pub struct Weed {
    /// Whether it is a grass.
    pub grass: bool,
    /// Its middle, X in metres.
    pub x_m: f64,
    /// Its middle, Y in metres.
    pub y_m: f64,
    /// Its leaves.
    pub leaves: Vec<Leaf>,
}

impl Corruption {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("weeds_per_m2", self.weeds_per_m2, 0.0..=1000.0)?;
        within("grass_share", self.grass_share, 0.0..=1.0)?;
        within("false_fraction", self.false_fraction, 0.0..=1.0)?;
        within("missed_fraction", self.missed_fraction, 0.0..=1.0)
    }

    /// The weeds of a field: density times area, to the nearest whole number, anywhere in its frame.
    pub fn weeds(&self, field: &Field) -> Vec<Weed> {
        let frame = &field.frame;
        let area_m2 =
            f64::from(frame.width_px) * f64::from(frame.height_px) * frame.gsd_m * frame.gsd_m;
        let count = (self.weeds_per_m2 * area_m2).round() as u64;
        (0..count).into_par_iter().map(|weed| grow_weed(field, weed, self.grass_share)).collect()
    }

    /// Makes the false and missed pixels in a mask (255 leaf, 0 not) and, where given, in the
    /// picture that belongs to it, which must have the same size.
    pub fn spoil_pixels(&self, seed: u64, mask: &mut GrayImage, picture: Option<&mut RgbImage>) {
        if self.false_fraction == 0.0 && self.missed_fraction == 0.0 {
            return;
        }
        let width = mask.width().max(1) as usize;
        let spoil = |(v, (mask, mut picture)): (usize, (&mut [u8], Option<&mut [u8]>))| {
            let mut false_rng = stream(seed, Stage::FalsePixel, v as u64);
            let mut missed_rng = stream(seed, Stage::MissedPixel, v as u64);
            for (u, pixel) in mask.iter_mut().enumerate() {
                let (appears, is_lost) = (false_rng.unit(), missed_rng.unit());
                let leaf = *pixel != 0;
                let lost = leaf && is_lost < self.missed_fraction;
                let gained = !leaf && appears < self.false_fraction;
                if !(lost || gained) {
                    continue;
                }
                *pixel = if gained { 255 } else { 0 };
                if let Some(colour) = picture.as_mut().and_then(|row| row.get_mut(3 * u..3 * u + 3))
                {
                    colour.copy_from_slice(&picture::mistaken(
                        [colour[0], colour[1], colour[2]],
                        gained,
                    ));
                }
            }
        };
        let masks = mask.par_chunks_mut(width);
        match picture {
            Some(picture) => {
                masks.zip(picture.par_chunks_mut(3 * width).map(Some)).enumerate().for_each(spoil)
            }
            None => masks.map(|row| (row, None)).enumerate().for_each(spoil),
        }
    }
}

fn grow_weed(field: &Field, weed: u64, grass_share: f64) -> Weed {
    let mut rng = stream(field.config.flight_seed(), Stage::Weed, weed);
    let frame = &field.frame;
    let [x_m, y_m] = frame.ground(
        rng.between(-0.5, f64::from(frame.width_px) - 0.5),
        rng.between(-0.5, f64::from(frame.height_px) - 0.5),
    );
    let mut kind = stream(field.config.flight_seed(), Stage::Grass, weed);
    if kind.unit() < grass_share {
        return Weed { grass: true, x_m, y_m, leaves: tuft([x_m, y_m], &mut kind) };
    }
    let count = rng.random_range(2..=6);
    let first_rad = rng.between(0.0, TAU);
    let size_m = rng.between(0.022, 0.064);
    let hue_deg = 92.0 + 8.0 * rng.normal();
    let leaves = (0..count)
        .map(|index| {
            let length_m = size_m * rng.between(0.7, 1.2);
            let shape = Shape {
                length_m,
                width_m: length_m * rng.between(0.45, 0.75),
                azimuth_rad: first_rad
                    + TAU * f64::from(index) / f64::from(count)
                    + 0.3 * rng.normal(),
                elevation_rad: rng.between(0.1, 0.5),
                turn_rad: 0.5,
                swing_rad: 0.1 * rng.normal(),
            };
            let hue_deg = (hue_deg + 3.0 * rng.normal()).clamp(76.0, 124.0);
            let brightness = 1.0 + 0.1 * rng.normal();
            shape.leaf([x_m, y_m, 0.02], hue_deg, brightness.clamp(0.7, 1.3), round_profile)
        })
        .collect();
    Weed { grass: false, x_m, y_m, leaves }
}

/// The leaves of a tuft of grass: narrow, of the crop's outline, in all directions.
fn tuft([x_m, y_m]: [f64; 2], rng: &mut ChaCha8Rng) -> Vec<Leaf> {
    let count = rng.random_range(3..=9);
    let hue_deg = 86.0 + 6.0 * rng.normal();
    (0..count)
        .map(|_| {
            let shape = Shape {
                length_m: rng.between(0.05, 0.20),
                width_m: rng.between(0.004, 0.010),
                azimuth_rad: rng.between(0.0, TAU),
                elevation_rad: rng.between(0.3, 1.1),
                turn_rad: rng.between(0.5, 1.5),
                swing_rad: 0.3 * rng.normal(),
            };
            let hue_deg = (hue_deg + 3.0 * rng.normal()).clamp(70.0, 110.0);
            let brightness = (1.0 + 0.1 * rng.normal()).clamp(0.7, 1.3);
            shape.leaf([x_m, y_m, 0.01], hue_deg, brightness, leaf::width_profile)
        })
        .collect()
}

/// Half width along a round leaf.
fn round_profile(q: f64) -> f64 {
    (PI * (0.06 + 0.94 * q)).sin().max(0.0).sqrt()
}
