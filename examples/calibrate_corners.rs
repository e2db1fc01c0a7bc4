//! A camera from corners that you have measured yourself: here they are computed from a known camera.
//!
//! ```sh
//! cargo run --example calibrate_corners
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram::{
    camera::{Lens, Model},
    engine::SolveError,
    nlls::Loss,
    problems::calibration::{BoardShape, Mark, Request, View, calibrate, statistics::statistics},
};

/// What a camera without distortion, of principal distance 900 px, sees of a board from somewhere.
fn photo(tilt_rad: f64, turn_rad: f64) -> View {
    let (sin, cos) = tilt_rad.sin_cos();
    let (s, c) = turn_rad.sin_cos();
    let mark = |corner: usize| {
        let board_m = [0.03 * (corner % 8) as f64, 0.03 * (corner / 8) as f64];
        let centred = [board_m[0] - 0.105, board_m[1] - 0.075];
        let turned = [c * centred[0] - s * centred[1], s * centred[0] + c * centred[1]];
        let depth = 0.5 + sin * turned[1];
        let image_px = [639.5 + 900.0 * turned[0] / depth, 479.5 + 900.0 * cos * turned[1] / depth];
        Mark { corner, board_m, image_px }
    };
    View { marks: (0..48).map(mark).collect() }
}

pub(crate) fn main() -> Result<(), SolveError> {
    let views: Vec<View> =
        (0..8).map(|k| photo(if k % 2 == 0 { 0.5 } else { -0.4 }, 0.8 * f64::from(k))).collect();
    let model = Model::Brown;
    let wanted = ["f_px", "cx_px", "cy_px", "k1"];
    let parameters = model.parameters();
    let request = Request {
        model,
        size_px: [1280, 960],
        free: parameters.iter().map(|p| wanted.contains(&p.name)).collect(),
        values: parameters.iter().map(|p| if p.name == "aspect" { 1.0 } else { 0.0 }).collect(),
        shape: BoardShape::Flat,
        loss: Loss::Trivial,
    };
    let solution = calibrate(&views, &request)?;
    for parameter in statistics(&views, &request, &solution)?.parameters.iter().filter(|p| p.free) {
        let (value, sigma) = (parameter.value, parameter.standard_deviation);
        println!("{:6} {value:12.6} +- {sigma:.1e} {}", parameter.name, parameter.unit);
    }
    let place = model.place("f_px").ok_or_else(|| SolveError::Misuse("no f_px".into()))?;
    assert!((solution.state.interior.values()[place] - 900.0).abs() < 1e-3);
    Ok(())
}
