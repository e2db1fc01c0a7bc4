//! Data snooping: what the tests reject is taken out, the worst first, and the rest adjusted again.

use super::{
    analysis::{AdjustError, Adjusted, FAR_OUT, adjust_after},
    problem::{Group, Settings},
    statistics::{ObservationRef, OutlierTest, TestedObservation},
};
use crate::scene::{Excluded, ExcludedKind, Reconstruction, Role};
use rowgram_optim::nlls::Loss;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// How suspect observations are looked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct DataSnoopingOptions {
    /// Which test.
    pub test: OutlierTest,
    /// Probability of a false alarm among all observations of a kind in one round.
    pub significance: f64,
    /// The most rounds.
    pub rounds: usize,
    /// Control points and camera positions that are off by less than this are kept, metres: what a lens
    /// model and the shape of a block may be wrong by, of which statistics know nothing. A good
    /// control point at the border, which holds the block there, would else be the first to go.
    pub least_error_m: f64,
    /// The same of marks, pixels.
    pub least_error_px: f64,
    /// Names of control points that stay control whatever the tests say.
    pub keep: Vec<String>,
}

impl Default for DataSnoopingOptions {
    fn default() -> DataSnoopingOptions {
        DataSnoopingOptions {
            test: OutlierTest::Pope,
            significance: 0.01,
            rounds: 20,
            least_error_m: 0.0,
            least_error_px: 0.0,
            keep: Vec::new(),
        }
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
    /// How far it is from what all others say, measured minus that: pixels or metres.
    pub error: [f64; 3],
}

impl Removed {
    /// As something that took no part.
    pub fn excluded(&self) -> Excluded {
        let kind = match self.group {
            Group::TiePoints => ExcludedKind::Observation,
            Group::Marks => ExcludedKind::Mark,
            Group::Control => ExcludedKind::GroundPoint,
            Group::Positions => ExcludedKind::CameraPosition,
            _ => ExcludedKind::ScaleBar,
        };
        Excluded {
            kind,
            image: None,
            point: Some(self.name.clone()),
            reason: format!("its test value is {:.2} times the critical value", self.excess),
        }
    }
}

/// A reconstruction after data snooping.
#[derive(Debug, Clone)]
pub struct DataSnooping {
    /// The last adjustment.
    pub adjusted: Adjusted,
    /// What was taken out, in that order.
    pub removed: Vec<Removed>,
    /// Whether the last round found nothing; otherwise the rounds were used up.
    pub complete: bool,
}

/// Control that was taken out on trial.
struct Trial {
    name: String,
    whole: Reconstruction,
    /// What the other control points were off by, each against all the rest.
    others_m2: f64,
}

/// So many other control points have to say that the block is better without one.
const LEAST_OTHERS: usize = 3;

/// Mean square of how far control points are from what all the rest says, but for one of them; `None` where too few are left.
fn others_m2(adjusted: &Adjusted, settings: &Settings, but: &str) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0);
    for (place, tested) in adjusted.statistics.tested.iter().enumerate() {
        if let ObservationRef::Control(k) = tested.subject
            && adjusted.reconstruction.ground[k].name != but
        {
            sum +=
                describe(adjusted, place, 1.0, settings).error.iter().map(|e| e * e).sum::<f64>();
            count += 1;
        }
    }
    (count >= LEAST_OTHERS).then(|| sum / count as f64)
}

