//! A run that is stopped and resumed anywhere makes the same steps, to the bit.

use rowgram_optim::{
    engine::Engine,
    lanes::Lane,
    nlls::{
        BatchPath, Dim, Euclidean, Infeasible, LeastSquares, Linearized, LinearizedProjection,
        Loss, Measurement, Method, Options, Problem, ProjectionBatch, ProjectionFactor, Residual,
        Residuals, Scalar, SolverState, Vector, solve,
    },
};

/// `(|X - S| - d) / sigma` with station `S` and target `X`.
struct Distance;

impl ProjectionFactor for Distance {
    type Residual = Dim<1>;
    type Camera = Dim<2>;
    type Shared = Dim<0>;
    type Point = Dim<2>;
    type Prepared = Dim<2>;
    type Data = Dim<2>;

    fn prepare(station: &[f64], _: &[f64]) -> [f64; 2] {
        [station[0], station[1]]
    }

    #[inline(always)]
    fn linearize<L: Lane>(s: &[L; 2], x: &[L; 2], data: &[L; 2]) -> Linearized<Self, L> {
        let [east, north] = [x[0] - s[0], x[1] - s[1]];
        let length = east.mul_add(east, north * north).sqrt();
        let towards = [east / length * data[1], north / length * data[1]];
        LinearizedProjection {
            residual: [(length - data[0]) * data[1]],
            jacobian_camera: [[-towards[0], -towards[1]]],
            jacobian_shared: [[]],
            jacobian_point: [towards],
        }
    }
}

/// Where a station is believed to be.
struct Believed([f64; 2], f64);

impl Residual<2> for Believed {
    type Blocks = (Vector<2>,);
    fn evaluate<T: Scalar>(&self, (at,): ([T; 2],)) -> Result<[T; 2], Infeasible> {
        Ok([0, 1].map(|k| (at[k] - self.0[k]) / self.1))
    }
}

/// Stations and targets far from where they belong, with three batches beside the fused one: their costs are added in
/// another order when a start is evaluated than when a trial is.
fn network() -> Problem {
    let stations = [[0.0, 0.0], [50.0, 2.0], [48.0, 40.0], [-3.0, 42.0]];
    let mut problem = Problem::new();
    let mut kept = Vec::new();
    for (k, [e, n]) in (0u8..).zip(stations) {
        let off = 0.7 * f64::from(k);
        kept.push(problem.block("station", Euclidean(2), &[e + off, n - off]).unwrap());
    }
    let mut measured = Vec::new();
    for k in 0..60_u32 {
        let x = [f64::from(k % 8) * 5.3, 8.1 + f64::from(k / 8) * 4.7];
        let off = 3.0 * f64::from(k % 7) - 9.0;
        let target = problem.block("target", Euclidean(2), &[x[0] + off, x[1] - off]).unwrap();
        problem.eliminate(target);
        for (c, (&station, s)) in (0u32..).zip(kept.iter().zip(stations)) {
            let error = 0.01 * (f64::from((17 * k + 5 * c) % 11) - 5.0);
            let length = (x[0] - s[0]).hypot(x[1] - s[1]) + error;
            measured.push(Measurement::new(station, target, [length, 1.0 / 0.013]));
        }
    }
    problem.add("distances", Loss::Cauchy(2.0), ProjectionBatch::new(Distance, measured)).unwrap();
    for (name, sigma) in [("plan", 0.37), ("log book", 1.3), ("memory", 7.7)] {
        let believed = kept.iter().zip(stations).map(|(&block, at)| ([block], Believed(at, sigma)));
        problem.add(name, Loss::Huber(1.7), Residuals::new(believed)).unwrap();
    }
    problem
}

fn reread(state: &SolverState) -> SolverState {
    serde_json::from_str(&serde_json::to_string(state).unwrap()).unwrap()
}

#[test]
fn a_resumed_run_makes_the_same_steps_with_several_batches() {
    let problem = network();
    let path = solve(&problem, &mut problem.start(), &Options::default(), 1).unwrap();
    assert_eq!(path.batches[0].path, Some(BatchPath::Fused), "the test tests nothing");
    for method in [Method::LevenbergMarquardt, Method::Dogleg] {
        let options = Options { method, cost_tolerance: 1e-14, ..Options::default() };
        let mut engine = LeastSquares::new(options.clone());
        let mut x = problem.start();
        engine.start(&problem, &mut x).unwrap();
        for step in 0..12 {
            let mut resumed = LeastSquares::new(options.clone());
            let mut copy = x.clone();
            resumed.resume(&problem, &mut copy, reread(&engine.state())).unwrap();
            let there = resumed.step(&problem, &mut copy).unwrap();
            let here = engine.step(&problem, &mut x).unwrap();
            let bits = |x: &[f64]| x.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(&x), bits(&copy), "{method:?}, step {step}");
            assert_eq!(engine.state(), resumed.state(), "{method:?}, step {step}");
            let numbers = |step: &rowgram_optim::engine::Step| {
                let metrics = step.metrics.iter().map(|(_, value)| value.to_bits());
                metrics.chain([step.cost.to_bits()]).collect::<Vec<_>>()
            };
            assert_eq!(numbers(&here), numbers(&there), "{method:?}, step {step}");
            if here.stop.is_some() {
                break;
            }
        }
    }
}

#[test]
fn a_checkpoint_of_another_problem_shows_by_its_cost() {
    let problem = network();
    let mut x = problem.start();
    let mut engine = LeastSquares::new(Options::default());
    let cost = engine.start(&problem, &mut x).unwrap();
    let mut moved = x.clone();
    moved[0] += 1.0;
    let found = engine.resume(&problem, &mut moved, engine.state()).unwrap();
    assert!((found - cost).abs() > 1e-3 * cost, "{found} {cost}");
}
