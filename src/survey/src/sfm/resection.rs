//! The pose of one image from points that are known and seen: three give at most four poses, sampling
//! finds the right one among outliers, least squares refines it.
//!
//! Three points: the law of cosines in the tetrahedron of the projection centre and the points, as
//! a quartic in the ratio of two distances. Reference: J. A. Grunert, 1841, in the form of
//! R. Haralick et al., *Review and analysis of solutions of the three point perspective pose estimation
//! problem*, IJCV 13(3), 1994.

use super::{
    polynomial::real_roots,
    relative::sample::{Sampled, Samples, Sampling, sample},
};
use crate::{
    camera::{Interior, Lens},
    scene::Pose,
};
use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rowgram_optim::geometry::{dot, rotation};

/// A known point and where an image shows it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence2d3d {
    /// In the world.
    pub point: [f64; 3],
    /// Pixels.
    pub image_px: [f64; 2],
    /// The unit direction to it in the camera frame.
    pub ray: [f64; 3],
}

struct Sights<'a> {
    sights: &'a [Correspondence2d3d],
    lens: &'a Interior,
}

/// The pose of an image from what it sees of known points, with the inliers within `tolerance_px`.
pub fn resect(
    sights: &[Correspondence2d3d],
    lens: &Interior,
    tolerance_px: f64,
    seed: u64,
) -> Option<Sampled<Pose>> {
    let sampling = Sampling {
        tolerance: tolerance_px,
        coarse: 2.0,
        confidence: 0.9999,
        least: 20,
        most: 2000,
    };
    sample(&Sights { sights, lens }, &sampling, &mut ChaCha8Rng::seed_from_u64(seed))
}

impl Samples for Sights<'_> {
    type Model = Pose;
    const SIZE: usize = 3;

    fn count(&self) -> usize {
        self.sights.len()
    }

    fn solve(&self, sample: &[usize], out: &mut Vec<Pose>) {
        three_points(std::array::from_fn(|k| &self.sights[sample[k]]), out);
    }

    fn squared_distance(&self, pose: &Pose, datum: usize) -> f64 {
        let sight = &self.sights[datum];
        match self.lens.project(pose.to_camera(sight.point)) {
            Some([u, v]) => (u - sight.image_px[0]).powi(2) + (v - sight.image_px[1]).powi(2),
            None => f64::INFINITY,
        }
    }

    fn refine(&self, pose: &Pose, squared_tolerance: f64) -> Option<Pose> {
        refine(pose, self.sights, self.lens, squared_tolerance, 4)
    }
}

/// Gauss-Newton on the image positions within a tolerance; `None` where they do not determine the
/// pose.
pub fn refine(
    start: &Pose,
    sights: &[Correspondence2d3d],
    lens: &Interior,
    squared_tolerance: f64,
    iterations: usize,
) -> Option<Pose> {
    let mut pose = *start;
    for _ in 0..iterations {
        let mut normal = SMatrix::<f64, 6, 6>::zeros();
        let mut right = SVector::<f64, 6>::zeros();
        let mut used = 0;
        for sight in sights {
            let p = pose.to_camera(sight.point);
            let Some(found) = lens.project_with_derivatives(p) else { continue };
            let r: [f64; 2] = std::array::from_fn(|k| found.image_px[k] - sight.image_px[k]);
            let share = 1.0 - (r[0] * r[0] + r[1] * r[1]) / squared_tolerance;
            if share <= 0.0 {
                continue;
            }
            used += 1;
            for k in 0..2 {
                let j = found.by_point[k];
                let turn = rowgram_optim::geometry::cross(p, j);
                let row = SVector::from([turn[0], turn[1], turn[2], j[0], j[1], j[2]]);
                normal.ger(share * share, &row, &row, 1.0);
                right.axpy(-share * share * r[k], &row, 1.0);
            }
        }
        if used < 3 {
            return None;
        }
        let step = normal.cholesky()?.solve(&right);
        let turn = rotation::exp([step[0], step[1], step[2]]);
        pose = Pose {
            rotation: rotation::normalize(rotation::multiply(turn, pose.rotation)),
            translation: {
                let t = rotation::rotate(turn, pose.translation);
                std::array::from_fn(|k| t[k] + step[3 + k])
            },
        };
        if pose.translation.iter().any(|v| !v.is_finite()) {
            return None;
        }
        if step.norm() < 1e-12 {
            break;
        }
    }
    Some(pose)
}

