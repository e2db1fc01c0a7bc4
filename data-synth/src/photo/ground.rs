//! Bare soil in photos: noise at all scales, evaluated where the ground is.
//!
//! The reflectance is a sum over a ladder of lattice spacings from metres (moisture, wheel tracks) to
//! millimetres (crumbs). Each rung has lighter and darker patches and, up to the size of clods, sides that face the
//! sun or turn away from it. A rung fades out where its lattice is finer than the pixels see, so what is left is
//! free of aliasing, and every photo sees the same soil.

use crate::{field::FieldConfig, soil::Soil};

/// One rung: lattice spacing in metres, deviation of the patches, steepness of the relief.
const LADDER: [(f32, f32, f32); 10] = [
    (3.1, 0.10, 0.0),
    (1.37, 0.08, 0.0),
    (0.59, 0.08, 0.05),
    (0.26, 0.09, 0.12),
    (0.115, 0.11, 0.22),
    (0.052, 0.11, 0.28),
    (0.0247, 0.07, 0.21),
    (0.0121, 0.06, 0.15),
    (0.0058, 0.06, 0.13),
    (0.0027, 0.06, 0.12),
];

/// The soil of one field, as photos see it.
pub(super) struct Ground {
    soil: Soil,
    /// What is new of the soil on this day of a season, and the weights of the old and the new.
    weathered: Option<(Soil, [f32; 2])>,
    contrast: f32,
    /// Horizontal direction to the sun.
    sun: [f32; 2],
}

impl Ground {
    pub(super) fn new(field: &FieldConfig, contrast: f64, sun: [f64; 3]) -> Ground {
        let flat = f64::hypot(sun[0], sun[1]).max(1e-9);
        let sun = [(sun[0] / flat) as f32, (sun[1] / flat) as f32];
        let soil = |seed| Soil::new(seed, 0.0, [0.0; 2]);
        // Shares of the variance, so that the soil is as uneven as before.
        let weathered =
            field.season.as_ref().filter(|season| season.weathering > 0.0).map(|season| {
                let share = season.weathering as f32;
                (soil(field.flight_seed()), [(1.0 - share).sqrt(), share.sqrt()])
            });
        Ground { soil: soil(field.seed), weathered, contrast: contrast as f32, sun }
    }

    fn noise(&self, u: f32, v: f32) -> f32 {
        let lasting = self.soil.noise(u, v);
        match &self.weathered {
            Some((new, [old_weight, new_weight])) => {
                old_weight * lasting + new_weight * new.noise(u, v)
            }
            None => lasting,
        }
    }

    /// Reflectance (red, green, blue; linear) at a place of the mapping frame seen with a ground sampling
    /// distance, and how much more light it gets than level ground.
    pub(super) fn look(&self, x_m: f64, y_m: f64, gsd_m: f32) -> ([f32; 3], f32) {
        let (mut patches, mut relief, mut broad) = (0.0, 0.0, 0.0);
        // Every rung is turned against the one before, so that no two lattices lie on each other.
        let (sin, cos) = (0.6_f32.sin(), 0.6_f32.cos());
        let (mut x, mut y) = (x_m as f32, y_m as f32);
        let [mut sx, mut sy] = self.sun;
        for (rung, &(spacing_m, patch, steep)) in LADDER.iter().enumerate() {
            let fade = ((spacing_m / gsd_m - 0.4) / 1.2).clamp(0.0, 1.0);
            if fade == 0.0 {
                break;
            }
            (x, y) = (x * cos - y * sin, x * sin + y * cos);
            (sx, sy) = (sx * cos - sy * sin, sx * sin + sy * cos);
            let offset = 37.0 * rung as f32;
            let (u, v) = (x / spacing_m + offset, y / spacing_m - offset);
            let here = self.noise(u, v);
            patches += fade * patch * here;
            if rung < 2 {
                broad += here;
            }
            if steep > 0.0 {
                let aside = self.noise(u + 0.6 * sx, v + 0.6 * sy);
                relief += fade * steep * (here - aside);
            }
        }
        let level = (1.0 + self.contrast * patches * 1.4).clamp(0.3, 2.0);
        let tint = 0.03 * self.contrast * broad;
        let light = (1.0 + self.contrast * relief).clamp(0.25, 1.9);
        ([0.275 * level * (1.0 + tint), 0.178 * level, 0.105 * level * (1.0 - tint)], light)
    }
}
