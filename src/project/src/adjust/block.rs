//! Blocks with names: what is read, in which order things are done, what is written.

use super::{AdjustOptions, Adjustment, DatumChoice, Outputs};
use crate::{
    align::without_heights,
    convert::{self, Format},
};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{camera, control, image_names::Names, model::Model};
use rowgram_optim::{
    nlls::Loss,
    output::{FileError, name_of},
};
use rowgram_raster::crs::Crs;
use rowgram_survey::{
    camera::Model as LensModel,
    problems::{
        adjustment::{
            self, Alignment, DataSnoopingOptions, Group, Removed, Settings, align, leave_one_out,
            snoop, variance_components,
        },
        bundle::InteriorSharing,
    },
    scene::{Excluded, HorizontalFrame, Reconstruction, ReferenceFrame, Role, RollingShutter},
};
use std::path::Path;

/// Rows of files that match nothing are named one by one up to this many.
const MAX_NAMED: usize = 5;
/// Rounds after which the estimation of variance components gives up; blocks of the tests need three to eight.
const MAX_ROUNDS: usize = 20;

/// Adjusts a block and writes what is asked for.
///
/// # Errors
/// Bad input, outputs that exist, a block that is not determined.
pub(super) fn adjust_block(
    path: &Path,
    options: &AdjustOptions,
    outputs: &Outputs,
    monitor: &mut dyn Monitor,
) -> Result<Adjustment, Error> {
    let format = Format::required(path)?;
    let output_format = options.to.unwrap_or(format);
    for path in options.report.iter().chain(&outputs.output) {
        if convert::is_in_the_way(path) && !outputs.force {
            return Err(FileError::Exists { path: path.clone() }.into());
        }
    }
    let (mut model, unmatched) = assemble(path, format, options, monitor)?;
    if let Some(path) = outputs.output.as_deref().filter(|_| output_format != Format::Rowgram) {
        check_lenses(path, &model)?;
    }
    report_unmatched(&unmatched, monitor);
    let adjustment = estimate(&mut model.survey, unmatched, options, monitor)?;
    if output_format == Format::Rowgram {
        model = Model { survey: adjustment.reconstruction(), ..Model::default() };
    }
    if let Some(folder) = &options.report {
        super::write((folder, folder), &adjustment, outputs.force)?;
    }
    if let Some(path) = &outputs.output {
        convert::write(path, output_format, &mut model, outputs.force)?;
    }
    if !adjustment.converged() {
        monitor.diagnostic(&super::not_converged());
    }
    Ok(adjustment)
}

/// Refuses an output that cannot hold what will be found, before any work is done.
fn check_lenses(path: &Path, model: &Model) -> Result<(), Error> {
    let mut cameras = model.survey.cameras.iter();
    match cameras.find(|camera| camera.interior.model() == LensModel::Smac) {
        None => Ok(()),
        Some(camera) => Err(Error::Argument(format!(
            "{}: camera {:?} has a smac lens, which the files of COLMAP, Bundler and OpenSfM cannot hold; \
             write the block with --to rowgram",
            path.display(),
            camera.name
        ))),
    }
}

