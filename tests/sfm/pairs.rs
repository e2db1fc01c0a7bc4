//! Orientation of pairs among wrong matches.

use super::toy::Flight;
use nalgebra::{Matrix3, Vector3};
use rowgram::{
    geometry::rotation,
    sfm::{
        relative::Solver,
        verify::{GeometricVerificationOptions, orient_pairs},
    },
};

/// Errors of rotation and baseline direction, radians, of all pairs.
fn errors(flight: &Flight, solver: Solver) -> (usize, usize, Vec<[f64; 2]>) {
    let flown = flight.fly();
    let verifying = GeometricVerificationOptions {
        solver,
        tolerance_px: 2.0,
        ..GeometricVerificationOptions::default()
    };
    let pairs = orient_pairs(&flown.features, &flown.cameras, &flown.matched, &verifying, &|| ());
    let found = pairs.iter().map(|pair| {
        let [a, b] = pair.images.map(|k| flown.poses[k as usize]);
        let turn = rotation::matrix(rotation::multiply(b.rotation, rotation::inverse(a.rotation)));
        let turn = Matrix3::from_fn(|i, j| turn[i][j]);
        let base = Vector3::from(b.to_camera(a.centre_m())).normalize();
        let left = pair.pose.rotation * turn.transpose();
        [
            (0.5 * (left.trace() - 1.0)).clamp(-1.0, 1.0).acos(),
            pair.pose.translation.dot(&base).clamp(-1.0, 1.0).acos(),
        ]
    });
    (flown.matched.len(), pairs.len(), found.collect())
}

#[test]
fn both_solvers_orient_a_nadir_flight_among_wrong_matches() {
    for solver in [Solver::TwoPoint, Solver::FivePoint, Solver::Auto] {
        let flight = Flight { wrong_share: 0.5, per_strip: 4, strips: 2, ..Flight::default() };
        let (all, found, errors) = errors(&flight, solver);
        assert!(found >= all * 9 / 10, "{solver:?}: {found} of {all}");
        let mut turns: Vec<f64> = errors.iter().map(|e| e[0]).collect();
        turns.sort_by(f64::total_cmp);
        assert!(turns[turns.len() / 2] < 0.004, "{solver:?}: {turns:?}");
        let good = errors.iter().filter(|e| e[0] < 0.02 && e[1] < 0.1).count();
        assert!(good * 10 >= found * 9, "{solver:?}: {errors:?}");
    }
}

#[test]
fn two_points_need_no_luck_among_nine_wrong_of_ten() {
    let flight = Flight {
        wrong_share: 0.85,
        tilt_deg: 0.5,
        points: 4000,
        strips: 1,
        per_strip: 4,
        ..Flight::default()
    };
    let (all, found, errors) = errors(&flight, Solver::TwoPoint);
    let good = errors.iter().filter(|e| e[0] < 0.02).count();
    assert!(found + 1 >= all && good + 1 >= all, "{good} good of {found} of {all}: {errors:?}");
}
