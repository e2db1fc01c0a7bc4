//! Problems of the project as instances for every solver: what a seed decides of each, and what is known
//! of its best cost.
//!
//! An instance is drawn from ranges by a stream of its own: size, error of the start, noise, gross errors
//! and with them the loss. All contestants see the same [`Problem`].

use super::{
    bundle,
    flat_problem::{Chart, Charted, Weighing},
    small_instances,
};
use crate::streams::{Stream, stream};
use data_synth::{
    block::{Block, BlockConfig},
    board::{self, BOARD},
    camera::{Camera, CameraConfig},
};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rowgram::{
    camera::{Interior, Model},
    geometry::rotation,
    nlls::{Loss, Problem},
    problems::{
        bundle::{Bundle, InteriorSharing},
        calibration::{BoardShape, CORNERS, Calibration, Mark, Request, State, View},
        plants::Quadratic,
    },
};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Which problem of the project.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Family {
    /// Bundle adjustment of an aerial block, a lens for each image, the frame free.
    Bundle,
    /// Calibration of a camera from photos of a board.
    Calibration,
    /// The place of one plant, its pixels held: a sum of distances and a prior.
    Plant,
    /// Axis and widths of one leaf from the ends of slices across it.
    Leaf,
}

/// What instances are drawn from: each pair is the two ends of an interval.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Ranges {
    /// Images of a block; uniform in the logarithm.
    images: [f64; 2],
    /// Points of a block for each image.
    points_per_image: [f64; 2],
    /// Photos of a board.
    photos: [f64; 2],
    /// Metres on the ground for a pixel of a plant; uniform in the logarithm.
    pub(super) plant_gsd_m: [f64; 2],
    /// Slices across a leaf; uniform in the logarithm.
    pub(super) slices: [f64; 2],
    /// Multiple of the usual error of the start; uniform in the logarithm.
    pub(super) start_scale: [f64; 2],
    /// Share of gross errors in those instances that have any; these take a robust loss.
    gross: [f64; 2],
}

impl Default for Ranges {
    fn default() -> Ranges {
        Ranges {
            images: [5.0, 60.0],
            points_per_image: [18.0, 40.0],
            photos: [4.0, 20.0],
            plant_gsd_m: [0.004, 0.03],
            slices: [8.0, 80.0],
            start_scale: [0.3, 3.0],
            gross: [0.01, 0.08],
        }
    }
}

impl Ranges {
    /// Refuses what is no interval of sensible numbers.
    pub(super) fn check(&self) -> Result<(), String> {
        for (name, [low, high], least, most) in [
            ("images", self.images, 3.0, 500.0),
            ("points_per_image", self.points_per_image, 12.0, 1000.0),
            ("photos", self.photos, 3.0, 200.0),
            ("plant_gsd_m", self.plant_gsd_m, 0.002, 0.1),
            ("slices", self.slices, 6.0, 1000.0),
            ("start_scale", self.start_scale, 1e-3, 30.0),
            ("gross", self.gross, 1e-4, 0.4),
        ] {
            if !(least <= low && low <= high && high <= most) {
                return Err(format!(
                    "ranges.{name} = [{low}, {high}]: expected two numbers in order from {least} to {most}"
                ));
            }
        }
        Ok(())
    }
}

/// Draws of an instance.
pub(super) struct Draws(pub(super) ChaCha8Rng);

impl Draws {
    pub(super) fn uniform(&mut self, [low, high]: [f64; 2]) -> f64 {
        low + (high - low) * self.0.random::<f64>()
    }

    pub(super) fn log_uniform(&mut self, [low, high]: [f64; 2]) -> f64 {
        (low.ln() + (high.ln() - low.ln()) * self.0.random::<f64>()).exp()
    }

    /// A number of at least 0, each as likely as the others, below `count`.
    pub(super) fn below(&mut self, count: usize) -> usize {
        self.0.random_range(0..count)
    }

    /// Normal with a mean of 0, by Box and Muller.
    pub(super) fn normal(&mut self, deviation: f64) -> f64 {
        let radius = (-2.0 * (1.0 - self.0.random::<f64>()).ln()).sqrt();
        deviation * radius * (std::f64::consts::TAU * self.0.random::<f64>()).cos()
    }

    /// No gross errors and least squares, or a share of them and one of the losses.
    pub(super) fn loss(&mut self, ranges: &Ranges, robust: &[Loss]) -> (f64, Loss) {
        let (share, which) = (self.uniform(ranges.gross), self.below(2 * robust.len()));
        robust.get(which).map_or((0.0, Loss::Trivial), |&loss| (share, loss))
    }
}

/// The inner problem of a plant, for the solvers that take nothing else.
#[derive(Debug)]
pub(super) struct OnePlant {
    pub(super) u_px: Vec<f64>,
    pub(super) v_px: Vec<f64>,
    pub(super) weight: f64,
    pub(super) prior: Quadratic,
}

