//! The plant objective three times on one mask: k-means, plants held to rows, and plants held to rows and columns.
//!
//! ```sh
//! cargo run --example plant_priors
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram::{
    descent::CoordinateDescentOptions,
    phenotype::{
        locate::{Init, LocateError, PlantFitOptions, locate_best},
        rows,
    },
    problems::plants::{Model, PlantUpdate, Prior, index::PixelIndex},
    raster::Mask,
};

/// Four rows of 24 plants with leaves of many lengths, which overlap along the row, and some weeds between rows.
fn mask(truth: &[[f64; 2]]) -> Mask {
    let mut mask = Mask::empty(540, 260);
    let mut paint = |u: usize, v: usize| mask.data[v * 540 + u] = 1;
    for (plant, at) in truth.iter().enumerate() {
        for leaf in 0..5 {
            let turn = (37 * plant + 73 * leaf) as f64;
            let length = 7.0 + (plant * 5 + leaf * 3) as f64 % 8.0;
            for step in 0..40 {
                let r = length * f64::from(step) / 40.0;
                let (u, v) = (at[0] + r * turn.cos(), at[1] + r * turn.sin());
                paint(u.round() as usize, v.round() as usize);
                paint(u.round() as usize + 1, v.round() as usize);
            }
        }
    }
    for weed in 0..12 {
        let (u, v) = (31 + 39 * weed % 480, 60 + 60 * (weed % 3));
        (0..25).for_each(|k| paint(u + k % 5, v + k / 5));
    }
    mask
}

pub(crate) fn main() -> Result<(), LocateError> {
    let truth: Vec<[f64; 2]> = (0..96)
        .map(|k| [30.0 + 20.0 * f64::from(k % 24), 30.0 + 60.0 * f64::from(k / 24)])
        .collect();
    let mask = mask(&truth);
    let index = PixelIndex::from_mask(mask.width, &mask.data);
    let rows = rows::detect(&mask);
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
        let (setup, outcome) = locate_best(&index, &options, &rows, None, 1)?;
        let at: Vec<[f64; 2]> =
            setup.finish().plants.iter().map(|plant| plant.position_px).collect();
        let near = |t: &&[f64; 2]| at.iter().any(|p| (p[0] - t[0]).hypot(p[1] - t[1]) < 5.0);
        let hit = truth.iter().filter(near).count();
        println!("{name:24} {:>7} {hit:>14}", outcome.iterations);
        found.push(hit);
    }
    assert!(found[1] > found[0] && found[2] > found[0], "{found:?}");
    Ok(())
}
