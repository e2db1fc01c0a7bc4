//! What every engine promises its driver: resumed anywhere, it ends in the same bytes.
//!
//! [`check_resume`] is for the tests of all engines; the two toys below show it, one monotone with
//! momentum in its memory, one not monotone with a random generator in it.

use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use rowgram::{
    drive::{Drive, Limits},
    engine::{Engine, SolveError, Step, Termination},
};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

/// What one step left behind, in bits, so that NaN equals NaN and -0 differs from 0.
#[derive(Debug, PartialEq)]
struct Footprint {
    cost: u64,
    step_norm: u64,
    accepted: bool,
    stop: Option<Termination>,
    metrics: Vec<(&'static str, u64)>,
    iterate: String,
}

fn footprint<X: Serialize>(step: &Step, x: &X) -> Footprint {
    Footprint {
        cost: step.cost.to_bits(),
        step_norm: step.step_norm.to_bits(),
        accepted: step.accepted,
        stop: step.stop,
        metrics: step.metrics.iter().map(|(name, value)| (*name, value.to_bits())).collect(),
        iterate: serde_json::to_string(x).unwrap(),
    }
}

/// Through the bytes of a checkpoint and back.
fn reread<T: Serialize + DeserializeOwned>(value: &T) -> T {
    let mut bytes = Vec::new();
    ciborium::into_writer(value, &mut bytes).unwrap();
    ciborium::from_reader(bytes.as_slice()).unwrap()
}

/// Checks the engine's and the driver's promise: stopped after any number of the first `steps`
/// steps and resumed by a fresh engine, from memory and through a checkpoint file, the run goes on
/// as if nothing had been.
pub(crate) fn check_resume<P: ?Sized, E: Engine<P>>(
    make_engine: impl Fn() -> E,
    problem: &P,
    start: E::Iterate,
    steps: usize,
) {
    let mut engine = make_engine();
    let mut x = start.clone();
    engine.start(problem, &mut x).unwrap();
    let mut moments = vec![(x.clone(), engine.state(), None)];
    let mut whole = Vec::new();
    for _ in 0..steps {
        let step = engine.step(problem, &mut x).unwrap();
        whole.push(footprint(&step, &x));
        moments.push((x.clone(), engine.state(), Some(step.cost)));
        if step.stop.is_some() {
            break;
        }
    }
    for (k, (x, memory, cost)) in moments.iter().enumerate() {
        let (mut x, mut engine) = (reread(x), make_engine());
        let resumed_cost = engine.resume(problem, &mut x, reread(memory)).unwrap();
        if let Some(cost) = cost {
            assert_eq!(resumed_cost.to_bits(), cost.to_bits(), "cost when resumed after {k} steps");
        }
        for (i, expected) in whole.iter().enumerate().skip(k) {
            let step = engine.step(problem, &mut x).unwrap();
            assert_eq!(&footprint(&step, &x), expected, "step {i}, resumed after {k} steps");
        }
    }
    check_driven_resume(make_engine, problem, start, whole.len() as u64);
}

/// The same through the driver: outcome and trace, stopped and resumed at every iteration.
fn check_driven_resume<P: ?Sized, E: Engine<P>>(
    make_engine: impl Fn() -> E,
    problem: &P,
    start: E::Iterate,
    steps: u64,
) {
    let folder = tempfile::tempdir().unwrap();
    let trace = folder.path().join("trace.csv");
    let saved = folder.path().join("run.checkpoint");
    let drive = |limit: u64| {
        Drive::new(problem, make_engine(), start.clone())
            .limits(Limits::iterations(limit))
            .trace(&trace)
            .force(true)
            .fingerprint(7)
    };
    let summary = |outcome: rowgram::drive::DriveOutcome<E::Iterate>| {
        assert!(
            outcome.error.is_none() && outcome.file_error.is_none(),
            "{outcome:?}",
            outcome = outcome.brief()
        );
        let log: Vec<_> =
            outcome.log.iter().map(|entry| (entry.iteration, entry.best_cost.to_bits())).collect();
        let bits = [outcome.initial_cost, outcome.final_cost, outcome.best_cost].map(f64::to_bits);
        let counts = (outcome.iterations, outcome.best_iteration, outcome.stop);
        let iterates = serde_json::to_string(&outcome.x).unwrap();
        (iterates, bits, counts, log, trace_without_seconds(&trace))
    };
    let whole = summary(drive(steps).run().unwrap());
    for k in 0..=steps {
        drive(k).checkpoint(&saved, 0).run().unwrap();
        let resumed = drive(steps).resume_from(&saved).run().unwrap();
        assert_eq!(summary(resumed), whole, "driven, resumed after {k} of {steps} steps");
    }
}

/// The trace but for its one column that no two runs share.
pub(crate) fn trace_without_seconds(path: &std::path::Path) -> Vec<Vec<String>> {
    let mut reader = csv::Reader::from_path(path).unwrap();
    let seconds = reader.headers().unwrap().iter().position(|name| name == "seconds").unwrap();
    let mut rows = vec![reader.headers().unwrap().clone()];
    rows.extend(reader.records().map(Result::unwrap));
    let others = |row: &csv::StringRecord| {
        let cells = row.iter().enumerate().filter(|(column, _)| *column != seconds);
        cells.map(|(_, cell)| cell.to_owned()).collect()
    };
    rows.iter().map(others).collect()
}

/// A quadratic bowl: cost = 1/2 sum `weights[i] x[i]^2`, with its smallest value at the origin.
#[derive(Debug, Clone)]
pub(crate) struct Bowl {
    pub(crate) weights: Vec<f64>,
}

impl Bowl {
    pub(crate) fn new(size: usize) -> Bowl {
        Bowl { weights: (1..=size).map(|i| i as f64).collect() }
    }

