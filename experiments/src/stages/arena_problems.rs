//! Small problems of least squares that everybody uses, with analytic Jacobians.
//!
//! Reference: J. J. More, B. S. Garbow and K. E. Hillstrom, "Testing unconstrained optimization
//! software", ACM Transactions on Mathematical Software 7, 1981; the numbers in its list are given.

/// A problem: `J = 1/2 |r(x)|^2`.
pub(super) struct Classic {
    /// The word for it in specs.
    pub(super) name: &'static str,
    /// The usual start.
    pub(super) start: &'static [f64],
    /// Number of residuals.
    pub(super) rows: usize,
    /// The least `1/2 |r|^2`.
    pub(super) best: f64,
    /// Writes residuals and, row by row, the Jacobian.
    pub(super) evaluate: fn(&[f64], &mut [f64], Option<&mut [f64]>),
}

/// All problems.
pub(super) static CLASSICS: [Classic; 9] = [
    Classic { name: "rosenbrock", start: &[-1.2, 1.0], rows: 2, best: 0.0, evaluate: rosenbrock },
    Classic {
        name: "powell-badly-scaled",
        start: &[0.0, 1.0],
        rows: 2,
        best: 0.0,
        evaluate: powell_badly_scaled,
    },
    Classic { name: "beale", start: &[1.0, 1.0], rows: 3, best: 0.0, evaluate: beale },
    Classic {
        name: "helical-valley",
        start: &[-1.0, 0.0, 0.0],
        rows: 3,
        best: 0.0,
        evaluate: helical_valley,
    },
    Classic {
        name: "bard",
        start: &[1.0, 1.0, 1.0],
        rows: 15,
        best: 0.5 * 8.214_877_306_578_963e-3,
        evaluate: bard,
    },
    Classic { name: "box", start: &[0.0, 10.0, 20.0], rows: 10, best: 0.0, evaluate: box_three },
    Classic {
        name: "powell-singular",
        start: &[3.0, -1.0, 0.0, 1.0],
        rows: 4,
        best: 0.0,
        evaluate: powell_singular,
    },
    Classic { name: "wood", start: &[-3.0, -1.0, -3.0, -1.0], rows: 6, best: 0.0, evaluate: wood },
    Classic {
        name: "kowalik-osborne",
        start: &[0.25, 0.39, 0.415, 0.39],
        rows: 11,
        best: 0.5 * 3.075_056_038_492_371e-4,
        evaluate: kowalik,
    },
];

fn put(jacobian: Option<&mut [f64]>, rows: &[&[f64]]) {
    if let Some(jacobian) = jacobian {
        let width = rows[0].len();
        for (k, row) in rows.iter().enumerate() {
            jacobian[k * width..(k + 1) * width].copy_from_slice(row);
        }
    }
}

/// Number 1.
fn rosenbrock(x: &[f64], r: &mut [f64], j: Option<&mut [f64]>) {
    r[0] = 10.0 * (x[1] - x[0] * x[0]);
    r[1] = 1.0 - x[0];
    put(j, &[&[-20.0 * x[0], 10.0], &[-1.0, 0.0]]);
}

/// Number 3.
fn powell_badly_scaled(x: &[f64], r: &mut [f64], j: Option<&mut [f64]>) {
    r[0] = 1e4 * x[0] * x[1] - 1.0;
    r[1] = (-x[0]).exp() + (-x[1]).exp() - 1.0001;
    put(j, &[&[1e4 * x[1], 1e4 * x[0]], &[-(-x[0]).exp(), -(-x[1]).exp()]]);
}

/// Number 5.
fn beale(x: &[f64], r: &mut [f64], mut j: Option<&mut [f64]>) {
    for (i, y) in [1.5, 2.25, 2.625].into_iter().enumerate() {
        let power = x[1].powi(i as i32 + 1);
        r[i] = y - x[0] * (1.0 - power);
        if let Some(j) = &mut j {
            j[2 * i] = power - 1.0;
            j[2 * i + 1] = x[0] * (i as f64 + 1.0) * x[1].powi(i as i32);
        }
    }
}

/// Number 7.
fn helical_valley(x: &[f64], r: &mut [f64], j: Option<&mut [f64]>) {
    let tau = std::f64::consts::TAU;
    let turn = if x[0] == 0.0 {
        0.25 * x[1].signum()
    } else {
        (x[1] / x[0]).atan() / tau + if x[0] < 0.0 { 0.5 } else { 0.0 }
    };
    let square = x[0] * x[0] + x[1] * x[1];
    let radius = square.sqrt();
    r[0] = 10.0 * (x[2] - 10.0 * turn);
    r[1] = 10.0 * (radius - 1.0);
    r[2] = x[2];
    let by = 100.0 / (tau * square);
    put(
        j,
        &[
            &[by * x[1], -by * x[0], 10.0],
            &[10.0 * x[0] / radius, 10.0 * x[1] / radius, 0.0],
            &[0.0, 0.0, 1.0],
        ],
    );
}

