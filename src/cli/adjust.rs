//! `rowgram adjust`: bundle adjustment of a block in BAL format, and the way to [`super::survey`]
//! for all others.

use super::survey;
use crate::{
    drive::{Drive, Fingerprint, Limits, LogEntry, Outcome, Progress},
    engine::Termination,
    error::Error,
    io::{FileError, bal, output},
    nlls::{LeastSquares, LinearSolver, Loss, Method, Options, Summary},
    problems::bundle::{Bundle, InteriorSharing, Network},
};
use clap::{Args as ClapArgs, ValueEnum};
use serde::Serialize;
use std::{
    path::PathBuf,
    time::{Duration, Instant},
};

/// Adjust a bundle: camera poses, interior orientations and points from image measurements.
///
/// Reads and writes "Bundle Adjustment in the Large" text files, plain or gzipped. The cost is
/// 1/2 sum rho(|r|^2) over residuals in pixels. Exit code 3 where the default limit of iterations
/// ended it; an explicit limit is as good an end as any.
///
/// A COLMAP folder, Bundler's bundle.out, OpenSfM's reconstruction.json or a block.toml that names one
/// and its control is adjusted with everything that is given: control and check points, camera
/// positions, scale bars, interior orientation, a rolling shutter. Then residuals count in standard
/// deviations, suspect observations are named and taken out, and a report gives standard deviations,
/// correlations, redundancy numbers, tests and the errors of the check points.
#[derive(Debug, ClapArgs)]
#[command(after_help = "Examples:
  rowgram adjust block.txt -o adjusted.txt
  rowgram adjust block.txt.gz --loss huber:1.0 --trace trace.csv --json
  rowgram adjust block.txt --interior shared --solver dense --max-iterations 20
  rowgram adjust sparse/0 --control gcps.csv --marks marks.csv --check A1,A2 \\
      --free f_px,cx_px,cy_px,k1,k2 --report report -o adjusted
  rowgram adjust block.toml --leave-one-out --variance-components")]
