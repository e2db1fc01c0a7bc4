//! A problem of the engine as a plain vector of numbers, for solvers that know of no rotations, no blocks
//! and no losses.
//!
//! ```text
//! R_i = exp(w_i) R_i0,   everything else by addition          y = sqrt(D) (x - x_0)
//! ```
//!
//! with `D` the diagonal of `J^T J` at the start: without that scale pixels of principal distance and
//! radians of rotation make every first-order method crawl. Derivatives come from the increments of the
//! engine's poses, `dP = omega x P + s`, by `omega = J_l(w) dw` and `s = dt + t x omega`, where `J_l` is the
//! left Jacobian of the rotations. A loss weighs residual and rows of a factor by `sqrt(rho')`: their
//! gradient is that of the cost, and their `J^T J` is the usual model of iterative reweighting.

use super::contestants::{Dense, GaussNewtonHessian, Rows};
use argmin::core::{CostFunction, Error, Gradient, Hessian, Jacobian, Operator};
use nalgebra::{Matrix3, Vector3};
use rowgram::{
    geometry::rotation,
    nlls::{Loss, LossFunction, Problem, Rho},
};
use std::{
    sync::{Arc, Mutex},
    time::Instant,
};

/// Numbers of a pose that move: rotation and translation.
const POSE: usize = 6;
/// Numbers of a pose that are stored: quaternion and translation.
const STORED_POSE: usize = 7;

/// How the values of a block follow from its offsets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Chart {
    /// A pose and so many numbers more.
    Pose(usize),
    /// So many numbers.
    Plain(usize),
}

impl Chart {
    fn stored(self) -> usize {
        match self {
            Chart::Pose(more) => STORED_POSE + more,
            Chart::Plain(count) => count,
        }
    }

    fn moving(self) -> usize {
        match self {
            Chart::Pose(more) => POSE + more,
            Chart::Plain(count) => count,
        }
    }
}

/// The loss of a batch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Weighing {
    /// One of the engine.
    Robust(Loss),
    /// So many times the length of the residual, without its square: `rho = 2 w sqrt(s)`.
    Length(f64),
}

impl LossFunction for Weighing {
    fn evaluate(&self, s: f64) -> Rho {
        /// Squared lengths below this count as this: the slope has no limit at 0.
        const MIN_SQUARE: f64 = 1e-24;
        match *self {
            Weighing::Robust(loss) => loss.evaluate(s),
            Weighing::Length(weight) => {
                let first = weight / s.max(MIN_SQUARE).sqrt();
                let second = -0.5 * first / s.max(MIN_SQUARE);
                Rho { value: 2.0 * weight * s.sqrt(), first, second }
            }
        }
    }
}

/// A problem and what has to be known of it to move it as a vector.
#[derive(Debug)]
pub(super) struct Charted {
    pub(super) problem: Problem,
    /// One for each block, in their order.
    pub(super) charts: Vec<Chart>,
    /// Every batch with its loss.
    pub(super) batches: Vec<(&'static str, Weighing)>,
}

/// What came of all evaluations.
#[derive(Debug)]
pub(super) struct Noted {
    /// Evaluations of all residuals, with or without derivatives.
    pub(super) passes: f64,
    pub(super) lowest: f64,
    /// Whenever the cost was lower than before: passes, cost, seconds.
    pub(super) log: Vec<[f64; 3]>,
    /// Where the lowest cost is, as the engine's values.
    pub(super) best: Vec<f64>,
    began: Instant,
    last: Option<(Vec<f64>, Arc<Linearized>)>,
}

/// When a race is over.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limits {
    /// Evaluations at most.
    pub(super) passes: f64,
    /// A cost as near to the best known as any question asks for: between these ends.
    pub(super) enough: [f64; 2],
}

impl Limits {
    /// As far as the solver itself goes.
    pub(super) const NONE: Limits = Limits { passes: f64::INFINITY, enough: [0.0, -1.0] };
}

