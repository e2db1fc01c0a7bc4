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

/// Interior orientation `[f_px, k1, k2]`.
pub type Interior = [f64; 3];

/// An image position and how it changes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection {
    /// Position in pixels from the image centre, `u` right and `v` up.
    pub image_px: [f64; 2],
    /// `2 x 3`: by the point in the camera frame.
    pub by_point: [[f64; 3]; 2],
    /// `2 x 3`: by `f`, `k1`, `k2`.
    pub by_interior: [[f64; 3]; 2],
}

/// The position alone; `None` in the plane of the projection centre, where there is none.
#[inline]
pub fn project([x, y, z]: [f64; 3], [f, k1, k2]: Interior) -> Option<[f64; 2]> {
    if z == 0.0 {
        return None;
    }
    let p = [-x / z, -y / z];
    let square = p[0] * p[0] + p[1] * p[1];
    let scale = f * (1.0 + square * (k1 + square * k2));
    Some([scale * p[0], scale * p[1]])
}

/// The position and its derivatives; `None` as [`project`].
#[inline]
pub fn project_with_derivatives([x, y, z]: [f64; 3], [f, k1, k2]: Interior) -> Option<Projection> {
    if z == 0.0 {
        return None;
    }
    let inverse = 1.0 / z;
    let p = [-x * inverse, -y * inverse];
    let square = p[0] * p[0] + p[1] * p[1];
    let distortion = 1.0 + square * (k1 + square * k2);
    let slope = f * (2.0 * k1 + 4.0 * k2 * square);
    let scale = f * distortion;
    // du/dp, symmetric
    let (a, b, c) = (scale + slope * p[0] * p[0], slope * p[0] * p[1], scale + slope * p[1] * p[1]);
    // dp/dP = 1/z [-1 0 -p_x; 0 -1 -p_y]
    let row = |left: f64, right: f64| {
        [-inverse * left, -inverse * right, -inverse * (left * p[0] + right * p[1])]
    };
    Some(Projection {
        image_px: [scale * p[0], scale * p[1]],
        by_point: [row(a, b), row(b, c)],
        by_interior: [0, 1]
            .map(|k| [distortion * p[k], f * square * p[k], f * square * square * p[k]]),
    })
}
