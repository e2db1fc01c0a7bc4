//! The commands that work on specs.

use crate::{
    compare,
    data::Frame,
    document,
    fail::Fail,
    keys, merge,
    plan::{Plan, Planned},
    publish, sensitivity,
    spec::Spec,
    stage::{self, STAGES},
    work::{self, Shard},
};
use clap::Subcommand;
use rowgram::io::output;
use std::path::{Path, PathBuf};

/// Specs that redraw the paper begin with this.
const PAPER: &str = "paper-";

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Run an experiment: every cell and seed, then tables, figures and the finding.
    ///
    /// Writes runs.csv (one row for each cell and seed; the same spec gives the same bytes), timing.csv,
    /// traces/, manifest.json and figures/. An interrupted run goes on with --resume. A cell that fails is a row with its
    /// reason. With --shard, FILE is a folder made by `plan`, and only records of finished tasks are written.
    Run {
        /// The spec (TOML), or with --shard the folder of a plan.
        file: PathBuf,
        /// Where the results go [default: experiments/out/NAME].
        #[arg(long, value_name = "DIR")]
        out: Option<PathBuf>,
        /// Tasks at a time [default: as many as there are processors].
        #[arg(long, value_name = "N", default_value_t = 0)]
        jobs: usize,
        /// Go on with a run that was interrupted.
        #[arg(long)]
        resume: bool,
        /// Replace the results of another plan.
        #[arg(long, conflicts_with = "resume")]
        force: bool,
        /// The spec's small setting.
        #[arg(long)]
        small: bool,
        /// Do only one shard of a planned folder, such as 2/8.
        #[arg(long, value_name = "I/N")]
        shard: Option<Shard>,
    },
    /// Check a spec completely and say what it would do.
    Check {
        /// The spec (TOML).
        spec: PathBuf,
        /// The spec's small setting.
        #[arg(long)]
        small: bool,
    },
    /// List the stages, or everything that can be set and measured in one.
    List {
        /// A stage.
        stage: Option<String>,
    },
    /// Write the immutable list of tasks of a spec.
    Plan {
        /// The spec (TOML).
        spec: PathBuf,
        /// The folder of the plan.
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// The spec's small setting.
        #[arg(long)]
        small: bool,
        /// Replace another plan.
        #[arg(long)]
        force: bool,
    },
    /// Merge the records of finished tasks into tables; lists what is missing, duplicate or damaged and exits with 3.
    Merge {
        /// The folder of the plan.
        folder: PathBuf,
    },
    /// Say how far a plan has come.
    Status {
        /// The folder of the plan.
        folder: PathBuf,
        /// Also by shard.
        #[arg(long, value_name = "N", default_value_t = 1)]
        shards: usize,
    },
    /// Draw the figures and tables of a spec from the tables of a result.
    Draw {
        /// The spec (TOML).
        spec: PathBuf,
        /// The folder with runs.csv.
        result: PathBuf,
    },
    /// Say which cells of two results differ beyond their intervals (paired tests, effect sizes).
    Compare {
        /// A result folder or its runs.csv.
        a: PathBuf,
        /// Another.
        b: PathBuf,
        /// The level of the tests.
        #[arg(long, value_name = "P", default_value_t = 0.05)]
        level: f64,
        /// Exit with 3 where any pair of numbers differs by more than this share (and 1e-11), or runs are in one result only.
        #[arg(long, value_name = "SHARE")]
        within: Option<f64>,
    },
    /// Copy merged results, with six digits, to where the committed ones are.
    ///
    /// Takes runs.csv, the series and timings that figures are drawn from, the manifest, and writes tests.csv where the
    /// spec names a baseline.
    Keep {
        /// Result folders of full runs.
        #[arg(required = true, value_name = "RESULT")]
        folders: Vec<PathBuf>,
        /// Where they go.
        #[arg(long, value_name = "DIR", default_value = "experiments/results")]
        results: PathBuf,
    },
    /// Draw the figures and tables of every spec from the committed results.
    Figures {
        /// The folder with the specs.
        #[arg(long, value_name = "DIR", default_value = "experiments/specs")]
        specs: PathBuf,
        /// The folder with a result for each spec.
        #[arg(long, value_name = "DIR", default_value = "experiments/results")]
        results: PathBuf,
        /// Where the figures go, a folder for each spec.
        #[arg(long, value_name = "DIR", default_value = "experiments/out/figures")]
        out: PathBuf,
    },
    /// Redraw the paper: run every spec whose name begins with `paper-`.
    ///
    /// With --pdf nothing is run: the committed results become one document with findings, figures, tables and the
    /// commands that made them (paper.typ, and paper.pdf by Typst or its Python package).
    Paper {
        /// The folder with the specs.
        #[arg(long, value_name = "DIR", default_value = "experiments/specs")]
        specs: PathBuf,
        /// Where the results go.
        #[arg(long, value_name = "DIR", default_value = "experiments/out")]
        out: PathBuf,
        /// The small settings.
        #[arg(long)]
        small: bool,
        /// Every spec, not only the paper's.
        #[arg(long)]
        all: bool,
        /// Make one document of the results in DIR.
        #[arg(
            long,
            value_name = "DIR",
            num_args = 0..=1,
            default_missing_value = "experiments/results",
            conflicts_with_all = ["small", "all"]
        )]
        pdf: Option<PathBuf>,
    },
    /// Write FINDINGS.md from the committed results, or check that it is what they say.
    Findings {
        /// The folder with the specs.
        #[arg(long, value_name = "DIR", default_value = "experiments/specs")]
        specs: PathBuf,
        /// The folder with the committed results.
        #[arg(long, value_name = "DIR", default_value = "experiments/results")]
        results: PathBuf,
        /// The file.
        #[arg(long, value_name = "FILE", default_value = "experiments/FINDINGS.md")]
        output: PathBuf,
        /// Write nothing; exit with 3 where the file is not what the results say.
        #[arg(long)]
        check: bool,
    },
}

