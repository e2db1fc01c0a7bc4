//! What came of an adjustment: a summary for a person, a report for a machine, a folder with both,
//! tables, figures and cameras.

use super::{Adjustment, figures, tables};
use rowgram_base::error::Error;
use rowgram_files::camera;
use rowgram_optim::{
    nlls::BatchSummary,
    output::{self, FileError},
};
use rowgram_survey::{
    problems::adjustment::{
        Alignment, AxisError, GroupStatistics, InteriorAccuracy, LeaveOneOut, OutlierTest, Removed,
        rmse,
    },
    scene::Reconstruction,
};
use serde::{Deserialize, Serialize};
use std::{fmt::Write, path::Path};

/// Confidence of intervals and of the global test.
const CONFIDENCE: f64 = 0.95;
/// Probability of a false alarm of each single test that is reported.
const SIGNIFICANCE: f64 = 0.001;
/// Variance factors below this, or above its inverse, are pointed out.
const MIN_FACTOR: f64 = 0.25;
/// Interior parameters whose neutral value is not 0.
const NEVER_ZERO: [&str; 5] = ["c_px", "f_px", "aspect", "cx_px", "cy_px"];
/// Interior parameters that are correlated by more than this are reported.
const HIGH_CORRELATION: f64 = 0.95;

/// A kind of observations with its variance component.
#[derive(Debug, Serialize)]
struct Group {
    #[serde(flatten)]
    statistics: GroupStatistics,
    variance_factor: Option<f64>,
    /// The factor on its standard deviations that was used.
    sigma_factor: f64,
}

/// A control or check point.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Ground {
    pub(crate) name: String,
    pub(crate) role: rowgram_survey::scene::Role,
    axes: rowgram_survey::scene::Axes,
    given_m: [f64; 3],
    pub(crate) adjusted_m: [f64; 3],
    /// From the given coordinates to the adjusted ones.
    pub(crate) difference_m: [f64; 3],
    pub(crate) sigma_m: [f64; 3],
    /// How many images it was measured in.
    pub(crate) images: usize,
    /// Root mean square distance of where it was measured and where the adjusted point is seen, pixels.
    pub(crate) image_rms_px: Option<f64>,
}

/// An observation that the test rejects.
#[derive(Debug, Serialize)]
struct Suspect {
    name: String,
    excess: f64,
}

/// All of it. Standard deviations are scaled by `sigma0`.
#[derive(Debug, Serialize)]
pub struct Report {
    images: usize,
    tie_points: usize,
    iterations: u64,
    initial_cost: f64,
    final_cost: f64,
    stop: rowgram_optim::engine::Termination,
    observations: usize,
    parameters: usize,
    redundancy: usize,
    sigma0: f64,
    /// By how much variances are larger because neighbouring tie points have the same errors; standard deviations have it
    /// in them.
    design_effect: f64,
    /// Where `sigma0` lies with 95 % if the standard deviations given are right.
    sigma0_interval: Option<[f64; 2]>,
    groups: Vec<Group>,
    /// The batches of residuals, and how the solver evaluated each.
    batches: Vec<BatchSummary>,
    interiors: Vec<InteriorAccuracy>,
    correlated_parameters: Vec<String>,
    ground: Vec<Ground>,
    /// Root mean square errors of the check points along X, Y, Z with their 95 % intervals.
    check_rmse: [Option<AxisError>; 3],
    alignment: Option<Alignment>,
    removed: Vec<Removed>,
    suspects: Vec<Suspect>,
    left_out: Vec<LeaveOneOut>,
    excluded: Vec<rowgram_survey::scene::Excluded>,
    mean_velocity_m_s: Option<f64>,
}

