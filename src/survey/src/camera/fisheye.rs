//! The equidistant fisheye with a polynomial in the angle (Kannala and Brandt; OpenCV's `fisheye`).
//!
//! ```text
//! theta = atan2(sqrt(X^2 + Y^2), Z)      computer-vision camera frame: y down, looking along +z
//! d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
//! u = cx + f d X / sqrt(X^2 + Y^2),  v = cy + f a d Y / sqrt(X^2 + Y^2)
//! ```
//!
//! `a = fy/fx`. Angles beyond 90 degrees have an image; the model is one to one while `d` grows with
//! `theta`, beyond that there is no projection.
//!
//! Reference: J. Kannala and S. S. Brandt, *A generic camera model and calibration method*, PAMI
//! 28(8), 2006.

use super::{
    interior::{BuiltInLens, first},
    lens::{Lens, MAX_PARAMETERS, Parameter, Projection},
    polynomial,
};

/// Number of parameters.
pub const COUNT: usize = 8;
/// The parameters.
pub static PARAMETERS: [Parameter; COUNT] = [
    Parameter::new("f_px", "px"),
    Parameter::new("aspect", "1"),
    Parameter::new("cx_px", "px"),
    Parameter::new("cy_px", "px"),
    Parameter::new("k1", "1"),
    Parameter::new("k2", "1"),
    Parameter::new("k3", "1"),
    Parameter::new("k4", "1"),
];
const F: usize = 0;
const ASPECT: usize = 1;
const CX: usize = 2;
const CY: usize = 3;
const K1: usize = 4;
/// Straight behind the camera there is no direction around the axis.
const LARGEST_ANGLE_RAD: f64 = 0.999 * std::f64::consts::PI;

/// An equidistant fisheye lens.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fisheye {
    values: [f64; COUNT],
    valid_angle_rad: f64,
}

/// A ray by its angle from the axis and its place around it.
struct Ray {
    /// Direction around the axis, `y` down.
    around: [f64; 2],
    /// Distances from the axis and along it.
    across: f64,
    along: f64,
    angle: f64,
    /// `d` and its slope.
    radius: f64,
    slope: f64,
}

impl Fisheye {
    /// A lens with these values, in the order of [`PARAMETERS`].
    pub fn new(values: [f64; COUNT]) -> Fisheye {
        let v = &values;
        let slope = [1.0, 3.0 * v[K1], 5.0 * v[K1 + 1], 7.0 * v[K1 + 2], 9.0 * v[K1 + 3]];
        let turn = polynomial::smallest_positive_root(&slope).map_or(f64::INFINITY, f64::sqrt);
        Fisheye { values, valid_angle_rad: turn.min(LARGEST_ANGLE_RAD) }
    }

    /// The lens of values whose valid angle is known.
    pub(super) fn with_valid_radius(values: [f64; COUNT], valid_angle_rad: f64) -> Fisheye {
        Fisheye { values, valid_angle_rad }
    }

    /// The angle from the axis up to which the model is one to one, radians.
    pub fn valid_angle_rad(&self) -> f64 {
        self.valid_angle_rad
    }

    /// `d` and its slope at an angle.
    fn curve(&self, angle: f64) -> (f64, f64) {
        let v = &self.values;
        let square = angle * angle;
        let (p, dp) = polynomial::evaluate(&[1.0, v[K1], v[K1 + 1], v[K1 + 2], v[K1 + 3]], square);
        (angle * p, p + 2.0 * square * dp)
    }

    fn ray(&self, [x, y, z]: [f64; 3]) -> Option<Ray> {
        let (x, y, along) = (x, -y, -z);
        let across = (x * x + y * y).sqrt();
        if !(across.is_finite() && along.is_finite()) || (across == 0.0 && along <= 0.0) {
            return None;
        }
        let angle = across.atan2(along);
        if angle > self.valid_angle_rad {
            return None;
        }
        let around = if across > 0.0 { [x / across, y / across] } else { [0.0, 0.0] };
        let (radius, slope) = self.curve(angle);
        Some(Ray { around, across, along, angle, radius, slope })
    }
}

