//! The same with the built-in residuals, which are linearised several at a time and never stored.
//!
//! ```sh
//! cargo run --example built_in_bundle
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram::{
    engine::SolveError,
    nlls::{BatchPath, Loss, Options, solve},
    problems::bundle::{Bundle, Camera, InteriorSharing, Network, Observation},
};

pub(crate) fn main() -> Result<(), SolveError> {
    let mut network = Network::default();
    for k in 0..3 {
        let translation = [0.5 - f64::from(k), 0.0, -8.0];
        let interior = [900.0, 0.0, 0.0];
        network.cameras.push(Camera { rotation_rad: [0.0; 3], translation, interior });
    }
    for point in 0..25u32 {
        let (column, row) = (f64::from(point % 5), f64::from(point / 5));
        let position = [column - 2.0, row - 2.0, 0.2 * f64::from(point % 3)];
        for (camera, of) in (0u32..).zip(&network.cameras) {
            let p: [f64; 3] = std::array::from_fn(|k| position[k] + of.translation[k]);
            let image_px = [0, 1].map(|i| -p[i] / p[2] * 900.0);
            network.observations.push(Observation { camera, point, image_px });
        }
        // The start is off.
        network.points.push(position.map(|v| v + 0.1));
    }
    let bundle = Bundle::new(&network, InteriorSharing::Shared, Loss::Huber(1.0))?;
    let mut x = bundle.problem.start();
    let summary = solve(&bundle.problem, &mut x, &Options::default(), 50)?;
    println!("{summary}");
    assert_eq!(summary.batches[0].path, Some(BatchPath::Fused));
    assert!(summary.final_cost < 1e-9);
    bundle.update(&x, &mut network);
    Ok(())
}
