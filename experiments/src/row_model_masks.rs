//! The locator for closed canopies on synthetic masks: number of plants given and not.
//!
//! `field_masks/SCENARIO/N.png` with truth in `N.csv`; 1.5 cm per pixel.

use crate::{
    Folders,
    locate::{GSD_M, Job, jobs, make},
};
use rayon::prelude::*;
use rowgram::robust::median;
use rowgram::{
    Error,
    io::{images, output, points},
    phenotype::{
        row_model::{self, RowModelOptions},
        rows,
    },
    score::Score,
};
use serde::Serialize;
use statrs::distribution::{ContinuousCDF, StudentsT};
use std::fmt::Write as _;

/// One mask, located once.
#[derive(Debug, Clone, Serialize)]
struct Run {
    scenario: String,
    image: String,
    plants: &'static str,
    truth: usize,
    found: usize,
    f1_5cm: f64,
    f1_10cm: f64,
    count_error: f64,
    in_interval: bool,
    row_spacing_cm: f64,
    true_row_spacing_cm: f64,
    spacing_cm: f64,
    true_spacing_cm: f64,
    /// Mean confidence, and how many of the plants are within a quarter of the spacing of a true one.
    confidence: f64,
    right: f64,
    /// Share of the plants matched within 10 cm inside their 95 % ellipse.
    in_ellipse: f64,
    seconds: f64,
}

/// Runs the experiment.
pub(crate) fn run(
    folders: &Folders,
    masks: usize,
    only: &[String],
    options: &RowModelOptions,
) -> Result<(), Error> {
    make(&folders.out)?;
    let mut jobs = jobs(folders, masks)?;
    jobs.retain(|(scenario, _)| only.is_empty() || only.contains(scenario));
    let runs: Vec<Vec<Run>> =
        jobs.par_iter().map(|job| both(job, options)).collect::<Result<_, Error>>()?;
    let runs: Vec<Run> = runs.into_iter().flatten().collect();
    let path = folders.out.join("row_model_masks.csv");
    output::write(&path, true, |writer| {
        let mut csv = csv::Writer::from_writer(writer);
        for run in &runs {
            csv.serialize(run)?;
        }
        csv.flush()
    })?;
    let text = markdown(&runs);
    let path = folders.out.join("row_model_masks.md");
    output::write(&path, true, |writer| writer.write_all(text.as_bytes()))?;
    show(&text);
    Ok(())
}

fn both((scenario, path): &Job, options: &RowModelOptions) -> Result<Vec<Run>, Error> {
    let mask = images::read_mask(path)?;
    let truth = points::read(&path.with_extension("csv"))?;
    let image = path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let mut runs = Vec::new();
    for plants in ["given", "auto"] {
        let clock = std::time::Instant::now();
        let detection = rows::detect(&mask);
        let count = (plants == "given").then_some(truth.len());
        let found = row_model::locate(&mask, &detection, count, options)?;
        let seconds = clock.elapsed().as_secs_f64();
        let positions: Vec<[f64; 2]> = found.plants.iter().map(|p| p.position_px).collect();
        let quarter = found.spacing.spacing / 4.0;
        let radii = [0.05 / GSD_M, 0.10 / GSD_M, quarter];
        let score = Score::new(&positions, &truth, &radii)?;
        let f1 = |k: usize| score.radii[k].f1.unwrap_or(0.0);
        let [low, high] = found.count_interval;
        let (row_spacing_px, spacing_px) = spacings(&truth, &found.rows.axes);
        let mut inside = (0.0, 0.0_f64);
        for plant in &found.plants {
            let at = plant.position_px;
            let distance = |t: &[f64; 2]| (t[0] - at[0]).hypot(t[1] - at[1]);
            let nearest = truth.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
            let Some(nearest) = nearest.filter(|t| distance(t) < radii[1]) else { continue };
            let axes = &found.rows.axes;
            let (a, b) = (axes.aligned(at), axes.aligned(*nearest));
            let along = (a[0] - b[0]) / plant.sigma_along_px;
            let across = (a[1] - b[1]) / plant.sigma_across_px;
            inside.1 += 1.0;
            // The 95 % point of chi-square with two degrees of freedom.
            inside.0 += f64::from(u8::from(along * along + across * across < 5.991));
        }
        runs.push(Run {
            scenario: scenario.clone(),
            image: image.clone(),
            plants,
            truth: truth.len(),
            found: positions.len(),
            f1_5cm: f1(0),
            f1_10cm: f1(1),
            count_error: positions.len() as f64 / truth.len() as f64 - 1.0,
            in_interval: (low..=high).contains(&(truth.len() as f64)),
            row_spacing_cm: 100.0 * GSD_M * found.rows.spacing_px.unwrap_or(0.0),
            true_row_spacing_cm: 100.0 * GSD_M * row_spacing_px,
            spacing_cm: 100.0 * GSD_M * found.median_gap_px(),
            true_spacing_cm: 100.0 * GSD_M * spacing_px,
            confidence: mean(found.plants.iter().map(|plant| plant.confidence)),
            right: score.radii[2].precision.unwrap_or(0.0),
            in_ellipse: inside.0 / inside.1.max(1.0),
            seconds,
        });
    }
    Ok(runs)
}

