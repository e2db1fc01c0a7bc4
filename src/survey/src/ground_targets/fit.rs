//! A target to a fraction of a pixel: the picture of its shape fitted to the photo by least squares.
//!
//! ```text
//! g(p) = b + w white(q) + k black(q) + e,     p = c + B R(theta) S exp(l) q,     min sum e^2 over c, theta, l, blur, b, w, k
//! ```
//!
//! `p` is a pixel, `q` a place of the target in its size, `S` the size in metres, `B` what a metre on the level ground is in the
//! photo (known from the orientation), `c` the wanted centre. Given the others, `b`, `w` and `k` follow by linear least squares
//! (Golub and Pereyra, 1973; variable projection with Kaufman's Jacobian), the others by Levenberg-Marquardt steps. The share of
//! the squares of a plain plate that the pattern explains is the square of the score.

use super::{patch::Patch, shape::Shape};
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

/// Pixels of a target beyond which fewer are as good.
const MAX_FITTED_PX: f64 = 48.0;
const MAX_ITERATIONS: usize = 12;
/// A centre that moves less has converged, pixels.
const TOLERANCE_PX: f64 = 1e-3;
/// Standard deviation of the logarithm of the size about the one that was given.
const SIZE_SIGMA: f64 = 0.1;
/// Blur of a photo that is in focus, with the area of a pixel: standard deviation, pixels, and the standard deviation of its logarithm.
const BLUR: (f64, f64) = (0.8, 0.4);
/// Residuals of neighbouring pixels are alike (interpolated colours, compression): independent ones are so many times fewer.
const CORRELATED_PIXELS: f64 = 4.0;
/// No image measurement is better than this: what the model leaves out (shadows, uneven plates), pixels.
const MIN_SIGMA_PX: f64 = 0.03;

/// The least share of a target that a photo has to show.
const MIN_VISIBLE: f64 = 0.6;

/// What the ground is in a photo: metres to the east and to the south, in pixels.
pub(super) type Jacobian = [[f64; 2]; 2];

/// How long a metre is, pixels.
pub(super) fn px_per_m(ground: &Jacobian) -> f64 {
    (ground[0][0] * ground[1][1] - ground[0][1] * ground[1][0]).abs().sqrt()
}

/// A target in a photo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Fit {
    /// Its centre in the photo, pixels.
    pub(super) centre_px: [f64; 2],
    /// Standard deviation of each coordinate, pixels.
    pub(super) sigma_px: f64,
    /// Its turn from the east to the south, radians.
    pub(super) turn_rad: f64,
    /// Its size over the one that was given.
    pub(super) scale: f64,
    /// Blur, pixels of the photo.
    pub(super) blur_px: f64,
    /// Correlation of the pattern and the photo, 0 to 1.
    pub(super) score: f64,
    /// Grey values of the ground, white and black.
    pub(super) grey: [f64; 3],
}

/// Centre, turn, logarithm of the scale, logarithm of the blur; pixels of the patch.
type Values = SVector<f64, 5>;

struct Problem<'a> {
    patch: &'a Patch,
    shape: &'a Shape,
    ground: Jacobian,
    size_m: f64,
    pixels: Vec<(usize, usize)>,
    /// Logarithm of the blur that is expected, pixels of the patch.
    expected_blur: f64,
}

/// What the linear part gives.
struct Linear {
    residuals: Vec<f64>,
    grey: Vector3<f64>,
    squares: f64,
}

