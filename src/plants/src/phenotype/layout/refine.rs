//! A plan onto the rows that were found: heading, coarse search, then least squares with standard deviations.

use super::{
    Plan,
    observed::{Cutting, FoundPlant, FoundRows, Lookup, observe},
    search::{self, Candidate, Reach},
};
use crate::problems::plot_layout::{
    Placement,
    fit::{self, Observations, Priors, RowFit, Scatter},
};
use rowgram_base::error::Error;
use serde::{Deserialize, Serialize};

/// Standard deviations of what is known beforehand, and how rows are cut.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Assumptions {
    /// Of the shift of the whole plan, metres.
    pub position_m: f64,
    /// Of its rotation, radians.
    pub rotation_rad: f64,
    /// Of its stretches along and across.
    pub stretch: f64,
    /// Of its shear, radians.
    pub shear_rad: f64,
    /// Of each number of the bend, metres.
    pub bend_m: f64,
    /// Of a plot by itself, metres; plots move together where not given.
    pub plot_shift_m: Option<f64>,
    /// Length of a piece of a row, metres.
    pub segment_m: f64,
}

/// Another place where the plan may lie.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Alternative {
    /// From the chosen place along the rows, metres.
    pub along_m: f64,
    /// From the chosen place across the rows, to the left, metres.
    pub across_m: f64,
    /// Its probability over that of the chosen place.
    pub odds: f64,
}

/// What was found of a plot.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PlotEvidence {
    /// Plants on its rows.
    pub plants: usize,
    /// Pieces of its rows.
    pub pieces: usize,
    /// Mean distance of its rows from their places across, to the left, metres.
    pub across_m: f64,
    /// Shift by itself along and across, metres.
    pub shift_m: [f64; 2],
}

/// A plan on the rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Refinement {
    /// The fit.
    pub fit: RowFit,
    /// Pieces and ends that took part.
    pub observations: Observations,
    /// Other places, the most probable first, as far as their odds are above 1 to 1000.
    pub alternatives: Vec<Alternative>,
    /// Rows that were found.
    pub found_rows: usize,
    /// Rows that were found along rows of the plan.
    pub used_rows: usize,
    /// Distance between the rows that were found, metres, where there are several.
    pub row_spacing_m: Option<f64>,
    /// What was found of each plot, in the order of the plan.
    pub plots: Vec<PlotEvidence>,
}

/// Rows further from the heading of the plan than this are no rows of it, radians, whatever is assumed.
const MIN_TURN_RAD: f64 = 0.05;
/// Rows whose spacing differs more from that of the plan are no rows of it.
const SPACING_RATIO: f64 = 1.25;
/// Rounds in which plants find their rows again.
const ROUNDS: usize = 4;
/// A fit needs so many pieces of rows.
const MIN_PIECES: usize = 6;
/// Where the scatter begins, metres.
const FIRST: Scatter = Scatter { sample_m: 0.02, row_m: 0.02, end_m: 0.08, line_m: 0.02 };
/// Alternatives are kept from these odds on.
const MIN_ODDS: f64 = 1e-3;

