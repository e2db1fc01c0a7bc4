//! Experiments with rowgram: questions answered with numbers and figures that go straight into a paper.
//!
//! An experiment is a spec (`specs/NAME.toml`): a stage under test, what is varied, seeds, metrics,
//! figures, tables and a finding. `run` turns it into tidy tables, `draw` those into figures; `plan`,
//! `run --shard` and `merge` do the same on many machines by Snakemake, with the same bytes in the end.
//!
//! The commands that read a data folder (`accuracy` and the like) write `NAME.csv` (one line per run)
//! and `NAME.md` (the table of means).

mod accuracy;
mod arena_peers;
mod command;
mod compare;
mod contrasts;
mod data;
mod document;
mod fail;
mod figures;
mod findings;
mod keys;
mod leaves;
mod mask_sets;
mod merge;
mod plan;
mod plots;
mod publish;
mod real_fields;
mod real_locators;
mod real_tables;
mod relative;
mod rivals;
mod season;
mod sensitivity;
mod spec;
mod stage;
mod stages;
mod stand_count;
mod streams;
mod tables;
mod twin_statistics;
mod watershed;
mod work;

use clap::{Args, Parser, Subcommand};
use std::{path::PathBuf, process::ExitCode};

/// Experiments with rowgram.
#[derive(Debug, Parser)]
#[command(name = "experiments", arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    experiment: Experiment,
}

/// Where an experiment reads and writes.
#[derive(Debug, Args)]
struct Folders {
    /// The data folder.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Where the tables go; made if it is not there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

#[derive(Debug, Subcommand)]
enum Experiment {
    #[command(flatten)]
    Spec(command::Command),
    /// Writes the pages of the documentation that are made from definitions: options.md, traits.md.
    Pages {
        /// The folder of the documentation.
        #[arg(long, value_name = "DIR", default_value = "docs")]
        out: PathBuf,
    },
    /// Every real data set with defaults, beside rivals of a few lines: the tables of docs/accuracy.md.
    Accuracy {
        #[command(flatten)]
        folders: Folders,
        /// Only every so many-th photo.
        #[arg(long, default_value_t = 1)]
        every: usize,
    },
    /// The paper's locators, regular spacing and today's locator on every real data set and on synthetic fields.
    Locators {
        #[command(flatten)]
        fields: real_fields::RealFields,
    },
    ArenaExport(arena_peers::Export),
    ArenaRace(arena_peers::Race),
    Season(season::Season),
    /// The weights of the stand count, from masks of which every plant is known.
    FitStandCount(stand_count::FitStandCount),
}

fn main() -> ExitCode {
    let done = match Cli::parse().experiment {
        Experiment::Spec(command) => return ended(command.run()),
        Experiment::ArenaExport(args) => return ended(args.run()),
        Experiment::ArenaRace(args) => return ended(args.run()),
        Experiment::Season(args) => return ended(args.run()),
        Experiment::Pages { out } => pages(&out),
        Experiment::Accuracy { folders, every } => accuracy::run(&folders, every.max(1)),
        Experiment::Locators { fields } => return ended(real_fields::run(&fields)),
        Experiment::FitStandCount(args) => stand_count::run(&args),
    };
    ended(done.map_err(fail::Fail::from))
}

fn ended(done: Result<(), fail::Fail>) -> ExitCode {
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(fail) => {
            complain(&fail);
            ExitCode::from(fail.exit_code())
        }
    }
}

/// Writes `options.md` and `traits.md`.
fn pages(out: &std::path::Path) -> Result<(), rowgram::Error> {
    use rowgram::{io::output, phenotype::traits::dictionary_page, pipeline::reference_page};
    for (name, page) in [("options.md", reference_page()), ("traits.md", dictionary_page())] {
        output::write(&out.join(name), true, |file| file.write_all(page.as_bytes()))?;
    }
    Ok(())
}

#[expect(clippy::print_stderr, reason = "the program's last word goes to stderr")]
fn complain(error: &dyn std::fmt::Display) {
    eprintln!("error: {error}");
}
