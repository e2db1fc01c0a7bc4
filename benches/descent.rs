//! One sweep of coordinate descent on 1e5 and 1e6 leaf pixels, and a whole descent on 1e5.
//!
//! Prints the cost per pixel before and after beside the times: a fast sweep that descends nothing
//! is worth nothing.

#![allow(clippy::print_stdout, reason = "a bench reports on stdout")]

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rowgram::{
    descent::{CoordinateDescentOptions, Descent, run},
    engine::Engine,
    problems::plants::{Field, Model, Plants, Prior, index::PixelIndex, lines::Axes, start},
};

/// Plants of eight leaves in rows 50 px apart, 14 px apart in the row, until there are enough
/// pixels; about 200 each.
fn field(pixels: usize) -> (Plants, Field) {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let side = (pixels as f64 / 200.0 * 14.0 * 50.0).sqrt();
    let (rows, per_row) = ((side / 50.0) as usize, (side / 14.0) as usize);
    let mut set = Vec::new();
    for row in 0..rows {
        for k in 0..per_row {
            let centre = [30.0 + 14.0 * k as f64, 30.0 + 50.0 * row as f64];
            for _ in 0..8 {
                let (angle, length) = (
                    std::f64::consts::TAU * rng.random::<f64>(),
                    12.0 + 10.0 * rng.random::<f64>(),
                );
                for step in 0..40 {
                    let r = length * f64::from(step) / 40.0;
                    let (u, v) = (centre[0] + r * angle.cos(), centre[1] + r * angle.sin());
                    set.push([u as u32, v as u32]);
                    set.push([u as u32 + 1, v as u32]);
                }
            }
        }
    }
    set.sort_unstable();
    set.dedup();
    let index = PixelIndex::new(&set);
    let plants = rows * per_row;
    let positions = start::kmeans_plus_plus(&index, plants, &mut rng);
    let axes = Axes { origin_px: [0.0; 2], heading_rad: 0.0 };
    let lines: Vec<f64> = (0..rows).map(|row| 30.0 + 50.0 * row as f64).collect();
    let model = Model { prior: Prior::Rows, ..Model::default() };
    match Plants::new(index, plants, model, axes)
        .and_then(|problem| problem.field(positions, &lines, &[]).map(|field| (problem, field)))
    {
        Ok(posed) => posed,
        Err(error) => panic!("{error}"),
    }
}

fn sweeps(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("descent");
    group.sample_size(10);
    for (name, pixels) in [("1e5", 100_000), ("1e6", 1_000_000)] {
        let (problem, start) = field(pixels);
        let count = problem.index().len() as f64;
        group.bench_function(format!("one sweep, {name} pixels"), |bencher| {
            bencher.iter_batched(
                || {
                    let (mut engine, mut x) =
                        (Descent::new(CoordinateDescentOptions::default()), start.clone());
                    let cost = engine.start(&problem, &mut x);
                    (engine, x, cost)
                },
                |(mut engine, mut x, _)| engine.step(&problem, &mut x),
                BatchSize::LargeInput,
            );
        });
        let mut x = start.clone();
        match run(&problem, &mut x, CoordinateDescentOptions::default(), 1, |_, _| ()) {
            Ok(outcome) => println!(
                "    quality: {} plants, {count} pixels, cost per pixel {:.5} -> {:.5}",
                x.positions_px.len(),
                outcome.initial_cost / count,
                outcome.final_cost / count,
            ),
            Err(error) => println!("    failed: {error}"),
        }
    }
    let (problem, start) = field(100_000);
    group.bench_function("to convergence, 1e5 pixels", |bencher| {
        bencher.iter_batched(
            || start.clone(),
            |mut x| run(&problem, &mut x, CoordinateDescentOptions::default(), 1000, |_, _| ()),
            BatchSize::LargeInput,
        );
    });
    let mut x = start.clone();
    if let Ok(outcome) = run(&problem, &mut x, CoordinateDescentOptions::default(), 1000, |_, _| ())
    {
        let count = problem.index().len() as f64;
        println!(
            "    quality: {} sweeps, cost per pixel {:.5} -> {:.5}, {}",
            outcome.iterations,
            outcome.initial_cost / count,
            outcome.final_cost / count,
            outcome.stop.explain(),
        );
    }
    group.finish();
}

criterion_group!(benches, sweeps);
criterion_main!(benches);
