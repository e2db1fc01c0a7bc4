//! What counts as an end, and what does not.

use rowgram_optim::{
    descent::{ActiveSet, BlockCost, CoordinateDescentOptions, Descent, run},
    engine::{Engine, SolveError, Termination},
    nlls::{
        BlockId, Curvature, Dual, Euclidean, Factor, Factors, Infeasible, Jacobian, LeastSquares,
        LinearSolver, Loss, Method, Options, Problem, Residual, Residuals, Scalar, Vector,
        covariance::null_space, solve,
    },
};

/// `x + y - 1 + k z`: the point `(x, y)` is determined along one direction only.
struct Sum(f64);

impl Residual<1> for Sum {
    type Blocks = (Vector<1>, Vector<2>);
    fn evaluate<T: Scalar>(&self, (z, point): ([T; 1], [T; 2])) -> Result<[T; 1], Infeasible> {
        Ok([point[0] + point[1] - 1.0 + z[0] * self.0])
    }
}

#[test]
fn an_elimination_that_fails_is_damped_and_is_no_convergence() {
    let mut problem = Problem::new();
    let z = problem.block("z", Euclidean(1), &[5.0]).unwrap();
    let point = problem.block("point", Euclidean(2), &[3.0, 4.0]).unwrap();
    problem.eliminate(point);
    problem.add("sum", Loss::Trivial, Residuals::new([([z, point], Sum(1.0))])).unwrap();
    // So small that the second pivot of the point is 0.
    let options = Options { initial_damping: 1e-20, ..Options::default() };
    let mut x = problem.start();
    let mut engine = LeastSquares::new(options.clone());
    engine.start(&problem, &mut x).unwrap();
    let first = engine.step(&problem, &mut x).unwrap();
    assert!(!first.accepted && first.stop.is_none(), "{first:?}");
    let summary = solve(&problem, &mut problem.start(), &options, 100).unwrap();
    assert!(summary.stop.converged() && summary.final_cost < 1e-12, "{summary}");
}

/// `x - 1` whose Jacobian has a NaN.
struct Broken([BlockId; 1]);

impl Factor for Broken {
    fn rows(&self) -> usize {
        1
    }
    fn blocks(&self) -> &[BlockId] {
        &self.0
    }
    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        residual[0] = x[0][0] - 1.0;
        if let Some(jacobian) = jacobian {
            jacobian.row(0)[0] = f64::NAN;
        }
        Ok(())
    }
}

#[test]
fn no_direction_is_undetermined_where_the_jacobian_is_no_number() {
    let mut problem = Problem::new();
    let x = problem.block("x", Euclidean(1), &[0.0]).unwrap();
    problem.add("broken", Loss::Trivial, Factors(vec![Broken([x])])).unwrap();
    let error = null_space(&problem, &problem.start(), LinearSolver::Schur).unwrap_err();
    assert!(matches!(error, SolveError::NotFinite(_)), "{error}");
    assert!(error.to_string().contains("the Jacobian of factor 0 of \"broken\""), "{error}");
}

#[test]
fn a_power_of_nothing_is_one_and_does_not_change() {
    let power = Dual::<1>::variable(0.0, 0).powi(0);
    assert_eq!((power.value, power.derivatives), (1.0, [0.0]));
    let linear = Dual::<1>::variable(0.0, 0).powi(1);
    assert_eq!((linear.value, linear.derivatives), (0.0, [1.0]));
}

#[test]
fn options_are_named_as_they_are_written() {
    let mut problem = Problem::new();
    let x = problem.block("x", Euclidean(1), &[0.0]).unwrap();
    problem.add("broken", Loss::Trivial, Factors(vec![Broken([x])])).unwrap();
    let options = Options { min_relative_decrease: 2.0, ..Options::default() };
    let error = solve(&problem, &mut problem.start(), &options, 1).unwrap_err().to_string();
    let keys = serde_json::to_value(Options::default()).unwrap();
    let key = error.split(' ').next().unwrap().to_owned();
    assert!(keys.get(&key).is_some(), "{error}");
}

/// It has a meaning at 10 only: steps are refused again and again.
struct Wall;

impl Residual<1> for Wall {
    type Blocks = (Vector<1>,);
    fn evaluate<T: Scalar>(&self, (x,): ([T; 1],)) -> Result<[T; 1], Infeasible> {
        if x[0].value() == 10.0 { Ok([x[0]]) } else { Err(Infeasible) }
    }
}