/// Distance between the rows of the truth, and the median distance between its neighbours in a row.
fn spacings(truth: &[[f64; 2]], axes: &rowgram::problems::plants::lines::Axes) -> (f64, f64) {
    let mut places: Vec<[f64; 2]> = truth.iter().map(|&at| axes.aligned(at)).collect();
    places.sort_by(|a, b| a[1].total_cmp(&b[1]));
    let mut rows: Vec<Vec<[f64; 2]>> = Vec::new();
    for place in places {
        match rows.last_mut().filter(|row| row.last().is_some_and(|p| place[1] - p[1] < 12.0)) {
            Some(row) => row.push(place),
            None => rows.push(vec![place]),
        }
    }
    let middles: Vec<f64> = rows.iter().map(|row| mean(row.iter().map(|p| p[1]))).collect();
    let last = middles.len() - 1;
    let mut gaps = Vec::new();
    for row in &mut rows {
        row.sort_by(|a, b| a[0].total_cmp(&b[0]));
        gaps.extend(row.windows(2).map(|pair| pair[1][0] - pair[0][0]));
    }
    let median = median(gaps).unwrap_or(0.0);
    ((middles[last] - middles[0]) / last.max(1) as f64, median)
}

fn markdown(runs: &[Run]) -> String {
    let mut text = String::from(
        "# Plants in closed canopies, synthetic masks\n\nMeans over the masks of a scenario, and \
         half the 95 % interval of the mean for F1 at 5 cm. Spacings: mean absolute error in cm, \
         between rows and (median) within rows.\n\n| scenario | plants | F1 5 cm | F1 10 cm | count \
         error % | mean abs % | in interval | rows cm | spacing cm | confidence | right | in 95 % \
         ellipse | s |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let mut names: Vec<&str> = runs.iter().map(|run| run.scenario.as_str()).collect();
    names.dedup();
    for plants in ["given", "auto"] {
        for name in &names {
            let mine: Vec<&Run> =
                runs.iter().filter(|run| run.scenario == *name && run.plants == plants).collect();
            let of = |f: fn(&Run) -> f64| mean(mine.iter().map(|run| f(run)));
            let (f1, count) = (of(|run| run.f1_5cm), mine.len() as f64);
            let square = mean(mine.iter().map(|run| (run.f1_5cm - f1).powi(2)));
            let t = StudentsT::new(0.0, 1.0, (count - 1.0).max(1.0));
            let t = t.map_or(f64::NAN, |t| t.inverse_cdf(0.975));
            let half = t * (square / (count - 1.0).max(1.0)).sqrt();
            // Writing to a string does not fail.
            let _ = writeln!(
                text,
                "| {name} | {plants} | {f1:.3} ± {half:.3} | {:.3} | {:+.2} | {:.2} | {:.2} | {:.2} \
                 | {:.2} | {:.3} | {:.3} | {:.2} | {:.2} |",
                of(|run| run.f1_10cm),
                100.0 * of(|run| run.count_error),
                100.0 * of(|run| run.count_error.abs()),
                of(|run| f64::from(u8::from(run.in_interval))),
                of(|run| (run.row_spacing_cm - run.true_row_spacing_cm).abs()),
                of(|run| (run.spacing_cm - run.true_spacing_cm).abs()),
                of(|run| run.confidence),
                of(|run| run.right),
                of(|run| run.in_ellipse),
                of(|run| run.seconds),
            );
        }
    }
    text
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), x| (sum + x, count + 1.0));
    sum / count
}

#[expect(clippy::print_stdout, reason = "the table is the output")]
fn show(text: &str) {
    println!("{text}");
}
