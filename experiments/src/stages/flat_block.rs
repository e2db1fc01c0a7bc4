//! A bundle block as a plain vector of numbers, for solvers that know of no rotations and no points.
//!
//! ```text
//! R_i = exp(w_i) R_i0,   t_i,   f_i,   k1_i,   k2_i,   X_j          y = sqrt(D) (x - x_0)
//! ```
//!
//! with `D` the diagonal of `J^T J` at the start: without that scale pixels of principal distance and
//! radians of rotation make every first-order method crawl. Derivatives come from the increments of the
//! engine's poses, `dP = omega x P + s`, by `omega = J_l(w) dw` and `s = dt + t x omega`, where `J_l` is the
//! left Jacobian of the rotations.

use super::contestants::{GaussNewtonHessian, Rows};
use argmin::core::{CostFunction, Error, Gradient, Hessian};
use nalgebra::{Matrix3, Vector3};
use rowgram::{
    geometry::rotation,
    problems::bundle::{Bundle, TIE_POINTS},
};
use std::{
    sync::{Arc, Mutex},
    time::Instant,
};

/// Numbers of a camera: rotation, translation, principal distance and two coefficients.
const CAMERA: usize = 9;
/// Numbers of a point.
const POINT: usize = 3;

/// What came of all evaluations.
#[derive(Debug)]
pub(super) struct Noted {
    /// Evaluations of all measurements, with or without derivatives.
    pub(super) passes: f64,
    pub(super) lowest: f64,
    /// Passes and seconds when the cost first was as low as it should be.
    pub(super) solved: Option<(f64, f64)>,
    /// The lowest cost by passes.
    pub(super) log: Vec<[f64; 2]>,
    /// Where the lowest cost is, as the engine's values.
    pub(super) best: Vec<f64>,
    began: Instant,
    last: Option<(Vec<f64>, Arc<Linearized>)>,
}

/// Gradient and rows over the flat parameters at one place.
#[derive(Debug, Default)]
struct Linearized {
    gradient: Vec<f64>,
    hessian: GaussNewtonHessian,
}

/// The block; clones share what they note.
#[derive(Debug, Clone)]
pub(super) struct FlatBlock {
    bundle: Arc<Bundle>,
    cameras: usize,
    start: Arc<Vec<f64>>,
    scale: Arc<Vec<f64>>,
    target: f64,
    pub(super) noted: Arc<Mutex<Noted>>,
}

impl FlatBlock {
    /// A block of so many cameras and points with lenses of their own, without a loss; solved at the cost
    /// `target`.
    pub(super) fn new(
        bundle: Bundle,
        cameras: usize,
        points: usize,
        target: f64,
    ) -> Result<FlatBlock, String> {
        let start = bundle.problem.start();
        let n = CAMERA * cameras + POINT * points;
        let noted = Noted {
            passes: 0.0,
            lowest: f64::INFINITY,
            solved: None,
            log: Vec::new(),
            best: start.clone(),
            began: Instant::now(),
            last: None,
        };
        let mut block = FlatBlock {
            bundle: Arc::new(bundle),
            cameras,
            start: Arc::new(start),
            scale: Arc::new(vec![1.0; n]),
            target,
            noted: Arc::new(Mutex::new(noted)),
        };
        let mut diagonal = vec![0.0; n];
        block
            .rows(&vec![0.0; n], |_, row| {
                row.iter().for_each(|&(column, value)| diagonal[column] += value * value);
            })
            .map_err(|e| e.to_string())?;
        let scale = diagonal.iter().map(|d| if *d > 0.0 { 1.0 / d.sqrt() } else { 1.0 });
        block.scale = Arc::new(scale.collect());
        Ok(block)
    }

    /// Where the race begins.
    pub(super) fn origin(&self) -> Vec<f64> {
        vec![0.0; self.scale.len()]
    }

    /// The unscaled offsets of a camera.
    fn offsets(&self, y: &[f64], at: usize) -> [f64; CAMERA] {
        std::array::from_fn(|k| y[at + k] * self.scale[at + k])
    }

