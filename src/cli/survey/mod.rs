//! `rowgram adjust` of a block with control: what is read, in which order things are done, what is
//! written.

pub(super) mod convert;
mod description;

use crate::{
    error::Error,
    io::{FileError, bundler, camera, colmap, control, model::Model, opensfm, reconstruction},
    pipeline::adjust::{self, Adjustment},
    problems::adjustment::{
        DataSnoopingOptions, Settings, align, leave_one_out, snoop, variance_components,
    },
    scene::{Excluded, Role},
};
pub(super) use description::Options;
use description::{Datum, Description, Format};
use std::path::Path;

/// Whether a path is a block for this file: a COLMAP folder, a description, or a reconstruction of
/// Bundler or OpenSfM.
pub(super) fn is_one(path: &Path) -> bool {
    path.is_dir() || description::is_description(path) || format_of(path).is_some()
}

fn format_of(path: &Path) -> Option<Format> {
    if reconstruction::is_one(path) {
        return Some(Format::Rowgram);
    }
    if path.is_dir() {
        return Some(match colmap::find(path) {
            Some(colmap::Form::Text) => Format::ColmapText,
            _ => Format::ColmapBinary,
        });
    }
    if path.extension().is_some_and(|extension| extension == "json") {
        return Some(Format::Opensfm);
    }
    let mut start = [0; 13];
    let read =
        std::fs::File::open(path).and_then(|mut f| std::io::Read::read_exact(&mut f, &mut start));
    (read.is_ok() && bundler::is_one(&start)).then_some(Format::Bundler)
}

/// Runs the command for such a block.
///
/// # Errors
/// Bad input, outputs that exist, a block that is not determined, and an end before the optimum.
pub(super) fn run(
    file: &Path,
    options: &Options,
    (loss, per_image): (crate::nlls::Loss, bool),
    output: Option<&Path>,
    (json, force): (bool, bool),
) -> Result<(), Error> {
    let description = Description::of(file, options, per_image)?;
    let format = format_of(&description.model).ok_or_else(|| {
        FileError::malformed(
            &description.model,
            None,
            "not a COLMAP folder, a bundle.out or a reconstruction.json of rowgram or OpenSfM",
        )
    })?;
    check_outputs(&description, output, force)?;
    let block = assemble(&description, format)?;
    let output_format = description.to.unwrap_or(format);
    if let Some(path) = output.filter(|_| output_format != Format::Rowgram) {
        check_lenses(path, &block.0)?;
    }
    let (mut model, adjustment) = work(block, &description, loss)?;
    if output_format == Format::Rowgram {
        model = Model { survey: adjustment.reconstruction(), ..Model::default() };
    }
    adjustment.unmatched.iter().take(5).for_each(|aside| tracing::warn!("set aside: {aside}"));
    if let Some(folder) = &description.report {
        adjust::write(folder, &adjustment, force)?;
    }
    if let Some(path) = output {
        write_model(path, output_format, &mut model, force)?;
    }
    if json {
        super::print_json(&adjust::Report::new(&adjustment))?;
    } else {
        super::print(&adjust::summary(&adjustment))?;
    }
    if !adjustment.converged() {
        return Err(Error::Incomplete(
            "the adjustment did not converge: look at the report before using its results".into(),
        ));
    }
    Ok(())
}

/// Refuses outputs before any work is done.
fn check_outputs(
    description: &Description,
    output: Option<&Path>,
    force: bool,
) -> Result<(), Error> {
    if let Some(folder) = &description.report
        && folder.exists()
        && !force
    {
        return Err(FileError::Exists { path: folder.clone() }.into());
    }
    if let Some(path) = output
        && path.exists()
        && !force
    {
        return Err(FileError::Exists { path: path.to_owned() }.into());
    }
    Ok(())
}

/// Refuses an output that cannot hold what will be found, before any work is done.
fn check_lenses(path: &Path, model: &Model) -> Result<(), Error> {
    let mut cameras = model.survey.cameras.iter();
    match cameras.find(|camera| camera.interior.model() == crate::camera::Model::Smac) {
        None => Ok(()),
        Some(camera) => Err(Error::Argument(format!(
            "{}: camera {:?} is a smac one, which COLMAP's, Bundler's and OpenSfM's files cannot hold; \
             leave --output away and take the results from the folder of --report",
            path.display(),
            camera.name
        ))),
    }
}

fn read_model(
    path: &Path,
    format: Format,
    list: Option<&Path>,
    tracks: Option<&Path>,
    size_px: Option<[u32; 2]>,
) -> Result<Model, Error> {
    Ok(match format {
        Format::ColmapText | Format::ColmapBinary => colmap::read(path)?,
        Format::Bundler => {
            let beside = path.with_file_name("list.txt");
            let list = list.or_else(|| beside.is_file().then_some(beside.as_path()));
            let size_px = size_px.ok_or_else(|| {
                Error::Argument(format!(
                    "{}: Bundler's files have no image sizes; give --image-size WIDTHxHEIGHT",
                    path.display()
                ))
            })?;
            bundler::read(path, list, size_px)?
        }
        Format::Opensfm => {
            let beside = path.with_file_name("tracks.csv");
            opensfm::read(path, tracks.unwrap_or(&beside))?
        }
        Format::Rowgram => Model { survey: reconstruction::read(path)?, ..Model::default() },
    })
}