/// Adjusts `whole`, takes out the most suspect observation, and so on until none is suspect. A
/// control point that is taken out becomes a check point; it stays control where the others do not fit better without it, or
/// are too few to say so. Of tie points as many go in one round as
/// are the worst of their point; the block keeps its shape then, so that neither its robust adjustment
/// nor the covariances of its cameras are repeated before nothing is suspect any more.
///
/// # Errors
/// As [`adjust`](super::adjust).
pub fn snoop(
    whole: &mut Reconstruction,
    settings: &Settings,
    snooping: &DataSnoopingOptions,
) -> Result<DataSnooping, AdjustError> {
    let mut removed = Vec::new();
    let mut excluded: Vec<Excluded> = Vec::new();
    let mut round = 0;
    let plain = Settings { tie_loss: Loss::Trivial, ..settings.clone() };
    let mut only_ties = false;
    let mut last: Option<Adjusted> = None;
    let mut trial: Option<Trial> = None;
    let mut snooping = snooping.clone();
    loop {
        let with = if only_ties { &plain } else { settings };
        let mut adjusted = adjust_after(whole, with, last.as_ref())?;
        if let Some(Trial { name, whole: before, others_m2: worse }) = trial.take()
            && others_m2(&adjusted, settings, &name).is_none_or(|better| better >= worse)
        {
            *whole = before;
            removed.pop();
            snooping.keep.push(name);
            continue;
        }
        let worst = select_outliers(&adjusted, settings, &snooping);
        let at_end = worst.is_empty() || round == snooping.rounds;
        if at_end && last.take().is_some() {
            continue;
        }
        if at_end {
            // What earlier rounds excluded is no longer in the reconstruction.
            excluded.append(&mut adjusted.validated.excluded);
            adjusted.validated.excluded = excluded;
            return Ok(DataSnooping { complete: worst.is_empty(), adjusted, removed });
        }
        round += 1;
        let lost = adjusted.validated.excluded.iter();
        excluded.extend(lost.filter(|a| a.reason == FAR_OUT).cloned());
        only_ties = worst
            .iter()
            .all(|(place, _)| adjusted.statistics.tested[*place].group == Group::TiePoints);
        if let [(place, _)] = worst.as_slice()
            && let ObservationRef::Control(k) = adjusted.statistics.tested[*place].subject
        {
            let name = adjusted.reconstruction.ground[k].name.clone();
            let Some(others_m2) = others_m2(&adjusted, settings, &name) else {
                snooping.keep.push(name);
                continue;
            };
            trial = Some(Trial { name, whole: whole.clone(), others_m2 });
        }
        for (place, excess) in &worst {
            removed.push(describe(&adjusted, *place, *excess, settings));
        }
        take_out(whole, &adjusted, &worst);
        last = only_ties.then(|| last.take().unwrap_or(adjusted));
    }
}

/// What goes this round: the worst of everything on the ground and in the air, or else the worst of each
/// tie point.
fn select_outliers(
    adjusted: &Adjusted,
    settings: &Settings,
    snooping: &DataSnoopingOptions,
) -> Vec<(usize, f64)> {
    let mut worst: Option<(usize, f64)> = None;
    let mut of_points: BTreeMap<u32, (usize, f64)> = BTreeMap::new();
    for (place, excess) in suspects(adjusted, snooping) {
        if let ObservationRef::TieObservation(k) = adjusted.statistics.tested[place].subject {
            let point = adjusted.reconstruction.observations[k].point;
            of_points.entry(point).or_insert((place, excess));
        } else if worst.is_none()
            && !is_kept(adjusted, place, snooping)
            && is_large(&describe(adjusted, place, excess, settings), snooping)
        {
            worst = Some((place, excess));
        }
    }
    match worst {
        // A wrong control point bends the block and makes good tie points look bad.
        Some((place, excess)) => vec![(point_of_single_mark(adjusted, place, snooping), excess)],
        None => of_points.into_values().collect(),
    }
}

/// A control point and its only mark are one and the same doubt: the point is what is named.
fn point_of_single_mark(
    adjusted: &Adjusted,
    place: usize,
    snooping: &DataSnoopingOptions,
) -> usize {
    let ObservationRef::Mark(mark) = adjusted.statistics.tested[place].subject else {
        return place;
    };
    let marks = &adjusted.reconstruction.marks;
    let ground = marks[mark].ground;
    if marks.iter().filter(|other| other.ground == ground).count() > 1 {
        return place;
    }
    let is_point =
        |tested: &TestedObservation| tested.subject == ObservationRef::Control(ground as usize);
    let point = adjusted.statistics.tested.iter().position(is_point);
    point.filter(|&point| !is_kept(adjusted, point, snooping)).unwrap_or(place)
}