impl Report {
    /// The report of an adjustment.
    pub fn new(adjustment: &Adjustment) -> Report {
        let (adjusted, statistics) = (&adjustment.adjusted, &adjustment.adjusted.statistics);
        let survey = &adjusted.reconstruction;
        let sigma0 = statistics.sigma0;
        let mut interiors = statistics.interiors.clone();
        for interior in &mut interiors {
            let all = interior.standard_deviations.iter_mut().chain(&mut interior.independent);
            all.for_each(|sigma| *sigma *= sigma0);
        }
        let ground = ground(adjustment);
        // Control that was rejected is compared too, and tells nothing of the accuracy of the block.
        let is_check =
            |name: &String| adjustment.checks.as_ref().is_none_or(|checks| checks.contains(name));
        let check_rmse = std::array::from_fn(|axis| {
            let errors: Vec<f64> = ground
                .iter()
                .filter(|point| point.role == rowgram_survey::scene::Role::Check)
                .filter(|point| is_check(&point.name))
                .filter(|point| point.axes.indices().contains(&axis))
                .map(|point| point.difference_m[axis])
                .collect();
            rmse(&errors, CONFIDENCE)
        });
        let findings = statistics.rejected(OutlierTest::Pope, |_| SIGNIFICANCE);
        let speeds: Vec<f64> = (0..survey.images.len())
            .filter_map(|k| survey.velocity_m_s(k))
            .map(|v| (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt())
            .collect();
        Report {
            images: survey.images.len(),
            tie_points: survey.points.len(),
            iterations: adjusted.summary.iterations,
            initial_cost: adjusted.summary.initial_cost,
            final_cost: adjusted.summary.final_cost,
            stop: adjusted.summary.stop,
            observations: statistics.observations,
            parameters: statistics.parameters,
            redundancy: statistics.redundancy,
            sigma0,
            design_effect: statistics.design_effect,
            sigma0_interval: statistics.variance_interval(CONFIDENCE).map(|i| i.map(f64::sqrt)),
            groups: statistics
                .groups
                .iter()
                .map(|group| Group {
                    statistics: *group,
                    variance_factor: group.variance_factor(),
                    sigma_factor: adjustment.settings.sigma_factors[group.group as usize],
                })
                .collect(),
            batches: adjusted.summary.batches.clone(),
            correlated_parameters: interiors.iter().flat_map(correlated_parameters).collect(),
            interiors,
            ground,
            check_rmse,
            alignment: adjustment.alignment.clone(),
            removed: adjustment.removed.clone(),
            suspects: findings
                .iter()
                .take(200)
                .map(|&(place, excess)| Suspect {
                    name: adjusted.name(statistics.tested[place].subject),
                    excess,
                })
                .collect(),
            left_out: adjustment.left_out.clone(),
            excluded: adjustment
                .unmatched
                .iter()
                .chain(&adjusted.validated.excluded)
                .cloned()
                .collect(),
            mean_velocity_m_s: (!speeds.is_empty())
                .then(|| speeds.iter().sum::<f64>() / speeds.len() as f64),
        }
    }
}

/// Control and check points with what the adjustment makes of them.
fn ground(adjustment: &Adjustment) -> Vec<Ground> {
    let adjusted = &adjustment.adjusted;
    let (survey, sigma0) = (&adjusted.reconstruction, adjusted.statistics.sigma0);
    let mut rows = Vec::new();
    for (k, point) in survey.ground.iter().enumerate() {
        let check = adjusted.check_points.iter().find(|check| check.ground == k);
        let taking_part = adjusted.ground_m[k].zip(adjusted.statistics.ground[k]);
        let (at, covariance) = match (check, taking_part) {
            (Some(check), _) => (check.position_m, check.covariance_m2),
            (None, Some((at, accuracy))) => (at, accuracy.covariance_m2),
            (None, None) => continue,
        };
        rows.push(Ground {
            name: point.name.clone(),
            role: point.role,
            axes: point.axes,
            given_m: point.position_m,
            adjusted_m: at,
            difference_m: std::array::from_fn(|axis| at[axis] - point.position_m[axis]),
            sigma_m: std::array::from_fn(|axis| sigma0 * covariance[axis][axis].max(0.0).sqrt()),
            images: survey.marks.iter().filter(|mark| mark.ground as usize == k).count(),
            image_rms_px: survey.ground_point_rms_px(k, at),
        });
    }
    rows
}

fn correlated_parameters(interior: &InteriorAccuracy) -> Vec<String> {
    let mut found = Vec::new();
    for (i, row) in interior.correlation.iter().enumerate() {
        for (j, correlation) in row.iter().enumerate().take(i) {
            if correlation.abs() > HIGH_CORRELATION {
                found.push(format!(
                    "{} and {} are highly correlated ({correlation:.4})",
                    interior.names[j], interior.names[i]
                ));
            }
        }
    }
    found
}

/// What a person reads.
pub fn summary(report: &Report) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = fill(&mut text, report);
    text
}

