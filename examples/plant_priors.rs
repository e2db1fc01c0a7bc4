//! The plant objective three times on one mask: k-means, plants held to rows, and plants held to rows and columns.
//!
//! ```sh
//! cargo run --example plant_priors
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram::{
    descent::CoordinateDescentOptions,
    phenotype::locate::{Init, LocateError, PlantFitOptions, locate},
    problems::plants::{Model, PlantUpdate, Prior, index::PixelIndex},
};

/// Four rows of 24 plants with leaves of many lengths, which overlap along the row, and some weeds between rows.
fn pixels(truth: &[[f64; 2]]) -> Vec<[u32; 2]> {
    let mut pixels = Vec::new();
    for (plant, at) in truth.iter().enumerate() {
        for leaf in 0..5 {
            let turn = (37 * plant + 73 * leaf) as f64;
            let length = 7.0 + (plant * 5 + leaf * 3) as f64 % 8.0;
            for step in 0..40 {
                let r = length * f64::from(step) / 40.0;
                let (u, v) = (at[0] + r * turn.cos(), at[1] + r * turn.sin());
                pixels.push([u.round() as u32, v.round() as u32]);
                pixels.push([u.round() as u32 + 1, v.round() as u32]);
            }
        }
    }
    for weed in 0..12_u32 {
        let (u, v) = (31 + 39 * weed % 480, 60 + 60 * (weed % 3));
        pixels.extend((0..25).map(|k| [u + k % 5, v + k / 5]));
    }
    pixels.sort_unstable();
    pixels.dedup();
    pixels
}

pub(crate) fn main() -> Result<(), LocateError> {
    let truth: Vec<[f64; 2]> = (0..96)
        .map(|k| [30.0 + 20.0 * f64::from(k % 24), 30.0 + 60.0 * f64::from(k / 24)])
        .collect();
    let index = PixelIndex::new(&pixels(&truth));
    println!("{:24} {:>7} {:>14}", "objective", "sweeps", "within 5 px");
    let mut found = Vec::new();
    for (name, update, prior) in [
        ("k-means", PlantUpdate::Mean, Prior::None),
        ("held to rows", PlantUpdate::Median, Prior::Rows),
        ("held to rows and columns", PlantUpdate::Median, Prior::Grid),
    ] {
        let options = PlantFitOptions {
            plants: truth.len(),
            model: Model { update, prior, ..Model::default() },
            init: Init::KmeansPlusPlus,
            seed: 3,
            descent: CoordinateDescentOptions::default(),
            max_sweeps: 300,
        };
        let (located, outcome) = locate(index.clone(), &options, |_, _| ())?;
        let at: Vec<[f64; 2]> = located.plants.iter().map(|plant| plant.position_px).collect();
        let near = |t: &&[f64; 2]| at.iter().any(|p| (p[0] - t[0]).hypot(p[1] - t[1]) < 5.0);
        let hit = truth.iter().filter(near).count();
        println!("{name:24} {:>7} {hit:>14}", outcome.iterations);
        found.push(hit);
    }
    assert!(found[1] > found[0] && found[2] > found[0], "{found:?}");
    Ok(())
}