impl Problem<'_> {
    /// Pixels to places of the target.
    fn inverse(&self, values: &Values) -> ([[f64; 2]; 2], f64) {
        let (sin, cos) = values[2].sin_cos();
        let size = self.size_m * values[3].exp() / self.patch.factor;
        let b = self.ground;
        // B R(theta) S, and its inverse.
        let m = [
            [size * (b[0][0] * cos + b[0][1] * sin), size * (b[0][1] * cos - b[0][0] * sin)],
            [size * (b[1][0] * cos + b[1][1] * sin), size * (b[1][1] * cos - b[1][0] * sin)],
        ];
        let determinant = m[0][0] * m[1][1] - m[0][1] * m[1][0];
        let inverse = [
            [m[1][1] / determinant, -m[0][1] / determinant],
            [-m[1][0] / determinant, m[0][0] / determinant],
        ];
        (inverse, determinant.abs().sqrt())
    }

    fn place(inverse: &[[f64; 2]; 2], values: &Values, (i, j): (usize, usize)) -> [f64; 2] {
        let d = [i as f64 - values[0], j as f64 - values[1]];
        inverse.map(|row| row[0] * d[0] + row[1] * d[1])
    }

    /// The pixels on which the shape is compared.
    fn select(&mut self, values: &Values) {
        let (inverse, side) = self.inverse(values);
        // The corners of the square that is covered.
        let half = 1.5 * side * self.shape.reach;
        let (columns, rows) = self.patch.window([values[0], values[1]], half);
        let all = rows.flat_map(|j| columns.clone().map(move |i| (i, j)));
        let covered = all.filter(|&pixel| self.shape.covers(Self::place(&inverse, values, pixel)));
        self.pixels = covered.collect();
    }

    /// White and black shares of the pixels.
    fn shares(&self, values: &Values) -> Vec<[f64; 2]> {
        let (inverse, side) = self.inverse(values);
        let sigma = values[4].exp() / side;
        let share = |&pixel| self.shape.shares(Self::place(&inverse, values, pixel), sigma);
        self.pixels.iter().map(share).collect()
    }

    fn grey(&self) -> impl Iterator<Item = f64> {
        self.pixels.iter().map(|&(i, j)| f64::from(self.patch.data[j * self.patch.width + i]))
    }

    /// Grey values for shares, and what is left.
    fn linear(&self, shares: &[[f64; 2]]) -> Option<Linear> {
        let mut normal = Matrix3::zeros();
        let mut right = Vector3::zeros();
        for (&[white, black], grey) in shares.iter().zip(self.grey()) {
            let row = Vector3::new(1.0, white, black);
            normal += row * row.transpose();
            right += row * grey;
        }
        // Where white and black together cover everything, the ground is not determined.
        let weight = 1e-6 * shares.len() as f64;
        (0..3).for_each(|k| normal[(k, k)] += weight);
        let solution = normal.cholesky()?.solve(&right);
        let model =
            |&[white, black]: &[f64; 2]| solution[0] + white * solution[1] + black * solution[2];
        let residuals: Vec<f64> =
            shares.iter().zip(self.grey()).map(|(share, grey)| grey - model(share)).collect();
        let squares = residuals.iter().map(|r| r * r).sum();
        Some(Linear { residuals, grey: solution, squares })
    }

    /// Squares that are left of a plate without a pattern.
    fn plain_squares(&self, shares: &[[f64; 2]]) -> f64 {
        let level = |[white, black]: &[f64; 2]| match self.shape.has_plate {
            true => white + black,
            false => 0.0,
        };
        let n = shares.len() as f64;
        let plate = shares.iter().map(level).sum::<f64>() / n;
        let mean = self.grey().sum::<f64>() / n;
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for (share, grey) in shares.iter().zip(self.grey()) {
            let (x, y) = (level(share) - plate, grey - mean);
            (xx, xy, yy) = (xx + x * x, xy + x * y, yy + y * y);
        }
        if xx > 1e-6 * n { yy - xy * xy / xx } else { yy }
    }

    /// Weights of what is expected of scale and blur, for one grey value squared of variance.
    fn prior(&self, values: &Values) -> ([f64; 2], [f64; 2]) {
        let weights = [SIZE_SIGMA.powi(-2), BLUR.1.powi(-2)];
        (weights, [values[3], values[4] - self.expected_blur])
    }

    fn cost(&self, squares: f64, values: &Values, variance: f64) -> f64 {
        let (weights, off) = self.prior(values);
        squares + variance * (0..2).map(|k| weights[k] * off[k] * off[k]).sum::<f64>()
    }
}

