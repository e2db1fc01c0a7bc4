//! SMAC: the image-to-ideal correction of simultaneous multi-frame analytical calibration.
//!
//! ```text
//! x = u - u_0,  y = v_0 - v            (u_0, v_0): image centre; x right, y up, pixels
//! xb = x - xp,  yb = y - yp,  r^2 = xb^2 + yb^2
//! q = K0 + K1 (r^2 - R0^2) + K2 (r^4 - R0^4) + K3 (r^6 - R0^6)
//! x_ideal = xb + xb q + P1 (r^2 + 2 xb^2) + 2 P2 xb yb  = -c U/W
//! y_ideal = yb + yb q + 2 P1 xb yb + P2 (r^2 + 2 yb^2)  = -c V/W
//! ```
//!
//! for a point `(U, V, W)` in the camera frame. `r` is that of the reduced coordinates (the paper
//! prints `sqrt(x^2 + y^2)`). The map runs from the measured to the ideal position; projection
//! inverts it by Newton's method, its derivatives follow by implicit differentiation. It is one to
//! one only while the radial curve `r (1 + q(r))` grows; that radius is found once per set of
//! parameters, and beyond it there is no projection.
//!
//! `K0` with `R0 = 0` is the same degree of freedom as `c`: never estimate both.
//!
//! Reference: D. C. Brown, *Close-range camera calibration*, Photogrammetric Engineering 37(8), 1971.

use super::{
    interior::{BuiltInLens, first},
    lens::{Lens, MAX_PARAMETERS, Parameter, Projection, inverse_2x2, newton_2d, times, unit},
    polynomial,
};

/// Number of parameters.
pub const COUNT: usize = 10;
/// The parameters; `R0` is a constant of the camera.
pub static PARAMETERS: [Parameter; COUNT] = [
    Parameter::new("c_px", "px"),
    Parameter::new("xp_px", "px"),
    Parameter::new("yp_px", "px"),
    Parameter::new("K0", "1"),
    Parameter::new("K1", "px^-2"),
    Parameter::new("K2", "px^-4"),
    Parameter::new("K3", "px^-6"),
    Parameter::new("P1", "px^-1"),
    Parameter::new("P2", "px^-1"),
    Parameter { name: "R0_px", unit: "px", estimable: false },
];
const C: usize = 0;
const XP: usize = 1;
const YP: usize = 2;
const K0: usize = 3;
const P1: usize = 7;
const P2: usize = 8;
const R0: usize = 9;

/// A SMAC lens.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Smac {
    values: [f64; COUNT],
    centre_px: [f64; 2],
    valid_radius_px: f64,
}

impl Smac {
    /// A lens with these values, in the order of [`PARAMETERS`], and the image's centre, pixels.
    pub fn new(values: [f64; COUNT], centre_px: [f64; 2]) -> Smac {
        let mut lens = Smac { values, centre_px, valid_radius_px: 0.0 };
        let [k0, k1, k2, k3] = lens.radial();
        let slope = [1.0 + k0, 3.0 * k1, 5.0 * k2, 7.0 * k3];
        lens.valid_radius_px = if slope[0] > 0.0 {
            polynomial::smallest_positive_root(&slope).map_or(f64::INFINITY, f64::sqrt)
        } else {
            0.0
        };
        lens
    }

    /// The lens of values whose valid radius is known.
    pub(super) fn with_valid_radius(
        values: [f64; COUNT],
        centre_px: [f64; 2],
        valid_radius_px: f64,
    ) -> Smac {
        Smac { values, centre_px, valid_radius_px }
    }

    /// The distance from the principal point up to which the model is one to one, pixels; infinite
    /// where it is so everywhere.
    pub fn valid_radius_px(&self) -> f64 {
        self.valid_radius_px
    }

    /// Coefficients of `q` as a polynomial in `r^2`: `R0` only changes the constant one.
    fn radial(&self) -> [f64; 4] {
        let v = &self.values;
        let square = v[R0] * v[R0];
        [
            v[K0] - square * (v[K0 + 1] + square * (v[K0 + 2] + square * v[K0 + 3])),
            v[K0 + 1],
            v[K0 + 2],
            v[K0 + 3],
        ]
    }

