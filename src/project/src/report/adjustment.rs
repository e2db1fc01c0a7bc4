//! The statistics of the block's adjustment: what `report.json` says of them, and their sections of the page.

use super::{
    Facts,
    block::shown,
    page::{Section, digits, table},
};
use crate::{Stage, adjust::Ground};
use maud::{Markup, html};
use rowgram_base::error::Error;
use rowgram_optim::output::FileError;
use rowgram_survey::{problems::adjustment::AxisError, scene::Role};
use serde::Deserialize;
use std::path::Path;

/// Where the stage `align` writes them, in its folder.
pub(super) const FILE: &str = "report/report.json";
/// Two-sided 95 % of the normal distribution.
const HALF_WIDTH: f64 = rowgram_plants::phenotype::stand::NORMAL_95;

/// Statistics of an adjustment. Standard deviations are scaled by `sigma0`.
#[derive(Debug, Deserialize)]
pub(super) struct Adjustment {
    iterations: u64,
    observations: usize,
    parameters: usize,
    redundancy: usize,
    sigma0: f64,
    sigma0_interval: Option<[f64; 2]>,
    groups: Vec<Group>,
    interiors: Vec<Interior>,
    correlated_parameters: Vec<String>,
    /// Control and check points.
    pub(super) ground: Vec<Ground>,
    check_rmse: [Option<AxisError>; 3],
    removed: Vec<Named>,
    suspects: Vec<Named>,
}

/// Observations of a kind.
#[derive(Debug, Deserialize)]
struct Group {
    group: String,
    observations: usize,
    redundancy: f64,
    variance_factor: Option<f64>,
}

/// The interior orientation of a camera.
#[derive(Debug, Deserialize)]
struct Interior {
    camera: usize,
    names: Vec<String>,
    values: Vec<f64>,
    standard_deviations: Vec<f64>,
    correlation: Vec<Vec<f64>>,
}

/// An observation.
#[derive(Debug, Deserialize)]
struct Named {}

impl Adjustment {
    /// # Errors
    /// A file that cannot be read or is none of these.
    pub(super) fn read(path: &Path) -> Result<Adjustment, FileError> {
        let text = std::fs::read(path).map_err(|e| FileError::read(path, e))?;
        serde_json::from_slice(&text)
            .map_err(|e| FileError::malformed(path, e.line(), e.to_string()))
    }
}

/// What the adjustment says of itself.
///
/// # Errors
/// A picture that cannot be read.
pub(super) fn adjustment(facts: &Facts<'_>) -> Result<Section, Error> {
    let Some((_, of)) = &facts.block else { return Ok(None) };
    let groups: Vec<Vec<String>> = of
        .groups
        .iter()
        .map(|group| {
            vec![
                group.group.replace('-', " "),
                group.observations.to_string(),
                format!("{:.1}", group.redundancy),
                digits(group.variance_factor.map(f64::sqrt), 3),
            ]
        })
        .collect();
    let content = html! {
        p {
            (of.observations) " observations, " (of.parameters) " parameters, redundancy " (of.redundancy)
            "; residuals are " (format!("{:.3}", of.sigma0)) " times the assumed accuracy (sigma0)"
            @if let Some([low, high]) = of.sigma0_interval { ", expected " (format!("{low:.3}")) " to " (format!("{high:.3}")) }
            "; " (of.iterations) " iterations; " (of.removed.len()) " observations removed, " (of.suspects.len()) " suspect."
        }
        (table(&["observations", "number", "redundancy", "own sigma0"], &groups))
        @for interior in &of.interiors {
            h3 { "Camera " (interior.camera + 1) }
            div .pair { div { (parameters(interior)) } div { (correlation(interior)) } }
        }
        @if !of.correlated_parameters.is_empty() { ul { @for line in &of.correlated_parameters { li { (line) } } } }
        div .pair {
            (shown(facts, Stage::Align, "figures/residuals-1.svg", "Mean residuals by place in the image: a pattern here is a lens that is not modelled.")?)
            (shown(facts, Stage::Align, "figures/control.svg", "Control and check points: adjusted minus given, in plan.")?)
        }
    };
    Ok(Some(("adjustment", "Adjustment", content)))
}

