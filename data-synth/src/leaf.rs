//! Leaves as curved, tapered, drooping ribbons in three dimensions.
//!
//! The axis of a leaf of length `L` starts at its collar and is followed by arc length `q L`,
//! `q` in [0, 1]. Its elevation above the horizontal falls as it droops,
//! `elevation(q) = elevation(0) - turn q`, and its azimuth swings, `azimuth(q) = azimuth(0) + swing q`,
//! so that the plan view is foreshortened by `cos(elevation)`. The blade is horizontal across the
//! axis; its full width is `W w(q)` with
//! `w(q) = ((q + a)/(m + a))^p ((1 - q)/(1 - m))^r`, which has its maximum 1 at `q = m`, leaves the
//! collar at 0.44 of the width and ends in a point. The ribbon's mean width is 0.75 W, the factor by
//! which sorghum and maize leaf area is estimated from length times maximum width (Montgomery 1911;
//! Stickler, Wearden and Pauli 1961).
//!
//! Positions are metres in the mapping frame, Z above the ground; azimuths are radians
//! counter-clockwise from east.

use crate::{
    field::{FieldConfig, GrowthStage, Phyllotaxy},
    habit::Stalk,
    streams::Draw,
};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{PI, TAU};

/// Nodes of a leaf's axis polyline.
pub const NODES: usize = 9;

const PROFILE_START: f64 = 0.10;
const PROFILE_WIDEST: f64 = 0.45;
const PROFILE_TIP_POWER: f64 = 0.75;
/// Height of a leaf that lies on the ground, metres.
pub(crate) const GROUND_M: f64 = 0.003;

/// One leaf: the ribbon around a polyline.
#[derive(Debug, Clone, PartialEq)]
pub struct Leaf {
    /// The axis from the collar to the tip (X, Y, Z above ground), metres; evenly spaced in arc length.
    pub axis_m: [[f64; 3]; NODES],
    /// Half the full width at each node, metres.
    pub half_width_m: [f64; NODES],
    /// Length along the axis, metres.
    pub length_m: f64,
    /// Full width where it is widest, metres.
    pub width_m: f64,
    /// Direction in which it leaves the plant, radians counter-clockwise from east.
    pub azimuth_rad: f64,
    /// Hue of the blade, degrees in [0, 360).
    pub hue_deg: f64,
    /// Brightness of the blade relative to the others of the field, about 1.
    pub brightness: f64,
    /// The stalk that carries it: 0 the main stalk, then the tillers.
    pub stalk: u32,
    /// Whether it is dying, and so neither green nor part of a mask.
    pub senescent: bool,
}

impl Leaf {
    /// Area of the blade, square metres: the ribbon between the nodes.
    pub fn area_m2(&self) -> f64 {
        let step_m = self.length_m / (NODES - 1) as f64;
        self.half_width_m.windows(2).map(|pair| step_m * (pair[0] + pair[1])).sum()
    }
}

/// How the leaves of a growth stage are: counts and sizes of sorghum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LeafTraits {
    /// Fewest and most leaves of a plant.
    pub count: (u32, u32),
    /// Shortest and longest leaf, metres.
    pub length_m: (f64, f64),
    /// Narrowest and widest leaf (where each is widest), metres.
    pub width_m: (f64, f64),
    /// Height of the topmost collar, metres.
    pub stem_m: f64,
    /// Radius of the stalk, metres.
    pub stalk_radius_m: f64,
}

impl GrowthStage {
    /// How the leaves of this stage are.
    pub fn leaf_traits(self) -> LeafTraits {
        match self {
            GrowthStage::Early => LeafTraits {
                count: (4, 5),
                length_m: (0.08, 0.18),
                width_m: (0.015, 0.025),
                stem_m: 0.06,
                stalk_radius_m: 0.003,
            },
            GrowthStage::Mid => LeafTraits {
                count: (5, 7),
                length_m: (0.18, 0.38),
                width_m: (0.025, 0.04),
                stem_m: 0.18,
                stalk_radius_m: 0.007,
            },
            GrowthStage::Late => LeafTraits {
                count: (7, 9),
                length_m: (0.30, 0.60),
                width_m: (0.03, 0.05),
                stem_m: 0.45,
                stalk_radius_m: 0.010,
            },
        }
    }
}

