//! Bundle adjustment: cameras, lenses and points from image measurements.
//!
//! ```text
//! r_ij = u(R_i X_j + t_i, interior_i) - u_ij      pixels
//! ```
//!
//! over `camera_from_world` poses `(R_i, t_i)`, interior orientations and points `X_j` in the world
//! frame, for the camera of [`crate::camera::bal`]. The gauge is free: nothing is fixed, the damped
//! steps choose the frame nearest to the start, as is the custom for these files.

use crate::{
    camera::bal,
    engine::SolveError,
    geometry::{cross, rotation},
    nlls::{BlockId, Factor, Factors, Infeasible, Jacobian, Loss, Problem, Space},
};
use serde::{Deserialize, Serialize};

/// A camera of the network: exterior and interior orientation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Rotation vector (axis times angle, radians) of `camera_from_world`.
    pub rotation_rad: [f64; 3],
    /// Translation of `camera_from_world`, in the unit of the world.
    pub translation: [f64; 3],
    /// `[f_px, k1, k2]`.
    pub interior: bal::Interior,
}

/// One point measured in one image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Index of the camera.
    pub camera: u32,
    /// Index of the point.
    pub point: u32,
    /// Pixels from the image centre, right and up.
    pub image_px: [f64; 2],
}

/// A photogrammetric network: what a bundle adjustment adjusts.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Network {
    /// The cameras.
    pub cameras: Vec<Camera>,
    /// The points, in the world frame.
    pub points: Vec<[f64; 3]>,
    /// The measurements.
    pub observations: Vec<Observation>,
}

/// Who shares an interior orientation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InteriorSharing {
    /// Every image has its own.
    #[default]
    PerImage,
    /// All images have one, starting at the mean of theirs.
    Shared,
}

/// Name of the batch of image measurements.
pub const TIE_POINTS: &str = "tie points";

/// A network as a least-squares problem.
#[derive(Debug)]
pub struct Bundle {
    /// The problem; its blocks start at the network's values.
    pub problem: Problem,
    cameras: Vec<BlockId>,
    lens: Option<BlockId>,
    points: Vec<BlockId>,
}

/// The image measurement of a point by a camera with a lens of its own: blocks
/// `[PoseAnd(3), Euclidean(3)]`.
#[derive(Debug, Clone)]
pub struct Reprojection {
    /// Camera, point.
    pub blocks: [BlockId; 2],
    /// Measured position.
    pub image_px: [f64; 2],
}

/// The image measurement of a point by a camera that shares its lens: blocks
/// `[Pose, Euclidean(3) lens, Euclidean(3)]`.
#[derive(Debug, Clone)]
pub struct SharedReprojection {
    /// Pose, lens, point.
    pub blocks: [BlockId; 3],
    /// Measured position.
    pub image_px: [f64; 2],
}

/// Residual of one measurement and, where wanted, its derivatives by the pose increment, the
/// interior orientation and the point.
#[inline]
fn reproject(
    pose: &[f64],
    interior: &[f64],
    point: &[f64],
    image_px: [f64; 2],
    residual: &mut [f64],
    derivatives: Option<&mut dyn FnMut(usize, [f64; 6], [f64; 3], [f64; 3])>,
) -> Result<(), Infeasible> {
    let r = rotation::matrix([pose[0], pose[1], pose[2], pose[3]]);
    let x = [point[0], point[1], point[2]];
    let in_camera: [f64; 3] = std::array::from_fn(|k| crate::geometry::dot(r[k], x) + pose[4 + k]);
    let interior = [interior[0], interior[1], interior[2]];
    let Some(visit) = derivatives else {
        let u = bal::project(in_camera, interior).ok_or(Infeasible)?;
        residual[0] = u[0] - image_px[0];
        residual[1] = u[1] - image_px[1];
        return Ok(());
    };
    let projection = bal::project_with_derivatives(in_camera, interior).ok_or(Infeasible)?;
    for k in 0..2 {
        residual[k] = projection.image_px[k] - image_px[k];
        let by_camera = projection.by_point[k];
        // The camera frame turns by w and shifts by s: dP = w x P + s.
        let by_turn = cross(in_camera, by_camera);
        let by_pose =
            [by_turn[0], by_turn[1], by_turn[2], by_camera[0], by_camera[1], by_camera[2]];
        let by_point = std::array::from_fn(|c| {
            by_camera[0] * r[0][c] + by_camera[1] * r[1][c] + by_camera[2] * r[2][c]
        });
        visit(k, by_pose, projection.by_interior[k], by_point);
    }
    Ok(())
}

impl Factor for Reprojection {
    fn rows(&self) -> usize {
        2
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
        let (pose, interior) = x[0].split_at(7);
        let Some(jacobian) = jacobian else {
            return reproject(pose, interior, x[1], self.image_px, residual, None);
        };
        let mut write = |row: usize, by_pose: [f64; 6], by_lens: [f64; 3], by_point: [f64; 3]| {
            let row = jacobian.row(row);
            row[..6].copy_from_slice(&by_pose);
            row[6..9].copy_from_slice(&by_lens);
            row[9..12].copy_from_slice(&by_point);
        };
        reproject(pose, interior, x[1], self.image_px, residual, Some(&mut write))
    }
}

