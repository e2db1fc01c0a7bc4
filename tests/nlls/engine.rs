//! The engine on problems small enough to know the answer.

use super::toys::{Decay, PointPair, SeenDirection, normal};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rowgram::{
    engine::{Engine, SolveError},
    geometry::rotation,
    nlls::{
        BlockId, Euclidean, Factors, GaussianPrior, LeastSquares, LinearSolver, Loss, Method,
        Options, Problem, check::check_jacobian, manifold, solve,
    },
};

const LINEAR: [LinearSolver; 3] = [LinearSolver::Dense, LinearSolver::Sparse, LinearSolver::Schur];
const METHODS: [Method; 2] = [Method::LevenbergMarquardt, Method::Dogleg];

fn decay(noise: f64, loss: Loss) -> (Problem, BlockId) {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut problem = Problem::new();
    let block = problem.block("curve", Euclidean(2), &[1.0, 0.1]).unwrap();
    let factors = (0..40)
        .map(|k| {
            let t = 0.1 * k as f64;
            let y = 5.0 * (-1.3 * t).exp() + noise * normal(&mut rng);
            Decay { block: [block], t, y }
        })
        .collect();
    problem.add("samples", loss, Factors(factors)).unwrap();
    (problem, block)
}

#[test]
fn exact_samples_give_the_exact_curve() {
    for method in METHODS {
        for linear in LINEAR {
            let (problem, block) = decay(0.0, Loss::Trivial);
            let mut x = problem.start();
            let options = Options { method, linear, ..Options::default() };
            let summary = solve(&problem, &mut x, &options, 100).unwrap();
            assert!(summary.stop.converged(), "{method:?} {linear:?}: {summary}");
            let values = problem.values(&x, block);
            assert!((values[0] - 5.0).abs() < 1e-8 && (values[1] - 1.3).abs() < 1e-8, "{values:?}");
        }
    }
}

#[test]
fn a_robust_loss_forgets_outliers_that_least_squares_believes() {
    let fit = |loss| {
        let (mut problem, block) = decay(0.01, loss);
        let wild = (0..8).map(|k| Decay { block: [block], t: 0.4 * k as f64, y: 30.0 }).collect();
        problem.add("wild", loss, Factors(wild)).unwrap();
        let mut x = problem.start();
        solve(&problem, &mut x, &Options::default(), 200).unwrap();
        (problem.values(&x, block)[0] - 5.0).abs()
    };
    assert!(fit(Loss::Trivial) > 1.0);
    for loss in [Loss::Huber(0.05), Loss::SoftL1(0.05), Loss::Cauchy(0.05)] {
        assert!(fit(loss) < 0.05, "{loss}: {}", fit(loss));
    }
}

#[test]
fn a_similarity_is_recovered_from_exact_point_pairs() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let (q, t, s) = (rotation::exp([0.4, -0.7, 1.1]), [10.0, -3.0, 2.0], 2.5);
    for method in METHODS {
        let mut problem = Problem::new();
        let start = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        let block = problem.block("similarity", manifold::Similarity, &start).unwrap();
        let pairs = (0..10)
            .map(|_| {
                let from: [f64; 3] = [0, 1, 2].map(|_| normal(&mut rng));
                let turned = rotation::rotate(q, from);
                PointPair { block: [block], from, to: [0, 1, 2].map(|k| s * turned[k] + t[k]) }
            })
            .collect();
        problem.add("pairs", Loss::Trivial, Factors(pairs)).unwrap();
        let mut x = problem.start();
        solve(&problem, &mut x, &Options { method, ..Options::default() }, 100).unwrap();
        let found = problem.values(&x, block);
        for (a, b) in found.iter().zip(q.iter().chain(&t).chain(&[s])) {
            assert!((a - b).abs() < 1e-8, "{method:?}: {found:?}");
        }
    }
}

/// Directions seen from turned frames, the first of which is held.
fn directions(linear: LinearSolver) -> (Problem, Vec<f64>, Vec<f64>) {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let mut problem = Problem::new();
    let turns: Vec<_> = (0..4)
        .map(|k| rotation::exp([0, 1, 2].map(|_| k as f64 * 0.3 * rng.random::<f64>())))
        .collect();
    let seen: Vec<_> = (0..9)
        .map(|_| {
            let v: [f64; 3] = [0, 1, 2].map(|_| normal(&mut rng));
            let norm = v.iter().map(|c| c * c).sum::<f64>().sqrt();
            v.map(|c| c / norm)
        })
        .collect();
    let frames: Vec<_> = turns
        .iter()
        .enumerate()
        .map(|(k, q)| {
            let start = if k == 0 { *q } else { rotation::IDENTITY };
            problem.block("frame", manifold::Rotation, &start).unwrap()
        })
        .collect();
    problem.fix(frames[0]);
    let mut truth: Vec<f64> = turns.iter().flatten().copied().collect();
    let blocks: Vec<_> = seen
        .iter()
        .map(|d| {
            truth.extend(d);
            let mut off = [d[0] + 0.1, d[1] - 0.1, d[2]];
            let norm = off.iter().map(|c| c * c).sum::<f64>().sqrt();
            off.iter_mut().for_each(|c| *c /= norm);
            let block = problem.block("direction", manifold::UnitVector, &off).unwrap();
            problem.eliminate(block);
            block
        })
        .collect();
    let mut factors = Vec::new();
    for (frame, q) in frames.iter().zip(&turns) {
        for (direction, d) in blocks.iter().zip(&seen) {
            let measured = rotation::rotate(*q, *d);
            factors.push(SeenDirection { blocks: [*frame, *direction], measured });
        }
    }
    problem.add("sightings", Loss::Trivial, Factors(factors)).unwrap();
    let mut x = problem.start();
    solve(&problem, &mut x, &Options { linear, ..Options::default() }, 50).unwrap();
    (problem, x, truth)
}

