//! What the colour of a pixel says of its height above the ground.
//!
//! With `d = G - max(R, B)` the green of a pixel of the reference and `g` its height above the ground,
//!
//! ```text
//! Q(g) = soil min(1, (|g| - t)/t)   where d < d_soil and |g| > t
//! Q(g) = leaf min(1, (l - g)/t)     where d >= d_leaf and g < l
//! Q(g) = 0                          elsewhere
//! ```
//!
//! Both are bounded, so photos that agree well on another height outweigh them: a stone, a wall, a seedling.

use super::cost_volume::{CostVolume, LANES};

/// How strongly colours speak. The default was measured on synthetic fields at mid stage, GSD 1.5 cm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Prior {
    /// Colours say nothing: buildings, trees without leaves, ripe crops.
    None,
    /// Green crops on soil.
    GreenOnSoil {
        /// Greatest cost of a pixel that is not green off the ground, in matching costs (at most 72).
        soil: u8,
        /// Greatest cost of a green pixel on the ground.
        leaf: u8,
        /// Greenness, of 255, below which a pixel is soil.
        soil_below: i16,
        /// Greenness from which a pixel is leaf.
        leaf_from: i16,
    },
}

/// Tolerance `t` of heights above the ground, metres.
const TOLERANCE_M: f32 = 0.04;
/// Least height `l` of leaves above the ground, metres.
const LEAF_M: f32 = 0.03;

impl Default for Prior {
    fn default() -> Prior {
        Prior::GreenOnSoil { soil: 20, leaf: 10, soil_below: 2, leaf_from: 6 }
    }
}

impl Prior {
    /// Whether the ground has to be known for it.
    pub fn needs_ground(&self) -> bool {
        *self != Prior::None
    }

    /// Whether a pixel is taken for leaf, at least in part.
    pub fn is_leaf(&self, green: i16) -> bool {
        matches!(*self, Prior::GreenOnSoil { soil_below, .. } if green >= soil_below)
    }

    /// The class of a colour: 0 soil, 1 leaf, 2 neither for sure.
    pub(super) fn class(&self, green: i16) -> u8 {
        match *self {
            Prior::GreenOnSoil { soil_below, .. } if green < soil_below => 0,
            Prior::GreenOnSoil { leaf_from, .. } if green >= leaf_from => 1,
            _ => super::posterior::UNSURE,
        }
    }

    /// The cost of a pixel so green at a height above the ground, metres; none where that is not known (NaN).
    pub fn cost(&self, green: i16, above_m: f32) -> u8 {
        price(self.most(green), above_m)
    }

    /// What a pixel so green costs at most off the ground, and on it.
    fn most(&self, green: i16) -> [f32; 2] {
        match *self {
            Prior::GreenOnSoil { soil, soil_below, .. } if green < soil_below => {
                [f32::from(soil), 0.0]
            }
            Prior::GreenOnSoil { leaf, leaf_from, .. } if green >= leaf_from => {
                [0.0, f32::from(leaf)]
            }
            _ => [0.0; 2],
        }
    }

    /// Adds the costs of all pixels and layers. `ground_m` is the height of the ground at each pixel above the plane of the
    /// block, NaN where not known.
    pub(super) fn add(
        &self,
        costs: &mut CostVolume,
        green: &[i16],
        ground_m: &[f32],
        heights_m: &[f64],
    ) {
        if self.needs_ground() {
            pulp::Arch::new().dispatch(Add { costs, prior: self, green, ground_m, heights_m });
        }
    }
}

/// The cost at a height above the ground of what costs so much at most off the ground, and on it. Where the height is no number
/// neither is the sum, and the cost is 0.
#[inline(always)]
fn price([soil, leaf]: [f32; 2], above_m: f32) -> u8 {
    const SLOPE: f32 = 1.0 / TOLERANCE_M;
    let off = ((above_m.abs() - TOLERANCE_M) * SLOPE).clamp(0.0, 1.0);
    let on = ((LEAF_M - above_m) * SLOPE).clamp(0.0, 1.0);
    // Beside 2^23 a number has no fractions, and its last byte is what it was rounded to: here the whole part, to a thousandth.
    let whole = (soil * off + leaf * on - 0.499).max(0.0);
    (whole + 8_388_608.0).to_bits() as u8
}

/// The costs of colours, with the machine's SIMD.
struct Add<'a> {
    costs: &'a mut CostVolume,
    prior: &'a Prior,
    green: &'a [i16],
    ground_m: &'a [f32],
    heights_m: &'a [f64],
}

impl pulp::WithSimd for Add<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Add { costs, prior, green, ground_m, heights_m } = self;
        let [width, height] = costs.size();
        for row in 0..height {
            for chunk in 0..costs.chunks() {
                let from = row * width + chunk * LANES;
                let n = LANES.min(width - chunk * LANES);
                // Beside the picture the ground is no number.
                let (mut soil, mut leaf) = ([0.0; LANES], [0.0; LANES]);
                let mut below_m = [f32::NAN; LANES];
                // What colours cost at most does not depend on the height.
                for k in 0..n {
                    [soil[k], leaf[k]] = prior.most(green[from + k]);
                    below_m[k] = ground_m[from + k];
                }
                for (costs, &height_m) in costs.chunk_mut(row, chunk).iter_mut().zip(heights_m) {
                    let height_m = height_m as f32;
                    for k in 0..LANES {
                        let price = price([soil[k], leaf[k]], height_m - below_m[k]);
                        costs[k] = costs[k].saturating_add(price);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn soil_belongs_on_the_ground_and_leaves_above_it() {
        let prior = Prior::default();
        assert_eq!(prior.cost(-5, 0.0), 0);
        assert_eq!(prior.cost(-5, 0.5), 20);
        assert_eq!(prior.cost(-5, -0.5), 20);
        assert_eq!(prior.cost(30, 0.5), 0);
        assert_eq!(prior.cost(30, -0.1), 10);
        assert_eq!(prior.cost(4, 0.5), 0);
        assert_eq!(Prior::None.cost(-5, 0.5), 0);
    }

    #[test]
    fn all_pixels_and_layers_get_what_one_gets() {
        let prior = Prior::default();
        let green: Vec<i16> = (0..200).map(|k| k % 25 - 10).collect();
        let mut ground_m: Vec<f32> = (0..200).map(|k| 0.01 * (k % 17) as f32).collect();
        ground_m[7] = f32::NAN;
        let heights_m = [-0.2, 0.003, 0.08, 0.5];
        let mut costs = CostVolume::new([40, 5], 4);
        let pixel = |at: usize| [at % 40, at / 40];
        (0..800).for_each(|at| *costs.at_mut(pixel(at % 200), at / 200) = 30);
        prior.add(&mut costs, &green, &ground_m, &heights_m);
        for at in 0..800 {
            let (of, height_m) = (at % 200, heights_m[at / 200] as f32);
            let cost = costs.at(pixel(of), at / 200);
            assert_eq!(cost, 30 + prior.cost(green[of], height_m - ground_m[of]), "{at}");
        }
        assert_eq!(costs.at(pixel(7), 0), 30);
    }
}
