//! From photos to a reconstruction in the mapping frame.
//!
//! Steps: inspect, features, match, verify (orientation of pairs), orient (exterior orientation image by image), adjust
//! (into the mapping frame, bundle adjustment with self-calibration), report. What a step found is kept in the cache of
//! the stage's folder and used again until something that it came from changes.

mod descriptor_store;
mod enlarge;
mod export;
mod features;
mod figures;
mod ground;
pub(super) mod inputs;
mod matches;
mod outcome;
mod pair_figures;
mod parts;
mod place;
mod results;
mod sharpness;
mod steps;

pub(super) use descriptor_store::DESCRIPTORS_IN_MEMORY_BYTES;
pub use outcome::{AlignOutcome, Fragment, PartialReport, PointErrors};
pub use parts::{find_features, match_pairs};

use super::{CACHE, Project, Stage, Task, adjust, record::Cache, stage};
use crate::{
    error::Error,
    features::{DescriptorSource, FeatureOptions},
    monitor::{Monitor, Recorder},
    sfm::{
        adjust_block::{
            BlockOptions, Flight, Photos, ShutterModel, USUAL_READOUT_S, adjust_blocks,
        },
        incremental::{IncrementalOptions, Start},
        relative::Solver,
        tracks::Tracks,
        verify::GeometricVerificationOptions,
    },
};
use matches::Matching;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

pub use crate::sfm::{adjust_block::When, intrinsics::LensChoice};

/// The minimal solver of relative orientation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SolverChoice {
    /// Whichever explains more matches of a pair.
    Auto,
    /// The paper's, for nadir photos from nearly the same height.
    TwoPoint,
    /// Any photos.
    FivePoint,
}

/// Where exterior orientation starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StartChoice {
    /// Three photos that fit; the others join one by one.
    Triplet,
    /// All photos at once: averaged rotations, positions by convex programming.
    Global,
}

/// Whether photos are enlarged twofold before features are looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EnlargeChoice {
    /// Those of fewer than eight megapixels, and those that show too few features at their own size.
    Auto,
    /// All.
    On,
    /// None.
    Off,
}

/// Whether rows are read one after the other while the camera moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ShutterChoice {
    /// It is estimated, and modelled where it explains much.
    Auto,
    /// All rows are read at once.
    Off,
    /// It is modelled in any case.
    On,
}

/// A step of the stage, in their order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Step {
    /// Files and what they say.
    Inspect,
    /// Features of every photo.
    Features,
    /// Matches of the pairs worth trying.
    Match,
    /// Orientation of pairs.
    Verify,
    /// Exterior orientation.
    Orient,
    /// Mapping frame, bundle adjustment, self-calibration.
    Adjust,
    /// Files and pictures.
    Report,
}

crate::choices!(SolverChoice: Auto, TwoPoint, FivePoint);
crate::choices!(StartChoice: Triplet, Global);
crate::choices!(EnlargeChoice: Auto, On, Off);
crate::choices!(ShutterChoice: Auto, Off, On);
crate::choices!(Step: Inspect, Features, Match, Verify, Orient, Adjust, Report);

