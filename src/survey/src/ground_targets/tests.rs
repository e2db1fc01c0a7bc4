use super::{
    codes::APRILTAG,
    fit::{Jacobian, fit},
    patch::Patch,
    shape::Shape,
    *,
};
use crate::{
    camera::Camera,
    scene::{GroundObservation, Image, Pose, Role, TiePoint},
};
use data_synth::{
    patterns::TargetPattern,
    twin::{FlightPreset, Twin, TwinConfig},
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};
use rowgram_optim::geometry::rotation;

/// A picture of a shape: samples of its sharp pattern, spread over the area of a pixel and a blur, with noise.
fn picture(shape: &Shape, centre: [f64; 2], turn_rad: f64, side_px: f64, seed: u64) -> Patch {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (blur, noise) = (Normal::new(0.0, 0.6).unwrap(), Normal::new(0.0, 2.0).unwrap());
    let size = (2.0 * side_px) as usize + 12;
    let (sin, cos) = turn_rad.sin_cos();
    let data = (0..size * size).map(|k| {
        let mut sum = 0.0;
        const SAMPLES: usize = 400;
        for _ in 0..SAMPLES {
            let mut place = |at: usize, centre: f64| {
                at as f64 + rng.random_range(-0.5..0.5) + blur.sample(&mut rng) - centre
            };
            let (i, j) = (place(k % size, centre[0]), place(k / size, centre[1]));
            let q = [(i * cos + j * sin) / side_px, (j * cos - i * sin) / side_px];
            let [white, black] = shape.shares(q, 1e-6);
            sum += 90.0 + 130.0 * white - 60.0 * black;
        }
        (sum / SAMPLES as f64 + noise.sample(&mut rng)) as f32
    });
    Patch { origin_px: [0.0; 2], factor: 1.0, width: size, height: size, data: data.collect() }
}

#[test]
fn fits_have_no_bias_and_err_as_they_say() {
    let shapes = [
        (Shape::of(TargetKind::Chequered), 12.0),
        (Shape::of(TargetKind::Cross), 14.0),
        (Shape::of(TargetKind::Disc), 10.0),
        (Shape::coded(&APRILTAG, Some(7)), 30.0),
    ];
    let ground: Jacobian = [[100.0, 0.0], [0.0, 100.0]];
    for (number, (shape, side_px)) in shapes.iter().enumerate() {
        let (mut bias, mut squares, mut sigmas) = ([0.0; 2], 0.0, 0.0);
        const RUNS: u64 = 40;
        for run in 0..RUNS {
            let mut rng = ChaCha8Rng::seed_from_u64(1000 * number as u64 + run);
            let middle = side_px + 6.0;
            let centre = [0; 2].map(|_| middle + rng.random_range(-0.5..0.5));
            let turn_rad = rng.random_range(-0.15..0.15);
            let patch = picture(shape, centre, turn_rad, *side_px, run);
            let start =
                [middle + rng.random_range(-1.0..1.0), middle + rng.random_range(-1.0..1.0)];
            let found = fit(&patch, shape, (&ground, side_px / 100.0), start, 0.0).unwrap();
            assert!(found.score > 0.95, "{}", found.score);
            let off = [0, 1].map(|k| found.centre_px[k] - centre[k]);
            bias = [0, 1].map(|k| bias[k] + off[k] / RUNS as f64);
            squares += (off[0] * off[0] + off[1] * off[1]) / (2 * RUNS) as f64;
            sigmas += found.sigma_px / RUNS as f64;
        }
        let error = squares.sqrt();
        assert!(bias.iter().all(|b| b.abs() < 0.02), "{number}: bias {bias:?}");
        assert!(error < 0.05, "{number}: {error}");
        // The factor for residuals that are alike makes it careful here, where they are not.
        assert!(error < 1.3 * sigmas && error > 0.1 * sigmas, "{number}: {error} told {sigmas}");
    }
}

