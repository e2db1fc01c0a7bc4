//! Covariances: against Monte Carlo, against dense inversion, and the words for a missing rank.

use super::toys::{Decay, network, normal};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rowgram::{
    nlls::{
        BlockId, Euclidean, Factors, GaussianPrior, LinearSolver, Loss, Options, Problem,
        covariance::Covariance, solve,
    },
    problems::bundle::{Bundle, InteriorSharing, Network},
};
use statrs::distribution::{ChiSquared, ContinuousCDF};

/// Holds the first camera, the lens and the scale of a block.
fn hold(bundle: &mut Bundle) {
    let camera = bundle.camera(0);
    bundle.problem.fix(camera);
    let second = bundle.camera(1);
    bundle.problem.fix_entries(second, &[3]).unwrap();
    for k in 1..4 {
        let lens = bundle.camera(k);
        bundle.problem.fix_entries(lens, &[6, 7, 8]).unwrap();
    }
}

fn held(network: &Network) -> Bundle {
    let mut bundle = Bundle::new(network, InteriorSharing::PerImage, Loss::Trivial).unwrap();
    hold(&mut bundle);
    bundle
}

#[test]
fn normalised_errors_of_many_adjustments_follow_chi_square() {
    let sigma_px = 0.3;
    let truth = network(21, 2, 40, 0.0);
    let mut rng = ChaCha8Rng::seed_from_u64(22);
    let runs = 200;
    let (mut camera_sum, mut point_sum) = (0.0, 0.0);
    for _ in 0..runs {
        let mut noisy = truth.clone();
        for observation in &mut noisy.observations {
            observation.image_px.iter_mut().for_each(|v| *v += sigma_px * normal(&mut rng));
        }
        let bundle = held(&noisy);
        let (camera, point) = (bundle.camera(3), bundle.point(7));
        let start = bundle.problem.start();
        let mut x = start.clone();
        solve(&bundle.problem, &mut x, &Options::default(), 30).unwrap();
        let mut covariance = Covariance::new(&bundle.problem, &x, LinearSolver::Schur).unwrap();
        for (block, free, sum) in [(camera, 6, &mut camera_sum), (point, 3, &mut point_sum)] {
            let space = bundle.problem.manifold(block);
            let mut error = vec![0.0; space.tangent()];
            space.minus(
                bundle.problem.values(&start, block),
                bundle.problem.values(&x, block),
                &mut error,
            );
            let n = space.tangent();
            let c = covariance.block(block);
            let matrix =
                nalgebra::DMatrix::from_fn(free, free, |i, j| sigma_px.powi(2) * c[i * n + j]);
            let error = nalgebra::DVector::from_column_slice(&error[..free]);
            *sum += error.dot(&matrix.cholesky().unwrap().solve(&error));
        }
    }
    for (sum, freedom) in [(camera_sum, 6), (point_sum, 3)] {
        let chi = ChiSquared::new(f64::from(runs * freedom)).unwrap();
        let (low, high) = (chi.inverse_cdf(0.0005), chi.inverse_cdf(0.9995));
        assert!((low..high).contains(&sum), "{sum} outside {low} .. {high}");
    }
}

#[test]
fn every_linear_solver_gives_the_same_blocks_and_cross_blocks() {
    let network = network(31, 2, 30, 0.4);
    let bundle = held(&network);
    let x = bundle.problem.start();
    let pairs: Vec<(BlockId, BlockId)> = vec![
        (bundle.camera(1), bundle.camera(1)),
        (bundle.camera(2), bundle.camera(3)),
        (bundle.camera(2), bundle.point(4)),
        (bundle.point(4), bundle.camera(2)),
        (bundle.point(4), bundle.point(4)),
        (bundle.point(4), bundle.point(9)),
        (bundle.camera(0), bundle.point(9)),
    ];
    let all: Vec<Vec<Vec<f64>>> = [LinearSolver::Dense, LinearSolver::Sparse, LinearSolver::Schur]
        .iter()
        .map(|&linear| {
            let mut covariance = Covariance::new(&bundle.problem, &x, linear).unwrap();
            pairs.iter().map(|&(a, b)| covariance.cross(a, b)).collect()
        })
        .collect();
    for (k, dense) in all[0].iter().enumerate() {
        let size = dense.iter().fold(0.0, |most: f64, v| v.abs().max(most));
        for other in [&all[1][k], &all[2][k]] {
            for (a, b) in dense.iter().zip(other) {
                assert!((a - b).abs() <= 1e-7 * size, "pair {k}: {a} {b}");
            }
        }
    }
    // Transposed pairs.
    for i in 0..9 {
        for j in 0..3 {
            let (a, b) = (all[2][2][i * 3 + j], all[2][3][j * 9 + i]);
            assert!((a - b).abs() <= 1e-9 * a.abs().max(1e-12), "{a} {b}");
        }
    }
    // What is fixed has no variance.
    assert!(all[2][6].iter().all(|&v| v == 0.0));
    assert!((0..9).all(|k| all[2][0][3 * 9 + k] == 0.0));
}