/// Fits a shape that is about at `start_px`, turned by `turn_rad`; `None` where it does not converge near there or is darker where
/// it should be brighter.
pub(super) fn fit(
    patch: &Patch,
    shape: &Shape,
    (ground, size_m): (&Jacobian, f64),
    start_px: [f64; 2],
    turn_rad: f64,
) -> Option<Fit> {
    let full_px = px_per_m(ground) * size_m;
    let reduced;
    let patch = match (full_px / MAX_FITTED_PX) as usize {
        0 | 1 => patch,
        factor => {
            reduced = patch.reduced(factor);
            &reduced
        }
    };
    let start = patch.in_patch(start_px);
    let expected_blur = (BLUR.0 / patch.factor).max(0.4).ln();
    let mut values = Values::new(start[0], start[1], turn_rad, 0.0, expected_blur);
    let mut problem =
        Problem { patch, shape, ground: *ground, size_m, pixels: Vec::new(), expected_blur };
    problem.select(&values);
    let mut damping = 1e-3;
    let mut shares = problem.shares(&values);
    let mut linear = problem.linear(&shares)?;
    let mut normal = SMatrix::<f64, 5, 5>::zeros();
    for iteration in 0..MAX_ITERATIONS {
        // Pixels change while the centre still does.
        if iteration > 0 && iteration < 4 {
            problem.select(&values);
            shares = problem.shares(&values);
            linear = problem.linear(&shares)?;
        }
        let n = problem.pixels.len();
        if n < 20 {
            return None;
        }
        let variance = linear.squares / (n - 8) as f64;
        let mut jacobian = vec![[0.0; 5]; n];
        for k in 0..5 {
            let step = if k == 4 { 1e-2 } else { 1e-3 };
            let mut moved = values;
            moved[k] += step;
            for ((row, from), to) in jacobian.iter_mut().zip(&shares).zip(problem.shares(&moved)) {
                row[k] = (linear.grey[1] * (to[0] - from[0]) + linear.grey[2] * (to[1] - from[1]))
                    / step;
            }
        }
        normal = SMatrix::zeros();
        let mut right = Values::zeros();
        for (row, residual) in jacobian.iter().zip(&linear.residuals) {
            let row = Values::from_column_slice(row);
            normal += row * row.transpose();
            right += row * *residual;
        }
        if shape.period_rad.is_none() {
            normal[(2, 2)] += 1.0;
        }
        let (weights, off) = problem.prior(&values);
        for k in 0..2 {
            normal[(3 + k, 3 + k)] += variance * weights[k];
            right[3 + k] -= variance * weights[k] * off[k];
        }
        let before = problem.cost(linear.squares, &values, variance);
        let mut step = Values::zeros();
        let mut accepted = false;
        for _ in 0..4 {
            let mut damped = normal;
            (0..5).for_each(|k| damped[(k, k)] *= 1.0 + damping);
            step = damped.cholesky()?.solve(&right);
            let mut next = values + step;
            next[4] = next[4].clamp(0.3f64.ln(), 4.0f64.ln());
            let next_shares = problem.shares(&next);
            let next_linear = problem.linear(&next_shares)?;
            if problem.cost(next_linear.squares, &next, variance) <= before {
                (values, shares, linear) = (next, next_shares, next_linear);
                damping *= 0.2;
                accepted = true;
                break;
            }
            damping = (damping * 10.0).max(1e-2);
        }
        let off = (values[0] - start[0]).hypot(values[1] - start[1]);
        if off > 0.4 * full_px / patch.factor + 1.0 || values[3].abs() > 0.5 {
            return None;
        }
        if !accepted || (iteration >= 4 && step[0].hypot(step[1]) < TOLERANCE_PX) {
            break;
        }
    }
    let n = problem.pixels.len() as f64;
    let variance = linear.squares / (n / CORRELATED_PIXELS - 8.0).max(1.0);
    let covariance = normal.try_inverse()? * variance;
    let sigma = (0.5 * (covariance[(0, 0)] + covariance[(1, 1)])).max(0.0).sqrt();
    let plain = problem.plain_squares(&shares);
    let [_, white, black] = linear.grey.into();
    // Most of it within the photo.
    let (_, side) = problem.inverse(&values);
    let whole = n >= MIN_VISIBLE * shape.area() * side * side;
    if white <= black.max(0.0) || !whole {
        return None;
    }
    Some(Fit {
        centre_px: patch.to_photo([values[0], values[1]]),
        sigma_px: (sigma * patch.factor).hypot(MIN_SIGMA_PX),
        turn_rad: values[2],
        scale: values[3].exp(),
        blur_px: values[4].exp() * patch.factor,
        score: (1.0 - linear.squares / plain.max(1e-9)).max(0.0).sqrt(),
        grey: [linear.grey[0], linear.grey[0] + white, linear.grey[0] + black],
    })
}