impl Command {
    pub(crate) fn run(self) -> Result<(), Fail> {
        match self {
            Command::Run { file, out, jobs, resume, force, small, shard } => match shard {
                Some(shard) => {
                    let planned = Planned::load(&file)?;
                    let done = work::run(&planned, shard, jobs)?;
                    say(&format!("shard {}/{}: {done} tasks done", shard.index, shard.count));
                    Ok(())
                }
                None => {
                    let plan = Plan::of(&file, small)?;
                    let out =
                        out.unwrap_or_else(|| Path::new("experiments/out").join(&plan.spec.name));
                    run(plan, &out, jobs, resume, force)
                }
            },
            Command::Check { spec, small } => {
                let plan = Plan::of(&spec, small)?;
                let (cells, seeds) = (plan.cells.len(), plan.spec.seeds.count);
                let Plan { spec, .. } = plan;
                say(&format!(
                    "{}: {cells} cells x {seeds} seeds of stage {}, {} figures, {} tables",
                    spec.name,
                    spec.stage,
                    spec.figures.len(),
                    spec.tables.len()
                ));
                Ok(())
            }
            Command::List { stage } => list(stage.as_deref()),
            Command::Plan { spec, out, small, force } => {
                let planned = Plan::of(&spec, small)?.save(&out, force)?;
                say(&format!("{} tasks, plan {}", planned.count(), planned.hash));
                Ok(())
            }
            Command::Merge { folder } => merge::merge(&Planned::load(&folder)?),
            Command::Status { folder, shards } => {
                say(merge::status(&Planned::load(&folder)?, shards)?.trim_end());
                Ok(())
            }
            Command::Draw { spec, result } => draw(&Spec::read(&spec, false)?.0, &result),
            Command::Keep { folders, results } => folders.iter().try_for_each(|folder| {
                let (name, bytes) = publish::keep(folder, &results)?;
                say(&format!("{name}: {} kB", bytes.div_ceil(1000)));
                Ok(())
            }),
            Command::Figures { specs, results, out } => {
                publish::kept(&spec_files(&specs)?, &results)?.iter().try_for_each(
                    |(spec, result)| {
                        say(&spec.name);
                        publish::draw(spec, result, &out.join(&spec.name))
                    },
                )
            }
            Command::Compare { a, b, level, within } => compare_two(&a, &b, level, within),
            Command::Paper { specs, out, pdf: Some(results), .. } => {
                let kept = publish::kept(&spec_files(&specs)?, &results)?;
                say(&document::write(&kept, &out)?.display().to_string());
                Ok(())
            }
            Command::Paper { specs, out, small, all, pdf: None } => {
                for path in spec_files(&specs)? {
                    let plan = Plan::of(&path, small)?;
                    if all || plan.spec.name.starts_with(PAPER) {
                        let out = out.join(&plan.spec.name);
                        say(&format!("{}: {}", plan.spec.name, plan.spec.title));
                        run(plan, &out, 0, true, false)?;
                    }
                }
                Ok(())
            }
            Command::Findings { specs, results, output, check } => {
                findings(&specs, &results, &output, check)
            }
        }
    }
}

fn run(plan: Plan, out: &Path, jobs: usize, resume: bool, force: bool) -> Result<(), Fail> {
    if Planned::exists(out) && !resume && !force {
        return Err(Fail::Input(format!(
            "{}: there is a run already; go on with --resume, replace another one with --force",
            out.display()
        )));
    }
    let planned = plan.save(out, force)?;
    if force {
        // Records of another plan would be taken for damaged ones.
        let folder = planned.tasks_folder();
        if folder.exists() {
            std::fs::remove_dir_all(&folder).map_err(|e| Fail::io(&folder, &e))?;
        }
    }
    work::run(&planned, Shard::WHOLE, jobs)?;
    merge::merge(&planned)?;
    draw(&planned.plan.spec, out)?;
    say(merge::status(&planned, 1)?.trim_end());
    Ok(())
}

