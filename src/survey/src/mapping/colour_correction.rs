//! What a photo's colours are multiplied by, and how that is done between sRGB bytes.
//!
//! ```text
//! f_c(u, v) = exp(-(g_c + k . (r^2, r^4, r^6) + a . s + d_1 (s_x^2 - s_y^2) + 2 d_2 s_x s_y))     a factor on linear light
//! y' = (y + o) f^(1/2.4) - o                         on a byte y of sRGB, o = 255 * 0.055
//! ```
//!
//! The terms are those of [`crate::problems::radiometry`]. `r` and `s` are polynomials of the pixel `p = (u - u_0, v - v_0) / r_0`
//! (`r_0` half the diagonal; `s` is the ray without distortion), so that the exponent is one polynomial of `p` for each photo. The sRGB
//! curve is a power of 2.4 of `y + o` above `y = 10.3`, so a factor on light is a factor on `y + o`, exactly; below that the curve is
//! straight and a straight line goes on.

use super::View;
use crate::{
    camera::Lens,
    problems::radiometry::{DIRECTION, RADIAL, direction_terms, radial_terms},
};
use rowgram_raster::srgb;
use serde::{Deserialize, Serialize};

/// `o`: 255 times the offset of the sRGB curve, in which `y = 255 (1.055 x^(1/2.4) - 0.055)`.
const OFFSET: f32 = 255.0 * 0.055;
/// Bytes below which the curve is straight.
const STRAIGHT: f32 = 255.0 * 0.040_45;
/// The exponent of the curve.
const GAMMA: f32 = 2.4;

/// The linear light, 0 to 1, of each sRGB byte.
pub(super) fn linear_light() -> [f32; 256] {
    std::array::from_fn(|byte| srgb::linear_light(byte as f64) as f32)
}

/// How pixels of a photo lie to its principal point and to the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PixelGeometry {
    middle_px: [f64; 2],
    radius_px: f64,
    /// `s` at the principal point, and what a radius to the right and one downwards add.
    origin: [f64; 2],
    right: [f64; 2],
    down: [f64; 2],
}

impl PixelGeometry {
    pub(super) fn new(view: &View) -> PixelGeometry {
        let size = view.interior.size_px().map(f64::from);
        let middle_px =
            view.interior.project([0.0, 0.0, -1.0]).unwrap_or(size.map(|n| 0.5 * (n - 1.0)));
        let radius_px = 0.5 * size[0].hypot(size[1]);
        let scale = radius_px / view.interior.principal_distance_px();
        let rotation = view.rotation();
        PixelGeometry {
            middle_px,
            radius_px,
            origin: [0, 1].map(|k| -rotation[2][k]),
            right: [0, 1].map(|k| scale * rotation[0][k]),
            down: [0, 1].map(|k| -scale * rotation[1][k]),
        }
    }

    /// `r^2` and `s` of a pixel.
    pub(super) fn of(&self, at_px: [f64; 2]) -> (f64, [f64; 2]) {
        let p = [0, 1].map(|k| (at_px[k] - self.middle_px[k]) / self.radius_px);
        let s = [0, 1].map(|k| self.origin[k] + p[0] * self.right[k] + p[1] * self.down[k]);
        (p[0] * p[0] + p[1] * p[1], s)
    }
}

/// The factor on the linear light of each pixel of a photo.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ColourCorrection {
    /// The factor on red, green and blue at the principal point.
    pub gain: [f32; 3],
    /// The principal point, pixels.
    pub middle_px: [f32; 2],
    /// Half the diagonal, pixels.
    pub radius_px: f32,
    /// The natural logarithm of what the factor is multiplied by at `p`: coefficients of `p_u, p_v, p_u^2, p_u p_v, p_v^2, r^4, r^6`.
    pub log_shape: [f32; 7],
}

impl ColourCorrection {
    /// The inverse of what a photo does to light.
    pub(super) fn new(
        geometry: &PixelGeometry,
        log_gain: [f64; 3],
        radial: [f64; RADIAL],
        direction: [f64; DIRECTION],
    ) -> ColourCorrection {
        let PixelGeometry { middle_px, radius_px, origin: o, right: r, down: d } = *geometry;
        let [a, b, along, diagonal] = direction;
        // The derivatives of a . s + d_1 (s_x^2 - s_y^2) + 2 d_2 s_x s_y.
        let gradient = [
            a + 2.0 * (along * o[0] + diagonal * o[1]),
            b + 2.0 * (diagonal * o[0] - along * o[1]),
        ];
        let product = |p: [f64; 2], q: [f64; 2]| {
            along * (p[0] * q[0] - p[1] * q[1]) + diagonal * (p[0] * q[1] + p[1] * q[0])
        };
        let terms = direction_terms(o);
        let middle: f64 = terms.iter().zip(&direction).map(|(t, c)| t * c).sum();
        let slope = |p: [f64; 2]| gradient[0] * p[0] + gradient[1] * p[1];
        let log_shape = [
            slope(r),
            slope(d),
            product(r, r) + radial[0],
            2.0 * product(r, d),
            product(d, d) + radial[0],
            radial[1],
            radial[2],
        ];
        ColourCorrection {
            gain: log_gain.map(|g| (-g - middle).exp() as f32),
            middle_px: middle_px.map(|value| value as f32),
            radius_px: radius_px as f32,
            log_shape: log_shape.map(|value| -value as f32),
        }
    }