/// Reads the block and its control.
fn assemble(
    path: &Path,
    format: Format,
    options: &AdjustOptions,
    monitor: &mut dyn Monitor,
) -> Result<(Model, Vec<Excluded>), Error> {
    let mut model = convert::read(path, format, &options.files)?;
    let survey = &mut model.survey;
    let mut unmatched = Vec::new();
    // Our own files tell it, and what is known on the ground and in the air.
    match (options.tie_sigma_px, format) {
        (Some(sigma_px), _) => survey.tie_sigma_px = sigma_px,
        (None, Format::Rowgram) => {}
        (None, _) => survey.tie_sigma_px = 1.0,
    }
    if let Some(path) = &options.camera {
        replace_cameras(survey, path)?;
    }
    if let Some(names) = &options.free {
        for camera in &mut survey.cameras {
            camera.set_free(names).map_err(|e| Error::Argument(format!("free: {e}")))?;
        }
    }
    if let Some(sharing) = options.interior {
        share(survey, sharing)?;
        model.camera_ids.clear();
    }
    let survey = &mut model.survey;
    let defaults = control::Defaults {
        mark_px: options.mark_sigma_px,
        control_m: options.control_sigma_m,
        position_m: options.position_sigma_m,
    };
    if let (Some(path), Some(marks)) = (&options.control, &options.marks) {
        let mut read = control::ground_points(path, &defaults)?;
        check_system(path, read.crs.as_deref(), &survey.reference)?;
        without_heights(&mut read, &name_of(path), monitor);
        survey.ground = read.ground;
        for name in &options.check {
            let point = survey.ground.iter_mut().find(|point| point.name == *name);
            let point = point.ok_or_else(|| {
                Error::Argument(format!("check: {} has no point {name:?}", path.display()))
            })?;
            point.role = Role::Check;
        }
        let names = Names::of(&survey.images);
        let (marks, rest) = control::marks(marks, &names, &survey.ground, &defaults)?;
        survey.marks = marks;
        unmatched.extend(rest);
    }
    if let Some(path) = &options.positions {
        let positions = control::positions(path, &Names::of(&survey.images), &defaults)?;
        check_system(path, positions.system.as_deref(), &survey.reference)?;
        survey.positions = positions.found;
        survey.lever_arm_m = options.lever_arm_m;
        unmatched.extend(positions.aside);
    }
    if let Some(path) = &options.scale_bars {
        survey.scale_bars = control::scale_bars(path, &survey.ground)?;
    }
    Ok((model, unmatched))
}

/// Refuses coordinates whose file names another system than that of the reconstruction: nothing is transformed here.
fn check_system(path: &Path, words: Option<&str>, reference: &ReferenceFrame) -> Result<(), Error> {
    let HorizontalFrame::Projected { name, definition, .. } = &reference.horizontal else {
        return Ok(());
    };
    // A comment may name none.
    match words.and_then(|words| Some((words, Crs::of_words(words).ok()?))) {
        Some((words, crs)) if crs.definition() != definition => {
            let message = format!(
                "its first lines name {words}, the reconstruction is in {name}; transform the coordinates into {name}"
            );
            Err(FileError::malformed(path, None, message).into())
        }
        _ => Ok(()),
    }
}

/// Puts a camera in the place of every camera of the block.
fn replace_cameras(survey: &mut Reconstruction, path: &Path) -> Result<(), Error> {
    let camera = camera::read(path)?;
    for theirs in &mut survey.cameras {
        let sizes = (theirs.interior.size_px(), camera.interior.size_px());
        if sizes.0 != sizes.1 {
            let message = format!(
                "it is for images of {:?} pixels, camera {:?} of the block has {:?}",
                sizes.1, theirs.name, sizes.0
            );
            return Err(FileError::malformed(path, None, message).into());
        }
        *theirs = camera.clone();
    }
    Ok(())
}

/// Gives every image a camera of its own, or all images the first one.
fn share(survey: &mut Reconstruction, sharing: InteriorSharing) -> Result<(), Error> {
    match sharing {
        InteriorSharing::PerImage => {
            let each = survey.images.iter().map(|image| survey.cameras[image.camera].clone());
            survey.cameras = each.collect();
            for (k, image) in survey.images.iter_mut().enumerate() {
                image.camera = k;
                survey.cameras[k].name.clone_from(&image.name);
            }
        }
        InteriorSharing::Shared => {
            let kind = |camera: &rowgram_survey::camera::Camera| {
                (camera.interior.model(), camera.interior.size_px())
            };
            let mut others = survey.cameras.iter().skip(1);
            if let Some(other) =
                others.find(|camera| survey.cameras.first().map(kind) != Some(kind(camera)))
            {
                return Err(Error::Argument(format!(
                    "interior = shared: camera {:?} has another lens model or image size than the first one",
                    other.name
                )));
            }
            survey.cameras.truncate(1);
            survey.images.iter_mut().for_each(|image| image.camera = 0);
        }
    }
    Ok(())
}

fn report_unmatched(unmatched: &[Excluded], monitor: &mut dyn Monitor) {
    for excluded in unmatched.iter().take(MAX_NAMED) {
        let subject = excluded.image.as_ref().or(excluded.point.as_ref());
        let subject = subject.cloned().unwrap_or_else(|| excluded.kind.to_string());
        monitor.diagnostic(&Diagnostic::warning("unmatched-row", subject, excluded.to_string()));
    }
    if unmatched.len() > MAX_NAMED {
        let message = format!(
            "{} more rows match nothing in the block; the report names them",
            unmatched.len() - MAX_NAMED
        );
        monitor.diagnostic(&Diagnostic::warning("unmatched-row", "control files", message));
    }
}

