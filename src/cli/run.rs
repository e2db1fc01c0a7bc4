//! `rowgram run`: all stages of a project, and the report.

use super::{print, print_json, project::open_with, terminal::Terminal};
use rowgram_base::{error::Error, options::Choice};
use rowgram_project::{
    Config, Project, Stage,
    batches::{self, Batch, BatchStep},
    environment, report,
    run::{self, Ending, Plan, RunOptions, RunOutcome, StageReport},
    synth,
};
use std::{
    path::{Path, PathBuf},
    str::FromStr,
    time::Instant,
};

/// From photos to traits and a report, in one go
///
/// Without PROJECT a small synthetic field is grown, flown over and photographed first, and every result is compared
/// with ground truth. With it, PROJECT is a folder with photos (in images/ or directly), optional ground control points
/// and camera positions, or with one orthomosaic; rowgram.toml in it, which rowgram init writes, holds the settings.
///
/// Stages: calibrate, align, dem, surface, ortho, segment, leaf-density, leaf-count, locate, leaves, plots, evaluate, then the
/// report. A stage for which the project has no input is left out with the reason. Results in
/// PROJECT/rowgram are reused until an input, an option or the program changes; an interrupted run continues.
///
/// Settings: rowgram.toml, then the environment (ROWGRAM_ALIGN_SEED=2), then --set align.seed=2. Stages are left out with
/// --set stages.skip=surface,leaves.
///
/// Exit code 3 where a stage could not be completed or a quality check is red; the report says what there is.
#[derive(Debug, clap::Args)]
#[command(
    verbatim_doc_comment,
    after_help = "Examples:
  rowgram run
  rowgram run --seed 2 -o second-field
  rowgram init field && rowgram run field
  rowgram run field --set ortho.gsd_m=0.01 --from ortho
  rowgram run field --dry-run"
)]
pub(super) struct Args {
    /// Folder of the project; a synthetic one in --output where it is not given.
    project: Option<PathBuf>,
    /// Folder for the results [default: PROJECT/rowgram]; without PROJECT, of the synthetic project
    /// [default: rowgram-run].
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Seed of the synthetic field.
    #[arg(long, value_name = "N", default_value_t = 1, conflicts_with = "project")]
    seed: u64,
    /// Set a key of rowgram.toml; may be given several times.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
    /// Repeat this stage and those after it.
    #[arg(long, value_name = "STAGE")]
    from: Option<Stage>,
    /// Stop after this stage.
    #[arg(long, value_name = "STAGE")]
    until: Option<Stage>,
    /// Do one task alone, without checks and report: a stage, or a part of a long step (features, matches, surface-coarse,
    /// surface-fine) such as features:2/8. For workflow managers (see rowgram plan).
    #[arg(long, value_name = "STAGE|STEP:PART/PARTS", requires = "project",
        conflicts_with_all = ["from", "until", "dry_run"])]
    only: Option<OneTask>,
    /// Show what would be done, without doing it.
    #[arg(long)]
    dry_run: bool,
    /// Replace results that were edited since, or that rowgram did not write: they are kept beside, as NAME.edited. Put a
    /// synthetic project into a folder that holds something else.
    #[arg(long)]
    force: bool,
    /// Print the outcome as one line of JSON in place of the summary.
    #[arg(long)]
    json: bool,
}

/// A task of a workflow.
#[derive(Debug, Clone, Copy)]
enum OneTask {
    Stage(Stage),
    Part(Batch),
}

impl FromStr for OneTask {
    type Err = String;
    fn from_str(text: &str) -> Result<OneTask, String> {
        if text.contains(':') {
            text.parse().map(OneTask::Part)
        } else {
            text.parse().map(OneTask::Stage)
        }
    }
}

impl Args {
    fn options(&self) -> RunOptions {
        RunOptions { from: self.from, until: self.until, ..RunOptions::default() }
    }
}

