//! The detector: rendered boards whose corners are known, and real photos beside OpenCV's corners.

use crate::{
    boards::{CLEAN, Look, Pose, corners, normal, photo, pose, poses, wide},
    data,
};
use image::{GrayImage, Luma};
use rowgram::{
    camera::Interior,
    io::images,
    target::{Board, Detection, DetectionOptions, NotFound, detect},
};
use std::f64::consts::PI;

const SIZE: [u32; 2] = [640, 480];
/// One side even, one odd: its order is unique.
const UNIQUE: Board = Board { columns: 7, rows: 6 };

fn found(image: &GrayImage, board: Board) -> Detection {
    detect(image, board, &DetectionOptions::default()).unwrap()
}

/// Root mean square and largest distance to the true corners, pixels; where the board looks the same
/// after half a turn, in the better of both orders.
fn errors(detection: &Detection, board: Board, truth: &[Option<[f64; 2]>]) -> (f64, f64) {
    assert!(detection.complete);
    assert_eq!(detection.corners.len(), truth.len());
    let distances = |turned: bool| -> Vec<f64> {
        detection
            .corners
            .iter()
            .map(|c| {
                let k = c.row * board.columns + c.column;
                let p = truth[if turned { truth.len() - 1 - k } else { k }].unwrap();
                (c.image_px[0] - p[0]).hypot(c.image_px[1] - p[1])
            })
            .collect()
    };
    let symmetric = (board.columns + board.rows).is_multiple_of(2);
    let of = |d: Vec<f64>| {
        let rms = (d.iter().map(|x| x * x).sum::<f64>() / d.len() as f64).sqrt();
        (rms, d.iter().copied().fold(0.0, f64::max))
    };
    let (straight, turned) = (of(distances(false)), of(distances(true)));
    if symmetric && turned.0 < straight.0 { turned } else { straight }
}

fn look_at(board: Board, lens: &Interior, pose: &Pose, look: Look, seed: u64) -> (f64, f64) {
    let image = photo(board, lens, pose, look, seed);
    errors(&found(&image, board), board, &corners(board, lens, pose))
}

#[test]
fn corners_are_within_a_twentieth_of_a_pixel() {
    let lens = wide(SIZE);
    for (k, pose) in poses(UNIQUE, &lens, 6, 1).iter().enumerate() {
        let (rms, largest) = look_at(UNIQUE, &lens, pose, CLEAN, 0);
        assert!(rms < 0.05 && largest < 0.1, "pose {k}: rms {rms:.3}, largest {largest:.3}");
        let noisy = Look { noise: 3.0, ..CLEAN };
        let (rms, _) = look_at(UNIQUE, &lens, pose, noisy, k as u64);
        assert!(rms < 0.05, "pose {k} with noise: {rms:.3}");
    }
}

#[test]
fn tilt_roll_shade_and_blur_are_no_matter() {
    let lens = normal(SIZE);
    for about in [0.0, 0.8, PI / 2.0] {
        let tilted = pose(UNIQUE, [0.0, 0.0, -0.3], 60f64.to_radians(), about, 0.1);
        let (rms, _) = look_at(UNIQUE, &lens, &tilted, CLEAN, 0);
        assert!(rms < 0.05, "60 degrees about {about}: {rms:.3}");
    }
    for roll in [-2.8, -1.6, -0.7, 0.7, 1.5, 3.0] {
        let rolled = pose(UNIQUE, [0.01, 0.005, -0.4], 0.3, 0.4, roll);
        let (rms, _) = look_at(UNIQUE, &lens, &rolled, CLEAN, 0);
        assert!(rms < 0.05, "rolled by {roll}: {rms:.3}");
    }
    let straight = pose(UNIQUE, [0.0, 0.0, -0.4], 0.2, 0.3, 0.1);
    let shaded = Look { shade: 0.75, noise: 1.5, ..CLEAN };
    assert!(look_at(UNIQUE, &lens, &straight, shaded, 5).0 < 0.06);
    let blurred = Look { blur_px: 3.0, noise: 1.5, ..CLEAN };
    assert!(look_at(UNIQUE, &lens, &straight, blurred, 6).0 < 0.12);
    // Squares of some 10 pixels.
    let far = pose(UNIQUE, [0.05, -0.05, -1.6], 0.2, 0.3, 0.1);
    assert!(look_at(UNIQUE, &lens, &far, CLEAN, 0).0 < 0.05);
}

#[test]
fn corners_know_how_sharp_a_photo_is() {
    let lens = normal(SIZE);
    let place = pose(UNIQUE, [0.0, 0.0, -0.4], 0.4, 0.3, 0.1);
    let image = photo(UNIQUE, &lens, &place, CLEAN, 0);
    let sharp = found(&image, UNIQUE).edge_width_px;
    let blurred = photo(UNIQUE, &lens, &place, Look { blur_px: 3.0, ..CLEAN }, 0);
    let wide = found(&blurred, UNIQUE).edge_width_px;
    assert!(sharp < 2.6 && wide > 5.0, "{sharp} {wide}");
}

#[test]
fn a_large_photo_is_like_a_small_one() {
    let lens = wide([2000, 1500]);
    let board = Board { columns: 8, rows: 6 };
    let place = pose(board, [0.02, 0.0, -0.25], 0.5, 0.3, 0.1);
    let look = Look { blur_px: 0.7, noise: 3.0, shade: 0.3 };
    let (rms, _) = look_at(board, &lens, &place, look, 3);
    assert!(rms < 0.05, "{rms}");
}

