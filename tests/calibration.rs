//! The calibration problem: derivatives, recovery of known lenses within their own sigmas, statistics, what
//! cannot be determined.

use crate::{
    boards::{SQUARE_M, corners, normal, poses, wide},
    data,
};
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use rowgram::{
    camera::{Interior, Lens, Model},
    engine::SolveError,
    nlls::{LinearSolver, Loss, covariance::Covariance},
    problems::calibration::{
        BoardShape, Calibration, MAX_ITERATIONS, Mark, Request, View, adjust, calibrate, start,
        statistics::{residuals, statistics},
    },
    target::Board,
};

const SIZE: [u32; 2] = [1280, 960];
const BOARD: Board = Board { columns: 8, rows: 6 };

fn request(model: Model, free: &str) -> Request {
    request_for(model, free, SIZE)
}

fn request_for(model: Model, free: &str, size_px: [u32; 2]) -> Request {
    let parameters = model.parameters();
    Request {
        model,
        size_px,
        free: parameters.iter().map(|p| free.split(' ').any(|name| name == p.name)).collect(),
        values: (0..parameters.len())
            .map(|k| model.default_value(k, size_px).unwrap_or(f64::from(size_px[0])))
            .collect(),
        shape: BoardShape::Flat,
        loss: Loss::Trivial,
    }
}

const BROWN: &str = "f_px aspect cx_px cy_px k1 k2 p1 p2 k3";
const SMAC: &str = "c_px xp_px yp_px K1 K2 K3 P1 P2";
const FISHEYE: &str = "f_px aspect cx_px cy_px k1 k2 k3 k4";

/// Views of a board through a lens, with noise of `sigma_px` in each coordinate.
fn views(lens: &Interior, count: usize, sigma_px: f64, seed: u64) -> Vec<View> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut noise = || sigma_px * ((0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0);
    poses(BOARD, lens, count, seed)
        .iter()
        .map(|pose| View {
            marks: corners(BOARD, lens, pose)
                .into_iter()
                .enumerate()
                .map(|(corner, at)| {
                    let at = at.unwrap();
                    Mark {
                        corner,
                        board_m: [
                            SQUARE_M * (corner % BOARD.columns) as f64,
                            SQUARE_M * (corner / BOARD.columns) as f64,
                        ],
                        image_px: [at[0] + noise(), at[1] + noise()],
                    }
                })
                .collect(),
        })
        .collect()
}

fn smac() -> Interior {
    let mut values = [0.0; 10];
    values[..9]
        .copy_from_slice(&[1100.0, 12.0, -9.0, 0.0, 9.0e-8, 4.0e-14, 1.0e-20, 4.0e-7, -3.0e-7]);
    Interior::new(Model::Smac, SIZE, &values).unwrap()
}

fn fisheye() -> Interior {
    let values = [420.0, 1.001, 646.0, 473.0, -0.02, 0.004, -0.002, 0.0005];
    Interior::new(Model::Fisheye, SIZE, &values).unwrap()
}

#[test]
fn known_lenses_come_back_within_their_sigmas() {
    for (name, lens, model, free) in [
        ("smac", smac(), Model::Smac, SMAC),
        ("brown", wide(SIZE), Model::Brown, BROWN),
        ("nearly none", normal(SIZE), Model::Brown, "f_px aspect cx_px cy_px k1 k2"),
        ("fisheye", fisheye(), Model::Fisheye, FISHEYE),
    ] {
        let views = views(&lens, 15, 0.2, 11);
        let request = request(model, free);
        let solution = calibrate(&views, &request).unwrap();
        assert!(solution.stop.converged(), "{name}: {:?}", solution.stop);
        let found = statistics(&views, &request, &solution).unwrap();
        assert!((found.sigma0_px / 0.2 - 1.0).abs() < 0.08, "{name}: {}", found.sigma0_px);
        let mut squares = 0.0;
        let free = found.parameters.iter().zip(lens.values()).filter(|(p, _)| p.free);
        for (p, truth) in free.clone() {
            let off = (p.value - truth) / p.standard_deviation;
            assert!(
                off.abs() < 3.5,
                "{name}: {} is {} not {truth}: {off:.1} sigma",
                p.name,
                p.value
            );
            squares += off * off;
        }
        // The sigmas are not too large either: the normalised squares are about one each.
        let count = free.count() as f64;
        assert!(squares > 0.15 * count, "{name}: {squares} of {count}");
    }
}

