//! Control and positions that do not fix how a block lies, or contradict it: the block is there in any case, and what is
//! wrong is said.

use super::{
    any_flight::off_level,
    blocks::{adjusted_as, adjusted_with, grow, known, tracks},
    toy::{Flight, Flown},
};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};
use rowgram::{
    monitor::{Diagnostic, Severity},
    scene::{Axes, Role},
    sfm::{adjust_block::AdjustedBlock, georeference::Known},
};

fn flown() -> Flown {
    Flight { points: 1200, tilt_deg: 1.5, ..Flight::default() }.fly()
}

/// Only these points are control, the others check points.
fn with_control(known: &mut Known, names: &[&str]) {
    for point in &mut known.ground {
        let is = names.contains(&point.name.as_str());
        point.role = if is { Role::Control } else { Role::Check };
    }
}

fn severe<'a>(found: &'a AdjustedBlock, code: &str) -> Option<&'a Diagnostic> {
    found.diagnostics.iter().find(|d| d.code == code && d.severity == Severity::Error)
}

/// The block of `given`, which all photos are part of.
fn whole(flown: &Flown, given: &Known) -> AdjustedBlock {
    let (tracks, pairs) = tracks(flown);
    let found = adjusted_with(flown, given, grow(flown, &tracks, &pairs)).unwrap();
    let images = found.adjusted.reconstruction.images.len();
    assert_eq!(images, flown.poses.len(), "{:?}", found.diagnostics);
    for said in &found.diagnostics {
        assert!(!said.to_string().contains("factor"), "{said}");
    }
    found
}

#[test]
fn two_points_alone_leave_a_block_of_its_own() {
    let flown = flown();
    let mut given = known(&flown);
    given.positions.clear();
    with_control(&mut given, &["T4", "T5"]);
    let found = whole(&flown, &given);
    assert!(!found.georeferenced);
    assert!(severe(&found, "datum-undetermined").is_some(), "{:?}", found.diagnostics);
}

#[test]
fn points_in_a_line_leave_the_tilt_to_the_positions_and_the_sigmas_say_so() {
    let flown = flown();
    let mut given = known(&flown);
    // Three points of one row, and a receiver that is metres off.
    let line: Vec<String> = {
        let mut by_x: Vec<_> = given.ground.iter().collect();
        by_x.sort_by(|a, b| a.position_m[0].total_cmp(&b.position_m[0]));
        by_x.iter().take(3).map(|point| point.name.clone()).collect()
    };
    let names: Vec<&str> = line.iter().map(String::as_str).collect();
    with_control(&mut given, &names);
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let normal = Normal::new(0.0, 1.0).unwrap();
    for position in &mut given.positions {
        for (k, shift) in [2.0, -1.0, 3.0].into_iter().enumerate() {
            position.position_m[k] += shift + normal.sample(&mut rng);
        }
    }
    let found = whole(&flown, &given);
    assert!(found.georeferenced);
    assert!(severe(&found, "datum-weak").is_some(), "{:?}", found.diagnostics);
    let (tilt, _) = off_level(&flown, &found);
    println!("tilt {tilt:.2} degrees");
    assert!(tilt < 2.0, "{tilt}");
    // Errors are within what standard deviations say.
    let sigma0 = found.adjusted.statistics.sigma0;
    for check in &found.adjusted.check_points {
        let sigma = sigma0 * check.covariance_m2[2][2].sqrt();
        println!("{:.3} m, sigma {sigma:.3}", check.error_m[2]);
        assert!(check.error_m[2].abs() < 4.0 * sigma + 0.05, "{check:?}");
    }
}

#[test]
fn control_without_heights_places_the_plan() {
    let flown = flown();
    let mut given = known(&flown);
    for point in given.ground.iter_mut().filter(|point| point.role == Role::Control) {
        point.axes = Axes::Xy;
        point.position_m[2] = 0.0;
    }
    for position in &mut given.positions {
        position.position_m[0] += 3.0;
    }
    let found = whole(&flown, &given);
    assert!(severe(&found, "datum-weak").is_none());
    let (tilt, plan) = off_level(&flown, &found);
    assert!(tilt < 1.0 && plan < 0.6, "{tilt} {plan}");
    for check in &found.adjusted.check_points {
        assert!(check.error_m[0].hypot(check.error_m[1]) < 0.3, "{check:?}");
    }
}

#[test]
fn marks_that_are_meant_otherwise_are_named_and_not_used() {
    let flown = flown();
    for (word, written) in [
        ("exchanged", (|[u, v]: [f64; 2]| [v, u]) as fn([f64; 2]) -> [f64; 2]),
        ("bottom", |[u, v]| [u, 899.0 - v]),
        ("shares", |[u, v]| [(u + 0.5) / 1200.0, (v + 0.5) / 900.0]),
    ] {
        let mut given = known(&flown);
        for mark in &mut given.marks {
            mark.image_px = written(mark.image_px);
        }
        let found = whole(&flown, &given);
        let said = severe(&found, "marks-misread");
        assert!(said.is_some_and(|d| d.message.contains(word)), "{word}: {:?}", found.diagnostics);
        assert!(found.georeferenced, "the positions place it");
    }
}

#[test]
fn told_positions_are_believed_against_a_tilted_mount() {
    // A camera that hangs 8 degrees off its mount, and a receiver with fixed ambiguities.
    let mut flown = Flight { points: 1200, per_strip: 8, tilt_deg: 1.5, ..Flight::default() };
    flown.seed = 3;
    let flown = flown.fly_with_mount([0.10, 0.09]);
    let mut given = known(&flown);
    (given.ground, given.marks) = (Vec::new(), Vec::new());
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let normal = Normal::new(0.0, 0.02).unwrap();
    for position in &mut given.positions {
        position.position_m = flown.poses[position.image as usize].centre_m();
        position.position_m.iter_mut().for_each(|v| *v += normal.sample(&mut rng));
        position.sigma_m = [0.02; 3];
    }
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    let found = adjusted_as(&flown, &given, blocks, &vec![true; flown.poses.len()]).unwrap();
    let (tilt, plan) = off_level(&flown, &found);
    println!("tilt {tilt:.3} degrees, plan {plan:.3} m");
    assert!(tilt < 0.1, "{tilt} degrees");
    for image in &found.adjusted.reconstruction.images {
        let k = flown.features.iter().position(|f| f.name == image.name).unwrap();
        let off = image.pose.centre_m()[2] - flown.poses[k].centre_m()[2];
        assert!(off.abs() < 0.05, "{}: {off} m", image.name);
    }
}