/// All at one place.
#[derive(Debug, Default)]
struct Linearized {
    residual: Vec<f64>,
    gradient: Vec<f64>,
    hessian: GaussNewtonHessian,
}

/// A factor's row of the Jacobian, by column.
type Row = Vec<(usize, f64)>;

/// The problem; clones share what they note.
#[derive(Debug, Clone)]
pub(super) struct FlatProblem {
    charted: Arc<Charted>,
    /// Where the values and the offsets of each block begin.
    places: Arc<Vec<[usize; 2]>>,
    start: Arc<Vec<f64>>,
    scale: Arc<Vec<f64>>,
    /// The cost of the start.
    begin: f64,
    limits: Limits,
    pub(super) noted: Arc<Mutex<Noted>>,
}

impl FlatProblem {
    pub(super) fn new(charted: Arc<Charted>, limits: Limits) -> Result<FlatProblem, String> {
        let began = Instant::now();
        let start = charted.problem.start();
        let mut places = Vec::with_capacity(charted.charts.len());
        let (mut stored, mut n) = (0, 0);
        for chart in &charted.charts {
            places.push([stored, n]);
            stored += chart.stored();
            n += chart.moving();
        }
        if stored != start.len() {
            return Err(format!("the charts have {stored} numbers, the blocks {}", start.len()));
        }
        let noted = Noted {
            passes: 0.0,
            lowest: f64::INFINITY,
            log: Vec::new(),
            best: start.clone(),
            began,
            last: None,
        };
        let mut flat = FlatProblem {
            charted,
            places: Arc::new(places),
            start: Arc::new(start),
            scale: Arc::new(vec![1.0; n]),
            begin: 0.0,
            limits,
            noted: Arc::new(Mutex::new(noted)),
        };
        let mut diagonal = vec![0.0; n];
        let begin = flat.rows(&vec![0.0; n], |_, row| {
            row.iter().for_each(|&(column, value)| diagonal[column] += value * value);
        });
        flat.begin = begin.map_err(|e| e.to_string())?;
        let scale = diagonal.iter().map(|d| if *d > 0.0 { 1.0 / d.sqrt() } else { 1.0 });
        flat.scale = Arc::new(scale.collect());
        Ok(flat)
    }

    /// Where the race begins.
    pub(super) fn origin(&self) -> Vec<f64> {
        vec![0.0; self.scale.len()]
    }

    /// The unscaled offsets from `at`.
    fn offset(&self, y: &[f64], at: usize) -> f64 {
        y[at] * self.scale[at]
    }

    /// The values of the engine at `y`.
    fn values(&self, y: &[f64]) -> Vec<f64> {
        let mut x = self.start.to_vec();
        for (chart, &[stored, at]) in self.charted.charts.iter().zip(self.places.iter()) {
            let plain = match chart {
                Chart::Plain(_) => [stored, at],
                Chart::Pose(_) => {
                    let w = [0, 1, 2].map(|k| self.offset(y, at + k));
                    let before = [0, 1, 2, 3].map(|k| x[stored + k]);
                    let turned = rotation::multiply(rotation::exp(w), before);
                    x[stored..stored + 4].copy_from_slice(&rotation::normalize(turned));
                    [stored + 4, at + 3]
                }
            };
            for k in 0..stored + chart.stored() - plain[0] {
                x[plain[0] + k] += self.offset(y, plain[1] + k);
            }
        }
        x
    }

