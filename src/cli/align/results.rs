//! What came of it: files that other programs read, a summary, a line of JSON.

use super::{
    Finding,
    finish::Final,
    foreign::Foreign,
    project::Project,
    stages::{frame_name, gsd_m},
};
use crate::{
    camera::{Camera, Lens},
    cli::survey,
    error::Error,
    io::{
        FileError, camera, cloud, cloud::CloudPoint, model::Model, orientation, output,
        reconstruction,
    },
    problems::adjustment::{Group, Removed},
    scene::{Excluded, ExcludedKind, Reconstruction, Role},
    sfm::Pair,
};
use serde::Serialize;
use std::{collections::BTreeMap, fmt::Write as _, path::Path};

/// Errors of control or check points.
#[derive(Serialize)]
pub(super) struct Errors {
    count: usize,
    rmse_x_m: Option<f64>,
    rmse_y_m: Option<f64>,
    rmse_z_m: Option<f64>,
}

/// A piece of the block.
#[derive(Serialize)]
struct Fragment {
    images: Vec<String>,
    /// Whether it is in the block.
    joined: bool,
}

/// All of it.
#[derive(Serialize)]
pub(super) struct Report {
    images: usize,
    registered: usize,
    /// Pieces: 1 where all that is registered is one block.
    fragments: usize,
    georeferenced: bool,
    crs: String,
    gsd_m: Option<f64>,
    reprojection_rms_px: f64,
    tie_points: usize,
    observations: usize,
    pairs: usize,
    control_points: Errors,
    check_points: Errors,
    sigma0: f64,
    converged: bool,
    cameras: Vec<BTreeMap<String, f64>>,
    unregistered: Vec<String>,
    fragment_images: Vec<Fragment>,
    findings: Vec<Finding>,
}

const REPORT: &str = "align.json";

/// Refuses results that exist before any work is done.
pub(super) fn check(output: &Path, force: bool) -> Result<(), Error> {
    let path = output.join(REPORT);
    if path.exists() && !force {
        return Err(FileError::Exists { path }.into());
    }
    Ok(())
}

fn errors(rows: &[([f64; 3], &[usize])]) -> Errors {
    let rmse = |axis: usize| {
        let of: Vec<f64> = rows
            .iter()
            .filter(|(_, axes)| axes.contains(&axis))
            .map(|(error, _)| error[axis] * error[axis])
            .collect();
        (!of.is_empty()).then(|| (of.iter().sum::<f64>() / of.len() as f64).sqrt())
    };
    Errors { count: rows.len(), rmse_x_m: rmse(0), rmse_y_m: rmse(1), rmse_z_m: rmse(2) }
}

fn described(camera: &Camera) -> BTreeMap<String, f64> {
    let parameters = camera.interior.parameters().iter();
    parameters.zip(camera.interior.values()).map(|(p, v)| (p.name.to_owned(), *v)).collect()
}