/// A problem for all contestants.
#[derive(Debug)]
pub(crate) struct Instance {
    pub(super) charted: Arc<Charted>,
    /// Other places to look for the best cost from, as values of the engine.
    pub(super) hints: Vec<Vec<f64>>,
    /// Whether some blocks are eliminated first, so that there are several ways to a step.
    pub(super) eliminates: bool,
    /// Whether the normal matrix is singular: nothing holds frame and scale.
    pub(super) free_frame: bool,
    pub(super) plant: Option<OnePlant>,
}

impl Instance {
    /// The instance of a seed.
    pub(crate) fn draw(family: Family, ranges: &Ranges, seed: u64) -> Result<Instance, String> {
        let mut draws = Draws(stream(seed, Stream::Input));
        match family {
            Family::Bundle => block(ranges, &mut draws, seed),
            Family::Calibration => calibration(ranges, &mut draws, seed),
            Family::Plant => small_instances::plant(ranges, &mut draws, seed),
            Family::Leaf => small_instances::leaf(ranges, &mut draws, seed),
        }
    }

    /// For the engine.
    pub(crate) fn problem(&self) -> &Problem {
        &self.charted.problem
    }

    /// The cost at the values of the engine.
    pub(crate) fn cost(&self, x: &[f64]) -> Result<f64, String> {
        self.charted.problem.costs(x).map(|costs| costs.iter().sum()).map_err(|e| e.to_string())
    }

    /// How many numbers move.
    pub(super) fn parameters(&self) -> usize {
        self.charted.problem.parameter_count()
    }
}

/// The block of a seed and the loss it is adjusted with.
pub(crate) fn drawn_block(ranges: &Ranges, seed: u64) -> Result<(Block, Loss), String> {
    fly(ranges, &mut Draws(stream(seed, Stream::Input)), seed)
}

fn fly(ranges: &Ranges, draws: &mut Draws, seed: u64) -> Result<(Block, Loss), String> {
    let images = draws.log_uniform(ranges.images).round();
    let points = (images * draws.uniform(ranges.points_per_image)).round();
    let scale = draws.log_uniform(ranges.start_scale);
    let (outlier_fraction, loss) = draws.loss(ranges, &[Loss::Huber(1.0)]);
    let mut config = BlockConfig {
        seed,
        images: images as usize,
        points: points as usize,
        sigma_px: draws.log_uniform([0.2, 1.0]),
        relief_m: draws.log_uniform([1.0, 10.0]),
        outlier_fraction,
        ..BlockConfig::default()
    };
    config.start.rotation_deg *= scale;
    config.start.centre_m *= scale;
    config.start.point_m *= scale;
    Block::fly(&config).map(|block| (block, loss)).map_err(|e| e.to_string())
}

fn block(ranges: &Ranges, draws: &mut Draws, seed: u64) -> Result<Instance, String> {
    let (block, loss) = fly(ranges, draws, seed)?;
    let pose = |cameras: &[[f64; 9]], points: &[[f64; 3]]| {
        let network = bundle::network(&block, cameras, points);
        Bundle::new(&network, InteriorSharing::PerImage, loss).map_err(|e| e.to_string())
    };
    let truth = pose(&block.cameras_true, &block.points_true)?.problem.start();
    let problem = pose(&block.cameras_start, &block.points_start)?.problem;
    Ok(Instance {
        charted: Arc::new(bundle::charted(problem, block.cameras_start.len(), loss)),
        hints: vec![truth],
        eliminates: true,
        free_frame: true,
        plant: None,
    })
}

/// A quaternion `w x y z` of a rotation matrix by rows.
fn quaternion(rows: &[[f64; 3]; 3]) -> [f64; 4] {
    let matrix = Matrix3::from_fn(|i, j| rows[i][j]);
    let q = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix));
    [q.w, q.i, q.j, q.k]
}

