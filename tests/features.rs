//! Key points and descriptors against an independent implementation, and what they must withstand.

use crate::{data, program::rowgram};
use image::{GrayImage, Luma, imageops};
use kornia_imgproc::features::{FirstOctave, SiftConfig, SiftWorkspace, sift_detect_and_compute};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rowgram::{
    features::{
        FeatureOptions, Features, KeyPoint, Norm, Upscale, detect, grey,
        matching::{MatchOptions, match_descriptors},
    },
    io,
};
use std::f32::consts::{PI, TAU};

/// Blobs of several sizes at random places, smooth enough to be turned and resampled exactly.
struct Scene {
    /// Position, blur and brightness of each.
    blobs: Vec<[f64; 4]>,
}

impl Scene {
    fn new(seed: u64, (width, height): (f64, f64), count: usize) -> Scene {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut unit = || random.random::<f64>();
        let blobs = (0..count).map(|_| {
            let sign = if unit() < 0.5 { -1.0 } else { 1.0 };
            let blur = 1.0 + 4.0 * unit() * unit();
            [unit() * width, unit() * height, blur, sign * (30.0 + 60.0 * unit())]
        });
        Scene { blobs: blobs.collect() }
    }

    /// What a camera sees that takes its pixel `(u, v)` to `place(u, v)` of the scene.
    fn picture(&self, size: (u32, u32), place: impl Fn(f64, f64) -> (f64, f64)) -> GrayImage {
        GrayImage::from_fn(size.0, size.1, |u, v| {
            let (x, y) = place(f64::from(u), f64::from(v));
            let mut sum = 128.0;
            for &[at_x, at_y, blur, brightness] in &self.blobs {
                let square = ((x - at_x).powi(2) + (y - at_y).powi(2)) / (blur * blur);
                if square < 25.0 {
                    sum += brightness * (-0.5 * square).exp();
                }
            }
            Luma([sum.round().clamp(0.0, 255.0) as u8])
        })
    }
}

fn all() -> FeatureOptions {
    FeatureOptions { max_features: 0, ..FeatureOptions::default() }
}

/// Enlarged, it is wider and higher than the tiles that the search works in.
fn scene() -> GrayImage {
    Scene::new(1, (330.0, 160.0), 420).picture((321, 151), |u, v| (u, v))
}

/// OpenCV's key points and descriptors as kornia computes them.
fn oracle(picture: &GrayImage, first_octave: FirstOctave) -> (Vec<KeyPoint>, Vec<f32>) {
    let values: Vec<f32> = picture.as_raw().iter().copied().map(f32::from).collect();
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let (config, mut memory) = (SiftConfig::default(), SiftWorkspace::new());
    let found = sift_detect_and_compute(
        &mut memory,
        &values,
        width,
        height,
        &config,
        first_octave,
        usize::MAX,
        false,
    )
    .unwrap();
    let points = found.keypoints.iter().map(|point| KeyPoint {
        u_px: point.x,
        v_px: point.y,
        sigma_px: 0.5 * point.size,
        angle_rad: point.angle.to_radians(),
        response: point.response,
    });
    (points.collect(), found.descriptors)
}

fn turn_between(a: f32, b: f32) -> f32 {
    ((a - b + PI).rem_euclid(TAU) - PI).abs()
}

/// For each of `wanted` the nearest of `found` with its blur and direction, and how far it is.
fn counterparts(wanted: &[KeyPoint], found: &[KeyPoint]) -> Vec<Option<(usize, f32)>> {
    let of = |point: &KeyPoint| {
        found
            .iter()
            .enumerate()
            .filter(|(_, other)| (other.sigma_px / point.sigma_px).ln().abs() < 0.05)
            .filter(|(_, other)| turn_between(other.angle_rad, point.angle_rad) < 0.1)
            .map(|(k, other)| (k, (other.u_px - point.u_px).hypot(other.v_px - point.v_px)))
            .min_by(|a, b| a.1.total_cmp(&b.1))
    };
    wanted.iter().map(of).collect()
}