impl Report {
    /// The report, and the adjustment in the form that the adjustment's own report takes.
    pub(super) fn new(
        found: Final,
        project: &Project,
        pairs: &[Pair],
        mut findings: Vec<Finding>,
    ) -> (Report, survey::Outcome) {
        let adjusted = &found.adjusted;
        let block = &adjusted.reconstruction;
        let mut control = Vec::new();
        for (k, point) in block.ground.iter().enumerate() {
            if let (Role::Control, Some(at)) = (point.role, adjusted.ground_m[k]) {
                let error = std::array::from_fn(|axis| at[axis] - point.position_m[axis]);
                control.push((error, point.axes.indices()));
            }
        }
        let checks: Vec<([f64; 3], &[usize])> = adjusted
            .check_points
            .iter()
            .map(|check| (check, &block.ground[check.ground]))
            .filter(|(_, point)| found.checks.contains(&point.name))
            .map(|(check, point)| (check.error_m, point.axes.indices()))
            .collect();
        let ties = adjusted.statistics.groups.iter().find(|group| group.group == Group::TiePoints);
        // Squares of whitened coordinates; two make a distance.
        let reprojection_rms_px = ties.map_or(0.0, |group| {
            (group.squares / (0.5 * group.observations as f64)).sqrt() * block.tie_sigma_px
        });
        let registered: Vec<&str> = block.images.iter().map(|image| image.name.as_str()).collect();
        let mut unregistered: Vec<String> = project
            .photos
            .iter()
            .map(|photo| photo.name.clone())
            .filter(|name| !registered.contains(&name.as_str()))
            .collect();
        for name in &unregistered {
            // Why it could not be is known already.
            if findings.iter().any(|finding| finding.subject == *name) {
                continue;
            }
            let place = project.photos.iter().position(|photo| photo.name == *name);
            let place = place.map_or(u32::MAX, |k| k as u32);
            let own = pairs.iter().filter(|pair| pair.images.contains(&place)).count();
            let apart = found.fragments.iter().find(|(images, _)| images.contains(name));
            let what = match (apart, own) {
                (Some((images, false)), _) => format!(
                    "it is in a piece of {} photos that nothing ties to the block",
                    images.len()
                ),
                (_, 0) => "not oriented: it matches no other photo".to_owned(),
                (_, own) => format!(
                    "not oriented: it matches {own} other photo(s), too little or in contradiction"
                ),
            };
            findings.push(Finding::new(name, &what));
        }
        unregistered.extend(project.left_out.iter().map(|(name, _)| name.clone()));
        unregistered.sort();
        let apart = found.fragments.iter().filter(|(_, joined)| !joined).count();
        let report = Report {
            images: project.photos.len() + project.left_out.len(),
            registered: registered.len(),
            fragments: apart + usize::from(!registered.is_empty()),
            georeferenced: found.georeferenced,
            crs: frame_name(&project.frame, found.georeferenced),
            gsd_m: found.georeferenced.then(|| gsd_m(block)),
            reprojection_rms_px,
            tie_points: block.points.len(),
            observations: block.observations.len(),
            pairs: pairs.len(),
            control_points: errors(&control),
            check_points: errors(&checks),
            sigma0: adjusted.statistics.sigma0,
            converged: adjusted.converged() && found.complete,
            cameras: block.cameras.iter().map(described).collect(),
            unregistered,
            fragment_images: found
                .fragments
                .iter()
                .map(|(images, joined)| Fragment { images: images.clone(), joined: *joined })
                .collect(),
            findings,
        };
        let outcome = survey::Outcome {
            model: Model { survey: found.survey, ..Model::default() },
            adjusted: found.adjusted,
            settings: found.settings,
            alignment: found.alignment,
            removed: found.removed,
            unmatched: Vec::new(),
            left_out: Vec::new(),
            complete: found.complete,
        };
        (report, outcome)
    }
}

/// What is known where a run ends before its last stage.
#[derive(Serialize)]
pub(super) struct SoFar {
    project: String,
    /// The last stage that was run.
    until: String,
    images: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) features: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) pairs: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) matches: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) registered: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) fragments: Option<usize>,
}

impl SoFar {
    pub(super) fn new(project: &Project, until: super::Stage) -> SoFar {
        SoFar {
            project: project.name.clone(),
            until: format!("{until:?}").to_lowercase(),
            images: project.photos.len() + project.left_out.len(),
            features: None,
            pairs: None,
            matches: None,
            registered: None,
            fragments: None,
        }
    }

