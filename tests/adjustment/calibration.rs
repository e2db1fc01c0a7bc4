//! Self-calibration inside the adjustment: what it recovers, what it cannot, and says so.

use super::toy::{self, NOISE, Noise, Plan, free, measured, truth, with_positions};
use rowgram::{
    camera::Lens,
    nlls::{LinearSolver, Loss, Options, solve},
    problems::adjustment::{AdjustmentProblem, Settings, adjust, align, rmse},
    scene::{Reconstruction, Role},
};

fn refused(survey: &Reconstruction, settings: &Settings) -> String {
    adjust(&mut survey.clone(), settings).map(|_| ()).unwrap_err().to_string()
}

#[test]
fn a_missing_rank_is_explained_in_words() {
    let truth = truth(&Plan::default());
    let mut survey = measured(&truth, 71, NOISE);
    free(&mut survey, &["c_px", "K0", "K1", "K2", "P1", "P2"]);
    let message = refused(&survey, &Settings::default());
    assert!(
        message.contains("K0 and the principal distance are the same parameter here"),
        "{message}"
    );
    // What is known beforehand of one of them tells them apart.
    survey.cameras[0].standard_deviations[3] = Some(1e-3);
    adjust(&mut survey.clone(), &Settings::default()).unwrap();
    // Without control the block floats.
    free(&mut survey, &["c_px"]);
    survey.ground.iter_mut().for_each(|point| point.role = Role::Check);
    let message = refused(&survey, &Settings::default());
    assert!(message.contains("whole block is free in 7 direction(s)"), "{message}");
    let settings = Settings { minimal_datum: true, ..Settings::default() };
    adjust(&mut survey.clone(), &settings).unwrap();
    // One control point holds its position only.
    survey.ground[0].role = Role::Control;
    let message = refused(&survey, &Settings::default());
    assert!(message.contains("whole block is free in 4 direction(s)"), "{message}");
}

#[test]
fn priors_and_held_entries_are_kept() {
    let truth = with_positions(truth(&Plan { tie_points: 80, ..Plan::default() }));
    let mut survey = measured(&truth, 72, NOISE);
    free(&mut survey, &["c_px", "xp_px", "K1"]);
    // So well known that nothing moves it.
    survey.cameras[0].standard_deviations[1] = Some(1e-6);
    let before = survey.cameras[0].interior.values().to_vec();
    let adjusted = adjust(&mut survey, &Settings::default()).unwrap();
    let after = survey.cameras[0].interior.values();
    assert!((before[1] - after[1]).abs() < 1e-6 && before[0] != after[0] && before[4] != after[4]);
    assert_eq!((before[2], before[5], before[7]), (after[2], after[5], after[7]));
    let interior = &adjusted.statistics.interiors[0];
    assert_eq!(interior.names, ["c_px", "xp_px", "K1"]);
    assert!((interior.standard_deviations[1] / 1e-6 - 1.0).abs() < 1e-3);
    for i in 0..3 {
        assert_eq!(interior.correlation[i][i], 1.0);
        for j in 0..3 {
            assert!((interior.correlation[i][j] - interior.correlation[j][i]).abs() < 1e-9);
        }
    }
}

#[test]
fn two_cameras_have_interior_orientations_of_their_own() {
    let mut truth = with_positions(truth(&Plan::default()));
    let other = truth.cameras[0].clone();
    truth.cameras.push(other);
    truth.images.iter_mut().skip(1).step_by(2).for_each(|image| image.camera = 1);
    let mut survey = measured(&truth, 73, NOISE);
    for (camera, c_px) in survey.cameras.iter_mut().zip([903.0, 896.0]) {
        camera.set_free(&["c_px"]).unwrap();
        let mut values = camera.interior.values().to_vec();
        values[0] = c_px;
        camera.interior = camera.interior.with_values(&values).unwrap();
    }
    let adjusted = adjust(&mut survey, &Settings::default()).unwrap();
    for (camera, interior) in survey.cameras.iter().zip(&adjusted.statistics.interiors) {
        let error = camera.interior.principal_distance_px() - 900.0;
        assert!(error.abs() < 4.0 * interior.standard_deviations[0], "{error} {interior:?}");
        assert!(interior.standard_deviations[0] < 2.0);
    }
}

/// Points are eliminated as they are linearised, and lenses share a layout in which only what one of them frees
/// has a place; the sparse system is put together from whole Jacobians.
#[test]
fn lenses_that_free_different_parameters_are_adjusted_as_by_the_whole_system() {
    for (velocity_m_s, tie_loss) in [(None, Loss::Trivial), (Some(8.0), Loss::SoftL1(1.0))] {
        let plan = Plan { tie_points: 80, velocity_m_s, ..Plan::default() };
        let mut truth = with_positions(truth(&plan));
        for _ in 0..2 {
            truth.cameras.push(truth.cameras[0].clone());
        }
        truth.images.iter_mut().enumerate().for_each(|(k, image)| image.camera = k % 3);
        let mut survey = measured(&truth, 74, NOISE);
        // One holds all of its parameters.
        for (camera, names) in survey.cameras.iter_mut().zip([&["c_px", "K1"][..], &["yp_px"], &[]])
        {
            camera.set_free(names).unwrap();
        }
        let settings = Settings { tie_loss, ..Settings::default() };
        let adjusted = [LinearSolver::Schur, LinearSolver::Sparse].map(|linear| {
            let mut survey = survey.clone();
            let posed = AdjustmentProblem::new(&survey, &settings).unwrap();
            let mut x = posed.problem.start();
            let options = Options { linear, ..settings.engine() };
            solve(&posed.problem, &mut x, &options, 100).unwrap();
            posed.update(&x, &mut survey);
            survey
        });
        for k in 0..3 {
            let [schur, sparse] = adjusted.each_ref().map(|s| s.cameras[k].interior.values());
            let before = survey.cameras[k].interior.values();
            for (p, free) in survey.cameras[k].free.iter().enumerate() {
                let near = 1e-6 * (schur[p] - before[p]).abs();
                assert!((schur[p] - sparse[p]).abs() <= near, "{k} {p}: {schur:?} {sparse:?}");
                assert_eq!(schur[p] != before[p], *free, "camera {k}, parameter {p}");
            }
        }
    }
}

