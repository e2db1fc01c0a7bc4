//! Refinement of all five parameters by the linearised co-planarity condition, and the removal of
//! outliers by their parallaxes in the epipolar geometry.
//!
//! With `q = R r1` the condition is `F = r2 . (t x q) = 0`. For `R <- Exp(w) R` and `t <- t + B a`
//! (`B` spans what is orthogonal to `t`):
//!
//! ```text
//! dF = w . (q x (r2 x t)) + a . B^T (q x r2),
//! ```
//!
//! and `F` over its gradient in the image positions is a distance (Sampson). In the normalised
//! (epipolar-rectified) geometry of a pair, x along the baseline and z midway between both optical
//! axes, a point that is right has a y-parallax near 0 and an x-parallax of baseline over height,
//! which over a field flown at a nearly constant height is nearly the same for all.
//! Reference: F. He and A. Habib, as in [`super::two_point`].

use super::{Correspondence, RelativePose, sampson_squared, vector};
use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, Vector3};
use rowgram_optim::robust::{NORMAL_MAD_RATIO, median};

/// Gauss-Newton on the co-planarity of the correspondences within a tolerance, which are chosen
/// anew in every iteration; `None` where they do not determine the orientation.
pub fn refine(
    start: &RelativePose,
    correspondences: &[Correspondence],
    squared_tolerance: f64,
    iterations: usize,
) -> Option<RelativePose> {
    let mut pose = *start;
    for _ in 0..iterations {
        let e = pose.essential();
        let [b0, b1] = tangents(&pose.translation);
        let mut normal = SMatrix::<f64, 5, 5>::zeros();
        let mut right = SVector::<f64, 5>::zeros();
        let mut used = 0;
        for c in correspondences {
            let (row, value, squared_distance) = linearize(&pose, &e, c, &b0, &b1);
            if squared_distance <= squared_tolerance {
                // Tukey's weight: the border of the tolerance counts nothing.
                let share = 1.0 - squared_distance / squared_tolerance;
                let weight = share * share;
                normal.ger(weight, &row, &row, 1.0);
                right.axpy(-weight * value, &row, 1.0);
                used += 1;
            }
        }
        if used < 5 {
            return None;
        }
        // A planar scene with few points may leave a direction open.
        let damping = 1e-12 * normal.trace();
        (0..5).for_each(|k| normal[(k, k)] += damping);
        let step = normal.cholesky()?.solve(&right);
        if step.iter().any(|v| !v.is_finite()) {
            return None;
        }
        let turn = Rotation3::from_scaled_axis(Vector3::new(step[0], step[1], step[2]));
        pose.rotation = turn.into_inner() * pose.rotation;
        pose.translation = (pose.translation + b0 * step[3] + b1 * step[4]).normalize();
        if step.norm() < 1e-12 {
            break;
        }
    }
    pose.rotation = orthonormal(&pose.rotation);
    Some(pose)
}

/// Takes rounding out of a rotation.
fn orthonormal(m: &Matrix3<f64>) -> Matrix3<f64> {
    let x = m.column(0).normalize();
    let y = (m.column(1) - x * x.dot(&m.column(1))).normalize();
    Matrix3::from_columns(&[x, y, x.cross(&y)])
}

/// Two directions orthogonal to a unit vector and to each other.
fn tangents(t: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let axis = if t.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
    let first = t.cross(&axis).normalize();
    [first, t.cross(&first)]
}

/// The row of the Jacobian, the residual and its square.
#[inline]
fn linearize(
    pose: &RelativePose,
    e: &Matrix3<f64>,
    c: &Correspondence,
    b0: &Vector3<f64>,
    b1: &Vector3<f64>,
) -> (SVector<f64, 5>, f64, f64) {
    let (r1, r2) = (vector(c.first), vector(c.second));
    let q = pose.rotation * r1;
    let value = r2.dot(&pose.translation.cross(&q));
    let (line, back) = (e * r1, e.tr_mul(&r2));
    let gradient = line.x * line.x + line.y * line.y + back.x * back.x + back.y * back.y;
    let scale = 1.0 / gradient.max(1e-300).sqrt();
    let by_turn = q.cross(&r2.cross(&pose.translation)) * scale;
    let by_shift = q.cross(&r2) * scale;
    let row =
        SVector::from([by_turn.x, by_turn.y, by_turn.z, b0.dot(&by_shift), b1.dot(&by_shift)]);
    let distance = value * scale;
    (row, distance, distance * distance)
}