/// Share of `wanted` that are in `found` to a tenth of a pixel.
fn agreement(wanted: &[KeyPoint], found: &[KeyPoint]) -> f64 {
    let near = counterparts(wanted, found).iter().flatten().filter(|(_, off)| *off < 0.1).count();
    near as f64 / wanted.len() as f64
}

#[test]
fn key_points_and_descriptors_are_those_of_the_oracle() {
    let picture = scene();
    for (upscale, first_octave) in
        [(Upscale::HalfPixel, FirstOctave::Double), (Upscale::None, FirstOctave::Native)]
    {
        let (expected, descriptors) = oracle(&picture, first_octave);
        let found = detect(&picture, &FeatureOptions { upscale, norm: Norm::L2, ..all() });
        assert!(expected.len() > 100, "{} key points", expected.len());
        // The same formulas in another order of rounding; what differs are key points at the very
        // edge of a threshold.
        let (there, back) =
            (agreement(&expected, &found.key_points), agreement(&found.key_points, &expected));
        assert!(there > 0.98 && back > 0.98, "{upscale:?}: {there} and {back}");
        let own: Vec<_> = found.descriptors.iter().collect();
        let (mut close, mut compared) = (0, 0);
        for (index, other) in counterparts(&expected, &found.key_points).iter().enumerate() {
            let Some((other, _)) = other else { continue };
            let expected = &descriptors[128 * index..][..128];
            let square: f32 =
                expected.iter().zip(own[*other]).map(|(a, &b)| (a - f32::from(b)).powi(2)).sum();
            compared += 1;
            // Of a length of 512.
            close += usize::from(square.sqrt() < 10.0);
        }
        assert!(f64::from(close as u32) > 0.97 * compared as f64, "{close} of {compared}");
    }
}

#[test]
fn precise_enlargement_has_no_shift_and_the_other_a_quarter_of_a_pixel() {
    let picture = scene();
    let mirrored = imageops::flip_horizontal(&picture);
    let last = (picture.width() - 1) as f32;
    for (upscale, shift) in
        [(Upscale::Precise, 0.0), (Upscale::None, 0.0), (Upscale::HalfPixel, 0.25)]
    {
        let options = FeatureOptions { upscale, ..all() };
        let one = detect(&picture, &options).key_points;
        let mut other = detect(&mirrored, &options).key_points;
        for point in &mut other {
            point.u_px = last - point.u_px;
            point.angle_rad = (PI - point.angle_rad).rem_euclid(TAU);
        }
        let mut offsets: Vec<f32> = counterparts(&one, &other)
            .iter()
            .enumerate()
            .filter_map(|(k, found)| found.map(|(other, off)| (k, other, off)))
            .filter(|(_, _, off)| *off < 1.0)
            .map(|(k, index, _)| one[k].u_px - other[index].u_px)
            .collect();
        offsets.sort_by(f32::total_cmp);
        assert!(offsets.len() > one.len() * 8 / 10);
        let median = offsets[offsets.len() / 2];
        // A shift to the right in both pictures is twice the shift here.
        assert!((median - 2.0 * shift).abs() < 0.01, "{upscale:?}: {median}");
    }
}

#[test]
fn a_turned_and_enlarged_scene_is_recognised() {
    let scene = Scene::new(7, (300.0, 220.0), 400);
    let one = scene.picture((280, 200), |u, v| (u, v));
    let (zoom, angle) = (1.35f64, 0.6f64);
    let (sine, cosine) = angle.sin_cos();
    // From a pixel of the second picture to the scene.
    let place = |u: f64, v: f64| {
        let (x, y) = ((u - 150.0) / zoom, (v - 120.0) / zoom);
        (140.0 + cosine * x - sine * y, 100.0 + sine * x + cosine * y)
    };
    let other = scene.picture((300, 240), place);
    let (first, second) = (detect(&one, &all()), detect(&other, &all()));
    let matches =
        match_descriptors(&first.descriptors, &second.descriptors, &MatchOptions::default());
    let right = matches.iter().filter(|m| {
        let (a, b) = (first.key_points[m.first as usize], second.key_points[m.second as usize]);
        let (x, y) = place(b.u_px.into(), b.v_px.into());
        let near = (x - f64::from(a.u_px)).hypot(y - f64::from(a.v_px)) < 1.0;
        let scaled = (b.sigma_px / a.sigma_px / zoom as f32).ln().abs() < 0.2;
        near && scaled && turn_between(a.angle_rad, b.angle_rad + angle as f32) < 0.2
    });
    let right = right.count();
    assert!(right > 80 && right * 100 > matches.len() * 90, "{right} of {}", matches.len());
}