#[test]
fn what_is_no_code_is_not_read() {
    let wanted = Wanted::new(TargetKind::Apriltag, 0.3, 0.7);
    let ground: Jacobian = [[100.0, 0.0], [0.0, 100.0]];
    let right = picture(&Shape::coded(&APRILTAG, Some(30)), [40.0, 37.0], 0.4, 30.0, 3);
    let found = wanted.search(&right, &ground, [36.0; 2], 12.0);
    assert_eq!(found.candidates.len(), 1);
    assert_eq!(found.candidates[0].code, Some(30));
    for other in [Shape::of(TargetKind::Chequered), Shape::of(TargetKind::Disc)] {
        let patch = picture(&other, [36.0; 2], 0.2, 37.0, 4);
        assert_eq!(wanted.search(&patch, &ground, [36.0; 2], 20.0).candidates, []);
    }
}

/// A flight over few targets, as a block whose frame is off the survey by a shift.
struct Flight {
    twin: Twin,
    block: Reconstruction,
    points: Vec<GroundPoint>,
}

const SHIFT_M: [f64; 3] = [0.7, -0.5, 12.0];

fn flight(pattern: TargetPattern, size_m: f64) -> Flight {
    let mut config = TwinConfig::preset(FlightPreset::Small);
    config.field.rows = 12;
    config.field.row_length_m = 9.0;
    config.flight.strips = 2;
    config.flight.photos_per_strip = 3;
    (config.targets.control, config.targets.check) = (5, 2);
    (config.targets.pattern, config.targets.size_m) = (pattern, size_m);
    let twin = config.build().unwrap();
    let mut toml = Vec::new();
    data_synth::files::camera(&twin, &mut toml).unwrap();
    let camera = Camera::from_toml(&String::from_utf8(toml).unwrap()).unwrap();
    let images = twin.shots.iter().zip(0..).map(|(shot, id)| {
        let [o, p, k] = shot.angles_rad();
        let turns = [[0.0, 0.0, -k], [0.0, -p, 0.0], [-o, 0.0, 0.0]].map(rotation::exp);
        let turn = turns.into_iter().reduce(rotation::multiply).unwrap();
        let centre_m = std::array::from_fn(|k| shot.centre_m[k] + SHIFT_M[k]);
        Image {
            name: shot.name.clone(),
            id,
            camera: 0,
            pose: Pose::from_centre(turn, centre_m),
            motion: [0.0; 6],
            expected_motion: [0.0; 6],
        }
    });
    let ties = (0..400u64).map(|id| {
        let [x, y] = [(id % 20) as f64 - 10.0, (id / 20) as f64 - 10.0];
        let z = twin.field().terrain.height_m(x, y);
        let position_m = [x + SHIFT_M[0], y + SHIFT_M[1], z + SHIFT_M[2]];
        TiePoint { id, position_m, colour: [0; 3] }
    });
    let points = twin.targets.iter().map(|target| GroundPoint {
        name: target.label.clone(),
        position_m: target.surveyed_m,
        sigma_m: [0.02; 3],
        role: Role::Control,
        axes: Axes::Xyz,
    });
    let block = Reconstruction {
        cameras: vec![camera],
        images: images.collect(),
        points: ties.collect(),
        ..Reconstruction::default()
    };
    let points = points.collect();
    Flight { block, points, twin }
}

