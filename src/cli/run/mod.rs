//! `rowgram run`: from a folder of photos to traits and a report, one verb after the other.
//!
//! Every stage is a verb, called with the words that a person would type; each is said on stderr and kept in the
//! report. What a stage wrote is used again while nothing that it came from has changed ([`record`]).

mod command;
mod config;
mod evaluate;
mod grow;
mod init;
pub(super) mod plots;
pub(super) mod record;
mod step;

use super::{captured, dispatch, parse, peak_memory_mb, print, print_json, report};
use crate::{
    error::Error,
    io::{FileError, output},
};
use command::Command;
use config::Config;
pub(super) use init::Init;
use record::{Lock, Record, Records};
use serde_json::Value;
use std::{
    path::{Path, PathBuf},
    time::Instant,
};
pub(super) use step::STAGES;
use step::{Place, Plan};

/// From photos to traits and a report, in one go
///
/// Without PROJECT a small synthetic field is grown, flown over and photographed first, and everything that is
/// found is held against its truth. With it, PROJECT is a folder with photos (in images/ or directly) and what is
/// known of them, or with one orthomosaic; rowgram.toml in it, which rowgram init writes, says what is to be done
/// otherwise than by default.
///
/// Stages: calibrate, align, dem, ortho, segment, density, count, locate, leaves, plots, evaluate, and the report.
/// A stage for which the project has no input is left out with the reason. What a stage wrote in PROJECT/rowgram
/// is used again until something that it came from changes; a run that was stopped goes on where it was.
///
/// Settings: rowgram.toml, then the environment (ROWGRAM_ALIGN_SEED=2), then --set align.seed=2.
///
/// Exit code 3 where a stage could not be completed; the report says what there is.
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
    /// Leave out these stages.
    #[arg(long, value_name = "STAGES", value_delimiter = ',', value_parser = stage)]
    skip: Vec<String>,
    /// Do this stage and those after it again, whatever is kept.
    #[arg(long, value_name = "STAGE", value_parser = stage)]
    from: Option<String>,
    /// Stop after this stage.
    #[arg(long, value_name = "STAGE", value_parser = stage)]
    until: Option<String>,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    dry_run: bool,
    /// Put a synthetic project into a folder that holds something else.
    #[arg(long)]
    force: bool,
    /// Print the numbers as one line of JSON in place of the summary.
    #[arg(long)]
    json: bool,
}

fn stage(text: &str) -> Result<String, String> {
    if STAGES.contains(&text) {
        return Ok(text.to_owned());
    }
    Err(format!("expected one of: {}", STAGES.join(", ")))
}

/// How a stage ended.
enum Ended {
    /// It was done, or what it did before still stands.
    Done,
    /// There was nothing to do.
    Skipped(String),
    /// It could not be done.
    Failed(Error),
}

/// Runs the verb.
///
/// # Errors
/// Bad settings, a project that is none, and the first stage that failed.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let synthetic = args.project.is_none();
    let root = match &args.project {
        Some(project) => project.clone(),
        None => args.output.clone().unwrap_or_else(|| "rowgram-run".into()),
    };
    let results = match (&args.project, &args.output) {
        (Some(_), Some(output)) => output.clone(),
        _ => root.join("rowgram"),
    };
    if !synthetic && !root.is_dir() {
        let message = "expected a folder with photos or an orthomosaic";
        return Err(FileError::malformed(&root, None, message).into());
    }
    if synthetic {
        grow::check(&root, args.seed, args.force)?;
    }
    if args.dry_run && synthetic {
        return print(&format!(
            "rowgram synth flight --preset small --seed {} -o {}\nthen the stages: {}",
            args.seed,
            root.display(),
            STAGES[1..].join(", ")
        ));
    }
    // Before anything is locked or written, so that a mistake leaves nothing behind.
    Config::read(&root, |name| std::env::var(name).ok(), &args.set)?;
    let _lock = if args.dry_run { None } else { Some(Lock::take(&results)?) };
    let begin = Instant::now();
    let runner = Runner {
        root: &root,
        results: &results,
        skip: &args.skip,
        from: args.from.as_deref(),
        until: args.until.as_deref(),
        dry_run: args.dry_run,
    };
    let mut ended = Vec::new();
    if synthetic {
        runner.own("grow", &mut ended, &[], &grow::command(args.seed), |_| {
            grow::grow(&root, args.seed)
        });
        if let Some((_, Ended::Failed(error))) = ended.pop() {
            return Err(error);
        }
    }
    let config = Config::read(&root, |name| std::env::var(name).ok(), &args.set)?;
    for name in &config.stages.skip {
        stage(name).map_err(|e| Error::Argument(format!("[stages] skip, {name}: {e}")))?;
    }
    runner.stages(&config, &mut ended)?;
    if args.dry_run {
        return Ok(());
    }
    let resolved = toml::to_string(&config).map_err(|e| Error::Argument(e.to_string()))?;
    output::write(&results.join(RESOLVED), true, |out| out.write_all(resolved.as_bytes()))?;
    let skipped: Vec<(String, String)> = ended
        .iter()
        .filter_map(|(name, ended)| match ended {
            Ended::Done => None,
            Ended::Skipped(why) => Some((name.clone(), why.clone())),
            Ended::Failed(error) => Some((name.clone(), format!("failed: {error}"))),
        })
        .collect();
    let limits = report::Limits {
        check_yellow_gsd: config.report.check_yellow_gsd,
        check_red_gsd: config.report.check_red_gsd,
    };
    let written = report::write(&report::Sources {
        root: &root,
        results: &results,
        name: config.project.name.clone(),
        skipped: &skipped,
        limits,
    })?;
    if args.json {
        print_json(&written.stats)?;
    } else {
        print(&format!(
            "{}\nreport  {}\n        {:.1} s",
            written.headline,
            written.path.display(),
            begin.elapsed().as_secs_f64()
        ))?;
    }
    let failed = ended.into_iter().find_map(|(name, ended)| match ended {
        Ended::Failed(error) => Some((name, error)),
        _ => None,
    });
    match failed {
        None => Ok(()),
        Some((_, error)) => Err(error),
    }
}

