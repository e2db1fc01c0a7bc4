//! A block closes: truth, projected by an independent formula, gives the measurements.

use crate::{moments, proportion_agrees};
use data_synth::block::{Block, BlockConfig, ForwardCamera, Observation, write_bal};
use std::collections::BTreeMap;

fn small() -> BlockConfig {
    BlockConfig { images: 40, points: 4000, sigma_px: 0.0, ..BlockConfig::default() }
}

/// Residual of one measurement by the definition, with the rotation by Rodrigues' vector formula
/// `X cos a + (n x X) sin a + n (n . X)(1 - cos a)`.
fn residual_px(camera: &[f64; 9], point: &[f64; 3], observation: &Observation) -> [f64; 2] {
    let angle = (0..3).map(|i| camera[i] * camera[i]).sum::<f64>().sqrt();
    let n = [0, 1, 2].map(|i| if angle > 0.0 { camera[i] / angle } else { 0.0 });
    let dot = (0..3).map(|i| n[i] * point[i]).sum::<f64>();
    let cross = [
        n[1] * point[2] - n[2] * point[1],
        n[2] * point[0] - n[0] * point[2],
        n[0] * point[1] - n[1] * point[0],
    ];
    let (sin, cos) = angle.sin_cos();
    let p = [0, 1, 2]
        .map(|i| point[i] * cos + cross[i] * sin + n[i] * dot * (1.0 - cos) + camera[3 + i]);
    let p = [-p[0] / p[2], -p[1] / p[2]];
    let r2 = p[0] * p[0] + p[1] * p[1];
    let scale = camera[6] * (1.0 + camera[7] * r2 + camera[8] * r2 * r2);
    [scale * p[0] - observation.measured_px[0], scale * p[1] - observation.measured_px[1]]
}

fn residuals(block: &Block, cameras: &[[f64; 9]], points: &[[f64; 3]]) -> Vec<[f64; 2]> {
    let observations = block.observations.iter();
    observations.map(|o| residual_px(&cameras[o.camera], &points[o.point], o)).collect()
}

#[test]
fn exact_measurements_reproject_to_zero() {
    let block = Block::fly(&small()).unwrap();
    for residual in residuals(&block, &block.cameras_true, &block.points_true) {
        assert!(residual[0].abs() < 1e-8 && residual[1].abs() < 1e-8, "{residual:?}");
    }
}

#[test]
fn every_point_is_seen_twice_and_every_image_sees_its_share() {
    for (images, strips) in [(2, 0), (3, 3), (7, 2), (40, 0), (100, 5), (61, 0)] {
        let config = BlockConfig { images, strips, points: 20 * images, ..small() };
        let block = Block::fly(&config).unwrap();
        assert_eq!((block.cameras_true.len(), block.points_true.len()), (images, 20 * images));
        let mut of_point = BTreeMap::<usize, Vec<usize>>::new();
        let mut of_image = vec![0; images];
        for observation in &block.observations {
            of_point.entry(observation.point).or_default().push(observation.camera);
            of_image[observation.camera] += 1;
            assert!(observation.measured_px[0].abs() <= 0.5 * config.image_width_px);
            assert!(observation.measured_px[1].abs() <= 0.5 * config.image_height_px);
        }
        assert_eq!(of_point.len(), config.points);
        for images in of_point.values() {
            assert!(images.len() >= 2);
            assert!(images.windows(2).all(|pair| pair[0] < pair[1]), "each image once");
        }
        assert!(of_image.iter().all(|&count| count >= 20), "{of_image:?}");
    }
}

#[test]
fn tracks_are_as_long_as_asked_where_enough_images_see() {
    let config =
        BlockConfig { forward_overlap: 0.9, side_overlap: 0.8, mean_track: 3.0, ..small() };
    let block = Block::fly(&config).unwrap();
    let mean = block.observations.len() as f64 / block.points_true.len() as f64;
    assert!((mean - 3.0).abs() < 0.1, "{mean}");
}