#[test]
#[ignore = "slow; renders the photos of five flights"]
fn targets_of_every_kind_are_found_in_a_block_that_is_off_and_none_is_wrong() {
    for (pattern, kind, size_m) in [
        (TargetPattern::Chequered, TargetKind::Chequered, 0.3),
        (TargetPattern::Cross, TargetKind::Cross, 0.4),
        (TargetPattern::Disc, TargetKind::Disc, 0.25),
        (TargetPattern::Apriltag, TargetKind::Apriltag, 0.45),
        (TargetPattern::Aruco, TargetKind::Aruco, 0.4),
    ] {
        let Flight { twin, block, points } = flight(pattern, size_m);
        let studio = twin.studio();
        let photo = |(image, shot)| crate::features::grey(&studio.photo(shot, image).image);
        let photos: Vec<image::GrayImage> = twin.shots.iter().enumerate().map(photo).collect();
        let read = |image: usize| Ok(photos[image].clone());
        let options = TargetSearch {
            kind: Some(kind),
            sizes_m: vec![size_m],
            search_m: 2.0,
            min_score: 0.7,
            tolerance_px: 3.0,
        };
        let found = find_targets(&block, &points, &options, &read).unwrap().unwrap();
        assert!((found.shift_m[2] - SHIFT_M[2]).abs() < 0.1, "{:?}", found.shift_m);
        let (mut errors, mut ratios, mut missed) = (Vec::new(), Vec::new(), Vec::new());
        for mark in &twin.marks {
            let sighting = (found.sightings.iter())
                .find(|s| s.ground == mark.target && s.image == mark.shot)
                .map(|s| s.outcome);
            match sighting {
                Some(Ok(measured)) => {
                    let [u, v] = measured.image_px;
                    let off = (u - mark.true_px[0]).hypot(v - mark.true_px[1]);
                    errors.push(off);
                    ratios.push(off / measured.sigma_px);
                    if let Some(code) = measured.code {
                        assert_eq!(code, twin.targets[mark.target].code);
                    }
                }
                other => missed.push((mark.shot, mark.target, other)),
            }
        }
        let unmarked = found.measurements().filter(|(s, _)| {
            !twin.marks.iter().any(|mark| mark.target == s.ground && mark.shot == s.image)
        });
        let unmarked = unmarked.count();
        errors.sort_by(f64::total_cmp);
        ratios.sort_by(f64::total_cmp);
        let median = |values: &[f64]| values.get(values.len() / 2).copied().unwrap_or(f64::NAN);
        println!(
            "{kind} {size_m} m: {} of {} found, {unmarked} beside, median {:.3} px, worst {:.3} px, error over sigma {:.2}; shift {:.3?} +- {:.3}; missed {missed:?}",
            errors.len(),
            twin.marks.len(),
            median(&errors),
            errors.last().copied().unwrap_or(f64::NAN),
            median(&ratios),
            found.shift_m,
            found.shift_sigma_m,
        );
        assert!(errors.len() as f64 >= 0.9 * twin.marks.len() as f64, "{kind}");
        assert!(errors.last().is_some_and(|&worst| worst < 1.0), "{kind}");
        assert!(median(&errors) < 0.15, "{kind}");
    }
}

#[test]
fn a_few_marks_tell_where_photos_show_the_other_points() {
    let Flight { twin, block, points } = flight(TargetPattern::Chequered, 0.3);
    let (views, grounds) = (views(&block), on_the_ground(&block, &points));
    let mark = |mark: &data_synth::targets::Mark| GroundObservation {
        image: mark.shot as u32,
        ground: mark.target as u32,
        image_px: mark.true_px,
        sigma_px: 0.5,
    };
    let mut marks: Vec<GroundObservation> =
        twin.marks.iter().filter(|mark| mark.target < 3).map(mark).collect();
    // The worst distance of a point without marks from where it truly appears, metres.
    let worst = |marks: &[GroundObservation]| {
        let found = expected_marks(&block, &views, &grounds, marks);
        let off_m = twin.marks.iter().filter(|mark| mark.target >= 3).map(|mark| {
            let own = &found.of_points[mark.target];
            let at = own.iter().find(|at| at.image == mark.shot)?;
            let [u, v] = at.image_px;
            Some((u - mark.true_px[0]).hypot(v - mark.true_px[1]) / at.px_per_m)
        });
        // What lies at the edge of a photo may be expected outside of it.
        let off_m: Vec<f64> = off_m.flatten().collect();
        assert!(off_m.len() >= 6, "{off_m:?}");
        (off_m.into_iter().fold(0.0, f64::max), found)
    };
    let (without, found) = worst(&[]);
    assert!(without > 0.5 && found.residuals_px.is_empty(), "{without}");
    let (with, found) = worst(&marks);
    assert!(with < 0.2, "{with}");
    assert!(found.residuals_px.iter().flatten().count() >= 4, "{found:?}");
    assert!(found.residuals_px.iter().flatten().all(|&off| off < 6.0), "{found:?}");
    // A slip of the hand stands out.
    marks[0].image_px[0] += 40.0;
    let (_, found) = worst(&marks);
    let slip = found.residuals_px[0];
    assert!(slip.is_none_or(|off| off > 20.0), "{slip:?}");
}
