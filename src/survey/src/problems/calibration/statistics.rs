//! How well a calibration is known.
//!
//! ```text
//! s0^2 = v^T W v / (n - u),   C = s0^2 (J^T W J)^-1,   t_k = x_k / sqrt(C_kk)
//! ```
//!
//! for `u` unknowns and `n` observations. `W` holds the weights `rho'` that a robust loss gives the corners, 1 without one, and `n`
//! is their sum over all coordinates: a corner that the loss all but leaves out is no observation. A parameter is significant where the two-sided probability
//! of its `t` under Student's distribution with `n - u` degrees of freedom is small.

use super::{BoardShape, Calibration, Mark, Request, Solution, State, View};
use crate::camera::Lens;
use rowgram_optim::{
    engine::SolveError,
    geometry::{dot, rotation},
    nlls::{
        LinearSolver,
        covariance::{Covariance, null_space},
    },
};
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, StudentsT};
use std::borrow::Cow;

/// One parameter of the interior orientation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterStatistics {
    /// Its name.
    pub name: Cow<'static, str>,
    /// Its unit.
    pub unit: Cow<'static, str>,
    /// Its value.
    pub value: f64,
    /// Whether it was estimated.
    pub free: bool,
    /// Its standard deviation; 0 where it was held.
    pub standard_deviation: f64,
    /// Value over standard deviation; none where it was held.
    pub t: Option<f64>,
    /// Probability of so large a `t` where the true value is 0.
    pub probability: Option<f64>,
}

/// One photo.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewStatistics {
    /// Corners in it.
    pub corners: usize,
    /// Root mean square of the distances between corners and projections, pixels.
    pub rms_px: f64,
    /// The largest such distance, pixels.
    pub largest_px: f64,
    /// The angle between the board and the image plane, degrees.
    pub tilt_deg: f64,
    /// Distance of the board's first corner from the camera, metres.
    pub distance_m: f64,
}

/// Everything known about a solution.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Statistics {
    /// Observations `n`: two for each corner of each photo.
    pub observations: usize,
    /// Unknowns `u`.
    pub unknowns: usize,
    /// `s0`, pixels: what one coordinate of a corner is off.
    pub sigma0_px: f64,
    /// Root mean square of the distances, pixels (`sqrt(2)` times that of the coordinates).
    pub rms_px: f64,
    /// The parameters of the model.
    pub parameters: Vec<ParameterStatistics>,
    /// Names of the free ones, in the order of [`Statistics::correlation`].
    pub free: Vec<Cow<'static, str>>,
    /// Correlation matrix of the free parameters, row by row.
    pub correlation: Vec<Vec<f64>>,
    /// Each photo.
    pub views: Vec<ViewStatistics>,
    /// Height of each corner of the board and its standard deviation, metres, where unknown.
    pub heights_m: Vec<[f64; 2]>,
}

/// Projection minus measurement of every mark of every view, pixels.
///
/// # Errors
/// Where a corner has no projection.
pub fn residuals(views: &[View], state: &State) -> Result<Vec<Vec<[f64; 2]>>, SolveError> {
    views
        .iter()
        .zip(&state.poses)
        .map(|(view, pose)| {
            let r = rotation::matrix([pose[0], pose[1], pose[2], pose[3]]);
            let residual = |mark: &Mark| {
                let height = state.heights_m.get(mark.corner).copied().unwrap_or(0.0);
                let board = [mark.board_m[0], mark.board_m[1], height];
                let point = std::array::from_fn(|k| dot(r[k], board) + pose[4 + k]);
                let [u, v] = state.interior.project(point)?;
                Some([u - mark.image_px[0], v - mark.image_px[1]])
            };
            view.marks
                .iter()
                .map(residual)
                .collect::<Option<Vec<_>>>()
                .ok_or_else(|| SolveError::InfeasibleStart("a corner has no projection".into()))
        })
        .collect()
}