/// Moves a plan from `about` onto the plants that were found. `is_visible` says whether a map position is on the picture in
/// which plants were looked for.
///
/// # Errors
/// Rows that run elsewhere or are spaced otherwise than those of the plan, too few of them on it, and as [`fit::fit`].
pub fn refine(
    plan: &Plan,
    about: &Placement,
    plants: &[FoundPlant],
    assumed: &Assumptions,
    is_visible: &dyn Fn([f64; 2]) -> bool,
) -> Result<Refinement, Error> {
    let nominal = Placement::nominal(about.origin_m, about.heading_rad, about.half_length_m);
    let found = FoundRows::new(plants, &nominal);
    let turn = found.turn_rad();
    let most = MIN_TURN_RAD.max(4.0 * assumed.rotation_rad);
    if found.rows.is_empty() {
        return refuse("there are no rows of plants to compare the layout with".into());
    }
    if (turn - about.affine[2]).abs() > most {
        return refuse(format!(
            "the rows that were found run {:.1} degrees from those of the layout, expected at most {:.1} (4 rotation_sigma_deg): \
             are the corners named rightly?",
            (turn - about.affine[2]).abs().to_degrees(),
            most.to_degrees()
        ));
    }
    let row_spacing_m = found.row_spacing_m();
    let ratio = row_spacing_m.map_or(1.0, |found| found / plan.row_spacing_m);
    if !(1.0 / SPACING_RATIO..=SPACING_RATIO).contains(&ratio) {
        return refuse(format!(
            "the rows that were found are {:.3} m apart, those of the layout {:.3} m: check row_spacing_m and rows_per_plot",
            row_spacing_m.unwrap_or(f64::NAN),
            plan.row_spacing_m
        ));
    }
    let lookup = Lookup::new(plan);
    let reach = Reach { position_m: assumed.position_m, stretch: assumed.stretch };
    let candidates = search::search(&found, plan, &lookup, about, turn, &reach, is_visible);
    let unmoved = |stretch: f64| Candidate { shift_m: 0.0, stretch, cost: 0.0 };
    let along = candidates.along.first().copied().unwrap_or(unmoved(about.affine[3]));
    let across = candidates.across.first().copied().unwrap_or(unmoved(about.affine[4]));
    let mut placement = *about;
    placement.affine = search::affine_of(about, turn, &along, &across);
    let alternatives = alternatives(plan, &candidates, along, across);

    let margin_m = 0.5 * found.plant_spacing_m;
    let priors = Priors {
        affine: [
            assumed.position_m,
            assumed.position_m,
            assumed.rotation_rad,
            assumed.stretch,
            assumed.stretch,
            assumed.shear_rad,
        ],
        bend_m: assumed.bend_m,
        // A plant stands anywhere within the first spacing.
        margin_m: [margin_m, margin_m.max(0.05)],
        plot_shift_m: assumed.plot_shift_m,
    };
    let cutting = Cutting { segment_m: assumed.segment_m, gate_m: 0.4 * plan.row_spacing_m };
    let mut last: Option<(Observations, RowFit)> = None;
    let mut scatter = FIRST;
    for _ in 0..ROUNDS {
        let (seen, _) = observe(&found, plan, &lookup, &placement, &cutting, is_visible);
        if seen.rows.len() < MIN_PIECES {
            return refuse(format!(
                "only {} pieces of rows with plants lie on the layout, expected {MIN_PIECES} or more",
                seen.rows.len()
            ));
        }
        if last.as_ref().is_some_and(|(before, _)| *before == seen) {
            break;
        }
        let fitted = fit::fit(about, &placement, &seen, &priors, &scatter)?;
        (placement, scatter) = (fitted.placement, fitted.scatter);
        last = Some((seen, fitted));
    }
    let Some((observations, fit)) = last else {
        return refuse("the layout could not be compared with any row".into());
    };
    let (_, of_plots) = observe(&found, plan, &lookup, &placement, &cutting, is_visible);
    let mut used: Vec<usize> = observations.rows.iter().map(|sample| sample.found_row).collect();
    used.sort_unstable();
    used.dedup();
    let plots = evidence(&observations, &fit, &of_plots);
    Ok(Refinement {
        alternatives,
        found_rows: found.rows.len(),
        used_rows: used.len(),
        row_spacing_m,
        plots,
        observations,
        fit,
    })
}

fn refuse<T>(message: String) -> Result<T, Error> {
    Err(Error::Argument(message))
}

/// Other minima with their odds, each with its step to the chosen one.
fn alternatives(
    plan: &Plan,
    candidates: &search::Candidates,
    along: Candidate,
    across: Candidate,
) -> Vec<Alternative> {
    let odds = |other: &Candidate, best: &Candidate| (best.cost - other.cost).exp();
    // Minima next to the best one along are ripples of single plants.
    let apart_m = 2.0 * plan.row_spacing_m;
    let of_along = candidates.along.iter().skip(1).map(|other| Alternative {
        along_m: other.shift_m - along.shift_m,
        across_m: 0.0,
        odds: odds(other, &along),
    });
    let of_across = candidates.across.iter().skip(1).map(|other| Alternative {
        along_m: 0.0,
        across_m: other.shift_m - across.shift_m,
        odds: odds(other, &across),
    });
    let mut all: Vec<Alternative> = of_along
        .filter(|of| of.along_m.abs() > apart_m)
        .chain(of_across.filter(|of| of.across_m.abs() > 0.6 * plan.row_spacing_m))
        .filter(|of| of.odds > MIN_ODDS)
        .collect();
    all.sort_by(|a, b| b.odds.total_cmp(&a.odds));
    all
}

fn evidence(seen: &Observations, fit: &RowFit, of_plots: &[usize]) -> Vec<PlotEvidence> {
    let mut plots: Vec<PlotEvidence> = of_plots
        .iter()
        .enumerate()
        .map(|(plot, &plants)| {
            let shift_m = fit.plot_shifts_m.get(plot).copied().unwrap_or_default();
            PlotEvidence { plants, pieces: 0, across_m: 0.0, shift_m }
        })
        .collect();
    for (sample, residual) in seen.rows.iter().zip(&fit.row_residuals_m) {
        let plot = &mut plots[sample.plot];
        plot.pieces += 1;
        plot.across_m += residual;
    }
    for plot in plots.iter_mut().filter(|plot| plot.pieces > 0) {
        plot.across_m /= plot.pieces as f64;
    }
    plots
}

impl Refinement {
    /// Standard deviations of a place of the plan, along and across the rows, metres.
    pub fn sigma_m(&self, at: [f64; 2]) -> [f64; 2] {
        self.fit.placement.sigma_m(&self.fit.covariance, at)
    }
}
