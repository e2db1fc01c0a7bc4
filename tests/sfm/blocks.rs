//! From matches to a block in the map.

use super::toy::{Flight, Flown, lens};
use rowgram::{
    camera::Camera,
    error::Error,
    monitor::Silent,
    problems::adjustment::{Settings, adjust as judge},
    scene::Role,
    sfm::{
        adjust_block::{
            AdjustedBlock, BlockOptions, Flight as Given, Photos, ShutterModel, When, adjust_blocks,
        },
        block::Block,
        georeference::{
            Known, MarkReading, adjust, axes_exchanged, join, review_marks, weigh_positions,
        },
        incremental::{IncrementalOptions, reconstruct},
        rolling_shutter,
        tracks::Tracks,
        triangulate::TriangulationOptions,
        verify::{GeometricVerificationOptions, PairMatches, orient_pairs},
    },
};
use std::collections::HashSet;

const DEMANDS: TriangulationOptions =
    TriangulationOptions { tolerance_px: 3.0, min_angle_rad: 0.02 };

/// A camera that is four per cent off, and knows nothing of distortion.
fn guess() -> Vec<Camera> {
    let mut camera = lens(1040.0, 0.0);
    camera.standard_deviations[0] = Some(50.0);
    vec![camera]
}

pub(super) fn tracks(flown: &Flown) -> (Tracks, Vec<rowgram::sfm::Pair>) {
    let verifying = GeometricVerificationOptions {
        tolerance_px: 4.0,
        ..GeometricVerificationOptions::default()
    };
    let mut pairs = orient_pairs(&flown.features, &guess(), &flown.matched, &verifying, &|| ());
    let counts: Vec<usize> = flown.features.iter().map(|f| f.positions_px.len()).collect();
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    order.sort_by_key(|&k| (std::cmp::Reverse(pairs[k].matches.len()), pairs[k].images));
    let tracks = Tracks::join(
        &counts,
        order.iter().map(|&k| (pairs[k].images, pairs[k].matches.as_slice())),
    );
    pairs.sort_by_key(|pair| pair.images);
    (tracks, pairs)
}

pub(super) fn known(flown: &Flown) -> Known {
    Known {
        ground: flown.ground.clone(),
        marks: flown.marks.clone(),
        positions: flown.positions.clone(),
        ..Known::default()
    }
}

pub(super) fn grow<'a>(
    flown: &'a Flown,
    tracks: &'a Tracks,
    pairs: &[rowgram::sfm::Pair],
) -> Vec<Block<'a>> {
    let growing = IncrementalOptions::default();
    reconstruct(&flown.features, tracks, pairs, &guess(), &growing, |_| ()).unwrap()
}

/// The photos in the order in which they were taken.
pub(super) fn in_order(flown: &Flown) -> Vec<usize> {
    (0..flown.poses.len()).collect()
}

fn prepare(block: &mut Block<'_>) {
    for camera in &mut block.cameras {
        camera.set_free(&["f_px", "cx_px", "cy_px", "k1", "k2"]).unwrap();
        camera.standard_deviations[0] = None;
    }
}

#[test]
fn a_block_grows_whole_and_control_brings_it_into_the_map() {
    let flown = Flight::default().fly();
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    assert_eq!(blocks.len(), 1);
    assert_eq!(blocks[0].registered(), flown.poses.len());
    let mut known = known(&flown);
    known.positions.clear();
    let mut block = join(blocks, &mut known, &in_order(&flown), &DEMANDS).unwrap().block;
    prepare(&mut block);
    for _ in 0..3 {
        adjust(&mut block, &known, 0.4, &DEMANDS, 30).unwrap();
    }
    let (mut survey, _, order) = block.reconstruction(None);
    known.attach(&mut survey, &order);
    survey.tie_sigma_px = 0.3;
    let adjusted = judge(&mut survey, &Settings::default()).unwrap();
    assert_eq!(adjusted.check_points.len(), 4);
    // 5 cm per pixel; marks of a fifth of a pixel, three or more of each point.
    for check in &adjusted.check_points {
        assert!(check.error_m[0].abs() < 0.04 && check.error_m[1].abs() < 0.04, "{check:?}");
        assert!(check.error_m[2].abs() < 0.10, "{check:?}");
    }
    let c = adjusted.reconstruction.cameras[0].interior.principal_distance_px();
    assert!((c - 1000.0).abs() < 2.0, "{c}");
}

