//! The camera of *Bundle Adjustment in the Large* (Agarwal et al., ECCV 2010).
//!
//! ```text
//! P = R X + t            camera frame, looking along -z, y up
//! p = -(P_x, P_y) / P_z
//! u = f (1 + k1 |p|^2 + k2 |p|^4) p      pixels from the image centre, right and up
//! ```
//!
//! The formula is taken as it stands: a point behind the camera has an image too, as in every
//! program whose costs are compared on these files.

use super::{
    interior::{BuiltInLens, first},
    lens::{self, Lens, MAX_PARAMETERS, Parameter, unit},
    polynomial,
};
use rowgram_optim::lanes::Lane;

/// Interior orientation `[f_px, k1, k2]`.
pub type Interior = [f64; 3];

/// An image position and how it changes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection<L> {
    /// Position in pixels from the image centre, `u` right and `v` up.
    pub image_px: [L; 2],
    /// `2 x 3`: by the point in the camera frame.
    pub by_point: [[L; 3]; 2],
    /// `2 x 3`: by `f`, `k1`, `k2`.
    pub by_interior: [[L; 3]; 2],
}

/// The position alone; not finite in the plane of the projection centre, where there is none.
#[inline(always)]
pub fn project<L: Lane>([x, y, z]: [L; 3], [f, k1, k2]: [L; 3]) -> [L; 2] {
    let inverse = z.like(-1.0) / z;
    let p = [x * inverse, y * inverse];
    let square = p[0].mul_add(p[0], p[1] * p[1]);
    let scale = f * square.mul_add(square.mul_add(k2, k1), z.like(1.0));
    [scale * p[0], scale * p[1]]
}

/// The position and its derivatives; not finite as [`project`].
#[inline(always)]
pub fn project_with_derivatives<L: Lane>([x, y, z]: [L; 3], [f, k1, k2]: [L; 3]) -> Projection<L> {
    let inverse = z.like(-1.0) / z;
    let p = [x * inverse, y * inverse];
    let square = p[0].mul_add(p[0], p[1] * p[1]);
    let distortion = square.mul_add(square.mul_add(k2, k1), z.like(1.0));
    let slope = f * (k1 * 2.0 + k2 * square * 4.0);
    let scale = f * distortion;
    // du/dp, symmetric
    let mixed = slope * p[0] * p[1];
    let along = [(slope * p[0]).mul_add(p[0], scale), (slope * p[1]).mul_add(p[1], scale)];
    let fs = f * square;
    Projection {
        image_px: [scale * p[0], scale * p[1]],
        by_point: [through(p, inverse, along[0], mixed), through(p, inverse, mixed, along[1])],
        by_interior: [
            [distortion * p[0], fs * p[0], fs * square * p[0]],
            [distortion * p[1], fs * p[1], fs * square * p[1]],
        ],
    }
}

/// A row `[left right]` of `du/dp` times `dp/dP = -1/z [1 0 p_x; 0 1 p_y]`.
#[inline(always)]
fn through<L: Lane>(p: [L; 2], inverse: L, left: L, right: L) -> [L; 3] {
    [inverse * left, inverse * right, inverse * left.mul_add(p[0], right * p[1])]
}

/// Number of parameters.
pub const COUNT: usize = 3;
/// The parameters.
pub static PARAMETERS: [Parameter; COUNT] =
    [Parameter::new("f_px", "px"), Parameter::new("k1", "1"), Parameter::new("k2", "1")];

/// The same model as a lens: with an image centre, and without images of points behind the camera
/// or beyond the radius up to which it is one to one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bal {
    values: Interior,
    centre_px: [f64; 2],
    valid_radius: f64,
}

impl Bal {
    /// A lens with these values and the image's centre, pixels.
    pub fn new(values: Interior, centre_px: [f64; 2]) -> Bal {
        let slope = [1.0, 3.0 * values[1], 5.0 * values[2]];
        let turn = polynomial::smallest_positive_root(&slope).map_or(f64::INFINITY, f64::sqrt);
        Bal { values, centre_px, valid_radius: turn }
    }

    /// The lens of values whose valid radius is known.
    pub(super) fn with_valid_radius(
        values: Interior,
        centre_px: [f64; 2],
        valid_radius: f64,
    ) -> Bal {
        Bal { values, centre_px, valid_radius }
    }

    /// The tangent of the angle from the axis up to which the model is one to one; infinite where
    /// it is so everywhere.
    pub fn valid_radius(&self) -> f64 {
        self.valid_radius
    }

    fn sees(&self, [x, y, z]: [f64; 3]) -> bool {
        z < 0.0 && x * x + y * y <= self.valid_radius * self.valid_radius * z * z
    }
}

impl BuiltInLens for Bal {
    const NAME: &'static str = "bal";
    const PARAMETERS: &'static [Parameter] = &PARAMETERS;

    fn from_values(values: &[f64], centre_px: [f64; 2]) -> Bal {
        Bal::new(first(values), centre_px)
    }

    #[inline]
    fn with_valid_radius(values: &[f64], centre_px: [f64; 2], valid_radius: f64) -> Bal {
        Bal::with_valid_radius(first(values), centre_px, valid_radius)
    }

    fn valid_radius(&self) -> f64 {
        self.valid_radius
    }

    fn centre_px(&self) -> Option<[f64; 2]> {
        Some(self.centre_px)
    }
}

impl Lens for Bal {
    fn parameters(&self) -> &'static [Parameter] {
        &PARAMETERS
    }

    fn values(&self) -> &[f64] {
        &self.values
    }

    fn project(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        let [x, y] = self.sees(point).then(|| project(point, self.values))?;
        Some([self.centre_px[0] + x, self.centre_px[1] - y])
    }

    fn project_with_derivatives(&self, point: [f64; 3]) -> Option<lens::Projection> {
        let found = self.sees(point).then(|| project_with_derivatives(point, self.values))?;
        let mut by_parameters = [[0.0; MAX_PARAMETERS]; 2];
        by_parameters[0][..COUNT].copy_from_slice(&found.by_interior[0]);
        by_parameters[1][..COUNT].copy_from_slice(&found.by_interior[1].map(|v| -v));
        Some(lens::Projection {
            image_px: [
                self.centre_px[0] + found.image_px[0],
                self.centre_px[1] - found.image_px[1],
            ],
            by_point: [found.by_point[0], found.by_point[1].map(|v| -v)],
            by_parameters,
        })
    }

    fn unproject(&self, image_px: [f64; 2]) -> Option<[f64; 3]> {
        let [f, k1, k2] = self.values;
        let at = [(image_px[0] - self.centre_px[0]) / f, (self.centre_px[1] - image_px[1]) / f];
        let far = (at[0] * at[0] + at[1] * at[1]).sqrt();
        let radius = polynomial::invert_monotonic(far, self.valid_radius, |r| {
            let (q, dq) = polynomial::evaluate(&[1.0, k1, k2], r * r);
            (r * q, q + 2.0 * r * r * dq)
        })?;
        let ratio = if far > 0.0 { radius / far } else { 0.0 };
        far.is_finite().then(|| unit([at[0] * ratio, at[1] * ratio, -1.0]))
    }
}