fn parameters(interior: &Interior) -> Markup {
    let known = interior.values.iter().zip(&interior.standard_deviations);
    let rows: Vec<Vec<String>> = interior
        .names
        .iter()
        .zip(known)
        .map(|(name, (value, sigma))| {
            let value =
                if value.abs() >= 0.01 { format!("{value:.4}") } else { format!("{value:.4e}") };
            vec![name.clone(), value, format!("{sigma:.1e}")]
        })
        .collect();
    table(&["parameter", "value", "standard deviation"], &rows)
}

fn correlation(interior: &Interior) -> Markup {
    let colour = |value: f64| {
        // Mixed with white, so that the dark numbers are read in both themes.
        let rest = 255.0 - 150.0 * value.abs().min(1.0);
        if value > 0.0 {
            format!("background:rgb(255,{rest:.0},{:.0})", rest - 10.0)
        } else {
            format!("background:rgb({:.0},{rest:.0},255)", rest - 10.0)
        }
    };
    html! {
        div .scroll { table .matrix {
            thead { tr { th {} @for name in &interior.names { th { (name) } } } }
            tbody { @for (name, row) in interior.names.iter().zip(&interior.correlation) {
                tr {
                    th { (name) }
                    @for value in row { td style=(colour(*value)) { (format!("{value:.2}")) } }
                }
            } }
        } }
        p .note { "Correlations of the interior orientation; beyond 0.95 the block hardly tells two parameters apart." }
    }
}

/// Control and check points one by one.
pub(super) fn ground(facts: &Facts<'_>) -> Section {
    let (_, of) = facts.block.as_ref().filter(|(_, of)| !of.ground.is_empty())?;
    let mut sorted: Vec<&Ground> = of.ground.iter().collect();
    sorted.sort_by_key(|point| (point.role != Role::Check, point.name.clone()));
    let row = |point: &Ground| {
        let role = match point.role {
            Role::Check => "check",
            Role::Control => "control",
            Role::Tie => "tie",
        };
        let axis = |k: usize| {
            let (difference, sigma) = (100.0 * point.difference_m[k], 100.0 * point.sigma_m[k]);
            format!("{difference:+.1} ± {:.1}", HALF_WIDTH * sigma)
        };
        let mut row = vec![point.name.clone(), role.to_owned()];
        row.extend([0, 1, 2].map(axis));
        row.extend([point.images.to_string(), digits(point.image_rms_px, 2)]);
        row
    };
    let rows: Vec<Vec<String>> = sorted.into_iter().map(row).collect();
    let rmse: Vec<Vec<String>> = ["X", "Y", "Z"]
        .iter()
        .zip(&of.check_rmse)
        .filter_map(|(axis, error)| {
            let error = error.as_ref()?;
            let cm = |metres: f64| format!("{:.2}", 100.0 * metres);
            let [low, high] = error.interval_m.map(cm);
            Some(vec![
                (*axis).to_owned(),
                cm(error.rmse_m),
                format!("{low} to {high}"),
                cm(error.mean_m),
                error.count.to_string(),
            ])
        })
        .collect();
    let content = html! {
        @if rmse.is_empty() {
            p { "There are no check points: nothing independent tells how large the errors are." }
        } @else {
            p { "Check points take no part in the adjustment; their errors are those of the map." }
            (table(&["axis", "rmse, cm", "95 %", "mean, cm", "points"], &rmse))
        }
        h3 { "One by one: adjusted minus given, with the half width of its 95 % interval" }
        (table(&["point", "role", "X, cm", "Y, cm", "Z, cm", "images", "in images, rms px"], &rows))
    };
    Some(("ground", "Ground points", content))
}