#[test]
fn the_share_of_the_curvature_vanishes_after_a_few_refusals() {
    let mut problem = Problem::new();
    let x = problem.block("x", Euclidean(1), &[10.0]).unwrap();
    problem.add("wall", Loss::Cauchy(1.0), Residuals::new([([x], Wall)])).unwrap();
    for method in [Method::LevenbergMarquardt, Method::Dogleg] {
        // Adaptive starts at no curvature; a state with some is what a good step leaves.
        let options = Options { method, curvature: Curvature::Adaptive, ..Options::default() };
        let mut x = problem.start();
        let mut engine = LeastSquares::new(options.clone());
        engine.start(&problem, &mut x).unwrap();
        let mut state = serde_json::to_value(engine.state()).unwrap();
        state["curvature_share"] = serde_json::json!(0.9);
        let state = serde_json::from_value(state).unwrap();
        engine.resume(&problem, &mut x, state).unwrap();
        let shares: Vec<f64> = (0..10)
            .map(|_| {
                let step = engine.step(&problem, &mut x).unwrap();
                let share = step.metrics.iter().find(|(name, _)| *name == "curvature_share");
                assert!(!step.accepted);
                share.unwrap().1
            })
            .collect();
        assert_eq!(shares.last(), Some(&0.0), "{method:?}: {shares:?}");
    }
}

/// Blocks that walk away from the optimum and say that they do not.
struct Liar(usize);

impl BlockCost for Liar {
    type Iterate = Vec<f64>;
    fn len(&self) -> usize {
        self.0
    }
    fn prepare(&self, _: &mut Vec<f64>) -> Result<(), SolveError> {
        Ok(())
    }
    fn cost(&self, x: &Vec<f64>) -> f64 {
        1.0 + x.iter().map(|v| v * v).sum::<f64>()
    }
    fn monotone(&self) -> bool {
        true
    }
    fn update(&self, x: &mut Vec<f64>, block: usize, active: &mut ActiveSet) -> f64 {
        x[block] += 1.0;
        active.mark(block);
        1.0
    }
    fn end_sweep(&self, _: &mut Vec<f64>, _: &mut ActiveSet) {}
}

#[test]
fn a_cost_that_rises_where_it_must_not_is_no_convergence() {
    for cost_tolerance in [0.0, 1e-6] {
        let options =
            CoordinateDescentOptions { cost_tolerance, ..CoordinateDescentOptions::default() };
        let outcome = run(&Liar(3), &mut vec![0.0; 3], options, 50, |_, _| ()).unwrap();
        assert_eq!((outcome.stop, outcome.iterations), (Termination::Stalled, 1));
        assert!(!outcome.stop.converged());
    }
}

#[test]
fn a_descent_that_was_not_started_makes_no_step() {
    let mut engine = Descent::default();
    let error = engine.step(&Liar(3), &mut vec![0.0; 3]).unwrap_err();
    assert!(matches!(error, SolveError::Misuse(_)), "{error}");
    // Nor one that was started on another problem.
    engine.start(&Liar(2), &mut vec![0.0; 2]).unwrap();
    let error = engine.step(&Liar(3), &mut vec![0.0; 3]).unwrap_err();
    assert!(matches!(error, SolveError::Misuse(_)), "{error}");
}

#[test]
fn what_no_factor_depends_on_is_fixed_on_demand() {
    let mut problem = Problem::new();
    let [a, b] = ["a", "b"].map(|name| problem.block(name, Euclidean(1), &[3.0]).unwrap());
    let point = problem.block("point", Euclidean(2), &[0.0; 2]).unwrap();
    problem.eliminate(point);
    struct One;
    impl Residual<1> for One {
        type Blocks = (Vector<1>,);
        fn evaluate<T: Scalar>(&self, (x,): ([T; 1],)) -> Result<[T; 1], Infeasible> {
            Ok([x[0] - 1.0])
        }
    }
    problem.add("one", Loss::Trivial, Residuals::new([([a], One)])).unwrap();
    let mut x = problem.start();
    assert!(solve(&problem, &mut x, &Options::default(), 10).is_err());
    assert_eq!(problem.fix_unused(), [b, point]);
    solve(&problem, &mut x, &Options::default(), 10).unwrap();
    assert!((x[0] - 1.0).abs() < 1e-9);
    assert_eq!(x[1..], [3.0, 0.0, 0.0]);
}