fn write_model(path: &Path, format: Format, model: &mut Model, force: bool) -> Result<(), Error> {
    match format {
        Format::ColmapText | Format::ColmapBinary => {
            std::fs::create_dir_all(path).map_err(|e| FileError::write(path, e))?;
            let form = if format == Format::ColmapText {
                colmap::Form::Text
            } else {
                colmap::Form::Binary
            };
            colmap::write(path, model, form, force)?;
        }
        Format::Bundler => {
            let list = path.with_file_name("list.txt");
            bundler::write(path, Some(&list), model, force)?;
        }
        Format::Opensfm => {
            opensfm::write(path, &path.with_file_name("tracks.csv"), model, force)?;
        }
        Format::Rowgram => {
            // A path that is no JSON file is a folder for the three of them.
            if path.extension().is_none_or(|extension| extension != "json") {
                std::fs::create_dir_all(path).map_err(|e| FileError::write(path, e))?;
            }
            reconstruction::write(path, &model.survey, force)?;
        }
    }
    Ok(())
}

/// Reads the block and its control.
fn assemble(description: &Description, format: Format) -> Result<(Model, Vec<Excluded>), Error> {
    let mut model = read_model(
        &description.model,
        format,
        description.list.as_deref(),
        description.tracks.as_deref(),
        description.image_size,
    )?;
    let survey = &mut model.survey;
    let mut unmatched = Vec::new();
    // Our own files tell it, and what is known on the ground and in the air.
    if format != Format::Rowgram || description.has_tie_sigma {
        survey.tie_sigma_px = description.tie_sigma_px;
    }
    if let Some(path) = &description.camera {
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
    }
    if let Some(names) = &description.free {
        for camera in &mut survey.cameras {
            camera.set_free(names).map_err(|e| Error::Argument(format!("--free: {e}")))?;
        }
    }
    if description.per_image {
        let each = survey.images.iter().map(|image| survey.cameras[image.camera].clone());
        survey.cameras = each.collect();
        for (k, image) in survey.images.iter_mut().enumerate() {
            image.camera = k;
            survey.cameras[k].name.clone_from(&image.name);
        }
        model.camera_ids.clear();
    }
    let defaults = description.defaults;
    if let Some(path) = &description.control {
        survey.ground = control::ground_points(path, &defaults)?;
        for name in &description.check {
            let point = survey.ground.iter_mut().find(|point| point.name == *name);
            let point = point.ok_or_else(|| {
                Error::Argument(format!("--check {name}: {} has no such point", path.display()))
            })?;
            point.role = Role::Check;
        }
        let marks = description.marks.as_ref().ok_or_else(|| {
            Error::Argument("--control needs --marks: where the points are in the images".into())
        })?;
        let (marks, aside) = control::marks(marks, &survey.images, &survey.ground, &defaults)?;
        survey.marks = marks;
        unmatched.extend(aside);
    } else if description.marks.is_some() {
        return Err(Error::Argument("--marks needs --control: what is marked".into()));
    }
    if let Some(path) = &description.positions {
        let (positions, aside) = control::positions(path, &survey.images, &defaults)?;
        survey.positions = positions;
        survey.lever_arm_m = description.lever_arm_m;
        unmatched.extend(aside);
    }
    if let Some(path) = &description.scale_bars {
        survey.scale_bars = control::scale_bars(path, &survey.ground)?;
    }
    Ok((model, unmatched))
}

fn work(
    (mut model, unmatched): (Model, Vec<Excluded>),
    description: &Description,
    loss: crate::nlls::Loss,
) -> Result<(Model, Adjustment), Error> {
    let alignment = if description.align { align(&mut model.survey) } else { None };
    if let Some(alignment) = &alignment {
        tracing::info!(
            "brought into the mapping frame by {} {}, rmse {:.3} m",
            alignment.used.len(),
            alignment.by,
            alignment.rmse_m
        );
        for (name, left) in &alignment.misfits {
            tracing::info!("{name} is {left:.3} m off after the alignment, before any adjustment");
        }
    }
    // A shutter is read in seconds of a block in metres.
    if let Some(shutter) = description.rolling_shutter {
        model.survey.rolling_shutter = Some(shutter);
    }
    let mut settings = Settings {
        tie_loss: loss,
        corrected_domain: description.corrected_domain,
        minimal_datum: description.datum == Datum::Minimal,
        ..Settings::default()
    };
    let survey = &mut model.survey;
    let (mut adjusted, removed, complete) = match description.snooping {
        Some(test) => {
            let snooping = DataSnoopingOptions { test, ..DataSnoopingOptions::default() };
            let snooped = snoop(survey, &settings, &snooping)?;
            for removed in &snooped.removed {
                if removed.group != crate::problems::adjustment::Group::TiePoints {
                    tracing::warn!(
                        "{} is not consistent with the block and was taken out ({:.1} times the critical value)",
                        removed.name,
                        removed.excess
                    );
                }
            }
            (snooped.adjusted, snooped.removed, snooped.complete)
        }
        None => (crate::problems::adjustment::adjust(survey, &settings)?, Vec::new(), true),
    };
    settings.tie_loss = crate::nlls::Loss::Trivial;
    if description.variance_components {
        let found = variance_components(survey, &settings, 20)?;
        if !found.converged {
            tracing::warn!("the variance components did not settle in {} rounds", found.rounds);
        }
        let aside = std::mem::take(&mut adjusted.validated.excluded);
        adjusted = found.adjusted;
        adjusted.validated.excluded = aside;
        settings = found.settings;
    }
    let left_out =
        if description.leave_one_out { leave_one_out(survey, &settings)? } else { Vec::new() };
    let adjustment =
        Adjustment { adjusted, settings, alignment, removed, unmatched, left_out, complete };
    Ok((model, adjustment))
}
