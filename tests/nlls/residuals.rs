//! Residuals over dual numbers, losses of one's own, and the path that each batch takes.

use super::toys::{network, perturb};
use proptest::prelude::*;
use rowgram::{
    engine::Engine,
    geometry::rotation,
    nlls::{
        BatchPath, BlockId, Euclidean, Factors, GaussianPrior, Infeasible, LeastSquares,
        LinearSolver, Loss, LossFunction, Method, Options, Problem, Residual, Residuals, Rho,
        Scalar, Vector,
        check::{check_batch, check_loss},
        manifold,
        residual::{DirectionBlock, PoseBlock, RigidTransform, RotationBlock, RotationMatrix},
        solve,
    },
    problems::bundle::{Bundle, InteriorSharing, TIE_POINTS},
};

/// A bit of everything: 6 + 3 + 3 + 2 degrees of freedom, more than one evaluation gives.
struct Everything;

impl Residual<3> for Everything {
    type Blocks = (PoseBlock, Vector<3>, RotationBlock, DirectionBlock);
    fn evaluate<T: Scalar>(
        &self,
        (pose, x, turn, direction): (RigidTransform<T>, [T; 3], RotationMatrix<T>, [T; 3]),
    ) -> Result<[T; 3], Infeasible> {
        let y = turn.rotate(pose.transform(x));
        let back = pose.transform_back(y);
        if y[2].value() > 100.0 {
            return Err(Infeasible);
        }
        Ok([
            // Away from the cut of the angle, which differences would step over.
            y[0].atan2(y[1] * y[1] + 1.0) * direction[0],
            (back[0] * back[0] + back[1] * back[1] + 1.0).sqrt() + direction[1] * direction[2],
            turn.between(&pose.rotation).rotate(x)[1] - direction[2],
        ])
    }
}

proptest! {
    #[test]
    fn dual_numbers_give_derivatives_by_every_tangent(
        w in prop::array::uniform3(-1.0..1.0f64),
        v in prop::array::uniform3(-1.0..1.0f64),
        t in prop::array::uniform3(1.0..2.0f64),
        d in prop::array::uniform3(0.2..1.0f64),
    ) {
        let (q, p) = (rotation::exp(w), rotation::exp(v));
        let length = d.iter().map(|v| v * v).sum::<f64>().sqrt();
        let mut problem = Problem::new();
        let pose = problem
            .block("pose", manifold::Pose, &[q[0], q[1], q[2], q[3], t[0], t[1], t[2]])
            .unwrap();
        let x = problem.block("x", Euclidean(3), &[2.0, t[2], t[0]]).unwrap();
        let turn = problem.block("turn", manifold::Rotation, &p).unwrap();
        let direction =
            problem.block("direction", manifold::UnitVector, &d.map(|v| v / length)).unwrap();
        let batch = Residuals::new([([pose, x, turn, direction], Everything)]);
        problem.add("everything", Loss::Trivial, batch).unwrap();
        let check = check_batch(&problem, &problem.start(), "everything", 0..1).unwrap();
        prop_assert!(check.error < 1e-7, "{check:?}");
    }
}

/// A line with a slope derived by hand, rightly or wrongly.
struct ByHand(f64);

impl Residual<1> for ByHand {
    type Blocks = (Vector<1>,);
    fn evaluate<T: Scalar>(&self, (x,): ([T; 1],)) -> Result<[T; 1], Infeasible> {
        Ok([x[0] * 3.0 - 1.0])
    }
    fn jacobian(&self, _: ([f64; 1],), jacobian: &mut rowgram::nlls::Jacobian<'_>) -> bool {
        jacobian.row(0)[0] = self.0;
        true
    }
}

#[test]
fn jacobians_by_hand_are_used_and_compared_with_dual_numbers() {
    let mut problem = Problem::new();
    let x = problem.block("x", Euclidean(1), &[0.0]).unwrap();
    let batch = Residuals::new([([x], ByHand(3.0)), ([x], ByHand(2.5))]);
    assert!(batch.check_derivatives(0, &[&[0.3]]).unwrap() < 1e-15);
    assert!(batch.check_derivatives(1, &[&[0.3]]).unwrap() > 0.1);
    problem.add("lines", Loss::Trivial, batch).unwrap();
    let linearized = problem.linearized(&problem.start(), "lines").unwrap();
    assert_eq!([linearized[0].2[0], linearized[1].2[0]], [3.0, 2.5]);
}

