//! The locator for closed canopies on real photos, number of plants not given, against three that are
//! told the number: k-means, rows with regular spacing, and the paper's form.
//!
//! `maize_plots` has lists of its own: thresholds of the leaf mask and the smallest component are chosen
//! on every fourth plot of `train.txt`, `val.txt` takes no part in it. `stand_count_clips` has none: the
//! clips with even numbers in the order of their names are the training list, the others the test.
//!
//! The choice is a coordinate search (two rounds) by the mean F1 at a quarter of the median in-row
//! spacing, as in [`crate::plots`]; once for the locator, and once for the three it is compared with, by
//! the mean of their scores, so that everybody has thresholds of their own.

use crate::{
    Folders,
    locate::make,
    methods::{self, METHODS, Method},
    plots::{CANDIDATES, Plot, read},
};
use rayon::prelude::*;
use rowgram::robust::median;
use rowgram::{
    Error,
    io::{FileError, images, output},
    phenotype::{
        row_model::{self, RowModelOptions},
        rows,
        stand::Stand,
    },
    problems::plants::index::PixelIndex,
    raster::{components, mask::Thresholds},
    score::Score,
};
use serde::Serialize;
use std::{fmt::Write as _, path::Path};

/// Side of a clip and about half a box, in pixels.
const CLIP: (f64, f64) = (640.0, 7.0);
/// Floor of the scatter about a row for the three: about 1 cm.
const FLOOR_PX: f64 = 3.0;
/// Those that are told the number of plants.
const RIVALS: [&str; 3] = ["k-means", "rows + regular spacing", "inter-row cond"];

#[derive(Debug, Clone, Serialize)]
struct Run {
    set: &'static str,
    list: &'static str,
    plot: String,
    method: &'static str,
    truth: usize,
    found: usize,
    f1_quarter: f64,
    f1_fixed: f64,
    spacing_px: f64,
    true_spacing_px: f64,
    /// Expected share of right plants by the locator's own confidence.
    confidence: f64,
    in_interval: bool,
}

