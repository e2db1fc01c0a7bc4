//! `rowgram align`: from a folder of photos to an oriented, georeferenced block.

mod again;
mod cache;
mod clock;
mod extract;
mod figures;
mod finish;
mod foreign;
mod ground;
mod judge;
mod lenses;
mod pair_figures;
mod project;
mod results;
mod roll;
mod stages;

use crate::{
    camera::{Camera, Model},
    error::Error,
    features,
    io::{FileError, control::Defaults},
    sfm::{
        block::Block,
        growth::{Growing, Start},
        relative::Solver,
        verify::Verifying,
    },
};
use clap::{Args as ClapArgs, ValueEnum};
use serde::Serialize;
use std::{path::PathBuf, time::Instant};

/// Orient the photos of a flight: camera poses, a sparse cloud, self-calibration, check points.
///
/// PROJECT is a folder with photos (JPEG, PNG, TIFF), in images/ or directly. What lies beside them is
/// used: gcps.csv and marks.csv (ground points and where they are in the photos), or an OpenDroneMap
/// gcp_list.txt (names that begin with CHK- are check points), or OpenSfM's ground_control_points.json;
/// geolocation.csv (camera positions, WGS84). Positions, focal lengths and dates come from EXIF and XMP.
///
/// Coordinates leave in the system in which the control came (--crs names it); without control they
/// are in the system of --crs, or in a local plane at the photos.
///
/// Stages: inspect, features, match, verify (orientation of pairs), orient (exterior orientation image by
/// image), adjust (into the map, bundle adjustment with self-calibration), report. What a stage found is
/// kept in OUTPUT/cache and used again until something that it came from changes.
///
/// Exit code 3 where photos could not be oriented together at all.
#[derive(Debug, ClapArgs)]
#[command(after_help = "Examples:
  rowgram align field --json
  rowgram align field --crs EPSG:27700 --check T3,T7 -o aligned
  rowgram align field --solver two-point --lens smac --until verify")]
pub(super) struct Args {
    /// Folder with the photos and what is known of them.
    project: PathBuf,
    /// Folder for the results [default: PROJECT/rowgram].
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Coordinate reference system of control and results: EPSG:<code> or a PROJ string.
    #[arg(long, value_name = "CRS")]
    crs: Option<String>,
    /// Ground points: CSV, gcp_list.txt or ground_control_points.json.
    #[arg(long, value_name = "FILE")]
    control: Option<PathBuf>,
    /// Marks of the ground points of a CSV file.
    #[arg(long, value_name = "FILE")]
    marks: Option<PathBuf>,
    /// Camera positions: image, latitude, longitude, height.
    #[arg(long, value_name = "FILE")]
    geolocation: Option<PathBuf>,
    /// Ground points that take no part and are compared afterwards.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    check: Vec<String>,
    /// Use camera positions for neighbourhoods only.
    #[arg(long)]
    no_positions: bool,
    /// A calibrated camera (camera.toml); what it does not name as free is held.
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
    /// Lens model of cameras that are not given.
    #[arg(long, value_enum, default_value_t = LensName::Auto)]
    lens: LensName,
    /// Lens parameters of the last adjustment [default: all but the aspect and rational terms].
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    free: Option<Vec<String>>,
    /// Minimal solver of relative orientation.
    #[arg(long, value_enum, default_value_t = SolverName::Auto)]
    solver: SolverName,
    /// Where exterior orientation starts.
    #[arg(long, value_enum, default_value_t = StartName::Triplet)]
    start: StartName,
    /// The most features of a photo.
    #[arg(long, value_name = "N", default_value_t = 6000)]
    max_features: usize,
    /// Distance up to which an image position belongs to a point, pixels.
    #[arg(long, value_name = "PX", default_value_t = 4.0)]
    tolerance: f64,
    /// Standard deviation of control points without one, metres.
    #[arg(long, value_name = "M", default_value_t = 0.02)]
    control_sigma: f64,
    /// Standard deviation of a mark without one, pixels.
    #[arg(long, value_name = "PX", default_value_t = 0.5)]
    mark_sigma: f64,
    /// Whether rows are read one after the other while the camera flies: auto looks for it, off does not, and
    /// a readout time in seconds takes it as certain.
    #[arg(long, value_name = "auto|off|S", default_value = "auto")]
    rolling_shutter: roll::Shutter,
    /// Whether the adjusted block is used to find more matches, and is adjusted by these: auto does so where there
    /// is control, on in any case.
    #[arg(long, value_enum, default_value_t = again::When::Auto)]
    look_again: again::When,
    /// Whether tie points are then measured again by least-squares matching, which is several times as exact as
    /// features: auto does so where there is control, on in any case.
    #[arg(long, value_enum, default_value_t = again::When::Auto)]
    remeasure: again::When,
    /// Seed of all random sampling.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Do this stage and those after it again, whatever is kept.
    #[arg(long, value_enum, value_name = "STAGE")]
    from: Option<Stage>,
    /// Stop after this stage.
    #[arg(long, value_enum, value_name = "STAGE")]
    until: Option<Stage>,
    /// Print one line of JSON instead of a summary.
    #[arg(long)]
    json: bool,
    /// Replace results that exist.
    #[arg(long)]
    force: bool,
}