/// The turns of both cameras into the normalised geometry of their pair: x along the baseline from
/// the first to the second, z midway between the optical axes. `None` where the baseline runs along
/// them.
pub fn rectification(pose: &RelativePose) -> Option<[Matrix3<f64>; 2]> {
    let baseline = -pose.rotation.tr_mul(&pose.translation);
    let x = baseline.normalize();
    let z = Vector3::z() + pose.rotation.transpose() * Vector3::z();
    let z = z - x * x.dot(&z);
    if z.norm() < 0.2 {
        return None;
    }
    let z = z.normalize();
    let first = Matrix3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
    Some([first, first * pose.rotation.transpose()])
}

/// Image positions of a correspondence in the normalised geometry; `None` behind a camera.
#[inline]
pub fn rectified(turns: &[Matrix3<f64>; 2], c: &Correspondence) -> Option<[[f64; 2]; 2]> {
    let (a, b) = (turns[0] * vector(c.first), turns[1] * vector(c.second));
    (a.z < -1e-6 && b.z < -1e-6).then(|| [[a.x / -a.z, a.y / -a.z], [b.x / -b.z, b.y / -b.z]])
}

/// How far parallaxes may be off.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Band {
    /// Distance from co-planarity, as a distance in the plane `z = -1`.
    pub tolerance: f64,
    /// Robust standard deviations of the x-parallax about its centre; infinite where the height above
    /// the scene is anything.
    pub sigmas: f64,
    /// The share of the x-parallax that the relief may take at least.
    pub min_share: f64,
}

/// Which correspondences have the parallaxes of a point that is right.
pub fn by_parallax(
    pose: &RelativePose,
    correspondences: &[Correspondence],
    band: &Band,
) -> Vec<u32> {
    let Some(turns) = rectification(pose) else {
        return near(pose, correspondences, band.tolerance)
            .filter(|&k| pose.in_front(&correspondences[k as usize]))
            .collect();
    };
    let mut found: Vec<(u32, f64)> = Vec::new();
    for k in near(pose, correspondences, band.tolerance) {
        if let Some([a, b]) = rectified(&turns, &correspondences[k as usize]) {
            let parallax = a[0] - b[0];
            if parallax > 0.0 {
                found.push((k, parallax));
            }
        }
    }
    if found.len() < 3 || band.sigmas.is_infinite() {
        return found.into_iter().map(|(k, _)| k).collect();
    }
    let middle = |values: Vec<f64>| median(values).unwrap_or(0.0);
    let centre = middle(found.iter().map(|(_, p)| *p).collect());
    let deviation = middle(found.iter().map(|(_, p)| (p - centre).abs()).collect());
    let half = (band.sigmas * NORMAL_MAD_RATIO * deviation).max(band.min_share * centre);
    found.into_iter().filter(|(_, p)| (p - centre).abs() <= half).map(|(k, _)| k).collect()
}

fn near<'a>(
    pose: &RelativePose,
    correspondences: &'a [Correspondence],
    tolerance: f64,
) -> impl Iterator<Item = u32> + 'a {
    let e = pose.essential();
    (0..correspondences.len() as u32).filter(move |&k| {
        sampson_squared(&e, &correspondences[k as usize]) <= tolerance * tolerance
    })
}