#[test]
fn threads_change_nothing() {
    let picture = scene();
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            detect(&picture, &FeatureOptions { max_features: 150, ..FeatureOptions::default() })
        })
    };
    let one = with(1);
    assert_eq!(one.key_points.len(), 150);
    assert_eq!(one, with(3));
}

#[test]
fn a_budget_is_kept_and_takes_from_what_there_is() {
    let picture = scene();
    let everything = detect(&picture, &all());
    let some = detect(&picture, &FeatureOptions { max_features: 64, ..FeatureOptions::default() });
    assert_eq!((some.key_points.len(), some.descriptors.len()), (64, 64));
    let known: Vec<(&KeyPoint, _)> =
        everything.key_points.iter().zip(everything.descriptors.iter()).collect();
    for feature in some.key_points.iter().zip(some.descriptors.iter()) {
        assert!(known.contains(&feature));
    }
    let plenty =
        detect(&picture, &FeatureOptions { max_features: 1_000_000, ..FeatureOptions::default() });
    assert_eq!(plenty, everything);
    // Every quarter of the picture gets its share.
    for left in [true, false] {
        let count = some.key_points.iter().filter(|p| (p.u_px < 160.0) == left).count();
        assert!((20..=44).contains(&count), "{count} of 64 in one half");
    }
}

#[test]
fn nothing_is_found_where_nothing_is() {
    for upscale in [Upscale::Precise, Upscale::HalfPixel, Upscale::None] {
        let options = FeatureOptions { upscale, ..all() };
        for (width, height) in [(0, 0), (0, 9), (1, 1), (5, 400), (11, 11), (64, 48), (300, 6)] {
            let flat = GrayImage::from_pixel(width, height, Luma([77]));
            let expected = Features { width_px: width, height_px: height, ..Features::default() };
            assert_eq!(detect(&flat, &options), expected, "{width} x {height} {upscale:?}");
        }
    }
    // One blob in the smallest pictures that can hold it; any answer will do.
    for side in 8..40 {
        let blob = GrayImage::from_fn(side, side, |u, v| {
            let square = (f64::from(u) - 4.0).powi(2) + (f64::from(v) - 4.0).powi(2);
            Luma([(255.0 * (-square / 6.0).exp()) as u8])
        });
        let found = detect(&blob, &all());
        assert_eq!(found.key_points.len(), found.descriptors.len());
    }
}

#[test]
fn grey_is_the_weighted_mean() {
    let colours = [[0, 0, 0], [255, 255, 255], [255, 0, 0], [0, 255, 0], [0, 0, 255], [3, 200, 90]];
    let photo = image::RgbImage::from_fn(6, 1, |u, _| image::Rgb(colours[u as usize]));
    // 0.299 R + 0.587 G + 0.114 B by hand.
    assert_eq!(grey(&photo).as_raw(), &[0, 255, 76, 150, 29, 129]);
}

/// Homography of the data set, row by row.
fn homography(path: &std::path::Path) -> [[f64; 3]; 3] {
    let text = std::fs::read_to_string(path).unwrap();
    let numbers: Vec<f64> = text.split_whitespace().map(|word| word.parse().unwrap()).collect();
    std::array::from_fn(|row| std::array::from_fn(|column| numbers[3 * row + column]))
}

