//! Angles of a gimbal as observations: they level what positions leave open, yield to positions that say better, and are
//! taken out with a word where they are wrong.

use super::{
    any_flight::off_level,
    blocks::{adjusted_as, grow, known, tracks},
    toy::{Flight, Flown},
};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};
use rowgram::{
    geometry::rotation,
    scene::CameraOrientation,
    sfm::{adjust_block::AdjustedBlock, georeference::Known},
};

/// Positions alone, with noise of this standard deviation in plan and height, metres.
fn positions(flown: &Flown, sigma_m: [f64; 3], seed: u64) -> Known {
    let mut given = known(flown);
    (given.ground, given.marks) = (Vec::new(), Vec::new());
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let normal = Normal::new(0.0, 1.0).unwrap();
    for position in &mut given.positions {
        position.position_m = flown.poses[position.image as usize].centre_m();
        for (value, sigma) in position.position_m.iter_mut().zip(sigma_m) {
            *value += sigma * normal.sample(&mut rng);
        }
        position.sigma_m = sigma_m;
    }
    given
}

/// What a gimbal tells of the flight, with noise about the horizon and in heading and a common turn in the mapping frame.
fn told(
    flown: &Flown,
    noise_deg: [f64; 2],
    common_deg: [f64; 3],
    seed: u64,
) -> Vec<CameraOrientation> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let normal = Normal::new(0.0, 1.0).unwrap();
    let noise_deg = [noise_deg[0], noise_deg[0], noise_deg[1]];
    let of = |(pose, image): (&rowgram::scene::Pose, u32)| {
        let error = std::array::from_fn(|k| {
            (common_deg[k] + noise_deg[k] * normal.sample(&mut rng)).to_radians()
        });
        CameraOrientation {
            image,
            rotation: rotation::multiply(pose.rotation, rotation::exp(error)),
            sigma_rad: [1_f64, 1.0, 5.0].map(f64::to_radians),
        }
    };
    flown.poses.iter().zip(0..).map(of).collect()
}

fn adjusted(flown: &Flown, given: &Known, is_told: bool) -> AdjustedBlock {
    let (tracks, pairs) = tracks(flown);
    let blocks = grow(flown, &tracks, &pairs);
    adjusted_as(flown, given, blocks, &vec![is_told; flown.poses.len()]).unwrap()
}

fn has(found: &AdjustedBlock, code: &str) -> bool {
    found.diagnostics.iter().any(|said| said.code == code)
}

#[test]
fn a_line_of_oblique_photos_with_a_coarse_receiver_is_level_by_its_gimbal() {
    // The camera looks 11 degrees ahead and 5 aside, which no receiver on one line can tell.
    let flight =
        Flight { strips: 1, per_strip: 14, points: 1500, tilt_deg: 1.5, ..Flight::default() };
    let flown = flight.fly_with_mount([0.20, 0.09]);
    let mut given = positions(&flown, [1.5, 1.5, 3.0], 3);
    let without = off_level(&flown, &adjusted(&flown, &given, false)).0;
    given.orientations = told(&flown, [0.5, 2.0], [0.0, 0.0, 6.0], 4);
    for is_told in [false, true] {
        let found = adjusted(&flown, &given, is_told);
        let (tilt, plan) = off_level(&flown, &found);
        println!(
            "{is_told}: {tilt:.3} degrees, {plan:.2} m; without a gimbal {without:.2} degrees"
        );
        // A strip flown in one direction does not tell the tilt of a mount, which is known to 3 degrees: heights count along it.
        assert!(tilt < 1.5, "{is_told}: {tilt} degrees");
        assert!(without > 8.0, "{without}");
        let summary = found.orientations.as_ref().unwrap();
        assert_eq!(summary.photos, 14);
        assert!((0.3..0.8).contains(&summary.level_rms_deg), "{summary:?}");
        assert!(summary.contradiction_sigmas < 3.0, "{summary:?}");
        assert!(has(&found, "gimbal-used") && !has(&found, "gimbal-contradicts"));
    }
}

#[test]
fn a_gimbal_that_tells_of_another_flight_is_taken_out() {
    let flown = Flight { points: 1200, per_strip: 8, tilt_deg: 3.0, ..Flight::default() }.fly();
    let mut given = positions(&flown, [0.5; 3], 3);
    let plain = off_level(&flown, &adjusted(&flown, &given, false)).0;
    given.orientations = told(&flown, [0.5, 2.0], [0.0; 3], 4);
    // The records of the photos in another order.
    let rotations: Vec<_> = given.orientations.iter().map(|told| told.rotation).collect();
    for (k, told) in given.orientations.iter_mut().enumerate() {
        told.rotation = rotations[(5 * k + 3) % rotations.len()];
    }
    let found = adjusted(&flown, &given, false);
    let (tilt, _) = off_level(&flown, &found);
    println!("{tilt:.2} degrees, {plain:.2} without: {:?}", found.diagnostics);
    assert!(has(&found, "gimbal-rejected"), "{:?}", found.diagnostics);
    assert!(found.orientations.is_none());
    assert!((tilt - plain).abs() < 1e-6, "{tilt} {plain}");
}

#[test]
fn single_wrong_angles_are_named_and_the_others_used() {
    let flown = Flight { points: 1200, per_strip: 8, tilt_deg: 1.5, ..Flight::default() }.fly();
    let mut given = positions(&flown, [1.0, 1.0, 2.0], 3);
    given.orientations = told(&flown, [0.4, 2.0], [0.0; 3], 4);
    for image in [3, 17] {
        let told = &mut given.orientations[image].rotation;
        *told = rotation::multiply(rotation::exp([0.3, 0.1, 0.0]), *told);
    }
    let found = adjusted(&flown, &given, false);
    let said = found.diagnostics.iter().find(|said| said.code == "gimbal-rejected").unwrap();
    let names = [3, 17].map(|k: usize| flown.features[k].name.clone()).join(", ");
    assert_eq!(said.subject, names);
    assert_eq!(found.orientations.as_ref().unwrap().photos, 22);
    let (tilt, _) = off_level(&flown, &found);
    println!("{tilt:.3} degrees");
    assert!(tilt < 0.3, "{tilt}");
}

#[test]
fn positions_that_are_told_to_be_exact_win_against_a_gimbal_that_is_not_level() {
    let flown = Flight { points: 1200, per_strip: 8, tilt_deg: 1.5, ..Flight::default() }.fly();
    let mut given = positions(&flown, [0.02; 3], 3);
    for (common_deg, contradicts) in [([0.0; 3], false), ([3.0, -2.0, 0.0], true)] {
        given.orientations = told(&flown, [0.5, 2.0], common_deg, 4);
        let found = adjusted(&flown, &given, true);
        let (tilt, _) = off_level(&flown, &found);
        let images = &found.adjusted.reconstruction.images;
        let worst = images.iter().map(|image| {
            let k = flown.features.iter().position(|f| f.name == image.name).unwrap();
            (image.pose.centre_m()[2] - flown.poses[k].centre_m()[2]).abs()
        });
        let worst = worst.fold(0.0, f64::max);
        println!("{common_deg:?}: {tilt:.3} degrees, heights within {worst:.3} m");
        assert!(tilt < 0.1, "{tilt}");
        assert!(worst < 0.05, "{worst}");
        assert_eq!(has(&found, "gimbal-contradicts"), contradicts, "{:?}", found.diagnostics);
    }
}