    /// Calls `visit(residual, row)` for every row of the Jacobian by `y`, weighed; the cost.
    fn rows(&self, y: &[f64], mut visit: impl FnMut(f64, &Row)) -> Result<f64, Error> {
        let x = self.values(y);
        // d(omega, s)/d(w, t) of each pose.
        let chains: Vec<Option<(Matrix3<f64>, Matrix3<f64>)>> = self
            .charted
            .charts
            .iter()
            .zip(self.places.iter())
            .map(|(chart, &[stored, at])| {
                matches!(chart, Chart::Pose(_)).then(|| {
                    let turn = left_jacobian(Vector3::from_fn(|k, _| self.offset(y, at + k)));
                    let t = Vector3::from_column_slice(&x[stored + 4..stored + STORED_POSE]);
                    (turn, t.cross_matrix() * turn)
                })
            })
            .collect();
        let (mut row, mut cost) = (Row::new(), 0.0);
        for (name, weighing) in &self.charted.batches {
            let factors = self.charted.problem.linearized(&x, name);
            for (blocks, residual, jacobian) in &factors.map_err(|e| Error::msg(e.to_string()))? {
                let weight = match weighing {
                    Weighing::Robust(Loss::Trivial) => {
                        residual.iter().for_each(|r| cost += 0.5 * r * r);
                        1.0
                    }
                    _ => {
                        let rho = weighing.evaluate(residual.iter().map(|r| r * r).sum());
                        cost += 0.5 * rho.value;
                        rho.first.sqrt()
                    }
                };
                let width = jacobian.len() / residual.len();
                for (r, mut entries) in residual.iter().zip(jacobian.chunks_exact(width)) {
                    row.clear();
                    for block in blocks.iter().map(|block| block.index()) {
                        let at = self.places[block][1];
                        let (mine, rest) = entries.split_at(self.charted.charts[block].moving());
                        entries = rest;
                        let mut plain = 0;
                        if let Some((turn, shift)) = &chains[block] {
                            let omega = Vector3::from_column_slice(&mine[..3]);
                            let s = Vector3::from_column_slice(&mine[3..POSE]);
                            let w = turn.tr_mul(&omega) + shift.tr_mul(&s);
                            row.extend((0..3).map(|k| (at + k, w[k])));
                            plain = 3;
                        }
                        row.extend((plain..mine.len()).map(|k| (at + k, mine[k])));
                    }
                    row.iter_mut().for_each(|(column, v)| *v *= self.scale[*column] * weight);
                    visit(*r * weight, &row);
                }
            }
        }
        Ok(cost)
    }

    /// Counts an evaluation with this cost.
    fn note(&self, y: &[f64], cost: f64) -> Result<(), Error> {
        let mut noted = self.noted.lock().map_err(|_| Error::msg("another thread failed"))?;
        noted.passes += 1.0;
        if cost < noted.lowest {
            noted.lowest = cost;
            noted.best = self.values(y);
            let entry = [noted.passes, cost, noted.began.elapsed().as_secs_f64()];
            noted.log.push(entry);
        }
        let [low, high] = self.limits.enough;
        if noted.passes >= self.limits.passes || (low..=high).contains(&cost) {
            return Err(Error::msg("the race is over"));
        }
        Ok(())
    }

    /// The cost where the residuals have none, such as a point without an image: far above that of the
    /// start and falling towards it, so that a line search or a simplex turns back.
    fn wall(&self, y: &[f64]) -> f64 {
        self.begin * (10.0 + y.iter().map(|y| y * y).sum::<f64>())
    }

