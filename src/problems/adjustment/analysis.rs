//! Adjusting a survey, and adjusting it again: without what is suspect, without one control point
//! at a time, with other weights.

use super::{
    check_points::{CheckPoint, check_points},
    posed::{Group, Posed, Settings},
    screening::{Aside, Screened, SurveyError, screen},
    statistics::{Statistics, Subject, Testing},
    survey::{Role, Survey},
};
use crate::{
    engine::{SolveError, Stop},
    nlls::{Loss, Summary, solve},
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Why a survey could not be adjusted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum AdjustError {
    /// The survey itself is wrong.
    #[error(transparent)]
    Survey(#[from] SurveyError),
    /// It has no solution, or none was reached.
    #[error(transparent)]
    Solve(#[from] SolveError),
}

/// An adjusted survey.
#[derive(Debug, Clone)]
pub struct Adjusted {
    /// What took part, where from, and what did not.
    pub screened: Screened,
    /// The survey that took part, adjusted.
    pub survey: Survey,
    /// How the engine fared.
    pub summary: Summary,
    /// What it is worth.
    pub statistics: Statistics,
    /// The check points, by their index in `survey`.
    pub check_points: Vec<CheckPoint>,
    /// Where the adjustment puts each ground point of `survey` that took part, metres.
    pub ground_m: Vec<Option<[f64; 3]>>,
}

/// Looks through `whole`, adjusts it and judges the result; `whole` gets the adjusted values.
///
/// With a robust loss for tie points, that adjustment only finds where to start from: those with
/// residuals beyond four standard deviations of their own spread are set aside, and what is left is
/// adjusted by least squares.
///
/// # Errors
/// Where the survey is wrong ([`SurveyError`]), cannot be evaluated, or does not determine its parameters
/// ([`SolveError::RankDeficient`], in words).
pub fn adjust(whole: &mut Survey, settings: &Settings) -> Result<Adjusted, AdjustError> {
    let mut screened = screen(whole)?;
    let mut initial_cost = None;
    if settings.tie_loss != Loss::Trivial {
        let posed = Posed::new(&screened.survey, settings)?;
        let mut x = posed.problem.start();
        let summary = solve(&posed.problem, &mut x, &settings.engine(), settings.max_iterations)?;
        initial_cost = Some(summary.initial_cost);
        let mut survey = screened.survey.clone();
        posed.update(&x, &mut survey);
        screened.update(&survey, whole);
        let far = far_observations(&posed, &x)?;
        screened = set_aside(whole, &screened, &far)?;
    }
    let plain = Settings { tie_loss: Loss::Trivial, ..settings.clone() };
    let posed = Posed::new(&screened.survey, &plain)?;
    let mut x = posed.problem.start();
    let mut summary = solve(&posed.problem, &mut x, &plain.engine(), plain.max_iterations)?;
    summary.initial_cost = initial_cost.unwrap_or(summary.initial_cost);
    let mut survey = screened.survey.clone();
    posed.update(&x, &mut survey);
    let statistics = Statistics::new(&survey, &posed, &plain, &x)?;
    let check_points = check_points(&survey, &posed, &x, &statistics);
    let ground_m = (0..survey.ground.len()).map(|k| posed.ground_m(&x, k)).collect();
    screened.update(&survey, whole);
    Ok(Adjusted { screened, survey, summary, statistics, check_points, ground_m })
}

impl Adjusted {
    /// Whether the engine came to an optimum.
    pub fn converged(&self) -> bool {
        self.summary.stop.converged() || self.summary.stop == Stop::Stalled
    }

    /// What a person calls an observation.
    pub fn name(&self, subject: Subject) -> String {
        let survey = &self.survey;
        let image = |k: u32| &survey.images[k as usize].name;
        match subject {
            Subject::TieObservation(k) => {
                let o = &survey.observations[k];
                format!("tie point {} in {}", survey.points[o.point as usize].id, image(o.image))
            }
            Subject::Mark(k) => {
                let mark = &survey.marks[k];
                let ground = &survey.ground[mark.ground as usize].name;
                format!("mark of {ground} in {}", image(mark.image))
            }
            Subject::Control(k) => format!("control point {}", survey.ground[k].name),
            Subject::Position(k) => {
                format!("camera position of {}", image(survey.positions[k].image))
            }
            Subject::ScaleBar(k) => {
                let ends = survey.scale_bars[k].ends;
                let [a, b] = ends.map(|end| survey.ground[end as usize].name.clone());
                format!("scale bar {a} - {b}")
            }
        }
    }
}

/// Tie observations whose residuals are beyond four standard deviations of the bulk's.
fn far_observations(posed: &Posed, x: &[f64]) -> Result<Vec<bool>, SolveError> {
    let residuals = posed.problem.residuals(x, Group::TiePoints.name())?;
    let lengths: Vec<f64> = residuals.chunks_exact(2).map(|r| r[0].hypot(r[1])).collect();
    let mut sorted = lengths.clone();
    sorted.sort_by(f64::total_cmp);
    // The median of a length in the plane is 1.1774 standard deviations; nothing within four of
    // those given is suspect.
    let sigma = (sorted[sorted.len() / 2] / 1.1774).max(1.0);
    Ok(lengths.iter().map(|&length| length > 4.0 * sigma).collect())
}

const FAR_OUT: &str = "its residual is far out in the robust adjustment";

/// Takes observations out of `whole`; names them among what is set aside.
fn set_aside(
    whole: &mut Survey,
    screened: &Screened,
    far: &[bool],
) -> Result<Screened, SurveyError> {
    let mut drop = vec![false; whole.observations.len()];
    let mut named = Vec::new();
    for (&far, &k) in far.iter().zip(&screened.observations) {
        if far {
            drop[k] = true;
            let o = &whole.observations[k];
            named.push(Aside {
                kind: "observation",
                image: Some(whole.images[o.image as usize].name.clone()),
                point: Some(whole.points[o.point as usize].id.to_string()),
                reason: FAR_OUT.into(),
            });
        }
    }
    let mut drop = drop.into_iter();
    whole.observations.retain(|_| !drop.next().unwrap_or(false));
    let mut again = screen(whole)?;
    again.aside.splice(0..0, named);
    Ok(again)
}

/// How suspect observations are looked for.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Snooping {
    /// Which test.
    pub test: Testing,
    /// Probability of a false alarm among all observations of a kind in one round.
    pub significance: f64,
    /// The most rounds.
    pub rounds: usize,
}

impl Default for Snooping {
    fn default() -> Snooping {
        Snooping { test: Testing::Pope, significance: 0.01, rounds: 20 }
    }
}

/// An observation that was taken out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Removed {
    /// What a person calls it.
    pub name: String,
    /// Its kind.
    pub group: Group,
    /// Its test value over the critical value.
    pub excess: f64,
    /// The residual that it had, adjusted minus measured: pixels or metres.
    pub residual: [f64; 3],
}

/// A survey after data snooping.
#[derive(Debug, Clone)]
pub struct Snooped {
    /// The last adjustment.
    pub adjusted: Adjusted,
    /// What was taken out, in that order.
    pub removed: Vec<Removed>,
    /// Whether the last round found nothing; otherwise the rounds were used up.
    pub complete: bool,
}

/// Adjusts `whole`, takes out the most suspect observation, and so on until none is suspect. A
/// control point that is taken out becomes a check point. Of tie points as many go in one round as
/// are the worst of their point; the block keeps its shape then, so that its robust adjustment
/// ([`adjust`]) is not repeated as it is after everything else.
///
/// # Errors
/// As [`adjust`].
pub fn snoop(
    whole: &mut Survey,
    settings: &Settings,
    snooping: &Snooping,
) -> Result<Snooped, AdjustError> {
    let mut removed = Vec::new();
    let mut aside: Vec<Aside> = Vec::new();
    let mut round = 0;
    let plain = Settings { tie_loss: Loss::Trivial, ..settings.clone() };
    let mut only_ties = false;
    loop {
        let mut adjusted = adjust(whole, if only_ties { &plain } else { settings })?;
        let worst = suspects(&adjusted, snooping);
        if worst.is_empty() || round == snooping.rounds {
            // What earlier rounds set aside is no longer in the survey.
            aside.append(&mut adjusted.screened.aside);
            adjusted.screened.aside = aside;
            return Ok(Snooped { complete: worst.is_empty(), adjusted, removed });
        }
        round += 1;
        let lost = adjusted.screened.aside.iter();
        aside.extend(lost.filter(|a| a.reason == FAR_OUT).cloned());
        only_ties = worst
            .iter()
            .all(|(place, _)| adjusted.statistics.tested[*place].group == Group::TiePoints);
        for (place, excess) in &worst {
            removed.push(describe(&adjusted, *place, *excess, settings));
        }
        take_out(whole, &adjusted, &worst);
    }
}

/// Places in `tested` of what goes this round: the worst of everything on the ground and in the
/// air, or else the worst of each tie point.
fn suspects(adjusted: &Adjusted, snooping: &Snooping) -> Vec<(usize, f64)> {
    let statistics = &adjusted.statistics;
    let count = |group: Group| {
        statistics.tested.iter().filter(|tested| tested.group == group).count().max(1) as f64
    };
    let counts: BTreeMap<Group, f64> = Group::ALL.iter().map(|&g| (g, count(g))).collect();
    let critical: BTreeMap<Group, [f64; 4]> = counts
        .iter()
        .map(|(&group, count)| {
            let of = |freedom: usize| {
                let significance = snooping.significance / count;
                statistics.critical(snooping.test, group, freedom.max(1), significance)
            };
            (group, std::array::from_fn(of))
        })
        .collect();
    let mut worst: Option<(usize, f64)> = None;
    let mut of_points: BTreeMap<u32, (usize, f64)> = BTreeMap::new();
    for (place, tested) in statistics.tested.iter().enumerate() {
        if tested.freedom == 0 {
            continue;
        }
        let excess = tested.statistic / critical[&tested.group][tested.freedom];
        if excess <= 1.0 {
            continue;
        }
        if let Subject::TieObservation(k) = tested.subject {
            let point = adjusted.survey.observations[k].point;
            let best = of_points.entry(point).or_insert((place, excess));
            if excess > best.1 {
                *best = (place, excess);
            }
        } else if worst.is_none_or(|(_, most)| excess > most) {
            worst = Some((place, excess));
        }
    }
    match worst {
        // A wrong control point bends the block and makes good tie points look bad.
        Some(worst) => vec![worst],
        None => of_points.into_values().collect(),
    }
}

fn describe(adjusted: &Adjusted, place: usize, excess: f64, settings: &Settings) -> Removed {
    let tested = &adjusted.statistics.tested[place];
    let survey = &adjusted.survey;
    let factor = settings.factor(tested.group);
    let sigma = match tested.subject {
        Subject::TieObservation(_) => [survey.tie_sigma_px; 3],
        Subject::Mark(k) => [survey.marks[k].sigma_px; 3],
        Subject::Control(k) => {
            let point = &survey.ground[k];
            let mut sigma = [0.0; 3];
            for (row, &axis) in point.axes.indices().iter().enumerate() {
                sigma[row] = point.sigma_m[axis];
            }
            sigma
        }
        Subject::Position(k) => survey.positions[k].sigma_m,
        Subject::ScaleBar(k) => [survey.scale_bars[k].sigma_m; 3],
    };
    Removed {
        name: adjusted.name(tested.subject),
        group: tested.group,
        excess,
        residual: std::array::from_fn(|k| tested.residual[k] * sigma[k] * factor),
    }
}

fn take_out(whole: &mut Survey, adjusted: &Adjusted, worst: &[(usize, f64)]) {
    let screened = &adjusted.screened;
    let mut ties = vec![true; whole.observations.len()];
    let mut marks = vec![true; whole.marks.len()];
    let mut positions = vec![true; whole.positions.len()];
    let mut bars = vec![true; whole.scale_bars.len()];
    for (place, _) in worst {
        match adjusted.statistics.tested[*place].subject {
            Subject::TieObservation(k) => ties[screened.observations[k]] = false,
            Subject::Mark(k) => marks[screened.marks[k]] = false,
            Subject::Control(k) => whole.ground[screened.ground[k]].role = Role::Check,
            Subject::Position(k) => positions[screened.positions[k]] = false,
            Subject::ScaleBar(k) => bars[screened.scale_bars[k]] = false,
        }
    }
    keep(&mut whole.observations, &ties);
    keep(&mut whole.marks, &marks);
    keep(&mut whole.positions, &positions);
    keep(&mut whole.scale_bars, &bars);
}

fn keep<T>(of: &mut Vec<T>, wanted: &[bool]) {
    let mut wanted = wanted.iter();
    of.retain(|_| wanted.next().copied().unwrap_or(true));
}

/// A control point as the rest of the block sees it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LeftOut {
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
/// Where the survey is wrong; a rest without a solution leaves its point without an error.
pub fn leave_one_out(whole: &Survey, settings: &Settings) -> Result<Vec<LeftOut>, AdjustError> {
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
                    .find(|check| adjusted.screened.ground[check.ground] == k);
                point.map(|check| (check.error_m, check.covariance_m2, sigma0))
            }
            Err(AdjustError::Solve(_)) => None,
            Err(error @ AdjustError::Survey(_)) => return Err(error),
        };
        let axes = whole.ground[k].axes.indices();
        let own = whole.ground[k].sigma_m;
        found.push(LeftOut {
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
/// motions keeps its weight.
///
/// # Errors
/// As [`adjust`].
pub fn variance_components(
    whole: &mut Survey,
    settings: &Settings,
    rounds: usize,
) -> Result<VarianceComponents, AdjustError> {
    let mut settings = settings.clone();
    let mut adjusted = adjust(whole, &settings)?;
    settings.tie_loss = Loss::Trivial;
    for round in 0..rounds {
        let mut change: f64 = 0.0;
        for group in &adjusted.statistics.groups {
            let held = matches!(group.group, Group::Interior | Group::Motion);
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