    /// The natural logarithm of the factor at a pixel relative to that at the principal point.
    #[inline(always)]
    fn log_shape_at(&self, [u, v]: [f32; 2]) -> f32 {
        let scale = 1.0 / self.radius_px;
        let (p, q) = ((u - self.middle_px[0]) * scale, (v - self.middle_px[1]) * scale);
        let r2 = p * p + q * q;
        let c = &self.log_shape;
        p * (c[0] + c[2] * p + c[3] * q) + q * (c[1] + c[4] * q) + r2 * r2 * (c[5] + c[6] * r2)
    }

    /// The factor on the linear light of a pixel.
    pub fn factor(&self, at_px: [f32; 2]) -> [f32; 3] {
        let shape = self.log_shape_at(at_px).exp();
        self.gain.map(|gain| gain * shape)
    }

    /// What the loop over pixels needs.
    pub(super) fn prepared(&self) -> PreparedCorrection {
        PreparedCorrection {
            of: ColourCorrection {
                gain: self.gain.map(|gain| gain.powf(1.0 / GAMMA)),
                log_shape: self.log_shape.map(|c| c / GAMMA),
                ..*self
            },
        }
    }
}

/// A correction whose gains and shape are of the encoded colour.
#[derive(Debug, Clone, Copy)]
pub(super) struct PreparedCorrection {
    of: ColourCorrection,
}

impl PreparedCorrection {
    /// Corrects a colour of sRGB, 0 to 255, of a pixel.
    #[inline(always)]
    pub(super) fn apply(&self, at_px: [f32; 2], colour: &mut [f32; 4]) {
        let shape = exponential(self.of.log_shape_at(at_px));
        for c in 0..3 {
            let factor = self.of.gain[c] * shape;
            let y = colour[c];
            let power = (y + OFFSET) * factor - OFFSET;
            // Where the curve is straight, light and colour have one factor; a cubic leads from there to the power.
            let light = light_factor(factor);
            let end = (STRAIGHT + OFFSET) * factor - OFFSET - light * STRAIGHT;
            let share = y * (1.0 / STRAIGHT);
            let straight = y * light + end * share * share * share;
            colour[c] = if y > STRAIGHT { power } else { straight };
        }
    }
}

/// `f^2.4`, the factor on light whose factor on colour is `f`: to a hundredth between 0.6 and 1.6.
#[inline(always)]
fn light_factor(f: f32) -> f32 {
    let d = f - 1.0;
    f * f * (1.0 + d * (0.4 + d * (-0.12 + d * 0.064)))
}

/// `exp(x)` to 1e-6 for what photos need (to 1e-4 at 4), in operations that a register does for many at a time.
#[inline(always)]
fn exponential(x: f32) -> f32 {
    let y = x.clamp(-6.0, 6.0) * 0.125;
    let p = 1.0
        + y * (1.0
            + y * (0.5
                + y * (1.0 / 6.0 + y * (1.0 / 24.0 + y * (1.0 / 120.0 + y * (1.0 / 720.0))))));
    let p = p * p;
    let p = p * p;
    p * p
}

/// What an observation of a point says of a photo: the sum of the terms.
pub(super) fn log_shape(
    radius2: f64,
    direction: [f64; 2],
    radial: &[f64; RADIAL],
    by_direction: &[f64; DIRECTION],
) -> f64 {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    dot(&radial_terms(radius2), radial) + dot(&direction_terms(direction), by_direction)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Interior, Model},
        scene::Pose,
    };
    use rowgram_optim::geometry::rotation;
    use rowgram_raster::srgb::grey_value;

    #[test]
    fn a_factor_on_light_is_what_bytes_are_changed_by() {
        let values = [900.0, 3.0, -5.0, 0.0, 1e-8, 0.0, 0.0, 0.0, 0.0, 0.0];
        let interior = Interior::new(Model::Smac, [1000, 750], &values).unwrap();
        let pose = Pose::from_centre(rotation::exp([0.1, -0.05, 0.8]), [0.0, 0.0, 30.0]);
        let geometry = PixelGeometry::new(&View::new("p", interior, pose, None));
        let (radial, direction) = ([-0.4, 0.05, -0.02], [0.12, -0.2, 0.05, 0.03]);
        let log_gain = [0.2, -0.1, 0.05];
        let correction = ColourCorrection::new(&geometry, log_gain, radial, direction);
        let table = linear_light();
        for at in [[0.0, 0.0], [500.0, 370.0], [999.0, 20.0], [130.0, 700.0]] {
            let (radius2, s) = geometry.of(at);
            let shape = log_shape(radius2, s, &radial, &direction);
            let at = at.map(|value| value as f32);
            let factor = correction.factor(at);
            for c in 0..3 {
                let expected = (-(log_gain[c] + shape)).exp();
                approx::assert_relative_eq!(f64::from(factor[c]), expected, max_relative = 1e-5);
            }
            for byte in [4u8, 12, 60, 130, 180] {
                let mut colour = [f32::from(byte); 4];
                correction.prepared().apply(at, &mut colour);
                for c in 0..3 {
                    let light = f64::from(table[usize::from(byte)]) * f64::from(factor[c]);
                    let off = f64::from(colour[c]) - grey_value(light);
                    // Below 20 a cubic stands for the bend between the straight part of the curve and the power.
                    assert!(off.abs() < if byte < 20 { 0.3 } else { 0.01 }, "{byte}: {off}");
                }
            }
        }
    }

    #[test]
    fn the_exponential_is_exact_enough() {
        for k in -40..=40 {
            let x = 0.05 * k as f32;
            approx::assert_relative_eq!(exponential(x), x.exp(), max_relative = 2e-6);
        }
    }
}
