//! A curve `y = a exp(-b t)` through measurements of which two are wrong, with a robust loss.
//!
//! ```sh
//! cargo run -p rowgram-optim --example curve_fitting
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram_optim::{
    engine::SolveError,
    nlls::{
        Euclidean, Infeasible, Loss, Options, Problem, Residual, Residuals, Scalar, Vector, solve,
    },
};

/// One measurement `y` at the time `t`, with its standard deviation.
struct Sample {
    t: f64,
    y: f64,
    sigma: f64,
}

impl Residual<1> for Sample {
    type Blocks = (Vector<2>,);
    fn evaluate<T: Scalar>(&self, ([a, b],): ([T; 2],)) -> Result<[T; 1], Infeasible> {
        Ok([(a * (b * -self.t).exp() - self.y) / self.sigma])
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    let measured = [5.02, 3.85, 3.07, 9.41, 1.84, 1.45, -4.0, 0.89, 0.69, 0.51];
    let fit = |loss: Loss| -> Result<[f64; 2], SolveError> {
        let mut problem = Problem::new();
        let curve = problem.block("curve", Euclidean(2), &[1.0, 1.0])?;
        let samples = measured.iter().enumerate().map(|(k, &y)| {
            let t = 0.5 * k as f64;
            ([curve], Sample { t, y, sigma: 0.03 })
        });
        problem.add("samples", loss, Residuals::new(samples))?;
        let mut x = problem.start();
        let summary = solve(&problem, &mut x, &Options::default(), 200)?;
        println!("{loss}: a = {:.3}, b = {:.3}, {}", x[0], x[1], summary.stop.explain());
        Ok([x[0], x[1]])
    };
    let [a, b] = fit(Loss::Cauchy(1.0))?;
    assert!((a - 5.0).abs() < 0.1 && (b - 0.5).abs() < 0.02);
    let [a, _] = fit(Loss::Trivial)?;
    assert!((a - 5.0).abs() > 0.1);
    Ok(())
}
