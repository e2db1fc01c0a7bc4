//! Any flight: parts of flights and spoiled positions give a block that is right, or a clear word.

use super::{
    blocks::{adjusted_with, grow, in_order, known, tracks},
    toy::{Flight, Flown},
};
use rand::{RngExt, SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;
use rowgram::{
    camera::Lens,
    error::Error,
    geometry::rotation,
    monitor::{Diagnostic, Severity},
    scene::Role,
    sfm::{adjust_block::AdjustedBlock, georeference::Known, verify::PairMatches},
};

/// A flight of some of the photos of another.
fn part(flown: &Flown, images: &[usize]) -> Flown {
    let place = |image: u32| images.iter().position(|&k| k == image as usize).map(|k| k as u32);
    let matched = flown.matched.iter().filter_map(|m| {
        let images = [place(m.images[0])?, place(m.images[1])?];
        Some(PairMatches { images, matches: m.matches.clone() })
    });
    let mut marks = flown.marks.clone();
    marks.retain_mut(|m| place(m.image).map(|k| m.image = k).is_some());
    let mut positions = flown.positions.clone();
    positions.retain_mut(|p| place(p.image).map(|k| p.image = k).is_some());
    Flown {
        cameras: flown.cameras.clone(),
        poses: images.iter().map(|&k| flown.poses[k]).collect(),
        features: images.iter().map(|&k| flown.features[k].clone()).collect(),
        matched: matched.collect(),
        ground: flown.ground.clone(),
        marks,
        positions,
    }
}

/// The largest angle by which the images of a block are turned against each other wrongly, degrees.
fn turned_deg(flown: &Flown, found: &AdjustedBlock) -> f64 {
    let images = &found.adjusted.reconstruction.images;
    let truth = |name: &str| {
        let k = flown.features.iter().position(|f| f.name == name).unwrap();
        flown.poses[k].rotation
    };
    let off: Vec<rotation::Quaternion> = images
        .iter()
        .map(|image| rotation::multiply(rotation::inverse(image.pose.rotation), truth(&image.name)))
        .collect();
    let angle = |q: &rotation::Quaternion| {
        let turn = rotation::log(rotation::multiply(*q, rotation::inverse(off[0])));
        turn.iter().map(|v| v * v).sum::<f64>().sqrt().to_degrees()
    };
    off.iter().map(angle).fold(0.0, f64::max)
}

#[test]
fn any_part_of_a_flight_is_a_block_or_is_said_to_be_none() {
    let flown = Flight { per_strip: 6, points: 900, ..Flight::default() }.fly();
    let mut rng = ChaCha8Rng::seed_from_u64(30);
    let mut whole = 0;
    for trial in 0..12 {
        let count = rng.random_range(3..13);
        let mut images: Vec<usize> = (0..flown.poses.len()).collect();
        if trial % 3 == 0 {
            let first = rng.random_range(0..=images.len() - count);
            images = images[first..first + count].to_vec();
        } else {
            images.shuffle(&mut rng);
            images.truncate(count);
            images.sort_unstable();
        }
        let part = part(&flown, &images);
        let mut given = known(&part);
        match trial % 4 {
            0 => given = Known::default(),
            1 => given.positions.clear(),
            2 => (given.ground, given.marks) = (Vec::new(), Vec::new()),
            _ => {}
        }
        let (tracks, pairs) = tracks(&part);
        let blocks = grow(&part, &tracks, &pairs);
        match adjusted_with(&part, &given, blocks) {
            Ok(found) => {
                whole += 1;
                let turned = turned_deg(&part, &found);
                assert!(turned < 3.0, "{images:?} {}: {turned} degrees", trial % 4);
            }
            Err(Error::Incomplete(_)) => {}
            Err(error) => panic!("{images:?} {}: {error}", trial % 4),
        }
    }
    assert!(whole >= 6, "{whole}");
}

/// The angle between the vertical of a block and the true one, degrees, and the error of its places in the plan, metres.
pub(super) fn off_level(flown: &Flown, found: &AdjustedBlock) -> (f64, f64) {
    let images = &found.adjusted.reconstruction.images;
    let (mut up, mut plan) = ([0.0; 3], 0.0_f64);
    for image in images {
        let k = flown.features.iter().position(|f| f.name == image.name).unwrap();
        let local = rotation::rotate(flown.poses[k].rotation, [0.0, 0.0, 1.0]);
        let back = rotation::rotate(rotation::inverse(image.pose.rotation), local);
        (0..3).for_each(|axis| up[axis] += back[axis]);
        let (a, b) = (image.pose.centre_m(), flown.poses[k].centre_m());
        plan += (a[0] - b[0]).hypot(a[1] - b[1]) / images.len() as f64;
    }
    (up[0].hypot(up[1]).atan2(up[2]).to_degrees(), plan)
}

#[test]
fn a_block_is_level_whatever_a_receiver_says_of_heights() {
    // What axes and heights of a few photos leave is part of the error: two dozen of a gimbal.
    let flown = Flight { points: 1200, per_strip: 8, tilt_deg: 1.5, ..Flight::default() }.fly();
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    let half = flown.poses.len() / 2;
    let last = (flown.poses.len() - 1) as f64;
    type Spoiled<'a> = (&'static str, &'a dyn Fn(usize, f64) -> f64, bool);
    let spoil: [Spoiled<'_>; 8] = [
        ("as measured", &|_, z| z, false),
        ("drift of 75", &|k, z| z + 75.0 * k as f64 / last, true),
        ("drift of -150", &|k, z| z - 150.0 * k as f64 / last, true),
        ("jump", &|k, z| if k < half { z } else { z + 60.0 }, true),
        ("late jump", &|k, z| if k < 18 { z } else { z - 30.0 }, true),
        ("high jump", &|k, z| if k < 7 { z } else { z + 150.0 }, true),
        ("constant", &|_, _| 0.0, false),
        ("swapped", &|_, z| -z, false),
    ];
    let mut plain = [0.0; 2];
    for (name, spoiled, says) in spoil {
        for told in [true, false] {
            let mut given = known(&flown);
            (given.ground, given.marks) = (Vec::new(), Vec::new());
            for (k, position) in given.positions.iter_mut().enumerate() {
                position.position_m[2] = spoiled(k, position.position_m[2]);
                position.sigma_m = if told { [0.5; 3] } else { [5.0; 3] };
            }
            let found = adjusted_told(&flown, &given, blocks.clone(), told);
            let (tilt, plan) = off_level(&flown, &found);
            let plain = &mut plain[usize::from(told)];
            if name == "as measured" {
                *plain = plan;
            }
            println!("{name} {told}: {tilt:.2} degrees, {plan:.3} m");
            assert!(tilt < 1.0, "{name} {told}: {tilt} degrees");
            assert!(plan < 1.5 * *plain + 0.05, "{name} {told}: {plan} m, {plain} m without");
            // What is usual for a receiver is said without a warning.
            let warns =
                |d: &Diagnostic| d.code == "heights-corrected" && d.severity == Severity::Warning;
            let said = found.diagnostics.iter().any(warns);
            assert_eq!(said, says, "{name} {told}: {:?}", found.diagnostics);
        }
    }
}

fn adjusted_told(
    flown: &Flown,
    given: &Known,
    blocks: Vec<rowgram::sfm::Block<'_>>,
    told: bool,
) -> AdjustedBlock {
    super::blocks::adjusted_as(flown, given, blocks, &vec![told; in_order(flown).len()]).unwrap()
}

#[test]
fn heights_that_jump_do_not_bend_a_block_with_control() {
    let flown = Flight { points: 1200, ..Flight::default() }.fly();
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    for jump in [0.0, 60.0] {
        let mut given = known(&flown);
        for position in &mut given.positions[8..] {
            position.position_m[2] += jump;
        }
        let found = adjusted_told(&flown, &given, blocks.clone(), true);
        let said = found.diagnostics.iter().any(|d| d.code == "heights-corrected");
        assert_eq!(said, jump > 0.0, "{:?}", found.diagnostics);
        for check in &found.adjusted.check_points {
            assert!(check.error_m.iter().all(|e| e.abs() < 0.12), "{jump}: {check:?}");
        }
        for group in &found.adjusted.statistics.groups {
            let most = group.observations as f64 + 1e-6;
            assert!((0.0..=most).contains(&group.redundancy), "{group:?}");
        }
    }
}

#[test]
fn positions_that_a_bent_block_contradicts_take_part_in_the_end() {
    let flown = Flight { points: 1200, ..Flight::default() }.fly();
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    let mut given = known(&flown);
    for position in &mut given.positions {
        position.position_m = flown.poses[position.image as usize].centre_m();
        position.sigma_m = [0.005; 3];
    }
    given.ground.iter_mut().for_each(|point| point.role = Role::Check);
    let found = adjusted_told(&flown, &given, blocks, true);
    let said = found.diagnostics.iter().filter(|d| d.code == "position-rejected").count();
    assert_eq!(said, 0, "{:?}", found.diagnostics);
    assert_eq!(found.adjusted.reconstruction.positions.len(), flown.poses.len());
}

#[test]
fn positions_that_do_not_fit_are_named_and_do_nothing() {
    let flown = Flight { points: 1200, ..Flight::default() }.fly();
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    let mut given = known(&flown);
    let wrong = [2, 6, 11];
    for image in wrong {
        given.positions[image].position_m[0] += 40.0;
        given.positions[image].position_m[1] -= 25.0;
    }
    given.positions.iter_mut().for_each(|position| position.sigma_m = [0.5; 3]);
    given.ground.iter_mut().for_each(|point| point.role = Role::Check);
    let found = adjusted_told(&flown, &given, blocks, true);
    for image in wrong {
        let name = &flown.features[image].name;
        let said = found.diagnostics.iter();
        assert_eq!(
            said.filter(|d| d.code == "position-rejected" && d.subject == *name).count(),
            1,
            "{name}: {:?}",
            found.diagnostics
        );
    }
    assert_eq!(found.adjusted.reconstruction.positions.len(), flown.poses.len() - wrong.len());
    assert!(found.adjusted.statistics.sigma0 < 1.5, "{}", found.adjusted.statistics.sigma0);
}

#[test]
fn an_orbit_around_a_heap_is_a_block_with_four_targets_and_without() {
    let flown = Flight { strips: 4, per_strip: 6, points: 1500, ..Flight::default() }.orbit();
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    for targets in [0, 4] {
        let mut given = known(&flown);
        // Some marks are where no camera could have the point.
        for mark in given.marks.iter_mut().step_by(9) {
            mark.image_px = [1150.0 - mark.image_px[0] / 3.0, 20.0];
        }
        let middle = |name: &str| ["T4", "T5", "T7", "T8"].contains(&name);
        for point in &mut given.ground {
            let is_control = targets > 0 && middle(&point.name);
            point.role = if is_control { Role::Control } else { Role::Check };
        }
        if targets == 0 {
            given = Known::default();
        }
        let found = adjusted_with(&flown, &given, blocks.clone()).unwrap();
        let adjusted = &found.adjusted;
        assert!(adjusted.reconstruction.images.len() >= 20, "{targets}");
        let (turned, summary) = (turned_deg(&flown, &found), &adjusted.summary);
        assert!(turned < 1.0, "{targets}: {turned} degrees");
        assert!(
            summary.final_cost <= summary.initial_cost,
            "{targets}: {} to {}",
            summary.initial_cost,
            summary.final_cost
        );
        assert_eq!(found.georeferenced, targets > 0);
    }
}

#[test]
fn control_that_is_to_be_kept_is_kept() {
    let flown = Flight { points: 1200, ..Flight::default() }.fly();
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    let mut given = known(&flown);
    let marks_of = |k: &usize| given.marks.iter().filter(|mark| mark.ground as usize == *k).count();
    let control = (0..given.ground.len()).filter(|&k| given.ground[k].role == Role::Control);
    let wrong = control.max_by_key(marks_of).unwrap();
    assert!(marks_of(&wrong) >= 3);
    given.ground[wrong].position_m[2] += 3.0;
    let name = given.ground[wrong].name.clone();
    for keep in [false, true] {
        given.keep = if keep { vec![name.clone()] } else { Vec::new() };
        let found = adjusted_with(&flown, &given, blocks.clone()).unwrap();
        let ground = &found.adjusted.reconstruction.ground;
        let takes_part = ground.iter().any(|p| p.name == name && p.role == Role::Control);
        assert!(takes_part || !keep, "{:?}", found.diagnostics);
        let about = |d: &&rowgram::monitor::Diagnostic| {
            d.code.ends_with("-rejected") && d.subject.split(' ').any(|word| word == name)
        };
        let rejected: Vec<_> = found.diagnostics.iter().filter(about).collect();
        assert_eq!(rejected.is_empty(), keep, "{name}: {rejected:?}");
    }
}

#[test]
fn marks_that_only_a_bent_block_contradicts_take_part_in_the_end() {
    // A lens that nobody knows leaves marks of the corners tens of pixels off before it is adjusted.
    let flown = Flight { points: 1200, ..Flight::default() }.fly();
    let (tracks, pairs) = tracks(&flown);
    let mut blocks = grow(&flown, &tracks, &pairs);
    for block in &mut blocks {
        for camera in &mut block.cameras {
            let mut values = camera.interior.values().to_vec();
            values[4] += 0.15;
            camera.interior = camera.interior.with_values(&values).unwrap();
        }
    }
    let given = known(&flown);
    let found = adjusted_with(&flown, &given, blocks).unwrap();
    let used = found.adjusted.reconstruction.marks.len();
    let said = |code: &str| found.diagnostics.iter().filter(|d| d.code == code).count();
    println!("{used} of {}, {}", given.marks.len(), said("observation-reconsidered"));
    assert_eq!(used, given.marks.len(), "{:?}", found.diagnostics);
    assert!(said("observation-reconsidered") > 0, "{:?}", found.diagnostics);
    assert_eq!(said("mark-rejected"), 0, "{:?}", found.diagnostics);
}
