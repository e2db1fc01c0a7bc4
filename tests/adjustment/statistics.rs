//! Jacobians, covariances, redundancy numbers, check points.

use super::toy::{self, NOISE, Noise, Plan, free, measured, truth, with_positions};
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use rowgram::{
    camera::{Interior, Lens, Model},
    nlls::{BlockId, solve},
    problems::adjustment::{
        AdjustmentProblem, Group, ObservationRef, OutlierTest, Settings, adjust, rmse, validate,
    },
    scene::{Axes, Reconstruction, Role, ScaleBar},
};
use statrs::distribution::{ChiSquared, ContinuousCDF};
use std::collections::HashMap;

/// A block with every kind of observation.
fn everything(interior: Interior, velocity_m_s: Option<f64>) -> Reconstruction {
    let plan = Plan { tie_points: 60, interior, velocity_m_s, ..Plan::default() };
    let mut survey = with_positions(truth(&plan));
    survey.lever_arm_m = [0.1, -0.2, 0.05];
    survey.ground[1].axes = Axes::Xy;
    survey.ground[3].axes = Axes::Z;
    survey.ground[4].role = Role::Tie;
    let [a, b] = [3, 4].map(|k: usize| Vector3::from(survey.ground[k].position_m));
    survey.scale_bars = vec![ScaleBar { ends: [3, 4], length_m: (a - b).norm(), sigma_m: 0.01 }];
    survey
}

fn lenses() -> [Interior; 4] {
    let make = |model, values: &[f64]| Interior::new(model, toy::SIZE_PX, values).unwrap();
    [
        toy::smac(),
        make(
            Model::Brown,
            &[900.0, 1.001, 503.0, 371.0, -0.06, 0.02, 5e-4, -3e-4, 0.0, 0.0, 0.0, 0.0],
        ),
        make(Model::Fisheye, &[900.0, 0.999, 503.0, 371.0, 0.02, -0.01, 0.0, 0.0]),
        make(Model::Bal, &[900.0, -0.05, 0.01]),
    ]
}

#[test]
fn all_jacobians_match_differences() {
    for interior in lenses() {
        for (velocity, corrected_domain) in [(None, false), (Some(8.0), false), (None, true)] {
            let mut survey = measured(&everything(interior, velocity), 3, NOISE);
            let names: Vec<&str> =
                interior.parameters().iter().filter(|p| p.estimable).map(|p| p.name).collect();
            free(&mut survey, &names);
            if survey.rolling_shutter.is_some() {
                survey.images.iter_mut().for_each(|i| i.motion = [0.0, 0.0, 0.0, 0.2, 0.1, 0.05]);
            }
            survey.cameras[0].standard_deviations[0] = Some(3.0);
            let settings = Settings { corrected_domain, ..Settings::default() };
            let posed = AdjustmentProblem::new(&survey, &settings).unwrap();
            let x = posed.problem.start();
            for name in NAMES {
                check(&posed, &x, name);
            }
        }
    }
}

/// Compares the Jacobian of the first factor of a batch with differences, every step being one that
/// changes the residual by a fraction of a standard deviation.
fn check(posed: &AdjustmentProblem, x: &[f64], name: &str) {
    let Ok(factors) = posed.problem.linearized(x, name) else {
        assert!(name == "interior orientation 0" || name == "motion", "{name}");
        return;
    };
    let (blocks, residual, jacobian) = &factors[0];
    let width = jacobian.len() / residual.len();
    let mut column = 0;
    for &block in blocks {
        let space = posed.problem.manifold(block);
        let values = posed.problem.values(x, block);
        let at = (values.as_ptr() as usize - x.as_ptr() as usize) / 8;
        for entry in 0..space.tangent() {
            let analytic: Vec<f64> =
                (0..residual.len()).map(|row| jacobian[row * width + column]).collect();
            column += 1;
            let size = analytic.iter().fold(0.0, |most: f64, v| v.abs().max(most));
            if size == 0.0 {
                continue;
            }
            let along = |h: f64| -> Vec<f64> {
                let mut step = vec![0.0; space.tangent()];
                step[entry] = h;
                let mut moved = x.to_vec();
                space.plus(values, &step, &mut moved[at..at + values.len()]);
                posed.problem.linearized(&moved, name).unwrap()[0].1.clone()
            };
            let h = (0.2 / size).min(0.01);
            let central = |h: f64| -> Vec<f64> {
                along(h).iter().zip(along(-h)).map(|(a, b)| (a - b) / (2.0 * h)).collect()
            };
            let (wide, narrow) = (central(h), central(0.5 * h));
            for (row, analytic) in analytic.iter().enumerate() {
                let difference = (4.0 * narrow[row] - wide[row]) / 3.0;
                let error = (analytic - difference).abs() * h;
                assert!(error < 1e-7, "{name} {entry}: {analytic} {difference}");
            }
        }
    }
}

