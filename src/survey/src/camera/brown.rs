//! Brown's model as OpenCV has it, ideal to measured, with the rational radial part.
//!
//! ```text
//! x = X/Z, y = Y/Z                       computer-vision camera frame: y down, looking along +z
//! s = x^2 + y^2
//! q = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)
//! x_d = x q + 2 p1 x y + p2 (s + 2 x^2)
//! y_d = y q + p1 (s + 2 y^2) + 2 p2 x y
//! u = cx + f x_d,  v = cy + f a y_d
//! ```
//!
//! `f` is OpenCV's `fx` and `a = fy/fx`; the other letters are OpenCV's, in OpenCV's order. All of
//! OpenCV's models without thin prisms are this one with parameters held at 0: none, `k1`, `k1 k2`,
//! the five, the rational eight.
//!
//! The model is one to one while the radial curve `r q(r^2)` grows; beyond that radius (a tangent of
//! the angle from the axis) there is no projection.
//!
//! Reference: G. Bradski, *The OpenCV library*, 2000, `calib3d`.

use super::{
    interior::{BuiltInLens, first},
    lens::{Lens, MAX_PARAMETERS, Parameter, Projection, inverse_2x2, newton_2d, unit},
    polynomial,
};

/// Number of parameters.
pub const COUNT: usize = 12;
/// The parameters.
pub static PARAMETERS: [Parameter; COUNT] = [
    Parameter::new("f_px", "px"),
    Parameter::new("aspect", "1"),
    Parameter::new("cx_px", "px"),
    Parameter::new("cy_px", "px"),
    Parameter::new("k1", "1"),
    Parameter::new("k2", "1"),
    Parameter::new("p1", "1"),
    Parameter::new("p2", "1"),
    Parameter::new("k3", "1"),
    Parameter::new("k4", "1"),
    Parameter::new("k5", "1"),
    Parameter::new("k6", "1"),
];
const F: usize = 0;
const ASPECT: usize = 1;
const CX: usize = 2;
const CY: usize = 3;
const K1: usize = 4;
const K2: usize = 5;
const P1: usize = 6;
const P2: usize = 7;
const K3: usize = 8;
const K4: usize = 9;

/// A lens of Brown's model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Brown {
    values: [f64; COUNT],
    valid_radius: f64,
}

/// The radial part and what distortion needs of it.
struct Radial {
    numerator: f64,
    denominator: f64,
    ratio: f64,
    slope: f64,
}

impl Brown {
    /// A lens with these values, in the order of [`PARAMETERS`].
    pub fn new(values: [f64; COUNT]) -> Brown {
        let (a, b) = coefficients(&values);
        // (r a(r^2) / b(r^2))' b^2 as a polynomial in s = r^2.
        let mut slope = [0.0; 7];
        for i in 0..4 {
            for j in 0..4 {
                slope[i + j] += a[i] * b[j] * (1.0 + 2.0 * i as f64 - 2.0 * j as f64);
            }
        }
        let turn = polynomial::smallest_positive_root(&slope).unwrap_or(f64::INFINITY);
        let pole = polynomial::smallest_positive_root(&b).unwrap_or(f64::INFINITY);
        // At the pole itself there is no value.
        let valid_radius = if pole <= turn { 0.999 * pole.sqrt() } else { turn.sqrt() };
        Brown { values, valid_radius }
    }

    /// The lens of values whose valid radius is known.
    pub(super) fn with_valid_radius(values: [f64; COUNT], valid_radius: f64) -> Brown {
        Brown { values, valid_radius }
    }

    /// The tangent of the angle from the axis up to which the model is one to one; infinite where
    /// it is so everywhere.
    pub fn valid_radius(&self) -> f64 {
        self.valid_radius
    }

    fn radial(&self, s: f64) -> Radial {
        let (a, b) = coefficients(&self.values);
        let (numerator, da) = polynomial::evaluate(&a, s);
        let (denominator, db) = polynomial::evaluate(&b, s);
        let ratio = numerator / denominator;
        Radial { numerator, denominator, ratio, slope: (da - ratio * db) / denominator }
    }

    /// The distorted position and its Jacobian.
    fn distort(&self, [x, y]: [f64; 2], radial: &Radial) -> ([f64; 2], [[f64; 2]; 2]) {
        let (p1, p2) = (self.values[P1], self.values[P2]);
        let s = x * x + y * y;
        let (q, dq) = (radial.ratio, radial.slope);
        let value = [
            x * q + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
            y * q + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y,
        ];
        let mixed = 2.0 * (x * y * dq + p1 * x + p2 * y);
        let jacobian = [
            [q + 2.0 * x * x * dq + 2.0 * p1 * y + 6.0 * p2 * x, mixed],
            [mixed, q + 2.0 * y * y * dq + 6.0 * p1 * y + 2.0 * p2 * x],
        ];
        (value, jacobian)
    }

