//! A loss of your own, Welsch's, which forgets outliers altogether: the middle of a few numbers of which two are wrong.
//!
//! ```sh
//! cargo run -p rowgram-optim --example custom_loss
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram_optim::{
    engine::SolveError,
    nlls::{
        Euclidean, Factors, GaussianPrior, LossFunction, Options, Problem, Rho, check::check_loss,
        solve,
    },
};

/// `rho(s) = a^2 (1 - exp(-s / a^2))` of the squared residual `s`.
#[derive(Debug)]
struct Welsch(f64);

impl LossFunction for Welsch {
    fn evaluate(&self, s: f64) -> Rho {
        let square = self.0 * self.0;
        let e = (-s / square).exp();
        Rho { value: square * (1.0 - e), first: e, second: -e / square }
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    // Value, slope and curvature belong together.
    (1..40)
        .try_for_each(|k| check_loss(&Welsch(2.0), 0.25 * f64::from(k)))
        .map_err(SolveError::Misuse)?;
    let seen = [4.98, 5.03, 5.01, 4.96, 5.02, 9.5, 12.0];
    let mut problem = Problem::new();
    let middle = problem.block("middle", Euclidean(1), &[5.5])?;
    let seen = seen.map(|value| GaussianPrior::new(&problem, middle, &[value], &[0.1]));
    let seen = seen.into_iter().collect::<Result<Vec<_>, _>>()?;
    problem.add("seen", Welsch(3.0), Factors(seen))?;
    let mut x = problem.start();
    let summary = solve(&problem, &mut x, &Options::default(), 200)?;
    println!("{summary}middle {:.3}", x[0]);
    assert!((x[0] - 5.0).abs() < 0.005);
    Ok(())
}
