//! From photos to a reconstruction in the mapping frame.
//!
//! Steps: inspect, features, match, verify (orientation of pairs), orient (exterior orientation image by image), adjust
//! (into the mapping frame, bundle adjustment with self-calibration), report. What a step found is kept in the content store
//! and used again until something that it came from changes.

mod descriptor_store;
mod enlarge;
mod export;
mod features;
mod figures;
mod geotags;
mod ground;
pub(super) mod inputs;
mod known_photos;
mod marks;
mod matches;
mod options;
mod outcome;
mod pair_figures;
mod parts;
mod place;
mod results;
mod sharpness;
mod steps;
mod surveyed;

pub(super) use descriptor_store::DESCRIPTORS_IN_MEMORY_BYTES;
pub(super) use ground::{plan_m, without_heights};
pub use options::{AlignOptions, Step};
pub use outcome::{AlignOutcome, Fragment, PartialReport, PointErrors};
pub use parts::{find_features, match_pairs};
pub(super) use surveyed::surveyed_points;

use super::{Project, Stage, Task, adjust, checks, record::Key, stage};
use matches::Matching;
use rowgram_base::{
    error::Error,
    monitor::{Monitor, Recorder, Severity},
};
use rowgram_survey::{
    features::DescriptorSource,
    scene::Image,
    sfm::{
        adjust_block::{Flight, Photos, adjust_blocks},
        tracks::Tracks,
    },
};
use std::path::{Path, PathBuf};

pub use rowgram_survey::sfm::{adjust_block::When, intrinsics::LensChoice, relative::Solver};

/// The task of [`align`].
pub struct AlignTask;

impl Task for AlignTask {
    type Options = AlignOptions;
    type Outcome = AlignOutcome;
    const STAGE: Stage = Stage::Align;

    fn inputs(project: &Project, _: &AlignOptions) -> Result<Vec<PathBuf>, Error> {
        if project.given_orthomosaic().is_some() {
            return Err(Error::NothingToDo("the orthomosaic is there already".to_owned()));
        }
        let mut files = project.photos();
        if files.len() < 3 {
            return Err(Error::NothingToDo(format!(
                "{}: {} photos (JPEG, PNG, TIFF) {}; at least 3 are needed",
                project.root().display(),
                files.len(),
                project.photo_place()
            )));
        }
        files.extend(inputs::beside(project));
        Ok(files)
    }

    fn context(project: &Project) -> String {
        project.config().project.crs.clone().unwrap_or_default()
    }