/// Refinement and removal by turns until the inliers stay the same.
pub fn settle(
    start: &RelativePose,
    correspondences: &[Correspondence],
    band: &Band,
    rounds: usize,
) -> Option<(RelativePose, Vec<u32>)> {
    let mut pose = *start;
    let mut inliers = by_parallax(&pose, correspondences, band);
    for _ in 0..rounds {
        let inside: Vec<Correspondence> =
            inliers.iter().map(|&k| correspondences[k as usize]).collect();
        pose = refine(&pose, &inside, 4.0 * band.tolerance * band.tolerance, 5)?;
        let again = by_parallax(&pose, correspondences, band);
        if again == inliers {
            break;
        }
        inliers = again;
    }
    Some((pose, inliers))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn truth() -> RelativePose {
        RelativePose {
            rotation: Rotation3::from_scaled_axis(Vector3::new(0.03, -0.05, 0.4)).into_inner(),
            translation: Vector3::new(0.9, 0.3, 0.05).normalize(),
        }
    }

    fn seen(pose: &RelativePose) -> Vec<Correspondence> {
        (0..60)
            .map(|k| {
                let (u, v) = (f64::from(k % 10) / 5.0 - 1.0, f64::from(k / 10) / 3.0 - 1.0);
                let at = Vector3::new(1.5 * u, 1.2 * v, -3.0 - 0.1 * (7.0 * u + 3.0 * v).sin());
                let moved = pose.rotation * at + pose.translation;
                Correspondence {
                    first: [at.x / -at.z, at.y / -at.z],
                    second: [moved.x / -moved.z, moved.y / -moved.z],
                }
            })
            .collect()
    }

    #[test]
    fn the_row_is_the_derivative() {
        let pose = truth();
        // A correspondence that is off, so that the residual is not zero.
        let mut c = seen(&pose)[17];
        c.second[1] += 0.03;
        let value = |pose: &RelativePose| {
            vector(c.second).dot(&pose.translation.cross(&(pose.rotation * vector(c.first))))
        };
        let [b0, b1] = tangents(&pose.translation);
        let (row, distance, _) = linearize(&pose, &pose.essential(), &c, &b0, &b1);
        let scale = distance / value(&pose);
        let h = 1e-6;
        for k in 0..5 {
            let moved = |by: f64| {
                let mut p = pose;
                if k < 3 {
                    let mut axis = Vector3::zeros();
                    axis[k] = by;
                    p.rotation = Rotation3::from_scaled_axis(axis).into_inner() * p.rotation;
                } else {
                    p.translation += if k == 3 { b0 * by } else { b1 * by };
                }
                value(&p)
            };
            let numeric = (moved(h) - moved(-h)) / (2.0 * h) * scale;
            assert!((row[k] - numeric).abs() < 1e-8, "{k}: {} {numeric}", row[k]);
        }
    }

    #[test]
    fn wrong_points_go_and_the_orientation_comes_out() {
        let pose = truth();
        let mut all = seen(&pose);
        // On the epipolar line, but at a height that no field has: only the x-parallax tells.
        let turns = rectification(&pose).unwrap();
        let [a, b] = rectified(&turns, &all[5]).unwrap();
        let shifted = turns[1].transpose() * Vector3::new(b[0] + 0.5 * (a[0] - b[0]), b[1], -1.0);
        all[5].second = [shifted.x / -shifted.z, shifted.y / -shifted.z];
        // Off the epipolar line.
        all[9].second[1] += 0.1;
        let start = RelativePose {
            rotation: Rotation3::from_scaled_axis(Vector3::new(0.01, 0.02, -0.01)).into_inner()
                * pose.rotation,
            translation: (pose.translation + Vector3::new(0.02, -0.03, 0.02)).normalize(),
        };
        let band = Band { tolerance: 0.02, sigmas: 4.0, min_share: 0.05 };
        let (found, inliers) = settle(&start, &all, &band, 20).unwrap();
        assert!(!inliers.contains(&5) && !inliers.contains(&9));
        assert_eq!(inliers.len(), 58);
        assert!((found.rotation - pose.rotation).norm() < 1e-9);
        assert!((found.translation - pose.translation).norm() < 1e-9);
    }
}
