//! Two correspondences give the relative orientation of two nadir photos of the same height.
//!
//! With `R = Rz(kappa)` and `t = (bx, by, 0)` the essential matrix has four entries,
//!
//! ```text
//! e13 = by,  e23 = -bx,  e31 = bx sin k - by cos k,  e32 = bx cos k + by sin k,
//! e13^2 + e23^2 = e31^2 + e32^2,
//! ```
//!
//! and a correspondence of rays `(x, y, -1)` is one linear equation in them:
//!
//! ```text
//! x2 e13 + y2 e23 + x1 e31 + y1 e32 = 0.
//! ```
//!
//! Two of them leave a plane of solutions, in which the quadratic constraint has at most two
//! directions. Reference: F. He and A. Habib, *Automated relative orientation of UAV-based imagery in
//! the presence of prior information for the flight trajectory*, PE&RS 82(11), 2016.

use super::{Correspondence, RelativePose};
use nalgebra::{Matrix3, Vector3};

/// The at most two orientations of two correspondences. The sign of the baseline is left to whoever
/// knows which points are in front of the cameras.
pub fn solve(a: &Correspondence, b: &Correspondence, out: &mut Vec<RelativePose>) {
    let row = |c: &Correspondence| [c.second[0], c.second[1], c.first[0], c.first[1]];
    let Some([n, m]) = null_space(row(a), row(b)) else { return };
    // q(e) = e13^2 + e23^2 - e31^2 - e32^2 along cos(s) n + sin(s) m.
    let form = |u: &[f64; 4], v: &[f64; 4]| u[0] * v[0] + u[1] * v[1] - u[2] * v[2] - u[3] * v[3];
    let (nn, nm, mm) = (form(&n, &n), form(&n, &m), form(&m, &m));
    // nn c^2 + 2 nm c s + mm s^2 = 0 in the double angle: p cos 2s + q sin 2s + r = 0.
    let (p, q, r) = (0.5 * (nn - mm), nm, 0.5 * (nn + mm));
    let length = p.hypot(q);
    if length < 1e-14 || r.abs() > length {
        return;
    }
    let (middle, apart) = (q.atan2(p), (-r / length).acos());
    let count = if apart < 1e-12 { 1 } else { 2 };
    for sign in [1.0, -1.0].into_iter().take(count) {
        let (sine, cosine) = (0.5 * (middle + sign * apart)).sin_cos();
        let e: [f64; 4] = std::array::from_fn(|k| cosine * n[k] + sine * m[k]);
        out.extend(pose(e));
    }
}

fn pose([e13, e23, e31, e32]: [f64; 4]) -> Option<RelativePose> {
    let (bx, by) = (-e23, e13);
    let squared = bx * bx + by * by;
    if squared < 1e-14 {
        return None;
    }
    let cosine = (bx * e32 - by * e31) / squared;
    let sine = (bx * e31 + by * e32) / squared;
    let (norm, length) = (cosine.hypot(sine), squared.sqrt());
    if norm < 1e-12 {
        return None;
    }
    let (c, s) = (cosine / norm, sine / norm);
    Some(RelativePose {
        rotation: Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0),
        translation: Vector3::new(bx / length, by / length, 0.0),
    })
}

/// An orthonormal basis of what is orthogonal to two rows; `None` where they are parallel.
fn null_space(a: [f64; 4], b: [f64; 4]) -> Option<[[f64; 4]; 2]> {
    let dot = |u: &[f64; 4], v: &[f64; 4]| -> f64 { (0..4).map(|k| u[k] * v[k]).sum() };
    let unit = |v: [f64; 4]| -> Option<[f64; 4]> {
        let norm = dot(&v, &v).sqrt();
        (norm > 1e-12).then(|| v.map(|x| x / norm))
    };
    let mut basis = vec![unit(a)?];
    let without = |v: [f64; 4], basis: &[[f64; 4]]| {
        // Twice, because once leaves rounding behind.
        let mut v = v;
        for _ in 0..2 {
            for u in basis {
                let share = dot(&v, u);
                v = std::array::from_fn(|k| v[k] - share * u[k]);
            }
        }
        v
    };
    let rest = without(unit(b)?, &basis);
    if dot(&rest, &rest) < 1e-16 {
        return None;
    }
    basis.push(unit(rest)?);
    while basis.len() < 4 {
        // The axis that is farthest from what is there.
        let candidates = (0..4).map(|axis| {
            let mut v = [0.0; 4];
            v[axis] = 1.0;
            without(v, &basis)
        });
        let best = candidates.max_by(|u, v| dot(u, u).total_cmp(&dot(v, v)))?;
        basis.push(unit(best)?);
    }
    Some([basis[2], basis[3]])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sfm::relative::sampson_squared;

    #[test]
    fn a_flight_without_tilt_is_found_exactly() {
        for (kappa, bearing) in [(0.3f64, 1.1f64), (-2.9, 0.2), (3.1, -1.7), (0.0, 0.0)] {
            let (s, c) = kappa.sin_cos();
            let truth = RelativePose {
                rotation: Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0),
                translation: Vector3::new(bearing.cos(), bearing.sin(), 0.0),
            };
            let see = |x: f64, y: f64, z: f64| {
                let at = Vector3::new(x, y, -z);
                let moved = truth.rotation * at + truth.translation;
                Correspondence {
                    first: [x / z, y / z],
                    second: [moved.x / -moved.z, moved.y / -moved.z],
                }
            };
            let (a, b) = (see(0.4, -0.7, 2.9), see(-1.1, 0.5, 3.1));
            let mut found = Vec::new();
            solve(&a, &b, &mut found);
            assert!(!found.is_empty() && found.len() <= 2);
            for pose in &found {
                for c in [a, b] {
                    assert!(sampson_squared(&pose.essential(), &c) < 1e-24);
                }
            }
            let best = found
                .iter()
                .map(|pose| {
                    let turn = (pose.rotation - truth.rotation).norm();
                    let shift = (pose.translation - truth.translation)
                        .norm()
                        .min((pose.translation + truth.translation).norm());
                    turn + shift
                })
                .fold(f64::INFINITY, f64::min);
            assert!(best < 1e-9, "{kappa} {bearing}: {best}");
        }
    }

    #[test]
    fn the_same_correspondence_twice_gives_nothing() {
        let c = Correspondence { first: [0.1, 0.2], second: [0.3, -0.1] };
        let mut found = Vec::new();
        solve(&c, &c, &mut found);
        assert!(found.is_empty());
    }
}