pub(super) struct Args {
    /// The block: a BAL file, plain or gzipped; a COLMAP folder, bundle.out, reconstruction.json or
    /// block.toml.
    file: PathBuf,
    /// Robust loss and its scale in pixels: trivial, huber:A, soft-l1:A, cauchy:A,
    /// geman-mcclure:A or tukey:A.
    #[arg(long, default_value = "trivial", value_name = "LOSS")]
    loss: Loss,
    /// How the linear systems are solved.
    #[arg(long, value_enum, default_value_t = Solver::Schur)]
    solver: Solver,
    /// Which trial step.
    #[arg(long, value_enum, default_value_t = Step::Lm)]
    method: Step,
    /// Who shares an interior orientation; "shared" starts at the mean of the file's. BAL files have
    /// one per image if not given, others what the file says.
    #[arg(long, value_enum)]
    interior: Option<Interior>,
    /// The most iterations; 200 if not given.
    #[arg(long, value_name = "N")]
    max_iterations: Option<u64>,
    /// The longest time to solve for, in seconds.
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    max_seconds: Option<f64>,
    /// Stop as soon as the cost is not above this.
    #[arg(long, value_name = "COST")]
    target_cost: Option<f64>,
    /// Stop where a step gains less than this share of the cost.
    #[arg(long, value_name = "SHARE", default_value_t = 1e-9, allow_negative_numbers = true)]
    cost_tolerance: f64,
    /// Write the adjusted block here (gzipped if the name ends in .gz).
    #[arg(short, long, value_name = "OUT.txt")]
    output: Option<PathBuf>,
    /// Write one line per iteration here, as CSV.
    #[arg(long, value_name = "TRACE.csv")]
    trace: Option<PathBuf>,
    /// Draw how the cost fell here, as SVG (the numbers are those of --trace).
    #[arg(long, value_name = "FIGURE.svg")]
    figure: Option<PathBuf>,
    /// Keep a checkpoint here, from which --resume goes on.
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Iterations between checkpoints.
    #[arg(long, value_name = "N", default_value_t = 10, requires = "checkpoint")]
    checkpoint_every: u64,
    /// Go on from a checkpoint of the same block and options.
    #[arg(long, value_name = "FILE")]
    resume: Option<PathBuf>,
    /// Print one line of JSON instead of a summary.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    survey: survey::Options,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Solver {
    /// Points eliminated first.
    Schur,
    /// Points eliminated first, then conjugate gradients instead of Cholesky.
    IterativeSchur,
    /// Sparse Cholesky of everything.
    Sparse,
    /// Dense Cholesky of everything; for small blocks.
    Dense,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Step {
    /// Levenberg-Marquardt.
    Lm,
    /// Powell's Dogleg.
    Dogleg,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Interior {
    /// Every image has its own.
    PerImage,
    /// All images have one.
    Shared,
}

/// The limit of iterations that nobody asked for.
const DEFAULT_MAX_ITERATIONS: u64 = 200;
/// A dense system of more parameters than this would not fit into memory.
const MAX_DENSE_PARAMETERS: usize = 20_000;

#[derive(Serialize)]
pub(super) struct Report {
    file: String,
    pub(super) cameras: usize,
    pub(super) points: usize,
    pub(super) observations: usize,
    loss: String,
    pub(super) initial_cost: f64,
    pub(super) final_cost: f64,
    pub(super) rmse_px: f64,
    pub(super) iterations: u64,
    load_seconds: f64,
    solve_seconds: f64,
    peak_memory_mb: Option<f64>,
    pub(super) stop: Termination,
    converged: bool,
    log: Vec<LogEntry>,
    #[serde(skip)]
    summary: Summary,
}

/// Runs the command.
///
/// # Errors
/// Bad input, outputs that exist, and whatever ends the adjustment early.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    if survey::is_one(&args.file) {
        args.refuse_bal_options()?;
        let per_image = matches!(args.interior, Some(Interior::PerImage));
        return survey::run(
            &args.file,
            &args.survey,
            (args.loss, per_image),
            args.output.as_deref(),
            (args.json, args.force),
        );
    }
    if let Some(option) = args.survey.given() {
        return Err(Error::Argument(format!(
            "{option}: {} is a BAL file, which has no names to join control to",
            args.file.display()
        )));
    }
    let report = work(args)?;
    if args.json {
        super::print_json(&report)?;
    } else {
        super::print(&format!(
            "{} images, {} points, {} observations\n{}read in {:.3} s, solved in {:.3} s",
            report.cameras,
            report.points,
            report.observations,
            report.summary,
            report.load_seconds,
            report.solve_seconds
        ))?;
    }
    if report.stop == Termination::MaxIterations && args.max_iterations.is_none() {
        return Err(Error::Incomplete(format!(
            "not converged after {DEFAULT_MAX_ITERATIONS} iterations; give --max-iterations to allow more"
        )));
    }
    Ok(())
}

/// Reads, adjusts, writes the files; prints nothing.
///
/// # Errors
/// As [`run`], but that the default limit of iterations is as good an end as any.
pub(super) fn work(args: &Args) -> Result<Report, Error> {
    let limits = args.limits()?;
    for path in [&args.output, &args.trace, &args.figure].into_iter().flatten() {
        output::check(path, args.force)?;
    }
    let begin = Instant::now();
    let mut network = bal::read(&args.file)?;
    if let Some(defect) = network.defect() {
        return Err(FileError::malformed(&args.file, None, defect).into());
    }
    let load_seconds = begin.elapsed().as_secs_f64();
    warn_of_single_rays(&network);

    let begin = Instant::now();
    let sharing = match args.interior {
        None | Some(Interior::PerImage) => InteriorSharing::PerImage,
        Some(Interior::Shared) => InteriorSharing::Shared,
    };
    let bundle = Bundle::new(&network, sharing, args.loss)?;
    let parameters = bundle.problem.parameter_count();
    if matches!(args.solver, Solver::Dense) && parameters > MAX_DENSE_PARAMETERS {
        return Err(Error::Argument(format!(
            "--solver dense: {parameters} parameters would need {:.0} GB; use schur or sparse",
            (parameters as f64).powi(2) * 8e-9
        )));
    }
    let posing_seconds = begin.elapsed().as_secs_f64();
    let mut outcome = args.solve(&bundle, limits)?;
    outcome.log.iter_mut().for_each(|entry| entry.seconds += posing_seconds);
    let solve_seconds = begin.elapsed().as_secs_f64();

    let summary = Summary::new(
        &bundle.problem,
        &outcome.x,
        outcome.initial_cost,
        outcome.final_cost,
        outcome.iterations,
        outcome.stop,
    )?;
    if let Some(path) = &args.output {
        bundle.update(&outcome.x, &mut network);
        bal::write(path, &network, args.force)?;
    }
    if let Some(path) = &args.figure {
        let title = format!("{}, loss {}", args.file.display(), args.loss);
        crate::pipeline::figures::convergence(path, args.force, &title, &outcome.log)?;
    }
    Ok(Report {
        file: args.file.display().to_string(),
        cameras: network.cameras.len(),
        points: network.points.len(),
        observations: network.observations.len(),
        loss: args.loss.to_string(),
        initial_cost: outcome.initial_cost,
        final_cost: outcome.final_cost,
        rmse_px: summary.batches.first().map_or(0.0, |batch| batch.rmse),
        iterations: outcome.iterations,
        load_seconds,
        solve_seconds,
        peak_memory_mb: crate::pipeline::peak_memory_mb(),
        stop: outcome.stop,
        converged: outcome.stop.converged(),
        log: outcome.log,
        summary,
    })
}