const NAMES: [&str; 7] = [
    "tie points",
    "marks",
    "control coordinates",
    "camera positions",
    "scale bars",
    "interior orientation 0",
    "motion",
];

#[test]
fn exact_measurements_give_the_truth() {
    for (interior, velocity) in
        lenses().map(|i| (i, None)).into_iter().chain([(toy::smac(), Some(8.0))])
    {
        let truth = everything(interior, velocity);
        let exact = Noise { tie: 0.0, mark: 0.0, control: 0.0, position: 0.0 };
        let mut survey = measured(&truth, 5, exact);
        survey.lever_arm_m = [0.0; 3];
        free(
            &mut survey,
            if interior.model() == Model::Smac { &["c_px", "K1"] } else { &["f_px", "k1"] },
        );
        let adjusted = adjust(&mut survey, &Settings::default()).unwrap();
        assert!(
            adjusted.converged() && adjusted.statistics.sigma0 < 0.01,
            "{:?}",
            adjusted.summary
        );
        for (found, true_image) in survey.images.iter().zip(&truth.images) {
            let error =
                Vector3::from(found.pose.centre_m()) - Vector3::from(true_image.pose.centre_m());
            assert!(error.norm() < 1e-3, "{error}");
        }
        assert!(!adjusted.check_points.is_empty());
        for check in &adjusted.check_points {
            assert!(Vector3::from(check.error_m).norm() < 1e-4, "{check:?}");
        }
    }
}