fn is_kept(adjusted: &Adjusted, place: usize, snooping: &DataSnoopingOptions) -> bool {
    match adjusted.statistics.tested[place].subject {
        ObservationRef::Control(k) => {
            snooping.keep.contains(&adjusted.reconstruction.ground[k].name)
        }
        _ => false,
    }
}

fn is_large(suspect: &Removed, snooping: &DataSnoopingOptions) -> bool {
    let least = match suspect.group {
        Group::Marks => snooping.least_error_px,
        _ => snooping.least_error_m,
    };
    suspect.error.iter().map(|e| e * e).sum::<f64>() >= least * least
}

/// What is in doubt on the ground and in the air after snooping, and was kept because it is not off by
/// much; the worst first.
pub fn retained_suspects(
    adjusted: &Adjusted,
    settings: &Settings,
    snooping: &DataSnoopingOptions,
) -> Vec<Removed> {
    suspects(adjusted, snooping)
        .into_iter()
        .filter(|(place, _)| adjusted.statistics.tested[*place].group != Group::TiePoints)
        .map(|(place, excess)| describe(adjusted, place, excess, settings))
        .collect()
}

/// What the test rejects, the worst first.
fn suspects(adjusted: &Adjusted, snooping: &DataSnoopingOptions) -> Vec<(usize, f64)> {
    let statistics = &adjusted.statistics;
    let ties = statistics.tested.iter().filter(|tested| tested.group == Group::TiePoints).count();
    // What is on the ground and in the air is one family: a false alarm there costs a point.
    let known = statistics.tested.len() - ties;
    statistics.rejected(snooping.test, |group| {
        let count = if group == Group::TiePoints { ties } else { known };
        snooping.significance / count.max(1) as f64
    })
}

fn describe(adjusted: &Adjusted, place: usize, excess: f64, settings: &Settings) -> Removed {
    let tested = &adjusted.statistics.tested[place];
    let reconstruction = &adjusted.reconstruction;
    let factor = settings.factor(tested.group);
    let sigma = match tested.subject {
        ObservationRef::TieObservation(_) => [reconstruction.tie_sigma_px; 3],
        ObservationRef::Mark(k) => [reconstruction.marks[k].sigma_px; 3],
        ObservationRef::Control(k) => {
            let point = &reconstruction.ground[k];
            let mut sigma = [0.0; 3];
            for (row, &axis) in point.axes.indices().iter().enumerate() {
                sigma[row] = point.sigma_m[axis];
            }
            sigma
        }
        ObservationRef::Position(k) => reconstruction.positions[k].sigma_m,
        ObservationRef::ScaleBar(k) => [reconstruction.scale_bars[k].sigma_m; 3],
    };
    Removed {
        name: adjusted.name(tested.subject),
        group: tested.group,
        excess,
        residual: std::array::from_fn(|k| tested.residual[k] * sigma[k] * factor),
        error: std::array::from_fn(|k| tested.error[k] * sigma[k] * factor),
    }
}

fn take_out(whole: &mut Reconstruction, adjusted: &Adjusted, worst: &[(usize, f64)]) {
    let validated = &adjusted.validated;
    let mut ties = vec![true; whole.observations.len()];
    let mut marks = vec![true; whole.marks.len()];
    let mut positions = vec![true; whole.positions.len()];
    let mut bars = vec![true; whole.scale_bars.len()];
    for (place, _) in worst {
        match adjusted.statistics.tested[*place].subject {
            ObservationRef::TieObservation(k) => ties[validated.observations[k]] = false,
            ObservationRef::Mark(k) => marks[validated.marks[k]] = false,
            ObservationRef::Control(k) => whole.ground[validated.ground[k]].role = Role::Check,
            ObservationRef::Position(k) => positions[validated.positions[k]] = false,
            ObservationRef::ScaleBar(k) => bars[validated.scale_bars[k]] = false,
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
