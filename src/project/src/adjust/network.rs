//! Networks without names: "Bundle Adjustment in the Large" files.

use super::{AdjustOptions, Outputs};
use crate::{figures, peak_memory_mb};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor, Progress},
};
use rowgram_files::bal;
use rowgram_optim::{
    drive::{Drive, DriveOutcome, Fingerprint, Limits, LogEntry},
    engine::{SolveError, Termination},
    nlls::{self, BatchPath, BatchSummary, LeastSquares, LinearPath, LinearSolver, Summary},
    output::{self, FileError},
};
use rowgram_survey::problems::bundle::{Bundle, InteriorSharing, Network};
use rowgram_survey::problems::network_start::move_points_off_centres;
use serde::Serialize;
use std::{
    path::Path,
    time::{Duration, Instant},
};

/// The limit of iterations that nobody asked for.
const DEFAULT_MAX_ITERATIONS: u64 = 200;
/// A dense system of more parameters than this would not fit into memory.
const MAX_DENSE_PARAMETERS: usize = 20_000;

/// An adjusted network in numbers.
#[derive(Debug, Clone, Serialize)]
pub struct NetworkOutcome {
    /// The file.
    pub file: String,
    /// Images.
    pub cameras: usize,
    /// Points.
    pub points: usize,
    /// Image measurements.
    pub observations: usize,
    /// The robust loss.
    pub loss: String,
    /// Cost at the start.
    pub initial_cost: f64,
    /// Cost at the end.
    pub final_cost: f64,
    /// Root mean square length of the residuals.
    pub rmse_px: f64,
    /// Trials made.
    pub iterations: u64,
    /// Time to read the file.
    pub load_seconds: f64,
    /// Time to adjust.
    pub solve_seconds: f64,
    /// The most memory used.
    pub peak_memory_mb: Option<f64>,
    /// Why it stopped.
    pub stop: Termination,
    /// Whether it converged.
    pub converged: bool,
    /// How each batch of residuals was evaluated.
    pub batches: Vec<BatchSummary>,
    /// How the cost fell.
    pub log: Vec<LogEntry>,
    /// How the linear systems were solved.
    pub linear: Option<LinearPath>,
    /// For a person.
    #[serde(skip)]
    pub summary: Summary,
}

impl std::fmt::Display for NetworkOutcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} images, {} points, {} observations\n{}read in {:.3} s, solved in {:.3} s",
            self.cameras,
            self.points,
            self.observations,
            self.summary,
            self.load_seconds,
            self.solve_seconds
        )
    }
}

/// Adjusts a network and writes what is asked for.
///
/// # Errors
/// Bad input, outputs that exist, a system that is too large for a dense solver.
pub(super) fn adjust_network(
    file: &Path,
    options: &AdjustOptions,
    outputs: &Outputs,
    monitor: &mut dyn Monitor,
) -> Result<NetworkOutcome, Error> {
    let limits = limits(options)?;
    for path in [&outputs.output, &outputs.trace, &outputs.figure].into_iter().flatten() {
        output::check(path, outputs.force)?;
    }
    let begin = Instant::now();
    let mut network = bal::read(file)?;
    if let Some(defect) = network.defect() {
        return Err(FileError::malformed(file, None, defect).into());
    }
    let load_seconds = begin.elapsed().as_secs_f64();
    report_single_rays(file, &network, monitor);
    let moved = move_points_off_centres(&mut network);
    if let Some(first) = moved.first() {
        let message = format!(
            "{} points start at the centre of a camera that sees them, the first number {first}: they begin where their rays meet",
            moved.len()
        );
        let subject = file.display().to_string();
        monitor.diagnostic(&Diagnostic::warning("points-at-centres", subject, message));
    }

    let begin = Instant::now();
    let sharing = options.interior.unwrap_or(InteriorSharing::PerImage);
    let loss = options.loss.0;
    let bundle = Bundle::new(&network, sharing, loss)?;
    let parameters = bundle.problem.parameter_count();
    if options.network.solver == LinearSolver::Dense && parameters > MAX_DENSE_PARAMETERS {
        return Err(Error::Argument(format!(
            "solver = dense: {parameters} parameters would need {:.0} GB; use schur or sparse",
            (parameters as f64).powi(2) * 8e-9
        )));
    }
    let setup_seconds = begin.elapsed().as_secs_f64();
    let solved = solve(&bundle, sharing, options, limits, outputs, monitor);
    let (mut outcome, paths, linear) = solved.map_err(|error| unusable(file, error))?;
    outcome.log.iter_mut().for_each(|entry| entry.seconds += setup_seconds);
    let solve_seconds = begin.elapsed().as_secs_f64();

    let summary = Summary::new(&bundle.problem, &outcome.x, outcome.as_run())?
        .with_paths(&paths, linear.as_ref());
    if let Some(path) = &outputs.output {
        bundle.update(&outcome.x, &mut network);
        bal::write(path, &network, outputs.force)?;
    }
    if let Some(path) = &outputs.figure {
        let title = format!("{}, loss {loss}", file.display());
        figures::convergence(path, outputs.force, &title, &outcome.log)?;
    }
    // A limit that was asked for is as good an end as any.
    if outcome.stop == Termination::MaxIterations && options.max_iterations.is_none() {
        let message = format!("not converged after {DEFAULT_MAX_ITERATIONS} iterations");
        monitor.diagnostic(
            &Diagnostic::error("not-converged", file.display().to_string(), message)
                .with_remedy("allow more with --max-iterations"),
        );
    }
    Ok(NetworkOutcome {
        file: file.display().to_string(),
        cameras: network.cameras.len(),
        points: network.points.len(),
        observations: network.observations.len(),
        loss: loss.to_string(),
        initial_cost: outcome.initial_cost,
        final_cost: outcome.final_cost,
        rmse_px: summary.batches.first().map_or(0.0, |batch| batch.rmse),
        iterations: outcome.iterations,
        load_seconds,
        solve_seconds,
        peak_memory_mb: peak_memory_mb(),
        stop: outcome.stop,
        converged: outcome.stop.converged(),
        batches: summary.batches.clone(),
        linear,
        log: outcome.log,
        summary,
    })
}