#[test]
fn noise_and_outliers_alone_do_what_they_say() {
    let exact = Block::fly(&small()).unwrap();
    let noisy = Block::fly(&BlockConfig { sigma_px: 0.5, ..small() }).unwrap();
    assert_eq!(
        (&exact.cameras_true, &exact.points_true),
        (&noisy.cameras_true, &noisy.points_true)
    );
    let all: Vec<f64> = residuals(&noisy, &noisy.cameras_true, &noisy.points_true).concat();
    let (mean_px, sigma_px) = moments(&all);
    assert!(mean_px.abs() < 4.0 * 0.5 / (all.len() as f64).sqrt(), "{mean_px}");
    assert!((sigma_px / 0.5 - 1.0).abs() < 4.0 / (2.0 * all.len() as f64).sqrt(), "{sigma_px}");

    let gross = BlockConfig { outlier_fraction: 0.05, outlier_px: 50.0, ..small() };
    let gross = Block::fly(&gross).unwrap();
    let count = gross.observations.iter().filter(|o| o.outlier).count();
    assert!(proportion_agrees(count, gross.observations.len(), 0.05, 4.0), "{count}");
    for (o, e) in gross.observations.iter().zip(&exact.observations) {
        assert_eq!((o.camera, o.point), (e.camera, e.point));
        let far_px =
            f64::hypot(o.measured_px[0] - e.measured_px[0], o.measured_px[1] - e.measured_px[1]);
        let range = if o.outlier { 10.0 - 1e-9..=50.0 + 1e-9 } else { 0.0..=0.0 };
        assert!(range.contains(&far_px), "{far_px}");
    }
}

#[test]
fn cameras_fly_where_the_configuration_says() {
    let config = BlockConfig { images: 400, strips: 20, points: 4000, ..small() };
    let block = Block::fly(&config).unwrap();
    let cameras: Vec<ForwardCamera> = block.cameras_true.iter().map(ForwardCamera::new).collect();
    let heights: Vec<f64> = cameras.iter().map(|camera| camera.centre_m()[2]).collect();
    let (mean_m, deviation_m) = moments(&heights);
    assert!((mean_m - 100.0).abs() < 0.25 && (deviation_m - 1.0).abs() < 0.15);
    // Where the optical axis points: down, with the gimbal's noise in x and y.
    let tilts: Vec<f64> = cameras
        .iter()
        .flat_map(|camera| [camera.rotation[2][0], camera.rotation[2][1]])
        .map(|part| part.asin().to_degrees())
        .collect();
    let (mean_deg, deviation_deg) = moments(&tilts);
    assert!(mean_deg.abs() < 0.25 && (deviation_deg - 1.5).abs() < 0.15, "{deviation_deg}");
    // The image's y axis points along the flight: east on even strips, west on odd ones.
    for (image, camera) in cameras.iter().enumerate() {
        let east = camera.rotation[1][0];
        assert!(if (image / 20) % 2 == 0 { east > 0.9 } else { east < -0.9 }, "{image}: {east}");
    }
    // Forward overlap 75 % of 4000 px at 100 m and f = 4386 px: 22.8 m between images.
    let base_m = cameras[19].centre_m()[0] - cameras[0].centre_m()[0];
    assert!((base_m / 19.0 - 22.8).abs() < 0.25, "{base_m}");
}

