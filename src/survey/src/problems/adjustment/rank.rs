//! A rank deficiency in words: which parameters the observations cannot tell apart.

use super::{
    analysis::AdjustError,
    problem::{AdjustmentProblem, Settings},
    validation::validate,
};
use crate::camera::Lens;
use crate::scene::Reconstruction;
use rowgram_optim::{
    engine::SolveError,
    nlls::{
        BlockId, LinearSolver, Loss,
        covariance::{Direction, null_space},
    },
};
use std::collections::BTreeSet;

/// An entry of a lens takes part where its share of the direction's lens part is above this.
const TAKES_PART: f64 = 1e-3;
/// A direction is one of lenses alone where they have this share of it.
const LENS_ALONE: f64 = 0.05;

/// Says why the normal equations of `adjustment` at `x` have no inverse; `otherwise` where nothing more
/// is found.
pub(super) fn explain(
    reconstruction: &Reconstruction,
    adjustment: &AdjustmentProblem,
    x: &[f64],
    otherwise: SolveError,
) -> SolveError {
    let Ok(directions) = null_space(&adjustment.problem, x, LinearSolver::Schur) else {
        return otherwise;
    };
    if directions.is_empty() {
        return otherwise;
    }
    let datum = directions.iter().filter(|direction| is_datum(adjustment, direction)).count();
    let mut reasons: Vec<String> = Vec::new();
    if datum > 0 {
        reasons.push(format!(
            "position, orientation or scale of the whole block is free in {datum} direction(s): the control does not fix it; give at least three control points or camera positions that are not in one line, or ask for a minimal datum"
        ));
    }
    let mut of_lenses = BTreeSet::new();
    let mut images = BTreeSet::new();
    for direction in directions.iter().filter(|direction| !is_datum(adjustment, direction)) {
        let names = lens_names(reconstruction, adjustment, direction);
        if names.is_empty() {
            for (block, entries) in direction {
                let share: f64 = entries.iter().map(|v| v * v).sum();
                if let Some(k) = adjustment.images.iter().position(|image| image == block)
                    && share > 0.05
                {
                    images.insert(reconstruction.images[k].name.clone());
                }
            }
        } else {
            of_lenses.insert(names);
        }
    }
    for names in of_lenses {
        reasons.push(match names.as_slice() {
            [one] => format!("{one} has no influence on any observation here; hold it"),
            [first, second] => format!(
                "{first} and {second} are the same parameter here; hold one of them, or give one a standard deviation"
            ),
            many => format!(
                "{} cannot be told apart here; hold one of them, or give one a standard deviation",
                many.join(", ")
            ),
        });
    }
    if !images.is_empty() {
        let names: Vec<String> = images.iter().take(5).cloned().collect();
        reasons.push(format!(
            "{} image(s) are not tied to the block: {}",
            images.len(),
            names.join(", ")
        ));
    }
    if reasons.is_empty() { otherwise } else { SolveError::RankDeficient(reasons.join("; ")) }
}

/// What the observations of a reconstruction leave undetermined, by index.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Undetermined {
    /// In how many directions the block as a whole is free.
    pub datum: usize,
    /// For each direction of lenses the camera and its parameters that carry it.
    pub lenses: Vec<(usize, Vec<usize>)>,
    /// Images that nothing ties to the others.
    pub images: Vec<usize>,
}

/// Finds what the observations leave undetermined where `whole` stands.
///
/// # Errors
/// A reconstruction that cannot be adjusted, points that are undetermined by themselves.
pub fn undetermined(
    whole: &Reconstruction,
    settings: &Settings,
) -> Result<Undetermined, AdjustError> {
    let validated = validate(whole)?;
    let plain = Settings { tie_loss: Loss::Trivial, ..settings.clone() };
    let adjustment = AdjustmentProblem::new(&validated.reconstruction, &plain)?;
    let x = adjustment.problem.start();
    let mut found = Undetermined::default();
    let mut images = BTreeSet::new();
    for direction in null_space(&adjustment.problem, &x, LinearSolver::Schur)? {
        let share = |block: &BlockId| -> f64 {
            let of = direction.iter().find(|(other, _)| other == block);
            of.map_or(0.0, |(_, entries)| entries.iter().map(|v| v * v).sum())
        };
        let lens = adjustment.lenses.iter().map(share).sum::<f64>();
        if is_datum(&adjustment, &direction) {
            if settings.minimal_datum {
                // The first image is held, so that all others move where it is one of those that are not tied.
                let still =
                    (0..adjustment.images.len()).filter(|&k| share(&adjustment.images[k]) < 1e-9);
                images.extend(still.map(|k| validated.images[k]));
            } else {
                found.datum += 1;
            }
        } else if lens >= LENS_ALONE {
            for (camera, block) in adjustment.lenses.iter().enumerate() {
                let entries = direction.iter().find(|(other, _)| other == block);
                let taking = entries.map_or(Vec::new(), |(_, entries)| {
                    (0..entries.len())
                        .filter(|&k| entries[k] * entries[k] > TAKES_PART * lens)
                        .collect()
                });
                let there = whole.cameras[camera].free.len();
                let taking: Vec<usize> = taking.into_iter().filter(|&k| k < there).collect();
                if !taking.is_empty() {
                    found.lenses.push((camera, taking));
                }
            }
        } else {
            let moved =
                (0..adjustment.images.len()).filter(|&k| share(&adjustment.images[k]) > 0.05);
            images.extend(moved.map(|k| validated.images[k]));
        }
    }
    found.images = images.into_iter().collect();
    Ok(found)
}

/// The parameters of lenses that carry a direction; none where it is not one of lenses.
fn lens_names(
    reconstruction: &Reconstruction,
    adjustment: &AdjustmentProblem,
    direction: &Direction,
) -> Vec<String> {
    let mut found: Vec<(f64, String)> = Vec::new();
    let mut total = 0.0;
    for (block, entries) in direction {
        let Some(k) = adjustment.lenses.iter().position(|lens| lens == block) else { continue };
        let camera = &reconstruction.cameras[k];
        for (parameter, entry) in camera.interior.parameters().iter().zip(entries) {
            total += entry * entry;
            let name = match parameter.name {
                "c_px" | "f_px" => "the principal distance".to_owned(),
                name => name.trim_end_matches("_px").to_owned(),
            };
            let name = if reconstruction.cameras.len() > 1 {
                format!("{name} of camera {:?}", camera.name)
            } else {
                name
            };
            found.push((entry * entry, name));
        }
    }
    if total < LENS_ALONE {
        return Vec::new();
    }
    found.retain(|(share, _)| *share > TAKES_PART * total);
    found.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| a.1.cmp(&b.1)));
    // K0 and c in the order in which a person would say it.
    let mut names: Vec<String> = found.into_iter().map(|(_, name)| name).collect();
    names.sort_by_key(|name| name.starts_with("the "));
    names
}

/// Whether a direction moves images and ground points and leaves lenses alone, all images taking
/// part.
fn is_datum(adjustment: &AdjustmentProblem, direction: &Direction) -> bool {
    let mut moving = 0;
    let mut lens = 0.0;
    for (block, entries) in direction {
        let share: f64 = entries.iter().map(|v| v * v).sum();
        if adjustment.lenses.contains(block) {
            lens += share;
        } else if adjustment.images.contains(block) && share > 1e-9 {
            moving += 1;
        }
    }
    lens < 1e-3 && 2 * moving > adjustment.images.len()
}
