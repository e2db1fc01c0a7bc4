//! A prior of your own: heights along a line that a few measurements know, held together by smoothness.
//!
//! ```sh
//! cargo run --example custom_prior
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram::{
    engine::SolveError,
    nlls::{
        BlockId, Euclidean, Factor, Factors, Infeasible, Jacobian, Loss, Options, Problem, solve,
    },
};

/// A linear residual `(sum_k w_k x_k - value) / sigma` of a few heights.
struct Weighted {
    blocks: Vec<BlockId>,
    weights: Vec<f64>,
    value: f64,
    sigma: f64,
}

impl Factor for Weighted {
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
        let sum: f64 = x.iter().zip(&self.weights).map(|(x, w)| w * x[0]).sum();
        residual[0] = (sum - self.value) / self.sigma;
        if let Some(jacobian) = jacobian {
            for (entry, weight) in jacobian.row(0).iter_mut().zip(&self.weights) {
                *entry = weight / self.sigma;
            }
        }
        Ok(())
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    let mut problem = Problem::new();
    let heights: Vec<BlockId> =
        (0..11).map(|_| problem.block("height", Euclidean(1), &[0.0])).collect::<Result<_, _>>()?;
    // The last measurement is wrong by metres: a robust loss keeps it from bending the line.
    let measured = [(0, 1.0), (3, 1.6), (6, 2.2), (10, 3.0), (8, 9.0)];
    let data = measured.map(|(k, value)| Weighted {
        blocks: vec![heights[k]],
        weights: vec![1.0],
        value,
        sigma: 0.02,
    });
    problem.add("measured", Loss::Cauchy(1.0), Factors(data.into()))?;
    // The prior: second differences are zero, to a centimetre.
    let smooth = heights.windows(3).map(|three| Weighted {
        blocks: three.to_vec(),
        weights: vec![1.0, -2.0, 1.0],
        value: 0.0,
        sigma: 0.01,
    });
    problem.add("smooth", Loss::Trivial, Factors(smooth.collect()))?;
    let mut x = problem.start();
    solve(&problem, &mut x, &Options::default(), 100)?;
    for (k, &height) in heights.iter().enumerate() {
        let value = problem.values(&x, height)[0];
        println!("{k:2}: {value:.3} m");
        assert!((value - (1.0 + 0.2 * k as f64)).abs() < 0.1);
    }
    Ok(())
}