    /// The ideal position of a reduced one, and its Jacobian.
    fn ideal(&self, [x, y]: [f64; 2]) -> ([f64; 2], [[f64; 2]; 2]) {
        let (p1, p2) = (self.values[P1], self.values[P2]);
        let square = x * x + y * y;
        let (q, dq) = polynomial::evaluate(&self.radial(), square);
        let value = [
            x + x * q + p1 * (square + 2.0 * x * x) + 2.0 * p2 * x * y,
            y + y * q + 2.0 * p1 * x * y + p2 * (square + 2.0 * y * y),
        ];
        let mixed = 2.0 * (x * y * dq + p1 * y + p2 * x);
        let jacobian = [
            [1.0 + q + 2.0 * x * x * dq + 6.0 * p1 * x + 2.0 * p2 * y, mixed],
            [mixed, 1.0 + q + 2.0 * y * y * dq + 2.0 * p1 * x + 6.0 * p2 * y],
        ];
        (value, jacobian)
    }

    /// How the ideal position changes with `K0..K3`, `P1`, `P2`, the reduced one being held.
    fn ideal_by_coefficients(&self, [x, y]: [f64; 2]) -> [[f64; 6]; 2] {
        let square = x * x + y * y;
        let zero = self.values[R0] * self.values[R0];
        let basis = [
            1.0,
            square - zero,
            square * square - zero * zero,
            square * square * square - zero * zero * zero,
        ];
        let (a, b, mixed) = (square + 2.0 * x * x, square + 2.0 * y * y, 2.0 * x * y);
        [
            [x * basis[0], x * basis[1], x * basis[2], x * basis[3], a, mixed],
            [y * basis[0], y * basis[1], y * basis[2], y * basis[3], mixed, b],
        ]
    }

    /// The reduced position of a point in the camera frame and its undistorted direction
    /// `(-U/W, -V/W)`, found fast where the image is near `near_px`.
    fn reduced(
        &self,
        [x, y, z]: [f64; 3],
        near_px: Option<[f64; 2]>,
    ) -> Option<([f64; 2], [f64; 2])> {
        if z.is_nan() || z >= 0.0 {
            return None;
        }
        let direction = [-x / z, -y / z];
        let target = direction.map(|v| self.values[C] * v);
        let far = (target[0] * target[0] + target[1] * target[1]).sqrt();
        if !far.is_finite() {
            return None;
        }
        let is_inside = |[x, y]: [f64; 2]| x * x + y * y <= self.valid_radius_px.powi(2);
        if let Some(near) = near_px {
            // Within the radius the map is one to one: what is found from anywhere is the image.
            let found = newton_2d(target, self.centred(near), far.max(1.0), |p| self.ideal(p));
            if let Some(found) = found.filter(|found| is_inside(*found)) {
                return Some((found, direction));
            }
        }
        let radial = self.radial();
        let radius = polynomial::invert_monotonic(far, self.valid_radius_px, |r| {
            let (q, dq) = polynomial::evaluate(&radial, r * r);
            (r * (1.0 + q), 1.0 + q + 2.0 * r * r * dq)
        })?;
        let ratio = if far > 0.0 { radius / far } else { 0.0 };
        let start = target.map(|v| v * ratio);
        if self.values[P1] == 0.0 && self.values[P2] == 0.0 {
            return Some((start, direction));
        }
        let found = newton_2d(target, start, far.max(1.0), |p| self.ideal(p))?;
        is_inside(found).then_some((found, direction))
    }

    /// The reduced position of a pixel, `y` up.
    fn centred(&self, [u, v]: [f64; 2]) -> [f64; 2] {
        [u - self.centre_px[0] - self.values[XP], self.centre_px[1] - v - self.values[YP]]
    }

    /// As [`Lens::project`], faster where the image is near `near_px`.
    pub fn project_near(&self, point: [f64; 3], near_px: Option<[f64; 2]>) -> Option<[f64; 2]> {
        let ([x, y], _) = self.reduced(point, near_px)?;
        Some([self.centre_px[0] + (self.values[XP] + x), self.centre_px[1] - (self.values[YP] + y)])
    }

    /// As [`Lens::project_with_derivatives`], faster where the image is near `near_px`.
    pub fn project_with_derivatives_near(
        &self,
        point: [f64; 3],
        near_px: Option<[f64; 2]>,
    ) -> Option<Projection> {
        let (at, direction) = self.reduced(point, near_px)?;
        let (_, jacobian) = self.ideal(at);
        let inverse = inverse_2x2(jacobian)?;
        let scaled = -self.values[C] / point[2];
        let by_coefficients = self.ideal_by_coefficients(at);
        let columns = [
            times(&inverse, [scaled, 0.0]),
            times(&inverse, [0.0, scaled]),
            times(&inverse, direction.map(|v| scaled * v)),
        ];
        let by_distance = times(&inverse, direction);
        let mut by_parameters = [[0.0; MAX_PARAMETERS]; 2];
        for row in 0..2 {
            by_parameters[row][C] = by_distance[row];
            by_parameters[row][XP + row] = 1.0;
        }
        for k in 0..6 {
            let change = times(&inverse, [by_coefficients[0][k], by_coefficients[1][k]]);
            by_parameters[0][K0 + k] = -change[0];
            by_parameters[1][K0 + k] = -change[1];
        }
        let mut found = Projection {
            image_px: [self.values[XP] + at[0], self.values[YP] + at[1]],
            by_point: [
                [columns[0][0], columns[1][0], columns[2][0]],
                [columns[0][1], columns[1][1], columns[2][1]],
            ],
            by_parameters,
        };
        turn_down(&mut found);
        found.image_px[0] += self.centre_px[0];
        found.image_px[1] += self.centre_px[1];
        Some(found)
    }

