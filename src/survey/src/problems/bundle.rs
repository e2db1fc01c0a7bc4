//! Bundle adjustment: cameras, lenses and points from image measurements.
//!
//! ```text
//! r_ij = u(R_i X_j + t_i, interior_i) - u_ij      pixels
//! ```
//!
//! over `camera_from_world` poses `(R_i, t_i)`, interior orientations and points `X_j` in the world
//! frame, for the camera of [`crate::camera::bal`]. The gauge is free: nothing is fixed, the damped
//! steps choose the frame nearest to the start, as is the custom for these files.

use super::pose_chain::{by_increment, by_world, to_camera};
use crate::camera::bal;
use rowgram_optim::{
    engine::SolveError,
    geometry::rotation,
    lanes::Lane,
    nlls::{
        BlockId, Dim, Euclidean, Linearized, LinearizedProjection, Loss, Measurement, Problem,
        ProjectionBatch, ProjectionFactor, manifold,
    },
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

rowgram_base::choices!(InteriorSharing: PerImage, Shared);

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
/// `[PoseWithParameters(3), Euclidean(3)]`, data the measured position in pixels.
#[derive(Debug, Clone, Copy)]
pub struct Reprojection;

/// The image measurement of a point by a camera that shares its lens: blocks
/// `[Pose, Euclidean(3) lens, Euclidean(3)]`, data the measured position in pixels.
#[derive(Debug, Clone, Copy)]
pub struct SharedReprojection;

/// What all measurements of one image need of its camera: the rotation matrix by rows, the
/// translation, `f`, `k1`, `k2`.
type Prepared<L> = [L; 15];

#[inline(always)]
fn prepare(pose: &[f64], interior: &[f64]) -> Prepared<f64> {
    let r = rotation::matrix([pose[0], pose[1], pose[2], pose[3]]);
    let mut prepared = [0.0; 15];
    for k in 0..3 {
        prepared[3 * k..3 * k + 3].copy_from_slice(&r[k]);
        prepared[9 + k] = pose[4 + k];
        prepared[12 + k] = interior[k];
    }
    prepared
}

// No closures from here on: one that is not inlined would be compiled without the instruction set
// that the engine has chosen.

#[inline(always)]
fn residual<L: Lane>(c: &Prepared<L>, x: &[L; 3], measured_px: &[L; 2]) -> [L; 2] {
    let image_px = bal::project(to_camera(c, x), [c[12], c[13], c[14]]);
    [image_px[0] - measured_px[0], image_px[1] - measured_px[1]]
}

/// The residual and its derivatives by the pose increment, the interior orientation and the point.
#[inline(always)]
fn linearize<L: Lane>(
    c: &Prepared<L>,
    x: &[L; 3],
    measured_px: &[L; 2],
) -> Linearized<SharedReprojection, L> {
    let p = to_camera(c, x);
    let found = bal::project_with_derivatives(p, [c[12], c[13], c[14]]);
    let (u, j) = (found.image_px, &found.by_point);
    LinearizedProjection {
        residual: [u[0] - measured_px[0], u[1] - measured_px[1]],
        jacobian_camera: [by_increment(&p, &j[0]), by_increment(&p, &j[1])],
        jacobian_shared: found.by_interior,
        jacobian_point: [by_world(c, &j[0]), by_world(c, &j[1])],
    }
}

/// `[pose, lens]` side by side.
#[inline(always)]
fn beside<L: Lane>(p: &[L; 6], l: &[L; 3]) -> [L; 9] {
    [p[0], p[1], p[2], p[3], p[4], p[5], l[0], l[1], l[2]]
}

impl ProjectionFactor for Reprojection {
    type Residual = Dim<2>;
    type Camera = Dim<9>;
    type Shared = Dim<0>;
    type Point = Dim<3>;
    type Prepared = Dim<15>;
    type Data = Dim<2>;

    fn prepare(kept: &[f64], _: &[f64]) -> Prepared<f64> {
        prepare(&kept[..7], &kept[7..])
    }

    #[inline(always)]
    fn residual<L: Lane>(camera: &Prepared<L>, point: &[L; 3], measured_px: &[L; 2]) -> [L; 2] {
        residual(camera, point, measured_px)
    }

    #[inline(always)]
    fn linearize<L: Lane>(
        camera: &Prepared<L>,
        point: &[L; 3],
        measured_px: &[L; 2],
    ) -> Linearized<Self, L> {
        let found = linearize(camera, point, measured_px);
        let (pose, lens) = (&found.jacobian_camera, &found.jacobian_shared);
        LinearizedProjection {
            residual: found.residual,
            jacobian_camera: [beside(&pose[0], &lens[0]), beside(&pose[1], &lens[1])],
            jacobian_shared: [[]; 2],
            jacobian_point: found.jacobian_point,
        }
    }

    fn is_in_front(camera: &Prepared<f64>, point: &[f64; 3]) -> bool {
        // Cameras of this format look along -z.
        to_camera(camera, point)[2] < 0.0
    }
}

impl ProjectionFactor for SharedReprojection {
    type Residual = Dim<2>;
    type Camera = Dim<6>;
    type Shared = Dim<3>;
    type Point = Dim<3>;
    type Prepared = Dim<15>;
    type Data = Dim<2>;

    fn prepare(kept: &[f64], shared: &[f64]) -> Prepared<f64> {
        prepare(kept, shared)
    }

    #[inline(always)]
    fn residual<L: Lane>(camera: &Prepared<L>, point: &[L; 3], measured_px: &[L; 2]) -> [L; 2] {
        residual(camera, point, measured_px)
    }

    #[inline(always)]
    fn linearize<L: Lane>(
        camera: &Prepared<L>,
        point: &[L; 3],
        measured_px: &[L; 2],
    ) -> Linearized<Self, L> {
        linearize(camera, point, measured_px)
    }

    fn is_in_front(camera: &Prepared<f64>, point: &[f64; 3]) -> bool {
        // Cameras of this format look along -z.
        to_camera(camera, point)[2] < 0.0
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

    /// The middle of the cameras that measure each point.
    fn sights(&self) -> Vec<[f64; 3]> {
        let centres: Vec<[f64; 3]> = self
            .cameras
            .iter()
            .map(|camera| {
                let r = rotation::matrix(rotation::exp(camera.rotation_rad));
                let t = camera.translation;
                std::array::from_fn(|k| -(0..3).map(|i| r[i][k] * t[i]).sum::<f64>())
            })
            .collect();
        let mut sums = vec![([0.0; 3], 0.0); self.points.len()];
        for observation in &self.observations {
            let (sum, count) = &mut sums[observation.point as usize];
            for (sum, centre) in sum.iter_mut().zip(centres[observation.camera as usize]) {
                *sum += centre;
            }
            *count += 1.0;
        }
        sums.into_iter().map(|(sum, count)| sum.map(|v| v / count)).collect()
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
            let parameters = match sharing {
                InteriorSharing::Shared => 0,
                InteriorSharing::PerImage => {
                    values.extend(camera.interior);
                    3
                }
            };
            let manifold = manifold::PoseWithParameters(parameters);
            cameras.push(problem.block("camera", manifold, &values)?);
        }
        let lens = match sharing {
            InteriorSharing::PerImage => None,
            InteriorSharing::Shared => {
                let count = network.cameras.len() as f64;
                let mean: [f64; 3] = std::array::from_fn(|k| {
                    network.cameras.iter().map(|camera| camera.interior[k]).sum::<f64>() / count
                });
                Some(problem.block("lens", Euclidean(3), &mean)?)
            }
        };
        let points = network
            .points
            .iter()
            .zip(network.sights())
            .map(|(point, sight)| {
                let block = problem.block("point", Euclidean(3), point)?;
                problem.eliminate(block);
                problem.seen_from(block, sight)?;
                Ok(block)
            })
            .collect::<Result<Vec<_>, SolveError>>()?;
        let ends = |o: &Observation| (cameras[o.camera as usize], points[o.point as usize]);
        let observations = network.observations.iter();
        match lens {
            None => {
                let pairs = observations.map(|o| {
                    let (camera, point) = ends(o);
                    Measurement::new(camera, point, o.image_px)
                });
                let batch = ProjectionBatch::new(Reprojection, pairs.collect());
                problem.add(TIE_POINTS, loss, batch)?;
            }
            Some(lens) => {
                let pairs = observations.map(|o| {
                    let (camera, point) = ends(o);
                    Measurement::with_shared(camera, lens, point, o.image_px)
                });
                let batch = ProjectionBatch::new(SharedReprojection, pairs.collect());
                problem.add(TIE_POINTS, loss, batch)?;
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