#[test]
fn the_graffiti_wall_is_recognised_from_the_side() {
    let Some(folder) = data::path("match_graf") else { return };
    let load = |name: &str| grey(&io::images::read_photo(&folder.join(name)).unwrap());
    let options = FeatureOptions { max_features: 1500, ..FeatureOptions::default() };
    let first = detect(&load("img1.png"), &options);
    for (other, h, least) in [("img2.png", "H1to2p", 0.9), ("img3.png", "H1to3p", 0.7)] {
        let second = detect(&load(other), &options);
        let h = homography(&folder.join(h));
        let matches =
            match_descriptors(&first.descriptors, &second.descriptors, &MatchOptions::default());
        let right = matches.iter().filter(|m| {
            let a = first.key_points[m.first as usize];
            let b = second.key_points[m.second as usize];
            let [x, y, w] = h.map(|r| r[0] * f64::from(a.u_px) + r[1] * f64::from(a.v_px) + r[2]);
            (x / w - f64::from(b.u_px)).hypot(y / w - f64::from(b.v_px)) < 3.0
        });
        let share = right.count() as f64 / matches.len() as f64;
        assert!(matches.len() > 100 && share > least, "{other}: {share} of {}", matches.len());
    }
}

#[test]
fn photos_become_files_and_pictures() {
    let folder = tempfile::tempdir().unwrap();
    scene().save(folder.path().join("one.png")).unwrap();
    imageops::rotate90(&scene()).save(folder.path().join("two.png")).unwrap();
    let run = rowgram(
        folder.path(),
        "align features one.png two.png -o out --max-features 90 --figures pictures",
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert_eq!(
        run.stdout,
        "out/one.features.csv: 90 features\nout/two.features.csv: 90 features\n"
    );
    let table = std::fs::read_to_string(folder.path().join("out/two.features.csv")).unwrap();
    assert_eq!(table.lines().count(), 91);
    assert_eq!(table.lines().next(), Some("u_px,v_px,sigma_px,angle_rad,response"));
    assert!(folder.path().join("pictures/two.features.png").exists());
    let again = rowgram(folder.path(), "align features one.png -o out --max-features 90");
    assert_eq!(again.code, 2);
    assert!(again.stderr.contains("out/one.features.csv exists already"), "{}", again.stderr);

    let run = rowgram(
        folder.path(),
        "align match one.png two.png -o m.csv --figures pictures --max-features 0 --json --quiet",
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    let summary: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    let matches = summary["matches"].as_u64().unwrap() as usize;
    let table = std::fs::read_to_string(folder.path().join("m.csv")).unwrap();
    assert_eq!(table.lines().count(), matches + 1);
    let last = f64::from(scene().height() - 1);
    let right = table.lines().skip(1).filter(|line| {
        let n: Vec<f64> = line.split(',').map(|word| word.parse().unwrap()).collect();
        (last - n[1] - n[2]).hypot(n[0] - n[3]) < 0.5
    });
    let right = right.count();
    assert!(right > 80 && right * 100 > matches * 95, "{right} of {matches}");
    assert_eq!(image::open(folder.path().join("pictures/matches.png")).unwrap().width(), 321);
}

#[test]
fn what_cannot_be_used_is_named() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("b")).unwrap();
    for name in ["one.png", "b/one.png"] {
        GrayImage::from_fn(40, 30, |u, v| Luma([(u * v) as u8]))
            .save(folder.path().join(name))
            .unwrap();
    }
    for (words, message) in [
        ("align features gone.png -o out", "cannot read gone.png"),
        ("align features one.png b/one.png -o out", "one.png and b/one.png would both become"),
        (
            "align features one.png -o out --contrast nan",
            "--contrast NaN: expected a number from 0",
        ),
        ("align features one.png -o out --edge 0.5", "--edge 0.5: expected a number from 1"),
        (
            "align match one.png b/one.png -o m.csv --ratio 0",
            "ratio 0: expected a number greater than 0",
        ),
        ("align match one.png b/one.png -o one.png", "it is an input"),
    ] {
        let run = rowgram(folder.path(), words);
        assert_eq!(run.code, 2, "{words}: {}", run.stderr);
        assert!(run.stderr.contains(message), "{words}: {}", run.stderr);
    }
}
