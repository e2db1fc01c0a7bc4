//! Plants in an array of your own: a mask of one byte a pixel.
//!
//! ```sh
//! cargo run --example locate_array
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram::{
    phenotype::{locate::LocateError, row_model, rows},
    raster::Mask,
};

/// Four rows of crosses: plants of four leaves each.
fn mask() -> Mask {
    let (width, height) = (640, 240);
    let mut data = vec![0; width * height];
    for row in 0..4 {
        for plant in 0..30 {
            let (u, v) = (20 + 20 * plant, 30 + 60 * row);
            for step in 0..9_usize {
                for (du, dv) in [(1, 1), (1, -1), (-1, 1), (-1, -1)] {
                    for side in 0..2 {
                        let at = |from: usize, d: i32| (from as i32 + d * step as i32) as usize;
                        data[at(v, dv) * width + at(u, du) + side] = 1;
                    }
                }
            }
        }
    }
    Mask { width, height, data }
}

pub(crate) fn main() -> Result<(), LocateError> {
    let mask = mask();
    let found = rows::detect(&mask);
    let canopy = row_model::locate(&mask, &found, None, &row_model::RowModelOptions::default())?;
    println!("{} plants in {} rows", canopy.plants.len(), canopy.rows.rows.len());
    for plant in canopy.plants.iter().take(5) {
        let [u, v] = plant.position_px;
        println!("row {}: {u:6.1} {v:6.1} px, confidence {:.2}", plant.row, plant.confidence);
    }
    let near = |plant: &[f64; 2]| {
        let places = canopy.plants.iter().map(|found| found.position_px);
        places.map(|at| (at[0] - plant[0]).hypot(at[1] - plant[1])).fold(f64::INFINITY, f64::min)
    };
    let truth: Vec<[f64; 2]> = (0..120)
        .map(|k| [20.5 + 20.0 * f64::from(k % 30), 30.0 + 60.0 * f64::from(k / 30)])
        .collect();
    let hit = truth.iter().filter(|plant| near(plant) < 4.0).count();
    println!("{hit} of {} within 4 pixels", truth.len());
    assert!(hit > 100);
    Ok(())
}