/// The inverse normal matrix and the hat matrix, densely and from the factors one by one.
#[test]
fn redundancy_numbers_are_those_of_the_dense_hat_matrix() {
    for velocity in [None, Some(8.0)] {
        let mut survey = measured(&everything(toy::smac(), velocity), 4, NOISE);
        free(&mut survey, &["c_px", "xp_px", "K1"]);
        let settings = Settings::default();
        let adjusted = adjust(&mut survey, &settings).unwrap();
        let statistics = &adjusted.statistics;
        let posed = AdjustmentProblem::new(&adjusted.reconstruction, &settings).unwrap();
        // Ground points start at their given coordinates.
        let mut x = posed.problem.start();
        solve(&posed.problem, &mut x, &settings.engine(), 20).unwrap();
        let names = [
            "tie points",
            "marks",
            "control coordinates",
            "control coordinates in plan",
            "control heights",
            "camera positions",
            "scale bars",
            "motion",
        ];
        let mut columns: HashMap<BlockId, usize> = HashMap::new();
        let mut width = 0;
        let mut rows: Vec<(Vec<BlockId>, Vec<f64>)> = Vec::new();
        let mut v = Vec::new();
        for name in names {
            let Ok(factors) = posed.problem.linearized(&x, name) else { continue };
            for (blocks, residual, jacobian) in factors {
                for &block in &blocks {
                    columns.entry(block).or_insert_with(|| {
                        width += posed.problem.dimension(block);
                        width - posed.problem.dimension(block)
                    });
                }
                for row in jacobian.chunks(jacobian.len() / residual.len()) {
                    rows.push((blocks.clone(), row.to_vec()));
                }
                v.extend(residual);
            }
        }
        let mut j = DMatrix::zeros(rows.len(), width);
        for (k, (blocks, row)) in rows.iter().enumerate() {
            let mut at = 0;
            for &block in blocks {
                let n = posed.problem.dimension(block);
                for i in 0..n {
                    j[(k, columns[&block] + i)] = row[at + i];
                }
                at += n;
            }
        }
        // Lens entries that are held, and rates of turn: their columns do not count.
        let lens =
            columns.iter().find(|(block, _)| posed.problem.dimension(**block) == 13).unwrap();
        let held: Vec<usize> =
            (0..13).filter(|k| ![0, 1, 4].contains(k)).map(|k| lens.1 + k).collect();
        held.iter().for_each(|&k| j.column_mut(k).fill(0.0));
        if velocity.is_some() {
            for (block, start) in &columns {
                if posed.problem.dimension(*block) == 12 {
                    (6..9).for_each(|k| j.column_mut(start + k).fill(0.0));
                }
            }
        }
        let free: Vec<usize> = (0..width).filter(|&k| j.column(k).norm() > 0.0).collect();
        let mut j = j.select_columns(&free);
        // Unit columns: the inverse keeps its digits.
        for mut column in j.column_iter_mut() {
            let norm = column.norm();
            column /= norm;
        }
        let q = j.qr().q();
        let hat = &q * q.transpose();
        assert_eq!(statistics.parameters, free.len());
        let sum: f64 = statistics.groups.iter().map(|group| group.redundancy).sum();
        assert!(
            (sum - statistics.redundancy as f64).abs() < 1e-5 * sum,
            "{sum} {}",
            statistics.redundancy
        );
        let mut at = 0;
        let ties = statistics.tested.iter().filter(|t| t.group == Group::TiePoints);
        let mut in_order: Vec<_> = ties.collect();
        in_order.sort_by_key(|t| match t.subject {
            ObservationRef::TieObservation(k) => k,
            _ => 0,
        });
        let others = statistics.tested.iter().filter(|t| t.group != Group::TiePoints);
        for tested in in_order.into_iter().chain(others.filter(|t| t.group == Group::Marks)) {
            for k in 0..usize::from(tested.rows) {
                let expected = 1.0 - hat[(at, at)];
                assert!((tested.redundancy[k] - expected).abs() < 1e-5, "{tested:?} {expected}");
                assert!((tested.residual[k] - v[at]).abs() < 1e-3);
                at += 1;
            }
        }
    }
}

#[test]
fn normalised_errors_of_many_blocks_follow_chi_square() {
    let plan = Plan { tie_points: 60, ..Plan::default() };
    let truth = with_positions(truth(&plan));
    let runs = 60;
    let mut sums = [0.0; 5];
    for run in 0..runs {
        let mut survey = measured(&truth, 1000 + run, NOISE);
        free(&mut survey, &["c_px", "K1"]);
        let adjusted = adjust(&mut survey, &Settings::default()).unwrap();
        let statistics = &adjusted.statistics;
        let normalised = |error: [f64; 3], c: &[[f64; 3]; 3]| {
            let e = Vector3::from(error);
            let c = Matrix3::from_fn(|i, j| c[i][j]);
            e.dot(&c.cholesky().unwrap().solve(&e))
        };
        let difference = |a: [f64; 3], b: [f64; 3]| [0, 1, 2].map(|k| a[k] - b[k]);
        let centre = difference(survey.images[5].pose.centre_m(), truth.images[5].pose.centre_m());
        sums[0] += normalised(centre, &statistics.images[5].centre_m2);
        let angles = difference(
            survey.images[5].pose.omega_phi_kappa_rad(),
            truth.images[5].pose.omega_phi_kappa_rad(),
        );
        sums[1] +=
            (0..3).map(|k| (angles[k] / statistics.images[5].angles_rad[k]).powi(2)).sum::<f64>();
        let point = difference(survey.points[9].position_m, truth.points[9].position_m);
        sums[2] += normalised(point, &statistics.points[9].covariance_m2);
        let check = &adjusted.check_points[1];
        let k = adjusted.validated.ground[check.ground];
        let error = difference(check.position_m, truth.ground[k].position_m);
        sums[3] += normalised(error, &check.covariance_m2);
        let interior = &statistics.interiors[0];
        let values = truth.cameras[0].interior.values();
        let e =
            DVector::from_vec(vec![interior.values[0] - values[0], interior.values[1] - values[4]]);
        let s = &interior.standard_deviations;
        let c = DMatrix::from_fn(2, 2, |i, j| interior.correlation[i][j] * s[i] * s[j]);
        sums[4] += e.dot(&c.cholesky().unwrap().solve(&e));
    }
    // The three angles are tested one by one: their sum of squares has the right mean, and a
    // spread that grows with their correlations, which are small in a block tied this well.
    for (sum, freedom) in sums.into_iter().zip([3, 3, 3, 3, 2]) {
        let chi = ChiSquared::new((runs * freedom) as f64).unwrap();
        let (low, high) = (chi.inverse_cdf(0.0005), chi.inverse_cdf(0.9995));
        assert!((low..high).contains(&sum), "{sum} outside {low} .. {high}: {sums:?}");
    }
}

