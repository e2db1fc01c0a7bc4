//! Bare soil: value noise at several scales.
//!
//! `noise(x, y)` interpolates (smoothstep) random values at the nodes of a unit lattice. The
//! brightness of the soil is a sum of such noises over wavelengths from metres (moisture, wheel
//! tracks) down to clods and grains, of streaks drawn out along the rows (tillage), of the sides of
//! clods that face the sun or turn away from it, and of one random value per pixel.

use crate::streams::{Draw, Stage, stream};

const TABLE: usize = 4096;

/// The random tables of one field's soil.
pub(crate) struct Soil {
    shifts: Box<[u16; TABLE]>,
    values: Box<[f32; TABLE]>,
    gsd_m: f32,
    sun: [f32; 2],
}

impl Soil {
    /// `sun`: horizontal direction to the sun in the field's axes (along, across).
    pub(crate) fn new(seed: u64, gsd_m: f64, sun: [f64; 2]) -> Soil {
        let mut rng = stream(seed, Stage::Soil, 0);
        let shifts = Box::new([0; TABLE].map(|_: u16| rng.between(0.0, TABLE as f64) as u16));
        let values = Box::new([0.0; TABLE].map(|_: f32| rng.between(-1.0, 1.0) as f32));
        Soil { shifts, values, gsd_m: gsd_m as f32, sun: sun.map(|part| part as f32) }
    }

    /// A random value in [-1, 1) of a whole position.
    pub(crate) fn grain(&self, x: i32, y: i32) -> f32 {
        self.values[x.wrapping_add(self.shift(y)) as usize % TABLE]
    }

    /// Where a row of the lattice begins in the one sequence of values.
    fn shift(&self, y: i32) -> i32 {
        i32::from(self.shifts[y as usize % TABLE])
    }

    /// Smooth noise in [-1, 1) with features about one unit wide.
    pub(crate) fn noise(&self, x: f32, y: f32) -> f32 {
        let (i, s) = split(x);
        let (j, t) = split(y);
        let smooth = |t: f32| t * t * (3.0 - 2.0 * t);
        let (a, b) = (smooth(s), smooth(t));
        let row = |shift: i32| {
            let at = i.wrapping_add(shift);
            let left = self.values[at as usize % TABLE];
            left + a * (self.values[at.wrapping_add(1) as usize % TABLE] - left)
        };
        let (upper, lower) = (row(self.shift(j)), row(self.shift(j.wrapping_add(1))));
        upper + b * (lower - upper)
    }

    /// Noise of a wavelength, fading out where a pixel is wider than half of it.
    fn octave(&self, x_m: f32, y_m: f32, wavelength_m: f32) -> f32 {
        let fade = (0.5 * wavelength_m / self.gsd_m).min(1.0);
        if fade < 0.2 {
            return 0.0;
        }
        // Each octave reads another part of the tables.
        let offset = 1000.0 * wavelength_m;
        fade * self.noise(x_m / wavelength_m + offset, y_m / wavelength_m - offset)
    }

    /// The colour of the soil at the pixel (`u`, `v`) that lies at (`along_m`, `across_m`) in the
    /// field's axes: red, green, blue in [0, 255] before shadow. Red always leads green.
    pub(crate) fn colour(&self, u: i32, v: i32, along_m: f32, across_m: f32) -> [f32; 3] {
        let octave = |wavelength_m| self.octave(along_m, across_m, wavelength_m);
        let aside = |wavelength_m: f32| {
            let step_m = 0.6 * wavelength_m;
            self.octave(
                along_m + step_m * self.sun[0],
                across_m + step_m * self.sun[1],
                wavelength_m,
            )
        };
        let broad = octave(2.7);
        let (clod, crumb) = (octave(0.075), octave(0.023));
        let brightness = 1.0
            + 0.09 * broad
            + 0.05 * octave(0.6)
            + 0.09 * self.octave(0.1 * along_m, across_m, 0.055)
            + 0.24 * (clod - aside(0.075))
            + 0.04 * clod
            + 0.28 * (crumb - aside(0.023))
            + 0.10 * octave(0.009)
            + 0.08 * self.grain(u, v);
        let light = 142.0 * brightness.clamp(0.55, 1.5);
        let red = 1.0 + 0.02 * broad;
        [light * red, light * 0.815, light * (0.625 - 0.02 * broad)]
    }
}

/// The whole number below and what is left of it, without the call that `floor` is on old processors.
fn split(x: f32) -> (i32, f32) {
    let toward_zero = x as i32;
    let whole = if toward_zero as f32 > x { toward_zero - 1 } else { toward_zero };
    (whole, x - whole as f32)
}
