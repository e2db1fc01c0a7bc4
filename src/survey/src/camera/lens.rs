//! What every lens model is: a map from the camera frame to pixels, with derivatives.
//!
//! # Frames
//! *Camera frame* (photogrammetric): `x` right, `y` **up**, looking along `-z`, origin at the
//! projection centre; any unit of length. *Image*: `u` right, `v` **down**, pixels, **the centre of
//! the top-left pixel is (0, 0)**. [`to_computer_vision`] is the one conversion to the frame of
//! computer vision (`y` down, looking along `+z`); it is its own inverse.
//!
//! # Invariants, each a test
//! 1. `project(unproject(u)) = u` wherever both answer;
//! 2. the derivatives are those of `project`;
//! 3. a point behind the camera, or outside the radius up to which the model is one to one, has no
//!    image: `None`, never a wrong pixel.

use std::fmt::Debug;

/// The most parameters of any built-in model.
pub const MAX_PARAMETERS: usize = 12;

/// One parameter of a lens model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Parameter {
    /// Its name in files and reports; a length in pixels ends in `_px`.
    pub name: &'static str,
    /// Its unit.
    pub unit: &'static str,
    /// Whether an adjustment may estimate it; what is not is a constant of the model.
    pub estimable: bool,
}

impl Parameter {
    /// A parameter that an adjustment may estimate.
    pub(super) const fn new(name: &'static str, unit: &'static str) -> Parameter {
        Parameter { name, unit, estimable: true }
    }
}

/// An image position and how it changes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection {
    /// `[u, v]`, pixels.
    pub image_px: [f64; 2],
    /// `2 x 3`: by the point in the camera frame.
    pub by_point: [[f64; 3]; 2],
    /// `2 x parameters`: by the parameters in the order of [`Lens::parameters`]; the rest is 0.
    pub by_parameters: [[f64; MAX_PARAMETERS]; 2],
}

/// A lens model with its parameters.
pub trait Lens: Debug + Send + Sync {
    /// Its parameters, in the order of [`Lens::values`].
    fn parameters(&self) -> &'static [Parameter];

    /// The values of the parameters.
    fn values(&self) -> &[f64];

    /// The pixel `[u, v]` of a point in the camera frame.
    fn project(&self, point: [f64; 3]) -> Option<[f64; 2]>;

    /// The pixel and its derivatives.
    fn project_with_derivatives(&self, point: [f64; 3]) -> Option<Projection>;

    /// The unit direction, in the camera frame, of all points whose image is the pixel `[u, v]`.
    fn unproject(&self, image_px: [f64; 2]) -> Option<[f64; 3]>;
}

/// Takes a vector from the photogrammetric camera frame (`y` up, looking along `-z`) to that of
/// computer vision (`y` down, looking along `+z`), or back.
#[inline]
pub fn to_computer_vision([x, y, z]: [f64; 3]) -> [f64; 3] {
    [x, -y, -z]
}

/// Solves a 2 x 2 system by its determinant; `None` where that is not positive: the map has folded
/// over.
#[inline]
pub(super) fn inverse_2x2(m: [[f64; 2]; 2]) -> Option<[[f64; 2]; 2]> {
    let determinant = m[0][0] * m[1][1] - m[0][1] * m[1][0];
    (determinant > 0.0).then(|| {
        let d = 1.0 / determinant;
        [[m[1][1] * d, -m[0][1] * d], [-m[1][0] * d, m[0][0] * d]]
    })
}

/// `m v`.
#[inline]
pub(super) fn times(m: &[[f64; 2]; 2], v: [f64; 2]) -> [f64; 2] {
    [m[0][0] * v[0] + m[0][1] * v[1], m[1][0] * v[0] + m[1][1] * v[1]]
}

/// `v` scaled to unit length.
#[inline]
pub(super) fn unit(v: [f64; 3]) -> [f64; 3] {
    let norm = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    [v[0] / norm, v[1] / norm, v[2] / norm]
}

/// Newton's method in the plane for `map(p) = target` from `p`; `map` gives value and Jacobian.
/// `None` where it folds over or does not settle.
#[inline]
pub(super) fn newton_2d(
    target: [f64; 2],
    mut p: [f64; 2],
    scale: f64,
    map: impl Fn([f64; 2]) -> ([f64; 2], [[f64; 2]; 2]),
) -> Option<[f64; 2]> {
    // Newton's method squares the error: after a step this short it is below rounding, even where the
    // map has nearly folded over.
    let small = scale * 1e-10 + 1e-300;
    for _ in 0..30 {
        let (value, jacobian) = map(p);
        let step = times(&inverse_2x2(jacobian)?, [target[0] - value[0], target[1] - value[1]]);
        p = [p[0] + step[0], p[1] + step[1]];
        if step[0].abs().max(step[1].abs()) <= small {
            return Some(p);
        }
    }
    None
}
