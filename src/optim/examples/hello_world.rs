//! The smallest problem: `min 1/2 (10 - x)^2`.
//!
//! ```sh
//! cargo run -p rowgram-optim --example hello_world
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram_optim::{
    engine::SolveError,
    nlls::{
        Euclidean, Infeasible, Loss, Options, Problem, Residual, Residuals, Scalar, Vector, solve,
    },
};

struct Ten;

impl Residual<1> for Ten {
    type Blocks = (Vector<1>,);
    fn evaluate<T: Scalar>(&self, (x,): ([T; 1],)) -> Result<[T; 1], Infeasible> {
        Ok([-x[0] + 10.0])
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    let mut problem = Problem::new();
    let x = problem.block("x", Euclidean(1), &[0.5])?;
    problem.add("ten", Loss::Trivial, Residuals::new([([x], Ten)]))?;
    let mut values = problem.start();
    let summary = solve(&problem, &mut values, &Options::default(), 50)?;
    println!("{summary}x = {}", values[0]);
    assert!((values[0] - 10.0).abs() < 1e-9);
    Ok(())
}
