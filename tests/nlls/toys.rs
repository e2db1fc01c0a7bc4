//! Small factors and problems for the tests, as a user would write them.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rowgram::{
    geometry::{cross, rotation},
    nlls::{BlockId, Factor, Infeasible, Jacobian, manifold::direction_basis},
    problems::bundle::{Camera, Network, Observation},
};

/// `y - a exp(-b t)` with `x = (a, b)`.
pub struct Decay {
    pub block: [BlockId; 1],
    pub t: f64,
    pub y: f64,
}

impl Factor for Decay {
    fn rows(&self) -> usize {
        1
    }
    fn blocks(&self) -> &[BlockId] {
        &self.block
    }
    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        let [a, b] = [x[0][0], x[0][1]];
        if b < -50.0 {
            return Err(Infeasible);
        }
        let e = (-b * self.t).exp();
        residual[0] = a * e - self.y;
        if let Some(jacobian) = jacobian {
            jacobian.row(0).copy_from_slice(&[e, -self.t * a * e]);
        }
        Ok(())
    }
}

/// `(s R p + t) - q` with one similarity.
pub struct PointPair {
    pub block: [BlockId; 1],
    pub from: [f64; 3],
    pub to: [f64; 3],
}

impl Factor for PointPair {
    fn rows(&self) -> usize {
        3
    }
    fn blocks(&self) -> &[BlockId] {
        &self.block
    }
    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        let x = x[0];
        let turned = rotation::rotate([x[0], x[1], x[2], x[3]], self.from).map(|v| x[7] * v);
        for k in 0..3 {
            residual[k] = turned[k] + x[4 + k] - self.to[k];
        }
        if let Some(jacobian) = jacobian {
            for k in 0..3 {
                let mut unit = [0.0; 3];
                unit[k] = 1.0;
                let row = jacobian.row(k);
                // d(w x v)_k = w . (v x e_k)
                row[..3].copy_from_slice(&cross(turned, unit));
                row[3 + k] = 1.0;
                row[6] = turned[k];
            }
        }
        Ok(())
    }
}

/// A direction `d` seen from a frame turned by `R`: `R d - measured`.
pub struct SeenDirection {
    pub blocks: [BlockId; 2],
    pub measured: [f64; 3],
}

impl Factor for SeenDirection {
    fn rows(&self) -> usize {
        3
    }
    fn blocks(&self) -> &[BlockId] {
        &self.blocks
    }
    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        let q = [x[0][0], x[0][1], x[0][2], x[0][3]];
        let d = [x[1][0], x[1][1], x[1][2]];
        let turned = rotation::rotate(q, d);
        let basis = direction_basis(d).map(|b| rotation::rotate(q, b));
        for k in 0..3 {
            residual[k] = turned[k] - self.measured[k];
        }
        if let Some(jacobian) = jacobian {
            for k in 0..3 {
                let mut unit = [0.0; 3];
                unit[k] = 1.0;
                let row = jacobian.row(k);
                row[..3].copy_from_slice(&cross(turned, unit));
                row[3] = basis[0][k];
                row[4] = basis[1][k];
            }
        }
        Ok(())
    }
}

/// A standard normal number (Box-Muller).
pub fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v): (f64, f64) = (rng.random(), rng.random());
    (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// A block of nadir images over rough ground, exactly measured but for `sigma_px`.
pub fn network(seed: u64, side: usize, points: usize, sigma_px: f64) -> Network {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut network = Network::default();
    for row in 0..side {
        for column in 0..side {
            let w = [0, 1, 2].map(|_| 0.05 * normal(&mut rng));
            let centre = [5.0 * column as f64, 5.0 * row as f64, 20.0 + normal(&mut rng)];
            let turned = rotation::rotate(rotation::exp(w), centre);
            network.cameras.push(Camera {
                rotation_rad: w,
                translation: turned.map(|v| -v),
                interior: [1000.0, -0.05, 0.01],
            });
        }
    }
    let extent = 5.0 * side as f64;
    while network.points.len() < points {
        let point = [
            extent * rng.random::<f64>() - 2.5,
            extent * rng.random::<f64>() - 2.5,
            normal(&mut rng),
        ];
        let index = network.points.len() as u32;
        let seen: Vec<_> =
            (0..network.cameras.len() as u32)
                .filter_map(|camera| {
                    let image_px = image(&network.cameras[camera as usize], point);
                    (image_px[0].abs() < 500.0 && image_px[1].abs() < 400.0)
                        .then_some(Observation { camera, point: index, image_px })
                })
                .collect();
        if seen.len() < 2 {
            continue;
        }
        network.points.push(point);
        for mut observation in seen {
            for v in &mut observation.image_px {
                *v += sigma_px * normal(&mut rng);
            }
            network.observations.push(observation);
        }
    }
    network
}

/// Where a camera sees a point, written out once more.
pub fn image(camera: &Camera, point: [f64; 3]) -> [f64; 2] {
    let turned = rotation::rotate(rotation::exp(camera.rotation_rad), point);
    let p: [f64; 3] = std::array::from_fn(|k| turned[k] + camera.translation[k]);
    let (x, y) = (-p[0] / p[2], -p[1] / p[2]);
    let [f, k1, k2] = camera.interior;
    let square = x * x + y * y;
    let scale = f * (1.0 + k1 * square + k2 * square * square);
    [scale * x, scale * y]
}

/// Moves everything but the first camera away from where it is.
pub fn perturb(network: &mut Network, seed: u64, size: f64) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for camera in network.cameras.iter_mut().skip(1) {
        for k in 0..3 {
            camera.rotation_rad[k] += 0.01 * size * normal(&mut rng);
            camera.translation[k] += 0.1 * size * normal(&mut rng);
        }
    }
    for point in &mut network.points {
        point.iter_mut().for_each(|v| *v += 0.1 * size * normal(&mut rng));
    }
}