/// The statistics of a solution.
///
/// # Errors
/// [`SolveError::RankDeficient`] says in words which parameters the photos leave undetermined.
pub fn statistics(
    views: &[View],
    request: &Request,
    solution: &Solution,
) -> Result<Statistics, SolveError> {
    let residuals = residuals(views, &solution.state)?;
    let problem = &solution.calibration.problem;
    let observations = 2 * residuals.iter().map(Vec::len).sum::<usize>();
    let unknowns = problem.parameter_count();
    if observations <= unknowns {
        return Err(SolveError::RankDeficient(format!(
            "{observations} observations do not determine {unknowns} unknowns; add photos"
        )));
    }
    let square = |r: &[f64; 2]| r[0] * r[0] + r[1] * r[1];
    let squares: f64 = residuals.iter().flatten().map(square).sum();
    let weighted = residuals.iter().flatten().map(|r| {
        let weight = request.loss.evaluate(square(r)).first;
        [weight, weight * square(r)]
    });
    let [weights, weighted_squares] =
        weighted.fold([0.0; 2], |sums, [weight, part]| [sums[0] + weight, sums[1] + part]);
    let freedom = 2.0 * weights - unknowns as f64;
    if freedom <= 0.0 {
        return Err(SolveError::RankDeficient(format!(
            "the robust loss leaves the weight of {:.0} of {observations} observations, which do not determine {unknowns} unknowns; take a loss of larger scale or add photos",
            2.0 * weights
        )));
    }
    let variance = weighted_squares / freedom;
    let free: Vec<usize> = (0..request.free.len()).filter(|&k| request.free[k]).collect();
    let mut covariance = Covariance::new(problem, &solution.x, LinearSolver::Schur)
        .map_err(|error| undetermined(request, solution, &free).unwrap_or(error))?;
    let own = covariance.block(solution.calibration.lens);
    let own = |i: usize, j: usize| own[i * free.len() + j];
    let student = StudentsT::new(0.0, 1.0, freedom)
        .map_err(|error| SolveError::Misuse(format!("Student's distribution: {error}")))?;
    let described = request.model.parameters();
    let values = solution.state.interior.values();
    let parameters = (0..request.free.len())
        .map(|k| {
            let place = free.iter().position(|&free| free == k);
            let sigma = place.map(|i| (variance * own(i, i)).max(0.0).sqrt());
            let t = sigma.map(|sigma| values[k] / sigma);
            ParameterStatistics {
                name: described[k].name.into(),
                unit: described[k].unit.into(),
                value: values[k],
                free: request.free[k],
                standard_deviation: sigma.unwrap_or(0.0),
                t,
                probability: t.map(|t| 2.0 * student.cdf(-t.abs())),
            }
        })
        .collect();
    let correlation = |i: usize, j: usize| match i == j {
        true => 1.0,
        false => own(i, j) / (own(i, i) * own(j, j)).sqrt(),
    };
    let all = 0..free.len();
    let correlation =
        all.clone().map(|i| all.clone().map(|j| correlation(i, j)).collect()).collect();
    let mut heights_m = Vec::new();
    if request.shape == BoardShape::Free {
        let blocks = &solution.calibration.heights;
        for (block, &height) in blocks.iter().zip(&solution.state.heights_m) {
            if let Some(block) = *block {
                let square = variance * covariance.block(block)[0];
                heights_m.push([height, square.max(0.0).sqrt()]);
            }
        }
    }
    let views = views
        .iter()
        .zip(&residuals)
        .zip(&solution.state.poses)
        .map(|((view, residuals), pose)| view_statistics(view, residuals, pose))
        .collect();
    Ok(Statistics {
        observations,
        unknowns,
        sigma0_px: variance.sqrt(),
        rms_px: (2.0 * squares / observations as f64).sqrt(),
        parameters,
        free: free.iter().map(|&k| described[k].name.into()).collect(),
        correlation,
        views,
        heights_m,
    })
}

fn view_statistics(view: &View, residuals: &[[f64; 2]], pose: &[f64; 7]) -> ViewStatistics {
    let squares = residuals.iter().map(|r| r[0] * r[0] + r[1] * r[1]);
    let r = rotation::matrix([pose[0], pose[1], pose[2], pose[3]]);
    let t = [pose[4], pose[5], pose[6]];
    ViewStatistics {
        corners: view.marks.len(),
        rms_px: (squares.clone().sum::<f64>() / residuals.len().max(1) as f64).sqrt(),
        largest_px: squares.fold(0.0, f64::max).sqrt(),
        tilt_deg: r[2][2].abs().min(1.0).acos().to_degrees(),
        distance_m: dot(t, t).sqrt(),
    }
}

/// A parameter takes part in an undetermined direction with at least this share of its length.
const PART: f64 = 0.15;

/// Says in words which free parameters the photos do not tell apart, if there are any.
fn undetermined(request: &Request, solution: &Solution, free: &[usize]) -> Option<SolveError> {
    let Calibration { problem, lens, .. } = &solution.calibration;
    let parameters = request.model.parameters();
    let mut sentences = Vec::new();
    for direction in null_space(problem, &solution.x, LinearSolver::Schur).ok()? {
        let of_lens = direction.iter().find(|(block, _)| block == lens);
        let entries = of_lens.map_or(&[][..], |(_, entries)| entries);
        let names: Vec<&str> = free
            .iter()
            .zip(entries)
            .filter(|(_, entry)| entry.abs() > PART)
            .map(|(&k, _)| parameters[k].name)
            .collect();
        sentences.push(match names.as_slice() {
            [] => continue,
            [name] => format!("the photos say nothing about {name}"),
            [first, last] => format!("{first} and {last} are the same parameter here"),
            [rest @ .., last] => {
                format!("{} and {last} cannot be told apart in these photos", rest.join(", "))
            }
        });
    }
    (!sentences.is_empty()).then(|| {
        SolveError::RankDeficient(format!(
            "{}; hold one of them, or add photos that are tilted against each other",
            sentences.join("; ")
        ))
    })
}