    /// Says it: in a few words, or as one line of JSON.
    ///
    /// # Errors
    /// Where stdout is closed.
    pub(super) fn present(
        &self,
        findings: Vec<Finding>,
        seconds: &[(&'static str, f64)],
        json: bool,
    ) -> Result<(), Error> {
        #[derive(Serialize)]
        struct Line<'a> {
            #[serde(flatten)]
            so_far: &'a SoFar,
            findings: Vec<Finding>,
            seconds: BTreeMap<&'static str, f64>,
            peak_memory_mb: Option<f64>,
        }
        if json {
            return super::super::print_json(&Line {
                so_far: self,
                findings,
                seconds: seconds.iter().copied().collect(),
                peak_memory_mb: super::super::peak_memory_mb(),
            });
        }
        let mut text = format!("until {}: {} images", self.until, self.images);
        for (count, what) in [
            (self.features, "features"),
            (self.pairs, "pairs"),
            (self.matches, "matches"),
            (self.registered, "images in the largest block"),
            (self.fragments, "blocks"),
        ] {
            if let Some(count) = count {
                let _ = write!(text, ", {count} {what}");
            }
        }
        text.push('\n');
        super::super::print(&text)
    }
}

/// Writes all results.
///
/// # Errors
/// Where one cannot be written.
pub(super) fn write(
    root: &Path,
    (report, outcome): (&Report, &mut survey::Outcome),
    foreign: &Foreign,
    project: &Project,
    force: bool,
) -> Result<(), Error> {
    let adjusted = &outcome.adjusted;
    let block = &adjusted.reconstruction;
    let sigma0 = adjusted.statistics.sigma0;
    for (k, camera) in survey::report::described(adjusted).iter().enumerate() {
        camera::write(&root.join(format!("camera-{}.toml", k + 1)), force, camera)?;
    }
    let accuracies = &adjusted.statistics.images;
    let table = root.join("exterior_orientation.csv");
    orientation::write(&table, block, accuracies, sigma0, force)?;
    let points: Vec<CloudPoint> = block
        .points
        .iter()
        .map(|point| CloudPoint { position_m: point.position_m, colour: point.colour })
        .collect();
    cloud::write_ply(&root.join("cloud.ply"), &points, force)?;
    cloud::write_laz(&root.join("cloud.laz"), &points, force)?;
    let excluded = adjusted.validated.excluded.iter().cloned();
    let removed = outcome.removed.iter().map(Removed::excluded);
    let left_out = project.left_out.iter().map(|(name, reason)| Excluded {
        kind: ExcludedKind::Image,
        image: Some(name.clone()),
        point: None,
        reason: reason.clone(),
    });
    let scene = Reconstruction {
        reference: project.frame.reference(report.georeferenced, project.known.has_control()),
        accuracy: Some(adjusted.accuracy()),
        excluded: excluded.chain(removed).chain(left_out).collect(),
        ..block.clone()
    };
    reconstruction::write(root, &scene, force)?;
    foreign.write(root, force)?;
    let frame = frame_text(project, report);
    output::write(&root.join("crs.txt"), force, |out| out.write_all(frame.as_bytes()))?;
    survey::write_report(&root.join("report"), outcome, force)?;
    output::write(&root.join(REPORT), force, |out| {
        serde_json::to_writer_pretty(&mut *out, report)?;
        writeln!(out)
    })?;
    Ok(())
}

fn frame_text(project: &Project, report: &Report) -> String {
    let mut text = format!("{}\n", report.crs);
    if let (true, super::project::Frame::Map(crs)) = (report.georeferenced, &project.frame) {
        let _ = writeln!(text, "{}", crs.definition());
    }
    let vertical = if project.known.has_control() {
        "heights: those of the control points"
    } else if report.georeferenced {
        "heights: those of the camera positions (in most photos above the ellipsoid or a geoid model of the receiver)"
    } else {
        "heights: none"
    };
    let _ = writeln!(text, "{vertical}");
    text
}

/// The last word: a summary, or one line of JSON.
///
/// # Errors
/// Where stdout is closed, and where the adjustment did not come to its end.
pub(super) fn present(
    report: &Report,
    outcome: &survey::Outcome,
    project: &str,
    seconds: &[(&'static str, f64)],
    json: bool,
) -> Result<(), Error> {
    #[derive(Serialize)]
    struct Line<'a> {
        project: &'a str,
        #[serde(flatten)]
        report: &'a Report,
        seconds: BTreeMap<&'static str, f64>,
        peak_memory_mb: Option<f64>,
    }
    if json {
        super::super::print_json(&Line {
            project,
            report,
            seconds: seconds.iter().copied().collect(),
            peak_memory_mb: super::super::peak_memory_mb(),
        })?;
    } else {
        super::super::print(&summary(report, outcome, seconds))?;
    }
    if !report.converged {
        return Err(Error::Incomplete(
            "the adjustment did not come to its end: look at the report before using its results"
                .into(),
        ));
    }
    Ok(())
}

fn summary(report: &Report, outcome: &survey::Outcome, seconds: &[(&'static str, f64)]) -> String {
    let mut text = format!(
        "{} of {} images oriented in {} {}; frame: {}\n",
        report.registered,
        report.images,
        report.fragments,
        if report.fragments == 1 { "piece" } else { "pieces" },
        report.crs
    );
    let _ = writeln!(
        text,
        "{} tie points, {} observations, reprojection rms {:.3} px{}",
        report.tie_points,
        report.observations,
        report.reprojection_rms_px,
        report.gsd_m.map_or(String::new(), |gsd| format!(", {:.4} m per pixel", gsd))
    );
    for (name, errors) in [("control", &report.control_points), ("check", &report.check_points)] {
        if let (Some(x), Some(y), Some(z)) = (errors.rmse_x_m, errors.rmse_y_m, errors.rmse_z_m) {
            let _ = writeln!(text, "{} {name} points: rmse {x:.4} {y:.4} {z:.4} m", errors.count);
        }
    }
    if !report.unregistered.is_empty() {
        let _ = writeln!(text, "not oriented: {}", report.unregistered.join(", "));
    }
    for finding in &report.findings {
        let _ = writeln!(text, "note: {}: {}", finding.subject, finding.what);
    }
    text.push_str(&survey::summary(outcome));
    let times: Vec<String> =
        seconds.iter().map(|(stage, seconds)| format!("{stage} {seconds:.1} s")).collect();
    let _ = writeln!(text, "{}", times.join(", "));
    text
}
