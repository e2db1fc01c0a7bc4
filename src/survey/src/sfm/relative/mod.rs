//! Relative orientation: how one camera stands to another, from points that both see.
//!
//! ```text
//! r2^T E r1 = 0,   E = [t]x R,   X2 = R X1 + t
//! ```
//!
//! A ray is `(x, y, -1)` in the camera frame of [`crate::camera::lens`] (`y` up, looking along `-z`);
//! [`Ray`] holds `(x, y)`, free of distortion. Distances are those in the plane `z = -1`: a
//! distance times the principal distance is about one in pixels.
//!
//! Two minimal solvers, [`two_point`] and [`five_point`], feed the same sampling ([`sample`]) and the
//! same refinement of all five parameters ([`coplanarity`]); [`estimate`] runs one of them, or takes
//! the one that explains a pair better.

pub mod coplanarity;
mod estimate;
pub mod five_point;
pub mod sample;
pub mod two_point;

pub use estimate::{Estimated, RelativePoseOptions, Solver, estimate};

use nalgebra::{Matrix3, Vector3};

/// An image position without distortion: the ray `(x, y, -1)` in the camera frame.
pub type Ray = [f64; 2];

/// A point seen by both cameras.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence {
    /// Its ray in the first.
    pub first: Ray,
    /// Its ray in the second.
    pub second: Ray,
}

/// `second_from_first`: `X2 = R X1 + t`, `t` of length 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RelativePose {
    /// The rotation `R`.
    pub rotation: Matrix3<f64>,
    /// The direction `t`.
    pub translation: Vector3<f64>,
}

/// The ray as a vector.
#[inline]
pub fn vector(ray: Ray) -> Vector3<f64> {
    Vector3::new(ray[0], ray[1], -1.0)
}

impl RelativePose {
    /// The essential matrix.
    pub fn essential(&self) -> Matrix3<f64> {
        self.translation.cross_matrix() * self.rotation
    }

    /// The other way round.
    pub fn inverse(&self) -> RelativePose {
        let back = self.rotation.transpose();
        RelativePose { rotation: back, translation: -(back * self.translation) }
    }

    /// Angle between the optical axes, radians.
    pub fn tilt_rad(&self) -> f64 {
        self.rotation[(2, 2)].clamp(-1.0, 1.0).acos()
    }

    /// Distances along both rays to where they come nearest, in units of the baseline; `None` for
    /// parallel rays.
    pub fn depths(&self, c: &Correspondence) -> Option<[f64; 2]> {
        // l2 r2 = l1 R r1 + t in the least-squares sense.
        let (a, b) = (self.rotation * vector(c.first), vector(c.second));
        let (aa, bb, ab) = (a.norm_squared(), b.norm_squared(), a.dot(&b));
        let determinant = aa * bb - ab * ab;
        if determinant < 1e-16 * aa * bb {
            return None;
        }
        let (at, bt) = (a.dot(&self.translation), b.dot(&self.translation));
        Some([(ab * bt - bb * at) / determinant, (aa * bt - ab * at) / determinant])
    }

    /// Whether a point is in front of both cameras.
    pub fn in_front(&self, c: &Correspondence) -> bool {
        self.depths(c).is_some_and(|[a, b]| a > 0.0 && b > 0.0)
    }
}

/// The squared distance of a correspondence from co-planarity (Sampson).
#[inline]
pub fn sampson_squared(e: &Matrix3<f64>, c: &Correspondence) -> f64 {
    let ([x1, y1], [x2, y2]) = (c.first, c.second);
    let (l0, l1, l2) = (
        e[(0, 0)] * x1 + e[(0, 1)] * y1 - e[(0, 2)],
        e[(1, 0)] * x1 + e[(1, 1)] * y1 - e[(1, 2)],
        e[(2, 0)] * x1 + e[(2, 1)] * y1 - e[(2, 2)],
    );
    let (m0, m1) =
        (e[(0, 0)] * x2 + e[(1, 0)] * y2 - e[(2, 0)], e[(0, 1)] * x2 + e[(1, 1)] * y2 - e[(2, 1)]);
    let value = l0 * x2 + l1 * y2 - l2;
    value * value / (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1).max(1e-300)
}

/// The four poses of an essential matrix, of which the one with most points in front of both
/// cameras is the answer; `None` where none has any.
pub fn pose_of_essential(
    e: &Matrix3<f64>,
    correspondences: &[Correspondence],
    inliers: &[u32],
) -> Option<RelativePose> {
    let svd = e.svd(true, true);
    let (mut u, mut vt) = (svd.u?, svd.v_t?);
    let mut order = [0usize, 1, 2];
    order.sort_by(|&a, &b| svd.singular_values[b].total_cmp(&svd.singular_values[a]));
    u = Matrix3::from_columns(&order.map(|k| u.column(k).into_owned()));
    vt = Matrix3::from_rows(&order.map(|k| vt.row(k).into_owned()));
    if u.determinant() < 0.0 {
        u = -u;
    }
    if vt.determinant() < 0.0 {
        vt = -vt;
    }
    let w = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let t = u.column(2).into_owned();
    let mut best: Option<(usize, RelativePose)> = None;
    for rotation in [u * w * vt, u * w.transpose() * vt] {
        for translation in [t, -t] {
            let pose = RelativePose { rotation, translation };
            let front =
                inliers.iter().filter(|&&k| pose.in_front(&correspondences[k as usize])).count();
            if front > 0 && best.as_ref().is_none_or(|(most, _)| front > *most) {
                best = Some((front, pose));
            }
        }
    }
    best.map(|(_, pose)| pose)
}
