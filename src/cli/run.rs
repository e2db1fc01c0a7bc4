//! `rowgram run`: everything that stands, end to end, on data whose truth is known.
//!
//! The steps are the other verbs, called with the words that a person would type; each is said on
//! stderr, to be repeated and varied. The files depend on the seed only.

use super::{adjust, evaluate, locate, print, print_json, segment, synth};
use crate::{
    engine::Stop,
    error::Error,
    io::{FileError, output, points},
    score::Score,
};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Do the main job on synthetic data: no input is needed.
///
/// Grows a small field, finds the plants in its picture and scores them against the truth; flies a
/// small aerial block and adjusts it. Everything goes into one folder: field/ with the picture, the true
/// mask and the true plants; segmented.png, plants.csv and found.png (the plants over the picture);
/// block.txt and adjusted.txt; run.json (the numbers).
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  rowgram run --seed 2 -o second-field")]
pub(super) struct Args {
    /// Folder to write into; it must not exist unless --force is given.
    #[arg(short, long, value_name = "DIR", default_value = "rowgram-run")]
    output: PathBuf,
    /// Seed of everything random.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Replace the files of an earlier run in the folder.
    #[arg(long)]
    force: bool,
    /// Print the numbers as one line of JSON in place of the summary.
    #[arg(long)]
    json: bool,
}

/// Ground sampling distance of the picture.
const GSD_M: f64 = 0.01;
/// How far from a true plant a found one may be.
const RADII_M: [f64; 2] = [0.05, 0.10];
/// What the run leaves in its folder.
const FILES: [&str; 6] =
    ["segmented.png", "plants.csv", "found.png", "block.txt", "adjusted.txt", "run.json"];

/// The numbers; nothing that depends on the machine or the time.
#[derive(Serialize)]
struct Report {
    seed: u64,
    field: FieldReport,
    block: BlockReport,
}

#[derive(Serialize)]
struct FieldReport {
    gsd_m: f64,
    leaf_pixels: usize,
    rows: usize,
    row_spacing_m: Option<f64>,
    radii_m: [f64; 2],
    #[serde(flatten)]
    score: Score,
}

#[derive(Serialize)]
struct BlockReport {
    images: usize,
    points: usize,
    observations: usize,
    initial_cost: f64,
    final_cost: f64,
    rmse_px: f64,
    iterations: u64,
    stop: Stop,
}

/// Runs the verb.
///
/// # Errors
/// A folder that exists or cannot be written, and whatever a step refuses.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let folder = &args.output;
    if folder.exists() && !(args.force && folder.is_dir()) {
        return Err(FileError::Exists { path: folder.clone() }.into());
    }
    let path = |name: &str| folder.join(name);
    // The first step makes a folder that does not exist, once its own arguments are found good.
    for name in FILES.iter().filter(|_| folder.exists()) {
        output::check(&path(name), args.force)?;
    }
    let field = field(args, &path)?;
    let block = block(args, &path)?;
    let report = Report { seed: args.seed, field, block };
    let json = serde_json::to_string_pretty(&report)
        .map_err(|error| FileError::write(&path("run.json"), std::io::Error::other(error)))?;
    output::write(&path("run.json"), args.force, |writer| writeln!(writer, "{json}"))?;
    if args.json { print_json(&report) } else { print(&summary(folder, &report)) }
}

