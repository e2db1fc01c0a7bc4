//! Start values of a [`collection`](crate::collection): places drifted by similarities, and errors of each camera.

use crate::{
    block::{ForwardCamera, camera},
    block_camera::{Matrix, matrix, multiply},
    collection::CollectionConfig,
    collection_scene::Wall,
    streams::{Draw, Stage, stream},
};
use rand_chacha::ChaCha8Rng;

/// `X' = s R X + t`.
#[derive(Debug, Clone)]
pub(crate) struct Similarity {
    scale: f64,
    rotation: Matrix,
    shift_m: [f64; 3],
}

impl Similarity {
    pub(crate) fn apply(&self, x: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|i| {
            let turned: f64 = (0..3).map(|k| self.rotation[i][k] * x[k]).sum();
            self.scale * turned + self.shift_m[i]
        })
    }
}

/// How far each place has drifted: its parent's drift, and one of its own about its foot.
pub(crate) fn drifts(config: &CollectionConfig, walls: &[Wall]) -> Vec<Similarity> {
    let identity = Similarity { scale: 1.0, rotation: matrix([0.0; 3]), shift_m: [0.0; 3] };
    let mut found: Vec<Similarity> = Vec::with_capacity(walls.len());
    for (k, wall) in walls.iter().enumerate() {
        let Some(parent) = wall.parent else {
            found.push(identity.clone());
            continue;
        };
        let mut rng = stream(config.seed, Stage::CollectionDrift, k as u64);
        let scale = 1.0 + config.start.drift_scale * rng.normal();
        let turn = config.start.drift_deg.to_radians();
        let rotation = matrix([0; 3].map(|_| turn * rng.normal()));
        let before = &found[parent];
        let own = Similarity { scale, rotation, shift_m: [0.0; 3] };
        let foot = [wall.foot_m[0], wall.foot_m[1], 0.0];
        let turned = own.apply(foot);
        let shift_m = [0, 1, 2].map(|i| foot[i] - turned[i] + config.start.drift_m * rng.normal());
        found.push(Similarity {
            scale: before.scale * scale,
            rotation: multiply(&before.rotation, &own.rotation),
            shift_m: before.apply(shift_m),
        });
    }
    found
}

pub(crate) fn start_camera(
    config: &CollectionConfig,
    image: usize,
    truth: &ForwardCamera,
    drift: &Similarity,
) -> [f64; 9] {
    let mut rng: ChaCha8Rng = stream(config.seed, Stage::BlockCameraStart, image as u64);
    let error_rad = config.start.rotation_deg.to_radians();
    let turn = matrix([0; 3].map(|_| error_rad * rng.normal()));
    let back: Matrix = std::array::from_fn(|i| [0, 1, 2].map(|k| drift.rotation[k][i]));
    let rotation = multiply(&turn, &multiply(&truth.rotation, &back));
    let centre_m = drift.apply(truth.centre_m());
    let centre_m = centre_m.map(|value| value + config.start.centre_m * rng.normal());
    let focal_px = truth.focal_px() * (1.0 + config.start.focal * rng.normal());
    camera(&rotation, centre_m, [focal_px, 0.0, 0.0])
}