#[test]
fn the_start_is_as_far_from_the_truth_as_asked() {
    let block = Block::fly(&BlockConfig { images: 400, points: 4000, ..small() }).unwrap();
    let (mut centres, mut angles) = (Vec::new(), Vec::new());
    for (truth, start) in block.cameras_true.iter().zip(&block.cameras_start) {
        let (truth, start) = (ForwardCamera::new(truth), ForwardCamera::new(start));
        for (a, b) in truth.centre_m().into_iter().zip(start.centre_m()) {
            centres.push(b - a);
        }
        // Rows of the two rotations differ by the small turn's sine.
        for (i, j) in [(0, 1), (1, 2), (2, 0)] {
            let sine: f64 = (0..3).map(|k| start.rotation[i][k] * truth.rotation[j][k]).sum();
            angles.push(sine.asin().to_degrees());
        }
        assert_eq!(start.focal_px(), 4386.0);
    }
    let points: Vec<f64> = block.points_true.concat();
    let start: Vec<f64> = block.points_start.concat();
    let points: Vec<f64> = points.iter().zip(&start).map(|(a, b)| b - a).collect();
    for (values, expected) in [(&centres, 0.5), (&angles, 0.3), (&points, 0.5)] {
        let (_, deviation) = moments(values);
        assert!((deviation / expected - 1.0).abs() < 0.1, "{deviation} for {expected}");
    }
    let known = BlockConfig {
        start: data_synth::block::StartError {
            rotation_deg: 0.0,
            centre_m: 0.0,
            point_m: 0.0,
            nominal_lens: false,
        },
        ..small()
    };
    let block = Block::fly(&known).unwrap();
    for residual in residuals(&block, &block.cameras_start, &block.points_start) {
        assert!(residual[0].abs() < 1e-7 && residual[1].abs() < 1e-7, "{residual:?}");
    }
}

#[test]
fn a_written_file_reads_back_bit_for_bit() {
    let block = Block::fly(&BlockConfig { images: 4, points: 60, ..small() }).unwrap();
    let mut bytes = Vec::new();
    write_bal(&block.cameras_true, &block.points_true, &block.observations, &mut bytes).unwrap();
    let text = String::from_utf8(bytes).unwrap();
    let numbers: Vec<f64> = text.split_whitespace().map(|word| word.parse().unwrap()).collect();
    let mut expected = vec![4.0, 60.0, block.observations.len() as f64];
    for observation in &block.observations {
        expected.extend([observation.camera as f64, observation.point as f64]);
        expected.extend(observation.measured_px);
    }
    expected.extend(block.cameras_true.concat());
    expected.extend(block.points_true.concat());
    assert_eq!(numbers, expected);
}

#[test]
fn every_bad_parameter_is_named() {
    type Change = fn(&mut BlockConfig);
    let bad: [(&str, Change); 22] = [
        ("seed", |c| c.seed = u64::MAX),
        ("images", |c| c.images = 1),
        ("strips", |c| c.strips = 1000),
        ("points", |c| c.points = 0),
        ("points", |c| c.points = 399),
        ("forward_overlap", |c| c.forward_overlap = 1.0),
        ("side_overlap", |c| c.side_overlap = -0.1),
        ("height_m", |c| c.height_m = 0.0),
        ("position_noise_m", |c| c.position_noise_m = 50.0),
        ("gimbal_noise_deg", |c| c.gimbal_noise_deg = f64::NAN),
        ("relief_m", |c| c.relief_m = 99.0),
        ("roughness_m", |c| c.roughness_m = -1.0),
        ("image_width_px", |c| c.image_width_px = 0.0),
        ("image_height_px", |c| c.image_height_px = f64::INFINITY),
        ("focal_px", |c| c.focal_px = 0.0),
        ("k1", |c| c.k1 = -0.6),
        ("k2", |c| c.k2 = 2.0),
        ("mean_track", |c| c.mean_track = 1.0),
        ("sigma_px", |c| c.sigma_px = -0.5),
        ("outlier_fraction", |c| c.outlier_fraction = 1.5),
        ("outlier_px", |c| c.outlier_px = f64::NAN),
        ("start.rotation_deg", |c| c.start.rotation_deg = -1.0),
    ];
    for (name, change) in bad {
        let mut config = small();
        change(&mut config);
        let error = Block::fly(&config).unwrap_err();
        assert_eq!(error.parameter, name, "{error}");
    }
}
