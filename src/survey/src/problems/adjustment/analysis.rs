//! Adjusting a reconstruction, and adjusting it again: without one control point at a time, with other
//! weights. What is suspect is taken out by [`super::snooping`].

use super::{
    check_points::{CheckPoint, check_points},
    problem::{AdjustmentProblem, Group, Settings},
    statistics::{ObservationRef, Statistics},
    validation::{InvalidReconstruction, Validated, validate},
};
use crate::scene::{Excluded, ExcludedKind, Reconstruction, Role};
use rowgram_base::Kind;
use rowgram_optim::robust::sigma_of_distances;
use rowgram_optim::{
    engine::{SolveError, Termination},
    nlls::{Loss, Options, Summary, solve},
};
use serde::Serialize;

/// Why a reconstruction could not be adjusted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum AdjustError {
    /// The reconstruction itself is wrong.
    #[error(transparent)]
    Invalid(#[from] InvalidReconstruction),
    /// It has no solution, or none was reached.
    #[error(transparent)]
    Solve(#[from] SolveError),
}

/// A reconstruction that its observations do not determine is as much an input's fault as a number that is none.
impl From<AdjustError> for rowgram_base::Error {
    fn from(error: AdjustError) -> Self {
        let kind = match &error {
            AdjustError::Invalid(_) | AdjustError::Solve(SolveError::RankDeficient(_)) => {
                Kind::BadInput
            }
            AdjustError::Solve(_) => Kind::Failure,
        };
        rowgram_base::Error::module(kind, error)
    }
}

/// An adjusted reconstruction.
#[derive(Debug, Clone)]
pub struct Adjusted {
    /// What took part, where from, and what did not.
    pub validated: Validated,
    /// The part that was adjusted.
    pub reconstruction: Reconstruction,
    /// The outcome of the solver.
    pub summary: Summary,
    /// Standard deviations, tests and variance factors.
    pub statistics: Statistics,
    /// The check points, by their index in `reconstruction`.
    pub check_points: Vec<CheckPoint>,
    /// Where the adjustment puts each ground point of `reconstruction` that took part, metres.
    pub ground_m: Vec<Option<[f64; 3]>>,
    /// Lens parameters, by camera and place, that still move where the iterations ended.
    pub creeping: Vec<(usize, usize)>,
}

/// Validates `whole`, adjusts it and evaluates the result; `whole` gets the adjusted values.
///
/// With a robust loss for tie points, that adjustment only finds where to start from: those with
/// residuals beyond four standard deviations of their own spread are excluded, and the rest is
/// adjusted by least squares.
///
/// # Errors
/// Where the reconstruction is wrong ([`InvalidReconstruction`]), cannot be evaluated, or does not determine its parameters
/// ([`SolveError::RankDeficient`], in words).
pub fn adjust(whole: &mut Reconstruction, settings: &Settings) -> Result<Adjusted, AdjustError> {
    adjust_after(whole, settings, None)
}

/// The robust adjustment only finds where to start from.
const ROBUST_TOLERANCE: f64 = 1e-8;
/// A step that gains less than this share of the cost changes no residual by what tests could see.
const ROUGH_TOLERANCE: f64 = 1e-7;

/// [`adjust`], `whole` having lost nothing but tie observations since it was adjusted as `last`: just
/// well enough to test what is left, with the covariances of the cameras from then. These are too small now,
/// and so are the test values (but for Pope's variance factor, which hardly moves): what is suspect would be with
/// the right ones too, and the last adjustment, which has these, decides.
pub(super) fn adjust_after(
    whole: &mut Reconstruction,
    settings: &Settings,
    last: Option<&Adjusted>,
) -> Result<Adjusted, AdjustError> {
    let mut validated = validate(whole)?;
    if settings.tie_loss != Loss::Trivial && !validated.reconstruction.observations.is_empty() {
        let adjustment = AdjustmentProblem::new(&validated.reconstruction, settings)?;
        let mut x = adjustment.problem.start();
        let engine = Options { cost_tolerance: ROBUST_TOLERANCE, ..settings.engine() };
        solve(&adjustment.problem, &mut x, &engine, settings.max_iterations)?;
        let mut reconstruction = validated.reconstruction.clone();
        adjustment.update(&x, &mut reconstruction);
        validated.update(&reconstruction, whole);
        let far = far_observations(&adjustment, &x)?;
        validated = set_aside(whole, &validated, &far)?;
    }
    let plain = Settings { tie_loss: Loss::Trivial, ..settings.clone() };
    let same = |last: &&Adjusted| {
        last.validated.images == validated.images && last.validated.ground == validated.ground
    };
    let of_last = last.filter(same).map(|last| last.statistics.inverse.clone());
    let datum = of_last.as_ref().and_then(|inverse| inverse.scale_datum);
    let adjustment = AdjustmentProblem::with_scale_datum(&validated.reconstruction, &plain, datum)?;
    let mut x = adjustment.problem.start();
    let mut engine = plain.engine();
    if last.is_some() {
        engine.cost_tolerance = ROUGH_TOLERANCE;
    }
    let (summary, moving) = solve_to_rest(&adjustment, &mut x, &engine, plain.max_iterations)?;
    let mut reconstruction = validated.reconstruction.clone();
    adjustment.update(&x, &mut reconstruction);
    let statistics = match of_last {
        Some(inverse) => {
            Statistics::with_inverse(&reconstruction, &adjustment, &plain, &x, inverse)?
        }
        None => Statistics::new(&reconstruction, &adjustment, &plain, &x)?,
    };
    let creeping = creeping(&reconstruction, &statistics, &moving);
    let check_points = check_points(&reconstruction, &adjustment, &x, &statistics);
    let ground_m = (0..reconstruction.ground.len()).map(|k| adjustment.ground_m(&x, k)).collect();
    validated.update(&reconstruction, whole);
    Ok(Adjusted {
        validated,
        reconstruction,
        summary,
        statistics,
        check_points,
        ground_m,
        creeping,
    })
}

/// The last iterations, whose progress is judged where the limit is reached.
const LAST_ITERATIONS: u64 = 10;
/// Parameters that the last iterations moved by more than this many standard deviations have not come to rest.
const AT_REST: f64 = 0.2;

/// Solves, and judges an end at the limit: where the last iterations together gain less than half the variance of unit
/// weight, no parameter is a standard deviation away from where further ones would bring it, and the noise of the cost is larger by
/// orders. With what the last iterations moved the lenses by.
fn solve_to_rest(
    adjustment: &AdjustmentProblem,
    x: &mut Vec<f64>,
    engine: &Options,
    iterations: u64,
) -> Result<(Summary, Vec<Vec<f64>>), SolveError> {
    let problem = &adjustment.problem;
    let most = if iterations > LAST_ITERATIONS { iterations - LAST_ITERATIONS } else { iterations };
    let first = solve(problem, x, engine, most)?;
    if first.stop != Termination::MaxIterations || iterations <= LAST_ITERATIONS {
        return Ok((first, Vec::new()));
    }
    let before = x.clone();
    let mut last = solve(problem, x, engine, LAST_ITERATIONS)?;
    let redundancy = last.residuals.saturating_sub(last.parameters).max(1) as f64;
    let variance = 2.0 * last.final_cost / redundancy;
    let rests = first.final_cost - last.final_cost < 0.5 * variance;
    last.initial_cost = first.initial_cost;
    last.iterations += first.iterations;
    if last.stop.converged() || rests {
        last.stop = Termination::CostConverged;
        return Ok((last, Vec::new()));
    }
    let moved = adjustment.lenses.iter().map(|&lens| {
        let (from, to) = (problem.values(&before, lens), problem.values(x, lens));
        from.iter().zip(to).map(|(a, b)| b - a).collect()
    });
    Ok((last, moved.collect()))
}

/// Parameters of lenses that moved by a good part of their standard deviations, the one that moved most last.
fn creeping(
    reconstruction: &Reconstruction,
    statistics: &Statistics,
    moved: &[Vec<f64>],
) -> Vec<(usize, usize)> {
    let mut found = Vec::new();
    for interior in &statistics.interiors {
        let Some(moved) = moved.get(interior.camera) else { continue };
        let model = reconstruction.cameras[interior.camera].interior.model();
        for (name, sigma) in interior.names.iter().zip(&interior.standard_deviations) {
            let Some(place) = model.place(name) else { continue };
            let ratio = moved.get(place).map_or(0.0, |moved| moved.abs() / sigma.max(1e-300));
            if *sigma > 0.0 && ratio > AT_REST {
                found.push((ratio, (interior.camera, place)));
            }
        }
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found.into_iter().map(|(_, which)| which).collect()
}

impl Adjusted {
    /// Whether the engine came to an optimum.
    pub fn converged(&self) -> bool {
        self.summary.stop.converged()
    }

    /// What a person calls an observation.
    pub fn name(&self, subject: ObservationRef) -> String {
        let reconstruction = &self.reconstruction;
        let image = |k: u32| &reconstruction.images[k as usize].name;
        match subject {
            ObservationRef::TieObservation(k) => {
                let o = &reconstruction.observations[k];
                format!(
                    "tie point {} in {}",
                    reconstruction.points[o.point as usize].id,
                    image(o.image)
                )
            }
            ObservationRef::Mark(k) => {
                let mark = &reconstruction.marks[k];
                let ground = &reconstruction.ground[mark.ground as usize].name;
                format!("mark of {ground} in {}", image(mark.image))
            }
            ObservationRef::Control(k) => {
                format!("control point {}", reconstruction.ground[k].name)
            }
            ObservationRef::Position(k) => {
                format!("camera position of {}", image(reconstruction.positions[k].image))
            }
            ObservationRef::ScaleBar(k) => {
                let ends = reconstruction.scale_bars[k].ends;
                let [a, b] = ends.map(|end| reconstruction.ground[end as usize].name.clone());
                format!("scale bar {a} - {b}")
            }
        }
    }
}

/// Tie observations whose residuals are beyond four standard deviations of the bulk's.
fn far_observations(adjustment: &AdjustmentProblem, x: &[f64]) -> Result<Vec<bool>, SolveError> {
    let residuals = adjustment.problem.residuals(x, Group::TiePoints.name())?;
    let lengths: Vec<f64> = residuals.chunks_exact(2).map(|r| r[0].hypot(r[1])).collect();
    // Nothing within four of the standard deviations given is suspect.
    let sigma = sigma_of_distances(lengths.iter().copied()).unwrap_or(1.0).max(1.0);
    Ok(lengths.iter().map(|&length| length > 4.0 * sigma).collect())
}

pub(super) const FAR_OUT: &str = "its residual is far out in the robust adjustment";

/// Removes observations from `whole` and lists them among what is excluded.
fn set_aside(
    whole: &mut Reconstruction,
    validated: &Validated,
    far: &[bool],
) -> Result<Validated, InvalidReconstruction> {
    let mut drop = vec![false; whole.observations.len()];
    let mut named = Vec::new();
    for (&far, &k) in far.iter().zip(&validated.observations) {
        if far {
            drop[k] = true;
            let o = &whole.observations[k];
            named.push(Excluded {
                kind: ExcludedKind::Observation,
                image: Some(whole.images[o.image as usize].name.clone()),
                point: Some(whole.points[o.point as usize].id.to_string()),
                reason: FAR_OUT.into(),
            });
        }
    }
    let mut drop = drop.into_iter();
    whole.observations.retain(|_| !drop.next().unwrap_or(false));
    let mut again = validate(whole)?;
    again.excluded.splice(0..0, named);
    Ok(again)
}

/// A control point as the rest of the block sees it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LeaveOneOut {
    /// Its name.
    pub name: String,
    /// Where the block without it puts it minus its coordinates, metres; `None` where that block
    /// does not determine it.
    pub error_m: Option<[f64; 3]>,
    /// Standard deviations expected of that, its own coordinates' included, metres.
    pub sigma_m: Option<[f64; 3]>,
}

/// Makes each control point in turn a check point and adjusts the rest.
///
/// # Errors
/// Where the reconstruction is wrong; a rest without a solution leaves its point without an error.
pub fn leave_one_out(
    whole: &Reconstruction,
    settings: &Settings,
) -> Result<Vec<LeaveOneOut>, AdjustError> {
    let control: Vec<usize> =
        (0..whole.ground.len()).filter(|&k| whole.ground[k].role == Role::Control).collect();
    let mut found = Vec::new();
    for k in control {
        let mut rest = whole.clone();
        rest.ground[k].role = Role::Check;
        let name = whole.ground[k].name.clone();
        let check = match adjust(&mut rest, settings) {
            Ok(adjusted) => {
                let sigma0 = adjusted.statistics.sigma0;
                let point = adjusted
                    .check_points
                    .iter()
                    .find(|check| adjusted.validated.ground[check.ground] == k);
                point.map(|check| (check.error_m, check.covariance_m2, sigma0))
            }
            Err(AdjustError::Solve(_)) => None,
            Err(error @ AdjustError::Invalid(_)) => return Err(error),
        };
        let axes = whole.ground[k].axes.indices();
        let factor = settings.factor(Group::Control);
        let own = whole.ground[k].sigma_m.map(|sigma| sigma * factor);
        found.push(LeaveOneOut {
            name,
            error_m: check.map(|(error, _, _)| {
                std::array::from_fn(|a| if axes.contains(&a) { error[a] } else { f64::NAN })
            }),
            sigma_m: check.map(|(_, c, sigma0)| {
                std::array::from_fn(|a| (sigma0 * sigma0 * c[a][a] + own[a] * own[a]).sqrt())
            }),
        });
    }
    Ok(found)
}

/// Variance components of the groups.
#[derive(Debug, Clone)]
pub struct VarianceComponents {
    /// The settings with the factors found.
    pub settings: Settings,
    /// The adjustment with them.
    pub adjusted: Adjusted,
    /// Rounds made.
    pub rounds: usize,
    /// Whether the factors settled.
    pub converged: bool,
}

/// Groups whose redundancy is below this keep their factor.
const LEAST_GROUP_REDUNDANCY: f64 = 3.0;

/// Estimates a factor on the standard deviations of each group so that every group fits its own,
/// by rounds of `sigma_g^2 <- sigma_g^2 (v^T v)_g / r_g` (Foerstner). What is known beforehand of lenses and
/// motions keeps its weight, and so do orientations, whose errors have parts in common.
///
/// # Errors
/// As [`adjust`].
pub fn variance_components(
    whole: &mut Reconstruction,
    settings: &Settings,
    rounds: usize,
) -> Result<VarianceComponents, AdjustError> {
    let mut settings = settings.clone();
    let mut adjusted = adjust(whole, &settings)?;
    settings.tie_loss = Loss::Trivial;
    for round in 0..rounds {
        let mut change: f64 = 0.0;
        for group in &adjusted.statistics.groups {
            let held = matches!(group.group, Group::Interior | Group::Motion | Group::Orientations);
            if held || group.redundancy < LEAST_GROUP_REDUNDANCY {
                continue;
            }
            if let Some(variance) = group.variance_factor() {
                let factor = variance.sqrt().clamp(0.1, 10.0);
                settings.sigma_factors[group.group as usize] *= factor;
                change = change.max((factor - 1.0).abs());
            }
        }
        if change < 0.01 {
            return Ok(VarianceComponents { settings, adjusted, rounds: round, converged: true });
        }
        adjusted = adjust(whole, &settings)?;
    }
    Ok(VarianceComponents { settings, adjusted, rounds, converged: false })
}
