//! Photos of chessboards made from geometry alone, for the tests of detector and calibration.

use image::{GrayImage, Luma};
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use rowgram::{
    camera::{Interior, Lens, Model},
    geometry::rotation,
    target::Board,
};

/// Side of a square, metres.
pub const SQUARE_M: f64 = 0.025;

/// `camera_from_board`: quaternion and translation, metres.
pub type Pose = ([f64; 4], [f64; 3]);

/// The board's middle at `middle_m` in the camera frame, turned about its own normal by `roll`,
/// then away from straight on by `tilt` about an axis in the image at the angle `about`, radians.
pub fn pose(board: Board, middle_m: [f64; 3], tilt: f64, about: f64, roll: f64) -> Pose {
    let towards_camera = rotation::exp([std::f64::consts::PI, 0.0, 0.0]);
    let turned = rotation::multiply(rotation::exp([0.0, 0.0, roll]), towards_camera);
    let q =
        rotation::multiply(rotation::exp([tilt * about.cos(), tilt * about.sin(), 0.0]), turned);
    let half = [
        0.5 * SQUARE_M * (board.columns as f64 - 1.0),
        0.5 * SQUARE_M * (board.rows as f64 - 1.0),
        0.0,
    ];
    let offset = rotation::rotate(q, half);
    (q, std::array::from_fn(|k| middle_m[k] - offset[k]))
}

/// Where the corners of the board are in the photo, row by row.
pub fn corners(board: Board, lens: &Interior, (q, t): &Pose) -> Vec<Option<[f64; 2]>> {
    (0..board.columns * board.rows)
        .map(|k| {
            let at =
                [SQUARE_M * (k % board.columns) as f64, SQUARE_M * (k / board.columns) as f64, 0.0];
            let p = rotation::rotate(*q, at);
            lens.project(std::array::from_fn(|k| p[k] + t[k]))
        })
        .collect()
}

/// What is done to a photo beside geometry.
#[derive(Debug, Clone, Copy)]
pub struct Look {
    /// Standard deviation of a Gaussian blur, pixels; 0 for none but that of the pixels' area.
    pub blur_px: f32,
    /// Standard deviation of the noise, grey values.
    pub noise: f64,
    /// How much darker the right border is than the left one, as a share.
    pub shade: f64,
}

/// A clean photo.
pub const CLEAN: Look = Look { blur_px: 0.7, noise: 0.0, shade: 0.0 };