#[test]
fn sigmas_with_a_robust_loss_are_those_of_the_weighted_problem_whatever_the_board() {
    let mut views = views(&wide(SIZE), 10, 0.2, 7);
    for mark in views.iter_mut().flat_map(|view| &mut view.marks).step_by(17) {
        mark.image_px[0] += 6.0;
    }
    for shape in [BoardShape::Flat, BoardShape::Free] {
        let request = Request { loss: Loss::Cauchy(0.5), shape, ..request(Model::Brown, BROWN) };
        let solution = calibrate(&views, &request).unwrap();
        let found = statistics(&views, &request, &solution).unwrap();
        // The loss takes some weight of good corners too.
        assert!((found.sigma0_px / 0.2 - 1.0).abs() < 0.3, "{shape:?}: {}", found.sigma0_px);
        let calibration = &solution.calibration;
        let mut covariance =
            Covariance::new(&calibration.problem, &solution.x, LinearSolver::Schur).unwrap();
        let block = covariance.block(calibration.lens);
        let free: Vec<_> = found.parameters.iter().filter(|p| p.free).collect();
        for (k, p) in free.iter().enumerate() {
            let sigma = found.sigma0_px * block[k * free.len() + k].sqrt();
            let ratio = p.standard_deviation / sigma;
            assert!((ratio - 1.0).abs() < 1e-5, "{shape:?}: {}: {ratio}", p.name);
        }
    }
}