    pub(crate) fn cost(&self, x: &[f64]) -> f64 {
        0.5 * self.weights.iter().zip(x).map(|(weight, x)| weight * x * x).sum::<f64>()
    }
}

/// Nesterov's accelerated gradient with restart whenever the cost would grow: monotone.
#[derive(Debug, Default)]
pub(crate) struct Accelerated {
    memory: Momentum,
    cost: f64,
}

/// Where the last iterate was, and the step counter that sets the momentum.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Momentum {
    before: Vec<f64>,
    count: u64,
    /// Infinite until the first step: memories may hold numbers that JSON cannot.
    last_movement: f64,
}

impl Engine<Bowl> for Accelerated {
    type Iterate = Vec<f64>;
    type State = Momentum;
    const NAME: &'static str = "accelerated";

    fn start(&mut self, problem: &Bowl, x: &mut Vec<f64>) -> Result<f64, SolveError> {
        self.memory = Momentum { before: x.clone(), count: 0, last_movement: f64::INFINITY };
        self.cost = problem.cost(x);
        if !self.cost.is_finite() {
            return Err(SolveError::InfeasibleStart("the cost is not finite".to_owned()));
        }
        Ok(self.cost)
    }

    fn step(&mut self, problem: &Bowl, x: &mut Vec<f64>) -> Result<Step, SolveError> {
        let Momentum { before, count, last_movement } = &mut self.memory;
        let rate = 1.0 / problem.weights.iter().fold(1.0, |a: f64, b| a.max(*b));
        let momentum = *count as f64 / (*count as f64 + 3.0);
        let ahead = |i: usize| x[i] + momentum * (x[i] - before[i]);
        let next: Vec<f64> =
            (0..x.len()).map(|i| ahead(i) * (1.0 - rate * problem.weights[i])).collect();
        let cost = problem.cost(&next);
        let accepted = cost <= self.cost;
        if accepted {
            *last_movement = next.iter().zip(&*x).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            *before = std::mem::replace(x, next);
            *count += 1;
            self.cost = cost;
        } else {
            before.clone_from(x);
            *count = 0;
        }
        let stop = (*last_movement < 1e-9).then_some(Termination::StepConverged);
        let metrics = vec![("momentum", momentum)];
        Ok(Step { cost: self.cost, step_norm: *last_movement, accepted, stop, metrics })
    }