/// A set of photos, in a list to choose on and a list to report.
struct Photos {
    name: &'static str,
    lists: [(&'static str, Vec<Plot>); 2],
    every: usize,
}

/// Runs the experiment: all of it, or only the training lists, or without those that are told the number.
pub(crate) fn run(
    folders: &Folders,
    options: &RowModelOptions,
    train_only: bool,
    alone: bool,
) -> Result<(), Error> {
    make(&folders.out)?;
    let plots = folders.data.join("maize_plots");
    let (train, val) = (read(&plots, "train.txt")?, read(&plots, "val.txt")?);
    let [first, second] = clips(&folders.data.join("stand_count_clips"))?;
    let sets = [
        Photos { name: "maize_plots", lists: [("train", train), ("val", val)], every: 4 },
        Photos { name: "stand_count_clips", lists: [("even", first), ("odd", second)], every: 1 },
    ];
    let rivals: Vec<Method> =
        METHODS.iter().copied().filter(|method| RIVALS.contains(&method.name)).collect();
    let (mut runs, mut chosen) = (Vec::new(), String::new());
    for &Photos { name, ref lists, every } in &sets {
        let search: Vec<&Plot> = lists[0].1.iter().step_by(every).collect();
        let mine = choose(|settings| {
            let runs = locate(name, "search", &search, settings, options, false)?;
            Ok(mean(&runs, |run| run.f1_quarter))
        })?;
        // Writing to a string does not fail.
        let _ = writeln!(chosen, "{name}: thresholds and smallest component {mine:?}.\n");
        let theirs = if alone {
            None
        } else {
            let theirs = choose(|settings| {
                let runs = compare(name, "search", &search, settings, &rivals)?;
                Ok(mean(&runs, |run| run.f1_quarter))
            })?;
            let _ = writeln!(chosen, "For the three others {theirs:?}.\n");
            Some(theirs)
        };
        for &(list, ref plots) in lists.iter().take(if train_only { 1 } else { 2 }) {
            let plots: Vec<&Plot> = plots.iter().collect();
            runs.extend(locate(name, list, &plots, mine, options, true)?);
            if let Some(theirs) = theirs {
                runs.extend(compare(name, list, &plots, theirs, &rivals)?);
            }
        }
    }
    let path = folders.out.join("row_model_plots.csv");
    output::write(&path, true, |writer| {
        let mut csv = csv::Writer::from_writer(writer);
        for run in &runs {
            csv.serialize(run)?;
        }
        csv.flush()
    })?;
    let text = markdown(&runs, &chosen);
    let path = folders.out.join("row_model_plots.md");
    output::write(&path, true, |writer| writer.write_all(text.as_bytes()))?;
    show(&text);
    Ok(())
}

/// The settings with the best score.
fn choose(score: impl Fn([i64; 5]) -> Result<f64, Error>) -> Result<[i64; 5], Error> {
    let mut settings = [30, 79, 30, 163, 0];
    let mut best = score(settings)?;
    for _ in 0..2 {
        let before = settings;
        for (setting, candidates) in CANDIDATES.iter().enumerate() {
            for &candidate in *candidates {
                let mut tried = settings;
                tried[setting] = candidate;
                if tried == settings || candidate == before[setting] {
                    continue;
                }
                let score = score(tried)?;
                if score > best {
                    (best, settings) = (score, tried);
                }
            }
        }
        if settings == before {
            break;
        }
    }
    Ok(settings)
}

/// Clips with their boxes, every other one.
pub(crate) fn clips(root: &Path) -> Result<[Vec<Plot>; 2], Error> {
    let folder = root.join("images");
    let entries = std::fs::read_dir(&folder).map_err(|error| FileError::read(&folder, error))?;
    let mut paths: Vec<_> = entries.filter_map(Result::ok).map(|entry| entry.path()).collect();
    paths.sort();
    let plots: Vec<Plot> = paths
        .par_iter()
        .map(|path| {
            let name = path.file_stem().map(|n| n.to_string_lossy().into_owned());
            let name = name.unwrap_or_default();
            let boxes = root.join(format!("labels/{name}.txt"));
            let text =
                std::fs::read_to_string(&boxes).map_err(|error| FileError::read(&boxes, error))?;
            let truth: Vec<[f64; 2]> = text
                .lines()
                .filter_map(|line| {
                    let numbers: Vec<f64> =
                        line.split_whitespace().filter_map(|word| word.parse().ok()).collect();
                    let &[_, x, y, _, _] = numbers.as_slice() else { return None };
                    Some([x * CLIP.0 - 0.5, y * CLIP.0 - 0.5])
                })
                .collect();
            let radii_px = [nearest_px(&truth) / 4.0, CLIP.1];
            Ok(Plot { name, photo: images::read_photo(path)?, truth, radii_px })
        })
        .collect::<Result<_, Error>>()?;
    let mut lists = [Vec::new(), Vec::new()];
    for (k, plot) in plots.into_iter().enumerate() {
        lists[k % 2].push(plot);
    }
    Ok(lists)
}

/// Median distance to the nearest neighbour on the farther side: with rows farther apart than plants,
/// the spacing in the rows, whatever their heading.
pub(crate) fn nearest_px(truth: &[[f64; 2]]) -> f64 {
    let distances: Vec<f64> = truth
        .iter()
        .filter_map(|at| {
            let mut near: Vec<[f64; 2]> = truth
                .iter()
                .map(|other| [other[0] - at[0], other[1] - at[1]])
                .filter(|d| d[0] != 0.0 || d[1] != 0.0)
                .collect();
            near.sort_by(|a, b| a[0].hypot(a[1]).total_cmp(&b[0].hypot(b[1])));
            let first = *near.first()?;
            let other =
                near.iter().find(|d| d[0] * first[0] + d[1] * first[1] < 0.0).unwrap_or(&first);
            Some(0.5 * (first[0].hypot(first[1]) + other[0].hypot(other[1])))
        })
        .collect();
    median(distances).unwrap_or(4.0).max(4.0)
}

fn mask_of(plot: &Plot, [t1, t2, t3, t4, least]: [i64; 5]) -> Result<rowgram::raster::Mask, Error> {
    let mut mask = Thresholds::new(t1, t2, t3, t4)?.mask(&plot.photo);
    components::remove_small(&mut mask, least.unsigned_abs() as usize);
    Ok(mask)
}

/// Locates on plots; one where no rows are found has no plants.
fn locate(
    set: &'static str,
    list: &'static str,
    plots: &[&Plot],
    settings: [i64; 5],
    options: &RowModelOptions,
    given: bool,
) -> Result<Vec<Run>, Error> {
    let runs: Vec<Vec<Run>> = plots
        .par_iter()
        .map(|plot| {
            let mask = mask_of(plot, settings)?;
            let detection = rows::detect(&mask);
            let auto = row_model::locate(&mask, &detection, None, options).ok();
            let mut runs = vec![run_of(set, list, plot, "full", auto.as_ref())?];
            if given {
                let count = Some(plot.truth.len());
                let told = row_model::locate(&mask, &detection, count, options).ok();
                runs.push(run_of(set, list, plot, "full, number given", told.as_ref())?);
            }
            Ok(runs)
        })
        .collect::<Result<_, Error>>()?;
    Ok(runs.into_iter().flatten().collect())
}

fn run_of(
    set: &'static str,
    list: &'static str,
    plot: &Plot,
    method: &'static str,
    found: Option<&Stand>,
) -> Result<Run, Error> {
    let mut run = Run {
        set,
        list,
        plot: plot.name.clone(),
        method,
        truth: plot.truth.len(),
        found: 0,
        f1_quarter: 0.0,
        f1_fixed: 0.0,
        spacing_px: 0.0,
        true_spacing_px: 4.0 * plot.radii_px[0],
        confidence: 0.0,
        in_interval: false,
    };
    if let Some(found) = found {
        let at: Vec<[f64; 2]> = found.plants.iter().map(|p| p.position_px).collect();
        let score = Score::new(&at, &plot.truth, &plot.radii_px)?;
        let f1 = |k: usize| score.radii[k].f1.unwrap_or(0.0);
        (run.f1_quarter, run.f1_fixed) = (f1(0), f1(1));
        (run.found, run.spacing_px) = (found.plants.len(), found.median_gap_px());
        let sum: f64 = found.plants.iter().map(|plant| plant.confidence).sum();
        run.confidence = sum / (found.plants.len() as f64).max(1.0);
        let [low, high] = found.count_interval;
        run.in_interval = (low..=high).contains(&(plot.truth.len() as f64));
    }
    Ok(run)
}

/// Those that are told the number of plants.
fn compare(
    set: &'static str,
    list: &'static str,
    plots: &[&Plot],
    settings: [i64; 5],
    rivals: &[Method],
) -> Result<Vec<Run>, Error> {
    let runs: Vec<Vec<Run>> = plots
        .par_iter()
        .map(|plot| {
            let mask = mask_of(plot, settings)?;
            let index = PixelIndex::from_mask(mask.width, &mask.data);
            let detection = rows::detect(&index);
            rivals
                .iter()
                .map(|method| {
                    let (truth, radii) = (&plot.truth, &plot.radii_px);
                    let at = (list, plot.name.as_str());
                    let done =
                        methods::run(method, at, &index, &detection, truth, radii, FLOOR_PX)?;
                    let run = run_of(set, list, plot, method.name, None)?;
                    let (f1_quarter, f1_fixed) = (done.f1[0], done.f1[1]);
                    Ok(Run { found: plot.truth.len(), f1_quarter, f1_fixed, ..run })
                })
                .collect()
        })
        .collect::<Result<_, Error>>()?;
    Ok(runs.into_iter().flatten().collect())
}

fn markdown(runs: &[Run], chosen: &str) -> String {
    let mut text = format!(
        "# Plants on real photos\n\n`full` counts by itself, the others are told the number. F1 at a \
         quarter of the median in-row spacing, and at 15 px (plots) or 7 px (clips). Count error: sum \
         over the list, and mean of the absolute errors.\n\n{chosen}\n| set | list | method | photos | \
         F1 quarter | F1 fixed | count error % | mean abs % | in interval | confidence | median abs error \
         of spacing % |\n|---|---|---|---|---|---|---|---|---|---|---|\n"
    );
    let mut keys: Vec<(&str, &str, &str)> =
        runs.iter().map(|run| (run.set, run.list, run.method)).collect();
    let mut seen = Vec::new();
    keys.retain(|key| {
        let new = !seen.contains(key);
        seen.push(*key);
        new
    });
    for (set, list, method) in keys {
        let mine: Vec<&Run> = runs
            .iter()
            .filter(|run| (run.set, run.list, run.method) == (set, list, method))
            .collect();
        let of = |f: fn(&Run) -> f64| {
            mine.iter().map(|run| f(run)).sum::<f64>() / mine.len().max(1) as f64
        };
        let mut errors: Vec<f64> =
            mine.iter().map(|run| (run.spacing_px / run.true_spacing_px - 1.0).abs()).collect();
        errors.sort_by(f64::total_cmp);
        let sums = [of(|run| run.found as f64), of(|run| run.truth as f64)];
        // Writing to a string does not fail.
        let _ = writeln!(
            text,
            "| {set} | {list} | {method} | {} | {:.3} | {:.3} | {:+.2} | {:.2} | {:.2} | {:.3} | {:.1} |",
            mine.len(),
            of(|run| run.f1_quarter),
            of(|run| run.f1_fixed),
            100.0 * (sums[0] / sums[1] - 1.0),
            100.0 * of(|run| (run.found as f64 / run.truth as f64 - 1.0).abs()),
            of(|run| f64::from(u8::from(run.in_interval))),
            of(|run| run.confidence),
            100.0 * errors.get(errors.len() / 2).copied().unwrap_or(f64::NAN),
        );
    }
    text
}

fn mean(runs: &[Run], f: impl Fn(&Run) -> f64) -> f64 {
    runs.iter().map(f).sum::<f64>() / runs.len().max(1) as f64
}

#[expect(clippy::print_stdout, reason = "the table is the output")]
fn show(text: &str) {
    println!("{text}");
}