crate::options! {
    /// From photos to camera poses, calibrated cameras and a sparse cloud in the mapping frame.
    pub struct AlignOptions in "align", together go_together {
        /// Lens model of cameras that are not given.
        pub lens: LensChoice = LensChoice::Auto;
        /// Lens parameters of the last adjustment; all but the aspect and rational terms where not set, or those that a
        /// calibrated camera names.
        pub free: Option<Vec<String>> = None, example "[\"f_px\", \"k1\", \"k2\"]";
        /// Minimal solver of relative orientation.
        pub solver: SolverChoice = SolverChoice::Auto;
        /// Where exterior orientation starts: at three photos that fit, or with all photos at once.
        pub start: StartChoice = StartChoice::Triplet;
        /// The most features of a photo.
        pub max_features: usize = 6000, limits at_least(100.0);
        /// Whether photos are enlarged twofold before features are looked for, which takes four times as long: auto enlarges
        /// photos of fewer than eight megapixels, and those that show too few features at their own size.
        pub enlarge: EnlargeChoice = EnlargeChoice::Auto;
        /// Distance from the projection of its point up to which an image position is used.
        pub tolerance_px: f64 = 4.0, limits POSITIVE;
        /// Standard deviation of control points that come without one.
        pub control_sigma_m: f64 = 0.02, limits POSITIVE;
        /// Standard deviation of image measurements of ground points that come without one.
        pub mark_sigma_px: f64 = 0.5, limits POSITIVE;
        /// Whether camera positions take part in the adjustment; else they only tell which photos are neighbours.
        pub use_positions: bool = true;
        /// Ground points that take no part and are compared afterwards.
        pub check: Vec<String> = Vec::new();
        /// Control points that are never left out, whatever the block says of them.
        pub keep: Vec<String> = Vec::new();
        /// Whether rows are read one after the other while the camera moves: auto estimates it, on models it in any case.
        pub rolling_shutter: ShutterChoice = ShutterChoice::Auto;
        /// Time from the first to the last row of a photo. Where it is not set, velocities are told for 0.03 s.
        pub readout_s: Option<f64> = None, limits between(0.0001, 1.0), example "0.03";
        /// Whether matching is repeated with the adjusted poses (guided matching): auto does so with ground control.
        pub guided_matching: When = When::Auto;
        /// Whether tie points are measured again by least-squares matching, several times as exact, and in further photos: auto
        /// does so with ground control.
        pub refine_tie_points: When = When::Auto;
        /// Seed of all random sampling.
        pub seed: u64 = 1;
    }
}

/// Lens parameters are those of a lens, and only a rolling shutter has a readout.
fn go_together(options: &AlignOptions) -> Result<(), String> {
    let known: Vec<&str> = crate::camera::Model::ALL
        .iter()
        .flat_map(|model| model.parameters())
        .map(|parameter| parameter.name)
        .collect();
    for name in options.free.iter().flatten() {
        if !known.contains(&name.as_str()) {
            let near = crate::options::nearest(name, &known)
                .map_or_else(String::new, |near| format!("; did you mean {near}?"));
            return Err(format!("free: no lens has a parameter {name:?}{near}"));
        }
    }
    match (options.rolling_shutter, options.readout_s) {
        (ShutterChoice::Off, Some(_)) => {
            Err("readout_s: rolling_shutter = off takes all rows to be read at once".to_owned())
        }
        _ => Ok(()),
    }
}

impl AlignOptions {
    fn detection(&self) -> FeatureOptions {
        // Half of the usual contrast: the budget keeps the best, and a plain crop has no others.
        let contrast_threshold = 0.02;
        let max_features = self.max_features;
        FeatureOptions { max_features, contrast_threshold, ..FeatureOptions::default() }
    }

    fn verification(&self) -> GeometricVerificationOptions {
        GeometricVerificationOptions {
            solver: match self.solver {
                SolverChoice::Auto => Solver::Auto,
                SolverChoice::TwoPoint => Solver::TwoPoint,
                SolverChoice::FivePoint => Solver::FivePoint,
            },
            tolerance_px: self.tolerance_px,
            seed: self.seed,
            ..GeometricVerificationOptions::default()
        }
    }

    fn incremental(&self, calibrated: bool) -> IncrementalOptions {
        // Of each camera those that its model has.
        let names: &[&str] =
            if calibrated { &[] } else { &["f_px", "k1", "k2", "c_px", "K1", "K2"] };
        IncrementalOptions {
            start: match self.start {
                StartChoice::Triplet => Start::Triplet,
                StartChoice::Global => Start::Global,
            },
            tolerance_px: self.tolerance_px,
            free: names.iter().map(|&name| name.to_owned()).collect(),
            seed: self.seed,
            ..IncrementalOptions::default()
        }
    }

