//! A residual of your own: `y - a exp(-b t)`, fitted to eight measurements, with standard deviations.
//!
//! ```sh
//! cargo run --example custom_factor
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram::{
    engine::SolveError,
    nlls::{
        BlockId, Euclidean, Factor, Factors, Infeasible, Jacobian, LinearSolver, Loss, Options,
        Problem, covariance::Covariance, solve,
    },
};

/// One measurement `y` at the time `t`, with its standard deviation.
struct Decay {
    block: [BlockId; 1],
    t: f64,
    y: f64,
    sigma: f64,
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
        let (a, b) = (x[0][0], x[0][1]);
        let e = (-b * self.t).exp();
        residual[0] = (a * e - self.y) / self.sigma;
        if let Some(jacobian) = jacobian {
            jacobian.row(0).copy_from_slice(&[e / self.sigma, -self.t * a * e / self.sigma]);
        }
        Ok(())
    }
}

fn main() -> Result<(), SolveError> {
    let mut problem = Problem::new();
    let curve = problem.block("curve", Euclidean(2), &[1.0, 1.0])?;
    let measured = [5.02, 3.85, 3.07, 2.41, 1.84, 1.45, 1.18, 0.89];
    let factors: Vec<Decay> = measured
        .iter()
        .enumerate()
        .map(|(k, &y)| Decay { block: [curve], t: 0.5 * k as f64, y, sigma: 0.03 })
        .collect();
    problem.add("decay", Loss::Trivial, Factors(factors))?;
    let mut x = problem.start();
    let summary = solve(&problem, &mut x, &Options::default(), 50)?;
    let covariance = Covariance::new(&problem, &x, LinearSolver::Dense)?.block(curve);
    let values = problem.values(&x, curve);
    println!("stopped because {}", summary.stop.explain());
    println!("a = {:.3} +- {:.3}", values[0], covariance[0].sqrt());
    println!("b = {:.3} +- {:.3}", values[1], covariance[3].sqrt());
    assert!((values[0] - 5.0).abs() < 0.1 && (values[1] - 0.5).abs() < 0.02);
    Ok(())
}
