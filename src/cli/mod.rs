//! The program: parse, call the library, present.
//!
//! Data goes to files or stdout, messages to stderr. Exit codes: 0 ok, 1 failure, 2 bad input,
//! 3 incomplete or a quality gate failed.

mod adjust;
mod align;
mod calibrate;
mod camera;
mod convert;
mod crops;
mod dem;
mod doctor;
mod evaluate;
mod features;
mod import;
mod init;
mod leaf_count;
mod leaf_density;
mod leaves;
mod locate;
mod options;
mod ortho;
mod plan;
mod plots;
mod project;
mod query;
mod report;
mod run;
mod season;
mod segment;
mod shell;
mod stage;
mod surface;
mod synth;
mod terminal;
mod thresholds;
mod undistort;
mod verify;
mod view;

use clap::{Parser, Subcommand};
use rowgram_base::error::Error;
use rowgram_optim::output::FileError;
use std::{borrow::Cow, process::ExitCode};

/// From overlapping drone photos of a crop field to plant traits.
#[derive(Debug, Parser)]
#[command(name = "rowgram", version, arg_required_else_help = true, propagate_version = true)]
#[command(after_help = "Examples:
  rowgram run                    a synthetic field, from photos to traits, against its truth
  rowgram init field             settings for a folder of photos
  rowgram run field              everything, into field/rowgram
  rowgram locate mask.png --gsd-m 0.01 -o plants.csv

Exit codes: 0 done, 1 failure, 2 bad input, 3 incomplete or a quality gate failed")]
struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Threads to use, at most 1024; 0 means one per core. Results never depend on it.
    #[arg(long, global = true, default_value_t = 0, value_name = "N",
        value_parser = clap::value_parser!(u16).range(0..=1024))]
    threads: u16,
    /// Memory that the content of one file may take, megabytes; a file that takes more is refused [default: what the
    /// machine has free].
    #[arg(long, global = true, value_name = "MB", value_parser = clap::value_parser!(u64).range(1..=1 << 30))]
    max_memory_mb: Option<u64>,
    /// Say more on stderr (-v: details, -vv: everything).
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    verbose: u8,
    /// Say nothing on stderr but errors.
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    quiet: bool,
}

#[derive(Debug, Subcommand)]
enum Command {
    Run(Box<run::Args>),
    Plan(plan::Args),
    Season(season::Args),
    Init(init::Args),
    Doctor(doctor::Args),
    Report(report::Args),
    View(view::Args),
    Verify(verify::Args),
    Align(Box<align::Args>),
    Adjust(Box<adjust::Args>),
    Convert(convert::Args),
    Calibrate(Box<calibrate::Args>),
    Undistort(undistort::Args),
    Camera(camera::CameraArgs),
    Dem(Box<dem::Args>),
    Surface(surface::Args),
    Ortho(Box<ortho::Args>),
    Query(query::Args),
    Synth(synth::Args),
    Locate(Box<locate::Args>),
    Segment(segment::Args),
    Features(features::Args),
    Match(features::MatchArgs),
    Thresholds(thresholds::Args),
    Leaves(leaves::Args),
    LeafCount(leaf_count::Args),
    LeafDensity(leaf_density::Args),
    Plots(plots::Args),
    Crops(crops::Args),
    Evaluate(evaluate::Args),
    Completions(shell::Completions),
    Man(shell::Man),
}

/// Parses the command line, runs the command, reports what went wrong.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            // Help and version are printed to stdout with code 0, misuse to stderr with code 2.
            let text = error.render().to_string();
            match terminal::visible(&text) {
                Cow::Borrowed(_) => drop(error.print()),
                Cow::Owned(text) => say(&text),
            }
            return ExitCode::from(u8::from(error.use_stderr()) * 2);
        }
    };
    start_logging(cli.verbose, cli.quiet);
    match run(cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            report(&error);
            ExitCode::from(error.kind().exit_code())
        }
    }
}

fn run(cli: Cli) -> Result<(), Error> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(cli.threads.into())
        .build_global()
        .map_err(|e| Error::Argument(format!("--threads {}: {e}", cli.threads)))?;
    if let Some(megabytes) = cli.max_memory_mb {
        rowgram_files::memory::set_limit_bytes(megabytes * 1_000_000);
    }
    dispatch(cli.command)
}

/// Does what a command says.
fn dispatch(command: Command) -> Result<(), Error> {
    match command {
        Command::Run(args) => run::run(&args),
        Command::Plan(args) => plan::run(&args),
        Command::Season(args) => season::run(&args),
        Command::Init(args) => init::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Report(args) => report::run(&args),
        Command::View(args) => view::run(&args),
        Command::Verify(args) => verify::run(&args),
        Command::Align(args) => align::run(&args),
        Command::Adjust(args) => adjust::run(&args),
        Command::Convert(args) => convert::run(&args),
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Undistort(args) => undistort::run(&args),
        Command::Camera(args) => args.run(),
        Command::Dem(args) => dem::run(&args),
        Command::Surface(args) => surface::run(&args),
        Command::Ortho(args) => ortho::run(&args),
        Command::Query(args) => query::run(&args),
        Command::Synth(args) => synth::run(&args),
        Command::Locate(args) => locate::run(&args),
        Command::Segment(args) => segment::run(&args),
        Command::Features(args) => features::run(&args),
        Command::Match(args) => features::run_match(&args),
        Command::Thresholds(args) => thresholds::run(&args),
        Command::Leaves(args) => leaves::run(&args),
        Command::LeafCount(args) => leaf_count::run(&args),
        Command::LeafDensity(args) => leaf_density::run(&args),
        Command::Plots(args) => plots::run(&args),
        Command::Crops(args) => crops::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Completions(args) => args.run(),
        Command::Man(args) => args.run(),
    }
}

fn report(error: &Error) {
    say(&terminal::visible(&format!("error: {error}")));
}

/// A line on stderr; where nobody can read it, the exit code still tells.
fn say(text: &str) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Messages go to stderr, coloured only on a terminal and only where `NO_COLOR` is not set.
fn start_logging(verbose: u8, quiet: bool) {
    use std::io::IsTerminal;
    use tracing_subscriber::{filter::Targets, fmt, layer::SubscriberExt, util::SubscriberInitExt};
    let level = match (quiet, verbose) {
        (true, _) => tracing::Level::ERROR,
        (false, 0) => tracing::Level::INFO,
        (false, 1) => tracing::Level::DEBUG,
        (false, _) => tracing::Level::TRACE,
    };
    let colour = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none();
    // A message that cannot be written is no reason to end.
    let lines = fmt::layer().with_writer(std::io::stderr).log_internal_errors(false);
    tracing_subscriber::registry()
        .with(lines.event_format(terminal::Lines { colour }))
        .with(Targets::new().with_target("rowgram", level))
        .init();
}

/// Writes text for a person to stdout.
fn print(text: &str) -> Result<(), Error> {
    use std::io::Write;
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{}", terminal::visible(text.trim_end())).and_then(|()| out.flush()) {
        // A reader that has seen enough is no failure.
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        result => result.map_err(|e| FileError::write("stdout".as_ref(), e).into()),
    }
}

/// Writes one line of JSON to stdout.
fn print_json(value: &impl serde::Serialize) -> Result<(), Error> {
    let line = serde_json::to_string(value)
        .map_err(|e| FileError::write("stdout".as_ref(), std::io::Error::other(e)))?;
    print(&line)
}