    fn block(&self, calibrated: bool) -> BlockOptions {
        let readout_s = self.readout_s.unwrap_or(USUAL_READOUT_S);
        BlockOptions {
            tolerance_px: self.tolerance_px,
            shutter: match self.rolling_shutter {
                ShutterChoice::Auto => ShutterModel::Auto(readout_s),
                ShutterChoice::Off => ShutterModel::Global,
                ShutterChoice::On => ShutterModel::Rolling(readout_s),
            },
            guided_matching: self.guided_matching,
            refine_tie_points: self.refine_tie_points,
            free: self.free.clone(),
            calibrated,
        }
    }
}

/// The task of [`align`].
pub struct AlignTask;

impl Task for AlignTask {
    type Options = AlignOptions;
    type Outcome = AlignOutcome;
    const STAGE: Stage = Stage::Align;
    const RESUMES: bool = true;

    fn inputs(project: &Project, _: &AlignOptions) -> Result<Vec<PathBuf>, Error> {
        if project.given_orthomosaic().is_some() {
            return Err(Error::NothingToDo("the orthomosaic is there already".to_owned()));
        }
        let mut files = project.photos();
        if files.len() < 3 {
            return Err(Error::NothingToDo(format!(
                "{}: {} photos (JPEG, PNG, TIFF) here or in images/; at least 3 are needed",
                project.root().display(),
                files.len()
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
        stage::clear(folder)?;
        match run(project, options, Step::Report, folder, monitor)? {
            StepOutcome::Whole(outcome) => Ok(*outcome),
            StepOutcome::Part(_) => {
                Err(Error::Incomplete("the last step was not reached".to_owned()))
            }
        }
    }
}

/// Orients the photos of a project: camera poses, a sparse cloud, self-calibration, check points.
///
/// Writes `reconstruction.json` with its tables (see [`crate::io::reconstruction`]), `camera-N.toml`,
/// `exterior_orientation.csv`, `cloud.ply`, `cloud.laz`, `crs.txt`, exports for COLMAP and OpenSfM, `report/` and `figures/`.
/// An adjustment that did not converge is a diagnostic of severity error, and the outcome says so.
///
/// # Errors
/// [`Error::NothingToDo`] for a project without photos; bad input; [`Error::Incomplete`] where no three photos can be
/// oriented together.
pub fn align(
    project: &Project,
    options: &AlignOptions,
    monitor: &mut dyn Monitor,
) -> Result<AlignOutcome, Error> {
    stage::perform::<AlignTask>(project, options, monitor)
}

/// As [`align`], up to a step; what that found is kept in the cache, and a later [`align`] goes on from there.
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
    crate::options::Options::validate(options).map_err(refused)?;
    let _lock = project.lock()?;
    AlignTask::inputs(project, options)?;
    let folder = project.folder(Stage::Align);
    std::fs::create_dir_all(&folder).map_err(|e| crate::io::FileError::write(&folder, e))?;
    match run(project, options, last.min(Step::Adjust), &folder, monitor)? {
        StepOutcome::Part(report) => Ok(report),
        StepOutcome::Whole(_) => Err(Error::Incomplete("the step was passed".to_owned())),
    }
}

/// Reads what [`align`] reads, photos only by their heads, and tells the monitor what is remarkable; writes nothing.
///
/// # Errors
/// What is missing or contradicts itself.
pub fn inspect(
    project: &Project,
    options: &AlignOptions,
    monitor: &mut dyn Monitor,
) -> Result<PartialReport, Error> {
    AlignTask::inputs(project, options)?;
    Ok(PartialReport::new(&inputs::inspect(project, options, monitor)?, Step::Inspect))
}

/// Makes [`align`] do a step and those after it again, whatever is kept.
///
/// # Errors
/// A project that another process is working on; a file that cannot be removed.
pub fn forget(project: &Project, from: Step) -> Result<(), Error> {
    let _lock = project.lock()?;
    project.records().forget(Stage::Align)?;
    let cache = Cache::new(&project.folder(Stage::Align).join(CACHE))?;
    for (step, name) in steps::KEPT {
        if from <= step {
            cache.forget(name)?;
        }
    }
    Ok(())
}

/// How far it went.
enum StepOutcome {
    Part(PartialReport),
    Whole(Box<AlignOutcome>),
}

fn run(
    project: &Project,
    options: &AlignOptions,
    last: Step,
    folder: &Path,
    monitor: &mut dyn Monitor,
) -> Result<StepOutcome, Error> {
    let monitor = &mut Recorder::new(monitor);
    let cache = Cache::new(&folder.join(CACHE))?;
    let mut inputs = inputs::inspect(project, options, monitor)?;
    let mut report = PartialReport::new(&inputs, last);
    if last == Step::Inspect {
        return Ok(StepOutcome::Part(report));
    }
    let search = (&options.detection(), options.enlarge);
    let extracted = features::features(&inputs, search, true, &cache, monitor)?;
    report.features = Some(extracted.geometric.iter().map(|of| of.positions_px.len()).sum());
    if last == Step::Features {
        return Ok(StepOutcome::Part(report));
    }
    let (mut matched, matched_key) =
        Matching::new(&inputs, &extracted, options.seed, &cache)?.all(monitor)?;
    matches::remove_duplicates(&inputs, &extracted, &mut matched, monitor);
    report.pairs = Some(matched.len());
    report.matches = Some(matched.iter().map(|m| m.matches.len()).sum());
    if last == Step::Match {
        return Ok(StepOutcome::Part(report));
    }
    let features::Extracted { geometric, descriptors, .. } = extracted;
    steps::intrinsics(&mut inputs, &geometric, (&matched, matched_key), options, &cache, monitor)?;
    let cameras = inputs.cameras();
    let verification = options.verification();
    let looks: &dyn DescriptorSource = &descriptors;
    let images = (geometric.as_slice(), cameras.as_slice(), looks);
    let (pairs, pairs_key) =
        steps::verify(images, (&matched, matched_key), &verification, &cache, monitor)?;
    descriptors.check()?;
    report.pairs = Some(pairs.len());
    report.matches = Some(pairs.iter().map(|pair| pair.matches.len()).sum());
    if last == Step::Verify {
        results::pairs_table(&folder.join(results::REPORT), &pairs, &inputs.names())?;
        return Ok(StepOutcome::Part(report));
    }
    let calibrated = inputs.calibrated;
    let tracks = Tracks::of_pairs(
        &geometric,
        pairs.iter().map(|pair| (pair.images, pair.matches.as_slice())),
    );
    let marked = (pairs.as_slice(), pairs_key);
    let incremental = options.incremental(calibrated);
    let blocks =
        steps::orient((&geometric, &tracks, &cameras), marked, &incremental, &cache, monitor)?;
    report.registered = blocks.first().map(crate::sfm::Block::registered);
    report.fragments = Some(blocks.len());
    if last == Step::Orient {
        return Ok(StepOutcome::Part(report));
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
    for diagnostic in
        crate::sfm::adjust_block::unregistered(&found, &geometric, &pairs, &monitor.diagnostics)
    {
        monitor.diagnostic(&diagnostic);
    }
    let outcome = AlignOutcome::new(&found, &inputs, pairs.len());
    if last == Step::Adjust {
        return Ok(StepOutcome::Part(report));
    }
    let scene = results::reconstruction(&inputs, &found);
    results::write(folder, &scene, &outcome, &exported)?;
    adjust::write_report(folder, &adjust::Adjustment::of_block(found))?;
    let drawn = folder.join(results::FIGURES);
    figures::write(&drawn, &folder.join(results::REPORT), &scene, &pairs, &inputs.names())?;
    let of = (inputs.photos.as_slice(), geometric.as_slice());
    pair_figures::write(&drawn, of, &cameras, &pairs)?;
    if !outcome.converged {
        monitor.diagnostic(&adjust::not_converged());
    }
    Ok(StepOutcome::Whole(Box::new(outcome)))
}
