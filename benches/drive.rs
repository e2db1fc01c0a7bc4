//! What driving costs: a loop over `Engine::step` against the same steps under the driver.
//!
//! The toy engine does next to nothing, so that the difference of the two times, divided by the
//! number of steps, is the price per iteration. The quality is the final cost, which must be the
//! same to the last bit.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use rowgram::{
    drive::{Drive, Limits},
    engine::{Engine, SolveError, Step},
};
use std::hint::black_box;

const STEPS: u64 = 10_000;

/// Gradient descent on 1/2 |x|^2 in three dimensions, with as many metrics as asked for.
struct Descent {
    metrics: usize,
}

const METRICS: [(&str, f64); 4] =
    [("damping", 1e-4), ("gradient", 0.5), ("evaluations", 2.0), ("active", 3.0)];

fn cost(x: &[f64; 3]) -> f64 {
    0.5 * (x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
}

impl Engine<f64> for Descent {
    type Iterate = [f64; 3];
    type State = ();
    const NAME: &'static str = "descent";

    fn start(&mut self, _rate: &f64, x: &mut [f64; 3]) -> Result<f64, SolveError> {
        Ok(cost(x))
    }

    fn step(&mut self, rate: &f64, x: &mut [f64; 3]) -> Result<Step, SolveError> {
        for value in &mut *x {
            *value *= 1.0 - rate;
        }
        let metrics = METRICS[..self.metrics].to_vec();
        Ok(Step { cost: cost(x), step_norm: *rate, accepted: true, stop: None, metrics })
    }

    fn state(&self) {}

    fn resume(&mut self, rate: &f64, x: &mut [f64; 3], (): ()) -> Result<f64, SolveError> {
        self.start(rate, x)
    }
}

const START: [f64; 3] = [1.0, -2.0, 3.0];
const RATE: f64 = 1e-4;

fn plain(metrics: usize) -> f64 {
    let (mut engine, mut x) = (Descent { metrics }, START);
    let mut cost = engine.start(&RATE, &mut x).unwrap_or(f64::NAN);
    for _ in 0..STEPS {
        if let Ok(step) = engine.step(&RATE, &mut x) {
            cost = black_box(step).cost;
        }
    }
    cost
}

fn driven(metrics: usize) -> f64 {
    let drive = Drive::new(&RATE, Descent { metrics }, START).limits(Limits::iterations(STEPS));
    drive.run().map_or(f64::NAN, |outcome| outcome.final_cost)
}

fn watched(metrics: usize) -> f64 {
    let mut seen = 0;
    let drive = Drive::new(&RATE, Descent { metrics }, START)
        .limits(Limits::iterations(STEPS))
        .on_step(|event| seen = black_box(event.iteration));
    drive.run().map_or(f64::NAN, |outcome| outcome.final_cost)
}

fn traced(metrics: usize) -> f64 {
    let Ok(folder) = tempfile::tempdir() else { return f64::NAN };
    let drive = Drive::new(&RATE, Descent { metrics }, START)
        .limits(Limits::iterations(STEPS))
        .trace(folder.path().join("trace.csv"));
    drive.run().map_or(f64::NAN, |outcome| outcome.final_cost)
}

/// The name and the run to be timed.
type Way = (&'static str, fn(usize) -> f64);

fn overhead(criterion: &mut Criterion) {
    const WAYS: [Way; 4] =
        [("plain", plain), ("driven", driven), ("watched", watched), ("traced", traced)];
    for metrics in [0, METRICS.len()] {
        let mut group = criterion.benchmark_group(format!("{STEPS} steps, {metrics} metrics"));
        group.throughput(Throughput::Elements(STEPS)).sample_size(20);
        let reference = plain(metrics);
        for (name, run) in WAYS {
            let reached = run(metrics);
            assert_eq!(reached.to_bits(), reference.to_bits(), "{name}");
            group.bench_function(format!("{name} (cost {reached:.6e})"), |bencher| {
                bencher.iter(|| black_box(run(black_box(metrics))));
            });
        }
        group.finish();
    }
}

criterion_group!(benches, overhead);
criterion_main!(benches);
