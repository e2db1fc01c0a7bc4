//! The locator for closed canopies on real plots, number of plants not given.
//!
//! The thresholds of the leaf mask and the smallest component are chosen on every fifth plot of
//! `train.txt` by coordinate search (two rounds), as in [`crate::plots`], by the mean F1 at a quarter
//! of the median in-row spacing. `val.txt` takes no part in it.

use crate::{
    Folders,
    locate::make,
    plots::{CANDIDATES, Plot, read},
};
use rayon::prelude::*;
use rowgram::{
    Error,
    io::output,
    phenotype::{
        canopy::{self, Options},
        rows,
        stand::Canopy,
    },
    problems::plants::index::PixelIndex,
    raster::{components, mask::Thresholds},
    score::Score,
};
use serde::Serialize;
use std::fmt::Write as _;

#[derive(Debug, Clone, Serialize)]
struct Run {
    list: &'static str,
    plot: String,
    truth: usize,
    found: usize,
    f1_auto: f64,
    f1_given: f64,
    spacing_px: f64,
    true_spacing_px: f64,
}

/// Runs the experiment.
pub(crate) fn run(folders: &Folders, options: &Options, train_only: bool) -> Result<(), Error> {
    make(&folders.out)?;
    let root = folders.data.join("maize_plots");
    let train = read(&root, "train.txt")?;
    let search: Vec<&Plot> = train.iter().step_by(5).collect();
    let mut settings = [30, 79, 30, 163, 0];
    let mut best = mean(&locate("search", &search, settings, options, false)?, |run| run.f1_auto);
    for _ in 0..2 {
        let before = settings;
        for (setting, candidates) in CANDIDATES.iter().enumerate() {
            for &candidate in *candidates {
                let mut tried = settings;
                tried[setting] = candidate;
                if tried == settings || candidate == before[setting] {
                    continue;
                }
                let runs = locate("search", &search, tried, options, false)?;
                let score = mean(&runs, |run| run.f1_auto);
                if score > best {
                    (best, settings) = (score, tried);
                }
            }
        }
        if settings == before {
            break;
        }
    }
    let mut runs = locate("train", &train.iter().collect::<Vec<_>>(), settings, options, true)?;
    if !train_only {
        let val = read(&root, "val.txt")?;
        runs.extend(locate("val", &val.iter().collect::<Vec<_>>(), settings, options, true)?);
    }
    let path = folders.out.join("canopy_plots.csv");
    output::write(&path, true, |writer| {
        let mut csv = csv::Writer::from_writer(writer);
        for run in &runs {
            csv.serialize(run)?;
        }
        csv.flush()
    })?;
    let mut text = format!(
        "# Plants on real plots, number of plants not given\n\nThresholds {:?}, components of at \
         least {} pixels.\n\n| list | plots | F1 auto | F1 given | mean abs count error % | median abs \
         error of spacing % |\n|---|---|---|---|---|---|\n",
        &settings[..4],
        settings[4]
    );
    for list in ["train", "val"] {
        let mine: Vec<Run> = runs.iter().filter(|run| run.list == list).cloned().collect();
        let mut errors: Vec<f64> =
            mine.iter().map(|run| (run.spacing_px / run.true_spacing_px - 1.0).abs()).collect();
        errors.sort_by(f64::total_cmp);
        let count = |run: &Run| (run.found as f64 / run.truth as f64 - 1.0).abs();
        // Writing to a string does not fail.
        let _ = writeln!(
            text,
            "| {list} | {} | {:.3} | {:.3} | {:.1} | {:.1} |",
            mine.len(),
            mean(&mine, |run| run.f1_auto),
            mean(&mine, |run| run.f1_given),
            100.0 * mean(&mine, count),
            100.0 * errors.get(errors.len() / 2).copied().unwrap_or(f64::NAN),
        );
    }
    let path = folders.out.join("canopy_plots.md");
    output::write(&path, true, |writer| writer.write_all(text.as_bytes()))?;
    show(&text);
    Ok(())
}

/// Locates on plots; one where no rows are found has no plants.
fn locate(
    list: &'static str,
    plots: &[&Plot],
    [t1, t2, t3, t4, least]: [i64; 5],
    options: &Options,
    given: bool,
) -> Result<Vec<Run>, Error> {
    let thresholds = Thresholds::new(t1, t2, t3, t4)?;
    plots
        .par_iter()
        .map(|plot| {
            let mut mask = thresholds.mask(&plot.photo);
            components::remove_small(&mut mask, least.unsigned_abs() as usize);
            let detection = rows::detect(&PixelIndex::from_mask(mask.width, &mask.data));
            let mut run = Run {
                list,
                plot: plot.name.clone(),
                truth: plot.truth.len(),
                found: 0,
                f1_auto: 0.0,
                f1_given: 0.0,
                spacing_px: 0.0,
                true_spacing_px: 4.0 * plot.radii_px[0],
            };
            let f1 = |found: &Canopy| -> Result<f64, Error> {
                let at: Vec<[f64; 2]> = found.plants.iter().map(|p| p.position_px).collect();
                let score = Score::new(&at, &plot.truth, &plot.radii_px[..1])?;
                Ok(score.radii[0].f1.unwrap_or(0.0))
            };
            if let Ok(found) = canopy::locate(&mask, &detection, None, options) {
                run.f1_auto = f1(&found)?;
                (run.found, run.spacing_px) = (found.plants.len(), found.median_gap_px());
            }
            if given {
                let count = Some(plot.truth.len());
                if let Ok(found) = canopy::locate(&mask, &detection, count, options) {
                    run.f1_given = f1(&found)?;
                }
            }
            Ok(run)
        })
        .collect()
}

fn mean(runs: &[Run], f: impl Fn(&Run) -> f64) -> f64 {
    runs.iter().map(f).sum::<f64>() / runs.len().max(1) as f64
}

#[expect(clippy::print_stdout, reason = "the table is the output")]
fn show(text: &str) {
    println!("{text}");
}