/// A run under way.
struct Runner<'a> {
    root: &'a Path,
    results: &'a Path,
    skip: &'a [String],
    from: Option<&'a str>,
    until: Option<&'a str>,
    dry_run: bool,
}

/// Whether the settings of a project can be understood.
///
/// # Errors
/// What is wrong with them.
pub(super) fn settings(root: &Path) -> Result<(), Error> {
    Config::read(root, |name| std::env::var(name).ok(), &[]).map(drop)
}

/// Does the stages of an earlier run again, with its settings, into another folder.
///
/// # Errors
/// A run without its settings, and the first stage that failed.
pub(super) fn again(root: &Path, results: &Path, folder: &Path) -> Result<(), Error> {
    let path = results.join(RESOLVED);
    let text = std::fs::read_to_string(&path).map_err(|e| FileError::read(&path, e))?;
    let config: Config =
        toml::from_str(&text).map_err(|e| FileError::malformed(&path, None, e.message()))?;
    let records = Records::of(root, results);
    let skip: Vec<String> = STAGES
        .iter()
        .filter(|stage| records.read(stage).is_none())
        .map(|stage| (*stage).to_owned())
        .collect();
    let runner =
        Runner { root, results: folder, skip: &skip, from: None, until: None, dry_run: false };
    let mut ended = Vec::new();
    runner.stages(&config, &mut ended)?;
    let failed = ended.into_iter().find_map(|(_, ended)| match ended {
        Ended::Failed(error) => Some(error),
        _ => None,
    });
    failed.map_or(Ok(()), Err)
}

/// The settings of a run, as they came out.
const RESOLVED: &str = "resolved.toml";

type Endings = Vec<(String, Ended)>;