impl Factor for SharedReprojection {
    fn rows(&self) -> usize {
        2
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
        let Some(jacobian) = jacobian else {
            return reproject(x[0], x[1], x[2], self.image_px, residual, None);
        };
        let mut write = |row: usize, by_pose: [f64; 6], by_lens: [f64; 3], by_point: [f64; 3]| {
            let row = jacobian.row(row);
            row[..6].copy_from_slice(&by_pose);
            row[6..9].copy_from_slice(&by_lens);
            row[9..12].copy_from_slice(&by_point);
        };
        reproject(x[0], x[1], x[2], self.image_px, residual, Some(&mut write))
    }
}

impl Network {
    /// How many images see each point.
    pub fn rays(&self) -> Vec<u32> {
        let mut rays = vec![0; self.points.len()];
        for observation in &self.observations {
            rays[observation.point as usize] += 1;
        }
        rays
    }

    /// What is wrong with the network, if anything: indices that are not there, cameras and
    /// points that nothing measures, numbers that are not finite.
    pub fn defect(&self) -> Option<String> {
        let mut seen = (vec![false; self.cameras.len()], vec![false; self.points.len()]);
        for (k, observation) in self.observations.iter().enumerate() {
            let (camera, point) = (observation.camera as usize, observation.point as usize);
            if camera >= self.cameras.len() || point >= self.points.len() {
                return Some(format!(
                    "observation {k} is of point {point} by camera {camera}; there are {} points and {} cameras",
                    self.points.len(),
                    self.cameras.len()
                ));
            }
            if observation.image_px.iter().any(|v| !v.is_finite()) {
                return Some(format!("observation {k} is not a finite position"));
            }
            seen.0[camera] = true;
            seen.1[point] = true;
        }
        if let Some(camera) = seen.0.iter().position(|seen| !seen) {
            return Some(format!("camera {camera} sees no point; leave it out"));
        }
        if let Some(point) = seen.1.iter().position(|seen| !seen) {
            return Some(format!("point {point} is seen by no camera; leave it out"));
        }
        None
    }
}

impl Bundle {
    /// Poses the adjustment of `network`, points to be eliminated.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] with the network's [`Network::defect`], or for a loss without
    /// meaning.
    pub fn new(
        network: &Network,
        sharing: InteriorSharing,
        loss: Loss,
    ) -> Result<Bundle, SolveError> {
        if let Some(defect) = network.defect() {
            return Err(SolveError::Misuse(defect));
        }
        let mut problem = Problem::new();
        let mut cameras = Vec::with_capacity(network.cameras.len());
        for camera in &network.cameras {
            let mut values = rotation::exp(camera.rotation_rad).to_vec();
            values.extend(camera.translation);
            let space = match sharing {
                InteriorSharing::Shared => Space::Pose,
                InteriorSharing::PerImage => {
                    values.extend(camera.interior);
                    Space::PoseAnd(3)
                }
            };
            cameras.push(problem.block("camera", space, &values)?);
        }
        let lens = match sharing {
            InteriorSharing::PerImage => None,
            InteriorSharing::Shared => {
                let count = network.cameras.len() as f64;
                let mean: [f64; 3] = std::array::from_fn(|k| {
                    network.cameras.iter().map(|camera| camera.interior[k]).sum::<f64>() / count
                });
                Some(problem.block("lens", Space::Euclidean(3), &mean)?)
            }
        };
        let points = network
            .points
            .iter()
            .map(|point| {
                let block = problem.block("point", Space::Euclidean(3), point)?;
                problem.eliminate(block);
                Ok(block)
            })
            .collect::<Result<Vec<_>, SolveError>>()?;
        let ends = |o: &Observation| (cameras[o.camera as usize], points[o.point as usize]);
        match lens {
            None => {
                let factors = network.observations.iter().map(|o| {
                    let (camera, point) = ends(o);
                    Reprojection { blocks: [camera, point], image_px: o.image_px }
                });
                problem.add(TIE_POINTS, loss, Factors(factors.collect()))?;
            }
            Some(lens) => {
                let factors = network.observations.iter().map(|o| {
                    let (camera, point) = ends(o);
                    SharedReprojection { blocks: [camera, lens, point], image_px: o.image_px }
                });
                problem.add(TIE_POINTS, loss, Factors(factors.collect()))?;
            }
        }
        Ok(Bundle { problem, cameras, lens, points })
    }

    /// The block of a camera.
    pub fn camera(&self, index: usize) -> BlockId {
        self.cameras[index]
    }

    /// The block of a point.
    pub fn point(&self, index: usize) -> BlockId {
        self.points[index]
    }

    /// The block of the shared interior orientation, if it is shared.
    pub fn lens(&self) -> Option<BlockId> {
        self.lens
    }

    /// Takes cameras and points from the values `x` into `network`, the one this came from.
    pub fn update(&self, x: &[f64], network: &mut Network) {
        for (camera, &block) in network.cameras.iter_mut().zip(&self.cameras) {
            let values = self.problem.values(x, block);
            camera.rotation_rad = rotation::log([values[0], values[1], values[2], values[3]]);
            camera.translation = [values[4], values[5], values[6]];
            let interior = match self.lens {
                Some(lens) => self.problem.values(x, lens),
                None => &values[7..],
            };
            camera.interior = [interior[0], interior[1], interior[2]];
        }
        for (point, &block) in network.points.iter_mut().zip(&self.points) {
            point.copy_from_slice(self.problem.values(x, block));
        }
    }
}
