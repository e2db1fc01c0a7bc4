//! The residuals of the radiometric block adjustment, all linear.
//!
//! ```text
//! light:  (y_0 - L_0 - g_0 - sqrt(3) (k . radial + a . direction)) / sigma_0,   (y_1 - L_1 - g_1) / sigma_1,   (y_2 - L_2 - g_2) / sigma_2
//! gains:  (g_0 - sqrt(3) e - l) / t_0,   g_1 / t_1,   g_2 / t_2
//! walk:   (l_i+1 - l_i) / w
//! shape:  k / sigma
//! chain:  (S_i+1 - S_i - n_i g_i) / tight
//! ```
//!
//! A photo's block is `[g_0, g_1, g_2, l]`, in the combinations of channels that [`super`] names.

use super::{DIRECTION, RADIAL};
use rowgram_optim::{
    engine::SolveError,
    nlls::{BlockId, Factor, Factors, GaussianPrior, Infeasible, Jacobian, Problem},
};

/// Standard deviation of a link of the chain: far below what a gain is known to, far above rounding.
const TIGHT: f64 = 1e-4;

/// A point in a photo.
#[derive(Debug, Clone, Copy)]
pub(super) struct Light {
    /// Photo, vignetting, direction of view, point.
    pub(super) blocks: [BlockId; 4],
    pub(super) value: [f64; 3],
    pub(super) radial: [f64; RADIAL],
    pub(super) direction: [f64; DIRECTION],
    pub(super) inverse_sigma: [f64; 3],
}

impl Factor for Light {
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
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let shape = dot(x[1], &self.radial) + dot(x[2], &self.direction);
        for k in 0..3 {
            let shape = if k == 0 { shape } else { 0.0 };
            residual[k] = (self.value[k] - x[3][k] - x[0][k] - shape) * self.inverse_sigma[k];
        }
        if let Some(jacobian) = jacobian {
            const POINT: usize = 4 + RADIAL + DIRECTION;
            for k in 0..3 {
                let row = jacobian.row(k);
                row[k] = -self.inverse_sigma[k];
                row[POINT + k] = -self.inverse_sigma[k];
            }
            let row = &mut jacobian.row(0)[4..POINT];
            for (entry, term) in row.iter_mut().zip(self.radial.iter().chain(&self.direction)) {
                *entry = -term * self.inverse_sigma[0];
            }
        }
        Ok(())
    }
}

/// What is known of a photo's gain beforehand.
#[derive(Debug, Clone, Copy)]
pub(super) struct PhotoPrior {
    pub(super) blocks: [BlockId; 1],
    pub(super) exposure: f64,
    pub(super) inverse_sigma: [f64; 3],
}

impl Factor for PhotoPrior {
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
        residual[0] = (x[0][0] - self.exposure - x[0][3]) * self.inverse_sigma[0];
        residual[1] = x[0][1] * self.inverse_sigma[1];
        residual[2] = x[0][2] * self.inverse_sigma[2];
        if let Some(jacobian) = jacobian {
            (0..3).for_each(|k| jacobian.row(k)[k] = self.inverse_sigma[k]);
            jacobian.row(0)[3] = -self.inverse_sigma[0];
        }
        Ok(())
    }
}

/// Light of a photo and of the next one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Walk {
    pub(super) blocks: [BlockId; 2],
    pub(super) inverse_sigma: f64,
}

impl Factor for Walk {
    fn rows(&self) -> usize {
        1
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
        residual[0] = (x[1][3] - x[0][3]) * self.inverse_sigma;
        if let Some(jacobian) = jacobian {
            let row = jacobian.row(0);
            row[3] = -self.inverse_sigma;
            row[7] = self.inverse_sigma;
        }
        Ok(())
    }
}

/// Coefficients near 0, the same for each block.
pub(super) fn shape_priors(
    problem: &Problem,
    blocks: &[BlockId],
    sigma: f64,
) -> Result<Factors<GaussianPrior>, SolveError> {
    let of = |&block: &BlockId| {
        let n = problem.dimension(block);
        GaussianPrior::new(problem, block, &vec![0.0; n], &vec![sigma; n])
    };
    Ok(Factors(blocks.iter().map(of).collect::<Result<_, _>>()?))
}

/// A link of the weighted sum of gains.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chain {
    /// Photo, sum before it, sum with it.
    pub(super) blocks: [BlockId; 3],
    pub(super) weight: f64,
}

impl Factor for Chain {
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
        for k in 0..3 {
            residual[k] = (x[2][k] - x[1][k] - self.weight * x[0][k]) / TIGHT;
        }
        if let Some(jacobian) = jacobian {
            for k in 0..3 {
                let row = jacobian.row(k);
                row[k] = -self.weight / TIGHT;
                row[4 + k] = -1.0 / TIGHT;
                row[7 + k] = 1.0 / TIGHT;
            }
        }
        Ok(())
    }
}