fn fill(out: &mut String, report: &Report) -> std::fmt::Result {
    writeln!(out, "{} images, {} tie points", report.images, report.tie_points)?;
    writeln!(
        out,
        "cost {:.6e} -> {:.6e} in {} iterations; stopped because {}",
        report.initial_cost,
        report.final_cost,
        report.iterations,
        report.stop.explain()
    )?;
    write!(
        out,
        "{} observations, {} parameters, redundancy {}; sigma0 {:.4}",
        report.observations, report.parameters, report.redundancy, report.sigma0
    )?;
    if let Some([low, high]) = report.sigma0_interval {
        let fits = if (low..=high).contains(&report.sigma0) { "fit" } else { "do not fit" };
        write!(out, " (the standard deviations given {fits}: {low:.4} to {high:.4} expected)")?;
    }
    writeln!(out)?;
    for group in &report.groups {
        let factor = group.variance_factor.map_or("-".into(), |v| format!("{:.3}", v.sqrt()));
        writeln!(
            out,
            "  {:22} {:>8} numbers  redundancy {:>10.1}  own sigma0 {factor}",
            group.statistics.group.name(),
            group.statistics.observations,
            group.statistics.redundancy
        )?;
    }
    for batch in &report.batches {
        let path = batch.path.as_ref().map_or("-".into(), ToString::to_string);
        writeln!(out, "  {:22} {:>8} factors  {path}", batch.name, batch.factors)?;
    }
    if report.design_effect > 1.0 {
        writeln!(
            out,
            "  standard deviations of photos and points: tie points count as {:.0} independent ones, as their errors within patches of ground say",
            report.tie_points as f64 / report.design_effect
        )?;
    }
    let off = |group: &Group| {
        group.variance_factor.is_some_and(|v| !(MIN_FACTOR..=1.0 / MIN_FACTOR).contains(&v))
    };
    if report.groups.iter().any(off) {
        writeln!(
            out,
            "  hint: a sigma0 of a kind far from 1 says that its standard deviations are not the given ones, or that the lens model lacks something; --variance-components estimates them"
        )?;
    }
    for interior in &report.interiors {
        writeln!(out, "camera {}", interior.camera + 1)?;
        for k in 0..interior.names.len() {
            let (value, sigma) = (interior.values[k], interior.standard_deviations[k]);
            write!(out, "  {:8} {value:>16.9e} +- {sigma:.2e}", interior.names[k])?;
            // Whether it is needed at all: only where 0 would mean that it is not.
            if !NEVER_ZERO.contains(&interior.names[k]) {
                write!(out, "  ({:.1} sigma from 0)", (value / sigma).abs())?;
            }
            writeln!(out)?;
        }
        let widened = interior.standard_deviations.iter().zip(&interior.independent);
        let most = widened.map(|(sigma, independent)| sigma / independent).fold(1.0, f64::max);
        if most > 1.05 {
            writeln!(
                out,
                "  (up to {most:.2} times as large as for independent measurements: errors of neighbouring ones are correlated, or vary in size)"
            )?;
        }
    }
    report.correlated_parameters.iter().try_for_each(|line| writeln!(out, "  {line}"))?;
    for (axis, error) in ["X", "Y", "Z"].iter().zip(&report.check_rmse) {
        if let Some(error) = error {
            writeln!(
                out,
                "check points {axis}: rmse {:.4} m (95 %: {:.4} to {:.4}), mean {:+.4} m, {} points",
                error.rmse_m, error.interval_m[0], error.interval_m[1], error.mean_m, error.count
            )?;
        }
    }
    for removed in report
        .removed
        .iter()
        .filter(|removed| removed.group != rowgram_survey::problems::adjustment::Group::TiePoints)
    {
        writeln!(
            out,
            "removed: {} ({:.1} times the critical value, residual {:.3} {:.3} {:.3})",
            removed.name,
            removed.excess,
            removed.residual[0],
            removed.residual[1],
            removed.residual[2]
        )?;
    }
    let ties = report
        .removed
        .iter()
        .filter(|removed| removed.group == rowgram_survey::problems::adjustment::Group::TiePoints)
        .count();
    if ties > 0 {
        writeln!(out, "removed: {ties} measurements of tie points")?;
    }
    for left_out in &report.left_out {
        match left_out.error_m {
            Some([x, y, z]) => {
                writeln!(out, "without {}: {x:+.4} {y:+.4} {z:+.4} m", left_out.name)?;
            }
            None => writeln!(out, "without {}: not determined", left_out.name)?,
        }
    }
    if let Some(speed) = report.mean_velocity_m_s {
        writeln!(out, "mean speed within the frames {speed:.2} m/s")?;
    }
    if !report.excluded.is_empty() {
        writeln!(out, "excluded: {} (the report names them)", report.excluded.len())?;
    }
    Ok(())
}

/// Writes the report: tables into `folder`, pictures into `pictures`.
///
/// # Errors
/// Where a folder cannot be made or one of its files cannot be written.
pub fn write(
    (folder, pictures): (&Path, &Path),
    adjustment: &Adjustment,
    force: bool,
) -> Result<(), Error> {
    for folder in [folder, pictures] {
        std::fs::create_dir_all(folder).map_err(|e| FileError::write(folder, e))?;
    }
    let report = Report::new(adjustment);
    output::write_json(&folder.join("report.json"), force, &report)?;
    let text = summary(&report);
    output::write(&folder.join("summary.txt"), force, |out| out.write_all(text.as_bytes()))?;
    tables::write(folder, adjustment, force)?;
    figures::write(pictures, adjustment, force)?;
    let adjusted = &adjustment.adjusted;
    let scene =
        Reconstruction { accuracy: Some(adjusted.accuracy()), ..adjusted.reconstruction.clone() };
    let cameras = scene.calibrated_cameras();
    for interior in &adjusted.statistics.interiors {
        let name = format!("camera-{}.toml", interior.camera + 1);
        camera::write(&folder.join(name), force, &cameras[interior.camera])?;
    }
    Ok(())
}