fn calibration(ranges: &Ranges, draws: &mut Draws, seed: u64) -> Result<Instance, String> {
    let width = draws.uniform([1200.0, 4000.0]).round();
    let height = (0.75 * width).round();
    let c_px = width * draws.log_uniform([0.45, 1.2]);
    let make = [CameraConfig::wide, CameraConfig::compact][draws.below(2)];
    let config = make(width as u32, height as u32, c_px);
    let size_px = [config.width_px, config.height_px];
    let camera = Camera::new(&config).map_err(|e| e.to_string())?;
    let photos = draws.uniform(ranges.photos).round() as usize;
    let model = [Model::Smac, Model::Brown][draws.below(2)];
    let noise_px = draws.log_uniform([0.05, 0.5]);
    let scale = draws.log_uniform(ranges.start_scale);
    let (gross, loss) = draws.loss(ranges, &[Loss::Huber(1.0), Loss::Cauchy(1.0)]);
    let poses = board::poses(BOARD, &camera, photos, seed).map_err(|e| e.to_string())?;
    let mut views = Vec::with_capacity(photos);
    let (mut truth, mut start) = (Vec::new(), Vec::new());
    for pose in &poses {
        let mut view = View::default();
        for corner in 0..BOARD.columns * BOARD.rows {
            let (column, row) = (corner % BOARD.columns, corner / BOARD.columns);
            let board_m = [column as f64, row as f64].map(|n| n * BOARD.side_m);
            let r = &pose.camera_from_board;
            let point: [f64; 3] = std::array::from_fn(|i| {
                r[i][0] * board_m[0] + r[i][1] * board_m[1] + pose.origin_m[i]
            });
            let Some(at) = camera.project(point) else { continue };
            let mut image_px = at.map(|x| x + draws.normal(noise_px));
            if draws.uniform([0.0, 1.0]) < gross {
                image_px = image_px.map(|x| x + draws.normal(10.0));
            }
            view.marks.push(Mark { corner, board_m, image_px });
        }
        views.push(view);
        let [q, t] = [quaternion(&pose.camera_from_board).to_vec(), pose.origin_m.to_vec()];
        truth.push([q[0], q[1], q[2], q[3], t[0], t[1], t[2]]);
        let turn = std::array::from_fn(|_| draws.normal(0.04 * scale));
        let turned = rotation::multiply(rotation::exp(turn), [q[0], q[1], q[2], q[3]]);
        let away = t[2].abs();
        let [x, y, z] = [0.02, 0.02, 0.05].map(|share| draws.normal(share * scale * away));
        let [w, i, j, k] = rotation::normalize(turned);
        // Never behind the camera.
        start.push([w, i, j, k, t[0] + x, t[1] + y, (t[2] + z).min(-0.4 * away)]);
    }
    let distance_px = c_px * (1.0 + draws.normal(0.05 * scale)).clamp(0.6, 1.6);
    let values = |distance_px: f64| -> Vec<f64> {
        let places = 0..model.parameters().len();
        places.map(|k| model.default_value(k, size_px).unwrap_or(distance_px)).collect()
    };
    // The scale of SMAC's radius is the principal distance once more.
    let free: Vec<bool> =
        model.parameters().iter().map(|p| p.estimable && p.name != "K0").collect();
    let request = Request {
        model,
        size_px,
        free,
        values: values(distance_px),
        shape: BoardShape::Flat,
        loss,
    };
    let posed = |values: &[f64], poses: &[[f64; 7]]| -> Result<Calibration, String> {
        let interior = Interior::new(model, size_px, values).map_err(|e| e.to_string())?;
        let heights_m = vec![0.0; BOARD.columns * BOARD.rows];
        let state = State { interior, poses: poses.to_vec(), heights_m };
        Calibration::new(&views, &request, &state, loss).map_err(|e| e.to_string())
    };
    let hint = posed(&values(c_px), &truth)?.problem.start();
    let found = posed(&request.values, &start)?;
    let lens = request.free.iter().filter(|free| **free).count();
    let charts = [vec![Chart::Plain(lens)], vec![Chart::Pose(0); photos]].concat();
    Ok(Instance {
        charted: Arc::new(Charted {
            problem: found.problem,
            charts,
            batches: vec![(CORNERS, Weighing::Robust(loss))],
        }),
        hints: vec![hint],
        eliminates: true,
        free_frame: false,
        plant: None,
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Small ones, for tests.
    pub(in crate::stages) fn small() -> Ranges {
        Ranges {
            images: [5.0, 8.0],
            points_per_image: [18.0, 20.0],
            photos: [4.0, 6.0],
            ..Ranges::default()
        }
    }

    #[test]
    fn the_start_and_the_hints_can_be_evaluated() {
        for family in [Family::Bundle, Family::Calibration, Family::Plant, Family::Leaf] {
            for seed in 1..7 {
                let found = Instance::draw(family, &small(), seed).unwrap();
                for x in found.hints.iter().chain([&found.problem().start()]) {
                    let cost = found.cost(x).unwrap();
                    assert!(cost.is_finite() && cost > 0.0, "{family:?} {seed}: {cost}");
                }
            }
        }
    }

    #[test]
    fn a_seed_is_an_instance() {
        for family in [Family::Bundle, Family::Calibration, Family::Plant, Family::Leaf] {
            let start = |seed| {
                let found = Instance::draw(family, &small(), seed).unwrap();
                (found.problem().start(), found.problem().residual_count())
            };
            assert_eq!(start(3), start(3), "{family:?}");
            assert_ne!(start(3), start(4), "{family:?}");
        }
        let mut ranges = small();
        ranges.slices = [9.0, 8.0];
        assert!(ranges.check().unwrap_err().contains("slices"));
    }
}
