//! Experiments with rowgram: questions answered with numbers and figures that go straight into a paper.
//!
//! An experiment is a spec (`specs/NAME.toml`): a stage under test, what is varied, seeds, metrics,
//! figures, tables and a finding. `run` turns it into tidy tables, `draw` those into figures; `plan`,
//! `run --shard`, `submit` and `merge` do the same on many machines, with the same bytes in the end.
//!
//! The commands that read a data folder (`locate-masks` and the like) write `NAME.csv` (one line per run)
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
mod leaf_area;
mod leaf_area_figure;
mod leaf_tips;
mod leaves;
mod leaves_twin;
mod locate;
mod merge;
mod methods;
mod parquet_file;
mod plan;
mod plots;
mod publish;
mod real_fields;
mod real_locators;
mod real_tables;
mod relative;
mod rivals;
mod row_model_masks;
mod row_model_plots;
mod row_model_time;
mod season;
mod segment_speed;
mod sensitivity;
mod spec;
mod stage;
mod stages;
mod stand_count;
mod streams;
mod submit;
mod table;
mod tables;
mod twin_statistics;
mod watershed;
mod whole_field;
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
    /// Plant location, every variant: synthetic masks (true number of plants).
    LocateMasks {
        #[command(flatten)]
        folders: Folders,
        /// Masks per scenario, at most.
        #[arg(long, default_value_t = 10)]
        masks: usize,
    },
    /// Plant location, every variant: real plots, thresholds chosen on `train`, reported on `val`.
    LocatePlots {
        #[command(flatten)]
        folders: Folders,
    },
    /// Both of the above.
    Locate {
        #[command(flatten)]
        folders: Folders,
    },
    /// Relative orientation by two points and by five: wrong matches, tilt, change of height.
    RelativeOrientation {
        #[command(flatten)]
        folders: Folders,
        /// Pairs of each setting.
        #[arg(long, default_value_t = 40)]
        trials: usize,
    },
    /// The locator for closed canopies: synthetic masks, number of plants given and not.
    RowModelMasks {
        #[command(flatten)]
        folders: Folders,
        /// Masks per scenario, at most.
        #[arg(long, default_value_t = 10)]
        masks: usize,
        /// Only this scenario; can be given several times.
        #[arg(long, value_name = "NAME")]
        only: Vec<String>,
        /// An option of the locator, as `NAME=VALUE`; can be given several times.
        #[arg(long, value_name = "NAME=VALUE")]
        set: Vec<String>,
    },
    /// The locator for closed canopies on real plots, number of plants not given; thresholds chosen on
    /// `train`, reported on `val`.
    RowModelPlots {
        #[command(flatten)]
        folders: Folders,
        /// An option of the locator, as `NAME=VALUE`; can be given several times.
        #[arg(long, value_name = "NAME=VALUE")]
        set: Vec<String>,
        /// Leave `val` out.
        #[arg(long)]
        train_only: bool,
        /// Leave out those that are told the number of plants, which take most of the time.
        #[arg(long)]
        alone: bool,
    },
    /// The locator for closed canopies on a quarter, half, the whole and twice of a field.
    RowModelTime {
        #[command(flatten)]
        folders: Folders,
    },
    /// Leaf segmentation: synthetic fields of which every leaf is known, and real rosettes.
    Leaves {
        #[command(flatten)]
        folders: Folders,
        /// Masks per scenario.
        #[arg(long, default_value_t = 3)]
        masks: u64,
    },
    /// Leaf segmentation in rendered photos of which every leaf is known.
    LeavesTwin {
        /// Where the tables go; made if it is not there.
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Photos of each growth stage and ground sampling distance.
        #[arg(long, default_value_t = 2)]
        photos: usize,
    },
    /// Leaf segmentation in side views of maize and sorghum, against leaf tips that people marked.
    LeafTips {
        #[command(flatten)]
        folders: Folders,
    },
    /// Leaf count against leaf area: photos as taken, without distortion, and from straight above.
    LeafArea {
        /// Where the table and the figure go; made if it is not there.
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
    },
    /// The time of the leaf mask of raw RGB pixels; see scripts/segment_speed.py.
    SegmentSpeed {
        /// Three bytes for each pixel.
        raw: PathBuf,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Where the mask goes, one byte for each pixel.
        mask: PathBuf,
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
    /// Speed and accuracy on one mask of a whole field.
    WholeField {
        #[command(flatten)]
        folders: Folders,
    },
}

fn main() -> ExitCode {
    let done = match Cli::parse().experiment {
        Experiment::Spec(command) => return ended(command.run()),
        Experiment::ArenaExport(args) => return ended(args.run()),
        Experiment::ArenaRace(args) => return ended(args.run()),
        Experiment::Season(args) => return ended(args.run()),
        Experiment::LocateMasks { folders, masks } => locate::run(&folders, masks),
        Experiment::LocatePlots { folders } => plots::run(&folders),
        Experiment::Locate { folders } => {
            locate::run(&folders, 10).and_then(|()| plots::run(&folders))
        }
        Experiment::RelativeOrientation { folders, trials } => relative::run_all(&folders, trials),
        Experiment::RowModelMasks { folders, masks, only, set } => {
            options(&set).and_then(|options| row_model_masks::run(&folders, masks, &only, &options))
        }
        Experiment::RowModelPlots { folders, set, train_only, alone } => options(&set)
            .and_then(|options| row_model_plots::run(&folders, &options, train_only, alone)),
        Experiment::RowModelTime { folders } => row_model_time::run(&folders),
        Experiment::Leaves { folders, masks } => leaves::run(&folders, masks),
        Experiment::LeavesTwin { out, photos } => leaves_twin::run(&out, photos),
        Experiment::LeafTips { folders } => leaf_tips::run(&folders),
        Experiment::LeafArea { out } => leaf_area::run(&out),
        Experiment::SegmentSpeed { raw, width, height, mask } => {
            segment_speed::run(&raw, width, height, &mask)
        }
        Experiment::Pages { out } => pages(&out),
        Experiment::Accuracy { folders, every } => accuracy::run(&folders, every.max(1)),
        Experiment::Locators { fields } => {
            return match real_fields::run(&fields) {
                Ok(()) => ExitCode::SUCCESS,
                Err(fail) => {
                    complain(&fail);
                    ExitCode::from(fail.exit_code())
                }
            };
        }
        Experiment::FitStandCount(args) => stand_count::run(&args),
        Experiment::WholeField { folders } => whole_field::run(&folders),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            complain(&error);
            ExitCode::from(error.kind().exit_code())
        }
    }
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

/// Options of the locator from lines of TOML.
fn options(
    set: &[String],
) -> Result<rowgram::phenotype::row_model::RowModelOptions, rowgram::Error> {
    use rowgram::options::Options as _;
    let table = set.join("\n").parse::<toml::Table>().map_err(|error| error.to_string());
    let options = rowgram::phenotype::row_model::RowModelOptions::default();
    table
        .and_then(|table| options.with(&table))
        .map_err(|error| rowgram::Error::Argument(format!("--set: {error}")))
}

#[expect(clippy::print_stderr, reason = "the program's last word goes to stderr")]
fn complain(error: &dyn std::fmt::Display) {
    eprintln!("error: {error}");
}