/// Runs the command.
///
/// # Errors
/// Bad settings, a project that is none, the first stage that failed, and [`Error::Incomplete`] where a quality check is
/// red.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let begin = Instant::now();
    let mut terminal = Terminal::new();
    let project = match &args.project {
        Some(root) => open_with(root, args.output.as_deref(), &args.set)?,
        None => {
            let root = args.output.clone().unwrap_or_else(|| "rowgram-run".into());
            if args.dry_run {
                return print(&synthetic_plan(&root, args.seed));
            }
            // Settings that cannot be understood are refused before anything is made.
            Config::read(&root, environment()?.into_iter(), &args.set)?;
            synth::synthesize(&root, args.seed, args.force, &mut terminal)?;
            open_with(&root, None, &args.set)?
        }
    };
    let project = project.forced(args.force);
    if args.dry_run {
        return print_plan(&project, args);
    }
    match args.only {
        Some(OneTask::Part(batch)) => return run_batch(&project, batch, args.json, terminal),
        Some(OneTask::Stage(stage)) => {
            let report = run::only(&project, stage, &mut terminal)?;
            drop(terminal);
            return if args.json { print_json(&report) } else { print(&one_line(&report)) };
        }
        None => {}
    }
    let mut outcome = run::run(&project, &args.options(), &mut terminal)?;
    let page = project.results().join(report::REPORT_FILE);
    let state = if outcome.is_whole {
        report::write(&project, &outcome)?;
        ""
    } else {
        "  (of a run of more stages; do that again to renew it)"
    };
    drop(terminal);
    if args.json {
        print_json(&outcome)?;
    } else {
        print(&format!(
            "{}\nreport  {}{state}\n        {:.1} s",
            report::summary(&outcome),
            page.display(),
            begin.elapsed().as_secs_f64()
        ))?;
    }
    let failure = outcome.failure.take();
    judge(&outcome, failure)
}

fn run_batch(
    project: &Project,
    batch: Batch,
    json: bool,
    mut terminal: Terminal,
) -> Result<(), Error> {
    let outcome = batches::perform(project, batch, &mut terminal)?;
    drop(terminal);
    if json {
        return print_json(&outcome);
    }
    let what = match batch.step {
        BatchStep::Features => "photos",
        BatchStep::Matches => "sets of pairs",
        BatchStep::SurfaceCoarse | BatchStep::SurfaceFine => "tiles",
    };
    print(&match (outcome.reason, outcome.stage_is_current) {
        (Some(reason), _) => format!("{batch}: left out, {reason}"),
        (None, true) => format!("{batch}: the stage is done already"),
        (None, false) => format!("{batch}: {} {what}", outcome.items),
    })
}

fn one_line(report: &StageReport) -> String {
    let ending = match report.ending {
        Ending::Done => "done",
        Ending::Kept => "kept",
        Ending::LeftOut => "left out",
        Ending::Failed => "failed",
    };
    match &report.reason {
        Some(reason) => format!("{}: {ending}, {reason}", report.stage),
        None => format!("{}: {ending}", report.stage),
    }
}

/// Repeats the red checks as the last words, and makes them the exit code.
///
/// # Errors
/// The failure of the first stage that failed, else [`Error::Incomplete`] with the red checks.
fn judge(outcome: &RunOutcome, failure: Option<Error>) -> Result<(), Error> {
    let red: Vec<String> = outcome.red_checks().map(ToString::to_string).collect();
    match failure {
        Some(error) => {
            red.iter().for_each(|line| tracing::error!("{line}"));
            Err(error)
        }
        None if red.is_empty() => Ok(()),
        None => Err(Error::Incomplete(red.join("\nerror: "))),
    }
}

fn synthetic_plan(root: &Path, seed: u64) -> String {
    let stages: Vec<String> = Stage::all().iter().map(Stage::word).collect();
    format!(
        "a synthetic project of seed {seed} in {}\nthen the stages: {}",
        root.display(),
        stages.join(", ")
    )
}

fn print_plan(project: &Project, args: &Args) -> Result<(), Error> {
    let planned = run::plan(project, &args.options())?;
    if args.json {
        return print_json(&planned);
    }
    let lines = planned.iter().map(|stage| {
        let plan = match stage.plan {
            Plan::ToDo => "to be done",
            Plan::Keep => "kept",
            Plan::Depends => "afterwards",
            Plan::LeaveOut => "left out",
        };
        format!("{:<13} {plan:<11} {}\n", stage.stage.to_string(), stage.text)
    });
    print(&lines.collect::<String>())
}