impl Args {
    /// Options that only BAL files have.
    fn refuse_bal_options(&self) -> Result<(), Error> {
        let given = [
            (self.trace.is_some(), "--trace"),
            (self.figure.is_some(), "--figure"),
            (self.checkpoint.is_some(), "--checkpoint"),
            (self.resume.is_some(), "--resume"),
            (self.max_iterations.is_some(), "--max-iterations"),
            (self.max_seconds.is_some(), "--max-seconds"),
            (self.target_cost.is_some(), "--target-cost"),
        ];
        match given.iter().find(|(given, _)| *given) {
            Some((_, name)) => Err(Error::Argument(format!("{name} is for BAL files only"))),
            None => Ok(()),
        }
    }

    fn limits(&self) -> Result<Limits, Error> {
        let max_time = match self.max_seconds {
            None => None,
            Some(seconds) => Some(Duration::try_from_secs_f64(seconds).map_err(|_| {
                Error::Argument(format!("--max-seconds {seconds}: expected a time of 0 or more"))
            })?),
        };
        if let Some(cost) = self.target_cost.filter(|cost| !cost.is_finite()) {
            return Err(Error::Argument(format!("--target-cost {cost}: expected a number")));
        }
        if !(0.0..1.0).contains(&self.cost_tolerance) {
            return Err(Error::Argument(format!(
                "--cost-tolerance {}: expected 0 or more and below 1",
                self.cost_tolerance
            )));
        }
        Ok(Limits {
            max_iterations: self.max_iterations.unwrap_or(DEFAULT_MAX_ITERATIONS),
            max_time,
            target_cost: self.target_cost,
        })
    }

    fn solve(&self, bundle: &Bundle, limits: Limits) -> Result<Outcome<Vec<f64>>, Error> {
        let options = Options {
            method: match self.method {
                Step::Lm => Method::LevenbergMarquardt,
                Step::Dogleg => Method::Dogleg,
            },
            linear: match self.solver {
                Solver::Schur => LinearSolver::Schur,
                Solver::IterativeSchur => LinearSolver::IterativeSchur,
                Solver::Sparse => LinearSolver::Sparse,
                Solver::Dense => LinearSolver::Dense,
            },
            cost_tolerance: self.cost_tolerance,
            ..Options::default()
        };
        let start = bundle.problem.start();
        let mut drive = Drive::new(&bundle.problem, LeastSquares::new(options.clone()), start)
            .limits(limits)
            .force(self.force);
        if self.checkpoint.is_some() || self.resume.is_some() {
            let mark = Fingerprint::new()
                .numbers(&bundle.problem.start())
                .count(bundle.problem.residual_count() as u64)
                .text(&format!(
                    "{options:?} {} {:?}",
                    self.loss,
                    self.interior.unwrap_or(Interior::PerImage)
                ));
            drive = drive.fingerprint(mark.finish());
        }
        if let Some(path) = &self.trace {
            drive = drive.trace(path);
        }
        if let Some(path) = &self.checkpoint {
            drive = drive.checkpoint(path, self.checkpoint_every);
        }
        if let Some(path) = &self.resume {
            drive = drive.resume_from(path);
        }
        if tracing::enabled!(tracing::Level::INFO) {
            drive = drive.observe(Progress::stderr("adjust"));
        }
        drive.run()?.checked()
    }
}

fn warn_of_single_rays(network: &Network) {
    let single = network.rays().iter().filter(|&&rays| rays < 2).count();
    if single > 0 {
        tracing::warn!(
            "{single} of {} points are seen in one image only: their distance is not determined, only damped",
            network.points.len()
        );
    }
}
