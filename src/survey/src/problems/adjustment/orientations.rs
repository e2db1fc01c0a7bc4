//! Measured orientations of cameras as observations: every one has its own error, and all of a camera share two.
//!
//! ```text
//! R_i^T = exp(e_i) exp(w) R_i0^T exp(b),   e_i ~ (0, s_i^2),   w ~ (0, s_w^2),   b ~ (0, s_b^2)
//! ```
//!
//! with the rotation `R_i` from the mapping frame to the camera and `R_i0` that which the gimbal tells. `w` turns with the
//! mapping frame: what an inertial unit takes for level is not, and north of a compass is neither that of the grid. `b` turns
//! with the camera: how it hangs in its mount (boresight). Neither becomes smaller with the number of photos, so that a gimbal
//! never outweighs a receiver that says where down is. All are rotation vectors, radians.
//!
//! With `E = R_i^T exp(-b) R_i0 exp(-w)`, `e = log E` and the left Jacobian `J` of the rotations,
//! `de = -J(e)^-1 R_i^T ds - J(e)^-1 R_i^T J(-b) db - J(-e)^-1 J(w) dw` for a turn `ds` of the camera.

use super::{
    problem::AdjustmentProblem,
    settings::{Group, Settings},
};
use crate::scene::Reconstruction;
use nalgebra::{Matrix3, Vector3};
use rowgram_optim::{
    engine::SolveError,
    geometry::rotation::{self, Quaternion},
    nlls::{BlockId, Euclidean, Factor, GaussianPrior, Infeasible, Jacobian},
};

/// What all orientations of a camera are off by about the axes of the mapping frame: of an inertial unit about east and north; of
/// a compass, with declination and convergence of meridians, about the vertical. Radians. Assumed, not measured on a drone.
pub const ATTITUDE_BIAS_SIGMA_RAD: [f64; 3] = [0.0035, 0.0035, 0.2];
/// How far a camera hangs from where its gimbal points, about each axis of the camera, radians. Assumed, not measured on a drone.
pub const BORESIGHT_SIGMA_RAD: f64 = 0.05;

/// A measured orientation: blocks image, then `w` and `b` of its camera.
#[derive(Debug, Clone)]
struct OrientationFactor {
    blocks: [BlockId; 2],
    rotation: Quaternion,
    sigma_rad: [f64; 3],
}

fn skew(v: Vector3<f64>) -> Matrix3<f64> {
    v.cross_matrix()
}

/// `exp(v + dv) = exp(J dv) exp(v)`.
fn left_jacobian(v: Vector3<f64>) -> Matrix3<f64> {
    let angle = v.norm();
    let (a, b) = if angle < 1e-4 {
        (0.5, 1.0 / 6.0)
    } else {
        ((1.0 - angle.cos()) / (angle * angle), (angle - angle.sin()) / angle.powi(3))
    };
    Matrix3::identity() + a * skew(v) + b * skew(v) * skew(v)
}

fn inverse_left_jacobian(v: Vector3<f64>) -> Matrix3<f64> {
    let angle = v.norm();
    let a = if angle < 1e-4 {
        1.0 / 12.0
    } else {
        1.0 / (angle * angle) - (1.0 + angle.cos()) / (2.0 * angle * angle.sin())
    };
    Matrix3::identity() - 0.5 * skew(v) + a * skew(v) * skew(v)
}

impl Factor for OrientationFactor {
    fn rows(&self) -> usize {
        3
    }

    fn blocks(&self) -> &[BlockId] {
        &self.blocks
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        let w = [x[1][0], x[1][1], x[1][2]];
        let b = [x[1][3], x[1][4], x[1][5]];
        let back = rotation::inverse([x[0][0], x[0][1], x[0][2], x[0][3]]);
        let expected = rotation::multiply(
            rotation::exp(b.map(|v| -v)),
            rotation::multiply(self.rotation, rotation::exp(w.map(|v| -v))),
        );
        let e = rotation::log(rotation::multiply(back, expected));
        for ((residual, error), sigma) in residual.iter_mut().zip(e).zip(self.sigma_rad) {
            *residual = error / sigma;
        }
        let Some(jacobian) = jacobian else { return Ok(()) };
        let (e, w, b) = (Vector3::from(e), Vector3::from(w), Vector3::from(b));
        let rows = rotation::matrix(back);
        let turn = -inverse_left_jacobian(e) * Matrix3::from_fn(|r, c| rows[r][c]);
        let by_mount = turn * left_jacobian(-b);
        let by_common = -inverse_left_jacobian(-e) * left_jacobian(w);
        for (k, sigma) in self.sigma_rad.iter().enumerate() {
            let row = jacobian.row(k);
            let common = row.len() - 6;
            for c in 0..3 {
                row[c] = turn[(k, c)] / sigma;
                row[common + c] = by_common[(k, c)] / sigma;
                row[common + 3 + c] = by_mount[(k, c)] / sigma;
            }
        }
        Ok(())
    }
}

