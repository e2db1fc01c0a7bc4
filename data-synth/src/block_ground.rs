//! The ground under a block, and which cameras stand above which part of it.
//!
//! Height of the rolling ground, metres: `Z(X, Y) = a sum_i sin(k_i . (X, Y) + phase_i)` over eight
//! waves of random direction, `a` such that its variance is the square of the relief.

use crate::{
    block::BlockConfig,
    block_camera::ForwardCamera,
    streams::{Draw, Stage, stream},
};

/// Rolling ground: a sum of eight waves of 1/3 to 3 times the flying height, in all directions.
pub(crate) struct Ground {
    /// Wave vector (rad/m), phase (rad).
    waves: [[f64; 3]; 8],
    amplitude_m: f64,
}

impl Ground {
    pub(crate) fn new(config: &BlockConfig) -> Ground {
        let mut rng = stream(config.seed, Stage::BlockRelief, 0);
        let waves = [0; 8].map(|_| {
            let length_m = config.height_m * 3f64.powf(rng.between(-1.0, 1.0));
            let direction_rad = rng.between(0.0, std::f64::consts::TAU);
            let number = std::f64::consts::TAU / length_m;
            let phase_rad = rng.between(0.0, std::f64::consts::TAU);
            [number * direction_rad.cos(), number * direction_rad.sin(), phase_rad]
        });
        // Each wave has variance 1/2.
        Ground { waves, amplitude_m: config.relief_m / 2.0 }
    }

    pub(crate) fn height_m(&self, x_m: f64, y_m: f64) -> f64 {
        let waves = self.waves.iter().map(|[kx, ky, phase]| (kx * x_m + ky * y_m + phase).sin());
        self.amplitude_m * waves.sum::<f64>()
    }
}

/// Which cameras stand near a place: square cells as wide as an image can see far.
pub(crate) struct CameraIndex {
    low_m: [f64; 2],
    cell_m: f64,
    size: [usize; 2],
    cells: Vec<Vec<usize>>,
}

impl CameraIndex {
    pub(crate) fn new(config: &BlockConfig, cameras: &[ForwardCamera]) -> CameraIndex {
        let centres: Vec<[f64; 3]> = cameras.iter().map(ForwardCamera::centre_m).collect();
        let [half_width_m, half_height_m] = config.half_footprint_m();
        // Tilts within four standard deviations, low ground, barrel distortion.
        let cell_m = 1.5 * f64::hypot(half_width_m, half_height_m)
            + 4.0 * config.gimbal_noise_deg.to_radians() * config.height_m;
        let bound = |axis: usize, pick: fn(f64, f64) -> f64| {
            centres.iter().map(|centre| centre[axis]).fold(centres[0][axis], pick)
        };
        let low_m = [bound(0, f64::min), bound(1, f64::min)];
        let high_m = [bound(0, f64::max), bound(1, f64::max)];
        let size = [0, 1].map(|axis| ((high_m[axis] - low_m[axis]) / cell_m) as usize + 1);
        let mut cells = vec![Vec::new(); size[0] * size[1]];
        for (camera, centre) in centres.iter().enumerate() {
            let [i, j] = [0, 1].map(|axis| ((centre[axis] - low_m[axis]) / cell_m) as usize);
            cells[j.min(size[1] - 1) * size[0] + i.min(size[0] - 1)].push(camera);
        }
        CameraIndex { low_m, cell_m, size, cells }
    }

    /// Cameras in the 3 x 3 cells around a place, in the order of the cells.
    pub(crate) fn near(&self, x_m: f64, y_m: f64) -> impl Iterator<Item = usize> {
        let around = |axis: usize, value_m: f64| {
            let cell = ((value_m - self.low_m[axis]) / self.cell_m).floor();
            let last = self.size[axis] as f64;
            // Both ends saturate at 0 from below.
            ((cell - 1.0) as usize)..((cell + 2.0).min(last) as usize)
        };
        let columns = around(0, x_m);
        around(1, y_m)
            .flat_map(move |j| columns.clone().map(move |i| j * self.size[0] + i))
            .flat_map(|cell| self.cells[cell].iter().copied())
    }
}