/// The width profile `w(q)`, 1 where the blade is widest.
pub fn width_profile(q: f64) -> f64 {
    let power = PROFILE_TIP_POWER * (PROFILE_WIDEST + PROFILE_START) / (1.0 - PROFILE_WIDEST);
    ((q + PROFILE_START) / (PROFILE_WIDEST + PROFILE_START)).powf(power)
        * ((1.0 - q).max(0.0) / (1.0 - PROFILE_WIDEST)).powf(PROFILE_TIP_POWER)
}

/// The stalks and leaves of one plant. `rng` makes the main stalk and its leaves; `habit_rng` everything that a
/// [`Habit`](crate::habit::Habit) adds to them.
pub(crate) fn plant(
    config: &FieldConfig,
    base_m: [f64; 2],
    tilt_m: [f64; 2],
    rng: &mut ChaCha8Rng,
    habit_rng: &mut ChaCha8Rng,
) -> (Vec<Stalk>, Vec<Leaf>) {
    let (habit, traits) = (&config.habit, config.stage.leaf_traits());
    let follows = habit_rng.unit() < habit.azimuth_preference;
    let scatter_rad = 0.35 * habit_rng.normal();
    let preferred = config.heading_rad() + habit.preferred_azimuth_deg.to_radians() + scatter_rad;
    let tillers = usize::from(habit_rng.unit() < habit.tiller_fraction)
        * if habit_rng.unit() < 0.5 { 1 } else { 2 };
    let mut growth = Growth {
        stage: config.stage,
        phyllotaxy: config.phyllotaxy,
        base_m,
        tilt_m,
        stem_m: traits.stem_m,
        size: 1.0,
        plane_rad: follows.then_some(preferred),
        hue_spread: habit.hue_spread,
        stalk: 0,
    };
    let mut leaves = growth.leaves(rng);
    let mut stalks = vec![growth.stalk_above(1.0, traits.stalk_radius_m)];
    let first_rad = habit_rng.between(0.0, TAU);
    for tiller in 0..tillers {
        let azimuth_rad = first_rad + PI * tiller as f64 + 0.4 * habit_rng.normal();
        let size = habit_rng.between(0.5, 0.8);
        let lean_m = traits.stem_m * size * habit_rng.between(0.3, 0.6);
        growth.tilt_m = [lean_m * azimuth_rad.cos(), lean_m * azimuth_rad.sin()];
        growth.stem_m = size * traits.stem_m;
        growth.size = size;
        growth.plane_rad = None;
        growth.stalk = tiller as u32 + 1;
        leaves.extend(growth.leaves(habit_rng));
        stalks.push(growth.stalk_above(size, 0.8 * traits.stalk_radius_m));
    }
    for stalk in &mut stalks {
        let carries = habit_rng.unit() < habit.panicle_fraction;
        let length_m = habit_rng.between(0.12, 0.25);
        stalk.panicle_m = if carries { length_m } else { 0.0 };
    }
    for stalk in 0..stalks.len() as u32 {
        let count = leaves.iter().filter(|leaf| leaf.stalk == stalk).count();
        for leaf in leaves.iter_mut().filter(|leaf| leaf.stalk == stalk).take(count.div_ceil(3)) {
            leaf.senescent = habit_rng.unit() < habit.senescent_fraction;
            let hue_deg = habit_rng.between(34.0, 56.0);
            if leaf.senescent {
                leaf.hue_deg = hue_deg;
            }
        }
    }
    (stalks, leaves)
}

/// What one stalk and its leaves grow from.
struct Growth {
    stage: GrowthStage,
    phyllotaxy: Phyllotaxy,
    base_m: [f64; 2],
    /// How far the topmost collar lies from the stalk's base; the collars are spread evenly along the
    /// straight stalk between them.
    tilt_m: [f64; 2],
    stem_m: f64,
    /// Leaf sizes relative to the stage's.
    size: f64,
    /// Azimuth of the leaf plane, where it is not any.
    plane_rad: Option<f64>,
    hue_spread: f64,
    stalk: u32,
}