    fn work(
        project: &Project,
        options: &AlignOptions,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<AlignOutcome, Error> {
        let (_, outcome) = run(project, options, Step::Report, Some(folder), monitor)?;
        outcome.ok_or_else(|| Error::Incomplete("the last step was not reached".to_owned()))
    }
}

/// Orients the photos of a project: camera poses, a sparse cloud, self-calibration, check points.
///
/// Writes `reconstruction.json` with its tables (see [`rowgram_files::reconstruction`]), `camera-N.toml`,
/// `exterior_orientation.csv`, `cloud.ply`, `cloud.laz`, `crs.txt`, exports for COLMAP and OpenSfM, `report/` and `figures/`.
/// An adjustment that did not converge ([`AlignOutcome::converged`]), and a smaller share of oriented photos than
/// `[checks] oriented_red` or control that contradicts the block, are diagnostics of severity error; the latter two for a result that was kept, too.
///
/// # Errors
/// [`Error::NothingToDo`] for a project without photos; bad input; [`Error::Incomplete`] where no three photos can be
/// oriented together.
pub fn align(
    project: &Project,
    options: &AlignOptions,
    monitor: &mut dyn Monitor,
) -> Result<AlignOutcome, Error> {
    let outcome = stage::perform::<AlignTask>(project, options, monitor)?;
    let limits = &project.config().checks;
    let control = outcome.georeferenced.then(|| checks::georeference(&outcome, limits));
    let found = [Some(checks::photos_oriented(&outcome, limits)), control];
    for found in found.iter().flatten().filter(|found| found.severity == Severity::Error) {
        monitor.diagnostic(found);
    }
    Ok(outcome)
}

/// As [`align`], up to a step; what that found is kept in the store, and a later [`align`] goes on from there.
///
/// # Errors
/// As [`align`].
pub fn align_until(
    project: &Project,
    options: &AlignOptions,
    last: Step,
    monitor: &mut dyn Monitor,
) -> Result<PartialReport, Error> {
    let refused = |why| Error::Argument(format!("[align] {why}"));
    rowgram_base::options::Options::validate(options).map_err(refused)?;
    let _lock = project.lock()?;
    AlignTask::inputs(project, options)?;
    Ok(run(project, options, last.min(Step::Adjust), None, monitor)?.0)
}

/// Reads what [`align`] reads, photos only by their heads, and tells the monitor what is remarkable; writes nothing. Where
/// each photo was taken, as [`align`] would take it.
///
/// # Errors
/// What is missing or contradicts itself.
pub(super) fn places(
    project: &Project,
    options: &AlignOptions,
    monitor: &mut dyn Monitor,
) -> Result<Vec<Option<rowgram_files::photo::Geotag>>, Error> {
    AlignTask::inputs(project, options)?;
    Ok(inputs::inspect(project, options, None, monitor)?.tags)
}

/// Makes [`align`] do a step and those after it again, where it is done again.
///
/// # Errors
/// A project that another process is working on; a file that cannot be removed.
pub fn forget(project: &Project, from: Step) -> Result<(), Error> {
    let _lock = project.lock()?;
    let store = project.store(Stage::Align);
    for (step, name) in steps::KEPT {
        if from <= step {
            store.forget(name)?;
        }
    }
    Ok(())
}

/// Runs the steps up to `last`. With a folder, the results are written into it, and the outcome is returned as well.
fn run(
    project: &Project,
    options: &AlignOptions,
    last: Step,
    folder: Option<&Path>,
    monitor: &mut dyn Monitor,
) -> Result<(PartialReport, Option<AlignOutcome>), Error> {
    let monitor = &mut Recorder::new(monitor);
    let store = project.store(Stage::Align);
    let mut inputs = inputs::inspect(project, options, Some(&store), monitor)?;
    let mut report = PartialReport::new(&inputs, last);
    if last == Step::Inspect {
        return Ok((report, None));
    }
    let search = (&options.detection(), options.enlarge);
    let extracted = features::features(&inputs, search, true, &store, monitor)?;
    report.features = Some(extracted.geometric.iter().map(|of| of.positions_px.len()).sum());
    if last == Step::Features {
        return Ok((report, None));
    }
    let (mut matched, matched_key) =
        Matching::new(&inputs, &extracted, options.seed, &store).all(monitor)?;
    matches::remove_duplicates(&inputs, &extracted, &mut matched, monitor);
    report.pairs = Some(matched.len());
    report.matches = Some(matched.iter().map(|m| m.matches.len()).sum());
    if last == Step::Match {
        return Ok((report, None));
    }
    let features::Extracted { geometric, descriptors, largest, .. } = extracted;
    drop(largest);
    steps::intrinsics(&mut inputs, &geometric, (&matched, matched_key), options, &store, monitor)?;
    let cameras = inputs.cameras();
    let verification = options.verification();
    let looks: &dyn DescriptorSource = &descriptors;
    let images = (geometric.as_slice(), cameras.as_slice(), looks);
    let (pairs, pairs_key) =
        steps::verify(images, (&matched, matched_key), &verification, &store, monitor)?;
    descriptors.check()?;
    descriptors.release();
    report.pairs = Some(pairs.len());
    report.matches = Some(pairs.iter().map(|pair| pair.matches.len()).sum());
    if last == Step::Verify {
        return Ok((report, None));
    }
    let calibrated = inputs.calibrated;
    let tracks = Tracks::of_pairs(
        &geometric,
        pairs.iter().map(|pair| (pair.images, pair.matches.as_slice())),
    )
    .thinned(&geometric, options.max_tie_observations);
    let tracks_key = Key::begin().key(pairs_key).count(options.max_tie_observations as u64);
    let marked = (pairs.as_slice(), tracks_key.finish());
    let incremental = options.incremental(calibrated);
    let blocks =
        steps::orient((&geometric, &tracks, &cameras), marked, &incremental, &store, monitor)?;
    report.registered = blocks.first().map(rowgram_survey::sfm::Block::registered);
    report.fragments = Some(blocks.len());
    if last == Step::Orient {
        return Ok((report, None));
    }
    let read = |image: usize| inputs.read_grey(image);
    let photos = Photos { descriptors: &descriptors, matched: &matched, read: &read };
    let (order, mark_scales) = (inputs.flight(), inputs.mark_scales());
    let flight = Flight {
        known: &inputs.known,
        order: &order,
        has_position_sigma: &inputs.has_position_sigma,
        mark_scales: &mark_scales,
    };
    let mut found = adjust_blocks(blocks, &flight, &photos, &options.block(calibrated), monitor)?;
    descriptors.check()?;
    let exported = export::Exports::of(&found.adjusted.reconstruction);
    found.diagnostics.extend(exported.diagnostics.iter().cloned());
    found.diagnostics.iter().for_each(|diagnostic| monitor.diagnostic(diagnostic));
    for diagnostic in rowgram_survey::sfm::adjust_block::unregistered(
        &found,
        &geometric,
        &pairs,
        &monitor.diagnostics,
    ) {
        monitor.diagnostic(&diagnostic);
    }
    let both_m = |image: &Image| {
        let [x, y, _] = image.pose.centre_m();
        [[x, y], inputs.plan_m[image.id.saturating_sub(1) as usize]]
    };
    let placed = found.adjusted.reconstruction.images.iter().map(both_m);
    let placed: Vec<_> = placed.filter(|[_, at]| at[0].is_finite()).collect();
    if found.georeferenced
        && let Some(diagnostic) = place::scale_contradiction(&placed)
    {
        monitor.diagnostic(&diagnostic);
    }
    let outcome = AlignOutcome::new(&found, &inputs, pairs.len());
    let Some(folder) = folder else { return Ok((report, None)) };
    let scene = results::reconstruction(&inputs, &found);
    results::write(folder, &scene, &outcome, &exported)?;
    let (drawn, tables) = (folder.join(results::FIGURES), folder.join(results::REPORT));
    adjust::write((&tables, &drawn), &adjust::Adjustment::of_block(found), true)?;
    figures::write(&drawn, &tables, &scene, &pairs, &inputs.names())?;
    let of = (inputs.photos.as_slice(), geometric.as_slice());
    pair_figures::write(&drawn, of, &cameras, &pairs)?;
    if !outcome.converged {
        monitor.diagnostic(&adjust::not_converged());
    }
    Ok((report, Some(outcome)))
}
