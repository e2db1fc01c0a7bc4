//! How long a calibration takes: 35 boards of 8 x 6 corners, one interior orientation.
//!
//! Prints the root mean square that was reached beside the time. `ROWGRAM_CORNERS` names a corner file
//! to be used instead of the synthetic one, with `ROWGRAM_BOARD` (`8x6`) and `ROWGRAM_SIZE`
//! (`1280x960`); `benches/calibration/compare.py` does that and runs OpenCV beside it.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a bench speaks on stdout")]

use rowgram::{
    camera::{Interior, Lens, Model},
    geometry::rotation,
    io::corners,
    nlls::Loss,
    problems::calibration::{
        BoardShape, MAX_ITERATIONS, Mark, Request, View, adjust, start, statistics::statistics,
    },
    target::Board,
};
use std::{path::Path, time::Instant};

const SIZE_PX: [u32; 2] = [1280, 960];

fn main() {
    let (views, size_px) = match std::env::var("ROWGRAM_CORNERS") {
        Ok(path) => from_file(&path),
        Err(_) => (synthetic(), SIZE_PX),
    };
    for (name, model, free) in [
        ("brown, 5 terms", Model::Brown, "f_px aspect cx_px cy_px k1 k2 p1 p2 k3"),
        ("brown, 8 terms", Model::Brown, "f_px aspect cx_px cy_px k1 k2 p1 p2 k3 k4 k5 k6"),
        ("smac, 5 terms", Model::Smac, "c_px xp_px yp_px K1 K2 K3 P1 P2"),
    ] {
        measure(name, &views, &request(model, free, size_px));
    }
}

fn request(model: Model, free: &str, size_px: [u32; 2]) -> Request {
    let parameters = model.parameters();
    Request {
        model,
        size_px,
        free: parameters.iter().map(|p| free.split(' ').any(|name| name == p.name)).collect(),
        values: (0..parameters.len())
            .map(|k| model.default_value(k, size_px).unwrap_or(f64::from(size_px[0])))
            .collect(),
        shape: BoardShape::Flat,
        loss: Loss::Trivial,
    }
}

fn measure(name: &str, views: &[View], request: &Request) {
    let time = |runs: usize, work: &mut dyn FnMut()| {
        let mut times: Vec<f64> = (0..runs)
            .map(|_| {
                let begin = Instant::now();
                work();
                begin.elapsed().as_secs_f64() * 1e3
            })
            .collect();
        times.sort_by(f64::total_cmp);
        (times[0], times[runs / 2])
    };
    let begin = start::search(views, request).unwrap();
    let whole = time(5, &mut || drop(start::search(views, request).unwrap()));
    let from_start = time(201, &mut || {
        drop(adjust(views, request, &begin, Loss::Trivial, MAX_ITERATIONS).unwrap());
    });
    let solution = adjust(views, request, &begin, Loss::Trivial, MAX_ITERATIONS).unwrap();
    let found = statistics(views, request, &solution).unwrap();
    println!(
        "{name}: {} photos, {} corners, rms {:.4} px; adjustment {:.2} ms (least {:.2}), {} iterations \
         from the start found; search {:.1} ms, together {:.1} ms",
        views.len(),
        views.iter().map(|view| view.marks.len()).sum::<usize>(),
        found.rms_px,
        from_start.1,
        from_start.0,
        solution.iterations,
        whole.1,
        whole.1 + from_start.1,
    );
}

fn from_file(path: &str) -> (Vec<View>, [u32; 2]) {
    let board: Board = std::env::var("ROWGRAM_BOARD").unwrap().parse().unwrap();
    let size = std::env::var("ROWGRAM_SIZE").unwrap();
    let (width, height) = size.split_once('x').unwrap();
    let images = corners::read(Path::new(path), board).unwrap();
    let views = images
        .iter()
        .map(|image| View {
            marks: image
                .corners
                .iter()
                .map(|c| Mark {
                    corner: c.row * board.columns + c.column,
                    board_m: [0.025 * c.column as f64, 0.025 * c.row as f64],
                    image_px: c.image_px,
                })
                .collect(),
        })
        .collect();
    (views, [width.parse().unwrap(), height.parse().unwrap()])
}

/// Boards seen from all around by a wide lens, with a noise of 0.2 px that follows a fixed pattern.
fn synthetic() -> Vec<View> {
    let mut values = [0.0; 12];
    values[..9].copy_from_slice(&[560.0, 1.002, 650.0, 499.0, -0.23, 0.06, 1e-4, -1e-4, -0.007]);
    let lens = Interior::new(Model::Brown, SIZE_PX, &values).unwrap();
    let wave = |k: usize, step: f64| (k as f64 * step).fract() * 2.0 - 1.0;
    (0..35)
        .map(|k| {
            let q = rotation::multiply(
                rotation::exp([0.4 * wave(k, 0.618_034), 0.4 * wave(k, 0.324_718), 0.2]),
                rotation::exp([std::f64::consts::PI, 0.0, 0.0]),
            );
            let t = [
                -0.0875 + 0.05 * wave(k, 0.41),
                0.0625 + 0.04 * wave(k, 0.73),
                -0.32 - 0.05 * wave(k, 0.21),
            ];
            let marks = (0..48).map(|c| {
                let board_m = [0.025 * (c % 8) as f64, 0.025 * (c / 8) as f64];
                let p = rotation::rotate(q, [board_m[0], board_m[1], 0.0]);
                let image = lens.project([p[0] + t[0], p[1] + t[1], p[2] + t[2]]).unwrap();
                let noise = |seed: f64| 0.2 * wave(48 * k + c + 1, seed);
                let image_px = [image[0] + noise(0.754_877_7), image[1] + noise(0.569_840_3)];
                Mark { corner: c, board_m, image_px }
            });
            View { marks: marks.collect() }
        })
        .collect()
}