#[test]
fn rotations_and_directions_are_recovered_by_every_linear_solver() {
    for linear in LINEAR {
        let (_, x, truth) = directions(linear);
        for (a, b) in x.iter().zip(&truth) {
            assert!((a - b).abs() < 1e-8, "{linear:?}");
        }
    }
}

#[test]
fn fixed_blocks_and_entries_keep_their_bits() {
    let (mut problem, block) = decay(0.01, Loss::Trivial);
    problem.fix_entries(block, &[1]).unwrap();
    let mut x = problem.start();
    let summary = solve(&problem, &mut x, &Options::default(), 50).unwrap();
    assert_eq!(x[1].to_bits(), 0.1f64.to_bits());
    assert_ne!(x[0], 1.0);
    assert_eq!(summary.parameters, 1);
    let (problem, x, truth) = directions(LinearSolver::Schur);
    assert_eq!(x[..4], truth[..4]);
    assert_eq!(problem.parameter_count(), 3 * 3 + 9 * 2);
}

#[test]
fn steps_never_raise_the_cost_and_infeasible_trials_are_refused() {
    for method in METHODS {
        let (problem, _) = decay(0.05, Loss::Trivial);
        // From here the first trials overflow or leave the domain.
        let mut x = vec![1e-3, -20.0];
        let mut engine =
            LeastSquares::new(Options { method, initial_damping: 1e-12, ..Options::default() });
        let mut cost = engine.start(&problem, &mut x).unwrap();
        let mut refused = 0;
        for _ in 0..300 {
            let before = x.clone();
            let step = engine.step(&problem, &mut x).unwrap();
            assert!(step.cost <= cost);
            if !step.accepted {
                assert_eq!(before, x);
                refused += 1;
            }
            cost = step.cost;
            if step.stop.is_some() {
                break;
            }
        }
        assert!(refused > 0, "{method:?} met no bad trial: the test tests nothing");
    }
}

#[test]
fn a_start_that_cannot_be_evaluated_is_an_error() {
    let (problem, _) = decay(0.0, Loss::Trivial);
    let mut x = vec![1.0, -100.0];
    let error = LeastSquares::new(Options::default()).start(&problem, &mut x).unwrap_err();
    assert!(matches!(error, SolveError::InfeasibleStart(_)), "{error}");
    assert!(error.to_string().contains("curve 0"), "{error}");
    let mut x = vec![f64::MAX, 0.1];
    let error = LeastSquares::new(Options::default()).start(&problem, &mut x).unwrap_err();
    assert!(matches!(error, SolveError::NotFinite(_)), "{error}");
}

#[test]
fn misuse_is_named() {
    let mut problem = Problem::new();
    assert!(problem.block("b", Euclidean(0), &[]).is_err());
    assert!(problem.block("b", Euclidean(65), &[0.0; 65]).is_err());
    let a = problem.block("a", Euclidean(1), &[0.0]).unwrap();
    let b = problem.block("b", Euclidean(2), &[0.0; 2]).unwrap();
    let prior = |block, of: usize| {
        GaussianPrior::new(&problem, block, &vec![1.0; of], &vec![1.0; of]).unwrap()
    };
    let (of_a, of_b) = (prior(a, 1), prior(b, 2));
    let one = || Factors(vec![of_a.clone()]);
    let none: Vec<GaussianPrior> = Vec::new();
    assert!(problem.add("none", Loss::Trivial, Factors(none)).is_err());
    let mixed = vec![of_a.clone(), of_b];
    assert!(problem.add("mixed", Loss::Trivial, Factors(mixed)).is_err());
    assert!(problem.add("loss", Loss::Huber(-1.0), one()).is_err());
    assert!(problem.fix_entries(b, &[2]).is_err());
    problem.add("prior", Loss::Trivial, one()).unwrap();
    assert!(problem.add("prior", Loss::Trivial, one()).is_err());
    let mut x = problem.start();
    let error = solve(&problem, &mut x, &Options::default(), 10).unwrap_err();
    assert!(error.to_string().contains("nothing is observed of b 0"), "{error}");
    problem.fix(b);
    let summary = solve(&problem, &mut x, &Options::default(), 10).unwrap();
    assert!((x[0] - 1.0).abs() < 1e-12 && summary.stop.converged(), "{summary}");
    problem.fix(a);
    assert!(solve(&problem, &mut x, &Options::default(), 10).is_err());
}