#[test]
fn blocks_of_another_shape_are_refused() {
    let mut problem = Problem::new();
    // As many numbers as a pose, but as a vector.
    let seven = problem.block("seven", Euclidean(7), &[0.1; 7]).unwrap();
    let x = problem.block("x", Euclidean(3), &[0.0; 3]).unwrap();
    struct Pair;
    impl Residual<3> for Pair {
        type Blocks = (PoseBlock, Vector<3>);
        fn evaluate<T: Scalar>(
            &self,
            (pose, x): (RigidTransform<T>, [T; 3]),
        ) -> Result<[T; 3], Infeasible> {
            Ok(pose.transform(x))
        }
    }
    let batch = Residuals::new([([seven, x], Pair)]);
    let error = problem.add("pair", Loss::Trivial, batch).unwrap_err();
    assert!(error.to_string().contains("[7, 3] numbers with 9 degrees"), "{error}");
}

/// Welsch's loss.
#[derive(Debug)]
struct Welsch(f64);

impl LossFunction for Welsch {
    fn evaluate(&self, s: f64) -> Rho {
        let square = self.0 * self.0;
        let e = (-s / square).exp();
        Rho { value: square * (1.0 - e), first: e, second: -e / square }
    }
}

/// Not concave.
#[derive(Debug)]
struct Square;

impl LossFunction for Square {
    fn evaluate(&self, s: f64) -> Rho {
        Rho { value: s + s * s, first: 1.0 + 2.0 * s, second: 2.0 }
    }
}

#[test]
fn losses_are_tested_by_their_invariants() {
    for k in 1..40 {
        check_loss(&Welsch(2.0), 0.25 * f64::from(k)).unwrap();
    }
    assert!(check_loss(&Square, 1.0).unwrap_err().contains("rho''"));
}

/// A bundle with this loss, perturbed.
fn bundle(loss: Loss) -> Bundle {
    let mut start = network(61, 4, 60, 0.5);
    perturb(&mut start, 62, 1.0);
    Bundle::new(&start, InteriorSharing::Shared, loss).unwrap()
}

fn path_of(problem: &Problem, options: &Options, batch: &str) -> BatchPath {
    let summary = solve(problem, &mut problem.start(), options, 3).unwrap();
    let found = summary.batches.into_iter().find(|found| found.name == batch).unwrap();
    found.path.unwrap()
}