/// The stages in their order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
enum Stage {
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
    /// The map, adjustment, self-calibration.
    Adjust,
    /// Files and pictures.
    Report,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum LensName {
    /// Brown, or SMAC where that explains clearly more: for lenses that bend rays much.
    Auto,
    /// Ideal to measured, radial and decentring, as in OpenCV and COLMAP.
    Brown,
    /// Measured to ideal, as in the paper.
    Smac,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum SolverName {
    /// Whichever explains more of a pair.
    Auto,
    /// Nadir photos from nearly the same height.
    TwoPoint,
    /// Any photos.
    FivePoint,
}

/// Something that is not as it should be, and what was done about it.
#[derive(Debug, Clone, Serialize)]
struct Finding {
    subject: String,
    what: String,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum StartName {
    /// Three photos that fit; the others join one by one.
    Triplet,
    /// All photos at once: averaged rotations, positions by convex programming.
    Global,
}

impl Finding {
    fn new(subject: &str, what: &str) -> Finding {
        Finding { subject: subject.to_owned(), what: what.to_owned() }
    }
}

impl Args {
    fn model(&self) -> Model {
        match self.lens {
            LensName::Auto | LensName::Brown => Model::Brown,
            LensName::Smac => Model::Smac,
        }
    }

    fn verifying(&self) -> Verifying {
        Verifying {
            solver: match self.solver {
                SolverName::Auto => Solver::Auto,
                SolverName::TwoPoint => Solver::TwoPoint,
                SolverName::FivePoint => Solver::FivePoint,
            },
            tolerance_px: self.tolerance,
            seed: self.seed,
            ..Verifying::default()
        }
    }

    fn growing(&self) -> Growing {
        // Of each camera those that its model has.
        let names: &[&str] = match self.camera {
            Some(_) => &[],
            None => &["f_px", "k1", "k2", "c_px", "K1", "K2"],
        };
        Growing {
            start: match self.start {
                StartName::Triplet => Start::Triplet,
                StartName::Global => Start::Global,
            },
            tolerance_px: self.tolerance,
            free: names.iter().map(|&name| name.to_owned()).collect(),
            seed: self.seed,
            ..Growing::default()
        }
    }

    /// What the last adjustment frees of a camera.
    fn last_free(&self, camera: &Camera, whole: bool) -> Vec<String> {
        if let Some(names) = &self.free {
            return names.clone();
        }
        let parameters = camera.interior.model().parameters();
        if self.camera.is_some() {
            let free = camera.free.iter().zip(parameters).filter(|(free, _)| **free);
            return free.map(|(_, parameter)| parameter.name.to_owned()).collect();
        }
        let wanted: &[&str] = match (whole, camera.interior.model()) {
            (true, Model::Smac) => &["c_px", "xp_px", "yp_px", "K1", "K2", "K3", "P1", "P2"],
            (false, Model::Smac) => &["c_px", "K1", "K2"],
            (true, _) => &["f_px", "cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2"],
            (false, _) => &["f_px", "k1", "k2"],
        };
        let known = wanted.iter().filter(|name| camera.interior.model().place(name).is_some());
        known.map(|&name| name.to_owned()).collect()
    }

    fn check(&self) -> Result<(), Error> {
        for (name, value) in [
            ("--tolerance", self.tolerance),
            ("--control-sigma", self.control_sigma),
            ("--mark-sigma", self.mark_sigma),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::Argument(format!("{name} {value}: expected a positive number")));
            }
        }
        if self.max_features < 100 {
            return Err(Error::Argument(format!(
                "--max-features {}: expected at least 100",
                self.max_features
            )));
        }
        if let (Some(from), Some(until)) = (self.from, self.until)
            && from > until
        {
            return Err(Error::Argument("--from: it comes after the stage of --until".into()));
        }
        Ok(())
    }
}

/// Runs the verb.
///
/// # Errors
/// Bad input, outputs that exist, photos that cannot be oriented together.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    args.check()?;
    let output = args.output.clone().unwrap_or_else(|| args.project.join("rowgram"));
    let last = args.until.unwrap_or(Stage::Report);
    if last == Stage::Report {
        results::check(&output, args.force)?;
    }
    if !args.project.is_dir() {
        let message = "expected a folder with photos";
        return Err(FileError::malformed(&args.project, None, message).into());
    }
    let fresh = |stage: Stage| args.from.is_some_and(|from| from <= stage);
    let cache = cache::Cache::new(&output.join("cache"))?;
    let mut clock = clock::Clock::default();
    let mut findings = Vec::new();
    let sources = project::Sources {
        root: &args.project,
        crs: args.crs.as_deref(),
        control: args.control.as_deref(),
        marks: args.marks.as_deref(),
        geolocation: args.geolocation.as_deref(),
        camera: args.camera.as_deref(),
        check: &args.check,
        use_positions: !args.no_positions,
        model: args.model(),
        defaults: Defaults {
            mark_px: args.mark_sigma,
            control_m: args.control_sigma,
            ..Defaults::default()
        },
    };
    let mut project = clock.time("inspect", || project::inspect(&sources, &mut findings))?;
    for (name, reason) in &project.left_out {
        findings.push(Finding::new(name, &format!("left out: {reason}")));
    }
    let mut told = 0;
    let mut tell = |findings: &[Finding]| {
        for finding in &findings[told..] {
            tracing::warn!("{}: {}", finding.subject, finding.what);
        }
        told = findings.len();
    };
    tell(&findings);
    tracing::info!(
        "{} photos, {} with a position, {} ground points, {} marks; frame: {}",
        project.photos.len(),
        project.plan_m.iter().filter(|p| p[0].is_finite()).count(),
        project.known.ground.len(),
        project.known.marks.len(),
        project.frame.name()
    );
    let mut so_far = results::SoFar::new(&project, last);
    if last == Stage::Inspect {
        return so_far.present(findings, &clock.seconds, args.json);
    }
    // Half of the usual contrast: the budget keeps the best, and a plain crop has no others.
    let options = features::Options {
        max_features: args.max_features,
        contrast_threshold: 0.02,
        ..Default::default()
    };
    let extracted = clock.time("features", || {
        extract::features(&project, &options, (&cache, fresh(Stage::Features)), &mut findings)
    })?;
    tell(&findings);
    so_far.features = Some(extracted.features.iter().map(|f| f.key_points.len()).sum());
    if last == Stage::Features {
        return so_far.present(findings, &clock.seconds, args.json);
    }
    let (mut matched, matched_mark) = clock.time("match", || {
        extract::matches(
            &project,
            &extracted,
            &extract::Choice::default(),
            &features::matching::MatchOptions::default(),
            (&cache, fresh(Stage::Match)),
        )
    })?;
    extract::take_out_doubles(&project, &extracted, &mut matched, &mut findings);
    tell(&findings);
    let all: usize = matched.iter().map(|m| m.matches.len()).sum();
    tracing::info!("{} pairs, {all} matches", matched.len());
    (so_far.pairs, so_far.matches) = (Some(matched.len()), Some(all));
    if last == Stage::Match {
        return so_far.present(findings, &clock.seconds, args.json);
    }
    let geometric = extracted.geometric(&project);
    let (pairs, pairs_mark) = clock.time("verify", || {
        let marked = (matched.as_slice(), matched_mark);
        let kept = (&cache, fresh(Stage::Verify));
        lenses::begin(&mut project, &geometric, marked, args, kept, &mut findings)?;
        let cameras: Vec<Camera> =
            project.cameras.iter().map(|(camera, _)| camera.clone()).collect();
        let looks: Vec<&features::Descriptors> =
            extracted.features.iter().map(|f| &f.descriptors).collect();
        stages::verify(&geometric, &cameras, &looks, marked, args, (&cache, fresh(Stage::Verify)))
    })?;
    tell(&findings);
    let two = pairs.iter().filter(|pair| pair.solver == Solver::TwoPoint).count();
    let right: usize = pairs.iter().map(|pair| pair.matches.len()).sum();
    tracing::info!(
        "{} oriented pairs ({two} by two points, {} by five), {right} matches",
        pairs.len(),
        pairs.len() - two,
    );
    let names: Vec<&str> = project.photos.iter().map(|photo| photo.name.as_str()).collect();
    (so_far.pairs, so_far.matches) = (Some(pairs.len()), Some(right));
    if last == Stage::Verify {
        figures::pairs_table(&output.join("report"), &pairs, &names, true)?;
        return so_far.present(findings, &clock.seconds, args.json);
    }
    let cameras: Vec<Camera> = project.cameras.iter().map(|(camera, _)| camera.clone()).collect();
    let matches = pairs.iter().map(|pair| (pair.images, pair.matches.as_slice()));
    let tracks = stages::tracks(&geometric, matches);
    tracing::info!("{} tracks, {} contradictory matches", tracks.count(), tracks.refused());
    let blocks = clock.time("orient", || {
        let marked = (pairs.as_slice(), pairs_mark);
        stages::orient(
            &geometric,
            &tracks,
            &cameras,
            marked,
            &args.growing(),
            (&cache, fresh(Stage::Orient)),
        )
    })?;
    let sizes: Vec<String> = blocks.iter().map(|block| block.registered().to_string()).collect();
    tracing::info!("blocks of {} images", sizes.join(", "));
    so_far.registered = blocks.first().map(Block::registered);
    so_far.fragments = Some(blocks.len());
    if last == Stage::Orient {
        return so_far.present(findings, &clock.seconds, args.json);
    }
    let looks: Vec<&features::Descriptors> =
        extracted.features.iter().map(|f| &f.descriptors).collect();
    let photos = again::Photos { descriptors: &looks, matched: &matched };
    let found =
        clock.time("adjust", || finish::finish(blocks, &project, &photos, args, &mut findings))?;
    let foreign = foreign::Foreign::of(&found.adjusted.reconstruction, &mut findings);
    tell(&findings);
    let (report, mut outcome) = results::Report::new(found, &project, &pairs, findings);
    if last == Stage::Report {
        let begin = Instant::now();
        results::write(&output, (&report, &mut outcome), &foreign, &project, args.force)?;
        let pictures = output.join("report");
        figures::write(&pictures, &outcome.adjusted.reconstruction, &pairs, &names, args.force)?;
        let of = (project.photos.as_slice(), geometric.as_slice());
        pair_figures::write(&pictures, of, &cameras, &pairs, args.force)?;
        clock.seconds.push(("report", begin.elapsed().as_secs_f64()));
    }
    results::present(&report, &outcome, &project.name, &clock.seconds, args.json)
}