#[test]
fn two_eliminated_blocks_in_one_factor_are_refused() {
    let mut problem = Problem::new();
    let frame = problem.block("frame", manifold::Rotation, &rotation::IDENTITY).unwrap();
    let direction = problem.block("direction", manifold::UnitVector, &[0.0, 0.0, 1.0]).unwrap();
    let sighting = SeenDirection { blocks: [frame, direction], measured: [0.0, 0.0, 1.0] };
    problem.add("sightings", Loss::Trivial, Factors(vec![sighting])).unwrap();
    problem.eliminate(frame);
    problem.eliminate(direction);
    let mut x = problem.start();
    let error = solve(&problem, &mut x, &Options::default(), 5).unwrap_err().to_string();
    assert!(error.contains("joins frame 0 and direction 0, which are both"), "{error}");
}

proptest! {
    #[test]
    fn toy_jacobians_match_differences(
        v in prop::array::uniform8(-1.0..1.0f64),
        w in prop::array::uniform3(-1.5..1.5f64),
    ) {
        let mut problem = Problem::new();
        let a = problem.block("a", Euclidean(1), &[0.0]).unwrap();
        let b = problem.block("b", Euclidean(1), &[0.0]).unwrap();
        let q = rotation::exp(w);
        let direction = {
            let norm = (v[0] * v[0] + v[1] * v[1] + 1.0).sqrt();
            [v[0] / norm, v[1] / norm, 1.0 / norm]
        };
        let similarity = [q[0], q[1], q[2], q[3], v[3], v[4], v[5], v[6].exp()];
        let sighting = SeenDirection { blocks: [a, b], measured: [0.3, 0.2, 0.1] };
        let pair = PointPair { block: [a], from: [v[0], v[1], v[2]], to: [1.0, 2.0, 3.0] };
        let checks = [
            check_jacobian(&sighting, &[&manifold::Rotation, &manifold::UnitVector], &[&q, &direction]),
            check_jacobian(&pair, &[&manifold::Similarity], &[&similarity]),
            check_jacobian(&Decay { block: [a], t: 0.7, y: 1.0 }, &[&Euclidean(2)], &[&v[..2]]),
        ];
        for check in checks {
            let check = check.unwrap();
            prop_assert!(check.error < 1e-8, "{check:?}");
        }
    }
}

/// `a x + b y - c` with a Jacobian that may be broken.
struct Line {
    blocks: [BlockId; 1],
    rows: usize,
    broken: bool,
}

impl rowgram::nlls::Factor for Line {
    fn rows(&self) -> usize {
        self.rows
    }

    fn blocks(&self) -> &[BlockId] {
        &self.blocks
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut rowgram::nlls::Jacobian<'_>>,
    ) -> Result<(), rowgram::nlls::Infeasible> {
        residual.fill(x[0][0] - 1.0);
        if let Some(jacobian) = jacobian {
            (0..self.rows).for_each(|k| {
                jacobian.row(k)[0] = if self.broken { f64::NAN } else { 1.0 };
            });
        }
        Ok(())
    }
}

#[test]
fn factors_of_different_lengths_are_refused() {
    let mut problem = Problem::new();
    let block = problem.block("x", Euclidean(1), &[0.0]).unwrap();
    let line = |rows| Line { blocks: [block], rows, broken: false };
    let error = problem.add("lines", Loss::Trivial, Factors(vec![line(1), line(2)])).unwrap_err();
    assert!(error.to_string().contains("factor 1 has 2 rows, factor 0 has 1"), "{error}");
}

#[test]
fn a_jacobian_that_is_not_a_number_is_named() {
    for method in METHODS {
        for linear in LINEAR {
            let mut problem = Problem::new();
            let block = problem.block("x", Euclidean(1), &[0.0]).unwrap();
            let line = |broken| Line { blocks: [block], rows: 1, broken };
            let lines = Factors(vec![line(false), line(true)]);
            problem.add("lines", Loss::Trivial, lines).unwrap();
            let options = Options { method, linear, ..Options::default() };
            let error = solve(&problem, &mut problem.start(), &options, 50).unwrap_err();
            assert!(matches!(error, SolveError::NotFinite(_)), "{method:?} {linear:?}: {error}");
            assert!(error.to_string().contains("the Jacobian of factor 1 of \"lines\""), "{error}");
        }
    }
}