/// All poses that put three points onto their rays.
pub fn three_points(three: [&Correspondence2d3d; 3], out: &mut Vec<Pose>) {
    let x = three.map(|sight| Vector3::from(sight.point));
    let f = three.map(|sight| sight.ray);
    let (a2, b2, c2) =
        ((x[1] - x[2]).norm_squared(), (x[0] - x[2]).norm_squared(), (x[0] - x[1]).norm_squared());
    if a2.min(b2).min(c2) < 1e-18 * a2.max(b2).max(c2) || b2 <= 0.0 {
        return;
    }
    let (alpha, beta, gamma) = (dot(f[1], f[2]), dot(f[0], f[2]), dot(f[0], f[1]));
    let (p, q, r) = (a2 / b2, c2 / b2, (a2 - c2) / b2);
    let quartic = [
        (1.0 + r).powi(2) - 4.0 * p * gamma * gamma,
        4.0 * (-r * (1.0 + r) * beta + 2.0 * p * gamma * gamma * beta
            - (1.0 - p - q) * alpha * gamma),
        2.0 * (r * r - 1.0 + 2.0 * r * r * beta * beta + 2.0 * (1.0 - q) * alpha * alpha
            - 4.0 * (p + q) * alpha * beta * gamma
            + 2.0 * (1.0 - p) * gamma * gamma),
        4.0 * (r * (1.0 - r) * beta - (1.0 - p - q) * alpha * gamma
            + 2.0 * q * alpha * alpha * beta),
        (r - 1.0).powi(2) - 4.0 * q * alpha * alpha,
    ];
    for v in real_roots(&quartic, 1e4) {
        let below = 2.0 * (gamma - v * alpha);
        if v <= 0.0 || below.abs() < 1e-12 {
            continue;
        }
        let u = ((r - 1.0) * v * v - 2.0 * r * beta * v + 1.0 + r) / below;
        let squared = b2 / (1.0 + v * v - 2.0 * v * beta);
        if u <= 0.0 || !squared.is_finite() || squared <= 0.0 {
            continue;
        }
        let s = squared.sqrt();
        let seen = [s, u * s, v * s];
        let y: [Vector3<f64>; 3] = std::array::from_fn(|k| Vector3::from(f[k]) * seen[k]);
        out.extend(between(&x, &y));
    }
}

/// The pose that takes one triangle onto a congruent one.
fn between(x: &[Vector3<f64>; 3], y: &[Vector3<f64>; 3]) -> Option<Pose> {
    let frame = |p: &[Vector3<f64>; 3]| -> Option<Matrix3<f64>> {
        let first = (p[1] - p[0]).try_normalize(1e-300)?;
        let third = first.cross(&(p[2] - p[0])).try_normalize(1e-300)?;
        Some(Matrix3::from_columns(&[first, third.cross(&first), third]))
    };
    let turn = frame(y)? * frame(x)?.transpose();
    let middle = |p: &[Vector3<f64>; 3]| (p[0] + p[1] + p[2]) / 3.0;
    let shift = middle(y) - turn * middle(x);
    Some(Pose { rotation: quaternion(&turn), translation: shift.into() })
}

/// The quaternion of a rotation matrix.
pub fn quaternion(m: &Matrix3<f64>) -> rotation::Quaternion {
    let q = UnitQuaternion::from_matrix(m);
    rotation::normalize([q.w, q.i, q.j, q.k])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Model;
    use rand::RngExt;

    fn lens() -> Interior {
        Interior::new(
            Model::Brown,
            [1000, 750],
            &[900.0, 1.0, 505.0, 370.0, -0.08, 0.01, 1e-4, -2e-4, 0.0, 0.0, 0.0, 0.0],
        )
        .unwrap()
    }

    fn sights(pose: &Pose, count: usize, rng: &mut ChaCha8Rng) -> Vec<Correspondence2d3d> {
        let lens = lens();
        let mut out = Vec::new();
        while out.len() < count {
            let point = [
                rng.random_range(-20.0..20.0),
                rng.random_range(-20.0..20.0),
                rng.random_range(-3.0..3.0),
            ];
            let Some(image_px) = lens.project(pose.to_camera(point)) else { continue };
            let inside =
                (0.0..1000.0).contains(&image_px[0]) && (0.0..750.0).contains(&image_px[1]);
            if let (true, Some(ray)) = (inside, lens.unproject(image_px)) {
                out.push(Correspondence2d3d { point, image_px, ray });
            }
        }
        out
    }

    #[test]
    fn three_points_know_the_pose() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for k in 0..100 {
            let pose = Pose::from_centre(
                rotation::exp([0.1, -0.2 + 0.003 * f64::from(k), 0.05 * f64::from(k)]),
                [1.0, -2.0, 30.0],
            );
            let seen = sights(&pose, 3, &mut rng);
            let mut found = Vec::new();
            three_points([&seen[0], &seen[1], &seen[2]], &mut found);
            let nearest = found
                .iter()
                .map(|p| {
                    let (a, b) = (p.centre_m(), pose.centre_m());
                    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt()
                })
                .fold(f64::INFINITY, f64::min);
            assert!(nearest < 1e-4, "{k}: {nearest} of {}", found.len());
        }
    }

    #[test]
    fn half_of_the_points_may_be_wrong() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let pose = Pose::from_centre(rotation::exp([0.05, 0.1, 2.0]), [3.0, 1.0, 25.0]);
        let mut seen = sights(&pose, 60, &mut rng);
        for k in 0..30 {
            seen[2 * k].point[0] += 5.0 + f64::from(k as u32);
        }
        let found = resect(&seen, &lens(), 2.0, 7).unwrap();
        assert_eq!(found.inliers.len(), 30);
        let (a, b) = (found.model.centre_m(), pose.centre_m());
        assert!((0..3).all(|k| (a[k] - b[k]).abs() < 1e-6));
    }
}
