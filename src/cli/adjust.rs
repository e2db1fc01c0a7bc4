//! `rowgram adjust`: arguments in, results out; see [`rowgram_project::adjust`].

use super::{options::Given, project::present};
use clap::Args as ClapArgs;
use rowgram_base::error::Error;
use rowgram_project::adjust::{self, AdjustOptions, Outputs};
use std::path::PathBuf;

/// Adjust a bundle: camera poses, interior orientations and points from image measurements.
///
/// Reads and writes "Bundle Adjustment in the Large" text files, plain or gzipped. The cost is
/// 1/2 sum rho(|r|^2) over residuals in pixels. Exit code 3 where the default limit of iterations
/// ended it; an explicit limit is as good an end as any.
///
/// A COLMAP folder, Bundler's bundle.out, OpenSfM's reconstruction.json or rowgram's, or a block.toml that names one
/// and its control, is adjusted with everything that is given: control and check points, camera
/// positions, scale bars, interior orientation, a rolling shutter. Then residuals count in standard
/// deviations, suspect observations are named and removed, and a report gives standard deviations,
/// correlations, redundancy numbers, tests and the errors of the check points. The keys of a block.toml are the options
/// below with underscores; what the command line gives comes before the file.
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
    #[command(flatten)]
    options: Given<AdjustOptions>,
    /// Write the adjusted block here (a BAL file is gzipped if the name ends in .gz).
    #[arg(short, long, value_name = "PATH")]
    output: Option<PathBuf>,
    /// Of a BAL file: write one line per iteration here, as CSV.
    #[arg(long, value_name = "TRACE.csv")]
    trace: Option<PathBuf>,
    /// Of a BAL file: draw how the cost fell here, as SVG (the numbers are those of --trace).
    #[arg(long, value_name = "FIGURE.svg")]
    figure: Option<PathBuf>,
    /// Of a BAL file: keep a checkpoint here, from which --resume goes on.
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Iterations between checkpoints.
    #[arg(long, value_name = "N", default_value_t = 10, requires = "checkpoint")]
    checkpoint_every: u64,
    /// Of a BAL file: go on from a checkpoint of the same block and options.
    #[arg(long, value_name = "FILE")]
    resume: Option<PathBuf>,
    /// Print one line of JSON instead of a summary.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
}

/// Runs the command.
///
/// # Errors
/// As [`adjust::adjust`], and [`Error::Incomplete`] where it did not converge.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let (block, told) = adjust::read_block(&args.file)?;
    let options = args.options.over(&told)?;
    let outputs = Outputs {
        output: args.output.clone(),
        trace: args.trace.clone(),
        figure: args.figure.clone(),
        checkpoint: args.checkpoint.clone().map(|path| (path, args.checkpoint_every)),
        resume: args.resume.clone(),
        force: args.force,
    };
    present(
        args.json,
        |monitor| adjust::adjust(&block, &options, &outputs, monitor),
        ToString::to_string,
    )
}