    /// The values of the engine at `y`.
    fn values(&self, y: &[f64]) -> Vec<f64> {
        let mut x = self.start.to_vec();
        // Quaternion, translation, interior orientation; then the points.
        for (i, camera) in x.chunks_exact_mut(10).take(self.cameras).enumerate() {
            let [a, b, c, rest @ ..] = self.offsets(y, CAMERA * i);
            let before = [camera[0], camera[1], camera[2], camera[3]];
            let turned = rotation::multiply(rotation::exp([a, b, c]), before);
            camera[..4].copy_from_slice(&rotation::normalize(turned));
            camera[4..].iter_mut().zip(rest).for_each(|(value, offset)| *value += offset);
        }
        let (first, from) = (10 * self.cameras, CAMERA * self.cameras);
        for (k, value) in x[first..].iter_mut().enumerate() {
            *value += y[from + k] * self.scale[from + k];
        }
        x
    }

    /// Calls `visit(residual, row)` for every row of the Jacobian by `y`.
    fn rows(&self, y: &[f64], mut visit: impl FnMut(f64, &[(usize, f64)])) -> Result<(), Error> {
        let x = self.values(y);
        let problem = &self.bundle.problem;
        let factors = problem.linearized(&x, TIE_POINTS).map_err(|e| Error::msg(e.to_string()))?;
        // d(omega, s)/d(w, t) of each camera.
        let chains: Vec<(Matrix3<f64>, Matrix3<f64>)> = (0..self.cameras)
            .map(|i| {
                let [a, b, c, ..] = self.offsets(y, CAMERA * i);
                let turn = left_jacobian(Vector3::new(a, b, c));
                let t = Vector3::from_column_slice(&x[10 * i + 4..10 * i + 7]);
                (turn, t.cross_matrix() * turn)
            })
            .collect();
        let mut row: Vec<(usize, f64)> = Vec::with_capacity(CAMERA + POINT);
        for (blocks, residual, jacobian) in &factors {
            let (camera, point) = (blocks[0].index(), blocks[1].index() - self.cameras);
            let (turn, shift) = &chains[camera];
            let (at, point_at) = (CAMERA * camera, CAMERA * self.cameras + POINT * point);
            for (r, entries) in residual.iter().zip(jacobian.chunks_exact(CAMERA + POINT)) {
                let omega = Vector3::from_column_slice(&entries[..3]);
                let s = Vector3::from_column_slice(&entries[3..6]);
                let w = turn.tr_mul(&omega) + shift.tr_mul(&s);
                row.clear();
                row.extend((0..3).map(|k| (at + k, w[k])));
                row.extend((3..CAMERA).map(|k| (at + k, entries[k])));
                row.extend((0..POINT).map(|k| (point_at + k, entries[CAMERA + k])));
                row.iter_mut().for_each(|(column, value)| *value *= self.scale[*column]);
                visit(*r, &row);
            }
        }
        Ok(())
    }

    /// Counts an evaluation with this cost.
    fn note(&self, y: &[f64], cost: f64) -> Result<(), Error> {
        let mut noted = self.noted.lock().map_err(|_| Error::msg("another thread failed"))?;
        noted.passes += 1.0;
        if cost < noted.lowest {
            noted.lowest = cost;
            noted.best = self.values(y);
            let passes = noted.passes;
            noted.log.push([passes, cost]);
            if cost <= self.target && noted.solved.is_none() {
                noted.solved = Some((passes, noted.began.elapsed().as_secs_f64()));
            }
        }
        Ok(())
    }