impl AdjustmentProblem {
    /// Adds the measured orientations, with the errors that those of a camera share.
    pub(super) fn add_orientations(
        &mut self,
        reconstruction: &Reconstruction,
        settings: &Settings,
    ) -> Result<(), SolveError> {
        let factor = settings.factor(Group::Orientations);
        let camera_of = |image: u32| reconstruction.images[image as usize].camera;
        let mut common = vec![None; reconstruction.cameras.len()];
        let mut priors = Vec::new();
        let mut cameras = Vec::new();
        for (camera, block) in common.iter_mut().enumerate() {
            if !reconstruction.orientations.iter().any(|known| camera_of(known.image) == camera) {
                continue;
            }
            let added =
                self.problem.block("attitude bias and boresight", Euclidean(6), &[0.0; 6])?;
            let mut sigmas = [BORESIGHT_SIGMA_RAD; 6];
            sigmas[..3].copy_from_slice(&ATTITUDE_BIAS_SIGMA_RAD);
            priors.push(GaussianPrior::new(&self.problem, added, &[0.0; 6], &sigmas)?);
            cameras.push(camera);
            *block = Some(added);
        }
        let mut factors = Vec::new();
        let mut subjects = Vec::new();
        for (k, known) in reconstruction.orientations.iter().enumerate() {
            let Some(common) = common[camera_of(known.image)] else { continue };
            factors.push(OrientationFactor {
                blocks: [self.images[known.image as usize], common],
                rotation: known.rotation,
                sigma_rad: known.sigma_rad.map(|sigma| sigma * factor),
            });
            subjects.push(k);
        }
        self.attitude_biases = common;
        self.add(Group::Orientations, "camera orientations", factors, subjects)?;
        self.add(Group::Orientations, "attitude biases and boresights", priors, cameras)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_optim::nlls::{
        Factors, Loss, Options, Problem, check::check_jacobian, manifold, solve,
    };

    const RECORD: [f64; 6] = [0.02, -0.01, 0.15, 0.03, -0.05, 0.08];

    fn problem() -> (Problem, OrientationFactor) {
        let mut problem = Problem::new();
        let pose = rotation::exp([0.4, -0.3, 2.0]);
        let mut values = pose.to_vec();
        values.extend([1.0, 2.0, 3.0]);
        let image = problem.block("image", manifold::PoseWithParameters(0), &values).unwrap();
        let common = problem.block("record", Euclidean(6), &RECORD).unwrap();
        let rotation = rotation::multiply(rotation::exp([0.2, -0.1, 0.3]), pose);
        let factor =
            OrientationFactor { blocks: [image, common], rotation, sigma_rad: [0.01, 0.02, 0.3] };
        (problem, factor)
    }

    #[test]
    fn derivatives_are_those_of_the_residual() {
        let (problem, factor) = problem();
        let x = problem.start();
        let pose = manifold::PoseWithParameters(0);
        let found = check_jacobian(&factor, &[&pose, &Euclidean(6)], &[&x[..7], &x[7..]]).unwrap();
        assert!(found.error < 1e-7, "{found:?}");
    }

    #[test]
    fn a_camera_that_nothing_else_holds_is_turned_to_where_its_gimbal_points() {
        let (mut problem, factor) = problem();
        let [image, common] = factor.blocks;
        let observed = factor.rotation;
        problem.fix_entries(image, &[3, 4, 5]).unwrap();
        problem.fix_entries(common, &[0, 1, 2, 3, 4, 5]).unwrap();
        problem.add("orientation", Loss::Trivial, Factors(vec![factor])).unwrap();
        let mut x = problem.start();
        solve(&problem, &mut x, &Options::default(), 50).unwrap();
        // R^T = exp(w) R_0^T exp(b).
        let [w, b] = [[0, 1, 2], [3, 4, 5]].map(|at| at.map(|k| RECORD[k]));
        let back = rotation::multiply(
            rotation::exp(w),
            rotation::multiply(rotation::inverse(observed), rotation::exp(b)),
        );
        let left = rotation::log(rotation::multiply([x[0], x[1], x[2], x[3]], back));
        assert!(left.iter().all(|v| v.abs() < 1e-6), "{left:?}");
    }
}
