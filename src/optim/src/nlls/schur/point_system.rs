//! The normal equations of one point.

use super::layout::point_record;
use crate::nlls::elimination::damping;

/// `V`, its damping and `g` of one point.
pub(super) struct PointSystem<const P: usize> {
    /// The lower triangle of `V`, then its Cholesky factor with the pivots inverted.
    v: [[f64; P]; P],
    pub(super) g: [f64; P],
    /// `lambda D`.
    pub(super) damped: [f64; P],
    /// `D`, 0 where nothing is known.
    pub(super) diagonal: [f64; P],
}

/// What factors of a point alone, priors, add to its normal equations.
#[derive(Debug, Clone, Copy)]
pub(super) struct PriorSums<const P: usize> {
    /// The lower triangle of `J^T J`.
    pub(super) v: [[f64; P]; P],
    /// `J^T r`.
    pub(super) g: [f64; P],
}

impl<const P: usize> PriorSums<P> {
    pub(super) const NONE: Self = PriorSums { v: [[0.0; P]; P], g: [0.0; P] };

    /// Adds one row of the Jacobian and its residual.
    #[inline(always)]
    pub(super) fn add(&mut self, row: &[f64], residual: f64) {
        for i in 0..P {
            self.g[i] += row[i] * residual;
            for j in 0..=i {
                self.v[i][j] += row[i] * row[j];
            }
        }
    }
}

impl<const P: usize> PointSystem<P> {
    /// Sums over the records of a point's observations, `R` rows each, on top of its priors.
    #[inline(always)]
    pub(super) fn new<const R: usize>(records: &[f64], prior: Option<&PriorSums<P>>) -> Self {
        let PriorSums { mut v, mut g } = *prior.unwrap_or(&PriorSums::NONE);
        for record in records.chunks_exact(point_record(R, P)) {
            for row in 0..R {
                let row = &record[row * (P + 1)..(row + 1) * (P + 1)];
                for i in 0..P {
                    g[i] += row[i] * row[P];
                    for j in 0..=i {
                        v[i][j] += row[i] * row[j];
                    }
                }
            }
        }
        let mut diagonal = [0.0; P];
        for k in 0..P {
            diagonal[k] = v[k][k];
        }
        PointSystem { v, g, damped: [0.0; P], diagonal }
    }

    /// The largest `|g_k| / sqrt(D_k)`.
    #[inline(always)]
    pub(super) fn slope(&self) -> f64 {
        let mut slope = 0.0;
        for k in 0..P {
            if self.diagonal[k] > 0.0 {
                slope = f64::max(slope, self.g[k].abs() / self.diagonal[k].sqrt());
            }
        }
        slope
    }

    /// Damps and factorises, holding the entries with a bit in `frozen`; `false` where the matrix
    /// is not positive definite.
    #[inline(always)]
    pub(super) fn factorize(&mut self, lambda: f64, frozen: u32) -> bool {
        for k in 0..P {
            let held = frozen >> k & 1 == 1;
            if held {
                for j in 0..P {
                    self.v[k.max(j)][k.min(j)] = 0.0;
                }
                self.g[k] = 0.0;
                self.diagonal[k] = 0.0;
            }
            self.damped[k] = if held { 1.0 } else { lambda * damping(self.diagonal[k]) };
            self.v[k][k] += self.damped[k];
        }
        let mut definite = true;
        for j in 0..P {
            let mut pivot = self.v[j][j];
            for k in 0..j {
                pivot -= self.v[j][k] * self.v[j][k];
            }
            definite &= pivot > 0.0 && pivot.is_finite();
            let inverse = 1.0 / pivot.sqrt();
            self.v[j][j] = inverse;
            for i in j + 1..P {
                let mut sum = self.v[i][j];
                for k in 0..j {
                    sum -= self.v[i][k] * self.v[j][k];
                }
                self.v[i][j] = sum * inverse;
            }
        }
        definite
    }

    /// `L^-1 b`.
    #[inline(always)]
    pub(super) fn forward(&self, b: [f64; P]) -> [f64; P] {
        let mut y = b;
        for i in 0..P {
            for k in 0..i {
                y[i] -= self.v[i][k] * y[k];
            }
            y[i] *= self.v[i][i];
        }
        y
    }

    /// `L^-T b`.
    #[inline(always)]
    pub(super) fn backward(&self, b: [f64; P]) -> [f64; P] {
        let mut y = b;
        for i in (0..P).rev() {
            for k in i + 1..P {
                y[i] -= self.v[k][i] * y[k];
            }
            y[i] *= self.v[i][i];
        }
        y
    }
}