#[test]
fn what_is_not_the_board_is_said() {
    let lens = normal(SIZE);
    let place = pose(UNIQUE, [0.0, 0.0, -0.4], 0.2, 0.3, 0.1);
    let image = photo(UNIQUE, &lens, &place, CLEAN, 0);
    let options = DetectionOptions::default();
    for wrong in ["8x6", "9x7", "5x4"] {
        assert_eq!(
            detect(&image, wrong.parse().unwrap(), &options),
            Err(NotFound::OtherSize { found: UNIQUE, expected: wrong.parse().unwrap() })
        );
    }
    // Columns and rows the other way round are the same board.
    assert!(found(&image, Board { columns: 6, rows: 7 }).complete);
    let empty = GrayImage::from_pixel(640, 480, Luma([120]));
    assert_eq!(detect(&empty, UNIQUE, &options), Err(NotFound::Nothing));
    for size in [1, 2, 7, 9, 40] {
        let tiny = GrayImage::from_pixel(size, size, Luma([9]));
        assert_eq!(detect(&tiny, UNIQUE, &options), Err(NotFound::Nothing));
    }
    // Texture everywhere, and no board.
    let texture = GrayImage::from_fn(640, 480, |u, v| {
        Luma([(u.wrapping_mul(2_654_435_761u32.rotate_left(v % 31)) >> 21) as u8])
    });
    assert!(detect(&texture, UNIQUE, &options).is_err());
}

#[test]
fn a_board_partly_outside_is_used_as_far_as_it_goes() {
    let lens = normal(SIZE);
    let board = Board { columns: 8, rows: 6 };
    let place = pose(board, [0.09, 0.0, -0.33], 0.2, 0.3, 0.0);
    let truth: Vec<[f64; 2]> = corners(board, &lens, &place).into_iter().flatten().collect();
    let inside = truth.iter().filter(|p| p[0] < 636.0).count();
    assert!((15..44).contains(&inside), "{inside} are inside");
    let part = found(&photo(board, &lens, &place, CLEAN, 0), board);
    assert!(!part.complete);
    assert!(part.corners.len() + 8 >= inside && part.corners.len() <= inside);
    for corner in &part.corners {
        let off = truth
            .iter()
            .map(|p| (p[0] - corner.image_px[0]).hypot(p[1] - corner.image_px[1]))
            .fold(f64::INFINITY, f64::min);
        assert!(off < 0.1, "{corner:?}: {off}");
    }
}

#[test]
fn boards_have_names() {
    assert_eq!("8x6".parse(), Ok(Board { columns: 8, rows: 6 }));
    assert_eq!(Board { columns: 8, rows: 6 }.to_string(), "8x6");
    for wrong in ["", "8", "8x", "x6", "2x6", "8x2", "-8x6", "8x6x2", "8.5x6", "501x6"] {
        assert!(wrong.parse::<Board>().is_err(), "{wrong}");
    }
}

/// Every board that OpenCV finds is found, and the corners agree.
fn beside_opencv(folder: &str, reference: &str, median_px: f64) {
    let (Some(folder), Some(reference)) = (data::path(folder), data::path(reference)) else {
        return;
    };
    let reference: serde_json::Value =
        serde_json::from_slice(&std::fs::read(reference).unwrap()).unwrap();
    let side = |k: usize| reference["pattern"][k].as_u64().unwrap() as usize;
    let board = Board { columns: side(0), rows: side(1) };
    let mut distances = Vec::new();
    // A third of the photos is enough for a debug build.
    for (name, theirs) in reference["corners"].as_object().unwrap().iter().step_by(3) {
        let image = images::read_grey(&folder.join(name)).unwrap();
        let ours = found(&image, board);
        assert!(ours.complete, "{name}");
        let theirs: Vec<f64> = numbers(theirs);
        let distance = |turned: bool| -> Vec<f64> {
            ours.corners
                .iter()
                .map(|c| {
                    let k = c.row * board.columns + c.column;
                    let k = if turned { board.columns * board.rows - 1 - k } else { k };
                    (c.image_px[0] - theirs[2 * k]).hypot(c.image_px[1] - theirs[2 * k + 1])
                })
                .collect()
        };
        let (same, turned) = (distance(false), distance(true));
        let total = |d: &[f64]| d.iter().sum::<f64>();
        distances.extend(if total(&same) <= total(&turned) { same } else { turned });
    }
    distances.sort_by(f64::total_cmp);
    let median = distances[distances.len() / 2];
    assert!(median < median_px, "{median}");
}

/// All numbers of nested lists, in order.
fn numbers(value: &serde_json::Value) -> Vec<f64> {
    match value {
        serde_json::Value::Array(all) => all.iter().flat_map(numbers).collect(),
        other => other.as_f64().into_iter().collect(),
    }
}

#[test]
fn a_wide_action_camera_is_as_opencv_sees_it() {
    beside_opencv(
        "calib_gopro_udacity/calibration_wide",
        "calib_gopro_udacity/opencv_reference.json",
        0.1,
    );
}

#[test]
fn small_photos_are_as_opencv_sees_them() {
    beside_opencv("calib_opencv_left", "calib_opencv_left/opencv_reference_left.json", 0.1);
}
