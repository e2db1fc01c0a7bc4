//! Photos of a chessboard by the camera of a flight, as a crew takes them on the ground to calibrate it.
//!
//! The board is a plane `Z = 0` with a corner of four squares at the origin, `X` along its columns and `Y`
//! along its rows, metres; `camera_from_board` takes its points to the camera frame (`y` up, looking along
//! `-z`). A pixel's value is the mean over its area: exact inside a square, sampled where an edge crosses.

use crate::{
    ConfigError,
    camera::Camera,
    streams::{Stage, stream},
};
use image::{GrayImage, Luma};
use rand::RngExt;
use rand_distr::StandardNormal;
use rayon::prelude::*;
use std::f64::consts::TAU;

/// A chessboard.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Board {
    /// Inner corners of a row, where four squares meet.
    pub columns: usize,
    /// Inner corners of a column.
    pub rows: usize,
    /// Side of a square, metres.
    pub side_m: f64,
}

/// The board of the photos of a flight.
pub const BOARD: Board = Board { columns: 9, rows: 6, side_m: 0.04 };

/// Where a board is: rotation (rows of the matrix) and translation, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardPose {
    /// Camera frame from board frame.
    pub camera_from_board: [[f64; 3]; 3],
    /// The origin of the board in the camera frame.
    pub origin_m: [f64; 3],
}

impl BoardPose {
    fn place(&self, [x, y]: [f64; 2]) -> [f64; 3] {
        let r = &self.camera_from_board;
        std::array::from_fn(|i| r[i][0] * x + r[i][1] * y + self.origin_m[i])
    }

    /// Where a ray from the projection centre meets the plane of the board; `None` where it does not.
    fn meet(&self, ray: [f64; 3]) -> Option<[f64; 2]> {
        let column =
            |k: usize| -> [f64; 3] { std::array::from_fn(|i| self.camera_from_board[i][k]) };
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let s = dot(column(2), self.origin_m) / dot(column(2), ray);
        let at: [f64; 3] = std::array::from_fn(|i| s * ray[i] - self.origin_m[i]);
        (s > 0.0).then(|| [dot(column(0), at), dot(column(1), at)])
    }
}

/// Poses of a board for `count` photos: the board fills most of the photo, now here and now there, tilted
/// by up to 35 degrees to one side or another.
///
/// # Errors
/// A board that no pose brings into the picture.
pub fn poses(
    board: Board,
    camera: &Camera,
    count: usize,
    seed: u64,
) -> Result<Vec<BoardPose>, ConfigError> {
    (0..count).map(|k| pose(board, camera, k, seed)).collect()
}

fn pose(board: Board, camera: &Camera, photo: usize, seed: u64) -> Result<BoardPose, ConfigError> {
    let mut rng = stream(seed, Stage::BoardPose, photo as u64);
    let size_m = [board.columns, board.rows].map(|n| (n as f64 + 1.0) * board.side_m);
    let half = camera.half_footprint();
    let fill = (size_m[0] / (2.0 * half[0])).max(size_m[1] / (2.0 * half[1]));
    for _ in 0..10_000 {
        // Around the normal, then away from straight on about an axis in the image, one side after another.
        let roll: f64 = rng.random_range(-0.3..0.3);
        let about = TAU * (photo as f64 * 0.382 + rng.random_range(-0.1..0.1));
        let tilt: f64 = rng.random_range(0.15..0.6);
        let axis = [about.cos(), about.sin()];
        let turn = |v: [f64; 3]| {
            let (s, c) = (tilt.sin(), tilt.cos());
            let along = (axis[0] * v[0] + axis[1] * v[1]) * (1.0 - c);
            [
                v[0] * c + axis[1] * v[2] * s + axis[0] * along,
                v[1] * c - axis[0] * v[2] * s + axis[1] * along,
                v[2] * c + (axis[0] * v[1] - axis[1] * v[0]) * s,
            ]
        };
        let columns = [
            turn([roll.cos(), roll.sin(), 0.0]),
            turn([-roll.sin(), roll.cos(), 0.0]),
            turn([0.0, 0.0, 1.0]),
        ];
        let distance_m = fill * rng.random_range(1.0..1.7);
        let middle: [f64; 3] = [
            distance_m * half[0] * rng.random_range(-0.5..0.5),
            distance_m * half[1] * rng.random_range(-0.5..0.5),
            -distance_m,
        ];
        let to_middle = [board.columns, board.rows].map(|n| 0.5 * (n as f64 - 1.0) * board.side_m);
        let pose = BoardPose {
            camera_from_board: std::array::from_fn(|i| columns.map(|column| column[i])),
            origin_m: std::array::from_fn(|i| {
                middle[i] - columns[0][i] * to_middle[0] - columns[1][i] * to_middle[1]
            }),
        };
        let [right, top] = [board.columns, board.rows].map(|n| n as f64 * board.side_m);
        let margin_px = 0.01 * f64::from(camera.config().width_px);
        let low = -board.side_m;
        let seen = [[low, low], [right, low], [low, top], [right, top]].into_iter().all(|corner| {
            camera.project(pose.place(corner)).is_some_and(|at| camera.inside(at, margin_px))
        });
        if seen {
            return Ok(pose);
        }
    }
    Err(ConfigError::new("camera", "a lens", "one that can have a whole chessboard in its picture"))
}