impl Growth {
    fn stalk_above(&self, size: f64, radius_m: f64) -> Stalk {
        let top_m = [self.tilt_m[0], self.tilt_m[1], 0.01 + self.stem_m];
        Stalk { top_m, radius_m: size * radius_m, panicle_m: 0.0 }
    }

    /// The leaves of the stalk, lowest first.
    fn leaves(&self, rng: &mut ChaCha8Rng) -> Vec<Leaf> {
        let traits = self.stage.leaf_traits();
        let (base_m, tilt_m) = (self.base_m, self.tilt_m);
        let count = rng.random_range(traits.count.0..=traits.count.1);
        let any_rad = rng.between(0.0, TAU);
        let plane_rad = self.plane_rad.unwrap_or(any_rad);
        let plant_hue_deg = 88.0 + 4.0 * self.hue_spread * rng.normal();
        let vigour = (1.0 + 0.05 * rng.normal()).clamp(0.8, 1.2);
        (0..count)
            .map(|index| {
                let rank = f64::from(index + 1) / f64::from(count);
                let size = rng.unit();
                let length_m = traits.length_m.0 + (traits.length_m.1 - traits.length_m.0) * size;
                let stout = 0.6 * size + 0.4 * rng.unit();
                let width_m = traits.width_m.0 + (traits.width_m.1 - traits.width_m.0) * stout;
                let scatter = rng.normal();
                let anywhere = rng.between(0.0, TAU);
                let azimuth_rad = match self.phyllotaxy {
                    Phyllotaxy::Distichous => plane_rad + PI * f64::from(index) + 0.44 * scatter,
                    Phyllotaxy::Random => anywhere,
                };
                // Young leaves at the top stand up, old ones below spread and hang.
                let elevation_rad = (0.28 + 0.60 * rank + 0.12 * rng.normal()).clamp(0.1, 1.3);
                let turn_rad = rng.between(0.6, 1.4);
                let swing_rad = 0.45 * rng.normal();
                let hue_deg =
                    (plant_hue_deg + 5.0 * (rank - 0.5) + 3.0 * self.hue_spread * rng.normal())
                        .clamp(74.0, 106.0);
                let brightness = vigour * (1.0 + 0.08 * rng.normal()).clamp(0.75, 1.25);
                let collar_m = [
                    base_m[0] + rank * tilt_m[0],
                    base_m[1] + rank * tilt_m[1],
                    0.01 + rank * self.stem_m,
                ];
                let shape = Shape {
                    length_m: self.size * length_m,
                    width_m: self.size * width_m,
                    azimuth_rad,
                    elevation_rad,
                    turn_rad,
                    swing_rad,
                };
                let leaf = shape.leaf(collar_m, hue_deg, brightness, width_profile);
                Leaf { stalk: self.stalk, ..leaf }
            })
            .collect()
    }
}

/// The parameters of one ribbon.
pub(crate) struct Shape {
    pub(crate) length_m: f64,
    pub(crate) width_m: f64,
    pub(crate) azimuth_rad: f64,
    pub(crate) elevation_rad: f64,
    pub(crate) turn_rad: f64,
    pub(crate) swing_rad: f64,
}

