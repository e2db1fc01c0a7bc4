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

use crate::lanes::Lane;

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