#[test]
fn the_summary_says_which_path_each_batch_took_and_why() {
    let options = Options::default();
    assert_eq!(path_of(&bundle(Loss::Trivial).problem, &options, TIE_POINTS), BatchPath::Fused);

    let dense = Options { linear: LinearSolver::Dense, ..options.clone() };
    // The fused batch is only one where points are eliminated first.
    assert_eq!(path_of(&bundle(Loss::Trivial).problem, &dense, TIE_POINTS), BatchPath::Dense);

    let sparse = Options { linear: LinearSolver::Sparse, ..options.clone() };
    let dogleg = Options { method: Method::Dogleg, ..options.clone() };
    for (options, reason) in [(sparse, "eliminates no block"), (dogleg, "all Jacobians at once")] {
        match path_of(&bundle(Loss::Trivial).problem, &options, TIE_POINTS) {
            BatchPath::Stored(why) => assert!(why.contains(reason), "{why}"),
            path => panic!("{path}"),
        }
    }

    // A prior leaves the tie points fused, whether it is on a block that is kept or on a point.
    let add_prior = |problem: &mut Problem, block: BlockId, name: &str| {
        let values = problem.values(&problem.start(), block).to_vec();
        let sigmas = vec![1.0; values.len()];
        let prior = GaussianPrior::new(problem, block, &values, &sigmas).unwrap();
        problem.add(name, Loss::Trivial, Factors(vec![prior])).unwrap();
    };
    let mut with_lens = bundle(Loss::Trivial);
    let lens = with_lens.lens().unwrap();
    add_prior(&mut with_lens.problem, lens, "lens");
    assert_eq!(path_of(&with_lens.problem, &options, TIE_POINTS), BatchPath::Fused);
    match path_of(&with_lens.problem, &options, "lens") {
        BatchPath::Stored(why) => assert!(why.contains("no factor depends"), "{why}"),
        path => panic!("{path}"),
    }
    let mut with_point = bundle(Loss::Trivial);
    let point = with_point.point(3);
    add_prior(&mut with_point.problem, point, "point");
    assert_eq!(path_of(&with_point.problem, &options, TIE_POINTS), BatchPath::Fused);

    // A factor that joins a point with a camera is more than a prior, and that is said.
    struct Distance;
    impl Residual<1> for Distance {
        type Blocks = (PoseBlock, Vector<3>);
        fn evaluate<T: Scalar>(
            &self,
            (pose, x): (RigidTransform<T>, [T; 3]),
        ) -> Result<[T; 1], Infeasible> {
            let [x, y, z] = pose.transform(x);
            Ok([(x * x + y * y + z * z).sqrt() - 4.0])
        }
    }
    let mut joined = bundle(Loss::Trivial);
    let blocks = [joined.camera(0), joined.point(3)];
    joined.problem.add("tape", Loss::Trivial, Residuals::new([(blocks, Distance)])).unwrap();
    match path_of(&joined.problem, &options, TIE_POINTS) {
        BatchPath::Stored(why) => assert!(why.contains("\"tape\" joins it"), "{why}"),
        path => panic!("{path}"),
    }
}

#[test]
fn priors_on_points_give_the_same_steps_fused_and_stored() {
    // One prior, two on one point, one on a point with an entry that is held; one prior outlying, with a loss.
    let posed = || {
        let mut bundle = bundle(Loss::Huber(1.0));
        let start = bundle.problem.start();
        let mut on = |of: &[(usize, f64)], name: &str, loss: Loss| {
            let priors = of.iter().map(|&(point, off)| {
                let block = bundle.point(point);
                let values = bundle.problem.values(&start, block).iter();
                let values: Vec<f64> = values.map(|v| v + off).collect();
                GaussianPrior::new(&bundle.problem, block, &values, &[0.05; 3]).unwrap()
            });
            let priors = Factors(priors.collect());
            bundle.problem.add(name, loss, priors).unwrap();
        };
        on(&[(3, 0.02), (7, -0.05), (7, 0.1)], "priors", Loss::Trivial);
        on(&[(11, 0.5), (7, 0.3)], "doubtful priors", Loss::Huber(1.0));
        bundle.problem.fix_entries(bundle.point(11), &[1]).unwrap();
        bundle
    };
    let trace = |linear| {
        let problem = posed().problem;
        let mut x = problem.start();
        let mut engine = LeastSquares::new(Options { linear, ..Options::default() });
        engine.start(&problem, &mut x).unwrap();
        let steps = (0..4).map(|_| engine.step(&problem, &mut x).unwrap());
        steps.flat_map(|step| [step.cost, step.step_norm]).collect::<Vec<f64>>()
    };
    let options = Options::default();
    assert_eq!(path_of(&posed().problem, &options, TIE_POINTS), BatchPath::Fused);
    let (fused, stored) = (trace(LinearSolver::Schur), trace(LinearSolver::Sparse));
    for (a, b) in fused.iter().zip(&stored) {
        assert!((a - b).abs() < 1e-7 * b.abs().max(1e-6), "{fused:?} {stored:?}");
    }
    // They count: without them the first step is another.
    let without = bundle(Loss::Huber(1.0)).problem;
    let mut x = without.start();
    let mut engine = LeastSquares::new(options);
    engine.start(&without, &mut x).unwrap();
    let step = engine.step(&without, &mut x).unwrap();
    assert!((step.step_norm / fused[1] - 1.0).abs() > 1e-3);
}
