//! Experiments with rowgram: tidy tables and figures from runs on data and on synthetic fields.
//!
//! Every experiment reads a data folder and writes `NAME.csv` (one line per run) and `NAME.md` (the
//! table of means) into an output folder.

mod leaves;
mod locate;
mod methods;
mod plots;
mod segment_speed;
mod table;
mod watershed;
mod whole_field;

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
    /// Leaf segmentation: synthetic fields of which every leaf is known, and real rosettes.
    Leaves {
        #[command(flatten)]
        folders: Folders,
        /// Masks per scenario.
        #[arg(long, default_value_t = 3)]
        masks: u64,
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
    /// Speed and accuracy on one mask of a whole field.
    WholeField {
        #[command(flatten)]
        folders: Folders,
    },
}

fn main() -> ExitCode {
    let done = match Cli::parse().experiment {
        Experiment::LocateMasks { folders, masks } => locate::run(&folders, masks),
        Experiment::LocatePlots { folders } => plots::run(&folders),
        Experiment::Locate { folders } => {
            locate::run(&folders, 10).and_then(|()| plots::run(&folders))
        }
        Experiment::Leaves { folders, masks } => leaves::run(&folders, masks),
        Experiment::SegmentSpeed { raw, width, height, mask } => {
            segment_speed::run(&raw, width, height, &mask)
        }
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

#[expect(clippy::print_stderr, reason = "the program's last word goes to stderr")]
fn complain(error: &rowgram::Error) {
    eprintln!("error: {error}");
}