    /// Everything at `y`; asking twice at the same place costs once.
    fn linearized(&self, y: &[f64]) -> Result<Arc<Linearized>, Error> {
        let poisoned = "another thread failed";
        if let Some((at, there)) = &self.noted.lock().map_err(|_| Error::msg(poisoned))?.last
            && at == y
        {
            return Ok(there.clone());
        }
        let mut gradient = vec![0.0; y.len()];
        let (mut rows, mut residual) = (Rows::default(), Vec::new());
        let done = self.rows(y, |r, row| {
            for &(column, value) in row {
                gradient[column] += value * r;
                rows.put(column, value);
            }
            rows.end();
            residual.push(r);
        });
        let (cost, found) = match done {
            Ok(cost) => (cost, Linearized { residual, gradient, hessian: rows.into() }),
            Err(_) => {
                let gradient = y.iter().map(|y| 2.0 * self.begin * y).collect();
                (self.wall(y), Linearized { gradient, ..Linearized::default() })
            }
        };
        self.note(y, cost)?;
        let found = Arc::new(found);
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

impl CostFunction for FlatProblem {
    type Param = Vec<f64>;
    type Output = f64;

    fn cost(&self, y: &Vec<f64>) -> Result<f64, Error> {
        let costs = self.charted.problem.costs(&self.values(y));
        let cost = costs.map_or_else(|_| self.wall(y), |costs| costs.iter().sum());
        self.note(y, cost)?;
        Ok(cost)
    }
}

impl Gradient for FlatProblem {
    type Param = Vec<f64>;
    type Gradient = Vec<f64>;

    fn gradient(&self, y: &Vec<f64>) -> Result<Vec<f64>, Error> {
        Ok(self.linearized(y)?.gradient.clone())
    }
}

impl Hessian for FlatProblem {
    type Param = Vec<f64>;
    type Hessian = GaussNewtonHessian;

    fn hessian(&self, y: &Vec<f64>) -> Result<GaussNewtonHessian, Error> {
        Ok(self.linearized(y)?.hessian.clone())
    }
}

impl Operator for FlatProblem {
    type Param = Vec<f64>;
    type Output = Vec<f64>;

    fn apply(&self, y: &Vec<f64>) -> Result<Vec<f64>, Error> {
        let residual = &self.linearized(y)?.residual;
        if residual.is_empty() {
            return Err(Error::msg("there are no residuals"));
        }
        Ok(residual.clone())
    }
}

impl Jacobian for FlatProblem {
    type Param = Vec<f64>;
    type Jacobian = Dense;

    fn jacobian(&self, y: &Vec<f64>) -> Result<Dense, Error> {
        Ok(self.linearized(y)?.hessian.jacobian(y.len()))
    }
}

/// Compares the gradient with differences of costs, away from the start, where the left Jacobian
/// is not the identity.
#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]
pub(super) fn check_gradient(charted: Charted, away: f64, tolerance: f64) {
    let flat = FlatProblem::new(Arc::new(charted), Limits::NONE).unwrap();
    let y: Vec<f64> =
        flat.scale.iter().enumerate().map(|(k, s)| away * (k as f64).sin() / s).collect();
    let gradient = flat.gradient(&y).unwrap();
    for k in 0..y.len() {
        let h = 1e-6 / flat.scale[k];
        let at = |sign: f64| {
            let mut moved = y.clone();
            moved[k] += sign * h;
            flat.cost(&moved).unwrap()
        };
        let difference = (at(1.0) - at(-1.0)) / (2.0 * h);
        let size = difference.abs().max(1.0);
        assert!(
            (difference - gradient[k]).abs() < tolerance * size,
            "{k}: {difference} {}",
            gradient[k]
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram::problems::bundle::{
        Bundle, Camera, InteriorSharing, Network, Observation, TIE_POINTS,
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
        for loss in [Loss::Trivial, Loss::Huber(20.0)] {
            let bundle = Bundle::new(&network, InteriorSharing::PerImage, loss).unwrap();
            let charted = Charted {
                problem: bundle.problem,
                charts: [vec![Chart::Pose(3); 2], vec![Chart::Plain(3); 8]].concat(),
                batches: vec![(TIE_POINTS, Weighing::Robust(loss))],
            };
            check_gradient(charted, 0.05, 1e-4);
        }
    }

    #[test]
    fn the_length_is_its_own_loss() {
        let (loss, s, h) = (Weighing::Length(1.7), 5.0, 1e-4);
        let [below, at, above] = [s - h, s, s + h].map(|s| loss.evaluate(s));
        assert!((at.value - 3.4 * 5f64.sqrt()).abs() < 1e-12);
        assert!(((above.value - below.value) / (2.0 * h) - at.first).abs() < 1e-8);
        assert!(((above.first - below.first) / (2.0 * h) - at.second).abs() < 1e-8);
        assert!(loss.evaluate(0.0).first.is_finite());
    }
}
