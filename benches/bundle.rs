//! Bundle adjustment, iteration by iteration: how fast, and how good.
//!
//! Runs on a synthetic nadir block, and on the file named by `ROWGRAM_BAL` where it is set. The
//! quality reached is printed beside the times.

#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "a bench that cannot go on fails")]

use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use data_synth::block::{Block, BlockConfig};
use rowgram::{
    engine::Engine,
    io::bal,
    nlls::{LeastSquares, Loss, Method, Options, solve},
    problems::bundle::{Bundle, InteriorSharing, Network},
};

fn synthetic(images: usize, points: usize) -> Network {
    let config = BlockConfig { images, points, sigma_px: 0.5, ..BlockConfig::default() };
    let block = Block::fly(&config).unwrap();
    let mut file = Vec::new();
    data_synth::block::write_bal(
        &block.cameras_start,
        &block.points_start,
        &block.observations,
        &mut file,
    )
    .unwrap();
    bal::parse(std::str::from_utf8(&file).unwrap()).unwrap()
}

fn networks() -> Vec<(String, Network)> {
    let mut networks = vec![("50 images".to_owned(), synthetic(50, 10_000))];
    if let Some(path) = std::env::var_os("ROWGRAM_BAL") {
        let name = std::path::Path::new(&path).file_stem().unwrap().to_string_lossy().into_owned();
        networks.push((name, bal::read(path.as_ref()).unwrap()));
    }
    networks
}

fn iterations(criterion: &mut Criterion) {
    for (name, network) in networks() {
        let mut group = criterion.benchmark_group(format!("one iteration on {name}"));
        group.throughput(Throughput::Elements(network.observations.len() as u64));
        group.sample_size(20);
        for sharing in [InteriorSharing::PerImage, InteriorSharing::Shared] {
            for method in [Method::LevenbergMarquardt, Method::Dogleg] {
                let bundle = Bundle::new(&network, sharing, Loss::Trivial).unwrap();
                let start = bundle.problem.start();
                let options = Options { method, ..Options::default() };
                let mut x = start.clone();
                let summary = solve(&bundle.problem, &mut x, &options, 50).unwrap();
                eprintln!(
                    "{name}, {sharing:?}, {method:?}: cost {:.6e} -> {:.6e} in {} iterations, rmse {:.4} px",
                    summary.initial_cost,
                    summary.final_cost,
                    summary.iterations,
                    summary.batches[0].rmse
                );
                let mut engine = LeastSquares::new(options);
                group.bench_function(format!("{sharing:?}, {method:?}"), |b| {
                    b.iter_batched(
                        || start.clone(),
                        |mut x| {
                            engine.start(&bundle.problem, &mut x).unwrap();
                            engine.step(&bundle.problem, &mut x).unwrap().cost
                        },
                        BatchSize::LargeInput,
                    );
                });
            }
        }
    }
}

criterion_group!(benches, iterations);
criterion_main!(benches);
