//! Bundle adjustment: factors, solvers against each other, exact and real blocks.

use super::toys::{network, perturb};
use crate::data;
use proptest::prelude::*;
use rowgram::{
    engine::Engine,
    geometry::rotation,
    io::bal,
    nlls::{
        BatchPath, LeastSquares, LinearSolver, Loss, Method, Options, Summary, check::check_batch,
        solve,
    },
    problems::bundle::{Bundle, Camera, InteriorSharing, Network, Observation, TIE_POINTS},
};

proptest! {
    #[test]
    fn reprojection_jacobians_match_differences(
        w in prop::array::uniform3(-1.5..1.5f64),
        t in prop::array::uniform3(-0.3..0.3f64),
        x in prop::array::uniform3(-1.0..1.0f64),
        k in prop::array::uniform2(-0.2..0.2f64),
        behind in any::<bool>(),
    ) {
        // In front or behind: the formula holds for both.
        let depth = if behind { 4.0 } else { -4.0 };
        let network = Network {
            cameras: vec![Camera {
                rotation_rad: w,
                translation: [t[0], t[1], t[2] + depth],
                interior: [3.0, k[0], k[1]],
            }],
            points: vec![x],
            observations: vec![Observation { camera: 0, point: 0, image_px: [0.2, -0.1] }],
        };
        for sharing in [InteriorSharing::PerImage, InteriorSharing::Shared] {
            let bundle = Bundle::new(&network, sharing, Loss::Trivial).unwrap();
            let start = bundle.problem.start();
            let check = check_batch(&bundle.problem, &start, TIE_POINTS, 0..1).unwrap();
            prop_assert!(check.error < 1e-8, "{check:?}");
        }
    }
}

#[test]
fn the_fused_path_takes_the_steps_of_the_stored_one() {
    // More observations per point than fit into a chunk, a camera that measures a point twice,
    // fixed cameras, fixed entries of cameras, lenses and points.
    let mut start = network(14, 8, 60, 0.5);
    perturb(&mut start, 15, 1.0);
    let twice = start.observations[3];
    start.observations.push(Observation {
        image_px: [twice.image_px[0] + 0.5, twice.image_px[1] - 0.25],
        ..twice
    });
    for sharing in [InteriorSharing::PerImage, InteriorSharing::Shared] {
        for loss in [Loss::Trivial, Loss::Cauchy(2.0)] {
            for held in [false, true] {
                let mut path = None;
                let traces: Vec<Vec<f64>> = [LinearSolver::Schur, LinearSolver::Sparse]
                    .iter()
                    .map(|&linear| {
                        let mut bundle = Bundle::new(&start, sharing, loss).unwrap();
                        if held {
                            let (fixed, partly, point) =
                                (bundle.camera(5), bundle.camera(9), bundle.point(7));
                            bundle.problem.fix(fixed);
                            bundle.problem.fix_entries(partly, &[1, 4]).unwrap();
                            bundle.problem.fix_entries(point, &[2]).unwrap();
                            if let Some(lens) = bundle.lens() {
                                bundle.problem.fix_entries(lens, &[1]).unwrap();
                            }
                        }
                        let mut x = bundle.problem.start();
                        let mut engine =
                            LeastSquares::new(Options { linear, ..Options::default() });
                        engine.start(&bundle.problem, &mut x).unwrap();
                        let mut trace = Vec::new();
                        for _ in 0..5 {
                            let step = engine.step(&bundle.problem, &mut x).unwrap();
                            trace.extend([step.cost, step.step_norm, step.metrics[2].1]);
                        }
                        if linear == LinearSolver::Schur {
                            let problem = &bundle.problem;
                            let summary =
                                solve(problem, &mut problem.start(), &Options::default(), 1);
                            path = summary.unwrap().batches[0].path.clone();
                        }
                        trace
                    })
                    .collect();
                assert_eq!(path, Some(BatchPath::Fused), "{sharing:?} {loss} {held}");
                for (fused, stored) in traces[0].iter().zip(&traces[1]) {
                    let error = (fused - stored).abs() / stored.abs().max(1e-6);
                    // 5e-9 at the most; rounding differs by the instruction set.
                    assert!(error < 1e-7, "{sharing:?} {loss} {held}: {traces:?}");
                }
            }
        }
    }
}