/// Figures, tables, tests and the finding of a result, into its folder.
fn draw(spec: &Spec, result: &Path) -> Result<(), Fail> {
    publish::draw(spec, result, &result.join("figures"))?;
    let runs = Frame::read(&result.join("runs.csv"))?;
    publish::write_tests(spec, &runs, result)?;
    if spec.sensitivity.is_some() {
        let stage = stage::find(&spec.stage).map_err(Fail::Input)?;
        sensitivity::write(&runs, &spec.kept(stage), &result.join("sensitivity.csv"))?;
    }
    let tests = publish::tests_sentence(spec, &runs)?;
    if let Some(finding) = &spec.finding {
        say(&finding.fill(&runs).map_err(|e| Fail::Failed(format!("finding: {e}")))?);
        for claim in finding.refuted(&runs).map_err(|e| Fail::Failed(format!("finding: {e}")))? {
            say(&format!("these numbers do not bear out: {claim}"));
        }
    }
    if !tests.is_empty() {
        say(&tests);
    }
    Ok(())
}

fn list(name: Option<&str>) -> Result<(), Fail> {
    let Some(name) = name else {
        STAGES.iter().for_each(|stage| say(&format!("{:<10} {}", stage.name, stage.about)));
        return Ok(());
    };
    let stage = stage::find(name).map_err(Fail::Input)?;
    say(&format!("{}: {}\n\nkeys and their defaults", stage.name, stage.about));
    let defaults = (stage.defaults)().map_err(Fail::Failed)?;
    for (path, value) in keys::flatten(&defaults) {
        say(&format!("  {path} = {value}"));
    }
    say("\nmetrics");
    stage.metrics.iter().for_each(|m| say(&format!("  {:<20} {}", m.name, m.about)));
    Ok(())
}

fn compare_two(a: &Path, b: &Path, level: f64, within: Option<f64>) -> Result<(), Fail> {
    let (found, lonely) = compare::compare(a, b)?;
    say(compare::report(&found, &lonely, level).trim_end());
    let Some(within) = within else { return Ok(()) };
    let far: Vec<String> = found
        .iter()
        .filter(|c| c.largest > within)
        .map(|c| format!("{}, {}: pairs differ by up to {:.3e}", c.cell, c.metric, c.largest))
        .collect();
    if far.is_empty() && lonely.is_empty() {
        return Ok(());
    }
    Err(Fail::Incomplete(format!(
        "the results are not the same to within {within}:\n{}",
        far.into_iter().chain(lonely).collect::<Vec<_>>().join("\n")
    )))
}

/// The specs of a folder, sorted.
fn spec_files(folder: &Path) -> Result<Vec<PathBuf>, Fail> {
    let entries = std::fs::read_dir(folder).map_err(|e| Fail::io(folder, &e))?;
    let mut paths: Vec<PathBuf> = entries.filter_map(Result::ok).map(|e| e.path()).collect();
    paths.retain(|path| path.extension().is_some_and(|extension| extension == "toml"));
    paths.sort();
    Ok(paths)
}

fn findings(specs: &Path, results: &Path, output: &Path, check: bool) -> Result<(), Fail> {
    let mut text = String::from(
        "# Findings\n\nWritten from the committed results by `experiments findings`; every number comes from the tables, and \
         what\nthe sentences claim is checked against them. Results are those of the full settings (`results/`).\n",
    );
    let (mut refuted, mut pending) = (Vec::new(), Vec::new());
    for path in spec_files(specs)? {
        let (spec, cells) = Spec::read(&path, false)?;
        let Some(finding) = &spec.finding else { continue };
        let result = results.join(&spec.name).join("runs.csv");
        if !result.exists() {
            pending.push(spec.name);
            continue;
        }
        let runs = Frame::read(&result)?;
        let fail = |e: String| Fail::Failed(format!("{}: {e}", spec.name));
        let filled = finding.fill(&runs).map_err(fail)?;
        let wrong = finding.refuted(&runs).map_err(fail)?;
        refuted.extend(wrong.into_iter().map(|c| format!("{}: {c}", spec.name)));
        text += &format!("\n## {}\n\n{filled}\n", spec.title);
        let tests = publish::tests_sentence(&spec, &runs)?;
        if !tests.is_empty() {
            text += &format!("\n{tests}\n");
        }
        text += &format!(
            "\n`specs/{}.toml`: {} cells, {} seed{}.\n",
            spec.name,
            cells.len(),
            spec.seeds.count,
            if spec.seeds.count == 1 { "" } else { "s" }
        );
    }
    if !pending.is_empty() {
        text += &format!(
            "\n## Without a committed result\n\nThese specs state a finding and have no result here: {}.\n",
            pending.join(", ")
        );
    }
    if !refuted.is_empty() {
        return Err(Fail::Incomplete(format!(
            "the results do not bear out:\n{}",
            refuted.join("\n")
        )));
    }
    if check {
        let there = std::fs::read_to_string(output).map_err(|e| Fail::io(output, &e))?;
        return if there == text {
            Ok(())
        } else {
            Err(Fail::Incomplete(format!(
                "{} is not what the results say; `experiments findings` writes it",
                output.display()
            )))
        };
    }
    output::write(output, true, |out| out.write_all(text.as_bytes()))?;
    Ok(())
}

#[expect(clippy::print_stdout, reason = "what was asked for goes to stdout")]
fn say(text: &str) {
    println!("{text}");
}