/// Height errors of the check points after a block was bowed by a wrong lens, or was not.
fn heights_m(survey: &Reconstruction, settings: &Settings) -> f64 {
    let mut survey = survey.clone();
    let adjusted = adjust(&mut survey, settings).unwrap();
    let errors: Vec<f64> = adjusted.check_points.iter().map(|check| check.error_m[2]).collect();
    rmse(&errors, 0.95).unwrap().rmse_m
}

#[test]
fn doming_vanishes_with_control_and_self_calibration() {
    let plan =
        Plan { columns: 9, rows: 2, tie_points: 260, control: 14, checks: 6, ..Plan::default() };
    let exact = Noise { tie: 0.25, mark: 0.25, control: 0.25, position: 1.0 };
    let mut survey = measured(&truth(&plan), 81, exact);
    let mut values = survey.cameras[0].interior.values().to_vec();
    values[4] += 8e-8;
    survey.cameras[0].interior = survey.cameras[0].interior.with_values(&values).unwrap();
    // A free network with the wrong lens, fitted to the control afterwards, is bowed.
    let mut network = survey.clone();
    network.ground.iter_mut().for_each(|point| point.role = Role::Check);
    adjust(&mut network, &Settings { minimal_datum: true, ..Settings::default() }).unwrap();
    network.ground.clone_from(&survey.ground);
    align(&mut network).unwrap();
    // Where its check points are, the images being held.
    let bowed: Vec<f64> = {
        let mut held = network.clone();
        held.ground.iter_mut().for_each(|point| point.role = Role::Check);
        let settings = Settings { minimal_datum: true, ..Settings::default() };
        let adjusted = adjust(&mut held, &settings).unwrap();
        adjusted.check_points.iter().map(|check| check.error_m[2]).collect()
    };
    let bowed = rmse(&bowed, 0.95).unwrap().rmse_m;
    free(&mut survey, &["c_px", "K1"]);
    let flat = heights_m(&survey, &Settings::default());
    assert!(bowed > 5.0 * flat, "bowed {bowed}, flat {flat}");
    assert!(flat < 0.03, "{flat}");
    let found = {
        let mut survey = survey.clone();
        adjust(&mut survey, &Settings::default()).unwrap();
        survey.cameras[0].interior.value("K1").unwrap()
    };
    assert!((found - 6e-8).abs() < 1e-8, "{found}");
}

#[test]
fn a_rolling_shutter_tells_its_velocity() {
    let plan = Plan { velocity_m_s: Some(8.0), tie_points: 200, ..Plan::default() };
    let truth = with_positions(truth(&plan));
    let quiet = Noise { tie: 0.25, mark: 0.25, control: 0.25, position: 0.25 };
    let mut survey = measured(&truth, 91, quiet);
    let still = {
        let mut survey = survey.clone();
        survey.rolling_shutter = None;
        adjust(&mut survey, &Settings::default()).unwrap().statistics.sigma0
    };
    let adjusted = adjust(&mut survey, &Settings::default()).unwrap();
    let count = survey.images.len();
    let mean: f64 = (0..count)
        .map(|k| {
            let forward = if (k / plan.columns).is_multiple_of(2) { 1.0 } else { -1.0 };
            forward * survey.velocity_m_s(k).unwrap()[0] / count as f64
        })
        .sum();
    assert!((mean - 8.0).abs() < 0.8, "{mean}");
    assert!((adjusted.statistics.sigma0 - 0.25).abs() < 0.03, "{}", adjusted.statistics.sigma0);
    assert!(still > 1.2 * adjusted.statistics.sigma0, "{still}");
}

#[test]
fn the_corrected_domain_is_an_ablation() {
    let truth = with_positions(truth(&Plan { tie_points: 80, ..Plan::default() }));
    let mut survey = measured(&truth, 74, NOISE);
    free(&mut survey, &["c_px", "K1"]);
    let mut other = survey.clone();
    adjust(&mut survey, &Settings::default()).unwrap();
    let settings = Settings { corrected_domain: true, ..Settings::default() };
    adjust(&mut other, &settings).unwrap();
    let [a, b] = [&survey, &other].map(|s| s.cameras[0].interior.principal_distance_px());
    assert!(a != b && (a - b).abs() < 1.0, "{a} {b}");
    assert_eq!(toy::smac().model(), survey.cameras[0].interior.model());
}