#[test]
fn sigmas_are_what_repetitions_scatter() {
    let lens = wide(SIZE);
    let request = request(Model::Brown, BROWN);
    const RUNS: usize = 24;
    let mut found: Vec<(f64, f64)> = Vec::new();
    let clean = views(&lens, 8, 0.0, 5);
    let begin = start::search(&clean, &request).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for _ in 0..RUNS {
        let mut noisy = clean.clone();
        for mark in noisy.iter_mut().flat_map(|view| &mut view.marks) {
            for x in &mut mark.image_px {
                *x += 0.3 * ((0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0);
            }
        }
        let solution = adjust(&noisy, &request, &begin, Loss::Trivial, MAX_ITERATIONS).unwrap();
        let p = &statistics(&noisy, &request, &solution).unwrap().parameters[0];
        found.push((p.value, p.standard_deviation));
    }
    let mean = found.iter().map(|f| f.0).sum::<f64>() / RUNS as f64;
    let scatter =
        (found.iter().map(|f| (f.0 - mean).powi(2)).sum::<f64>() / (RUNS - 1) as f64).sqrt();
    let sigma = found.iter().map(|f| f.1).sum::<f64>() / RUNS as f64;
    // 24 runs know a standard deviation to 15 %; three times that.
    assert!((scatter / sigma - 1.0).abs() < 0.45, "{scatter} {sigma}");
}

#[test]
fn a_bent_board_is_measured() {
    let lens = wide(SIZE);
    let height = |corner: usize| {
        let (x, y) = ((corner % 8) as f64 - 3.5, (corner / 8) as f64 - 2.5);
        2e-4 * (x * x - y * y)
    };
    let clean = views(&lens, 20, 0.1, 21);
    let request = request(Model::Brown, BROWN);
    // The same poses, with the corners above and below the plane.
    let begin = start::search(&clean, &request).unwrap();
    let mut state = adjust(&clean, &request, &begin, Loss::Trivial, 100).unwrap().state;
    let before = residuals(&clean, &state).unwrap();
    state.heights_m = (0..48).map(height).collect();
    let after = residuals(&clean, &state).unwrap();
    let mut bent = clean;
    for ((view, before), after) in bent.iter_mut().zip(&before).zip(&after) {
        for ((mark, before), after) in view.marks.iter_mut().zip(before).zip(after) {
            for k in 0..2 {
                mark.image_px[k] += after[k] - before[k];
            }
        }
    }
    let flat = calibrate(&bent, &request).unwrap();
    let flat = statistics(&bent, &request, &flat).unwrap();
    let free = Request { shape: BoardShape::Free, ..request };
    let solution = calibrate(&bent, &free).unwrap();
    let found = statistics(&bent, &free, &solution).unwrap();
    assert!(flat.rms_px > 2.0 * found.rms_px, "{} {}", flat.rms_px, found.rms_px);
    // Three corners define the plane: compare after taking the true heights to it.
    let plane = |values: &[f64]| -> Vec<f64> {
        let rows = nalgebra::DMatrix::from_fn(48, 3, |k, j| match j {
            0 => 1.0,
            1 => (k % 8) as f64,
            _ => (k / 8) as f64,
        });
        let right = nalgebra::DVector::from_column_slice(values);
        let fit = rows.clone().svd(true, true).solve(&right, 1e-12).unwrap();
        (right - rows * fit).iter().copied().collect()
    };
    let truth = plane(&(0..48).map(height).collect::<Vec<_>>());
    let heights = plane(&found.heights_m.iter().map(|h| h[0]).collect::<Vec<_>>());
    for (k, (a, b)) in heights.iter().zip(&truth).enumerate() {
        assert!((a - b).abs() < 2e-4, "corner {k}: {a} instead of {b}");
    }
}

#[test]
fn what_cannot_be_told_apart_is_named() {
    let lens = smac();
    let views = views(&lens, 8, 0.2, 4);
    let request = request(Model::Smac, "c_px xp_px yp_px K0 K1 K2");
    let message = match calibrate(&views, &request)
        .and_then(|solution| statistics(&views, &request, &solution))
    {
        Err(SolveError::RankDeficient(message)) => message,
        other => panic!("{:?}", other.map(|found| found.rms_px)),
    };
    assert!(message.contains("c_px") && message.contains("K0"), "{message}");
}

#[test]
fn photos_straight_on_leave_the_distance_open() {
    let lens = normal(SIZE);
    let board = BOARD;
    let views: Vec<View> = (0..5)
        .map(|k| {
            let pose = crate::boards::pose(
                board,
                [0.01 * f64::from(k) - 0.02, 0.004 * f64::from(k), -0.4],
                0.0,
                0.0,
                0.3 * f64::from(k),
            );
            let marks = corners(board, &lens, &pose).into_iter().enumerate();
            let mark = |(corner, at): (usize, Option<[f64; 2]>)| Mark {
                corner,
                board_m: [SQUARE_M * (corner % 8) as f64, SQUARE_M * (corner / 8) as f64],
                image_px: at.unwrap(),
            };
            View { marks: marks.map(mark).collect() }
        })
        .collect();
    let request = request(Model::Brown, "f_px cx_px cy_px k1");
    let outcome =
        calibrate(&views, &request).and_then(|found| statistics(&views, &request, &found));
    match outcome {
        Err(SolveError::RankDeficient(message)) => assert!(message.contains("f_px"), "{message}"),
        // Without noise the next best thing is a sigma that says so.
        Ok(found) => panic!("{:?}", found.parameters),
        Err(other) => panic!("{other}"),
    }
}

#[test]
fn corners_in_no_order_are_no_plane() {
    let lens = wide(SIZE);
    let mut one = views(&lens, 1, 0.1, 2).remove(0);
    assert!(start::resembles_plane(&one));
    let last = one.marks.len() - 1;
    for k in (0..last / 2).step_by(2) {
        let other = one.marks[last - k].image_px;
        one.marks[last - k].image_px = one.marks[k].image_px;
        one.marks[k].image_px = other;
    }
    assert!(!start::resembles_plane(&one));
}

#[test]
fn misuse_is_an_error() {
    let lens = wide(SIZE);
    let views = views(&lens, 3, 0.1, 2);
    let mut nothing = request(Model::Brown, BROWN);
    let begin = start::search(&views, &nothing).unwrap();
    nothing.free.fill(false);
    assert!(Calibration::new(&views, &nothing, &begin, Loss::Trivial).is_err());
    // A single photo does not determine nine parameters and a pose with their sigmas to spare; it
    // says so or gives finite numbers, and never panics.
    let one = &views[..1];
    let request = request(Model::Brown, BROWN);
    if let Ok(solution) = calibrate(one, &request)
        && let Ok(found) = statistics(one, &request, &solution)
    {
        assert!(found.parameters.iter().all(|p| p.standard_deviation.is_finite()));
    }
}

/// OpenCV's result on OpenCV's corners.
fn like_opencv(reference: &str, size_px: [u32; 2]) {
    let Some(path) = data::path(reference) else { return };
    let reference: serde_json::Value =
        serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    let columns = reference["pattern"][0].as_u64().unwrap() as usize;
    let number = |v: &serde_json::Value| v.as_f64().unwrap();
    let views: Vec<View> = reference["corners"]
        .as_object()
        .unwrap()
        .values()
        .map(|corners| View {
            marks: corners
                .as_array()
                .unwrap()
                .iter()
                .map(|p| if p[0].is_array() { &p[0] } else { p })
                .enumerate()
                .map(|(corner, p)| Mark {
                    corner,
                    board_m: [
                        SQUARE_M * (corner % columns) as f64,
                        SQUARE_M * (corner / columns) as f64,
                    ],
                    image_px: [number(&p[0]), number(&p[1])],
                })
                .collect(),
        })
        .collect();
    let request = request_for(Model::Brown, BROWN, size_px);
    let solution = calibrate(&views, &request).unwrap();
    let found = statistics(&views, &request, &solution).unwrap();
    let theirs = &reference["k1k2p1p2k3"];
    let rms = number(&theirs["rms"]);
    // OpenCV stops a little before the minimum: ours is never above.
    assert!(found.rms_px < rms + 1e-6 && found.rms_px > rms - 2e-3, "{} {rms}", found.rms_px);
    let (fx, fy) = (number(&theirs["fx"]), number(&theirs["fy"]));
    let d = |k: usize| number(&theirs["dist"][k]);
    let expected = [
        ("f_px", fx),
        ("aspect", fy / fx),
        ("cx_px", number(&theirs["cx"])),
        ("cy_px", number(&theirs["cy"])),
        ("k1", d(0)),
        ("k2", d(1)),
        ("p1", d(2)),
        ("p2", d(3)),
        ("k3", d(4)),
    ];
    for (name, value) in expected {
        let p = found.parameters.iter().find(|p| p.name == name).unwrap();
        let off = (p.value - value) / p.standard_deviation;
        assert!(off.abs() < 1.0, "{name}: {} and {value}, {off:.2} sigma", p.value);
    }
}

#[test]
fn opencv_agrees_on_its_own_corners() {
    like_opencv("calib_gopro_udacity/opencv_reference.json", [1280, 960]);
    like_opencv("calib_opencv_left/opencv_reference_left.json", [640, 480]);
}