fn report_alignment(alignment: &Alignment, monitor: &mut dyn Monitor) {
    let message = format!(
        "brought into the mapping frame by {} {}, rmse {:.3} m",
        alignment.used.len(),
        alignment.by,
        alignment.rmse_m
    );
    monitor.diagnostic(&Diagnostic::info("aligned", "block", message));
    for (name, left_m) in &alignment.misfits {
        let message = format!("{left_m:.3} m off after the alignment, before any adjustment");
        monitor.diagnostic(&Diagnostic::info("alignment-misfit", name, message));
    }
}

fn report_removed(removed: &[Removed], monitor: &mut dyn Monitor) {
    for removed in removed.iter().filter(|removed| removed.group != Group::TiePoints) {
        let message = format!(
            "not consistent with the block and removed ({:.1} times the critical value)",
            removed.excess
        );
        monitor.diagnostic(&Diagnostic::warning("observation-removed", &removed.name, message));
    }
}

fn estimate(
    survey: &mut Reconstruction,
    unmatched: Vec<Excluded>,
    options: &AdjustOptions,
    monitor: &mut dyn Monitor,
) -> Result<Adjustment, Error> {
    let alignment = if options.align { align(survey) } else { None };
    if let Some(alignment) = &alignment {
        report_alignment(alignment, monitor);
    }
    // A shutter is read in seconds of a block in metres.
    if let Some(readout_s) = options.readout_s {
        survey.rolling_shutter =
            Some(RollingShutter { readout_s, sigma_velocity_m_s: options.velocity_sigma_m_s });
    }
    let plain = Settings::default();
    let mut settings = Settings {
        tie_loss: options.loss.0,
        corrected_domain: options.corrected_domain,
        minimal_datum: options.datum == DatumChoice::Minimal,
        max_iterations: options.max_iterations.unwrap_or(plain.max_iterations),
        ..plain
    };
    let (mut adjusted, removed, complete) = match options.snooping.test() {
        Some(test) => {
            let snooping = DataSnoopingOptions { test, ..DataSnoopingOptions::default() };
            let snooped = snoop(survey, &settings, &snooping)?;
            report_removed(&snooped.removed, monitor);
            (snooped.adjusted, snooped.removed, snooped.complete)
        }
        None => (adjustment::adjust(survey, &settings)?, Vec::new(), true),
    };
    settings.tie_loss = Loss::Trivial;
    if options.variance_components {
        let found = variance_components(survey, &settings, MAX_ROUNDS)?;
        if !found.converged {
            let message = format!("they did not converge in {} rounds", found.rounds);
            let diagnostic = Diagnostic::warning("not-converged", "variance components", message);
            monitor.diagnostic(&diagnostic.with_remedy(
                "leave variance_components away, or look at the residuals of small groups",
            ));
        }
        let excluded = std::mem::take(&mut adjusted.validated.excluded);
        adjusted = found.adjusted;
        adjusted.validated.excluded = excluded;
        settings = found.settings;
    }
    let left_out =
        if options.leave_one_out { leave_one_out(survey, &settings)? } else { Vec::new() };
    Ok(Adjustment {
        adjusted,
        settings,
        alignment,
        removed,
        unmatched,
        left_out,
        complete,
        checks: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_of_another_system_than_the_reconstruction_is_refused() {
        let horizontal = HorizontalFrame::from(&Crs::from_epsg(32616).unwrap());
        let reference = ReferenceFrame { horizontal, ..ReferenceFrame::default() };
        let check = |words: Option<&str>, reference: &ReferenceFrame| {
            check_system(Path::new("gcps.csv"), words, reference).map_err(|e| e.to_string())
        };
        for words in [None, Some("EPSG:32616"), Some("WGS84 UTM 16N"), Some("WGS84, by Ana")] {
            assert_eq!(check(words, &reference), Ok(()), "{words:?}");
        }
        let error = check(Some("EPSG:32617"), &reference).unwrap_err();
        assert!(error.contains("EPSG:32617") && error.contains("in EPSG:32616"), "{error}");
        assert_eq!(check(Some("EPSG:32617"), &ReferenceFrame::default()), Ok(()));
    }
}