impl Runner<'_> {
    fn stages(&self, config: &Config, ended: &mut Endings) -> Result<(), Error> {
        let place = Place { root: self.root, results: self.results, config };
        let until = self.until.and_then(index).unwrap_or(STAGES.len());
        let skip = |name: &str| {
            let by = |list: &[String]| list.iter().any(|other| other == name);
            by(self.skip) || by(&config.stages.skip)
        };
        // A block that could not be made leaves nothing to be mapped; old results do not stand in for it.
        let mut broken: Option<&str> = None;
        for (at, &name) in STAGES.iter().enumerate().skip(1) {
            if at > until {
                break;
            }
            if skip(name) {
                ended.push((name.to_owned(), Ended::Skipped("left out as asked".to_owned())));
                continue;
            }
            if let Some(broken) = broken {
                let why = format!("{broken} did not come to its end");
                ended.push((name.to_owned(), Ended::Skipped(why)));
                continue;
            }
            match name {
                "plots" => self.plots(&place, ended),
                "evaluate" => self.evaluate(&place, ended),
                _ => match place.plan(name) {
                    Ok(Plan::Do(command)) => self.verb(name, &command, ended),
                    Ok(Plan::Nothing(why)) => {
                        tracing::info!("{name}: left out, {why}");
                        ended.push((name.to_owned(), Ended::Skipped(why)));
                    }
                    Err(error) => ended.push((name.to_owned(), Ended::Failed(error))),
                },
            }
            if let Some((_, Ended::Failed(error))) = ended.last() {
                if error.kind() != crate::error::Kind::Incomplete {
                    tracing::error!("{name}: {error}");
                }
                if ["calibrate", "align", "dem", "ortho", "segment"].contains(&name) {
                    broken = Some(name);
                }
            }
        }
        Ok(())
    }

    fn verb(&self, name: &str, command: &Command, ended: &mut Endings) {
        let shown = command.shown(self.root);
        let result = self.stage(name, &shown, &command.inputs, command.resumes, |_| {
            let cli = parse(command.arguments())?;
            let (said, result) = captured(|| dispatch(cli.verb));
            result?;
            Ok(serde_json::from_str(said.trim()).unwrap_or(Value::String(said)))
        });
        ended.push((name.to_owned(), result.unwrap_or_else(Ended::Failed)));
    }

    /// A stage that is no verb.
    fn own(
        &self,
        name: &str,
        ended: &mut Endings,
        inputs: &[PathBuf],
        command: &str,
        work: impl FnOnce(&Path) -> Result<Value, Error>,
    ) {
        let result = self.stage(name, command, inputs, name == "grow", work);
        ended.push((name.to_owned(), result.unwrap_or_else(Ended::Failed)));
    }

    fn plots(&self, place: &Place<'_>, ended: &mut Endings) {
        match plots::Inputs::of(place) {
            Ok(inputs) => {
                let files = inputs.files();
                let what = format!("rowgram run . --from plots --until plots # {}", inputs.key());
                self.own("plots", ended, &files, &what, |folder| plots::work(&inputs, folder));
            }
            Err(plots::Missing::Nothing(why)) => {
                tracing::info!("plots: left out, {why}");
                ended.push(("plots".to_owned(), Ended::Skipped(why)));
            }
            Err(plots::Missing::Fault(error)) => {
                ended.push(("plots".to_owned(), Ended::Failed(error)));
            }
        }
    }

    fn evaluate(&self, place: &Place<'_>, ended: &mut Endings) {
        match evaluate::Inputs::of(place) {
            Some(inputs) => {
                let files = inputs.files();
                let what =
                    format!("rowgram run . --from evaluate --until evaluate # {}", inputs.key());
                self.own("evaluate", ended, &files, &what, |folder| {
                    evaluate::work(&inputs, folder)
                });
            }
            None => {
                let why = "no truth to be held against ([project] truth), or no plants".to_owned();
                ended.push(("evaluate".to_owned(), Ended::Skipped(why)));
            }
        }
    }

    /// Does a stage, unless what it did before still stands.
    fn stage(
        &self,
        name: &str,
        command: &str,
        inputs: &[PathBuf],
        resumes: bool,
        work: impl FnOnce(&Path) -> Result<Value, Error>,
    ) -> Result<Ended, Error> {
        let records = Records::of(self.root, self.results);
        let inputs = record::contents(self.root, inputs)?;
        let mut text = format!("{}\n{command}\n", env!("CARGO_PKG_VERSION"));
        for input in &inputs {
            text += &format!("{} {}\n", input.sha256, input.path.display());
        }
        let key = record::of_text(&text);
        let number = index(name).unwrap_or(0);
        let again = self.from.and_then(index).is_some_and(|from| number >= from);
        let kept = if again { None } else { records.kept(name, &key)? };
        if self.dry_run {
            let state = if kept.is_some() { "kept" } else { "to be done" };
            print(&format!("{name:<10} {state:<11} {command}"))?;
            return Ok(Ended::Done);
        }
        if let Some(kept) = kept {
            if kept.program == record::program() {
                tracing::info!("{name}: nothing has changed, kept");
            } else {
                tracing::warn!(
                    "{name}: kept, as written by another build of version {}; --from {name} does it again",
                    kept.version
                );
            }
            return Ok(Ended::Done);
        }
        tracing::info!("{name}: {command}");
        let begin = Instant::now();
        records.forget(name)?;
        let folder = if name == "grow" { self.root.to_owned() } else { self.results.join(name) };
        if !resumes && folder.is_dir() {
            std::fs::remove_dir_all(&folder).map_err(|e| FileError::write(&folder, e))?;
        }
        std::fs::create_dir_all(&folder).map_err(|e| FileError::write(&folder, e))?;
        let says = work(&folder)?;
        let mut written = record::files(&folder, &["cache", "rowgram"])?;
        // Settings are the person's: they decide other stages through their commands.
        written.retain(|path| !path.ends_with(config::NAME));
        records.write(&Record {
            stage: name.to_owned(),
            key,
            command: command.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            program: record::program().to_owned(),
            inputs,
            outputs: record::contents(self.root, &written)?,
            says,
            seconds: begin.elapsed().as_secs_f64(),
            peak_memory_mb: peak_memory_mb(),
        })?;
        Ok(Ended::Done)
    }
}

fn index(name: &str) -> Option<usize> {
    STAGES.iter().position(|stage| *stage == name)
}
