//! What is known of a block beforehand: a normal distribution of some of its numbers.
//!
//! ```text
//! r = W (x - x_0),   W^T W = C^-1
//! ```
//!
//! with the expected values `x_0` and their covariance `C`; for independent numbers `r_k = (x_k - x_0k) / sigma_k`. Of a block
//! that is not a vector those numbers can have a prior that one entry of the tangent moves and no other
//! ([`Manifold::additive_value`](super::Manifold::additive_value)).

use super::{
    factor::{Factor, Infeasible, Jacobian},
    problem::{BlockId, Problem},
};
use crate::engine::SolveError;
use nalgebra::DMatrix;

/// A normal distribution of numbers of one block, as a factor: a batch of them is
/// [`Factors`](super::Factors)`(vec![prior, ...])`.
///
/// ```
/// use rowgram_optim::nlls::{Euclidean, Factors, GaussianPrior, Loss, Options, Problem, solve};
///
/// let mut problem = Problem::new();
/// let lens = problem.block("lens", Euclidean(2), &[1000.0, 0.1])?;
/// let prior = GaussianPrior::new(&problem, lens, &[1200.0, 0.0], &[5.0, 0.01])?;
/// problem.add("data sheet", Loss::Trivial, Factors(vec![prior]))?;
/// let mut x = problem.start();
/// solve(&problem, &mut x, &Options::default(), 50)?;
/// assert!((x[0] - 1200.0).abs() < 1e-6 && x[1].abs() < 1e-9);
/// # Ok::<(), rowgram_optim::engine::SolveError>(())
/// ```
#[derive(Debug, Clone)]
pub struct GaussianPrior {
    block: [BlockId; 1],
    /// Where each number is among the values, and which entry of the tangent moves it.
    places: Vec<(usize, usize)>,
    expected: Vec<f64>,
    scale: Scale,
}

#[derive(Debug, Clone)]
enum Scale {
    /// Standard deviations of independent numbers.
    Sigmas(Vec<f64>),
    /// `W`, row-major.
    Whitening(Vec<f64>),
}

impl GaussianPrior {
    /// Independent numbers: all of a block, with the values expected and their standard deviations.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] where there are not as many as the block has entries, where the block is no vector, and for
    /// values that are not finite or standard deviations that are not positive.
    pub fn new(
        problem: &Problem,
        block: BlockId,
        expected: &[f64],
        sigmas: &[f64],
    ) -> Result<GaussianPrior, SolveError> {
        let entries: Vec<usize> = (0..problem.dimension(block)).collect();
        GaussianPrior::of_entries(problem, block, &entries, expected, sigmas)
    }

    /// Independent numbers: those that some entries of the block's tangent move.
    ///
    /// # Errors
    /// As [`GaussianPrior::new`].
    pub fn of_entries(
        problem: &Problem,
        block: BlockId,
        entries: &[usize],
        expected: &[f64],
        sigmas: &[f64],
    ) -> Result<GaussianPrior, SolveError> {
        let name = || problem.describe(block);
        if sigmas.len() != entries.len() {
            return Err(SolveError::Misuse(format!(
                "the prior of {} has {} standard deviations for {} numbers",
                name(),
                sigmas.len(),
                entries.len()
            )));
        }
        if let Some(sigma) = sigmas.iter().find(|sigma| !(**sigma > 0.0 && sigma.is_finite())) {
            return Err(SolveError::Misuse(format!(
                "the prior of {} has the standard deviation {sigma}, expected a positive number",
                name()
            )));
        }
        let scale = Scale::Sigmas(sigmas.to_vec());
        GaussianPrior::with_scale(problem, block, entries, expected, scale)
    }

    /// Numbers with a covariance, row-major.
    ///
    /// # Errors
    /// As [`GaussianPrior::new`], and where the covariance is not positive definite.
    pub fn with_covariance(
        problem: &Problem,
        block: BlockId,
        entries: &[usize],
        expected: &[f64],
        covariance: &[f64],
    ) -> Result<GaussianPrior, SolveError> {
        let n = entries.len();
        let unusable = || {
            SolveError::Misuse(format!(
                "the covariance of the prior of {} is no positive definite matrix of {n} rows",
                problem.describe(block)
            ))
        };
        // The inverse of the Cholesky factor of C.
        let inverse = (covariance.len() == n * n)
            .then(|| DMatrix::from_row_slice(n, n, covariance).cholesky())
            .flatten()
            .and_then(|factor| factor.unpack().solve_lower_triangular(&DMatrix::identity(n, n)))
            .ok_or_else(unusable)?;
        let whitening: Vec<f64> = (0..n * n).map(|k| inverse[(k / n, k % n)]).collect();
        if whitening.iter().any(|w| !w.is_finite()) {
            return Err(unusable());
        }
        GaussianPrior::with_scale(problem, block, entries, expected, Scale::Whitening(whitening))
    }

    fn with_scale(
        problem: &Problem,
        block: BlockId,
        entries: &[usize],
        expected: &[f64],
        scale: Scale,
    ) -> Result<GaussianPrior, SolveError> {
        let name = || problem.describe(block);
        if entries.is_empty() || entries.len() != expected.len() {
            return Err(SolveError::Misuse(format!(
                "the prior of {} expects {} values of {} numbers",
                name(),
                expected.len(),
                entries.len()
            )));
        }
        if let Some(value) = expected.iter().find(|value| !value.is_finite()) {
            return Err(SolveError::Misuse(format!("the prior of {} expects {value}", name())));
        }
        let place = |&entry: &usize| {
            let within = entry < problem.dimension(block);
            let value = within.then(|| problem.manifold(block).additive_value(entry)).flatten();
            value.map(|value| (value, entry)).ok_or_else(|| {
                SolveError::Misuse(format!(
                    "entry {entry} of {} moves no number of its own",
                    name()
                ))
            })
        };
        let places = entries.iter().map(place).collect::<Result<Vec<_>, _>>()?;
        Ok(GaussianPrior { block: [block], places, expected: expected.to_vec(), scale })
    }
}

impl Factor for GaussianPrior {
    fn rows(&self) -> usize {
        self.expected.len()
    }

    fn blocks(&self) -> &[BlockId] {
        &self.block
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        mut jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        let n = self.expected.len();
        match &self.scale {
            Scale::Sigmas(sigmas) => {
                for (row, sigma) in sigmas.iter().enumerate() {
                    let (value, tangent) = self.places[row];
                    residual[row] = (x[0][value] - self.expected[row]) / sigma;
                    if let Some(jacobian) = jacobian.as_deref_mut() {
                        jacobian.row(row)[tangent] = 1.0 / sigma;
                    }
                }
            }
            Scale::Whitening(whitening) => {
                for (row, weights) in whitening.chunks_exact(n).enumerate() {
                    residual[row] = weights
                        .iter()
                        .zip(&self.places)
                        .zip(&self.expected)
                        .map(|((w, &(value, _)), expected)| w * (x[0][value] - expected))
                        .sum();
                    if let Some(jacobian) = jacobian.as_deref_mut() {
                        let to = jacobian.row(row);
                        for (w, &(_, tangent)) in weights.iter().zip(&self.places) {
                            to[tangent] = *w;
                        }
                    }
                }
            }
        }
        Ok(())
    }
}
