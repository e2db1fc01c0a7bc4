//! One independent random stream per (seed, stage, item).
//!
//! The ChaCha8 key is (seed, stage), the ChaCha8 stream number is the item, so that no item's draws
//! depend on how many another item makes, nor on the order in which threads take them.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// What a stream decides. The numbers are part of what a seed means: they never change.
#[derive(Debug, Clone, Copy)]
#[repr(u64)]
pub(crate) enum Stage {
    RowStart = 1,
    Site = 2,
    Plant = 3,
    Soil = 4,
    Relief = 5,
    Habit = 6,
    Residue = 7,
    Stone = 8,
    Target = 9,
    Weed = 16,
    FalsePixel = 17,
    Grass = 19,
    MissedPixel = 18,
    PlotGrowth = 20,
    PlantGrowth = 21,
    Weather = 22,
    PlotSpectrum = 24,
    PlantSpectrum = 25,
    BandNoise = 26,
    FlightDrift = 48,
    Shot = 49,
    Gnss = 50,
    Mark = 51,
    Exposure = 52,
    SensorRow = 53,
    TiePoint = 54,
    TieNoise = 55,
    TieOutlier = 56,
    BoardPose = 57,
    BoardNoise = 58,
    Gimbal = 59,
    BlockPose = 32,
    BlockLens = 33,
    BlockRelief = 34,
    BlockPoint = 35,
    BlockNoise = 36,
    BlockOutlier = 37,
    BlockCameraStart = 38,
    BlockPointStart = 39,
    CollectionWall = 64,
    CollectionView = 65,
    CollectionPoint = 66,
    CollectionTrack = 67,
    CollectionDrift = 68,
}

/// The stream of one item of one stage.
pub(crate) fn stream(seed: u64, stage: Stage, item: u64) -> ChaCha8Rng {
    let mut key = [0; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&(stage as u64).to_le_bytes());
    let mut rng = ChaCha8Rng::from_seed(key);
    rng.set_stream(item);
    rng
}

/// The number of item `second` within item `first` (both below 2^32).
pub(crate) fn pair(first: usize, second: usize) -> u64 {
    ((first as u64) << 32) | (second as u64 & 0xffff_ffff)
}

/// The three draws that everything here is made of.
pub(crate) trait Draw {
    /// Uniform in [0, 1).
    fn unit(&mut self) -> f64;
    /// Normal with mean 0 and standard deviation 1.
    fn normal(&mut self) -> f64;
    /// Uniform between the two ends.
    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }
}

impl Draw for ChaCha8Rng {
    fn unit(&mut self) -> f64 {
        self.random()
    }

    fn normal(&mut self) -> f64 {
        self.sample(StandardNormal)
    }
}
