//! How long a whole field takes, uncropped, and how good it is.

use crate::{Folders, locate::make};
use rowgram::{
    Error, descent,
    io::{images, output, points},
    phenotype::{
        locate::{Init, PlantFitOptions, Setup},
        rows,
    },
    problems::plants::{Form, Model, PlantUpdate, Prior, SigmaRule, index::PixelIndex},
    score::Score,
};
use std::{fmt::Write as _, time::Instant};

/// Runs the experiment.
pub(crate) fn run(folders: &Folders) -> Result<(), Error> {
    make(&folders.out)?;
    let path = folders.data.join("field_masks/whole_field/1000.png");
    let truth = points::read(&path.with_extension("csv"))?;
    let clock = Instant::now();
    let mask = images::read_mask(&path)?;
    let read = clock.elapsed().as_secs_f64();
    let clock = Instant::now();
    let index = PixelIndex::from_mask(mask.width, &mask.data);
    let sorted = clock.elapsed().as_secs_f64();
    let clock = Instant::now();
    let detection = rows::detect(&index);
    let detected = clock.elapsed().as_secs_f64();
    // Writing to a string does not fail.
    let mut text = format!(
        "# A whole field: {} plants, {} leaf pixels\n\nReading {read:.2} s, sorting the pixels \
         {sorted:.2} s, finding the rows {detected:.2} s.\n\n",
        truth.len(),
        index.len()
    );
    let _ = writeln!(
        text,
        "| start | prior, update | start s | descent s | sweeps | updates | us per update | \
         cost per pixel | F1 5 cm | F1 10 cm |\n|---|---|---|---|---|---|---|---|---|---|"
    );
    for (init, prior, update) in [
        (Init::Rows, Prior::Rows, PlantUpdate::Median),
        (Init::KmeansPlusPlus, Prior::Rows, PlantUpdate::Median),
        (Init::KmeansPlusPlus, Prior::None, PlantUpdate::Median),
        (Init::KmeansPlusPlus, Prior::None, PlantUpdate::Mean),
    ] {
        let model = Model {
            prior,
            update,
            form: Form::Joint,
            sigma: SigmaRule::Paper,
            floor_px: 2.0 / 3.0,
            ..Model::default()
        };
        let descent = descent::CoordinateDescentOptions::default();
        let options = PlantFitOptions {
            plants: truth.len(),
            model,
            init,
            seed: 1,
            descent,
            max_sweeps: 1000,
        };
        let clock = Instant::now();
        let mut setup = Setup::with_rows(index.clone(), &options, detection.clone())?;
        let started = clock.elapsed().as_secs_f64();
        let clock = Instant::now();
        let mut updates = 0.0;
        let outcome = descent::run(
            &setup.problem,
            &mut setup.field,
            options.descent,
            options.max_sweeps,
            |_, step| updates += step.metrics.first().map_or(0.0, |note| note.1),
        )?;
        let (sweeps, cost) = (outcome.iterations, outcome.final_cost);
        let seconds = clock.elapsed().as_secs_f64();
        let count = index.len() as f64;
        let located = setup.finish();
        let found: Vec<[f64; 2]> = located.plants.iter().map(|p| p.position_px).collect();
        let score = Score::new(&found, &truth, &[0.05 / 0.015, 0.10 / 0.015])?;
        let f1 = |k: usize| score.radii[k].f1.unwrap_or(0.0);
        let _ = writeln!(
            text,
            "| {init:?} | {prior:?}, {update:?} | {started:.2} | {seconds:.2} | {sweeps} | \
             {updates} | {:.1} | {:.4} -> {:.4} | {:.3} | {:.3} |",
            1e6 * seconds / updates,
            outcome.initial_cost / count,
            cost / count,
            f1(0),
            f1(1)
        );
    }
    let path = folders.out.join("whole_field.md");
    output::write(&path, true, |writer| writer.write_all(text.as_bytes()))?;
    show(&text);
    Ok(())
}

#[expect(clippy::print_stdout, reason = "the table is the output")]
fn show(text: &str) {
    println!("{text}");
}