/// Number 8.
fn bard(x: &[f64], r: &mut [f64], mut j: Option<&mut [f64]>) {
    const Y: [f64; 15] =
        [0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39];
    for (i, y) in Y.into_iter().enumerate() {
        let u = i as f64 + 1.0;
        let v = 16.0 - u;
        let w = u.min(v);
        let below = v * x[1] + w * x[2];
        r[i] = y - (x[0] + u / below);
        if let Some(j) = &mut j {
            let by = u / (below * below);
            j[3 * i..3 * i + 3].copy_from_slice(&[-1.0, by * v, by * w]);
        }
    }
}

/// Number 12, with ten residuals.
fn box_three(x: &[f64], r: &mut [f64], mut j: Option<&mut [f64]>) {
    for i in 0..10 {
        let t = 0.1 * (i as f64 + 1.0);
        let [a, b] = [(-t * x[0]).exp(), (-t * x[1]).exp()];
        let c = (-t).exp() - (-10.0 * t).exp();
        r[i] = a - b - x[2] * c;
        if let Some(j) = &mut j {
            j[3 * i..3 * i + 3].copy_from_slice(&[-t * a, t * b, -c]);
        }
    }
}

/// Number 13.
fn powell_singular(x: &[f64], r: &mut [f64], j: Option<&mut [f64]>) {
    let (five, ten) = (5f64.sqrt(), 10f64.sqrt());
    let (a, b) = (x[1] - 2.0 * x[2], x[0] - x[3]);
    r[0] = x[0] + 10.0 * x[1];
    r[1] = five * (x[2] - x[3]);
    r[2] = a * a;
    r[3] = ten * b * b;
    put(
        j,
        &[
            &[1.0, 10.0, 0.0, 0.0],
            &[0.0, 0.0, five, -five],
            &[0.0, 2.0 * a, -4.0 * a, 0.0],
            &[2.0 * ten * b, 0.0, 0.0, -2.0 * ten * b],
        ],
    );
}

/// Number 14.
fn wood(x: &[f64], r: &mut [f64], j: Option<&mut [f64]>) {
    let (n, t) = (90f64.sqrt(), 10f64.sqrt());
    r[0] = 10.0 * (x[1] - x[0] * x[0]);
    r[1] = 1.0 - x[0];
    r[2] = n * (x[3] - x[2] * x[2]);
    r[3] = 1.0 - x[2];
    r[4] = t * (x[1] + x[3] - 2.0);
    r[5] = (x[1] - x[3]) / t;
    put(
        j,
        &[
            &[-20.0 * x[0], 10.0, 0.0, 0.0],
            &[-1.0, 0.0, 0.0, 0.0],
            &[0.0, 0.0, -2.0 * n * x[2], n],
            &[0.0, 0.0, -1.0, 0.0],
            &[0.0, t, 0.0, t],
            &[0.0, 1.0 / t, 0.0, -1.0 / t],
        ],
    );
}

/// Number 15.
fn kowalik(x: &[f64], r: &mut [f64], mut j: Option<&mut [f64]>) {
    const Y: [f64; 11] =
        [0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246];
    const U: [f64; 11] = [4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625];
    for i in 0..11 {
        let u = U[i];
        let (above, below) = (u * u + u * x[1], u * u + u * x[2] + x[3]);
        r[i] = Y[i] - x[0] * above / below;
        if let Some(j) = &mut j {
            let by = x[0] * above / (below * below);
            j[4 * i..4 * i + 4].copy_from_slice(&[-above / below, -x[0] * u / below, by * u, by]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jacobians_match_differences() {
        for problem in &CLASSICS {
            let n = problem.start.len();
            // Not at the start, where some derivatives vanish.
            let x: Vec<f64> =
                problem.start.iter().enumerate().map(|(k, v)| v + 0.13 + 0.07 * k as f64).collect();
            let mut r = vec![0.0; problem.rows];
            let mut j = vec![0.0; problem.rows * n];
            (problem.evaluate)(&x, &mut r, Some(&mut j));
            for k in 0..n {
                let h = 1e-6 * x[k].abs().max(1.0);
                let at = |sign: f64| {
                    let mut moved = x.clone();
                    moved[k] += sign * h;
                    let mut r = vec![0.0; problem.rows];
                    (problem.evaluate)(&moved, &mut r, None);
                    r
                };
                let (low, high) = (at(-1.0), at(1.0));
                for i in 0..problem.rows {
                    let difference = (high[i] - low[i]) / (2.0 * h);
                    let size = difference.abs().max(1.0);
                    assert!(
                        (difference - j[i * n + k]).abs() < 1e-5 * size,
                        "{} r{i} x{k}: {difference} {}",
                        problem.name,
                        j[i * n + k]
                    );
                }
            }
        }
    }
}