#[test]
fn a_curve_has_the_textbook_covariance() {
    let mut problem = Problem::new();
    let block = problem.block("curve", Euclidean(2), &[5.0, 1.3]).unwrap();
    let times: Vec<f64> = (0..30).map(|k| 0.1 * f64::from(k)).collect();
    let factors = times.iter().map(|&t| Decay { block: [block], t, y: 0.0 }).collect();
    problem.add("samples", Loss::Trivial, Factors(factors)).unwrap();
    let x = problem.start();
    let found = Covariance::new(&problem, &x, LinearSolver::Dense).unwrap().block(block);
    let (mut aa, mut ab, mut bb) = (0.0, 0.0, 0.0);
    for t in times {
        let (a, b) = ((-1.3 * t).exp(), -t * 5.0 * (-1.3 * t).exp());
        (aa, ab, bb) = (aa + a * a, ab + a * b, bb + b * b);
    }
    let det = aa * bb - ab * ab;
    for (a, b) in found.iter().zip([bb / det, -ab / det, -ab / det, aa / det]) {
        assert!((a / b - 1.0).abs() < 1e-10, "{found:?}");
    }
}

#[test]
fn a_free_gauge_is_named_with_its_seven_directions() {
    let network = network(41, 2, 40, 0.2);
    let mut bundle = Bundle::new(&network, InteriorSharing::PerImage, Loss::Trivial).unwrap();
    for k in 0..4 {
        let camera = bundle.camera(k);
        bundle.problem.fix_entries(camera, &[6, 7, 8]).unwrap();
    }
    let x = bundle.problem.start();
    let error = Covariance::new(&bundle.problem, &x, LinearSolver::Schur).unwrap_err().to_string();
    assert!(
        error.contains("leave 7 direction(s) undetermined") && error.contains("camera"),
        "{error}"
    );
    hold(&mut bundle);
    Covariance::new(&bundle.problem, &x, LinearSolver::Schur).unwrap();
}

#[test]
fn a_point_seen_once_is_named() {
    let mut network = network(51, 2, 30, 0.0);
    let mut first = true;
    network.observations.retain(|o| o.point != 5 || std::mem::take(&mut first));
    let bundle = held(&network);
    let x = bundle.problem.start();
    let error = Covariance::new(&bundle.problem, &x, LinearSolver::Schur).unwrap_err().to_string();
    assert!(error.contains("point 5 is not determined"), "{error}");
}

#[test]
fn parameters_that_only_appear_together_are_named() {
    /// `a + b - y`: only the sum is seen.
    struct Sum([BlockId; 2]);
    impl rowgram::nlls::Factor for Sum {
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
            jacobian: Option<&mut rowgram::nlls::Jacobian<'_>>,
        ) -> Result<(), rowgram::nlls::Infeasible> {
            residual[0] = x[0][0] + x[1][0] - 3.0;
            if let Some(jacobian) = jacobian {
                jacobian.row(0).copy_from_slice(&[1.0, 1.0]);
            }
            Ok(())
        }
    }
    let mut problem = Problem::new();
    let a = problem.block("K0", Euclidean(1), &[0.0]).unwrap();
    let b = problem.block("principal distance", Euclidean(1), &[0.0]).unwrap();
    let c = problem.block("other", Euclidean(1), &[0.0]).unwrap();
    problem.add("sums", Loss::Trivial, Factors(vec![Sum([a, b]), Sum([a, b])])).unwrap();
    let prior = |block| GaussianPrior::new(&problem, block, &[1.0], &[0.1]).unwrap();
    let [of_a, of_c] = [a, c].map(prior);
    problem.add("prior", Loss::Trivial, Factors(vec![of_c])).unwrap();
    let x = problem.start();
    let error = Covariance::new(&problem, &x, LinearSolver::Sparse).unwrap_err().to_string();
    assert!(error.contains("K0 0") && error.contains("principal distance 0"), "{error}");
    assert!(!error.contains("other"), "{error}");
    problem.add("a", Loss::Trivial, Factors(vec![of_a])).unwrap();
    let mut covariance = Covariance::new(&problem, &x, LinearSolver::Sparse).unwrap();
    let variance = covariance.block(b)[0];
    assert!((variance - (0.01 + 0.5)).abs() < 1e-12, "{variance}");
}