#[test]
fn the_global_test_and_the_groups_fit_noise_as_given() {
    let mut survey = measured(&with_positions(truth(&Plan::default())), 77, NOISE);
    let adjusted = adjust(&mut survey, &Settings::default()).unwrap();
    let statistics = &adjusted.statistics;
    let [low, high] = statistics.variance_interval(0.999).unwrap();
    let variance = statistics.sigma0.powi(2);
    assert!((low..high).contains(&variance), "{variance} outside {low} .. {high}");
    for group in &statistics.groups {
        let factor = group.variance_factor().unwrap();
        let chi = ChiSquared::new(group.redundancy).unwrap();
        let bounds = [0.0005, 0.9995].map(|p| chi.inverse_cdf(p) / group.redundancy);
        assert!((bounds[0]..bounds[1]).contains(&factor), "{group:?} {bounds:?}");
    }
    // Baarda's critical value for one number at 0.1 %: 3.29 standard deviations.
    let critical = statistics.critical(OutlierTest::Baarda, Group::TiePoints, 1, 0.001).sqrt();
    assert!((critical - 3.2905).abs() < 1e-4);
    // With much redundancy Pope's is the same.
    let ties = statistics.groups[0].variance_factor().unwrap().sqrt().max(statistics.sigma0);
    let pope = statistics.critical(OutlierTest::Pope, Group::TiePoints, 1, 0.001).sqrt() / ties;
    assert!((pope / critical - 1.0).abs() < 0.01, "{pope}");
    // Control is better known than tie points, ellipsoids have their axes in order.
    let axes = statistics.images[0].ellipsoid();
    assert!(axes[0] >= axes[1] && axes[1] >= axes[2] && axes[2] > 0.0);
}

#[test]
fn check_points_take_no_part() {
    let truth = truth(&Plan::default());
    let mut survey = measured(&truth, 11, NOISE);
    let mut moved = survey.clone();
    for point in moved.ground.iter_mut().filter(|point| point.role == Role::Check) {
        point.position_m[2] += 0.4;
    }
    for mark in &mut moved.marks {
        if moved.ground[mark.ground as usize].role == Role::Check {
            mark.image_px[0] += 0.2;
        }
    }
    let (first, second) =
        (adjust(&mut survey, &Settings::default()), adjust(&mut moved, &Settings::default()));
    assert_eq!(survey.images, moved.images);
    let (first, second) = (first.unwrap(), second.unwrap());
    for (a, b) in first.check_points.iter().zip(&second.check_points) {
        assert!((a.error_m[2] - b.error_m[2] - 0.4).abs() < 0.1);
    }
    let errors: Vec<f64> = first.check_points.iter().map(|check| check.error_m[0]).collect();
    let found = rmse(&errors, 0.95).unwrap();
    assert!(found.interval_m[0] < found.rmse_m && found.rmse_m < found.interval_m[1]);
    assert!(found.rmse_m < 0.08, "{found:?}");
    // Textbook: four errors of 1 have an interval of sqrt(4/11.143) .. sqrt(4/0.4844).
    let four = rmse(&[1.0, -1.0, 1.0, -1.0], 0.95).unwrap();
    assert!(
        (four.interval_m[0] - 0.5991).abs() < 1e-3 && (four.interval_m[1] - 2.8736).abs() < 1e-3,
        "{four:?}"
    );
}