    fn ideal([x, y, z]: [f64; 3], valid_radius: f64) -> Option<[f64; 2]> {
        let inverse = -1.0 / z;
        if !(inverse > 0.0 && inverse.is_finite()) {
            return None;
        }
        let at = [x * inverse, -y * inverse];
        (at[0] * at[0] + at[1] * at[1] <= valid_radius * valid_radius).then_some(at)
    }
}

/// `a` and `b` of `q = a(s) / b(s)`.
fn coefficients(v: &[f64; COUNT]) -> ([f64; 4], [f64; 4]) {
    ([1.0, v[K1], v[K2], v[K3]], [1.0, v[K4], v[K4 + 1], v[K4 + 2]])
}

impl BuiltInLens for Brown {
    const NAME: &'static str = "brown";
    const PARAMETERS: &'static [Parameter] = &PARAMETERS;
    const ABSOLUTE_PRINCIPAL_POINT: Option<usize> = Some(2);

    fn from_values(values: &[f64], _: [f64; 2]) -> Brown {
        Brown::new(first(values))
    }

    #[inline]
    fn with_valid_radius(values: &[f64], _: [f64; 2], valid_radius: f64) -> Brown {
        Brown::with_valid_radius(first(values), valid_radius)
    }

    fn valid_radius(&self) -> f64 {
        self.valid_radius
    }
}

impl Lens for Brown {
    fn parameters(&self) -> &'static [Parameter] {
        &PARAMETERS
    }

    fn values(&self) -> &[f64] {
        &self.values
    }

    fn project(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        let at = Brown::ideal(point, self.valid_radius)?;
        let (d, _) = self.distort(at, &self.radial(at[0] * at[0] + at[1] * at[1]));
        let v = &self.values;
        Some([v[CX] + v[F] * d[0], v[CY] + v[F] * v[ASPECT] * d[1]])
    }

    fn project_with_derivatives(&self, point: [f64; 3]) -> Option<Projection> {
        let at = Brown::ideal(point, self.valid_radius)?;
        let [x, y] = at;
        let s = x * x + y * y;
        let radial = self.radial(s);
        let (d, jacobian) = self.distort(at, &radial);
        let v = &self.values;
        let scale = [v[F], v[F] * v[ASPECT]];
        let inverse = -1.0 / point[2];
        // dq/dk1 = s / b, dq/dk4 = -q s / b, and so on with higher powers.
        let (up, down) = (1.0 / radial.denominator, -radial.numerator / radial.denominator.powi(2));
        let mut by_parameters = [[0.0; MAX_PARAMETERS]; 2];
        let mut by_point = [[0.0; 3]; 2];
        let powers = [s, s * s, s * s * s];
        for row in 0..2 {
            let (g, own) = (scale[row], at[row]);
            let [jx, jy] = jacobian[row];
            by_point[row] = [g * jx * inverse, -g * jy * inverse, g * (jx * x + jy * y) * inverse];
            let by = &mut by_parameters[row];
            by[F] = d[row] * if row == 0 { 1.0 } else { v[ASPECT] };
            by[CX + row] = 1.0;
            for (power, place) in powers.iter().zip([K1, K2, K3]) {
                by[place] = g * own * power * up;
            }
            for (power, place) in powers.iter().zip(K4..) {
                by[place] = g * own * power * down;
            }
            let (along, across) = (g * (s + 2.0 * own * own), g * 2.0 * x * y);
            (by[P1], by[P2]) = if row == 0 { (across, along) } else { (along, across) };
        }
        by_parameters[1][ASPECT] = v[F] * d[1];
        Some(Projection {
            image_px: [v[CX] + scale[0] * d[0], v[CY] + scale[1] * d[1]],
            by_point,
            by_parameters,
        })
    }

    fn unproject(&self, image_px: [f64; 2]) -> Option<[f64; 3]> {
        let v = &self.values;
        let target = [(image_px[0] - v[CX]) / v[F], (image_px[1] - v[CY]) / (v[F] * v[ASPECT])];
        let far = (target[0] * target[0] + target[1] * target[1]).sqrt();
        if !far.is_finite() {
            return None;
        }
        let radius = polynomial::invert_monotonic(far, self.valid_radius, |r| {
            let radial = self.radial(r * r);
            (r * radial.ratio, radial.ratio + 2.0 * r * r * radial.slope)
        })?;
        let ratio = if far > 0.0 { radius / far } else { 0.0 };
        let mut found = target.map(|t| t * ratio);
        if v[P1] != 0.0 || v[P2] != 0.0 {
            found = newton_2d(target, found, far.max(1e-3), |p| {
                self.distort(p, &self.radial(p[0] * p[0] + p[1] * p[1]))
            })?;
        }
        let [x, y] = found;
        let inside = x * x + y * y <= self.valid_radius * self.valid_radius;
        let (_, jacobian) = self.distort(found, &self.radial(x * x + y * y));
        (inside && inverse_2x2(jacobian).is_some()).then(|| unit([x, -y, -1.0]))
    }
}