/// What the strategy makes of a flight with this control, without another look at the photos.
fn adjusted(flown: &Flown, known: &Known) -> AdjustedBlock {
    let (tracks, pairs) = tracks(flown);
    adjusted_with(flown, known, grow(flown, &tracks, &pairs)).unwrap()
}

/// The same of blocks that have grown.
pub(super) fn adjusted_with(
    flown: &Flown,
    known: &Known,
    blocks: Vec<Block<'_>>,
) -> Result<AdjustedBlock, Error> {
    adjusted_as(flown, known, blocks, &vec![false; flown.poses.len()])
}

/// The same with receivers that tell how accurate they are.
pub(super) fn adjusted_as(
    flown: &Flown,
    known: &Known,
    blocks: Vec<Block<'_>>,
    has_position_sigma: &[bool],
) -> Result<AdjustedBlock, Error> {
    let order = in_order(flown);
    let given = Given { known, order: &order, has_position_sigma, mark_scales: &[0.5, 2.0] };
    let read = |image: usize| Err(Error::Incomplete(format!("no photo {image}")));
    let photos = Photos { descriptors: &Vec::new(), matched: &flown.matched, read: &read };
    let options = BlockOptions {
        max_tie_observations: usize::MAX,
        tolerance_px: 4.0,
        shutter: ShutterModel::Auto(0.03),
        guided_matching: When::Off,
        refine_tie_points: When::Off,
        free: None,
        calibrated: false,
    };
    adjust_blocks(blocks, &given, &photos, &options, &mut Silent)
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn the_strategy_names_wrong_control_and_resized_marks_and_is_right_without() {
    let flown = Flight::default().fly();
    let mut known = known(&flown);
    let wrong = known.ground.iter().position(|point| point.role == Role::Control).unwrap();
    known.ground[wrong].position_m[0] += 5.0;
    for mark in &mut known.marks {
        mark.image_px = mark.image_px.map(|v| (v + 0.5) * 0.5 - 0.5);
    }
    let found = adjusted(&flown, &known);
    assert!(found.georeferenced && found.complete);
    let said = |code: &str| found.diagnostics.iter().find(|diagnostic| diagnostic.code == code);
    assert!(said("marks-resized").is_some_and(|d| d.message.contains("multiplied by 2")));
    let name = format!("control point {}", known.ground[wrong].name);
    let named = found.diagnostics.iter().any(|d| d.subject == name);
    assert!(named, "{:?}", found.diagnostics);
    assert!(said("rolling-shutter").is_none());
    assert_eq!(found.fragments.len(), 1);
    let checks: Vec<_> = found
        .adjusted
        .check_points
        .iter()
        .filter(|check| {
            found.checks.contains(&found.adjusted.reconstruction.ground[check.ground].name)
        })
        .collect();
    assert_eq!(checks.len(), 4);
    for check in checks {
        assert!(check.error_m.iter().all(|error| error.abs() < 0.12), "{check:?}");
    }
}

/// The first image sees what one neighbour does, of which others see but `shared` points.
fn at_the_edge(shared: usize) -> Flown {
    let mut flown = Flight { points: 6000, ..Flight::default() }.fly();
    let of_first = flown.matched.iter().filter(|pair| pair.images[0] == 0);
    let neighbour = of_first.max_by_key(|pair| pair.matches.len()).unwrap().images[1];
    let others =
        |pair: &&PairMatches| !pair.images.contains(&0) && pair.images.contains(&neighbour);
    let elsewhere: HashSet<u32> = flown
        .matched
        .iter()
        .filter(others)
        .flat_map(|pair| {
            let side = usize::from(pair.images[1] == neighbour);
            pair.matches.iter().map(move |m| m[side])
        })
        .collect();
    flown.matched.retain(|pair| pair.images[0] != 0 || pair.images[1] == neighbour);
    let mut left = shared;
    for pair in flown.matched.iter_mut().filter(|pair| pair.images[0] == 0) {
        pair.matches.retain(|m| {
            let known = elsewhere.contains(&m[1]);
            let kept = !known || left > 0;
            left -= usize::from(known && kept);
            kept
        });
    }
    flown
}

#[test]
fn an_image_joins_by_one_pair_and_a_few_points() {
    for (shared, joins) in [(6, true), (2, false)] {
        let flown = at_the_edge(shared);
        let (tracks, pairs) = tracks(&flown);
        let own = pairs.iter().filter(|pair| pair.images.contains(&0));
        assert_eq!(own.count(), 1);
        let blocks = grow(&flown, &tracks, &pairs);
        assert_eq!(blocks[0].poses[0].is_some(), joins, "{shared}");
        assert_eq!(blocks[0].registered(), flown.poses.len() - usize::from(!joins));
    }
}

/// The root mean square error of the check points along each axis, metres.
fn check_rmse_m(block: &Block<'_>, known: &Known) -> [f64; 3] {
    let (mut survey, _, order) = block.reconstruction(None);
    known.attach(&mut survey, &order);
    survey.tie_sigma_px = 0.3;
    let adjusted = judge(&mut survey, &Settings::default()).unwrap();
    assert_eq!(adjusted.check_points.len(), 4);
    std::array::from_fn(|k| {
        let squares: f64 = adjusted.check_points.iter().map(|c| c.error_m[k].powi(2)).sum();
        (squares / 4.0).sqrt()
    })
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn a_rolling_shutter_is_found_where_there_is_one_and_only_there() {
    for readout_displacement_m in [0.0, 0.5] {
        let flown = Flight { readout_displacement_m, ..Flight::default() }.fly();
        let (tracks, pairs) = tracks(&flown);
        let blocks = grow(&flown, &tracks, &pairs);
        let mut known = known(&flown);
        known.positions.clear();
        let mut block = join(blocks, &mut known, &in_order(&flown), &DEMANDS).unwrap().block;
        assert_eq!(block.registered(), flown.poses.len());
        prepare(&mut block);
        for _ in 0..3 {
            adjust(&mut block, &known, 0.4, &DEMANDS, 30).unwrap();
        }
        let flight: Vec<usize> = (0..flown.poses.len()).collect();
        let found = rolling_shutter::estimate(&block, &known, &flight, 0.4, 0.03, false).unwrap();
        if readout_displacement_m == 0.0 {
            assert_eq!(found, None);
            continue;
        }
        // Half a metre from 50 m is 10 pixels.
        let drift = found.unwrap();
        assert!(
            (drift.readout_displacement_m - readout_displacement_m).abs() < 0.02,
            "{}",
            drift.readout_displacement_m
        );
        assert!(
            (drift.readout_displacement_px - 10.0).abs() < 1.5,
            "{}",
            drift.readout_displacement_px
        );
        let without = check_rmse_m(&block, &known);
        drift.apply(&mut block);
        for _ in 0..2 {
            adjust(&mut block, &known, 0.4, &DEMANDS, 30).unwrap();
        }
        let with = check_rmse_m(&block, &known);
        let plan = |rmse: [f64; 3]| rmse[0].hypot(rmse[1]);
        assert!(plan(with) < 0.05 && plan(with) < 0.5 * plan(without), "{with:?} {without:?}");
    }
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn what_is_known_beforehand_counts_once_however_often_a_block_is_adjusted() {
    let flown = Flight { readout_displacement_m: 0.5, ..Flight::default() }.fly();
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    let mut known = known(&flown);
    known.positions.clear();
    let mut block = join(blocks, &mut known, &in_order(&flown), &DEMANDS).unwrap().block;
    prepare(&mut block);
    adjust(&mut block, &known, 0.4, &DEMANDS, 30).unwrap();
    let flight: Vec<usize> = (0..flown.poses.len()).collect();
    let drift =
        rolling_shutter::estimate(&block, &known, &flight, 0.4, 0.03, true).unwrap().unwrap();
    drift.apply(&mut block);
    let c_px = |block: &Block<'_>| block.cameras[0].interior.principal_distance_px();
    let adjusted = |block: &mut Block<'_>, times: usize| {
        for _ in 0..times {
            adjust(block, &known, 0.4, &DEMANDS, 30).unwrap();
        }
        c_px(block)
    };
    let free = adjusted(&mut block, 3);
    // The guess was 1040, the truth is 1000; it is held about as firmly as the block holds its own.
    block.cameras[0].standard_deviations[0] = Some(1.0);
    let once = adjusted(&mut block, 3);
    let often = adjusted(&mut block, 6);
    assert!(once - free > 1.0 && 1040.0 - once > 1.0, "{free} {once}");
    assert!((often - once).abs() < 0.02 * (once - free), "{free} {once} {often}");
    // Nor do the images leave the common way, step by step.
    let away = |block: &Block<'_>| -> f64 {
        let both = block.motions.iter().zip(&block.expected_motions);
        both.map(|(found, expected)| {
            (3..6).map(|k| (found[k] - expected[k]).powi(2)).sum::<f64>().sqrt()
        })
        .fold(0.0, f64::max)
    };
    let before = away(&block);
    adjusted(&mut block, 6);
    assert!(before > 0.0 && away(&block) < 1.02 * before, "{before} {}", away(&block));
}

#[test]
fn positions_alone_bring_it_there_too() {
    let flown = Flight::default().fly();
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    let mut known = known(&flown);
    known.ground.clear();
    known.marks.clear();
    // One position is far out.
    known.positions[4].position_m[0] += 60.0;
    let joined = join(blocks, &mut known, &in_order(&flown), &DEMANDS).unwrap();
    assert!(joined.georeferenced);
    let mut block = joined.block;
    prepare(&mut block);
    let mut out = Vec::new();
    for _ in 0..3 {
        let fit = weigh_positions(&block, &mut known, &[]).unwrap();
        out.extend(fit.outliers.iter().map(|(image, _)| *image));
        assert!(fit.sigma_m[0] < 1.5 && fit.sigma_m[1] < 1.5, "{fit:?}");
        adjust(&mut block, &known, 0.4, &DEMANDS, 30).unwrap();
    }
    assert_eq!(out, [4]);
    for (pose, truth) in block.poses.iter().zip(&flown.poses) {
        let (a, b) = (pose.unwrap().centre_m(), truth.centre_m());
        let off = (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt();
        assert!(off < 0.9, "{off}");
    }
}

#[test]
fn positions_that_drift_weigh_less_where_there_is_control() {
    let flown = Flight::default().fly();
    let (tracks, pairs) = tracks(&flown);
    let mut known = known(&flown);
    let count = known.positions.len() as f64;
    for (k, position) in known.positions.iter_mut().enumerate() {
        position.position_m[0] += 2.0 * (4.0 * k as f64 / count).sin();
        position.sigma_m = [1.0; 3];
    }
    let told = vec![Some([1.0; 3]); known.positions.len()];
    let mut block =
        join(grow(&flown, &tracks, &pairs), &mut known, &in_order(&flown), &DEMANDS).unwrap().block;
    prepare(&mut block);
    adjust(&mut block, &known, 0.4, &DEMANDS, 30).unwrap();
    let fit = weigh_positions(&block, &mut known, &told).unwrap();
    assert!(fit.together[0] > 2.0, "{fit:?}");
    for position in &known.positions {
        assert_eq!(position.sigma_m[0], fit.together[0].sqrt());
        assert_eq!(position.sigma_m[2], fit.together[1].sqrt());
    }
    // Asked once more, the same: what was told is what it starts from. Without control nothing is made larger.
    let again = weigh_positions(&block, &mut known, &told).unwrap();
    assert_eq!(again, fit);
    known.ground.clear();
    weigh_positions(&block, &mut known, &told).unwrap();
    assert!(known.positions.iter().all(|position| position.sigma_m == [1.0; 3]));
}

#[test]
fn pieces_that_share_nothing_are_joined_by_positions() {
    let mut flown = Flight { strips: 2, per_strip: 6, ..Flight::default() }.fly();
    // Nothing matches between the first three and the last three of each strip.
    let part = |k: u32| (k % 6 < 3) ^ (k / 6 == 1);
    flown.matched.retain(|m| part(m.images[0]) == part(m.images[1]));
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    assert_eq!(blocks.len(), 2);
    let mut known = known(&flown);
    known.ground.clear();
    known.marks.clear();
    let joined = join(blocks, &mut known, &in_order(&flown), &DEMANDS).unwrap();
    assert_eq!(joined.block.registered(), 12);
    assert!(joined.alignments.iter().all(Option::is_some));
}

#[test]
fn marks_and_coordinates_that_cannot_be_are_found() {
    let flown = Flight::default().fly();
    let (tracks, pairs) = tracks(&flown);
    let blocks = grow(&flown, &tracks, &pairs);
    let demands = TriangulationOptions { tolerance_px: 8.0, min_angle_rad: 0.01 };
    let scales = [0.25, 0.5, 2.0, 4.0];

    let mut good = known(&flown);
    let review = review_marks(&blocks[0], &mut good, &scales, true, &demands);
    assert!(review.reading == MarkReading::Pixels && review.wrong.is_empty(), "{review:?}");
    assert!(!axes_exchanged(&blocks[0], &good));

    let mut moved = known(&flown);
    moved.marks[7].image_px[0] += 90.0;
    let (image, ground) = (moved.marks[7].image, moved.marks[7].ground);
    let review = review_marks(&blocks[0], &mut moved, &scales, true, &demands);
    assert_eq!(review.wrong.len(), 1);
    assert_eq!((review.wrong[0].image, review.wrong[0].ground), (image, ground));
    assert_eq!(moved.marks.len() + 1, flown.marks.len());

    let mut resized = known(&flown);
    for mark in &mut resized.marks {
        mark.image_px = mark.image_px.map(|v| (v + 0.5) * 0.5 - 0.5);
    }
    let review = review_marks(&blocks[0], &mut resized, &scales, true, &demands);
    assert_eq!(review.reading, MarkReading::Resized(2.0));
    assert!((resized.marks[3].image_px[0] - flown.marks[3].image_px[0]).abs() < 1e-9);

    // Marks that are meant otherwise: what they are is found.
    let size = blocks[0].lens(0).size_px();
    let [width, height] = size.map(f64::from);
    for (reading, written) in [
        (MarkReading::Exchanged, (|[u, v]: [f64; 2], _| [v, u]) as fn([f64; 2], [f64; 2]) -> _),
        (MarkReading::FromBottom, |[u, v], [_, h]| [u, h - 1.0 - v]),
        (MarkReading::Shares, |[u, v], [w, h]| [(u + 0.5) / w, (v + 0.5) / h]),
    ] {
        let mut meant = known(&flown);
        for mark in &mut meant.marks {
            mark.image_px = written(mark.image_px, [width, height]);
        }
        let review = review_marks(&blocks[0], &mut meant, &scales, true, &demands);
        assert_eq!(review.reading, reading);
        assert!((meant.marks[3].image_px[1] - flown.marks[3].image_px[1]).abs() < 1e-9);
    }
    // None of them fits.
    let mut nonsense = known(&flown);
    for (k, mark) in nonsense.marks.iter_mut().enumerate() {
        mark.image_px = [(k * 397 % 1000) as f64, (k * 211 % 700) as f64];
    }
    let review = review_marks(&blocks[0], &mut nonsense, &scales, true, &demands);
    assert!(review.is_contradiction, "{review:?}");

    let mut exchanged = known(&flown);
    exchanged.ground.iter_mut().for_each(|point| point.position_m.swap(0, 1));
    assert!(axes_exchanged(&blocks[0], &exchanged));

    // Control five metres off, at the rim where one photo shows it and in the middle.
    for name in ["T0", "T4"] {
        let mut wrong = known(&flown);
        wrong.ground.iter_mut().for_each(|point| point.role = Role::Control);
        let place = wrong.ground.iter().position(|point| point.name == name).unwrap();
        wrong.ground[place].position_m[0] += 5.0;
        let marks = wrong.marks.iter().filter(|mark| mark.ground as usize == place).count();
        assert_eq!(marks == 1, name == "T0");
        let joined = join(blocks.clone(), &mut wrong, &in_order(&flown), &DEMANDS).unwrap();
        let alignment = joined.alignments[0].as_ref().unwrap();
        let named: Vec<&str> = alignment.misfits.iter().map(|(n, _)| n.as_str()).collect();
        assert!(named.contains(&name) && alignment.misfits.len() <= 2, "{name}: {alignment:?}");
        let left_m = alignment.misfits.iter().find(|(n, _)| n == name).unwrap().1;
        assert!((4.0..6.0).contains(&left_m), "{name}: {left_m}");
    }
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let flown = Flight { strips: 2, per_strip: 3, ..Flight::default() }.fly();
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let (tracks, pairs) = tracks(&flown);
            let blocks = grow(&flown, &tracks, &pairs);
            (blocks[0].poses.clone(), blocks[0].points.clone())
        })
    };
    assert_eq!(run(1), run(4));
}