    /// Gradient and Hessian; asking twice at the same place costs once.
    fn linearized(&self, y: &[f64]) -> Result<Arc<Linearized>, Error> {
        let poisoned = "another thread failed";
        if let Some((at, there)) = &self.noted.lock().map_err(|_| Error::msg(poisoned))?.last
            && at == y
        {
            return Ok(there.clone());
        }
        let mut gradient = vec![0.0; y.len()];
        let (mut rows, mut cost) = (Rows::default(), 0.0);
        self.rows(y, |r, row| {
            cost += 0.5 * r * r;
            for &(column, value) in row {
                gradient[column] += value * r;
                rows.put(column, value);
            }
            rows.end();
        })?;
        self.note(y, cost)?;
        let found = Arc::new(Linearized { gradient, hessian: rows.into() });
        let mut noted = self.noted.lock().map_err(|_| Error::msg(poisoned))?;
        noted.last = Some((y.to_vec(), found.clone()));
        Ok(found)
    }
}

/// `J_l(w)`: a turn by `w + dw` is a turn by `w` and then by `J_l dw`.
fn left_jacobian(w: Vector3<f64>) -> Matrix3<f64> {
    let angle = w.norm();
    let cross = w.cross_matrix();
    let (a, b) = if angle < 1e-4 {
        (0.5 - angle * angle / 24.0, 1.0 / 6.0 - angle * angle / 120.0)
    } else {
        ((1.0 - angle.cos()) / angle.powi(2), (angle - angle.sin()) / angle.powi(3))
    };
    Matrix3::identity() + cross * a + cross * cross * b
}

impl CostFunction for FlatBlock {
    type Param = Vec<f64>;
    type Output = f64;

    fn cost(&self, y: &Vec<f64>) -> Result<f64, Error> {
        let costs = self.bundle.problem.costs(&self.values(y));
        let cost = costs.map_err(|e| Error::msg(e.to_string()))?.iter().sum();
        self.note(y, cost)?;
        Ok(cost)
    }
}

impl Gradient for FlatBlock {
    type Param = Vec<f64>;
    type Gradient = Vec<f64>;

    fn gradient(&self, y: &Vec<f64>) -> Result<Vec<f64>, Error> {
        Ok(self.linearized(y)?.gradient.clone())
    }
}

impl Hessian for FlatBlock {
    type Param = Vec<f64>;
    type Hessian = GaussNewtonHessian;

    fn hessian(&self, y: &Vec<f64>) -> Result<GaussNewtonHessian, Error> {
        Ok(self.linearized(y)?.hessian.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram::{
        nlls::Loss,
        problems::bundle::{Camera, InteriorSharing, Network, Observation},
    };

    #[test]
    fn the_gradient_is_the_difference_of_the_costs() {
        let points: Vec<[f64; 3]> = (0..8)
            .map(|k| [f64::from(k % 3) - 1.0, f64::from(k / 3) - 1.0, 0.1 * f64::from(k)])
            .collect();
        let camera = |a: f64| Camera {
            rotation_rad: [0.2 * a, -0.1, 0.3],
            translation: [a, 0.2, -6.0],
            interior: [500.0, -0.05, 0.01],
        };
        let observations = (0..2u32)
            .flat_map(|camera| (0..8).map(move |point| (camera, point)))
            .map(|(camera, point)| Observation {
                camera,
                point,
                image_px: [f64::from(point) * 20.0 - 70.0, 40.0 - f64::from(point) * 9.0],
            })
            .collect();
        let network = Network { cameras: vec![camera(0.5), camera(-0.5)], points, observations };
        let bundle = Bundle::new(&network, InteriorSharing::PerImage, Loss::Trivial).unwrap();
        let block = FlatBlock::new(bundle, 2, 8, 0.0).unwrap();
        // Away from the start, where the left Jacobian is not the identity.
        let y: Vec<f64> =
            block.scale.iter().enumerate().map(|(k, s)| 0.05 * (k as f64).sin() / s).collect();
        let gradient = block.gradient(&y).unwrap();
        for k in 0..y.len() {
            let h = 1e-6 / block.scale[k];
            let at = |sign: f64| {
                let mut moved = y.clone();
                moved[k] += sign * h;
                block.cost(&moved).unwrap()
            };
            let difference = (at(1.0) - at(-1.0)) / (2.0 * h);
            let size = difference.abs().max(1.0);
            assert!((difference - gradient[k]).abs() < 1e-4 * size, "{k}: {difference}");
        }
    }
}
