//! A manifold of your own, without a derivative by hand: headings, as points `(cos, sin)` of the unit circle.
//!
//! ```sh
//! cargo run -p rowgram-optim --example custom_manifold
//! ```
#![allow(clippy::print_stdout, reason = "an example prints")]

use rowgram_optim::{
    engine::SolveError,
    nlls::{
        Infeasible, Loss, Manifold, Options, Problem, Residual, Residuals, Scalar,
        check::check_manifold, residual::Parameter, solve,
    },
};

#[derive(Debug, PartialEq)]
struct Circle;

impl Manifold for Circle {
    fn ambient(&self) -> usize {
        2
    }
    fn tangent(&self) -> usize {
        1
    }
    fn plus(&self, x: &[f64], d: &[f64], out: &mut [f64]) {
        let (sin, cos) = d[0].sin_cos();
        out.copy_from_slice(&[cos * x[0] - sin * x[1], sin * x[0] + cos * x[1]]);
    }
    fn minus(&self, y: &[f64], x: &[f64], out: &mut [f64]) {
        out[0] = (x[0] * y[1] - x[1] * y[0]).atan2(x[0] * y[0] + x[1] * y[1]);
    }
}

/// What residuals see of such a block: `plus` over dual numbers, which is all that their derivatives need.
struct Heading;

impl Parameter for Heading {
    const AMBIENT: usize = 2;
    const TANGENT: usize = 1;
    type Of<T: Scalar> = [T; 2];
    fn at<T: Scalar>(x: &[f64], increment: impl Fn(usize) -> T) -> [T; 2] {
        let (sin, cos) = (increment(0).sin(), increment(0).cos());
        [cos * x[0] - sin * x[1], sin * x[0] + cos * x[1]]
    }
}

/// A measured heading, as a unit vector.
struct Compass([f64; 2]);

impl Residual<2> for Compass {
    type Blocks = (Heading,);
    fn evaluate<T: Scalar>(&self, (heading,): ([T; 2],)) -> Result<[T; 2], Infeasible> {
        Ok([heading[0] - self.0[0], heading[1] - self.0[1]])
    }
}

pub(crate) fn main() -> Result<(), SolveError> {
    check_manifold(&Circle, &[0.6, 0.8], &[-0.8, 0.6], &[0.3], 1e-12)
        .map_err(SolveError::Misuse)?;
    let mut problem = Problem::new();
    let heading = problem.block("heading", Circle, &[0.0, 1.0])?;
    // On both sides of 180 degrees, where a mean of angles would be 0.
    let seen =
        [179.0f64, -179.0, 178.0].map(|deg| [deg.to_radians().cos(), deg.to_radians().sin()]);
    let residuals = seen.map(|measured| ([heading], Compass(measured)));
    problem.add("compass", Loss::Trivial, Residuals::new(residuals))?;
    let mut x = problem.start();
    solve(&problem, &mut x, &Options::default(), 50)?;
    let found_deg = x[1].atan2(x[0]).to_degrees();
    println!("{found_deg:.3} degrees");
    assert!((found_deg - 179.333).abs() < 0.01);
    Ok(())
}