    fn state(&self) -> Momentum {
        self.memory.clone()
    }

    fn resume(
        &mut self,
        problem: &Bowl,
        x: &mut Vec<f64>,
        memory: Momentum,
    ) -> Result<f64, SolveError> {
        self.memory = memory;
        self.cost = problem.cost(x);
        Ok(self.cost)
    }
}

/// A walk that goes uphill one time in three: not monotone, with the generator as its memory.
#[derive(Debug)]
pub(crate) struct Wanderer {
    generator: ChaCha8Rng,
}

impl Wanderer {
    pub(crate) fn new(seed: u64) -> Wanderer {
        Wanderer { generator: ChaCha8Rng::seed_from_u64(seed) }
    }
}

impl Engine<Bowl> for Wanderer {
    type Iterate = Vec<f64>;
    type State = ChaCha8Rng;
    const NAME: &'static str = "wanderer";

    fn start(&mut self, problem: &Bowl, x: &mut Vec<f64>) -> Result<f64, SolveError> {
        Ok(problem.cost(x))
    }

    fn step(&mut self, problem: &Bowl, x: &mut Vec<f64>) -> Result<Step, SolveError> {
        let before = problem.cost(x);
        let place = self.generator.random_range(0..x.len());
        let by: f64 = self.generator.random_range(-0.5..0.5);
        x[place] += by;
        let cost = problem.cost(x);
        let accepted = cost <= before || self.generator.random_bool(1.0 / 3.0);
        if !accepted {
            x[place] -= by;
        }
        let cost = problem.cost(x);
        let step_norm = if accepted { by.abs() } else { 0.0 };
        Ok(Step { cost, step_norm, accepted, stop: None, metrics: vec![("place", place as f64)] })
    }

    fn state(&self) -> ChaCha8Rng {
        self.generator.clone()
    }

    fn resume(
        &mut self,
        problem: &Bowl,
        x: &mut Vec<f64>,
        memory: ChaCha8Rng,
    ) -> Result<f64, SolveError> {
        self.generator = memory;
        Ok(problem.cost(x))
    }
}

#[test]
fn an_engine_with_momentum_resumes_anywhere() {
    check_resume(Accelerated::default, &Bowl::new(5), vec![1.0, -2.0, 3.0, 0.5, 0.1], 60);
}

#[test]
fn an_engine_that_is_not_monotone_resumes_anywhere() {
    check_resume(|| Wanderer::new(1), &Bowl::new(3), vec![1.0, -2.0, 3.0], 40);
}

#[test]
#[should_panic(expected = "resumed after 1 steps")]
fn an_engine_that_forgets_is_found_out() {
    /// Leaves its momentum out of its memory.
    struct Forgetful(Accelerated);
    impl Engine<Bowl> for Forgetful {
        type Iterate = Vec<f64>;
        type State = ();
        const NAME: &'static str = "forgetful";
        fn start(&mut self, problem: &Bowl, x: &mut Vec<f64>) -> Result<f64, SolveError> {
            self.0.start(problem, x)
        }
        fn step(&mut self, problem: &Bowl, x: &mut Vec<f64>) -> Result<Step, SolveError> {
            self.0.step(problem, x)
        }
        fn state(&self) {}
        fn resume(&mut self, problem: &Bowl, x: &mut Vec<f64>, _: ()) -> Result<f64, SolveError> {
            self.0.start(problem, x)
        }
    }
    let forgetful = || Forgetful(Accelerated::default());
    check_resume(forgetful, &Bowl::new(3), vec![1.0, -2.0, 3.0], 10);
}