/// Numbers of a file that cannot be computed with are the fault of the file.
fn unusable(file: &Path, error: Error) -> Error {
    match error {
        Error::Solve(SolveError::InfeasibleStart(_) | SolveError::NotFinite(_)) => {
            let message = "the points cannot be projected into its images: their coordinates, poses or lenses are too large, or points \
                           lie in the planes of cameras";
            FileError::malformed(file, None, message).into()
        }
        other => other,
    }
}

fn limits(options: &AdjustOptions) -> Result<Limits, Error> {
    let max_time = match options.network.max_seconds {
        None => None,
        Some(seconds) => Some(Duration::try_from_secs_f64(seconds).map_err(|_| {
            Error::Argument(format!("max_seconds = {seconds}: expected a time of 0 or more"))
        })?),
    };
    Ok(Limits {
        max_iterations: options.max_iterations.unwrap_or(DEFAULT_MAX_ITERATIONS),
        max_time,
        target_cost: options.network.target_cost,
    })
}

/// The outcome, and how batches and linear systems were worked on.
type Solved = (DriveOutcome<Vec<f64>>, Vec<BatchPath>, Option<LinearPath>);

fn solve(
    bundle: &Bundle,
    sharing: InteriorSharing,
    options: &AdjustOptions,
    limits: Limits,
    outputs: &Outputs,
    monitor: &mut dyn Monitor,
) -> Result<Solved, Error> {
    let settings = nlls::Options {
        method: options.network.method,
        linear: options.network.solver,
        cost_tolerance: options.network.cost_tolerance,
        restart_ratio: Some(options.network.restart_ratio).filter(|&ratio| ratio > 0.0),
        ..nlls::Options::default()
    };
    let mut engine = LeastSquares::new(settings.clone());
    let total = limits.max_iterations;
    let mut warned = false;
    let mut drive = Drive::new(&bundle.problem, &mut engine, bundle.problem.start())
        .limits(limits)
        .force(outputs.force)
        .on_step(|event| {
            let (iteration, cost) = (event.iteration, event.cost);
            let step = (event.step.step_norm, event.step.accepted);
            tracing::debug!(iteration, cost, ?step, "adjusting");
            if let (Some(error), false) = (event.file_error, warned) {
                tracing::warn!("no checkpoint at iteration {iteration}: {error}");
                warned = true;
            }
            monitor.progress(&Progress {
                activity: "adjusting",
                done: event.iteration,
                total: Some(total),
                unit: "iterations",
            });
        });
    if outputs.checkpoint.is_some() || outputs.resume.is_some() {
        let mark = Fingerprint::new()
            .numbers(&bundle.problem.start())
            .count(bundle.problem.residual_count() as u64)
            .text(&format!("{settings:?} {} {sharing:?}", options.loss.0));
        drive = drive.fingerprint(mark.finish());
    }
    if let Some(path) = &outputs.trace {
        drive = drive.trace(path);
    }
    if let Some((path, every)) = &outputs.checkpoint {
        drive = drive.checkpoint(path, *every);
    }
    if let Some(path) = &outputs.resume {
        drive = drive.resume_from(path);
    }
    let outcome = drive.run()?.checked()?;
    Ok((outcome, engine.paths().to_vec(), engine.linear_path().cloned()))
}

fn report_single_rays(file: &Path, network: &Network, monitor: &mut dyn Monitor) {
    let single = network.rays().iter().filter(|&&rays| rays < 2).count();
    if single > 0 {
        let message = format!(
            "{single} of {} points are seen in one image only: their distance is not determined, only damped",
            network.points.len()
        );
        let subject = file.display().to_string();
        monitor.diagnostic(&Diagnostic::warning("single-ray-points", subject, message));
    }
}
