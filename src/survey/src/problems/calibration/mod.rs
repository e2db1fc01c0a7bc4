//! Camera calibration from photos of a board.
//!
//! ```text
//! r_ij = u(R_i X_j + t_i, interior) - u_ij          pixels
//! ```
//!
//! over one interior orientation and the poses `(R_i, t_i)` of the board in every photo
//! (`camera_from_board`, photogrammetric camera frame), for corners `X_j` of the board with `x` along its
//! rows, `y` along its columns and `z = 0`, or a height of each corner as an unknown of its own where the
//! board need not be flat. Poses are eliminated; the reduced system is that of the interior orientation
//! (and the heights).
//!
//! [`start`] finds where to begin without knowing anything of the lens, [`Calibration`] poses the
//! problem, [`calibrate`] does all of it, [`consistent`] leaves out photos that contradict
//! the others, [`statistics`] says how well everything is known, [`comparison`] compares lens models.
//!
//! References: Z. Zhang, *A flexible new technique for camera calibration*, PAMI 22(11), 2000, for the
//! start from homographies; T. Luhmann et al., *Close-range photogrammetry and 3D imaging*, 2014, for the
//! statistics.

pub mod comparison;
pub mod consistent;
mod corners;
pub mod residuals;
pub mod start;
pub mod statistics;

use crate::camera::{CameraError, Interior, Model};
use corners::{CornerObservations, LensParameters};
use rowgram_optim::{
    engine::{SolveError, Termination},
    nlls::{self, BlockId, Euclidean, LinearSolver, Loss, Options, Problem, manifold},
};
use serde::{Deserialize, Serialize};

/// A corner of the board, measured in one photo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mark {
    /// Which corner of the board, for unknowns of its own.
    pub corner: usize,
    /// Where it is on the board, `x` and `y`, metres.
    pub board_m: [f64; 2],
    /// Where it is in the photo, pixels.
    pub image_px: [f64; 2],
}

/// What one photo shows of the board.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct View {
    /// The corners measured in it.
    pub marks: Vec<Mark>,
}

/// Whether the board is taken for flat.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BoardShape {
    /// All corners lie in one plane.
    #[default]
    Flat,
    /// Every corner has a height of its own, but for three far apart, which define the plane.
    Free,
}

rowgram_base::choices!(BoardShape: Flat, Free);

/// What is to be calibrated.
#[derive(Debug, Clone, PartialEq)]
pub struct Request {
    /// The lens model.
    pub model: Model,
    /// `[width, height]` of the photos, pixels.
    pub size_px: [u32; 2],
    /// Which parameters of the model are estimated.
    pub free: Vec<bool>,
    /// Values of all parameters where they are not estimated; the rest only where no start is to be
    /// searched for.
    pub values: Vec<f64>,
    /// Whether the board is flat.
    pub shape: BoardShape,
    /// The robust loss of the final adjustment; its scale is in pixels.
    pub loss: Loss,
}

/// Name of the batch of measured corners.
pub const CORNERS: &str = "corners";

/// The problem of a calibration.
#[derive(Debug)]
pub struct Calibration {
    /// The problem; its blocks start at the values given.
    pub problem: Problem,
    /// The block of the free parameters of the interior orientation, in their order.
    pub lens: BlockId,
    /// The block of each photo's pose.
    pub poses: Vec<BlockId>,
    /// The block of the height of each corner of the board, where heights are unknown.
    pub heights: Vec<Option<BlockId>>,
    lenses: LensParameters,
}

/// Where a calibration stands.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// The interior orientation.
    pub interior: Interior,
    /// The pose of the board in every photo: quaternion `w x y z`, then translation in metres, of
    /// `camera_from_board`.
    pub poses: Vec<[f64; 7]>,
    /// Height of each corner above the board's plane, metres, towards the back of the board.
    pub heights_m: Vec<f64>,
}