    /// The residual that many photogrammetric programs use, in the domain of the corrected
    /// coordinates: ideal position of the point minus corrected position of the measurement
    /// `[u, v]`, `v` down, pixels, with its derivatives (in the place of an image position and
    /// its). The noise of a measurement is not white there, and all parameters zero fit perfectly:
    /// it is offered for comparison.
    pub fn corrected_residual(
        &self,
        [x, y, z]: [f64; 3],
        measured_px: [f64; 2],
    ) -> Option<Projection> {
        let inverse = -1.0 / z;
        if !(inverse > 0.0 && inverse.is_finite()) {
            return None;
        }
        let direction = [x * inverse, y * inverse];
        let c = self.values[C];
        let at = self.centred(measured_px);
        let (corrected, jacobian) = self.ideal(at);
        let by_coefficients = self.ideal_by_coefficients(at);
        let mut by_parameters = [[0.0; MAX_PARAMETERS]; 2];
        for row in 0..2 {
            by_parameters[row][C] = direction[row];
            by_parameters[row][XP] = jacobian[row][0];
            by_parameters[row][YP] = jacobian[row][1];
            for k in 0..6 {
                by_parameters[row][K0 + k] = -by_coefficients[row][k];
            }
        }
        let scaled = c * inverse;
        let mut found = Projection {
            image_px: [c * direction[0] - corrected[0], c * direction[1] - corrected[1]],
            by_point: [[scaled, 0.0, scaled * direction[0]], [0.0, scaled, scaled * direction[1]]],
            by_parameters,
        };
        turn_down(&mut found);
        Some(found)
    }
}

/// From `y` up to `v` down.
fn turn_down(found: &mut Projection) {
    found.image_px[1] = -found.image_px[1];
    found.by_point[1].iter_mut().for_each(|v| *v = -*v);
    found.by_parameters[1].iter_mut().for_each(|v| *v = -*v);
}

impl BuiltInLens for Smac {
    const NAME: &'static str = "smac";
    const PARAMETERS: &'static [Parameter] = &PARAMETERS;

    fn from_values(values: &[f64], centre_px: [f64; 2]) -> Smac {
        Smac::new(first(values), centre_px)
    }

    #[inline]
    fn with_valid_radius(values: &[f64], centre_px: [f64; 2], valid_radius: f64) -> Smac {
        Smac::with_valid_radius(first(values), centre_px, valid_radius)
    }

    fn valid_radius(&self) -> f64 {
        self.valid_radius_px
    }

    fn centre_px(&self) -> Option<[f64; 2]> {
        Some(self.centre_px)
    }

    fn corrected_residual(&self, point: [f64; 3], measured_px: [f64; 2]) -> Option<Projection> {
        Smac::corrected_residual(self, point, measured_px)
    }

    #[inline]
    fn project_near(&self, point: [f64; 3], near_px: [f64; 2]) -> Option<[f64; 2]> {
        Smac::project_near(self, point, Some(near_px))
    }

    #[inline]
    fn project_with_derivatives_near(
        &self,
        point: [f64; 3],
        near_px: [f64; 2],
    ) -> Option<Projection> {
        Smac::project_with_derivatives_near(self, point, Some(near_px))
    }
}

impl Lens for Smac {
    fn parameters(&self) -> &'static [Parameter] {
        &PARAMETERS
    }

    fn values(&self) -> &[f64] {
        &self.values
    }

    fn project(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        self.project_near(point, None)
    }

    fn project_with_derivatives(&self, point: [f64; 3]) -> Option<Projection> {
        self.project_with_derivatives_near(point, None)
    }

    fn unproject(&self, image_px: [f64; 2]) -> Option<[f64; 3]> {
        let at = self.centred(image_px);
        let inside = at[0] * at[0] + at[1] * at[1] <= self.valid_radius_px * self.valid_radius_px;
        let (ideal, jacobian) = self.ideal(at);
        (inside && self.values[C] > 0.0 && inverse_2x2(jacobian).is_some())
            .then(|| unit([ideal[0], ideal[1], -self.values[C]]))
    }
}
