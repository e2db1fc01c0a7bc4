//! How the time of the locator for closed canopies grows with the field: a quarter, half, the whole
//! and twice of one mask, cut and stacked across the rows.

use crate::{Folders, locate::make};
use rowgram::{
    Error,
    io::{images, output, points},
    phenotype::{
        row_model::{self, RowModelOptions},
        rows,
    },
    problems::plants::index::PixelIndex,
    raster::Mask,
    score::Score,
};
use std::{fmt::Write as _, time::Instant};

/// Runs the experiment.
pub(crate) fn run(folders: &Folders) -> Result<(), Error> {
    make(&folders.out)?;
    let path = folders.data.join("field_masks/whole_field/1000.png");
    let truth = points::read(&path.with_extension("csv"))?;
    let clock = Instant::now();
    let whole = images::read_mask(&path)?;
    let read = clock.elapsed().as_secs_f64();
    let mut text = format!(
        "# A whole field, number of plants not given\n\nReading {read:.2} s.\n\n| part | leaf pixels \
         | plants | found | rows s | plants s | peak MB | F1 5 cm | F1 10 cm |\n\
         |---|---|---|---|---|---|---|---|---|\n"
    );
    for share in [0.25, 0.5, 1.0, 2.0] {
        let height = (share * whole.height as f64) as usize;
        let mask = Mask::from_fn(whole.width, height, |u, v| whole.get(u, v % whole.height));
        let mut truth: Vec<[f64; 2]> = truth.clone();
        if share > 1.0 {
            let above: Vec<[f64; 2]> =
                truth.iter().map(|at| [at[0], at[1] + whole.height as f64]).collect();
            truth.extend(above);
        }
        truth.retain(|at| at[1] < height as f64 - 0.5);
        let clock = Instant::now();
        let index = PixelIndex::from_mask(mask.width, &mask.data);
        let detection = rows::detect(&index);
        let detected = clock.elapsed().as_secs_f64();
        let clock = Instant::now();
        let found = row_model::locate(&mask, &detection, None, &RowModelOptions::default())?;
        let located = clock.elapsed().as_secs_f64();
        let at: Vec<[f64; 2]> = found.plants.iter().map(|plant| plant.position_px).collect();
        let score = Score::new(&at, &truth, &[0.05 / 0.015, 0.10 / 0.015])?;
        let f1 = |k: usize| score.radii[k].f1.unwrap_or(0.0);
        // Writing to a string does not fail.
        let _ = writeln!(
            text,
            "| {share} | {} | {} | {} | {detected:.2} | {located:.2} | {:.0} | {:.3} | {:.3} |",
            index.len(),
            truth.len(),
            at.len(),
            peak_memory_mb(),
            f1(0),
            f1(1)
        );
    }
    let path = folders.out.join("row_model_time.md");
    output::write(&path, true, |writer| writer.write_all(text.as_bytes()))?;
    show(&text);
    Ok(())
}

/// The most memory this process has used so far; not a number where the system does not tell.
fn peak_memory_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|line| line.trim().strip_suffix("kB")?.trim().parse().ok());
    kilobytes.map_or(f64::NAN, |kb: f64| kb / 1024.0)
}

#[expect(clippy::print_stdout, reason = "the table is the output")]
fn show(text: &str) {
    println!("{text}");
}
