//! Five correspondences give the essential matrices of two calibrated photos, without any
//! assumption on the flight.
//!
//! The five linear equations leave `E = x A + y B + z C + D`; `det E = 0` and
//! `2 E E^T E - tr(E E^T) E = 0` are ten cubics in `(x, y, z)`. Gauss-Jordan elimination reduces them to a
//! 3 x 3 matrix of polynomials in `z` with a determinant of degree ten. Reference: D. Nister, *An
//! efficient solution to the five-point relative pose problem*, PAMI 26(6), 2004.

use super::Correspondence;
use crate::sfm::polynomial::real_roots;
use nalgebra::{Matrix3, SMatrix};

/// Exponents of `x, y, z` of the twenty monomials, in the order of the elimination.
const MONOMIALS: [[u8; 3]; 20] = [
    [3, 0, 0],
    [0, 3, 0],
    [2, 1, 0],
    [1, 2, 0],
    [2, 0, 1],
    [2, 0, 0],
    [0, 2, 1],
    [0, 2, 0],
    [1, 1, 1],
    [1, 1, 0],
    [1, 0, 2],
    [1, 0, 1],
    [1, 0, 0],
    [0, 1, 2],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 3],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];

const fn place_of(exponents: [u8; 3]) -> usize {
    let mut k = 0;
    while k < 20 {
        let m = MONOMIALS[k];
        if m[0] == exponents[0] && m[1] == exponents[1] && m[2] == exponents[2] {
            return k;
        }
        k += 1;
    }
    20
}

/// Place of the product of two monomials; 20 where its degree is above three.
const PRODUCTS: [[usize; 20]; 20] = {
    let mut table = [[20; 20]; 20];
    let mut i = 0;
    while i < 20 {
        let mut j = 0;
        while j < 20 {
            let (a, b) = (MONOMIALS[i], MONOMIALS[j]);
            table[i][j] = place_of([a[0] + b[0], a[1] + b[1], a[2] + b[2]]);
            j += 1;
        }
        i += 1;
    }
    table
};

/// The monomials of degree at most one and at most two.
const LINEAR: [usize; 4] = [12, 15, 18, 19];
const QUADRATIC: [usize; 10] = [5, 7, 9, 11, 12, 14, 15, 17, 18, 19];

type Polynomial = [f64; 20];

fn times(a: &Polynomial, of_a: &[usize], b: &Polynomial, scale: f64, out: &mut Polynomial) {
    for &i in of_a {
        for &j in &LINEAR {
            out[PRODUCTS[i][j]] += scale * a[i] * b[j];
        }
    }
}

/// All essential matrices of five correspondences, scaled to norm 1.
pub fn solve(five: [&Correspondence; 5], out: &mut Vec<Matrix3<f64>>) {
    let mut rows = SMatrix::<f64, 9, 9>::zeros();
    for (k, c) in five.iter().enumerate() {
        let (a, b) = ([c.first[0], c.first[1], -1.0], [c.second[0], c.second[1], -1.0]);
        for i in 0..3 {
            for j in 0..3 {
                rows[(k, 3 * i + j)] = b[i] * a[j];
            }
        }
    }
    // The null space of five rows: the last columns of Q in the QR of the transpose.
    let q = {
        let mut transposed = SMatrix::<f64, 9, 5>::zeros();
        for k in 0..5 {
            for j in 0..9 {
                transposed[(j, k)] = rows[(k, j)];
            }
        }
        let mut whole = SMatrix::<f64, 9, 9>::identity();
        let qr = transposed.qr();
        qr.q_tr_mul(&mut whole);
        whole.transpose()
    };
    // entries[i][j]: E_ij as a polynomial of degree one.
    let mut entries = [[[0.0; 20]; 3]; 3];
    for i in 0..3 {
        for j in 0..3 {
            for (m, &place) in LINEAR.iter().enumerate() {
                entries[i][j][place] = q[(3 * i + j, 5 + m)];
            }
        }
    }
    let Some(reduced) = eliminate(constraints(&entries)) else { return };
    let (matrix, determinant) = hidden(&reduced);
    for z in real_roots(&determinant, 1e4) {
        let at = |p: &[f64; 5]| p.iter().rev().fold(0.0, |sum, v| sum * z + v);
        let b: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| at(&matrix[i][j])));
        // The null vector of B(z): the best conditioned of the three cross products of its rows.
        let cross = |i: usize, j: usize| rowgram_optim::geometry::cross(b[i], b[j]);
        let candidates = [cross(0, 1), cross(1, 2), cross(0, 2)];
        let best = candidates
            .into_iter()
            .max_by(|u, v| u[2].abs().total_cmp(&v[2].abs()))
            .filter(|v| v[2].abs() > 1e-14);
        let Some(v) = best else { continue };
        let (x, y) = (v[0] / v[2], v[1] / v[2]);
        let mut e = Matrix3::zeros();
        for i in 0..3 {
            for j in 0..3 {
                let n = 3 * i + j;
                e[(i, j)] = x * q[(n, 5)] + y * q[(n, 6)] + z * q[(n, 7)] + q[(n, 8)];
            }
        }
        let norm = e.norm();
        if norm.is_finite() && norm > 1e-12 {
            out.push(e / norm);
        }
    }
}