fn adjust(network: &Network, sharing: InteriorSharing, options: &Options) -> (Summary, Network) {
    let bundle = Bundle::new(network, sharing, Loss::Trivial).unwrap();
    let mut x = bundle.problem.start();
    let summary = solve(&bundle.problem, &mut x, options, 100).unwrap();
    let mut adjusted = network.clone();
    bundle.update(&x, &mut adjusted);
    (summary, adjusted)
}

#[test]
fn exact_observations_recover_the_truth() {
    let truth = network(1, 3, 120, 0.0);
    for sharing in [InteriorSharing::PerImage, InteriorSharing::Shared] {
        let mut start = truth.clone();
        perturb(&mut start, 2, 1.0);
        // The gauge: the pose of the first camera, and the scale by one point.
        let mut with_point = start.clone();
        with_point.points[0] = truth.points[0];
        let mut bundle = Bundle::new(&with_point, sharing, Loss::Trivial).unwrap();
        bundle.problem.fix_entries(bundle.camera(0), &[0, 1, 2, 3, 4, 5]).unwrap();
        bundle.problem.fix(bundle.point(0));
        let mut x = bundle.problem.start();
        let options = Options { cost_tolerance: 1e-14, ..Options::default() };
        let summary = solve(&bundle.problem, &mut x, &options, 100).unwrap();
        assert!(summary.final_cost < 1e-12, "{sharing:?}: {summary}");
        let mut found = with_point.clone();
        bundle.update(&x, &mut found);
        for (a, b) in found.points.iter().flatten().zip(truth.points.iter().flatten()) {
            assert!((a - b).abs() < 1e-6, "{sharing:?}: {a} {b}");
        }
        for (a, b) in found.cameras.iter().zip(&truth.cameras) {
            for k in 0..3 {
                assert!((a.rotation_rad[k] - b.rotation_rad[k]).abs() < 1e-7);
                assert!((a.translation[k] - b.translation[k]).abs() < 1e-5);
            }
            assert!((a.interior[0] - b.interior[0]).abs() < 1e-3);
        }
    }
}

#[test]
fn conjugate_gradients_come_to_the_same_optimum() {
    let mut start = network(4, 6, 200, 0.5);
    perturb(&mut start, 5, 1.0);
    for sharing in [InteriorSharing::PerImage, InteriorSharing::Shared] {
        for method in [Method::LevenbergMarquardt, Method::Dogleg] {
            let with = |linear, linear_tolerance| {
                let options = Options { method, linear, linear_tolerance, ..Options::default() };
                adjust(&start, sharing, &options).0
            };
            let exact = with(LinearSolver::Schur, 0.01);
            let iterated = with(LinearSolver::IterativeSchur, 0.01);
            let ratio = iterated.final_cost / exact.final_cost;
            assert!((ratio - 1.0).abs() < 1e-6, "{sharing:?} {method:?}: {iterated} {exact}");
            // To the last digit, every step is the exact one.
            let tight = with(LinearSolver::IterativeSchur, 1e-13);
            assert_eq!(tight.iterations, exact.iterations, "{sharing:?} {method:?}");
        }
    }
}