impl Shape {
    /// The ribbon from `collar_m` on, with full width `width_m profile(q)`.
    pub(crate) fn leaf(
        &self,
        collar_m: [f64; 3],
        hue_deg: f64,
        brightness: f64,
        profile: fn(f64) -> f64,
    ) -> Leaf {
        let step_m = self.length_m / (NODES - 1) as f64;
        let mut axis_m = [collar_m; NODES];
        let mut half_width_m = [0.0; NODES];
        for node in 0..NODES {
            let q = node as f64 / (NODES - 1) as f64;
            half_width_m[node] = 0.5 * self.width_m * profile(q);
            if node > 0 {
                let q = (node as f64 - 0.5) / (NODES - 1) as f64;
                let elevation_rad = (self.elevation_rad - self.turn_rad * q).max(-1.4);
                let azimuth_rad = self.azimuth_rad + self.swing_rad * q;
                let from = axis_m[node - 1];
                // A leaf that reaches the ground goes on along it.
                let z_m = (from[2] + step_m * elevation_rad.sin()).max(GROUND_M);
                let rise_m = z_m - from[2];
                let flat_m = (step_m * step_m - rise_m * rise_m).max(0.0).sqrt();
                axis_m[node] = [
                    from[0] + flat_m * azimuth_rad.cos(),
                    from[1] + flat_m * azimuth_rad.sin(),
                    z_m,
                ];
            }
        }
        Leaf {
            axis_m,
            half_width_m,
            length_m: self.length_m,
            width_m: self.width_m,
            azimuth_rad: self.azimuth_rad.rem_euclid(TAU),
            hue_deg,
            brightness,
            stalk: 0,
            senescent: false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::streams::{Stage, stream};

    fn grow(
        stage: GrowthStage,
        phyllotaxy: Phyllotaxy,
        base_m: [f64; 2],
        tilt_m: [f64; 2],
        rng: &mut ChaCha8Rng,
    ) -> Vec<Leaf> {
        let config = FieldConfig { stage, phyllotaxy, ..FieldConfig::default() };
        let mut habit_rng = stream(1, Stage::Habit, 0);
        plant(&config, base_m, tilt_m, rng, &mut habit_rng).1
    }

    #[test]
    fn the_width_profile_peaks_at_one_and_has_the_area_of_grass_leaves() {
        let profile: Vec<f64> = (0..NODES).map(|i| width_profile(i as f64 / 8.0)).collect();
        let mean = profile.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])).sum::<f64>() / 8.0;
        approx::assert_abs_diff_eq!(mean, 0.75, epsilon = 0.005);
        assert_eq!(profile[NODES - 1], 0.0, "ends in a point");
        let widest = (0..=1000).map(|i| width_profile(f64::from(i) / 1000.0)).fold(0.0, f64::max);
        approx::assert_abs_diff_eq!(widest, 1.0, epsilon = 1e-9);
    }

    #[test]
    fn leaves_have_the_counts_and_sizes_of_their_stage() {
        for stage in [GrowthStage::Early, GrowthStage::Mid, GrowthStage::Late] {
            let traits = stage.leaf_traits();
            let mut counts = std::collections::BTreeSet::new();
            for plant in 0..300 {
                let mut rng = stream(1, Stage::Plant, plant);
                let leaves = grow(stage, Phyllotaxy::Distichous, [3.0, 4.0], [0.0; 2], &mut rng);
                counts.insert(leaves.len() as u32);
                for leaf in &leaves {
                    assert!((traits.length_m.0..=traits.length_m.1).contains(&leaf.length_m));
                    assert!((traits.width_m.0..=traits.width_m.1).contains(&leaf.width_m));
                    assert_eq!((leaf.axis_m[0][0], leaf.axis_m[0][1]), (3.0, 4.0));
                    let arc: f64 = leaf.axis_m.windows(2).map(|w| distance(w[0], w[1])).sum();
                    approx::assert_abs_diff_eq!(arc, leaf.length_m, epsilon = 1e-12);
                }
            }
            assert_eq!(counts, (traits.count.0..=traits.count.1).collect());
        }
    }

    #[test]
    fn distichous_leaves_lie_in_one_plane_and_random_ones_do_not() {
        let concentration = |phyllotaxy| {
            let mut sum = 0.0;
            for plant in 0..200 {
                let mut rng = stream(2, Stage::Plant, plant);
                let leaves = grow(GrowthStage::Mid, phyllotaxy, [0.0; 2], [0.0; 2], &mut rng);
                let (c, s) = leaves.iter().fold((0.0, 0.0), |(c, s), leaf| {
                    let twice = 2.0 * leaf.azimuth_rad;
                    (c + twice.cos(), s + twice.sin())
                });
                sum += f64::hypot(c, s) / leaves.len() as f64;
            }
            sum / 200.0
        };
        // Normal scatter leaves exp(-2 scatter^2) = 0.68 of the doubled angles' resultant.
        assert!(concentration(Phyllotaxy::Distichous) > 0.66);
        assert!(concentration(Phyllotaxy::Random) < 0.5);
    }

    fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
        (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
    }
}