/// A photo of the board on a grey wall, with a blur of a lens and the noise of a sensor.
pub fn photo(
    board: Board,
    camera: &Camera,
    pose: &BoardPose,
    seed: u64,
    number: usize,
) -> GrayImage {
    /// Samples along each side of a pixel that an edge crosses.
    const PARTS: usize = 12;
    const BLUR_PX: f32 = 0.6;
    const NOISE: f64 = 1.2;
    let (width, height) = (camera.config().width_px, camera.config().height_px);
    let at =
        |u: f64, v: f64| pose.meet(camera.direction(u, v)).map(|p| p.map(|x| x / board.side_m));
    let rows: Vec<Vec<u8>> = (0..height)
        .into_par_iter()
        .map(|v| {
            let (top, bottom) = (f64::from(v) - 0.5, f64::from(v) + 0.5);
            let corners = |u: u32| [at(f64::from(u) - 0.5, top), at(f64::from(u) - 0.5, bottom)];
            let mut left = corners(0);
            (0..width)
                .map(|u| {
                    let right = corners(u + 1);
                    let ([Some(a), Some(c)], [Some(b), Some(d)]) =
                        (std::mem::replace(&mut left, right), right)
                    else {
                        return WALL as u8;
                    };
                    if [b, c, d].iter().all(|p| p.map(f64::floor) == a.map(f64::floor)) {
                        return grey(board, a) as u8;
                    }
                    let part = |k: usize| (k as f64 + 0.5) / PARTS as f64;
                    let mut sum = 0.0;
                    for (x, y) in (0..PARTS * PARTS).map(|k| (part(k % PARTS), part(k / PARTS))) {
                        sum += grey(
                            board,
                            [0, 1].map(|k| {
                                let (top, bottom) =
                                    (a[k] + x * (b[k] - a[k]), c[k] + x * (d[k] - c[k]));
                                top + y * (bottom - top)
                            }),
                        );
                    }
                    (sum / (PARTS * PARTS) as f64).round() as u8
                })
                .collect()
        })
        .collect();
    let sharp = GrayImage::from_fn(width, height, |u, v| Luma([rows[v as usize][u as usize]]));
    let mut photo = image::imageops::blur(&sharp, BLUR_PX);
    let mut rng = stream(seed, Stage::BoardNoise, number as u64);
    for pixel in photo.pixels_mut() {
        let noise: f64 = rng.sample(StandardNormal);
        pixel.0[0] = (f64::from(pixel.0[0]) + NOISE * noise).round().clamp(0.0, 255.0) as u8;
    }
    photo
}

/// Grey value of the wall.
const WALL: f64 = 110.0;

/// The grey value at a place, in squares from the origin: dark and light squares, a light rim as wide as half
/// a square, the wall.
fn grey(board: Board, [x, y]: [f64; 2]) -> f64 {
    let inside = |v: f64, n: usize, rim: f64| v >= -1.0 - rim && v < n as f64 + rim;
    if !(inside(x, board.columns, 0.5) && inside(y, board.rows, 0.5)) {
        return WALL;
    }
    let on_board = inside(x, board.columns, 0.0) && inside(y, board.rows, 0.0);
    let dark = (x.floor() + y.floor()).rem_euclid(2.0) == 0.0;
    if on_board && dark { 35.0 } else { 215.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::CameraConfig;

    /// Around every corner of the board the squares are as the geometry says.
    #[test]
    fn corners_are_where_the_camera_sees_them() {
        let camera = Camera::new(&CameraConfig::compact(640, 480, 520.0)).unwrap();
        for (k, pose) in poses(BOARD, &camera, 3, 7).unwrap().iter().enumerate() {
            let photo = photo(BOARD, &camera, pose, 7, k);
            for corner in 0..BOARD.columns * BOARD.rows {
                let place = [corner % BOARD.columns, corner / BOARD.columns];
                for (dx, dy) in [(0.35, 0.35), (-0.35, 0.35), (-0.35, -0.35), (0.35, -0.35)] {
                    let at = [place[0] as f64 + dx, place[1] as f64 + dy];
                    let [u, v] = camera.project(pose.place(at.map(|x| x * BOARD.side_m))).unwrap();
                    let found = photo.get_pixel(u.round() as u32, v.round() as u32).0[0];
                    let dark = (at[0].floor() + at[1].floor()).rem_euclid(2.0) == 0.0;
                    assert_eq!(found < 110, dark, "photo {k}, {at:?}: {found}");
                }
            }
        }
    }
}