fn field(args: &Args, path: &impl Fn(&str) -> PathBuf) -> Result<FieldReport, Error> {
    let (gsd, seed) = (GSD_M.to_string(), args.seed.to_string());
    let grow = ["mask", "--stage", "mid", "--rows", "4", "--row-length", "6", "--gsd"];
    let words = [&grow[..], &[&gsd, "--seed", &seed]].concat();
    synth::run(&parse(args, "synth", &words, &[("-o", path("field"))])?)?;
    let segmented = path("segmented.png");
    let outputs = [("", path("field/picture.png")), ("-o", segmented)];
    segment::run(&parse(args, "segment", &[], &outputs)?)?;

    let plants = points::read(&path("field/plants.csv"))?.len().to_string();
    let words = ["--plants", &plants, "--gsd", &gsd, "--seed", &seed];
    let outputs = [
        ("", path("field/picture.png")),
        ("-o", path("plants.csv")),
        ("--overlay", path("found.png")),
    ];
    let located = parse::<locate::Locate>(args, "locate", &words, &outputs)?.work()?;

    let radii = RADII_M.map(|radius| (radius / GSD_M).to_string()).join(",");
    let inputs = [("", path("plants.csv")), ("", path("field/plants.csv"))];
    let score = evaluate::score(&parse(args, "evaluate", &["--radius", &radii], &inputs)?)?;
    Ok(FieldReport {
        gsd_m: GSD_M,
        leaf_pixels: located.pixels,
        rows: located.rows,
        row_spacing_m: located.row_spacing_m,
        radii_m: RADII_M,
        score,
    })
}

fn block(args: &Args, path: &impl Fn(&str) -> PathBuf) -> Result<BlockReport, Error> {
    let seed = args.seed.to_string();
    let words = ["bundle", "--images", "20", "--points", "1000", "--seed", &seed];
    synth::run(&parse(args, "synth", &words, &[("-o", path("block.txt"))])?)?;
    let outputs = [("", path("block.txt")), ("-o", path("adjusted.txt"))];
    let adjusted = adjust::work(&parse(args, "adjust", &[], &outputs)?)?;
    Ok(BlockReport {
        images: adjusted.cameras,
        points: adjusted.points,
        observations: adjusted.observations,
        initial_cost: adjusted.initial_cost,
        final_cost: adjusted.final_cost,
        rmse_px: adjusted.rmse_px,
        iterations: adjusted.iterations,
        stop: adjusted.stop,
    })
}

/// The arguments of another verb from its words and paths, with `--force` where it writes; says
/// the command on stderr.
fn parse<T: clap::Args>(
    run: &Args,
    verb: &'static str,
    words: &[&str],
    paths: &[(&str, PathBuf)],
) -> Result<T, Error> {
    let mut all: Vec<std::ffi::OsString> = words.iter().map(Into::into).collect();
    for (option, path) in paths {
        all.extend((!option.is_empty()).then(|| option.into()));
        all.push(path.into());
    }
    let shown: Vec<_> = all.iter().map(|word| word.to_string_lossy()).collect();
    tracing::info!("rowgram {verb} {}", shown.join(" "));
    if run.force && verb != "evaluate" {
        all.push("--force".into());
    }
    let command = T::augment_args(clap::Command::new(verb)).no_binary_name(true);
    command
        .try_get_matches_from(all)
        .and_then(|matches| T::from_arg_matches(&matches))
        .map_err(|error| Error::Argument(format!("{verb}: {error}")))
}

fn summary(folder: &Path, report: &Report) -> String {
    let Report { field, block, .. } = report;
    let share = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.2}"));
    let f1: Vec<String> = RADII_M
        .iter()
        .zip(&field.score.radii)
        .map(|(radius_m, at)| format!("F1 {} at {:.0} cm", share(at.f1), radius_m * 100.0))
        .collect();
    let see = |name: &str| folder.join(name).display().to_string();
    format!(
        "field   {} plants in {} rows: {}\n        the plants that were found: {}\n\
         block   {} images, {} points, {} observations: RMSE {:.3} px, cost {:.1} from {:.1} in {} iterations\n        \
         the adjusted block: {}\nnumbers {}",
        field.score.truth,
        field.rows,
        f1.join(", "),
        see("found.png"),
        block.images,
        block.points,
        block.observations,
        block.rmse_px,
        block.final_cost,
        block.initial_cost,
        block.iterations,
        see("adjusted.txt"),
        see("run.json"),
    )
}