#[test]
fn dense_sparse_and_schur_take_the_same_steps() {
    let mut start = network(4, 3, 150, 0.5);
    perturb(&mut start, 5, 1.0);
    for sharing in [InteriorSharing::PerImage, InteriorSharing::Shared] {
        for loss in [Loss::Trivial, Loss::Huber(1.0)] {
            let traces: Vec<Vec<(f64, f64)>> =
                [LinearSolver::Dense, LinearSolver::Sparse, LinearSolver::Schur]
                    .iter()
                    .map(|&linear| {
                        let bundle = Bundle::new(&start, sharing, loss).unwrap();
                        let mut x = bundle.problem.start();
                        let mut engine =
                            LeastSquares::new(Options { linear, ..Options::default() });
                        engine.start(&bundle.problem, &mut x).unwrap();
                        (0..6)
                            .map(|_| {
                                let step = engine.step(&bundle.problem, &mut x).unwrap();
                                (step.cost, step.step_norm)
                            })
                            .collect()
                    })
                    .collect();
            let mut before = f64::INFINITY;
            for (dense, others) in traces[0].iter().zip(traces[1].iter().zip(&traces[2])) {
                // At the optimum rounding decides whether a step is taken at all.
                let falls = before - dense.0 > 1e-13 * dense.0;
                before = dense.0;
                for other in [others.0, others.1] {
                    assert!((dense.0 - other.0).abs() <= 1e-9 * dense.0, "{traces:?}");
                    if !falls {
                        continue;
                    }
                    assert!((dense.1 - other.1).abs() <= 1e-5 * dense.1.max(1e-6), "{traces:?}");
                }
            }
        }
    }
}

#[test]
fn both_methods_and_both_losses_reach_one_optimum() {
    let mut start = network(6, 3, 150, 0.5);
    perturb(&mut start, 7, 1.0);
    let dogleg = Options { method: Method::Dogleg, ..Options::default() };
    let (first, _) = adjust(&start, InteriorSharing::PerImage, &Options::default());
    let (second, _) = adjust(&start, InteriorSharing::PerImage, &dogleg);
    assert!(first.stop.converged() && second.stop.converged(), "{first} {second}");
    assert!((first.final_cost / second.final_cost - 1.0).abs() < 1e-6, "{first} {second}");
    // Half a pixel of noise on 2n residuals with 2n - u degrees of freedom.
    let freedom = (first.residuals - (first.parameters - 7)) as f64;
    let sigma = (2.0 * first.final_cost / freedom).sqrt();
    assert!((sigma - 0.5).abs() < 0.05, "a-posteriori sigma {sigma}");
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    // Enough observations for several shares.
    let mut start = network(8, 6, 6000, 0.5);
    perturb(&mut start, 9, 1.0);
    for (sharing, loss) in
        [(InteriorSharing::PerImage, Loss::Trivial), (InteriorSharing::Shared, Loss::Huber(1.0))]
    {
        let results: Vec<Vec<u64>> = [1, 2, 3, 7]
            .iter()
            .map(|&threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| {
                    let bundle = Bundle::new(&start, sharing, loss).unwrap();
                    let mut x = bundle.problem.start();
                    solve(&bundle.problem, &mut x, &Options::default(), 5).unwrap();
                    x.iter().map(|v| v.to_bits()).collect()
                })
            })
            .collect();
        assert!(results.windows(2).all(|pair| pair[0] == pair[1]), "{sharing:?}");
    }
}

#[test]
fn a_network_with_holes_is_named() {
    let mut broken = network(1, 2, 20, 0.0);
    broken.points.push([0.0; 3]);
    assert!(broken.defect().unwrap().contains("point 20 is seen by no camera"));
    let mut broken = network(1, 2, 20, 0.0);
    broken.observations.retain(|o| o.camera != 2);
    assert!(broken.defect().unwrap().contains("camera 2 sees no point"));
    broken.observations[0].point = 99;
    assert!(broken.defect().unwrap().contains("point 99"));
    assert!(Bundle::new(&broken, InteriorSharing::PerImage, Loss::Trivial).is_err());
}

/// Best known costs of the real blocks, without loss and with Huber at 1 px (the data's README).
const REFERENCE: [(&str, f64, Option<f64>); 3] = [
    ("problem-49-7776-pre.txt", 13344.2403, Some(7648.631)),
    ("problem-21-11315-pre.txt", 30378.6358, None),
    ("problem-16-22106-pre.txt", 18033.9035, Some(12336.962)),
];