impl BuiltInLens for Fisheye {
    const NAME: &'static str = "fisheye";
    const PARAMETERS: &'static [Parameter] = &PARAMETERS;
    const ABSOLUTE_PRINCIPAL_POINT: Option<usize> = Some(2);

    fn from_values(values: &[f64], _: [f64; 2]) -> Fisheye {
        Fisheye::new(first(values))
    }

    #[inline]
    fn with_valid_radius(values: &[f64], _: [f64; 2], valid_radius: f64) -> Fisheye {
        Fisheye::with_valid_radius(first(values), valid_radius)
    }

    fn valid_radius(&self) -> f64 {
        self.valid_angle_rad
    }
}

impl Lens for Fisheye {
    fn parameters(&self) -> &'static [Parameter] {
        &PARAMETERS
    }

    fn values(&self) -> &[f64] {
        &self.values
    }

    fn project(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        let ray = self.ray(point)?;
        let v = &self.values;
        Some([
            v[CX] + v[F] * ray.radius * ray.around[0],
            v[CY] + v[F] * v[ASPECT] * ray.radius * ray.around[1],
        ])
    }

    fn project_with_derivatives(&self, point: [f64; 3]) -> Option<Projection> {
        let ray = self.ray(point)?;
        let v = &self.values;
        let distance_squared = ray.across * ray.across + ray.along * ray.along;
        let radial = ray.slope * ray.along / distance_squared;
        // On the axis d / across tends to the radial slope.
        let around = if ray.across > 0.0 { ray.radius / ray.across } else { radial };
        let [ex, ey] = ray.around;
        let towards = -ray.slope * ray.across / distance_squared;
        let rows = [
            [around + ex * ex * (radial - around), ex * ey * (radial - around), ex * towards],
            [ex * ey * (radial - around), around + ey * ey * (radial - around), ey * towards],
        ];
        let scale = [v[F], v[F] * v[ASPECT]];
        let mut by_parameters = [[0.0; MAX_PARAMETERS]; 2];
        let mut by_point = [[0.0; 3]; 2];
        let square = ray.angle * ray.angle;
        for row in 0..2 {
            let g = scale[row];
            // y down and z forward turn into y up and z backward.
            by_point[row] = [g * rows[row][0], -g * rows[row][1], -g * rows[row][2]];
            let by = &mut by_parameters[row];
            by[F] = ray.radius * ray.around[row] * if row == 0 { 1.0 } else { v[ASPECT] };
            by[CX + row] = 1.0;
            let mut power = ray.angle;
            for k in 0..4 {
                power *= square;
                by[K1 + k] = g * power * ray.around[row];
            }
        }
        by_parameters[1][ASPECT] = v[F] * ray.radius * ray.around[1];
        Some(Projection {
            image_px: [
                v[CX] + scale[0] * ray.radius * ray.around[0],
                v[CY] + scale[1] * ray.radius * ray.around[1],
            ],
            by_point,
            by_parameters,
        })
    }

    fn unproject(&self, image_px: [f64; 2]) -> Option<[f64; 3]> {
        let v = &self.values;
        let at = [(image_px[0] - v[CX]) / v[F], (image_px[1] - v[CY]) / (v[F] * v[ASPECT])];
        let radius = (at[0] * at[0] + at[1] * at[1]).sqrt();
        if !radius.is_finite() {
            return None;
        }
        let angle =
            polynomial::invert_monotonic(radius, self.valid_angle_rad, |angle| self.curve(angle))?;
        let (sine, cosine) = angle.sin_cos();
        let ratio = if radius > 0.0 { sine / radius } else { 1.0 };
        Some([at[0] * ratio, -at[1] * ratio, -cosine])
    }
}
