//! How fast one pair of photos is compared: census costs of 64 layers and their aggregation along ten paths, on one thread.
//!
//! The work of OpenCV's `StereoSGBM` with MODE_HH and 64 disparities, which `benches/surface/speed.py` times beside it; per pixel of a picture
//! of as many pixels as blocks of the surface have. The quality is the share of pixels at the layer by which the second photo was moved.

#![allow(clippy::print_stdout, reason = "a bench prints what it measured")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rowgram::mapping::dense::{
    LAYERS, Penalties,
    aggregate::aggregate,
    cost_volume::CostVolume,
    sweep::{Rectified, costs},
};
use std::{hint::black_box, time::Instant};

/// Columns and rows: a block with what it shares with its neighbours.
const SIZE: usize = 288;
/// The mean of so many is told.
const ROUNDS: usize = 40;
/// The layer by which the second photo is moved, one cell for a layer.
const TRUE_LAYER: usize = 20;
/// Height of flight over the plane and of a layer, metres, and the base in cells that moves a photo by one cell for a layer.
const ABOVE_M: f64 = 640.0;
const LAYER_M: f64 = 0.01;
const BASE: f64 = ABOVE_M / LAYER_M;

fn photo(values: Vec<u8>, width: usize, origin: [isize; 2], centre: [f64; 2]) -> Rectified {
    let height = values.len() / width;
    Rectified { values, width, height, origin, centre, above_m: ABOVE_M }
}

/// Memory of costs and of what they sum up to.
type Memory = [CostVolume; 2];

fn layers(pair: &[Rectified; 2], heights_m: &[f64], [volume, sums]: &mut Memory) {
    costs(&pair[0], &pair[1..], heights_m, volume);
    aggregate(volume, &pair[0].values, &Penalties::default(), sums);
}

fn main() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let width = SIZE + LAYERS + 8;
    let wide: Vec<u8> = (0..width * (SIZE + 8)).map(|_| rng.random_range(20..235)).collect();
    // The reference shows what the other shows `TRUE_LAYER` cells farther left; four cells more on all sides.
    let own = |at: usize| wide[(at / SIZE + 4) * width + at % SIZE + 4 + LAYERS - TRUE_LAYER];
    let reference = photo((0..SIZE * SIZE).map(own).collect(), SIZE, [0; 2], [0.0; 2]);
    let pair = [reference, photo(wide, width, [-4 - LAYERS as isize, -4], [BASE, 0.0])];
    let heights_m: Vec<f64> = (0..LAYERS).map(|layer| LAYER_M * layer as f64).collect();
    let mut memory = Memory::default();
    layers(&pair, &heights_m, &mut memory);
    let found = &memory[1];
    let best = |at: usize| (0..LAYERS).min_by_key(|&d| found.at([at % SIZE, at / SIZE], d));
    let right = (0..SIZE * SIZE).filter(|&at| best(at) == Some(TRUE_LAYER)).count();
    let start = Instant::now();
    for _ in 0..ROUNDS {
        layers(black_box(&pair), black_box(&heights_m), black_box(&mut memory));
    }
    let (seconds, pixels) = (start.elapsed().as_secs_f64(), ROUNDS * SIZE * SIZE);
    println!("at the true layer: {:.1} %", 100.0 * right as f64 / (SIZE * SIZE) as f64);
    println!("seconds per million pixels: {:.4}", seconds * 1e6 / pixels as f64);
    println!("pixels: {pixels}");
}