#[test]
fn real_blocks_reach_the_best_known_cost() {
    for (name, plain, huber) in REFERENCE {
        let Some(path) = data::path(&format!("ba_bal/{name}")) else { return };
        let network = bal::read(&path).unwrap();
        for (loss, reference) in [(Loss::Trivial, Some(plain)), (Loss::Huber(1.0), huber)] {
            let Some(reference) = reference else { continue };
            let bundle = Bundle::new(&network, InteriorSharing::PerImage, loss).unwrap();
            let mut x = bundle.problem.start();
            let summary = solve(&bundle.problem, &mut x, &Options::default(), 60).unwrap();
            assert!(summary.final_cost < reference * (1.0 + 1e-4), "{name} {loss}: {summary}");
        }
    }
}

#[test]
fn dogleg_keeps_the_damping_that_a_singular_first_system_has_raised() {
    // As it stands after refused trials: damped more, and still without a radius.
    let mut start = network(23, 2, 40, 0.5);
    perturb(&mut start, 24, 1.0);
    let bundle = Bundle::new(&start, InteriorSharing::PerImage, Loss::Trivial).unwrap();
    let mut engine = LeastSquares::new(Options { method: Method::Dogleg, ..Options::default() });
    let mut x = bundle.problem.start();
    engine.start(&bundle.problem, &mut x).unwrap();
    let mut state = serde_json::to_value(engine.state()).unwrap();
    state["lambda"] = 1e-3.into();
    let state = serde_json::from_value(state).unwrap();
    engine.resume(&bundle.problem, &mut x, state).unwrap();
    let step = engine.step(&bundle.problem, &mut x).unwrap();
    let damping = step.metrics.iter().find(|(name, _)| *name == "damping").unwrap().1;
    assert_eq!(damping, 1e-3);
}

#[test]
fn points_thrown_to_the_wrong_side_of_a_ray_come_back() {
    let mut start = network(31, 4, 200, 0.5);
    perturb(&mut start, 32, 0.3);
    let good = adjust(&start, InteriorSharing::PerImage, &Options::default()).0.final_cost;
    // Some points on the other side of the first camera that sees them.
    for point in [0, 100] {
        let of = start.observations.iter().find(|o| o.point == point).unwrap();
        let camera = &start.cameras[of.camera as usize];
        let back = rotation::exp(camera.rotation_rad.map(|v| -v));
        let centre = rotation::rotate(back, camera.translation).map(|v| -v);
        let place = &mut start.points[point as usize];
        *place = std::array::from_fn(|k| centre[k] - 0.3 * (place[k] - centre[k]));
    }
    let with = |restart_ratio| {
        let options = Options { restart_ratio, ..Options::default() };
        adjust(&start, InteriorSharing::PerImage, &options).0.final_cost
    };
    let found = with(Some(30.0));
    assert!(found < good * (1.0 + 1e-4), "{found}, without thrown points {good}");
    // Where points are not started again the block ends elsewhere.
    let stuck = with(None);
    assert!(stuck > good * 1.5, "{stuck}, without thrown points {good}");
}

#[test]
fn points_far_away_need_few_steps() {
    // A fifth of the points is 100 to 10,000 times as far away as the start says: straight in distance, a step at most
    // doubles that.
    let mut start = network(4, 3, 150, 0.0);
    let middle = [5.0, 5.0, 20.0];
    let mut truth = start.clone();
    for (k, point) in truth.points.iter_mut().enumerate().filter(|(k, _)| k % 5 == 0) {
        let scale = 1e4 / (1.0 + (k % 7) as f64).powi(2);
        *point = std::array::from_fn(|i| middle[i] + scale * (point[i] - middle[i]));
    }
    let exact = Bundle::new(&truth, InteriorSharing::PerImage, Loss::Trivial).unwrap();
    let residuals = exact.problem.residuals(&exact.problem.start(), TIE_POINTS).unwrap();
    for (observation, r) in start.observations.iter_mut().zip(residuals.chunks_exact(2)) {
        observation.image_px = [observation.image_px[0] + r[0], observation.image_px[1] + r[1]];
    }
    let bundle = Bundle::new(&start, InteriorSharing::PerImage, Loss::Trivial).unwrap();
    let mut x = bundle.problem.start();
    let found = solve(&bundle.problem, &mut x, &Options::default(), 10).unwrap();
    assert!(found.final_cost < 1e-6 * found.initial_cost, "{found}");
}