impl Calibration {
    /// Poses the adjustment of everything, from `state`.
    ///
    /// # Errors
    /// Where a view has no marks, or the values do not belong to the model.
    pub fn new(
        views: &[View],
        request: &Request,
        state: &State,
        loss: Loss,
    ) -> Result<Calibration, SolveError> {
        let mut problem = Problem::new();
        let lenses = LensParameters::new(&state.interior, &request.free);
        if lenses.free_count() == 0 {
            return Err(SolveError::Misuse("no parameter of the lens is free".into()));
        }
        let lens = problem.block("lens", Euclidean(lenses.free_count()), &lenses.block())?;
        let mut poses = Vec::with_capacity(views.len());
        for pose in &state.poses {
            let block = problem.block("photo", manifold::Pose, pose)?;
            problem.eliminate(block);
            poses.push(block);
        }
        let mut heights = vec![None; state.heights_m.len()];
        match request.shape {
            BoardShape::Flat => {
                let marks = views.iter().zip(&poses).flat_map(|(view, &pose)| {
                    view.marks.iter().map(move |mark| ([lens, pose], *mark))
                });
                problem.add(
                    CORNERS,
                    loss,
                    CornerObservations::new(lenses.clone(), marks.collect()),
                )?;
            }
            BoardShape::Free => {
                for (block, &height) in heights.iter_mut().zip(&state.heights_m) {
                    *block = Some(problem.block("corner", Euclidean(1), &[height])?);
                }
                for corner in plane_corners(views) {
                    if let Some(block) = heights.get(corner).copied().flatten() {
                        problem.fix(block);
                    }
                }
                let mut all = Vec::new();
                for (view, &pose) in views.iter().zip(&poses) {
                    for mark in &view.marks {
                        let height =
                            heights.get(mark.corner).copied().flatten().ok_or_else(|| {
                                SolveError::Misuse(format!("corner {} has no height", mark.corner))
                            })?;
                        all.push(([lens, pose, height], *mark));
                    }
                }
                // A corner that no photo shows has nothing that determines it.
                for (corner, block) in heights.iter().enumerate() {
                    let seen = views.iter().any(|v| v.marks.iter().any(|m| m.corner == corner));
                    if let (false, Some(block)) = (seen, block) {
                        problem.fix(*block);
                    }
                }
                problem.add(CORNERS, loss, CornerObservations::new(lenses.clone(), all))?;
            }
        }
        Ok(Calibration { problem, lens, poses, heights, lenses })
    }

    /// The state at the values `x`.
    ///
    /// # Errors
    /// Where the values are no interior orientation.
    pub fn state(&self, request: &Request, x: &[f64]) -> Result<State, CameraError> {
        let values = self.lenses.values(self.problem.values(x, self.lens));
        let pose = |&block: &BlockId| {
            let values = self.problem.values(x, block);
            std::array::from_fn(|k| values[k])
        };
        let height = |block: &Option<BlockId>| block.map_or(0.0, |b| self.problem.values(x, b)[0]);
        Ok(State {
            interior: Interior::new(request.model, request.size_px, &values[..request.free.len()])?,
            poses: self.poses.iter().map(pose).collect(),
            heights_m: self.heights.iter().map(height).collect(),
        })
    }
}

/// Three corners that define the board's plane: the one furthest from the middle, the one furthest
/// from that, the one furthest from their line.
fn plane_corners(views: &[View]) -> Vec<usize> {
    let mut places: Vec<(usize, [f64; 2])> =
        views.iter().flat_map(|view| &view.marks).map(|m| (m.corner, m.board_m)).collect();
    places.sort_by_key(|place| place.0);
    places.dedup_by_key(|place| place.0);
    let count = places.len().max(1) as f64;
    let middle: [f64; 2] =
        std::array::from_fn(|k| places.iter().map(|p| p.1[k]).sum::<f64>() / count);
    let furthest = |distance: &dyn Fn([f64; 2]) -> f64| {
        places.iter().max_by(|a, b| distance(a.1).total_cmp(&distance(b.1))).copied()
    };
    let from = |a: [f64; 2]| move |b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
    let Some(first) = furthest(&from(middle)) else { return Vec::new() };
    let Some(second) = furthest(&from(first.1)) else { return vec![first.0] };
    let along = [second.1[0] - first.1[0], second.1[1] - first.1[1]];
    let third = furthest(&|p: [f64; 2]| {
        (along[0] * (p[1] - first.1[1]) - along[1] * (p[0] - first.1[0])).abs()
    });
    third.map_or(vec![first.0, second.0], |third| vec![first.0, second.0, third.0])
}

/// The result of a calibration.
#[derive(Debug)]
pub struct Solution {
    /// The problem that was solved last.
    pub calibration: Calibration,
    /// Its values at the end.
    pub x: Vec<f64>,
    /// The same as interior orientation and poses.
    pub state: State,
    /// Iterations of the final adjustment.
    pub iterations: u64,
    /// Why it ended.
    pub stop: Termination,
}

/// Most iterations of an adjustment.
pub const MAX_ITERATIONS: u64 = 200;

/// Settings of the engine that suit a calibration.
pub fn options() -> Options {
    Options { linear: LinearSolver::Schur, cost_tolerance: 1e-8, ..Options::default() }
}

/// Adjusts from a known start.
///
/// # Errors
/// Where the start cannot be evaluated, or the outcome is no interior orientation.
pub fn adjust(
    views: &[View],
    request: &Request,
    state: &State,
    loss: Loss,
    max_iterations: u64,
) -> Result<Solution, SolveError> {
    let calibration = Calibration::new(views, request, state, loss)?;
    let mut x = calibration.problem.start();
    let summary = nlls::solve(&calibration.problem, &mut x, &options(), max_iterations)?;
    let state =
        calibration.state(request, &x).map_err(|error| SolveError::NotFinite(error.to_string()))?;
    Ok(Solution { calibration, x, state, iterations: summary.iterations, stop: summary.stop })
}

/// Calibrates without knowing where to begin.
///
/// # Errors
/// Where no start leads anywhere.
pub fn calibrate(views: &[View], request: &Request) -> Result<Solution, SolveError> {
    let begin = start::search(views, request)?;
    adjust(views, request, &begin, request.loss, MAX_ITERATIONS)
}
