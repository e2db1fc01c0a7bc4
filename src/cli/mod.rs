//! The program: parse, call the library, present.
//!
//! Data goes to files or stdout, messages to stderr. Exit codes: 0 ok, 1 failure, 2 bad input,
//! 3 incomplete or a quality check failed.

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
mod run;
mod season;
mod segment;
mod shell;
mod stage;
mod surface;
mod synth;
mod targets;
mod terminal;
mod thresholds;
mod undistort;
mod verify;
mod view;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
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

Exit codes: 0 done, 1 failure, 2 bad input, 3 incomplete or a quality check failed")]
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
    Init(init::Args),
    Doctor(doctor::Args),
    Run(Box<run::Args>),
    Season(season::Args),
    View(view::Args),
    Verify(verify::Args),
    Plan(plan::Args),
    Segment(Box<segment::Args>),
    Locate(Box<locate::Args>),
    Leaves(Box<leaves::Args>),
    Plots(Box<plots::Args>),
    Evaluate(evaluate::Args),
    Align(Box<align::Args>),
    Targets(targets::Args),
    Adjust(Box<adjust::Args>),
    Surface(Box<surface::Args>),
    Ortho(Box<ortho::Args>),
    Camera(camera::Args),
    Convert(convert::Args),
    Synth(synth::Args),
    Completions(shell::Args),
}

/// The commands as `--help` shows them.
const GROUPS: [(&str, &[&str]); 5] = [
    ("A project", &["init", "doctor", "run", "season", "view", "verify", "plan"]),
    (
        "Single files, or one stage of a project",
        &["segment", "locate", "leaves", "plots", "evaluate"],
    ),
    (
        "Cameras and reconstructions",
        &["align", "targets", "adjust", "surface", "ortho", "camera", "convert"],
    ),
    ("Synthetic data", &["synth"]),
    ("This program", &["completions", "help"]),
];

/// The command line, whose help lists commands by group.
fn command() -> clap::Command {
    let mut command = Cli::command();
    command.build();
    let width = command.get_subcommands().map(|of| of.get_name().len()).max().unwrap_or(0);
    let mut groups = String::new();
    for (heading, names) in GROUPS {
        groups += &format!("{heading}:\n");
        for name in names {
            let about = command.find_subcommand(name).and_then(clap::Command::get_about);
            groups += &format!(
                "  {name:width$}  {}\n",
                about.map(ToString::to_string).unwrap_or_default()
            );
        }
        groups.push('\n');
    }
    Cli::command().help_template(format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n\n{groups}Options:\n{{options}}{{after-help}}"
    ))
}

/// Parses the command line, runs the command, reports what went wrong.
pub fn main() -> ExitCode {
    let matches = command().try_get_matches();
    let cli = match matches.and_then(|matches| Cli::from_arg_matches(&matches)) {
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
    rowgram_files::memory::set_limit_bytes(
        cli.max_memory_mb.map(|megabytes| megabytes * 1_000_000),
    );
    dispatch(cli.command)
}

/// Does what a command says.
fn dispatch(command: Command) -> Result<(), Error> {
    match command {
        Command::Init(args) => init::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Run(args) => run::run(&args),
        Command::Season(args) => season::run(&args),
        Command::View(args) => view::run(&args),
        Command::Verify(args) => verify::run(&args),
        Command::Plan(args) => plan::run(&args),
        Command::Segment(args) => segment::run(&args),
        Command::Locate(args) => locate::run(&args),
        Command::Leaves(args) => leaves::run(&args),
        Command::Plots(args) => plots::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Align(args) => align::run(&args),
        Command::Targets(args) => targets::run(&args),
        Command::Adjust(args) => adjust::run(&args),
        Command::Surface(args) => surface::run(&args),
        Command::Ortho(args) => ortho::run(&args),
        Command::Camera(args) => args.run(),
        Command::Convert(args) => convert::run(&args),
        Command::Synth(args) => synth::run(&args),
        Command::Completions(args) => args.run(),
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
    let lines = fmt::layer().with_writer(|| terminal::AboveBars).log_internal_errors(false);
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