/// `2 E E^T E - tr(E E^T) E` and `det E`.
fn constraints(e: &[[Polynomial; 3]; 3]) -> [Polynomial; 10] {
    let mut square = [[[0.0; 20]; 3]; 3];
    for i in 0..3 {
        for j in 0..3 {
            for k in 0..3 {
                times(&e[i][k], &LINEAR, &e[j][k], 1.0, &mut square[i][j]);
            }
        }
    }
    let trace: Polynomial =
        std::array::from_fn(|p| 0.5 * (square[0][0][p] + square[1][1][p] + square[2][2][p]));
    (0..3).for_each(|i| (0..20).for_each(|p| square[i][i][p] -= trace[p]));
    let mut out = [[0.0; 20]; 10];
    for i in 0..3 {
        for j in 0..3 {
            for k in 0..3 {
                times(&square[i][k], &QUADRATIC, &e[k][j], 1.0, &mut out[3 * i + j]);
            }
        }
    }
    for (column, sign) in [(0, 1.0), (1, -1.0), (2, 1.0)] {
        let (a, b) = [(1, 2), (0, 2), (0, 1)][column];
        let mut minor = [0.0; 20];
        times(&e[1][a], &LINEAR, &e[2][b], 1.0, &mut minor);
        times(&e[1][b], &LINEAR, &e[2][a], -1.0, &mut minor);
        times(&minor, &QUADRATIC, &e[0][column], sign, &mut out[9]);
    }
    out
}

/// Gauss-Jordan elimination of the first ten monomials.
fn eliminate(mut rows: [Polynomial; 10]) -> Option<[Polynomial; 10]> {
    for column in 0..10 {
        let pivot = (column..10)
            .max_by(|&a, &b| rows[a][column].abs().total_cmp(&rows[b][column].abs()))?;
        if rows[pivot][column].abs() < 1e-13 {
            return None;
        }
        rows.swap(column, pivot);
        let scale = 1.0 / rows[column][column];
        rows[column].iter_mut().for_each(|v| *v *= scale);
        let of = rows[column];
        for (k, row) in rows.iter_mut().enumerate() {
            // Rows above the fifth are not asked for, so they need not be cleared.
            if k != column && (k > column || k >= 4) {
                let share = row[column];
                (column..20).for_each(|p| row[p] -= share * of[p]);
            }
        }
    }
    Some(rows)
}

/// The matrix of polynomials in `z` that `(x, y, 1)` is a null vector of, and its determinant.
fn hidden(rows: &[Polynomial; 10]) -> ([[[f64; 5]; 3]; 3], [f64; 11]) {
    // row(x^2 z) - z row(x^2) and so on: monomials x z^2 .. 1 remain.
    let matrix: [[[f64; 5]; 3]; 3] = std::array::from_fn(|k| {
        let (a, b) = (&rows[4 + 2 * k], &rows[5 + 2 * k]);
        [
            [a[12], a[11] - b[12], a[10] - b[11], -b[10], 0.0],
            [a[15], a[14] - b[15], a[13] - b[14], -b[13], 0.0],
            [a[19], a[18] - b[19], a[17] - b[18], a[16] - b[17], -b[16]],
        ]
    });
    let mut determinant = [0.0; 11];
    for (i, j, k, sign) in [
        (0, 1, 2, 1.0),
        (1, 2, 0, 1.0),
        (2, 0, 1, 1.0),
        (0, 2, 1, -1.0),
        (1, 0, 2, -1.0),
        (2, 1, 0, -1.0),
    ] {
        for (p, u) in matrix[0][i].iter().enumerate() {
            for (q, v) in matrix[1][j].iter().enumerate() {
                for (r, w) in matrix[2][k].iter().enumerate() {
                    if p + q + r < 11 {
                        determinant[p + q + r] += sign * u * v * w;
                    }
                }
            }
        }
    }
    (matrix, determinant)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sfm::relative::{RelativePose, sampson_squared};
    use nalgebra::{Rotation3, Vector3};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn the_true_essential_matrix_is_among_the_answers() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut found_all = 0;
        for _ in 0..200 {
            let mut number = || rng.random_range(-1.0..1.0);
            let pose = RelativePose {
                rotation: Rotation3::from_scaled_axis(Vector3::new(number(), number(), number()))
                    .into_inner(),
                translation: Vector3::new(number(), number(), number()).normalize(),
            };
            let mut seen = Vec::new();
            while seen.len() < 5 {
                let at = Vector3::new(2.0 * number(), 2.0 * number(), -4.0 + number());
                let moved = pose.rotation * at + pose.translation;
                seen.push(Correspondence {
                    first: [at.x / -at.z, at.y / -at.z],
                    second: [moved.x / -moved.z, moved.y / -moved.z],
                });
            }
            let mut found = Vec::new();
            solve(std::array::from_fn(|k| &seen[k]), &mut found);
            assert!(found.len() <= 10);
            for e in &found {
                for c in &seen {
                    assert!(sampson_squared(e, c) < 1e-12);
                }
            }
            let truth = pose.essential() / pose.essential().norm();
            let nearest = found
                .iter()
                .map(|e| (e - truth).norm().min((e + truth).norm()))
                .fold(f64::INFINITY, f64::min);
            found_all += usize::from(nearest < 1e-5);
        }
        // Some random cases are close to singular and keep fewer digits.
        assert!(found_all >= 190, "{found_all} of 200");
    }
}