/// A photo of a board with one white square around it, on a grey wall.
pub fn photo(board: Board, lens: &Interior, (q, t): &Pose, look: Look, seed: u64) -> GrayImage {
    // Edges along the pixels' rows are placed to a part of a pixel.
    const PARTS: usize = 20;
    let [width, height] = lens.size_px();
    let back = rotation::inverse(*q);
    let centre = rotation::rotate(back, t.map(|x| -x));
    // Squares from the first corner, of the lower left corner of each pixel.
    let stride = width as usize + 1;
    let places: Vec<Option<[f64; 2]>> = (0..stride * (height as usize + 1))
        .map(|k| {
            let at = [(k % stride) as f64 - 0.5, (k / stride) as f64 - 0.5];
            let ray = rotation::rotate(back, lens.unproject(at)?);
            let s = -centre[2] / ray[2];
            (s > 0.0).then(|| [0, 1].map(|axis| (centre[axis] + s * ray[axis]) / SQUARE_M))
        })
        .collect();
    let colour = |[x, y]: [f64; 2]| -> f64 {
        let (i, j) = (x.floor(), y.floor());
        let inside = |v: f64, n: usize, rim: f64| v >= -1.0 - rim && v < n as f64 + rim;
        if !(inside(x, board.columns, 1.0) && inside(y, board.rows, 1.0)) {
            return 110.0;
        }
        let on_board = inside(x, board.columns, 0.0) && inside(y, board.rows, 0.0);
        // The square between the first four corners is dark.
        if on_board && (i + j).rem_euclid(2.0) == 0.0 { 35.0 } else { 215.0 }
    };
    let mut image = GrayImage::from_fn(width, height, |u, v| {
        let k = v as usize * stride + u as usize;
        let [Some(a), Some(b), Some(c), Some(d)] =
            [k, k + 1, k + stride, k + stride + 1].map(|k| places[k])
        else {
            return Luma([110]);
        };
        let light = 1.0 - look.shade * f64::from(u) / f64::from(width);
        let cell = |p: [f64; 2]| p.map(f64::floor);
        if [b, c, d].iter().all(|p| cell(*p) == cell(a)) {
            return Luma([(light * colour(a)).round() as u8]);
        }
        let mut sum = 0.0;
        for j in 0..PARTS {
            for i in 0..PARTS {
                let (x, y) = ((i as f64 + 0.5) / PARTS as f64, (j as f64 + 0.5) / PARTS as f64);
                sum += colour([0, 1].map(|k| {
                    let (top, bottom) = (a[k] + x * (b[k] - a[k]), c[k] + x * (d[k] - c[k]));
                    top + y * (bottom - top)
                }));
            }
        }
        Luma([(light * sum / (PARTS * PARTS) as f64).round() as u8])
    });
    if look.blur_px > 0.0 {
        image = image::imageops::blur(&image, look.blur_px);
    }
    if look.noise > 0.0 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for pixel in image.pixels_mut() {
            // Nearly normal: the sum of twelve even ones.
            let z: f64 = (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
            pixel.0[0] = (f64::from(pixel.0[0]) + look.noise * z).round().clamp(0.0, 255.0) as u8;
        }
    }
    image
}

/// A wide lens with the usual barrel.
pub fn wide(size_px: [u32; 2]) -> Interior {
    let long = f64::from(size_px[0].max(size_px[1]));
    let mut values = [0.0; 12];
    values[..9].copy_from_slice(&[
        0.44 * long,
        1.002,
        0.51 * f64::from(size_px[0]),
        0.49 * f64::from(size_px[1]),
        -0.23,
        0.061,
        2e-4,
        -1e-4,
        -0.0072,
    ]);
    Interior::new(Model::Brown, size_px, &values).unwrap()
}

/// A lens nearly without distortion.
pub fn normal(size_px: [u32; 2]) -> Interior {
    let long = f64::from(size_px[0].max(size_px[1]));
    let mut values = [0.0; 12];
    values[..6].copy_from_slice(&[
        1.1 * long,
        1.0,
        0.5 * f64::from(size_px[0]),
        0.5 * f64::from(size_px[1]),
        -0.08,
        0.02,
    ]);
    Interior::new(Model::Brown, size_px, &values).unwrap()
}

/// Poses from all around, boards over the whole photo; the same for the same seed.
pub fn poses(board: Board, lens: &Interior, count: usize, seed: u64) -> Vec<Pose> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let [width, height] = lens.size_px().map(f64::from);
    let f = lens.principal_distance_px();
    let length = SQUARE_M * (board.columns.max(board.rows) as f64 + 2.0);
    let mut found = Vec::new();
    while found.len() < count {
        let distance = length * f / (rng.random_range(0.45..0.75) * width);
        let tilt = rng.random_range(0.1..0.75);
        let about = rng.random_range(0.0..std::f64::consts::TAU);
        let roll = rng.random_range(-0.6..0.6);
        let x = rng.random_range(-0.35..0.35) * width / f * distance;
        let y = rng.random_range(-0.35..0.35) * height / f * distance;
        let pose = pose(board, [x, y, -distance], tilt, about, roll);
        let inside = |p: &Option<[f64; 2]>| {
            p.is_some_and(|[u, v]| u > 12.0 && v > 12.0 && u < width - 13.0 && v < height - 13.0)
        };
        if corners(board, lens, &pose).iter().all(inside) {
            found.push(pose);
        }
    }
    found
}