#[test]
fn screening_changes_nothing_that_is_sound() {
    let survey = measured(&everything(toy::smac(), None), 8, NOISE);
    let validated = validate(&survey).unwrap();
    assert!(validated.excluded.is_empty(), "{:?}", validated.excluded);
    assert_eq!(validated.reconstruction, survey);
}

#[test]
fn check_points_follow_the_accuracy_that_their_marks_are_found_to_have() {
    let survey = measured(&with_positions(truth(&Plan::default())), 91, NOISE);
    let variances = |factor: f64| -> f64 {
        // All observations alike: the geometry is the same, its scale is not.
        let settings = Settings { sigma_factors: [factor; 8], ..Settings::default() };
        let adjusted = adjust(&mut survey.clone(), &settings).unwrap();
        adjusted.check_points.iter().map(|check| check.covariance_m2[2][2]).sum()
    };
    let (one, three) = (variances(1.0), variances(3.0));
    assert!((three / one - 9.0).abs() < 0.05, "{one} {three}");
}

#[test]
fn a_stalled_adjustment_has_not_converged() {
    let survey = measured(&with_positions(truth(&Plan::default())), 92, NOISE);
    let mut adjusted = adjust(&mut survey.clone(), &Settings::default()).unwrap();
    assert!(adjusted.converged());
    adjusted.summary.stop = rowgram::engine::Termination::Stalled;
    assert!(!adjusted.converged());
}

#[test]
fn a_limit_of_ten_iterations_allows_more_than_one() {
    let survey = measured(&with_positions(truth(&Plan::default())), 92, NOISE);
    let settings = Settings { max_iterations: 10, ..Settings::default() };
    let adjusted = adjust(&mut survey.clone(), &settings).unwrap();
    assert!(adjusted.converged() && adjusted.summary.iterations > 1, "{:?}", adjusted.summary);
}

#[test]
fn a_robust_loss_needs_no_tie_points() {
    let plan = Plan { control: 12, ..Plan::default() };
    let mut survey = measured(&with_positions(truth(&plan)), 93, NOISE);
    survey.points.clear();
    survey.observations.clear();
    let least_squares = adjust(&mut survey.clone(), &Settings::default()).unwrap();
    let settings = Settings { tie_loss: rowgram::nlls::Loss::Huber(2.0), ..Settings::default() };
    let robust = adjust(&mut survey.clone(), &settings).unwrap();
    assert_eq!(robust.summary.final_cost, least_squares.summary.final_cost);
}

#[test]
fn costs_are_those_of_one_problem() {
    // Under a robust loss the same residuals cost less: next to the cost of least squares it would look like a rise.
    let noise = Noise { tie: 3.0, ..NOISE };
    let mut survey = measured(&with_positions(truth(&Plan::default())), 94, noise);
    adjust(&mut survey, &Settings::default()).unwrap();
    let settings = Settings { tie_loss: rowgram::nlls::Loss::SoftL1(1.0), ..Settings::default() };
    let posed = AdjustmentProblem::new(&validate(&survey).unwrap().reconstruction, &settings);
    let posed = posed.unwrap();
    let robust: f64 = posed.problem.costs(&posed.problem.start()).unwrap().iter().sum();
    let found = adjust(&mut survey, &settings).unwrap().summary;
    assert!(robust < 0.9 * found.final_cost, "{robust} {}", found.final_cost);
    assert!(found.final_cost <= found.initial_cost, "{found}");
}
